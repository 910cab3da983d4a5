"""Where a simulated arm could touch faces when their places are not stated."""

from __future__ import annotations

import numpy as np

from casacal.errors import SimulationError
from casacal.instruments.instrument import Probe
from casacal.problem.cell import Cell, corner
from casacal.problem.problem import Problem
from casacal.robots.joint_space import random_joints
from casacal.simulation.reach import Touch
from casacal.simulation.touches import try_touches
from casacal.simulation.true_arm import true_unknowns


def default_cell(problem: Problem) -> Cell:
    """Three faces at right angles where this arm touches them most readily; the same for the same problem.

    Raises SimulationError when no such place is found, as for arms that cannot point their plunger freely.
    """
    probe, rng = problem.instrument.probe, np.random.default_rng(0)
    if probe is None:
        raise SimulationError(
            f"{type(problem.instrument).__name__} touches no faces, so no place for them is looked for",
            "Simulate it without a cell",
        )
    nominal = true_unknowns(problem, probe, 0.0, rng)
    touch = Touch.of(problem.robot, problem.instrument, probe, nominal)
    tips = touch(random_joints(problem.robot, 400, rng), np.zeros(400))[0]
    base = np.median(tips, axis=0)
    reach = float(np.quantile(np.linalg.norm(tips - base, axis=1), 0.9))
    size = min(600.0, 0.4 * reach)
    best, best_share = None, 0.0
    for centre in tips[rng.choice(len(tips), 24, replace=False)]:
        away = (base - centre)[:2]
        faces = corner(centre, size=size, towards=away if np.linalg.norm(away) > 1e-6 else (-1.0, 0.0))
        cell = Cell(faces=faces)
        share = _share_reached(touch, probe, cell, np.random.default_rng(1))
        if share > best_share:
            best, best_share = cell, share
    if best is None or best_share < 0.1:
        raise SimulationError(
            f"No place was found where '{problem.robot.name}' can touch three faces at right angles",
            "Define `cell = Cell(faces=...)` in the problem file",
        )
    return best


def _share_reached(touch: Touch, probe: Probe, cell: Cell, rng: np.random.Generator) -> float:
    which = np.arange(30) % len(cell.faces)
    *_, good = try_touches(touch, probe, cell, which, np.zeros(30), [None] * len(cell.faces), rng)
    shares = [good[which == i].mean() for i in range(len(cell.faces))]
    return float(min(shares))
