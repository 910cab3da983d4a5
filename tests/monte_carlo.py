"""One trial of the simulated corner, for process pools: every method on the same truth, poses and noise."""

from pathlib import Path

import numpy as np

from casacal import bind, ekf, ipopt, lm, load_problem, sckf, sckf_lm, simulate
from casacal.uncertainty.figures import nees
from casacal.uncertainty.tip_error import bayesian_bound, tip_rms, tip_stds, without_rigid, workspace_joints

METHODS = {"lm": lm, "sckf": sckf, "sckf_lm": sckf_lm, "ekf": ekf, "ipopt": ipopt}
ROOT = Path(__file__).parent.parent
ARM = slice(0, 24)
_SOURCE = load_problem(ROOT / "problems" / "hsr_jr680")
_JOINTS = workspace_joints(_SOURCE.problem.robot)


def trial(seed, methods):
    """By method: cost, tip error, its bound, NEES of the arm, NIS of the last third, convergence, coverage."""
    simulation = simulate(_SOURCE.problem, _SOURCE.cell, seed=seed)
    bound = bind(_SOURCE.problem, simulation.samples)
    truth = simulation.truth(bound)
    tips = bound.tips(truth, _JOINTS)
    best = bayesian_bound(
        bound.normal(truth).information, bound.prior_information, bound.tip_jacobian(truth, _JOINTS), tips
    )
    found = {}
    for name in methods:
        result = METHODS[name](bound)
        error = tip_rms(without_rigid((bound.tips(result.x, _JOINTS) - tips).ravel(), tips))
        covariance = result.covariance[ARM, ARM]
        nis = np.nan
        if "innovation" in result.trace:
            whitened = result.trace["innovation"] / result.trace["innovation_std"]
            nis = float(np.mean(whitened[2 * len(whitened) // 3 :] ** 2))
        field = without_rigid((bound.tips(result.x, _JOINTS) - tips).ravel(), tips)
        stds = tip_stds(result.covariance, without_rigid(bound.tip_jacobian(result.x, _JOINTS), tips)).ravel()
        covered = float(np.mean(np.abs(field) < 1.96 * stds))
        consistency = nees((result.x - truth)[ARM], covariance)
        found[name] = (result.cost, error, best, consistency, nis, result.converged, covered)
    return found
