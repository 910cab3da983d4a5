"""The arm's error in what an instrument sees, from fresh rows: overall, by face and by region, with intervals.

The measurand is the RMS, over postures of the kind that were measured, of what the instrument would read without noise
and with the rows' own unknowns (faces, where a tracker stands) fitted: of the length of it where a row has several
components. The rows are a sample of such postures. Their residuals are y = N (e + n), e the arm's error, n noise, N
what fitting the own unknowns leaves; so the mean square of y is divided by that of N's rows, which gives back what the
fit absorbed, and the instrument's own noise is taken off.

Nothing is assumed of what causes e, nor that rows err apart from one another: given the arm, it is the postures that
are drawn. How far their mean square may lie from that of all postures follows from how unlike their squares are. A
few rows show that badly, and some postures err much more than most, so that it is taken together with what is usual.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.compensation.arm import CalibratedArm
from casacal.uncertainty.fresh_rows import spanned
from casacal.verification.decision import Scatter
from casacal.verification.fresh import Fresh

USUAL, AS_ROWS = 5.0, 20.0
"""Variance of the squares of one component over the square of their mean, as it may well be, and how many rows that
counts as. It is 2 of a normal distribution; of four arms calibrated from planes half had 2 to 4, a few over 10."""

SURE = 0.01
"""Chance below which residuals are too small for the noise that was stated."""

ALONE = 0.3
"""Standard deviation of the arm's error over that of noise below which a direction holds noise alone."""

TENTH = 0.9
"""Found over stated noise below which the calibration's rows say so."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What some fresh rows see of the arm's error.

    fresh: the rows, and the arm. kept: which of the residuals (k,) count. quieter: part of the stated noise, as a
    standard deviation, that the rows let stand.
    """

    fresh: Fresh
    kept: NDArray[np.intp]
    quieter: float = 1.0

    @cached_property
    def basis(self) -> Array:
        """Orthonormal basis (k + g, o) of what the own unknowns absorb, whitened; g guesses of them beforehand."""
        bound, free = self.fresh.bound, ~self.fresh.known
        firm = np.flatnonzero(free & np.isfinite(bound.prior_std))
        guesses = np.zeros((firm.size, bound.unknowns))
        guesses[np.arange(firm.size), firm] = 1.0 / bound.prior_std[firm]
        return spanned(np.vstack([self.fresh.jacobian[self.kept], guesses])[:, free])

    @cached_property
    def used(self) -> Array:
        """Noise (k,) as the calibration used it."""
        return np.asarray(self.fresh.bound.noise[self.kept])

    @cached_property
    def stated(self) -> Array:
        """The instrument's own (k,): as it was stated, or less."""
        return np.asarray(self.quieter * np.minimum(self.fresh.bound.with_noise().noise[self.kept], self.used))

    @cached_property
    def leading(self) -> NDArray[np.bool_]:
        """Residuals (k,) in mm where a row has others as well."""
        return self.fresh.bound.leading[self.kept]

    @cached_property
    def sample_of(self) -> NDArray[np.intp]:
        """The row that each residual (k,) is of."""
        return np.asarray(self.fresh.bound.sample_of[self.kept], dtype=np.intp)

    @cached_property
    def given(self) -> Array:
        """How much (k,) of an error of one size everywhere the fit of the own unknowns leaves, squared."""
        return self._left(np.where(self.leading, 1.0, 0.0), 0.0)

    @cached_property
    def noise(self) -> Array:
        """Square (k,) of the instrument's own noise that is left, mm^2."""
        return self._left(self.stated**2, 1.0)

    @cached_property
    def most(self) -> Array:
        """The same of noise as the calibration used it."""
        return self._left(self.used**2, 1.0)

    def _left(self, squares: Array, guess: float) -> Array:
        """Mean square (k,) that is left of independent errors with mean squares (k,), and of guesses, whitened."""
        count = len(self.kept)
        whitened = np.concatenate([squares / self.used**2, np.full(len(self.basis) - count, guess)])
        across = self.basis.T @ (whitened[:, None] * self.basis)
        beside = 1 - 2 * (self.basis**2).sum(axis=1)
        left = whitened * beside + ((self.basis @ across) * self.basis).sum(axis=1)
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

    def scatter(self, residual: Array, rows: NDArray[np.intp] | None = None) -> Scatter | None:
        """What residuals (k,), mm, say of the arm's error, of all or some rows; None where they say nothing."""
        counts = self._counted(rows)
        places, which = np.unique(self.sample_of[counts], return_inverse=True)
        if not places.size:
            return None
        parts = int(counts.sum()) / places.size
        given = float(self.given[counts].sum()) / parts
        if given < 1e-6 * places.size:
            return None
        squares = np.bincount(which, residual[counts] ** 2)
        noise, most = (float(each[counts].sum()) / given for each in (self.noise, self.most))
        total = float(squares.sum()) / given
        again = np.unique(self.fresh.bound.repeats.codes[places], return_counts=True)[1]
        alike = float((again**2).sum()) / places.size  # touches in one posture are one of its kind
        mean = float(squares.mean())
        found = max(float(squares.var()) / mean**2 if mean > 0 else 0.0, 2 / parts)
        uneven = (places.size * found + AS_ROWS * USUAL / parts) / (places.size + AS_ROWS)
        return Scatter(total, min(noise, most), most, 2 * given / (uneven * alike))

    def _counted(self, rows: NDArray[np.intp] | None) -> NDArray[np.bool_]:
        """Which residuals (k,) are of some rows, or of all, and in mm."""
        if rows is None:
            return self.leading
        asked = np.zeros(int(self.sample_of.max(initial=0)) + 1, dtype=bool)
        asked[rows[rows < asked.size]] = True
        return self.leading & asked[self.sample_of]

    def given_rows(self, rows: NDArray[np.intp] | None = None) -> float:
        """Rows less what their own unknowns absorbed of them."""
        counts = self._counted(rows)
        parts = int(counts.sum()) / max(np.unique(self.sample_of[counts]).size, 1)
        return float(self.given[counts].sum()) / max(parts, 1.0)

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
        residual, spread, own = self.fresh.likelihood()
        kept = np.concatenate([self.kept, np.arange(self.fresh.bound.rows, len(residual))])
        basis = spanned(own[kept])
        across = spread[kept] - basis @ (basis.T @ spread[kept])
        return np.asarray(self.used**2 * (across[: len(self.kept)] ** 2).sum(axis=1))

    def promised_mm(self, rows: NDArray[np.intp] | None = None) -> float:
        """Error that the calibration expects of all or some rows, RMS."""
        counts = self._counted(rows)
        places = np.unique(self.sample_of[counts]).size
        given = float(self.given[counts].sum()) * places / max(int(counts.sum()), 1)
        return math.sqrt(float(self.promised[counts].sum()) / given) if given > 0 else math.nan


