"""Accept, reject or leave undecided: a tolerance for an arm's RMS error, held against what fresh rows say of it.

The rule is that of JCGM 106:2012, 8.3: accepted where the measured error lies below the tolerance by a guard band or
more, rejected where it lies above it by another, undecided between. Both bands follow from the risk. With v the mean
square of the residuals, s^2 of the instrument's noise and M^2 of the arm's error, nu v / (M^2 + s^2) is taken for
chi-square with nu degrees of freedom. An arm whose M is the tolerance or more is then accepted with a chance of no
more than the risk, whatever arm it is; one whose M is the tolerance or less is rejected as rarely.

That M cannot be below zero is not made use of to accept: where rows happen to scatter less than noise alone would,
the chance is divided by that of so little from noise alone (Read, J. Phys. G 28, 2002).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from scipy.special import gammainc, gammainccinv, gammaincinv

Conformity: TypeAlias = Literal["accept", "reject", "undecided"]

RISK = 0.05  # chance of a wrong decision of an arm at the tolerance, unless another is asked for
POWER = 0.8  # chance with which so many more rows as are named settle it
MOST_TIMES = 50.0  # times as many rows beyond which nobody takes them
SMALLEST = 1e-300


@dataclass(frozen=True)
class Scatter:
    """What rows say of the mean square of an arm's error; all squares in mm^2.

    square: mean square of the residuals, the freedom that the rows' own unknowns absorbed given back. noise: of it the
    instrument's own, the least there is. most: the most of it that may be the instrument's. freedom: nu.
    """

    square: float
    noise: float
    most: float
    freedom: float

    @property
    def measured_mm(self) -> float:
        """The arm's error, RMS; zero where the rows scatter no more than noise."""
        return math.sqrt(max(self.square - self.noise, 0.0))

    @property
    def half(self) -> float:
        """Half the freedom: the shape of the gamma distribution that the mean square has."""
        return self.freedom / 2

    def below(self, mean: float) -> float:
        """Chance of a mean square so small where its mean is another."""
        return 1.0 if mean <= 0 else float(gammainc(self.half, max(self.half * self.square / mean, SMALLEST)))

    def upper_mm(self, chance: float) -> float:
        """Error of which so little or less would be seen with this chance."""
        quantile = float(gammaincinv(self.half, chance * self.below(self.noise))) / self.half
        return math.inf if quantile <= SMALLEST else math.sqrt(max(self.square / quantile - self.noise, 0.0))

    def lower_mm(self, chance: float) -> float:
        """Error of which so much or more would be seen with this chance; as much as may be noise is taken for it."""
        quantile = float(gammainccinv(self.half, chance)) / self.half
        return math.sqrt(max(self.square / quantile - self.most, 0.0))

    def conformance(self, tolerance: float) -> float:
        """Probability that the error is within a tolerance (mm)."""
        return 1.0 - min(self.below(tolerance**2 + self.noise) / max(self.below(self.noise), SMALLEST), 1.0)

    def accept_below_mm(self, tolerance: float, risk: float) -> float:
        """Largest measured error that is accepted; nan where none is, since noise alone could hide as much."""
        low, high = self.noise, tolerance**2 + self.noise
        if replace(self, square=low).upper_mm(risk) > tolerance:
            return math.nan
        for _ in range(80):
            middle = (low + high) / 2
            low, high = (middle, high) if replace(self, square=middle).upper_mm(risk) <= tolerance else (low, middle)
        return replace(self, square=low).measured_mm

    def reject_above_mm(self, tolerance: float, risk: float) -> float:
        """Smallest measured error that is rejected."""
        square = (tolerance**2 + self.most) * float(gammainccinv(self.half, risk)) / self.half
        return math.sqrt(square - self.noise)


@dataclass(frozen=True)
class Decision:
    """Whether an arm's error, RMS in what its instrument sees, is within a tolerance, by JCGM 106:2012.

    verdict: in a word. tolerance_mm, risk: as asked for. measured_mm: the error. probability: that it is within.
    accept_below_mm, reject_above_mm: limits of the measured error; nan where such rows could accept nothing.
    further_rows: how many more rows would settle it in four cases of five if the error is as measured; None where it
    is settled, or rows would not. hangs_on_gross: whether it would be another without the rows that are named gross.
    rests_on_noise: whether it is accepted for the noise that was taken off, and would not be without.
    """

    verdict: Conformity
    tolerance_mm: float
    risk: float
    measured_mm: float
    probability: float
    accept_below_mm: float
    reject_above_mm: float
    further_rows: int | None = None
    hangs_on_gross: bool = False
    rests_on_noise: bool = False

    @property
    def guard_mm(self) -> float:
        """Guard band of acceptance: from the tolerance down to the largest error accepted; all of it if none is."""
        return self.tolerance_mm if math.isnan(self.accept_below_mm) else self.tolerance_mm - self.accept_below_mm

    @property
    def guard_of_rejection_mm(self) -> float:
        """From the tolerance up to the smallest error that is rejected."""
        return self.reject_above_mm - self.tolerance_mm


def decide(scatter: Scatter, given: float, tolerance: float, risk: float) -> Decision:
    """Decide by the rule of this module.

    given: rows less what their own unknowns absorbed: what freedom is in proportion to. tolerance: of the RMS error,
    mm. risk: chance of a wrong decision of an arm at the tolerance, below one half.
    """
    accept, reject = scatter.accept_below_mm(tolerance, risk), scatter.reject_above_mm(tolerance, risk)
    measured = scatter.measured_mm
    verdict: Conformity = "accept" if measured <= accept else "reject" if measured >= reject else "undecided"
    further = _further(scatter, given, tolerance, risk) if verdict == "undecided" else None
    rests = verdict == "accept" and replace(scatter, noise=0.0).upper_mm(risk) > tolerance
    within = scatter.conformance(tolerance)
    return Decision(
        verdict, tolerance, risk, measured, within, accept, reject, further_rows=further, rests_on_noise=rests
    )


def _further(scatter: Scatter, given: float, tolerance: float, risk: float) -> int | None:
    """Rows that would settle it if the error is as measured; None where as many are out of reach."""
    low, high = 1.0, MOST_TIMES
    if not _settles(scatter, high, tolerance, risk):
        return None
    for _ in range(40):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if _settles(scatter, middle, tolerance, risk) else (middle, high)
    return max(math.ceil((high - 1) * given), 1)


def _settles(scatter: Scatter, times: float, tolerance: float, risk: float) -> bool:
    """Whether so many times the rows settle it, if the error is as measured."""
    measured = scatter.measured_mm
    more = replace(scatter, freedom=scatter.freedom * times)
    within = measured < tolerance
    at = float(gammainccinv(more.half, 1 - POWER if within else POWER)) / more.half
    seen = math.sqrt(max((measured**2 + scatter.noise) * at - scatter.noise, 0.0))
    if within:
        return replace(more, square=seen**2 + scatter.noise).upper_mm(risk) <= tolerance
    return seen >= more.reject_above_mm(tolerance, risk)
