"""Samples of a simulated arm, with the truth behind them: touches of faces, or rows that any residual fits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from casacal.errors import SimulationError, came
from casacal.problem.disturbances import Disturbances
from casacal.problem.problem import Problem
from casacal.simulation.several import simulate_several
from casacal.simulation.simulation import Simulation
from casacal.simulation.single import simulate_one
from casacal.simulation.true_arm import Draw

MOST_SAMPLES = 1_000_000
"""Rows beyond which drawing postures takes hours."""


def simulate(
    problem: Problem,
    cell: Disturbances | None = None,
    *,
    samples: int | Mapping[str, int] = 120,
    seed: int = 0,
) -> Simulation:
    """Draw a true arm from the prior and let its instruments measure.

    An instrument that touches faces (`Instrument.probe`) touches those of a cell: the true tip, at joint values inside
    the limits, within the travel of the dial. Any other instrument measures in random postures: its columns, and where
    it reads none the joints, take the values at which its residual vanishes. What is recorded are the joint values
    without sag, backlash and repeatability, and the readings with their faults.

    Args:
        problem: a robot with its instruments; what they share is the same for all.
        cell: what surrounds and disturbs it; by default `default_cell(problem)` where faces are touched.
        samples: rows, shared evenly between the faces, or between the labels; of several instruments each has so
            many, or as many as stand by its name.
        seed: of every random number drawn here.

    Returns:
        The samples (rows in mm and rad), and the truth behind them: `truth(bound)` is the true x (n,) of a bound
        problem.

    Raises SimulationError when it cannot be measured as asked.

    """
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise SimulationError(f"The seed is {seed!r}", "Give a whole number from zero on")
    if not isinstance(problem, Problem):
        raise SimulationError(
            f"{came(problem)} came as the problem", "Give a Problem; load_problem(path).problem is one"
        )
    if cell is not None and not isinstance(cell, Disturbances):
        raise SimulationError(f"{came(cell)} came as the cell", "Give a Cell(faces=...), or Disturbances(...)")
    counts = _counts(problem, samples)
    if len(problem.instruments) > 1:
        return simulate_several(problem, cell, counts, int(seed))
    return simulate_one(problem, cell, counts[problem.names[0]], Draw(int(seed)))


def _counts(problem: Problem, samples: int | Mapping[str, int]) -> dict[str, int]:
    """How many rows each instrument takes."""
    if isinstance(samples, Mapping):
        for name in samples:
            problem.number(name)
        if missing := [name for name in problem.names if name not in samples]:
            raise SimulationError(f"How many samples of the {missing[0]} was not said", f"Say it: {missing[0]}=120")
    counts = {name: samples[name] if isinstance(samples, Mapping) else samples for name in problem.names}
    for count in counts.values():
        if not isinstance(count, (int, np.integer)) or not 1 <= count <= MOST_SAMPLES:
            fix = f"Ask for at least one, at most {MOST_SAMPLES:,}"
            raise SimulationError(f"{count} samples were asked for", fix)
    return {name: int(count) for name, count in counts.items()}