def seen_by_rows(arm: CalibratedArm, fresh: Fresh, without: NDArray[np.intp] | None = None) -> Seen:
    """What fresh rows see of the arm's error, all of them or without some residuals."""
    everything = np.arange(fresh.bound.rows)
    kept = everything if without is None else np.setdiff1d(everything, without)
    return Seen(fresh, kept, quieter=_quieter(arm, fresh))


def _quieter(arm: CalibratedArm, fresh: Fresh) -> float:
    """Part of the stated noise that may be taken off: less than one where it was surely stated too large.

    That would hide the arm's error. The calibration says so by what it found over what was stated, and the fresh rows
    by residuals that are too small where nothing but noise is expected; then the lower end of either is what counts.
    """
    from scipy.special import gammaincinv

    noise = arm.document.get("noise") or {}
    low, high = noise.get("low"), noise.get("high")
    least = float(low) if low and high and high < TENTH and not fresh.other else 1.0
    square, freedom = _noise_alone(fresh)
    if freedom and square < 2 * float(gammaincinv(freedom / 2, SURE)):
        least = min(least, math.sqrt(square / (2 * float(gammaincinv(freedom / 2, 1 - SURE)))))
    return least


def _noise_alone(fresh: Fresh) -> tuple[float, int]:
    """Sum of squares over those of stated noise where only noise is expected, and how many directions these are."""
    residual, spread, own = fresh.likelihood()
    basis = spanned(own)
    left, across = (each - basis @ (basis.T @ each) for each in (residual, spread))
    directions, sizes, _ = np.linalg.svd(across, full_matrices=False)
    expected = directions[:, sizes > ALONE]
    square = float(left @ left) - float(((expected.T @ left) ** 2).sum())
    bound = fresh.bound
    louder = float(np.median((bound.noise / bound.with_noise().noise) ** 2))  # as used over as stated
    return louder * max(square, 0.0), len(residual) - basis.shape[1] - expected.shape[1]
