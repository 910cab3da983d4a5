"""Reading an SX function into a program."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import casadi as ca

from casacal.graphs import Operation, operations_of
from casacal.kernels.algebra import Builder
from casacal.kernels.program import Kind, Program, Role, elementary


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
