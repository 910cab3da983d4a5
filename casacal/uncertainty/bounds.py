"""The tip error that no estimator can beat, with the prior and without."""

from __future__ import annotations

import math

import numpy as np

from casacal.array_types import Array
from casacal.least_squares.linalg import posterior_covariance
from casacal.uncertainty.workspace import tip_stds, without_rigid

RANK_TOLERANCE = 1e-9
"""Fraction of the largest singular value below which a direction counts as null."""


FIELD_TOLERANCE = 1e-4
"""Fraction of the largest tip motion below which a direction counts as not moving the tip: well below a micrometre
under usual priors, and above what rank tolerance times condition mixes into null directions."""


def seen_space(rows: Array) -> tuple[int, Array]:
    """Rank of a matrix (m, n), and right singular vectors (n, n; rows) of which the first `rank` span what it sees."""
    _, sizes, right = np.linalg.svd(rows, full_matrices=len(rows) < rows.shape[1])
    return int((sizes > RANK_TOLERANCE * max(float(sizes.max(initial=0.0)), 1e-300)).sum()), right


def bayesian_bound(
    information: Array, prior_std: Array, tip_jacobian: Array, tips: Array, off: Array | None = None
) -> float:
    """Smallest RMS tip error (mm) over the workspace, apart from rigid motion, that data and prior allow.

    sqrt(trace(H (F + Lambda0)^-1 H') / N): F the data's information (n, n), H the tips' Jacobian (3 N, n) with the
    rigid fields projected out, N tips (N, 3). Infinite when a flat direction that the data do not see moves a tip.
    `off` as for `tip_stds`.
    """
    stds = tip_stds(posterior_covariance(information, prior_std), without_rigid(tip_jacobian, tips), off)
    return math.sqrt(float((stds**2).sum(axis=1).mean()))


def classical_bound(jacobian: Array, scale: Array, tip_jacobian: Array, tips: Array) -> tuple[float, int]:
    """The same without any prior, H F^+ H', and how many directions that move a tip the data do not see.

    Infinite when there is such a direction. Of the whitened Jacobian (rows, n), its columns in units of `scale` (n,).
    """
    _, sizes, right = np.linalg.svd(jacobian * scale, full_matrices=len(jacobian) < len(scale))
    sizes = np.concatenate([sizes, np.zeros(len(scale) - len(sizes))])
    seen = sizes > RANK_TOLERANCE * max(float(sizes.max(initial=0.0)), 1e-300)
    field = without_rigid(tip_jacobian * scale, tips)
    lost = np.linalg.svd(field @ right[~seen].T, compute_uv=False)
    blind = int((lost > FIELD_TOLERANCE * max(float(np.linalg.norm(field, axis=0).max(initial=0.0)), 1e-300)).sum())
    spread = (field @ right[seen].T) / sizes[seen]
    return (math.inf if blind else math.sqrt(float((spread**2).sum()) / len(tips))), blind
