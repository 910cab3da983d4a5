"""Figures of merit: plane residuals, true tip errors over the workspace, and the bound no estimator can beat."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from casacal.least_squares.linalg import posterior_covariance
from casacal.least_squares.objective import LeastSquares
from casacal.robots.robot import Robot
from casacal.simulation.reach import random_joints

Array: TypeAlias = NDArray[np.float64]

WORKSPACE_POSES = 400

RANK_TOLERANCE = 1e-9
"""Part of the largest singular value below which a direction counts as null."""

FIELD_TOLERANCE = 1e-4
"""Part of the largest tip motion below which a direction counts as not moving the tip: well below a micrometre under
usual priors, and above what rank tolerance times condition mixes into null directions."""

BLIND_FIELD = 1e-9
"""Motion (mm per unit) below which a tip does not see an unknown."""


def residual_figures(residuals: Array) -> dict[str, float]:
    """RMSE, MAE, STD (about the mean) and MAX of residuals (N,) in mm.

    Each by its right definition; the paper's eqs (30), (31) are not (errata E17, E18).
    """
    size = np.abs(residuals)
    return {
        "rmse_mm": math.sqrt(float((residuals**2).mean())),
        "mae_mm": float(size.mean()),
        "std_mm": float(residuals.std()),
        "max_mm": float(size.max()),
    }


def workspace_joints(robot: Robot, *, poses: int = WORKSPACE_POSES, seed: int = 0) -> Array:
    """Fixed joint values (poses, n; rad, mm) that move every joint through its limits; no sample lies there."""
    return random_joints(robot, poses, np.random.default_rng([20220802, seed]))


def rigid_fields(tips: Array, about: Array) -> Array:
    """Six rigid displacement fields (3 N, 6) of tips (N, 3): three shifts, three turns about a point (3,)."""
    arms = tips - about
    turns = [np.cross(axis, arms).ravel() for axis in np.eye(3)]
    shifts = [np.tile(axis, len(tips)) for axis in np.eye(3)]
    return np.column_stack([*shifts, *turns])


def without_rigid(field: Array, tips: Array) -> Array:
    """A displacement of tips, or several as columns (3 N, m), with its best rigid motion taken out.

    Planes alone cannot see where the base frame stands, so six rigid fields of the tips (N, 3) are projected out.
    """
    basis, _ = np.linalg.qr(rigid_fields(tips, tips.mean(axis=0)))
    return np.asarray(field - basis @ (basis.T @ field))


def up_to_base(field: Array, tips: Array, frame_field: Array, frame_tips: Array) -> Array:
    """Displacements (3 N, m) of some tips with the rigid motion taken out that fits another set's displacements best.

    The other set (3 M, m) of tips (M, 3), usually the workspace, says what counts as a move of the base frame.
    """
    about = frame_tips.mean(axis=0)
    motion = np.linalg.lstsq(rigid_fields(frame_tips, about), frame_field, rcond=None)[0]
    return np.asarray(field - rigid_fields(tips, about) @ motion)


def tip_stds(covariance: Array, field: Array) -> Array:
    """Standard deviation (N, 3; mm) of each tip along each axis.

    Args:
        covariance: of the unknowns (n, n); infinite variances count where the field sees them.
        field: derivative (3 N, n) of the tips by the unknowns, up to the base frame where that is wanted.

    """
    lost = ~np.isfinite(np.diagonal(covariance))
    held = np.where(np.isfinite(covariance), covariance, 0.0)
    variance = np.einsum("ij,jk,ik->i", field, held, field)
    variance[(np.abs(field[:, lost]) > BLIND_FIELD).any(axis=1)] = np.inf
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)).reshape(-1, 3))


def tip_rms(field: Array) -> float:
    """Root mean square length (mm) of a displacement (3 N,) of N tips."""
    return math.sqrt(float((field.reshape(-1, 3) ** 2).sum(axis=1).mean()))


def bayesian_bound(information: Array, prior_std: Array, tip_jacobian: Array, tips: Array) -> float:
    """Smallest RMS tip error (mm) over the workspace, modulo rigid motion, that data and prior allow.

    sqrt(trace(H (F + Lambda0)^-1 H') / N): F the data's information (n, n), H the tips' Jacobian (3 N, n) with the
    rigid fields projected out, N tips (N, 3). Infinite when a flat direction that the data do not see moves a tip.
    """
    stds = tip_stds(posterior_covariance(information, prior_std), without_rigid(tip_jacobian, tips))
    return math.sqrt(float((stds**2).sum(axis=1).mean()))


def classical_bound(jacobian: Array, scale: Array, tip_jacobian: Array, tips: Array) -> tuple[float, int]:
    """The same without any prior, H F^+ H', and how many directions that move a tip the data do not see.

    Infinite when there is such a direction. Of the whitened Jacobian (rows, n), its columns in units of `scale` (n,).
    """
    _, sizes, right = np.linalg.svd(jacobian * scale, full_matrices=len(jacobian) < len(scale))
    sizes = np.concatenate([sizes, np.zeros(len(scale) - len(sizes))])
    seen = sizes > RANK_TOLERANCE * max(float(sizes[0]), 1e-300)
    field = without_rigid(tip_jacobian * scale, tips)
    lost = np.linalg.svd(field @ right[~seen].T, compute_uv=False)
    blind = int((lost > FIELD_TOLERANCE * max(float(np.linalg.norm(field, axis=0).max()), 1e-300)).sum())
    spread = (field @ right[seen].T) / sizes[seen]
    return (math.inf if blind else math.sqrt(float((spread**2).sum()) / len(tips))), blind


def noise_interval(
    problem: LeastSquares, x: Array, covariance: Array, kept: NDArray[np.bool_]
) -> tuple[float, float, float]:
    """Found over stated noise: the estimate and its 95 % interval, from the whitened residuals at x.

    The residuals' sum of squares over its degrees of freedom, rows less the unknowns that the data determined.

    Args:
        problem: whose noise is judged.
        x: estimate (n,).
        covariance: of x (n, n).
        kept: rows (rows,) that count; a robust fit leaves out those that it down-weighted.

    """
    from scipy.special import gammaincinv

    if kept.all():
        information = problem.normal(x).information
    else:
        jacobian = problem.jacobian(x)[kept]
        information = jacobian.T @ jacobian
    held = np.where(np.isfinite(covariance), covariance, 0.0)
    free = max(int(kept.sum()) - float((information * held).sum()), 1.0)
    total = float((problem.residual(x)[kept] ** 2).sum())
    # quantiles of chi-square with `free` degrees of freedom, without the half second that importing scipy.stats takes
    low, high = (total / (2 * float(gammaincinv(free / 2, p))) for p in (0.975, 0.025))
    return math.sqrt(total / free), math.sqrt(low), math.sqrt(high)


def nees(error: Array, covariance: Array) -> float:
    """Normalised estimation error squared: error' covariance^-1 error, chi-square with n degrees of freedom."""
    return float(error @ np.linalg.solve(covariance, error))
