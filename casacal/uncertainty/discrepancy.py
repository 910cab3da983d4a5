"""What arm and cell do beside their geometry, brought into a fit: effects of expected sizes, and sizes as found."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.noise_scale import OTHERS, SHARED
from casacal.discrepancy.joint_field import JointField
from casacal.estimators import lm
from casacal.problem.problem import Problem
from casacal.uncertainty.effect_sizes import effect_sizes

ENOUGH = 300
"""Rows from which on a field of many unknowns can be told."""


def with_effects(bound: BoundProblem, problem: Problem, *, find_noise: bool = True) -> BoundProblem:
    """The same rows with the effects that any arm is expected to have, sizes and noise as the rows show them.

    Sizes are those at which the rows are likeliest (restricted marginal likelihood) where the geometry stands; noise is
    never less than stated. Itself where nothing is unknown, where faces are so many that each has too few rows to say,
    and where the geometry cannot be fitted.

    Args:
        bound: of the geometry alone, with the noise as it was found without effects.
        problem: the same geometry; its effects, or those to expect of any arm where it has none.
        find_noise: whether noise is found beside the sizes; else it stays as it is.

    """
    if bound.groups is not None or not bound.unknowns:
        return bound
    geometry = lm(bound)
    if not geometry.converged:
        return bound
    found = _sized(bound, problem.with_kit, geometry.x, find_noise)
    if not problem.effects and _errs_together(found):
        found = _sized(bound, problem.with_rich_kit, geometry.x, find_noise)
    return found


def _sized(bound: BoundProblem, problem: Problem, geometry: Array, find_noise: bool) -> BoundProblem:
    """The rows under a problem with effects, its sizes and noise as found where the geometry stands at x (n,).

    Faces that differed in noise may differ in what effects do to them instead: what makes the rows likelier is taken.
    """
    whole = bound.under(problem)
    x = whole.x0.copy()
    x[[j for j, key in enumerate(whole.beside) if not key]] = geometry
    found = [_likeliest(whole, x, find_noise)]
    scale = _scale(whole)
    if find_noise and set(scale) - {OTHERS, SHARED}:
        alike = {OTHERS: min(value for name, value in scale.items() if name != SHARED)}
        shared = {name: value for name, value in scale.items() if name == SHARED}
        found.append(_likeliest(whole.with_noise({**alike, **shared}), x, find_noise))
    return max(found, key=lambda each: each[0])[1]


def _likeliest(whole: BoundProblem, x: Array, find_noise: bool) -> tuple[float, BoundProblem]:
    """Logarithm of the likelihood of the rows at the sizes and the noise that make it greatest, and the rows so."""
    scale = _scale(whole)
    least = min((factor for name, factor in scale.items() if name != SHARED), default=1.0)
    known = {effect.key: (effect.doubt, effect.most) for effect in whole.problem.effects}
    sizes = effect_sizes(whole, x, whole.beside, known, stated=1 / least, find_noise=find_noise)
    density = float(np.log(np.concatenate([block.noise.ravel() for block in whole.blocks])).sum())
    rows = whole.with_sizes(sizes.times, noise=_times(scale, sizes.noise) if sizes.noise != 1 else None)
    return sizes.evidence - density, rows


def _scale(whole: BoundProblem) -> Mapping[str, float]:
    return whole.noise_scale[0] if whole.noise_scale else {}


def _errs_together(whole: BoundProblem) -> bool:
    """Whether rows err together by more than each does alone, and are many enough to say how."""
    sizes = [slot.unknown.prior_stds[0] for slot in whole.slots if slot.beside == JointField.key]
    return bool(sizes) and whole.rows > ENOUGH and float(sizes[0]) > float(np.median(whole.block.noise))


def _times(scale: Mapping[str, float], factor: float) -> dict[str, float]:
    """Noise as used, times a factor; what repeats share is a part of it and stays."""
    found = {name: value if name == SHARED else value * factor for name, value in scale.items()}
    return found if scale else {OTHERS: factor}
