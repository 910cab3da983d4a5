"""The flange's own error to expect: what the calibrated arm owes any tool, apart from where the tool's tip is."""

from __future__ import annotations

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.marginal import Marginal, Seen
from casacal.uncertainty.bounds import bayesian_bound
from casacal.uncertainty.workspace import workspace_joints


def flange_accuracy(bound: Seen, x: Array, off: Array | None = None) -> tuple[float, float]:
    """Error of the flange's origin (mm RMS over the workspace) at x (n,): from priors alone, and with the rows.

    Apart from where the base stands, as the tip's error of `expected_accuracy`; `off` as there.
    """
    joints = workspace_joints(bound.problem.robot)
    points, slopes = _flange_jacobian(bound, x, joints)
    information = bound.information(x if off is None else x + off)
    before = bayesian_bound(np.zeros_like(information), bound.prior_std, slopes, points)
    return before, bayesian_bound(information, bound.prior_std, slopes, points, off)


def _flange_jacobian(bound: Seen, x: Array, joints: Array) -> tuple[Array, Array]:
    """Flange origins (N, 3; mm) at joint values (N, n; rad, mm), and their derivative (3 N, n) by x."""
    whole: BoundProblem = bound.whole if isinstance(bound, Marginal) else bound
    everything = bound.expand(x) if isinstance(bound, Marginal) else x
    places = bound.shared if isinstance(bound, Marginal) else np.arange(x.size)
    block = whole.blocks[0]
    points, slopes = block.posture("flange_jacobian", everything, joints)
    _, inside, seen = np.intersect1d(places, block.columns[0], return_indices=True)
    jacobian = np.zeros((3 * len(joints), x.size))
    jacobian[:, inside] = slopes.reshape(len(jacobian), -1)[:, seen]
    return np.asarray(points), jacobian
