"""One instrument on a simulated arm: touches of faces, or rows that any residual fits."""

from __future__ import annotations

from casacal.errors import SimulationError
from casacal.problem.cell import Cell
from casacal.problem.disturbances import Disturbances
from casacal.problem.problem import Problem
from casacal.samples.measurements import Measurements
from casacal.simulation.places import default_cell
from casacal.simulation.rows import fitting_rows
from casacal.simulation.session import touched_rows
from casacal.simulation.simulation import Simulation
from casacal.simulation.true_arm import Draw
from casacal.values import FrozenMapping


def simulate_one(problem: Problem, cell: Disturbances | None, samples: int, draw: Draw) -> Simulation:
    """Samples of a problem with one instrument; raises SimulationError when it cannot be measured as asked."""
    instrument = problem.instrument
    if instrument.probe is None:
        cell = Disturbances() if cell is None else cell
        rows, truth, arm = fitting_rows(problem, cell, samples, draw)
        true, frames = FrozenMapping(truth.local), FrozenMapping(truth.frames)
        return Simulation(problem, Measurements.of(rows), true, cell, draw.seed, arm, frames=frames)
    cell = default_cell(problem) if cell is None else cell
    if not isinstance(cell, Cell):
        raise SimulationError(
            f"{type(instrument).__name__} touches faces, and the disturbances that came have none",
            "Give a Cell(faces=...)",
        )
    rows, local, arm, dial = touched_rows(problem, instrument, instrument.probe, cell, samples, draw)
    return Simulation(problem, Measurements.of(rows), FrozenMapping(local), cell, draw.seed, arm, dial)
