"""Problems whose arm is known less well: what studies of basins and of large errors start from."""

import dataclasses

from casacal import DialOnPlane, Problem


def widened(problem: Problem, factor: float) -> Problem:
    """The problem with `factor` times its priors, and planes that may stand so much farther from where they seem."""
    stds = {key: factor * float(unknown.prior_stds[0]) for key, unknown in problem.robot.parameters.items()}
    wider = problem.with_prior(stds)
    (dial,) = wider.instruments
    if not isinstance(dial, DialOnPlane):
        raise TypeError("only problems with one dial are widened")
    tilt, offset = dial.plane.start_std
    plane = dataclasses.replace(dial.plane, start_std=(factor * tilt, factor * offset))
    return Problem(wider.robot, dataclasses.replace(dial, plane=plane))
