"""A compiled SX function as a list of elementary operations, split by how often each must be done.

Operations on parameters alone are done once a call, operations on data alone once for all calls; what mixes both is
left for the kernel, lane by lane. A lane is a row of samples, or one of many states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import casadi as ca

Role: TypeAlias = Literal["once", "lane"]
Kind: TypeAlias = Literal["constant", "once", "lane", "mixed"]

TRIGONOMETRIC = (ca.OP_SIN, ca.OP_COS)
COMMUTATIVE = (ca.OP_ADD, ca.OP_MUL, ca.OP_FMIN, ca.OP_FMAX, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR, ca.OP_HYPOT)


@dataclass(frozen=True)
class Operation:
    """One value: an operation on earlier values, a constant, or an element of an argument."""

    op: int
    args: tuple[int, ...] = ()
    constant: float = 0.0
    element: tuple[int, int] = (-1, -1)
    """Argument of the function and position in it, for OP_INPUT."""


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

    @property
    def results(self) -> list[int]:
        """All values that are outputs."""
        return [value for output in self.outputs for value in output]


def read_program(function: ca.Function, roles: Sequence[Role], *, ahead: bool = True) -> Program:
    """Read an SX function whose arguments have the given roles; sines and cosines of sums of both are split up.

    `ahead`: whether operations on data alone are done once for all calls; otherwise each call does them, for data that
    differ from call to call, and lanes are elements of arguments.
    """
    builder = _Builder(roles, ahead)
    work: dict[int, int] = {}
    outputs = [[0] * function.numel_out(i) for i in range(function.n_out())]
    for k in range(function.n_instructions()):
        op, inputs, places = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
        if op == ca.OP_OUTPUT:
            outputs[places[0]][places[1]] = work[inputs[0]]
        elif op == ca.OP_INPUT:
            work[places[0]] = builder.add(Operation(op, element=(inputs[0], inputs[1])))
        elif op == ca.OP_CONST:
            work[places[0]] = builder.constant(function.instruction_constant(k))
        else:
            work[places[0]] = builder.apply(op, *(work[i] for i in inputs))
    sizes = [function.numel_in(i) if role == "once" else 0 for i, role in enumerate(roles)]
    starts = tuple(sum(sizes[:i]) for i in range(len(sizes)))
    program = Program(tuple(builder.operations), tuple(builder.kinds), tuple(map(tuple, outputs)), starts, ())
    used = {arg for v in program.needed(program.results) if program.kinds[v] == "mixed"
            for arg in program.operations[v].args} | set(program.results)  # fmt: skip
    return replace(program, lanes=tuple(sorted(value for value in used if program.kinds[value] == "lane")))


class _Builder:
    """Collects operations, each once."""

    def __init__(self, roles: Sequence[Role], ahead: bool) -> None:
        self.roles, self.ahead = roles, ahead
        self.operations: list[Operation] = []
        self.kinds: list[Kind] = []
        self._known: dict[Operation, int] = {}

    def add(self, operation: Operation) -> int:
        if operation not in self._known:
            self._known[operation] = len(self.operations)
            self.operations.append(operation)
            self.kinds.append(self._kind(operation))
        return self._known[operation]

    def constant(self, value: float) -> int:
        return self.add(Operation(ca.OP_CONST, constant=float(value)))

    def apply(self, op: int, *args: int) -> int:
        if op in TRIGONOMETRIC:
            parts = self._summands(args[0])
            if parts is not None:
                return self._of_sum(op, *parts)
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
