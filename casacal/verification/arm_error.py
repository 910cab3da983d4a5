"""The arm's error as fresh rows show it, noise removed; acceptance against a tolerance at a stated risk; pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Literal, TypeAlias

import numpy as np
from markupsafe import Markup
from scipy.special import gammainc, gammainccinv, gammaincinv

from casacal.calibration.fresh import Fresh, guesses
from casacal.deployment.arm import CalibratedArm
from casacal.pages.drawing import Panel, figure, fixed, mm, number, picture, shortened, tag
from casacal.uncertainty.fresh_rows import spanned
from casacal.values import Array, Index, Rows

Conformity: TypeAlias = Literal["accept", "reject", "undecided"]

RISK = 0.05  # chance of a wrong decision of an arm at the tolerance, unless another is asked for
POWER = 0.8  # chance with which so many more rows as are named settle it
MOST_TIMES = 50.0  # times as many rows beyond which nobody takes them
SMALLEST = 1e-300
USUAL, AS_ROWS = 5.0, 20.0
"""Variance of the squares of one component over the square of their mean, as it may well be, and how many rows that
counts as. It is 2 of a normal distribution; of four arms calibrated from planes half had 2 to 4, a few over 10."""
SURE = 0.01  # chance below which residuals are too small for the noise that was stated
ALONE = 0.3  # standard deviation of the arm's error over that of noise below which a direction holds noise alone
TENTH = 0.9  # found over stated noise below which the calibration's rows say so
BEYOND = 0.025  # chance that the error lies beyond either end of its interval
FEWEST = 12  # rows of a part that are told with an interval of their own
NARROW = 0.25  # part of the longest side of the volume below which another side is not divided
ROUND = 10.0  # multiple of mm at which the volume is divided
LONGEST = 60  # characters of a label in a table
NAMES = {"all": "", "face": "face ", "region": "tip at "}
MOST = 16  # parts that have a place in the picture
EACH, TOP, BOTTOM = 40.0, 26.0, 44.0  # height of a part, and of what stands above and below all of them
DECADES = 5  # powers of ten that the axis spans at most
GREY, BLUE, ORANGE, INK = "#8b949f", "#1d5f9e", "#c2560c", "#1b2330"


@dataclass(frozen=True)
class Scatter:
    """Estimate of the mean square of an arm's error; all squares in mm^2.

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
        """Shape of the gamma distribution of the mean square: half the freedom."""
        return self.freedom / 2

    def below(self, mean: float) -> float:
        """Probability of a mean square of at most `square` where its expectation is `mean`."""
        return 1.0 if mean <= 0 else float(gammainc(self.half, max(self.half * self.square / mean, SMALLEST)))

    def upper_mm(self, chance: float) -> float:
        """Upper confidence limit of the error: so small a square, or a smaller one, has this chance there."""
        quantile = float(gammaincinv(self.half, chance * self.below(self.noise))) / self.half
        return math.inf if quantile <= SMALLEST else math.sqrt(max(self.square / quantile - self.noise, 0.0))

    def lower_mm(self, chance: float) -> float:
        """Lower confidence limit of the error: so large a square, or a larger one, has this chance; noise is `most`."""
        quantile = float(gammainccinv(self.half, chance)) / self.half
        return math.sqrt(max(self.square / quantile - self.most, 0.0))

    @property
    def interval(self) -> ErrorInterval:
        """The error, between what it lies with a chance of 95 %."""
        return ErrorInterval(self.measured_mm, self.lower_mm(BEYOND), self.upper_mm(BEYOND))

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
        return math.sqrt(max(square - self.noise, 0.0))


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


def decide(scatter: Scatter, effective_rows: float, tolerance: float, risk: float) -> Decision:
    """Decide by guarded acceptance and rejection.

    effective_rows: rows less what their own unknowns absorbed, to which freedom is proportional. tolerance: of the RMS
    error, mm. risk: chance of a wrong decision of an arm at the tolerance, below one half.
    """
    accept, reject = scatter.accept_below_mm(tolerance, risk), scatter.reject_above_mm(tolerance, risk)
    measured = scatter.measured_mm
    verdict: Conformity = "accept" if measured <= accept else "reject" if measured >= reject else "undecided"
    further = _further(scatter, effective_rows, tolerance, risk) if verdict == "undecided" else None
    rests = verdict == "accept" and replace(scatter, noise=0.0).upper_mm(risk) > tolerance
    within = scatter.conformance(tolerance)
    return Decision(verdict, tolerance, risk, measured, within, accept, reject, further, rests_on_noise=rests)


