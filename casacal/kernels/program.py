"""A CasADi graph as lines of text, there and back, and as a list of elementary operations, each in its cheapest form.

A line of text is one instruction: what result.json holds of a user's own functions, and kernels are built from.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np

from casacal.errors import CasacalError, ProblemError
from casacal.values import Array

MOST = 1_000_000  # operations beyond which a graph is no arm's
MOST_PARTS = 500  # arguments and results beyond which it is none either

UNARY = (
    *("assign", "neg", "exp", "log", "sqrt", "sq", "twice", "sin", "cos", "tan", "asin", "acos", "atan", "not"),
    *("floor", "ceil", "fabs", "sign", "erf", "inv", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "erfinv"),
    *("log1p", "expm1"),
)
BINARY = (
    *("add", "sub", "mul", "div", "pow", "constpow", "lt", "le", "eq", "ne", "and", "or", "fmod", "copysign"),
    *("if_else_zero", "fmin", "fmax", "atan2", "hypot", "remainder"),
)
NAMES: Mapping[int, str] = {getattr(ca, f"OP_{name.upper()}"): name for name in (*UNARY, *BINARY)}
OPERATIONS: Mapping[str, int] = {name: op for op, name in NAMES.items()}
ARITY = {(name, 1) for name in UNARY} | {(name, 2) for name in BINARY}


@dataclass(frozen=True)
class Operation:
    """One value: an operation on earlier values, a constant, or an element of an argument."""

    op: int
    args: tuple[int, ...] = ()
    constant: float = 0.0
    element: tuple[int, int] = (-1, -1)  # argument of the function and position in it, for OP_INPUT


def operations_of(function: ca.Function) -> tuple[list[Operation], list[list[int]]]:
    """The operations of an SX function, and the value of each element of each result; raises RuntimeError for MX."""
    operations: list[Operation] = []
    work: dict[int, int] = {}
    results = [[0] * function.numel_out(i) for i in range(function.n_out())]
    for k in range(function.n_instructions()):
        op, read, written = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
        if op == ca.OP_OUTPUT:
            results[written[0]][written[1]] = work[read[0]]
            continue
        if op == ca.OP_CONST:
            operations.append(Operation(op, constant=float(function.instruction_constant(k))))
        elif op == ca.OP_INPUT:
            operations.append(Operation(op, element=(read[0], read[1])))
        else:
            operations.append(Operation(op, tuple(work[i] for i in read)))
        for place in written:  # a call of another function has several results
            work[place] = len(operations) - 1
    return operations, results


def calls(function: ca.Function) -> bool:
    """Whether an SX function calls others that CasADi does not write out: a rootfinder, a table, a callback."""
    return any(function.instruction_id(k) == ca.OP_CALL for k in range(function.n_instructions()))


ALWAYS = {
    *(ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST, ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, ca.OP_NEG, ca.OP_SQ, ca.OP_TWICE),
    *(ca.OP_SIN, ca.OP_COS),
}
"""Operations that give numbers for numbers."""


def may_be_no_number(function: ca.Function) -> bool:
    """Whether an SX function of finite arguments may give what is not a number, as roots, quotients and calls may."""
    return any(function.instruction_id(k) not in ALWAYS for k in range(function.n_instructions()))


def graph_data(function: ca.Function) -> dict[str, Any]:
    """Name, arguments, operations and results of an SX function; raises CasacalError for operations of other kinds."""
    try:
        operations, results = operations_of(function)
    except RuntimeError as error:
        raise CasacalError(f"'{function.name()}' is no graph of operations", "Build it of SX symbols") from error
    lines: list[str] = []
    for each in operations:
        if each.op == ca.OP_CONST:
            lines.append(f"const {each.constant!r}")
        elif each.op == ca.OP_INPUT:
            lines.append(f"input {each.element[0]} {each.element[1]}")
        elif each.op in NAMES:
            lines.append(" ".join((NAMES[each.op], *map(str, each.args))))
        else:
            raise CasacalError(f"'{function.name()}' uses an operation that is not elementary", "Use elementary ones")
    return {
        "name": function.name(),
        "arguments": [[function.name_in(i), *function.size_in(i)] for i in range(function.n_in())],
        "operations": lines,
        "results": [
            {"shape": list(function.size_out(i)), "values": " ".join(map(str, values))}
            for i, values in enumerate(results)
        ],
    }


def graph_from(data: Mapping[str, Any]) -> ca.Function:
    """The function that such data describe; raises CasacalError for what describes none."""
    try:
        if len(data["arguments"]) + len(data["results"]) > MOST_PARTS:
            raise ValueError("it has too many arguments and results")
        symbols = [ca.SX.sym(str(name), _size(rows), _size(columns)) for name, rows, columns in data["arguments"]]
        elements = [ca.vec(symbol).elements() if symbol.numel() else [] for symbol in symbols]
        values = _values(data["operations"], elements)
        results = []
        for result in data["results"]:
            rows, columns = map(_size, result["shape"])
            chosen = [values[_place(word, len(values))] for word in result["values"].split()]
            if len(chosen) != rows * columns:
                raise ValueError("a result has another number of values than its shape")
            results.append(ca.reshape(ca.vertcat(*chosen), rows, columns) if chosen else ca.SX(rows, columns))
        return ca.Function(str(data["name"]), symbols, results)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, RuntimeError, NotImplementedError) as error:
        said = " ".join(str(error).split())[:200]
        raise CasacalError(f"A graph cannot be read: {said}", "Restore the file that holds it") from error


def _values(lines: Sequence[str], elements: Sequence[Sequence[Any]]) -> list[ca.SX]:
    """The value of each line; raises ValueError for a line that is no operation on what stands before it."""
    if len(lines) > MOST:
        raise ValueError(f"it has {len(lines)} operations")
    values: list[ca.SX] = []
    for line in lines:
        name, *words = line.split()
        if name == "const" and len(words) == 1:
            values.append(ca.SX(float(words[0])))
            continue
        if name == "input" and len(words) == 2:
            argument = elements[_place(words[0], len(elements))]
            values.append(ca.SX(argument[_place(words[1], len(argument))]))
            continue
        arguments = [values[_place(word, len(values))] for word in words]
        if (name, len(arguments)) not in ARITY:
            raise ValueError(f"'{line[:40]}' is no operation")
        values.append((ca.SX.unary if len(arguments) == 1 else ca.SX.binary)(OPERATIONS[name], *arguments))
    return values


def _place(word: str, count: int) -> int:
    if not (word.isascii() and word.isdigit() and int(word) < count):
        raise ValueError(f"'{word}' names no value")
    return int(word)


def _size(number: Any) -> int:
    if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number <= MOST:
        raise ValueError(f"{number!r} is no size")
    return number


Role: TypeAlias = Literal["once", "lane"]
Kind: TypeAlias = Literal["constant", "once", "lane", "mixed"]

TRIGONOMETRIC = (ca.OP_SIN, ca.OP_COS)

COMMUTATIVE = (ca.OP_ADD, ca.OP_MUL, ca.OP_FMIN, ca.OP_FMAX, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR, ca.OP_HYPOT)


class Builder:
    """Collects operations, each once and in its cheapest form."""

    def __init__(self, roles: Sequence[Role], ahead: bool) -> None:
        self.roles, self.ahead = roles, ahead
        self.operations: list[Operation] = []
        self.kinds: list[Kind] = []
        self._known: dict[Operation, int] = {}

    def add(self, operation: Operation) -> int:
        """An operation as it is: the value it makes."""
        if operation not in self._known:
            self._known[operation] = len(self.operations)
            self.operations.append(operation)
            self.kinds.append(self._kind(operation))
        return self._known[operation]

    def constant(self, value: float) -> int:
        """A number."""
        return self.add(Operation(ca.OP_CONST, constant=float(value)))

    def apply(self, op: int, *args: int) -> int:
        """An operation on earlier values, rewritten where a rule applies."""
        if op in TRIGONOMETRIC:
            parts = self._summands(args[0])
            if parts is not None:
                return self._of_sum(op, *parts)
        if op == ca.OP_DIV and self._depends_on_lane(args[0]) and not self._depends_on_lane(args[1]):
            return self.apply(ca.OP_MUL, args[0], self.apply(ca.OP_INV, args[1]))  # one division for all lanes
        return self.add(Operation(op, tuple(sorted(args)) if op in COMMUTATIVE else args))

    def _kind(self, operation: Operation) -> Kind:
        if operation.op == ca.OP_CONST:
            return "constant"
        if operation.op == ca.OP_INPUT:
            return self.roles[operation.element[0]]
        kinds = {self.kinds[arg] for arg in operation.args} - {"constant"}
        if not kinds:
            return "once"
        kind = kinds.pop() if len(kinds) == 1 else "mixed"
        return "mixed" if kind == "lane" and not self.ahead else kind

    def _summands(self, value: int) -> tuple[int, int] | None:
        """A mixed value as a sum of parameters and data, when it is one."""
        if self.kinds[value] != "mixed":
            return None
        operation = self.operations[value]
        if operation.op not in (ca.OP_ADD, ca.OP_SUB):
            return None
        once = lane = zero = self.constant(0.0)
        for arg, minus in zip(operation.args, (False, operation.op == ca.OP_SUB), strict=True):
            pair = (zero, arg) if self.kinds[arg] == "lane" else (arg, zero)
            if self.kinds[arg] == "mixed":
                inner = self._summands(arg)
                if inner is None:
                    return None
                pair = inner
            once, lane = self._sum(once, pair[0], minus), self._sum(lane, pair[1], minus)
        return once, lane

    def _sum(self, one: int, other: int, minus: bool) -> int:
        zero = self.constant(0.0)
        if other == zero:
            return one
        if one == zero:
            return self.apply(ca.OP_NEG, other) if minus else other
        return self.apply(ca.OP_SUB if minus else ca.OP_ADD, one, other)

    def _of_sum(self, op: int, once: int, lane: int) -> int:
        """sin(a + b) = sin a cos b + cos a sin b; cos(a + b) = cos a cos b - sin a sin b."""
        (sin_a, cos_a), (sin_b, cos_b) = (
            (self.add(Operation(ca.OP_SIN, (part,))), self.add(Operation(ca.OP_COS, (part,)))) for part in (once, lane)
        )
        if op == ca.OP_SIN:
            return self.apply(ca.OP_ADD, self.apply(ca.OP_MUL, sin_a, cos_b), self.apply(ca.OP_MUL, cos_a, sin_b))
        return self.apply(ca.OP_SUB, self.apply(ca.OP_MUL, cos_a, cos_b), self.apply(ca.OP_MUL, sin_a, sin_b))

    def _depends_on_lane(self, value: int) -> bool:
        return self.kinds[value] in ("lane", "mixed")


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
        """Position in p of an element of an argument of role "once"."""
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
        leaf = each.op in (ca.OP_CONST, ca.OP_INPUT)
        made.append(builder.add(each) if leaf else builder.apply(elementary(each.op), *(made[i] for i in each.args)))
    outputs = tuple(tuple(made[value] for value in result) for result in results)
    sizes = [function.numel_in(i) if role == "once" else 0 for i, role in enumerate(roles)]
    starts = tuple(itertools.accumulate(sizes[:-1], initial=0))
    program = Program(tuple(builder.operations), tuple(builder.kinds), outputs, starts, ())
    return replace(program, lanes=tuple(program.used("lane")))


def _erf(values: Any) -> Any:
    from scipy.special import erf  # a seventh of a second that few graphs need

    return erf(values)


def _by_casadi(op: int) -> Callable[..., Any]:
    """An operation that NumPy does not have, or has with other digits, by CasADi's machine."""

    def evaluated(*values: Any) -> Any:
        arrays = np.broadcast_arrays(*values)
        symbols = [ca.MX.sym("a", each.size) for each in arrays]
        value = ca.MX.unary(op, symbols[0]) if len(symbols) == 1 else ca.MX.binary(op, symbols[0], symbols[1])
        found = ca.Function("f", symbols, [value])(*(ca.DM(each.ravel()) for each in arrays))
        return np.asarray(found).reshape(arrays[0].shape)

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
"""NumPy function and C text of each operation; an empty text where C has none."""

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
                made = NUMPY[operation.op](*(known[arg] for arg in operation.args))
            known[index] = np.asarray(made, dtype=np.float64)  # comparisons too, as CasADi has them
    shape = np.broadcast_shapes(*(np.shape(known[value]) for value in values)) if values else ()
    found = np.empty((len(values), *shape))
    for i, value in enumerate(values):
        found[i] = known[value]
    return found
