"""What rows show beside the geometry: effects of the arm at the sizes as found, and errors of the dial itself."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.instruments.dial import dial_cycle, dial_gain
from casacal.least_squares.linalg import posterior_covariance
from casacal.uncertainty.discrepancy import times_found
from casacal.uncertainty.transfer import in_sample_gains
from casacal.uncertainty.workspace import tip_rms, without_rigid, workspace_joints
from casacal.wording import sized

VERY_STRONG = 5.0
"""Logarithm of a ratio of densities from which evidence is called very strong (Kass and Raftery, Journal of the
American Statistical Association 90, 1995, section 3.2: 2 ln B above 10)."""
UNLIKELY = 0.01 / 2
"""Chance below which an error of the dial is taken to be there: one in a hundred, for the two that are tested."""
FLAT = 1e-3  # slope of a residual by its reading below which that reading tells nothing
STEP = 0.5  # millimetres by which readings are shifted for their slope: a distance from a plane is linear in them
UNSEEN = 1e-9  # part of the squared length of a column that a fit must leave of it for it to be seen at all


@dataclass(frozen=True)
class EffectSize:
    """An effect beside the geometry as the rows show it.

    gain: by how much the logarithm of the rows' likelihood is larger with it than without. size: at which the rows are
    likeliest, all effects together, and expected_size: of any arm, both in `unit`.
    """

    key: str
    words: str
    gain: float
    size: float
    expected_size: float
    unit: str

    @property
    def shown(self) -> bool:
        """Whether the evidence is very strong."""
        return self.gain > VERY_STRONG


@dataclass(frozen=True)
class DialError:
    """An error of a dial that its problem does not declare, at its likeliest size.

    chance: of rows like these without it. tip_mm: what it makes of the estimate, mm RMS at the tip over the workspace,
    apart from the position of the base.
    """

    key: str
    words: str
    chance: float
    size: float
    unit: str
    tip_mm: float

    @property
    def shown(self) -> bool:
        """Whether the rows show it."""
        return self.chance < UNLIKELY

    @property
    def shown_size(self) -> str:
        """The size as people read it."""
        return sized(self.size, self.unit)


def effect_sizes_of(fit: BoundProblem, x: Array) -> tuple[EffectSize, ...]:
    """Every effect of a fit, the likeliest first; x: where it stands (n,). Empty for the geometry alone."""
    times = times_found(fit)
    known = [effect for effect in fit.problem.effects if effect.key in times and effect.key in fit.beside]
    gains = in_sample_gains(fit, x, [effect.key for effect in known]) if known else {}
    found = [
        EffectSize(
            effect.key,
            effect.words,
            gains[effect.key],
            effect.size * times[effect.key],
            effect.size,
            effect.unit or fit.units[fit.beside.index(effect.key)],
        )
        for effect in known
    ]
    return tuple(sorted(found, key=lambda each: -each.gain))


def dial_errors(fit: BoundProblem, x: Array) -> tuple[DialError, ...]:
    """What undeclared errors of a dial would explain beside a fit: a gain, and an error by the pointer's angle.

    Columns B (N, m) beside a minimum of residuals r, with C its covariance: what the fit leaves of them,
    K = B'(I - J C J')B, lowers the sum of squares by B'r K^-1 B'r; that over the rest is F distributed.

    Args:
        fit: with noise and effects as they were found, so that none of these passes for the dial's error.
        x: its minimum (n,).

    """
    if not fit.unknowns or not any(instrument.probe for instrument in fit.problem.instruments):
        return ()
    jacobian, residual, joints = fit.jacobian(x), fit.residual(x), workspace_joints(fit.problem.robot)
    covariance = posterior_covariance(jacobian.T @ jacobian, fit.prior_information)
    covariance = np.where(np.isfinite(covariance), covariance, 0.0)
    square = float(residual @ residual) + 2 * fit.prior_cost(x)
    free = len(residual) - int((~np.isfinite(fit.prior_std)).sum())
    tips, found = fit.tips(x, joints), []
    field = without_rigid(fit.tip_jacobian(x, joints), tips)
    for key, words, unit, columns in _dial_columns(fit, x):
        cross = jacobian.T @ columns
        left, own = columns.T @ columns - cross.T @ covariance @ cross, columns.T @ columns
        freedom = free - columns.shape[1]
        if freedom < 1 or np.linalg.eigvalsh(left)[0] < UNSEEN * np.linalg.eigvalsh(own)[-1]:
            continue
        size = -np.linalg.solve(left, columns.T @ residual)
        gained = float(-size @ (columns.T @ residual))
        ratio = gained / len(size) / (max(square - gained, 0.0) / freedom + 1e-300)
        moved = tip_rms(field @ (covariance @ (cross @ size)))
        chance = float(fdtrc(len(size), freedom, ratio))
        found.append(DialError(key, words, chance, float(np.linalg.norm(size)), unit, moved))
    return tuple(found)


def _dial_columns(fit: BoundProblem, x: Array) -> Iterator[tuple[str, str, str, Array]]:
    """Key, words, unit, and whitened rows (N, m) by one percent of gain, by micrometres of cosine and sine.

    What was read holds the arm's errors, too, and little else where all touches were programmed to one depth: there a
    gain that makes readings vanish would seem to explain why the arm errs. So the gain is of what the drawn arm would
    read, which depends on no error; the pointer's angle, of what the fitted one does.
    """
    for i, instrument in enumerate(fit.problem.instruments):
        probe, declared = instrument.probe, instrument.unknowns
        if probe is None or probe.column is None or not probe.turn:
            continue
        read = np.zeros(fit.rows)
        read[fit.sample_rows(i)] = fit.samples[i].columns[probe.column]
        steep = _steepness(fit, x, i, probe.column)
        told = np.abs(steep) > FLAT
        drawn, fitted = (
            read - np.where(told, fit.plain_residual(at) / np.where(told, steep, 1.0), 0.0) for at in (fit.x0, x)
        )
        slope, before = steep / fit.noise, fit.problem.prefix(i)
        if "gain" not in declared:
            way = slope * drawn / 100
            yield f"{before}gain", "gain of the dial", dial_gain().unit, way[:, None]
        if "cycle" not in declared:
            angle = 2 * math.pi * fitted / probe.turn
            ways = slope[:, None] / 1000 * np.column_stack([np.cos(angle), np.sin(angle)])
            words = "error of the dial that repeats with every turn of its pointer"
            yield f"{before}cycle", words, dial_cycle().unit, ways


def _steepness(fit: BoundProblem, x: Array, i: int, column: str) -> Array:
    """Slope (rows,) of all residuals by what instrument `i` reads in a column."""
    shifted = []
    for step in (STEP, -STEP):
        samples = list(fit.samples)
        columns = samples[i].columns
        samples[i] = replace(samples[i], columns={**columns, column: columns[column] + step})
        shifted.append(fit.on(*samples).plain_residual(x))
    return np.asarray((shifted[0] - shifted[1]) / (2 * STEP))