def _further(scatter: Scatter, effective_rows: float, tolerance: float, risk: float) -> int | None:
    """Further rows that would settle it if the error is as measured; None beyond `MOST_TIMES` the rows."""
    measured = scatter.measured_mm
    within = measured < tolerance

    def settles(times: float) -> bool:
        more = replace(scatter, freedom=scatter.freedom * times)
        at = float(gammainccinv(more.half, 1 - POWER if within else POWER)) / more.half
        observed = math.sqrt(max((measured**2 + scatter.noise) * at - scatter.noise, 0.0))
        if within:
            return replace(more, square=observed**2 + scatter.noise).upper_mm(risk) <= tolerance
        return observed >= more.reject_above_mm(tolerance, risk)

    low, high = 1.0, MOST_TIMES
    if not settles(high):
        return None
    for _ in range(40):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if settles(middle) else (middle, high)
    return max(math.ceil((high - 1) * effective_rows), 1)


@dataclass(frozen=True)
class ErrorInterval:
    """An RMS error, mm, and between what it lies with a chance of 95 %."""

    mm: float
    low_mm: float
    high_mm: float


@dataclass(frozen=True)
class PartError:
    """The arm's error in what its instrument sees, in some of the rows.

    kind: "all", "face" or "region". label: which one. rows: how many. before, after: of the arm as drawn and as
    calibrated, the instrument's own noise taken off. promised_mm: what the calibration expects of it, RMS.
    """

    kind: str
    label: str
    rows: int
    before: ErrorInterval
    after: ErrorInterval
    promised_mm: float


