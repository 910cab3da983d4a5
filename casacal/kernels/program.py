"""An SX function as a list of elementary operations, split by how often each must be done; what each is in NumPy and C.

Operations on parameters alone are done once per call, operations on data alone once for all calls; what mixes both is
left for the kernel, lane by lane. A lane is a row of samples, or one of many states. NumPy and C give CasADi's own
answer for any number. An operation that has no form in C keeps a graph on blocks, where CasADi's machine does it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.graphs import Operation, operations_of
from casacal.kernels.algebra import Builder, Kind, Role


@dataclass(frozen=True)
class Program:
    """Operations in order, the kind of each, and for each output the values it consists of.

    starts: where each argument of role "once" begins in the vector p of all of them, one after the other.
    lanes: values of data alone that mixed operations or outputs use: what a kernel reads lane by lane, in this order.
    """

    operations: tuple[Operation, ...]
    kinds: tuple[Kind, ...]
    outputs: tuple[tuple[int, ...], ...]
    starts: tuple[int, ...]
    lanes: tuple[int, ...]

    def only(self, output: int) -> Program:
        """The program of one output, which reads the same lanes."""
        return replace(self, outputs=(self.outputs[output],))

    def position(self, value: int) -> int:
        """Where a value that is an element of an argument of role "once" stands in p."""
        argument, element = self.operations[value].element
        return self.starts[argument] + element

    def needed(self, roots: Sequence[int]) -> list[int]:
        """The values that some values depend on, themselves included, in order."""
        found, waiting = set[int](), list(roots)
        while waiting:
            value = waiting.pop()
            if value not in found:
                found.add(value)
                waiting += self.operations[value].args
        return sorted(found)

    @cached_property
    def once(self) -> list[int]:
        """Values of parameters alone that mixed operations or outputs use: what a kernel prepares before its loop."""
        return self.used("once")

    def used(self, kind: Kind) -> list[int]:
        """Values of one kind that mixed operations or outputs use."""
        mixed = {arg for v in self.needed(self.results) if self.kinds[v] == "mixed" for arg in self.operations[v].args}
        return [v for v in sorted(mixed | set(self.results)) if self.kinds[v] == kind]

    @property
    def results(self) -> list[int]:
        """All values that are outputs."""
        return [value for output in self.outputs for value in output]


def read_program(function: ca.Function, roles: Sequence[Role], *, ahead: bool = True) -> Program:
    """Read an SX function whose arguments have the given roles.

    `ahead`: whether operations on data alone are done once for all calls; otherwise each call does them, for data that
    differ from call to call, and lanes are elements of arguments. Raises ProblemError for what is not elementary.
    """
    builder = Builder(roles, ahead)
    operations, results = operations_of(function)
    made: list[int] = []
    for each in operations:
        given = each.op in (ca.OP_CONST, ca.OP_INPUT)
        made.append(builder.add(each) if given else builder.apply(elementary(each.op), *(made[i] for i in each.args)))
    outputs = _flattened(builder, [[made[value] for value in result] for result in results])
    sizes = [function.numel_in(i) if role == "once" else 0 for i, role in enumerate(roles)]
    starts = tuple(itertools.accumulate(sizes[:-1], initial=0))
    program = Program(tuple(builder.operations), tuple(builder.kinds), tuple(map(tuple, outputs)), starts, ())
    return replace(program, lanes=tuple(program.used("lane")))


def _flattened(builder: Builder, outputs: list[list[int]]) -> list[list[int]]:
    """Outputs that are sums of few values, each times a factor of parameters alone, as such where that saves work."""
    flat = {value: builder.flat(value) for output in outputs for value in output}
    chosen = {value: other for value, other in flat.items() if other != value}
    work = Work(builder.operations, builder.kinds)
    for value in flat:
        work.use(chosen.get(value, value))
    for value, other in list(chosen.items()):
        least = work.lanes
        work.use(value)
        work.use(other, -1)
        if work.lanes <= least:
            del chosen[value]
        else:
            work.use(other)
            work.use(value, -1)
    return [[chosen.get(value, value) for value in output] for output in outputs]


class Work:
    """How many operations must be done lane by lane for some values, as values come and go."""

    def __init__(self, operations: Sequence[Operation], kinds: Sequence[Kind]) -> None:
        self._operations, self._kinds, self._uses, self.lanes = operations, kinds, [0] * len(operations), 0

    def use(self, root: int, by: int = 1) -> None:
        """One more use of a value, or one less; what it depends on is done from its first use on."""
        waiting = [root]
        while waiting:
            value = waiting.pop()
            self._uses[value] += by
            if self._uses[value] == max(by, 0):  # its first use, or none any more
                self.lanes += by * (self._kinds[value] == "mixed")
                waiting += self._operations[value].args


def _erf(values: Any) -> Any:
    from scipy.special import erf  # a seventh of a second that few graphs need

    return erf(values)


def _by_casadi(op: int) -> Callable[..., Any]:
    """An operation that NumPy does not have, or has with other digits, by CasADi's machine."""

    def evaluated(*values: Any) -> Any:
        given = np.broadcast_arrays(*values)
        symbols = [ca.MX.sym("a", each.size) for each in given]
        value = ca.MX.unary(op, symbols[0]) if len(symbols) == 1 else ca.MX.binary(op, symbols[0], symbols[1])
        found = ca.Function("f", symbols, [value])(*(ca.DM(each.ravel()) for each in given))
        return np.asarray(found).reshape(given[0].shape)

    return evaluated


