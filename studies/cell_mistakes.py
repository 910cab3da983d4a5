"""Mistakes that people make in a cell, planted one at a time into simulated samples of any robot with a dial."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from casacal import Cell, DialOnPlane, Problem, Samples, bind, load_problem, simulate, tool_point
from casacal.data.columns import Labels
from casacal.fit import BoundProblem
from casacal.simulation import Simulation
from casacal.uncertainty.tip_error import tip_rms, without_rigid, workspace_joints
from studies.reporting import PROBLEMS

SHIFT = 5.0
"""How far the tool is from where it is said to be, mm."""
DRIFT = 0.3
"""Drift of the readings from the first row to the last, mm."""
LEAD = 20.0
"""A SCARA's quill comes down by so much as it turns once, mm, unless its controller makes up for it."""
WRONG_LABELS = 3
NONE = "none"
UPRIGHT = "adept_cobra600"
"""A SCARA: no joint of it carries a weight, so that it has no compliance."""


def robots() -> dict[str, tuple[Problem, Cell]]:
    """Four arms with a dial: the paper's, a UR5, one of seven axes, a SCARA."""
    found = {name: load_problem(PROBLEMS / name) for name in ("hsr_jr680", "ur5", "kuka_iiwa14", "adept_cobra600")}
    cases = {name: (source.problem, source.cell) for name, source in found.items()}
    arm, cell = cases["kuka_iiwa14"]
    dial = DialOnPlane(noise_std=0.01, sign=-1, tool=tool_point(0, 0, 100, prior_std=1.0))
    return {**cases, "kuka_iiwa14": (Problem(arm.robot, dial), cell)}


def fit_for(name: str, sizes: Mapping[str, Any]) -> dict[str, Any]:
    """Those changes of a cell that a robot can have."""
    return {key: size for key, size in sizes.items() if key != "compliance" or name != UPRIGHT}


def with_travel(problem: Problem, travel: float) -> Problem:
    """The problem with another dial."""
    return problem.with_settings({"travel": travel})


def with_tool_elsewhere(problem: Problem, rng: np.random.Generator) -> Problem:
    """What is true where the tool stands elsewhere than said; a SCARA's moves sideways, which touches can tell."""
    tool = problem.instrument.unknowns["tool"]
    step = rng.normal(size=3) * ([1, 1, 0] if not problem.robot.revolute.all() else [1, 1, 1])
    moved = tuple(np.asarray(tool.values) + SHIFT * step / np.linalg.norm(step))
    return Problem(problem.robot, dataclasses.replace(problem.instrument, tool=dataclasses.replace(tool, values=moved)))


def readings(samples: Samples, change: Callable[[np.ndarray], np.ndarray]) -> Samples:
    """The samples with other readings."""
    changed = change(samples.columns["reading"].copy())
    return dataclasses.replace(samples, columns={**samples.columns, "reading": changed})


def moved(samples: Samples, matrix: np.ndarray) -> Samples:
    """The samples with joint values that were mixed up."""
    return dataclasses.replace(samples, joints=samples.joints @ matrix.T)


def first_face_the_other_way(problem: Problem, samples: Samples) -> Samples:
    """The dial read from the other end of its travel on one face."""
    first, travel = samples.faces(problem.instrument.groups).codes == 0, problem.instrument.travel
    return readings(samples, lambda reading: np.where(first, travel - reading, reading))


def a_lost_turn(problem: Problem, samples: Samples, rng: np.random.Generator) -> Samples:
    """One turn of the pointer miscounted in one row."""
    row, travel = int(rng.integers(len(samples))), problem.instrument.travel
    turn = 1.0 if travel >= 10 else 0.5

    def change(reading: np.ndarray) -> np.ndarray:
        reading[row] += turn if reading[row] + turn <= travel else -turn
        return np.clip(reading, 0, travel)

    return readings(samples, change)