@dataclass(frozen=True, eq=False)
class VisibleError:
    """The arm's error as some fresh rows observe it.

    fresh: the rows, and the arm. kept: which of the residuals (k,) count. quieter: part of the stated noise, as a
    standard deviation, that the rows let stand.
    """

    fresh: Fresh
    kept: Index
    quieter: float = 1.0

    @cached_property
    def basis(self) -> Array:
        """Orthonormal basis (k + g, o) of what the own unknowns absorb, whitened; g: their prior guesses."""
        _, held = guesses(self.fresh.bound, self.fresh.known)
        return spanned(np.vstack([self.fresh.jacobian[self.kept], held])[:, ~self.fresh.known])

    @cached_property
    def used(self) -> Array:
        """Noise (k,) as the calibration used it."""
        return np.asarray(self.fresh.bound.noise[self.kept])

    @cached_property
    def stated(self) -> Array:
        """Noise (k,) of the instrument itself: as stated, times `quieter`, and no more than used."""
        return np.asarray(self.quieter * np.minimum(self.fresh.bound.with_noise().noise[self.kept], self.used))

    @cached_property
    def leading(self) -> Rows:
        """Residuals (k,) in mm where a row has others as well."""
        return self.fresh.bound.leading[self.kept]

    @cached_property
    def sample_of(self) -> Index:
        """The row that each residual (k,) is of."""
        return np.asarray(self.fresh.bound.sample_of[self.kept], dtype=np.intp)

    @cached_property
    def redundancy(self) -> Array:
        """Mean square (k,) that the fit of the own unknowns leaves of independent errors of unit mean square."""
        return self._left(np.where(self.leading, 1.0, 0.0), 0.0)

    @cached_property
    def noise(self) -> Array:
        """Square (k,) of the instrument's own noise that is left, mm^2."""
        return self._left(self.stated**2, 1.0)

    @cached_property
    def most(self) -> Array:
        """Square (k,) of the noise as the calibration used it that is left, mm^2."""
        return self._left(self.used**2, 1.0)

    def _left(self, squares: Array, guess: float) -> Array:
        """Mean square (k,) left by the fit of independent errors with mean squares (k,), and of whitened guesses."""
        count = len(self.kept)
        whitened = np.concatenate([squares / self.used**2, np.full(len(self.basis) - count, guess)])
        across = self.basis.T @ (whitened[:, None] * self.basis)
        diagonal = 1 - 2 * (self.basis**2).sum(axis=1)
        left = whitened * diagonal + ((self.basis @ across) * self.basis).sum(axis=1)
        return np.asarray(self.used**2 * np.maximum(left[:count], 0.0))

    def residual(self, x: Array) -> Array:
        """Residuals (k,), mm, of an arm x with the own unknowns fitted to these rows."""
        count = len(self.kept)
        plain = np.zeros(len(self.basis))
        plain[:count] = self.fresh.bound.residual(x)[self.kept]
        # at x, own unknowns are at their minimum over all rows: of some of them it is elsewhere
        if count < self.fresh.bound.rows:
            plain = plain - self.basis @ (self.basis.T @ plain)
        return np.asarray(plain[:count] * self.used)

    def scatter(self, residual: Array, rows: Index | None = None) -> Scatter | None:
        """Scatter of residuals (k,), mm, of all or some rows; None where they do not observe the error."""
        counts = self._counted(rows)
        places, which = np.unique(self.sample_of[counts], return_inverse=True)
        if not places.size:
            return None
        parts = int(counts.sum()) / places.size
        effective = float(self.redundancy[counts].sum()) / parts
        if effective < 1e-6 * places.size:
            return None
        squares = np.bincount(which, residual[counts] ** 2)
        noise, most = (float(each[counts].sum()) / effective for each in (self.noise, self.most))
        again = np.unique(self.fresh.bound.repeats.codes[places], return_counts=True)[1]
        alike = float((again**2).sum()) / places.size  # touches in one posture are one of its kind
        mean = float(squares.mean())
        found = max(float(squares.var()) / mean**2 if mean > 0 else 0.0, 2 / parts)
        uneven = (places.size * found + AS_ROWS * USUAL / parts) / (places.size + AS_ROWS)
        return Scatter(float(squares.sum()) / effective, min(noise, most), most, 2 * effective / (uneven * alike))

    def _counted(self, rows: Index | None) -> Rows:
        """Which residuals (k,) are of some rows, or of all, and in mm."""
        return self.leading if rows is None else self.leading & np.isin(self.sample_of, rows)

    def effective_rows(self) -> float:
        """Rows less what their own unknowns absorbed of them."""
        parts = int(self.leading.sum()) / max(np.unique(self.sample_of[self.leading]).size, 1)
        return float(self.redundancy[self.leading].sum()) / max(parts, 1.0)

    def noises_mm(self) -> tuple[float, float, float]:
        """Noise of a row, RMS: what is taken off, the most that it may be, and as it was stated."""
        places = np.unique(self.sample_of).size
        stated = self.fresh.bound.with_noise().noise[self.kept]
        each = (self.stated, self.used, stated)
        taken, most, said = (math.sqrt(float((one[self.leading] ** 2).sum()) / places) for one in each)
        return taken, most, said

    @cached_property
    def promised(self) -> Array:
        """Mean square (k,) that the calibration expects of the arm's error, mm^2."""
        across = self.fresh.some(self.kept).across[: len(self.kept)]
        return np.asarray(self.used**2 * (across**2).sum(axis=1))

    def promised_mm(self, rows: Index) -> float:
        """Error that the calibration expects of some rows, RMS."""
        counts = self._counted(rows)
        places = np.unique(self.sample_of[counts]).size
        effective = float(self.redundancy[counts].sum()) * places / max(int(counts.sum()), 1)
        return math.sqrt(float(self.promised[counts].sum()) / effective) if effective > 0 else math.nan


