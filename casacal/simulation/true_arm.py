"""The true arm of a simulation, and rows that were asked for rather than drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import SimulationError
from casacal.instruments.description import Probe
from casacal.problem.problem import Problem
from casacal.simulation.cell import OF_TOUCHES, Cell, Disturbances
from casacal.tables.columns import Labels
from casacal.unknowns import Unknown

LABELS = ("1", "2", "3")  # labels of simulated rows where neither the instrument nor a cell names any


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
    turn, found = np.arange(samples), {}
    for column in problem.layout().labels:
        names = label_names(problem, cell, column)
        found[column] = Labels(names, turn % len(names))
        turn //= len(names)  # each label of one column meets each of the next
    return found


def label_names(problem: Problem, cell: Disturbances, column: str) -> tuple[str, ...]:
    """Labels that a column of simulated rows has; what bears the first of them stands in the first place, and so on."""
    instrument = problem.instrument
    known = instrument.known_columns.values() if instrument.known_by == column else ()
    names = tuple(dict.fromkeys(label for values in known for label in values))
    if isinstance(cell, Cell):
        names = names or tuple(face.label for face in cell.faces)
    return names or LABELS


def true_unknowns(problem: Problem, probe: Probe, error_scale: float, rng: np.random.Generator) -> dict[str, Array]:
    """Local coordinates of what moves the tip, drawn from the prior (flat: `start_std`) times `error_scale`."""
    own = problem.instrument.unknowns
    unknowns = {**problem.robot.parameters, **{key: own[key] for key in probe.moves}}
    return {key: error_scale * u.start_stds * rng.normal(size=u.size) for key, u in unknowns.items()}


@dataclass(frozen=True)
class Draw:
    """What is drawn at random: an arm by its seed, and one of several sessions in which it is measured.

    known: true local coordinates that stand already, by key, such as those of the same arm in another session.
    nominals: the same of nominal values, where others than those of a simulation are meant.
    """

    seed: int
    session: int = 0
    known: Mapping[str, Array] = field(default_factory=dict)
    nominals: Mapping[str, Array] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Stands for the file of such samples."""
        return f"simulated-{self.seed}" + (f"-{self.session + 1}" if self.session else "")

    def streams(self, count: int, of_the_arm: Sequence[int]) -> tuple[np.random.Generator, ...]:
        """Independent random numbers for each thing that is drawn; further ones leave the first as they are.

        Those of the arm are the same in every session.
        """
        arm = np.random.SeedSequence(self.seed).spawn(count)
        here = np.random.SeedSequence((self.seed, self.session)).spawn(count) if self.session else arm
        return tuple(np.random.default_rng(arm[k] if k in of_the_arm else here[k]) for k in range(count))

    def true(self, drawn: Mapping[str, Array]) -> dict[str, Array]:
        """Local coordinates as they were drawn, but for those that stand."""
        return {key: np.asarray(self.known.get(key, values)) for key, values in drawn.items()}


def frame_coordinates(frame: Unknown, nominal: Array, matrix: Array) -> Array:
    """Local coordinates (6,) of a true transform (4, 4; mm) about a nominal frame."""
    from scipy.spatial.transform import Rotation

    turn = nominal[:9].reshape(3, 3) @ matrix[:3, :3]  # the nominal rotation, column by column, is transposed so
    quaternion = np.roll(Rotation.from_matrix(turn).as_quat(canonical=True), 1)
    raw = np.concatenate([quaternion, matrix[:3, 3] - nominal[9:12]])
    return np.asarray(frame.raw_local(ca.DM(nominal), ca.DM(raw))).ravel()


def plane_coordinates(plane: Unknown, nominal: Array, centre: Array, normal: Array) -> Array:
    """Local coordinates (3,) of a face about a nominal plane; none (0,) where the plane is held.

    centre: a point (3, mm) of the face; normal: its unit normal (3,), of either sign.
    """
    if not plane.size:
        return np.zeros(0)
    normal = normal if normal @ nominal[:3] > 0 else -normal
    raw = np.concatenate([normal, [normal @ (centre - nominal[9:12])]])
    return np.asarray(plane.raw_local(ca.DM(nominal), ca.DM(raw))).ravel()
