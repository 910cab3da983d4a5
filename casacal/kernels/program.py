"""An SX function as a list of elementary operations, split by how often each must be done.

Operations on parameters alone are done once per call, operations on data alone once for all calls; what mixes both is
left for the kernel, lane by lane. A lane is a row of samples, or one of many states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, TypeAlias

import casadi as ca

Role: TypeAlias = Literal["once", "lane"]
Kind: TypeAlias = Literal["constant", "once", "lane", "mixed"]

TRIGONOMETRIC = (ca.OP_SIN, ca.OP_COS)


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

    @cached_property
    def once(self) -> list[int]:
        """Values of parameters alone that mixed operations or outputs use: what a kernel prepares before its loop."""
        mixed = {arg for v in self.needed(self.results) if self.kinds[v] == "mixed" for arg in self.operations[v].args}
        return [v for v in sorted(mixed | set(self.results)) if self.kinds[v] == "once"]

    @property
    def results(self) -> list[int]:
        """All values that are outputs."""
        return [value for output in self.outputs for value in output]
