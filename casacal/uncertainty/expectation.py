"""The tip error to expect: over the workspace, inside a box, before or after any touch."""

from __future__ import annotations

import math

import numpy as np

from casacal.array_types import Array
from casacal.binding.seen import Seen
from casacal.errors import CasacalError
from casacal.least_squares.linalg import posterior_covariance
from casacal.robots.robot import random_joints
from casacal.uncertainty.identifiability import natural_scale
from casacal.uncertainty.workspace import (
    WORKSPACE_POSES,
    bayesian_bound,
    classical_bound,
    flange_jacobian,
    spread_rms,
    tip_stds,
    up_to_base,
    workspace_joints,
)

Box = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
"""Ranges of x, y and z in the base frame, mm."""

TRIES = 40_000  # random joint values among which those inside a box are looked for
FEWEST = 20


def planned_accuracy(bound: Seen) -> tuple[float, float]:
    """Tip error (mm RMS over the workspace) to expect: from the prior alone, and with these rows.

    Apart from where the base stands. At the nominal, so that it can be asked of planned or simulated touches before
    anyone moves a robot. It trusts stated noise and priors.
    """
    return expected_accuracy(bound, bound.x0)


def expected_accuracy(
    bound: Seen,
    x: Array,
    off: Array | None = None,
    *,
    usual: bool = True,
    flange: bool = False,
    covariance: Array | None = None,
) -> tuple[float, float]:
    """The same at x (n,), or of the flange's origin; `off` as for `tip_stds`, `usual` as for `Block.posture`.

    covariance: (n, n) of an estimate that does not count all rows alike; by default what rows and prior give.
    """
    joints = workspace_joints(bound.problem.robot)
    if flange:
        tips, slopes = flange_jacobian(bound, x, joints)
    else:
        tips, slopes = bound.tips(x, joints), bound.tip_jacobian(x, joints, usual=usual)
    information = bound.information(x if off is None else x + off)
    before = bayesian_bound(np.zeros_like(information), bound.prior_information, slopes, tips)
    if covariance is not None:
        return before, spread_rms(covariance, slopes, tips, off)
    return before, bayesian_bound(information, bound.prior_information, slopes, tips, off)


def classical_accuracy(bound: Seen, x: Array) -> tuple[float, int]:
    """Tip error (mm RMS) that the rows alone allow at x (n,), without a prior, and how many unseen directions move it.

    Infinite when there is such a direction.
    """
    joints = workspace_joints(bound.problem.robot)
    return classical_bound(
        bound.compact_jacobian(x), natural_scale(bound), bound.tip_jacobian(x, joints), bound.tips(x, joints)
    )


def accuracy_in_box(bound: Seen, x: Array, box: Box, off: Array | None = None) -> tuple[float, float]:
    """Tip error (mm RMS) to expect inside a box at x (n,), and its largest value there.

    Both apart from the position of the base; `off` as for `tip_stds`.
    Raises CasacalError when the arm hardly reaches the box.
    """
    joints, frame = joints_in_box(bound, x, box), workspace_joints(bound.problem.robot)
    field = up_to_base(
        bound.tip_jacobian(x, joints), bound.tips(x, joints), bound.tip_jacobian(x, frame), bound.tips(x, frame)
    )
    covariance = posterior_covariance(bound.information(x if off is None else x + off), bound.prior_information)
    stds = np.linalg.norm(tip_stds(covariance, field, off), axis=1)
    return math.sqrt(float((stds**2).mean())), float(stds.max())


def joints_in_box(bound: Seen, x: Array, box: Box) -> Array:
    """Random joint values (M, n; rad, mm) at which the tip is inside a box; CasacalError where it hardly gets there."""
    low, high = np.array(box).T
    if not (low < high).all():
        ranges = ",".join(f"{lower:g}:{upper:g}" for lower, upper in box)
        raise CasacalError(f"The box {ranges} is empty", "Give each range as LOW:HIGH in mm")
    tried = random_joints(bound.problem.robot, TRIES, np.random.default_rng(0))
    tips = bound.tips(x, tried)
    joints = tried[((tips >= low) & (tips <= high)).all(axis=1)][:WORKSPACE_POSES]
    if len(joints) < FEWEST:
        raise CasacalError(
            f"Only {len(joints)} of {TRIES} random postures put the tip inside the box",
            "Choose a box in the arm's reach",
        )
    return np.asarray(joints)
