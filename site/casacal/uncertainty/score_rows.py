"""What is tested beside a geometry: columns of the residual by each effect, and which rows would err together."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix, identity

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.nominal import nominal_tips
from casacal.discrepancy import TransmissionError
from casacal.instruments.dial_parts import dial_cycle, dial_gain
from casacal.problem.problem import Problem
from casacal.uncertainty.row_forms import alike, diagonal, following, near_on_faces, whitened

FLAT = 1e-3  # slope of a residual by its reading below which that reading tells nothing
STEP = 0.5  # millimetres by which readings are shifted for their slope: a distance from a plane is linear in them

REPEATS, JOINTS = "repeats", "repeatability"

WAVE = TransmissionError(order=1).key
"""Sine and cosine of a joint value, times its slope: their squares are that of the slope, whatever the posture."""


@dataclass(frozen=True, eq=False)
class Columns:
    """Whitened rows (N, m) and tips (3 M, m; mm) by the unknowns of an effect of the size that one expects of it."""

    key: str
    words: str
    expected: float
    unit: str
    rows: Array
    tip: Array


@dataclass(frozen=True, eq=False)
class Form:
    """Which rows err together or err more: what is tested, if it is here, and the covariance of size one behind it.

    own: tip motion (mm RMS) of size one that comes of itself.
    """

    key: str
    words: str
    unit: str
    tested: csr_matrix | None
    covariance: csr_matrix
    own: float = 0.0


def columns_of(bound: BoundProblem, x: Array, problem: Problem, joints: Array) -> dict[str, Columns]:
    """Of every effect of a problem, and of the errors of the dial that it does not declare, by key.

    Args:
        bound: of the geometry alone.
        x: its estimate (n,).
        problem: the same geometry; its effects, or those to expect of any arm where it has none.
        joints: where the tip is looked at (M, joints; rad, mm).

    """
    whole = bound.under(problem.with_kit)
    at, found = whole.x0.copy(), []
    at[~np.array(whole.beside, dtype=bool)] = x
    rows, tips = whole.jacobian(at), whole.tip_jacobian(at, joints)
    for effect in whole.problem.effects:
        mine = np.flatnonzero(np.array(whole.beside) == effect.key)
        if mine.size and np.isfinite(stds := whole.prior_std[mine]).all():
            scaled, unit = (rows[:, mine] * stds, tips[:, mine] * stds), whole.units[mine[0]]
            found.append(Columns(effect.key, effect.words, effect.size, effect.unit or unit, *scaled))
    return {each.key: each for each in (*found, *_dial_columns(bound, x, len(tips)))}


def _dial_columns(bound: BoundProblem, x: Array, tips: int) -> Iterator[Columns]:
    """Gain, and what comes back with every turn of the pointer; at reading zero, where tips are asked for, no error.

    What was read holds the arm's errors, too, and little else where all touches were programmed to one depth: there a
    gain that makes readings vanish would seem to explain why the arm errs. So the gain is of what the drawn arm would
    read, which depends on no error; the pointer's angle, of what the fitted one does.
    """
    for i, instrument in enumerate(bound.problem.instruments):
        probe, declared = instrument.probe, instrument.unknowns
        if probe is None or probe.column is None or not probe.turn:
            continue
        read = np.zeros(bound.rows)
        own = bound.sample_rows(i)
        read[own] = bound.samples[i].columns[probe.column]
        steep = _steepness(bound, x, i, probe.column)
        told = np.abs(steep) > FLAT
        drawn, fitted = (
            read - np.where(told, bound.plain_residual(at) / np.where(told, steep, 1.0), 0.0) for at in (bound.x0, x)
        )
        slope, before = steep / bound.noise, bound.problem.prefix(i)
        gain, cycle = dial_gain(), dial_cycle()
        if "gain" not in declared:
            size = float(gain.prior_stds[0])
            way = size / 100 * slope * drawn
            yield Columns(f"{before}gain", "gain of the dial", size, gain.unit, way[:, None], np.zeros((tips, 1)))
        if "cycle" not in declared:
            size, angle = float(cycle.prior_stds[0]), 2 * math.pi * fitted / probe.turn
            ways = size / 1000 * slope[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
            words = "error of the dial that repeats with every turn of its pointer"
            yield Columns(f"{before}cycle", words, size, cycle.unit, ways, np.zeros((tips, 2)))


def _steepness(bound: BoundProblem, x: Array, i: int, column: str) -> Array:
    """Slope (rows,) of all residuals by what instrument `i` reads in a column."""
    shifted = []
    for step in (STEP, -STEP):
        samples = list(bound.samples)
        columns = samples[i].columns
        samples[i] = replace(samples[i], columns={**columns, column: columns[column] + step})
        shifted.append(bound.on(*samples).plain_residual(x))
    return np.asarray((shifted[0] - shifted[1]) / (2 * STEP))


def forms_of(bound: BoundProblem, columns: Mapping[str, Columns]) -> Iterator[Form]:
    """Rows that are near one another on a face, follow one another, repeat one another, or see more of the joints."""
    measured, places, unit = bound.measured, bound.repeats, bound.problem.instruments[0].words.unit
    near = following(measured.lines, places.codes, measured.instruments)
    pairs = {"succession": ("error that successive touches share", near)}
    touching = np.array([instrument.probe is not None for instrument in bound.problem.instruments])
    if touching.any():
        tips = np.vstack([nominal_tips(bound.problem, i, some) for i, some in enumerate(bound.samples)])
        faces = np.where(touching[measured.instruments], bound.faces.codes, -1)
        near = near_on_faces(tips, faces, places.codes)
        pairs["neighbours"] = ("error that neighbouring touches share", near)
    for key, (words, form) in pairs.items():
        if form.nnz:
            shared = csr_matrix(form + identity(len(measured)))
            yield Form(key, words, unit, whitened(form, bound), whitened(shared, bound))
    if places.any:
        words = "repeated touches agree better than the fit"
        yield Form(REPEATS, words, unit, None, whitened(alike(places.codes), bound))
    if WAVE in columns:
        wave = columns[WAVE]
        moved = diagonal((bound.joint_noise / bound.noise) ** 2)
        own = math.sqrt(3 * float((wave.tip**2).sum()) / len(wave.tip)) / wave.expected
        yield Form(JOINTS, "joint repeatability", "rad", moved, moved, own)


def noise_mm(bound: BoundProblem) -> float:
    """Noise of a touch as stated, its median, in the unit of the residual."""
    return float(np.median(bound.with_noise().noise))
