"""What is asked of rows that a residual fits: their noise, their labels, and what only touches have."""

from __future__ import annotations

import numpy as np

from casacal.array_types import Array
from casacal.errors import SimulationError
from casacal.problem.cell import OF_TOUCHES, Cell
from casacal.problem.disturbances import Disturbances
from casacal.problem.problem import Problem
from casacal.tables.columns import Labels

LABELS = ("1", "2", "3")
"""Labels of simulated rows where neither the instrument nor a cell names any."""


def own_noise(problem: Problem) -> Array | float:
    """Standard deviation of each component of the residual by itself."""
    instrument = problem.instrument
    if said := next((block.name for block in instrument.blocks if isinstance(block.std, str)), ""):
        raise SimulationError(
            f"The noise of '{said}' comes from a column, which simulated rows do not have", "Declare it as a number"
        )
    stds = [float(block.std) for block in instrument.blocks for _ in range(block.size)]
    return np.array(stds) if stds else instrument.residual_std


def check_asked(problem: Problem, cell: Disturbances) -> None:
    """Raise SimulationError where a cell asks for what only touches of faces have."""
    plain = Cell(faces=cell.faces) if isinstance(cell, Cell) else cell
    own = [name for name in OF_TOUCHES if getattr(cell, name, None) != getattr(plain, name, None)]
    if own:
        raise SimulationError(
            f"The cell has {own[0]}, and {type(problem.instrument).__name__} touches no faces that the simulator knows",
            "Leave it out, or ask it of an instrument that touches faces",
        )


def row_labels(problem: Problem, cell: Disturbances, samples: int) -> dict[str, Labels]:
    """Labels of the rows, in turn: those that the instrument knows, the cell's faces, or 1, 2, 3."""
    instrument, turn, found = problem.instrument, np.arange(samples), {}
    for column in problem.layout().labels:
        known = instrument.known_columns.values() if instrument.known_by == column else ()
        names = tuple(dict.fromkeys(label for values in known for label in values))
        if isinstance(cell, Cell):
            names = names or tuple(face.label for face in cell.faces)
        names = names or LABELS
        found[column] = Labels(names, turn % len(names))
        turn //= len(names)  # each label of one column meets each of the next
    return found
