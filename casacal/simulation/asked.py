"""What a simulation is asked for: how many samples of each instrument, or in which postures."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from casacal.errors import SamplesError, SimulationError, came
from casacal.problem.problem import Problem
from casacal.samples.layout import Layout
from casacal.samples.samples import Samples

ROUNDED = 1e-5  # rad or mm by which postures of a file may be beyond a joint's limit
MOST_SAMPLES = 1_000_000  # rows beyond which drawing postures takes hours


def postures_of(problem: Problem, samples: Samples) -> Samples:
    """Postures of an only instrument, inside the joint limits.

    Raises ProblemError of several, SamplesError without the joints and labels that it takes.
    """
    _ = problem.instrument
    layout, robot = problem.layout(), problem.robot
    samples.check(Layout(layout.joints, {}, layout.labels))
    _check_count(len(samples))
    lower, upper = robot.limits
    beyond = np.maximum(lower - samples.joints, samples.joints - upper) > ROUNDED
    if beyond.any():
        k, j = map(int, np.argwhere(beyond)[0])
        factor, unit = (180 / math.pi, "degrees") if robot.revolute[j] else (1.0, "mm")
        raise SamplesError(
            samples.file,
            f"joint {j + 1} stands at {factor * samples.joints[k, j]:.6g} {unit}, outside its limits "
            f"{factor * lower[j]:g} to {factor * upper[j]:g}",
            "Leave the posture out, or mend the limits of the robot",
            line=int(samples.lines[k]),
        )
    return samples


def counts_of(problem: Problem, samples: int | Mapping[str, int]) -> dict[str, int]:
    """How many rows each instrument takes."""
    if isinstance(samples, Mapping):
        for name in samples:
            problem.number(name)
        if missing := [name for name in problem.names if name not in samples]:
            raise SimulationError(f"How many samples of the {missing[0]} was not said", f"Say it: {missing[0]}=120")
    counts = {name: samples[name] if isinstance(samples, Mapping) else samples for name in problem.names}
    for count in counts.values():
        _check_count(count)
    return {name: int(count) for name, count in counts.items()}


def _check_count(count: object) -> None:
    """Raise SimulationError unless so many samples can be simulated."""
    if not isinstance(count, (int, np.integer)):
        fix = "Give a number, numbers by the name of the instrument, or the postures of a plan: plan.samples"
        raise SimulationError(f"Got {came(count)} as the samples", fix)
    if not 1 <= count <= MOST_SAMPLES:
        fix = f"Ask for at least one, at most {MOST_SAMPLES:,}"
        raise SimulationError(f"{count} samples were asked for", fix)
