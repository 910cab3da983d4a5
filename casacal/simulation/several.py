"""A simulated arm that several instruments measure: one truth, and a session of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields

from casacal.array_types import Array
from casacal.problem.cell import Cell
from casacal.problem.disturbances import Disturbances
from casacal.problem.problem import Problem
from casacal.samples.measurements import Measurements
from casacal.simulation.asked_rows import check_asked
from casacal.simulation.simulation import Simulation
from casacal.simulation.single import simulate_one
from casacal.simulation.true_arm import Draw
from casacal.values import FrozenMapping


def simulate_several(problem: Problem, cell: Disturbances | None, counts: Mapping[str, int], seed: int) -> Simulation:
    """Samples of every instrument on the same true arm; what they share is the same, too.

    Those that touch faces touch those of the cell. Raises SimulationError as `simulate` does, and for what only those
    that touch can be asked.
    """
    local: dict[str, Array] = {}
    frames: dict[str, Array] = {}
    parts: list[Simulation] = []
    for i, name in enumerate(problem.names):
        alone = problem.measured_by(name)
        names = {key: key for key in problem.robot.parameters} | dict(problem.full_names[i])
        known = {key: local[full] for key, full in names.items() if full in local}
        own = cell if alone.instrument.probe is not None else _elsewhere(alone, cell)
        part = simulate_one(alone, own, counts[name], Draw(seed, i, FrozenMapping(known)))
        parts.append(part)
        for of_part, of_all in ((part.local, local), (part.frames, frames)):
            for key, value in of_part.items():
                head, dot, label = key.partition(".")
                of_all.setdefault(names[head] + dot + label, value)
    sets = tuple(part.samples for part in parts)
    touched = next((part.cell for part in parts if isinstance(part.cell, Cell)), parts[0].cell)
    together, true = Measurements(problem.names, sets), FrozenMapping(frames)
    return Simulation(problem, together, FrozenMapping(local), touched, seed, frames=true, parts=tuple(parts))


def _elsewhere(alone: Problem, cell: Disturbances | None) -> Disturbances | None:
    """What disturbs an instrument that touches no faces, in the cell of those that do."""
    if not isinstance(cell, Cell):
        return cell
    check_asked(alone, cell)
    return Disturbances(**{field.name: getattr(cell, field.name) for field in fields(Disturbances)})