def visible_error(arm: CalibratedArm, fresh: Fresh, without: Index | None = None) -> VisibleError:
    """The arm's error as fresh rows observe it, all of them or without some residuals.

    Part of the stated noise may not be taken off, as it would hide the arm's error, where it was surely stated too
    large. The calibration says so by what it found over what was stated, and the fresh rows by residuals that are too
    small where nothing but noise is expected; then the lower end of either is what counts.
    """
    low, high = arm.found.noise.low, arm.found.noise.high
    quieter = low if low > 0 and 0 < high < TENTH and not fresh.other else 1.0
    bound, rows, (directions, sizes) = fresh.bound, fresh.linear, fresh.linear.directions
    expected = directions[:, sizes > ALONE]
    louder = float(np.median((bound.noise / bound.with_noise().noise) ** 2))  # as used over as stated
    square = louder * max(float(rows.left @ rows.left) - float(((expected.T @ rows.left) ** 2).sum()), 0.0)
    half = (rows.freedom - expected.shape[1]) / 2
    if half and square < 2 * float(gammaincinv(half, SURE)):
        quieter = min(quieter, math.sqrt(square / (2 * float(gammaincinv(half, 1 - SURE)))))
    return VisibleError(fresh, np.setdiff1d(np.arange(bound.rows), [] if without is None else without), quieter)


def errors_by_part(visible: VisibleError, drawn: Array) -> tuple[PartError, ...]:
    """Errors of all rows, then of faces and of regions where there are several with rows enough.

    drawn: unknowns (n,) of the arm as drawn, those of the rows fitted.
    """
    bound, x = visible.fresh.bound, visible.fresh.x
    pair = visible.residual(drawn), visible.residual(x)
    faces = bound.block.samples.faces(bound.problem.instrument.groups)
    everything: Index = np.arange(len(faces))
    parts = [("all", "all rows", everything)]
    if len(faces.names) > 1:
        parts += [("face", label, rows) for label, rows in faces.rows().items() if len(rows) >= FEWEST]
    parts += [("region", label, rows) for label, rows in blocks(bound.tips(x, bound.block.samples.joints)).items()]
    found = []
    for kind, label, rows in parts:
        before, after = (visible.scatter(residual, rows) for residual in pair)
        if before is not None and after is not None:
            found.append(PartError(kind, label, len(rows), before.interval, after.interval, visible.promised_mm(rows)))
    return tuple(found)


def blocks(tips: Array) -> dict[str, Index]:
    """Rows of each block of the volume of some tips (N, 3; mm in the base frame), by its name.

    The two longest sides are halved at a round number near the median, or the longest alone; nothing where a half has
    too few rows.
    """
    sides = np.quantile(tips, 0.95, axis=0) - np.quantile(tips, 0.05, axis=0)
    longest = [int(k) for k in np.argsort(-sides, kind="stable")[:2] if sides[k] > max(NARROW * sides.max(), ROUND)]
    for axes in (longest, longest[:1]):
        at = {k: ROUND * round(float(np.median(tips[:, k])) / ROUND) for k in axes}
        found = {}
        for halves in product((False, True), repeat=len(axes)):
            inside = np.all([(tips[:, k] > at[k]) == far for k, far in zip(axes, halves, strict=True)], axis=0)
            words = [
                f"{'xyz'[k]} {'above' if far else 'up to'} {at[k]:.0f} mm" for k, far in zip(at, halves, strict=True)
            ]
            found[", ".join(words)] = np.flatnonzero(np.broadcast_to(inside, len(tips)))
        if len(found) > 1 and all(len(rows) >= FEWEST for rows in found.values()):
            return found
    return {}


def error_rows(errors: Sequence[PartError]) -> list[list[str]]:
    """Rows of a table: the error of each part as drawn and as calibrated, with intervals, and what was promised."""
    rows = []
    for part in errors:
        each = [cell for error in (part.before, part.after) for cell in (fixed(error.mm), _between(error))]
        label = shortened(NAMES[part.kind] + part.label, LONGEST)
        rows.append([label, f"{part.rows:,}", *each, fixed(part.promised_mm)])
    return rows


def boxes(part: PartError | None, decision: Decision | None) -> list[tuple[str, str, str]]:
    """The figures that stand first: title, value and what explains it; none where the rows say nothing of the arm."""
    if part is None:
        return []
    shown = [
        ("Error as drawn", mm(part.before.mm, 4), f"{_between(part.before)} mm"),
        ("Error as calibrated", mm(part.after.mm, 4), f"{_between(part.after)} mm"),
        ("Promised", mm(part.promised_mm, 4), "what the calibration expects, RMS"),
    ]
    if decision is not None:
        accept = decision.accept_below_mm
        limit = "noise hides it" if math.isnan(accept) else f"accepted up to {mm(accept, 4)}"
        shown.append(("Tolerance", f"{decision.tolerance_mm:g} mm", f"{decision.verdict}; {limit}"))
    return shown


