"""Priors for those who have none: where the defaults come from, and how to scale them to a maker's accuracy.

A `Parameter` without `prior_std` gets 0.7 mm or 1 mrad, by its unit: what machining and assembly leave of the lengths
and zero offsets of an industrial arm (0.3 to 1 mm, 0.5 to 2 mrad), a few millimetres at the tip. Who knows the absolute
accuracy that the maker states scales all of them so that they predict just that.
"""

from __future__ import annotations

import math

import numpy as np

from casacal.errors import ProblemError
from casacal.problem.problem import Problem
from casacal.uncertainty.workspace import without_rigid, workspace_joints


def prior_tip_rms(problem: Problem) -> float:
    """Tip error (mm RMS over the workspace) that the priors of the arm's parameters predict.

    Apart from where the base stands. The instrument's own unknowns, such as its tool, do not count; flat priors make
    it infinite.
    """
    model, joints = problem.models[0], workspace_joints(problem.robot)
    z = np.zeros(model.tip_jacobian.numel_in(0))
    data = np.zeros((len(joints), model.tip_jacobian.numel_in(2)))
    data[:, : joints.shape[1]] = joints
    tips, slopes = model.batch.tip_jacobian(z, np.zeros(model.tip_jacobian.numel_in(1)), data)
    arm = sum(unknown.size for unknown in problem.robot.parameters.values())
    field = without_rigid(slopes.reshape(3 * len(joints), -1)[:, :arm], tips)
    stds = np.concatenate([unknown.prior_stds for unknown in problem.robot.parameters.values()] or [np.zeros(0)])
    if not np.isfinite(stds).all():
        return math.inf
    return math.sqrt(float(((field * stds) ** 2).sum()) / len(tips))


def scaled_to_accuracy(problem: Problem, accuracy: float) -> Problem:
    """Copy whose arm priors, all scaled alike, predict a tip error of `accuracy` mm RMS, as the maker states it.

    Raises ProblemError unless the accuracy is positive and the priors are finite and move the tip.
    """
    if not 0 < accuracy < math.inf:
        raise ProblemError(f"The maker's accuracy is {accuracy:g} mm", "Give a positive number of mm")
    present = prior_tip_rms(problem)
    if not 0 < present < math.inf:
        raise ProblemError(
            f"The arm's priors predict a tip error of {present:g} mm", "Give finite priors before scaling them"
        )
    factor = accuracy / present
    stds = {
        name: factor * float(std)
        for key, unknown in problem.robot.parameters.items()
        for name, std in zip(unknown.names(key), unknown.prior_stds, strict=True)
    }
    return problem.with_prior(stds)
