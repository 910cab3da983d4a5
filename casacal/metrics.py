"""Figures of merit: plane residuals, true tip errors over the workspace, and the bound no estimator can beat."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from casacal.inverse_kinematics import random_joints
from casacal.least_squares import LeastSquares
from casacal.linalg import posterior_covariance
from casacal.robot import Robot

Array: TypeAlias = NDArray[np.float64]

WORKSPACE_POSES = 400


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


def without_rigid(field: Array, tips: Array) -> Array:
    """A displacement of tips, or several as columns (3 N, m), with its best rigid motion taken out.

    Planes alone cannot see where the base frame stands, so six rigid fields of the tips (N, 3) are projected out.
    """
    arms = tips - tips.mean(axis=0)
    turns = [np.cross(axis, arms).ravel() for axis in np.eye(3)]
    shifts = [np.tile(axis, len(tips)) for axis in np.eye(3)]
    basis, _ = np.linalg.qr(np.column_stack([*shifts, *turns]))
    return np.asarray(field - basis @ (basis.T @ field))


def tip_rms(field: Array) -> float:
    """Root mean square length (mm) of a displacement (3 N,) of N tips."""
    return math.sqrt(float((field.reshape(-1, 3) ** 2).sum(axis=1).mean()))


def bayesian_bound(information: Array, prior_std: Array, tip_jacobian: Array, tips: Array) -> float:
    """Smallest RMS tip error (mm) over the workspace, modulo rigid motion, that data and prior allow.

    sqrt(trace(H (F + Lambda0)^-1 H') / N): F the data's information (n, n), H the tips' Jacobian (3 N, n) with the
    rigid fields projected out, N tips (N, 3).
    """
    covariance = posterior_covariance(information, prior_std)
    seen = np.where(np.isfinite(covariance), covariance, 0.0)
    projected = without_rigid(tip_jacobian, tips)
    blind = ~np.isfinite(np.diagonal(covariance))
    if (np.abs(projected[:, blind]) > 1e-9).any():
        return math.inf
    return math.sqrt(float(np.einsum("ij,jk,ik->", projected, seen, projected)) / len(tips))


def noise_interval(problem: LeastSquares, x: Array, covariance: Array) -> tuple[float, float, float]:
    """Found over stated noise: the estimate and its 95 % interval, from the whitened residuals at x.

    The residuals' sum of squares over its degrees of freedom, rows less the unknowns that the data determined.
    """
    information = problem.normal(x).information
    held = np.where(np.isfinite(covariance), covariance, 0.0)
    free = max(problem.rows - float(np.einsum("ij,ji->", held, information)), 1.0)
    total = float((problem.residual(x) ** 2).sum())
    low, high = (total / float(chi2.ppf(p, free)) for p in (0.975, 0.025))
    return math.sqrt(total / free), math.sqrt(low), math.sqrt(high)


def nees(error: Array, covariance: Array) -> float:
    """Normalised estimation error squared: error' covariance^-1 error, chi-square with n degrees of freedom."""
    return float(error @ np.linalg.solve(covariance, error))