def _between(error: ErrorInterval) -> str:
    return f"{fixed(error.low_mm)} to {fixed(error.high_mm)}"


def errors_picture(errors: Sequence[PartError], decision: Decision | None) -> Markup:
    """Error before and after: two intervals for each part, what was promised, and the tolerance, logarithmically."""
    parts = errors[:MOST]
    height = TOP + BOTTOM + EACH * len(parts)
    each = [error for part in errors for error in (part.before, part.after)]
    values = [value for error in each for value in (error.mm, error.low_mm, error.high_mm)]
    values += [*(part.promised_mm for part in errors), *([] if decision is None else [decision.tolerance_mm])]
    shown = [value for value in values if 0 < value < math.inf] or [1.0]
    high = math.ceil(math.log10(max(shown)) + 1e-9)
    low = min(max(math.floor(math.log10(min(shown)) - 1e-9), high - DECADES), high - 1)
    panel = Panel((float(low), float(high)), (0.0, 1.0), height, left=24.0, right=24.0, top=TOP, bottom=BOTTOM)
    axis, foot = [], height - BOTTOM
    for power in range(low, high + 1):
        x = number(float(panel.across(power)))
        axis.append(tag("path", at={"d": f"M{x} {number(TOP)}V{number(foot)}", "class": "grid"}))
        axis.append(tag("text", f"{10.0**power:g}", at={"x": x, "y": number(foot + 18), "class": "middle"}))
    axis.append(tag("text", "error, mm RMS", at={"x": "200", "y": number(height - 6), "class": "middle title"}))
    axis.append(tag("text", "Before and after, with intervals of 95 %", at={"x": "4", "y": "14", "class": "title"}))
    drawn = [tag("g", *axis)]
    for k, part in enumerate(parts):
        y = TOP + EACH * k
        label = shortened(f"{NAMES[part.kind]}{part.label} ({part.rows:,})", 52)
        drawn.append(tag("text", label, at={"x": number(panel.left), "y": number(y + 12)}))
        drawn += [_interval(panel, part.before, y + 20, GREY), _interval(panel, part.after, y + 30, BLUE)]
        if part.promised_mm > 0 and math.isfinite(part.promised_mm):
            drawn.append(_upright(panel, part.promised_mm, y + 25, y + 35, INK))
    if decision is not None:
        drawn.append(_upright(panel, decision.tolerance_mm, TOP, foot, ORANGE))
    says = "; ".join(f"{part.label}: {part.before.mm:.4f} before, {part.after.mm:.4f} after" for part in parts)
    more = "" if len(errors) <= MOST else f" {len(errors) - MOST} more stand in the table."
    tolerance = "" if decision is None else " The orange line is the tolerance."
    return figure(
        "Error of the arm as drawn (grey) and as calibrated (blue), RMS, with intervals of 95 %; one that reaches the "
        f"left edge reaches zero. Dark strokes are what the calibration promised.{tolerance}{more}",
        picture("errors-picture", "Error before and after, with intervals", f"In mm: {says}.", height, *drawn),
    )


def _place(panel: Panel, value: float) -> str:
    """Picture units of a value; what is beyond the axis stands at its end."""
    power = math.log10(value) if 0 < value < math.inf else (math.inf if value > 0 else -math.inf)
    return number(float(panel.across(min(max(power, panel.x[0]), panel.x[1]))))


def _interval(panel: Panel, error: ErrorInterval, y: float, colour: str) -> Markup:
    a, b, at = (_place(panel, value) for value in (error.low_mm, error.high_mm, error.mm))
    bar = tag("path", at={"d": f"M{a} {number(y)}H{b}", "stroke": colour, "stroke-width": "2.5", "fill": "none"})
    dot = tag("path", at={"d": f"M{at} {number(y)}h.1", "class": "spot", "stroke": colour})
    return tag("g", bar, dot)


def _upright(panel: Panel, value: float, top: float, foot: float, colour: str) -> Markup:
    path = f"M{_place(panel, value)} {number(top)}V{number(foot)}"
    return tag("path", at={"d": path, "stroke": colour, "stroke-width": "1.75", "fill": "none"})
