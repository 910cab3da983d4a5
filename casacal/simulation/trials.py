"""Trials of a study in a simulated cell: an arm drawn from the prior touches faces, and the truth judges."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from casacal.errors import StudyError
from casacal.fit.bound_problem import BoundProblem, bind
from casacal.fit.least_squares import Result
from casacal.model.problem import Problem
from casacal.simulation.cell import Disturbances
from casacal.simulation.simulate import simulate
from casacal.uncertainty.figures import nees, residual_figures
from casacal.uncertainty.tip_error import bayesian_bound, tip_rms, tip_stds, up_to_base, without_rigid, workspace_joints
from casacal.values import Array

Z95 = 1.959963984540054  # half width of a 95 % interval in standard deviations


@dataclass(frozen=True)
class SimulatedTrial:
    """One arm, its touches and its truth; every method of the trial sees the same."""

    problem: BoundProblem
    heldout: BoundProblem
    truth: Array  # true x (n,) of the problem

    def judge(self, result: Result) -> dict[str, float]:
        """Figures of merit of a result, from its x and covariance alone.

        cost: the objective. fit_rmse_mm, heldout_*_mm: distances from the fitted planes. tip_*_mm: length of the true
        tip error over the workspace, apart from the pose of the base. bound_mm: the Bayesian bound of
        tip_rms_mm. nees: of the arm's unknowns, per unknown. coverage: share of tip errors, axis by axis, inside their
        95 % intervals.
        """
        problem, x = self.problem, result.x
        joints, true, bound = self._workspace
        field = without_rigid((problem.tips(x, joints) - true).ravel(), true)
        lengths = np.linalg.norm(field.reshape(-1, 3), axis=1)
        stds = tip_stds(result.covariance, without_rigid(problem.tip_jacobian(x, joints), true)).ravel()
        heldout, arm = residual_figures(self.heldout.plain_residual(x)), ~problem.datum
        own = result.covariance[np.ix_(arm, arm)]
        bounded = bool(np.isfinite(own).all())
        return {
            "cost": problem.cost(x),
            "fit_rmse_mm": residual_figures(problem.plain_residual(x))["rmse_mm"],
            **{f"heldout_{name}": value for name, value in heldout.items()},
            "tip_rms_mm": tip_rms(field),
            "tip_p95_mm": float(np.quantile(lengths, 0.95)),
            "tip_max_mm": float(lengths.max()),
            "bound_mm": bound,
            "nees": nees((x - self.truth)[arm], own) / int(arm.sum()) if bounded else float("nan"),
            "coverage": float(np.mean(np.abs(field) < Z95 * stds)),
        }

    def detail(self, result: Result) -> dict[str, Any]:
        """Detail of the first trial: estimate and spread by name, tip errors at held-out touches."""
        touches = self.heldout.block.samples
        joints, true, _ = self._workspace
        tips = self.problem.tips(result.x, joints)
        at, at_true = (self.problem.tips(x, touches.joints) for x in (result.x, self.truth))
        field = up_to_base((at - at_true).ravel(), at_true, (tips - true).ravel(), true)
        return {
            "names": list(self.problem.names),
            "x": result.x.tolist(),
            "std": result.std.tolist(),
            "truth": self.truth.tolist(),
            "heldout_tip_mm": np.linalg.norm(field.reshape(-1, 3), axis=1).tolist(),
        }

    @cached_property
    def _workspace(self) -> tuple[Array, Array, float]:
        """Joint values, true tips and the Bayesian bound over the workspace: the same for all methods."""
        problem = self.problem
        joints = workspace_joints(problem.problem.robot)
        true, slopes = problem.tips(self.truth, joints), problem.tip_jacobian(self.truth, joints)
        return joints, true, bayesian_bound(problem.information(self.truth), problem.prior_information, slopes, true)


@dataclass(frozen=True)
class Simulated:
    """A setting of a study: a problem in a simulated cell.

    problem: what is true, with one instrument; its prior is what true errors are drawn from. cell: what it touches, and
    what disturbs the arm without being in its model; by default as `simulate` has it. samples: touches of a trial.
    heldout: how many of them, the last ones, are not fitted but judged. fitted: what is assumed, with the same
    unknowns; by default the problem itself.
    Raises StudyError when nothing would be left to fit.
    """

    problem: Problem
    cell: Disturbances | None = None
    samples: int = 120
    heldout: int = 35
    fitted: Problem | None = None

    def __post_init__(self) -> None:
        if not 0 < self.heldout < self.samples:
            fix = "Hold some out and fit the rest"
            raise StudyError(f"{self.heldout} of {self.samples} samples of a setting are held out", fix)

    def trial(self, seed: int) -> SimulatedTrial:
        """One simulated arm and its touches; the same for the same seed."""
        simulation = simulate(self.problem, self.cell, samples=self.samples, seed=seed)
        rows = np.arange(self.samples)
        fit = bind(self.fitted or self.problem, simulation.samples.take(rows[: -self.heldout]))
        return SimulatedTrial(fit, fit.on(simulation.samples.take(rows[-self.heldout :])), simulation.truth(fit))
