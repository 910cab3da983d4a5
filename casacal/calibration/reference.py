"""What an independent solver found on the same objective, and whether that is the same minimum."""

from __future__ import annotations

from dataclasses import dataclass

from casacal.least_squares.result import Result
from casacal.values import Value

AGREEMENT = 1e-8
"""Largest relative gap between the costs of two solvers that found the same minimum."""

NEGLIGIBLE = 1e-6
"""A gap in cost that means nothing, however small the costs are.

The cost is minus the logarithm of the posterior, so a gap g in it is a distance of sqrt(2 g) posterior standard
deviations: here little more than a thousandth of one. Costs of data that fit exactly are rounding, and so
is their ratio.
"""


@dataclass(frozen=True, eq=False)
class Reference(Value):
    """What an independent solver found on the same objective."""

    solver: str
    result: Result
    cost: float
    """The objective as that solver itself evaluated it."""
    relative_gap: float
    """(cost of the method - cost of the reference) / cost of the reference."""

    @property
    def gap(self) -> float:
        """Cost of the method less that of the reference."""
        return self.relative_gap * max(self.cost, 1e-300)

    @property
    def limit(self) -> float:
        """Largest gap of two solvers that found the same minimum."""
        return max(AGREEMENT * self.cost, NEGLIGIBLE)

    @property
    def agrees(self) -> bool:
        """Whether both found the same minimum."""
        return self.result.converged and abs(self.gap) <= self.limit
