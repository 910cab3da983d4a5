"""The touches among which a plan chooses: what the arm as drawn can make, and keeps clear as it does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casacal.binding.nominal import nominal_tips
from casacal.errors import CasacalError
from casacal.planning.clearance import Clearance
from casacal.problem.cell import Cell
from casacal.problem.disturbances import Disturbances
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples, joined
from casacal.simulation.places import default_cell
from casacal.simulation.simulate import simulate

ROUNDS = 20
"""Times that more touches are drawn where some do not keep clear."""

RARE = 0.05
"""Part of all that must keep clear, or a plan makes no sense."""


def cell_of(problem: Problem, cell: Disturbances | None) -> Disturbances:
    """The cell without anything that disturbs; where none is given, that of `simulate`."""
    if cell is None and problem.instrument.probe is not None:
        cell = default_cell(problem)
    still = Disturbances()
    if isinstance(cell, Cell):
        still = Cell(faces=cell.faces, tilt=cell.tilt, travel=cell.travel)
    return replace(still, error_scale=0.0, repeatability=0.0, resolution=0.0)


def pool_of(
    problem: Problem, cell: Disturbances | None, count: int, seed: int, clearance: Clearance | None = None
) -> Samples:
    """Touches that the arm as drawn could make, without any error.

    Raises SimulationError where faces are out of reach, CasacalError where hardly a touch keeps clear.
    """
    still = cell_of(problem, cell)
    if clearance is None:
        return simulate(problem, still, samples=count, seed=seed).samples
    found: Samples | None = None
    tried = 0
    for k in range(ROUNDS):
        drawn = simulate(problem, still, samples=count, seed=seed if k == 0 else seed + 7919 * k).samples
        faces = still if isinstance(still, Cell) else None
        good = np.flatnonzero(clearance.clear(problem.robot, faces, drawn.joints, nominal_tips(problem, 0, drawn)))
        tried += count
        some = drawn.take(good)
        found = some if found is None else joined(found, some)
        if len(found) >= count:
            return found.take(range(count))
        if len(found) < RARE * tried:
            break
    assert found is not None
    raise CasacalError(
        f"Only {len(found)} of {tried} reachable touches keep clear of boxes, faces and the arm itself",
        "Make the boxes or --link-radius smaller, move the faces, or ignore the shapes of the URDF (--ignore-shapes)",
    )