FORMS: dict[int, tuple[Callable[..., Any], str]] = {
    ca.OP_ASSIGN: (lambda a: a, "{0}"), ca.OP_ADD: (np.add, "{0} + {1}"), ca.OP_SUB: (np.subtract, "{0} - {1}"),
    ca.OP_MUL: (np.multiply, "{0} * {1}"), ca.OP_DIV: (np.divide, "{0} / {1}"), ca.OP_NEG: (np.negative, "-{0}"),
    ca.OP_EXP: (np.exp, "exp({0})"), ca.OP_LOG: (np.log, "log({0})"), ca.OP_POW: (np.power, "pow({0}, {1})"),
    ca.OP_CONSTPOW: (np.power, "pow({0}, {1})"), ca.OP_SQRT: (np.sqrt, "sqrt({0})"), ca.OP_SQ: (np.square, "{0} * {0}"),
    ca.OP_TWICE: (lambda a: 2 * a, "2.0 * {0}"), ca.OP_SIN: (np.sin, "sin({0})"), ca.OP_COS: (np.cos, "cos({0})"),
    ca.OP_TAN: (np.tan, "tan({0})"), ca.OP_ASIN: (np.arcsin, "asin({0})"), ca.OP_ACOS: (np.arccos, "acos({0})"),
    ca.OP_ATAN: (np.arctan, "atan({0})"), ca.OP_ATAN2: (np.arctan2, "atan2({0}, {1})"),
    ca.OP_LT: (np.less, "(double)({0} < {1})"), ca.OP_LE: (np.less_equal, "(double)({0} <= {1})"),
    ca.OP_EQ: (np.equal, "(double)({0} == {1})"), ca.OP_NE: (np.not_equal, "(double)({0} != {1})"),
    ca.OP_NOT: (np.logical_not, "(double)({0} == 0.0)"),
    ca.OP_AND: (np.logical_and, "(double)({0} != 0.0 && {1} != 0.0)"),
    ca.OP_OR: (np.logical_or, "(double)({0} != 0.0 || {1} != 0.0)"), ca.OP_FLOOR: (np.floor, "floor({0})"),
    ca.OP_CEIL: (np.ceil, "ceil({0})"), ca.OP_FMOD: (np.fmod, "fmod({0}, {1})"), ca.OP_FABS: (np.abs, "fabs({0})"),
    ca.OP_SIGN: (np.sign, "({0} > 0.0 ? 1.0 : {0} < 0.0 ? -1.0 : {0})"),
    ca.OP_COPYSIGN: (np.copysign, "copysign({0}, {1})"),
    ca.OP_IF_ELSE_ZERO: (lambda a, b: np.where(a, b, 0.0), "({0} != 0.0 ? {1} : 0.0)"), ca.OP_ERF: (_erf, "erf({0})"),
    ca.OP_FMIN: (np.fmin, "fmin({0}, {1})"), ca.OP_FMAX: (np.fmax, "fmax({0}, {1})"),
    ca.OP_INV: (np.reciprocal, "1.0 / {0}"), ca.OP_SINH: (np.sinh, "sinh({0})"), ca.OP_COSH: (np.cosh, "cosh({0})"),
    ca.OP_TANH: (np.tanh, "tanh({0})"), ca.OP_ASINH: (np.arcsinh, "asinh({0})"),
    ca.OP_ACOSH: (np.arccosh, "acosh({0})"), ca.OP_ATANH: (np.arctanh, "atanh({0})"),
    ca.OP_HYPOT: (np.hypot, "hypot({0}, {1})"), ca.OP_EXPM1: (np.expm1, "expm1({0})"),
    ca.OP_LOG1P: (np.log1p, "log1p({0})"), ca.OP_LIFT: (lambda a, _: a, "{0}"),
    ca.OP_ERFINV: (_by_casadi(ca.OP_ERFINV), ""), ca.OP_REMAINDER: (_by_casadi(ca.OP_REMAINDER), "remainder({0}, {1})"),
    ca.OP_PRINTME: (_by_casadi(ca.OP_PRINTME), ""),
}  # fmt: skip
"""What each operation is in NumPy and in C; no text where it has no form there."""

NUMPY = {op: numpy for op, (numpy, _) in FORMS.items()}
C = {op: text for op, (_, text) in FORMS.items() if text}


def name_of(op: int) -> str:
    """CasADi's name of an operation."""
    known = (name for name in dir(ca) if name.startswith("OP_") and getattr(ca, name) == op)
    return next(known, f"OP_{op}").removeprefix("OP_").lower()


def elementary(op: int) -> int:
    """An operation that kernels evaluate, as it is; raises ProblemError for any other."""
    if op not in NUMPY:
        raise ProblemError(
            f"The model holds the operation '{name_of(op)}', which is not elementary",
            "Build pose and residual of CasADi's elementary operations; a function that they call must be one that"
            " CasADi writes out: no table, no callback, nothing with never_inline",
        )
    return op


def evaluate(program: Program, values: Sequence[int], arguments: Sequence[Array]) -> Array:
    """Some values (len(values), ...) by NumPy; element k of argument i is arguments[i][k], a number or an array."""
    known: dict[int, Any] = {}
    for index in program.needed(values):
        operation = program.operations[index]
        if operation.op == ca.OP_CONST:
            known[index] = operation.constant
        elif operation.op == ca.OP_INPUT:
            argument, element = operation.element
            known[index] = arguments[argument][element]
        else:
            with np.errstate(all="ignore"):  # what is not finite is found in the residuals, and said there
                known[index] = NUMPY[operation.op](*(known[arg] for arg in operation.args))
    shape = np.broadcast_shapes(*(np.shape(known[value]) for value in values)) if values else ()
    found = np.empty((len(values), *shape))
    for i, value in enumerate(values):
        found[i] = known[value]
    return found