def swapped(problem: Problem, samples: Samples, rng: np.random.Generator) -> Samples:
    """Two neighbouring columns of joints in each other's place."""
    turning = np.flatnonzero(problem.robot.revolute)
    k = int(rng.integers(len(turning) - 1))
    order = np.arange(len(problem.robot.axes))
    order[[turning[k], turning[k + 1]]] = order[[turning[k + 1], turning[k]]]
    return moved(samples, np.eye(len(order))[order])


def coupled(problem: Problem, samples: Samples) -> Samples:
    """Joint 3 as the motor counts it, not as it stands: joint 2 drives it along, or the quill's spindle does."""
    matrix = np.eye(len(problem.robot.axes))
    if problem.robot.revolute.all():
        matrix[2, 1] = -1.0
    else:
        matrix[2, 3] = -LEAD / (2 * math.pi)
    return moved(samples, matrix)


def mislabelled(problem: Problem, samples: Samples, rng: np.random.Generator) -> Samples:
    """A few rows under the name of another face."""
    column = problem.instrument.groups
    names = list(samples.faces(column))
    known = sorted(set(names))
    for row in rng.choice(len(names), WRONG_LABELS, replace=False):
        names[row] = known[(known.index(names[row]) + 1) % len(known)]
    return dataclasses.replace(samples, labels={**samples.labels, column: Labels.of(names)})


MISTAKES: dict[str, tuple[str, ...]] = {
    NONE: (),
    "sign of the dial": ("wrong dial sign",),
    "sign on one face": ("dial sign of",),
    "a lost turn in one row": ("lost revolution",),
    "radians as degrees": ("unit of the joints",),
    "inches as mm": ("unit of the readings",),
    "joints swapped": ("swapped",),
    "tool elsewhere": ("tool elsewhere", "tool offset"),
    "coupling missing": ("coupled",),
    "three wrong labels": ("labels exchanged",),
    "drift": ("drift",),
}
"""What casacal should say of each: one of these in the verdict or its reasons."""


def planted(mistake: str, problem: Problem, samples: Samples, rng: np.random.Generator) -> tuple[Problem, Samples]:
    """Problem and samples as somebody has them who made the mistake; the tool's is in how they were simulated."""
    count, turning = len(samples), problem.robot.revolute
    if mistake == "sign of the dial":
        return problem.with_settings({"sign": -problem.instrument.sign}), samples
    others: dict[str, Callable[[], Samples]] = {
        "sign on one face": lambda: first_face_the_other_way(problem, samples),
        "a lost turn in one row": lambda: a_lost_turn(problem, samples, rng),
        "radians as degrees": lambda: moved(samples, np.diag(np.where(turning, math.pi / 180, 1.0))),
        "inches as mm": lambda: readings(samples, lambda reading: reading / 25.4),
        "joints swapped": lambda: swapped(problem, samples, rng),
        "coupling missing": lambda: coupled(problem, samples),
        "three wrong labels": lambda: mislabelled(problem, samples, rng),
        "drift": lambda: readings(samples, lambda reading: reading + DRIFT * np.arange(count) / count),
    }
    return problem, others[mistake]() if mistake in others else samples


def simulated(
    problem: Problem, cell: Cell, mistake: str, samples: int, seed: int
) -> tuple[Simulation, Problem, Samples]:
    """A true arm's touches, and problem and samples with a mistake."""
    rng = np.random.default_rng(seed)
    true = with_tool_elsewhere(problem, rng) if mistake == "tool elsewhere" else problem
    made = simulate(true, cell, samples=samples, seed=seed)
    return made, *planted(mistake, problem, made.samples, rng)


def tip_errors(made: Simulation, estimates: dict[str, tuple[BoundProblem, np.ndarray]]) -> dict[str, float]:
    """True tip error (mm RMS over the workspace, apart from where the base stands) of several estimates."""
    joints, bound = workspace_joints(made.problem.robot), bind(made.problem, made.samples)
    right = bound.tips(made.truth(bound), joints)
    return {
        name: tip_rms(without_rigid((problem.tips(x, joints) - right).ravel(), right))
        for name, (problem, x) in estimates.items()
    }
