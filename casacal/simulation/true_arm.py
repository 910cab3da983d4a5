"""What is true of a simulated arm: unknowns drawn from the prior, faces where the cell has them."""

from __future__ import annotations

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.instruments.instrument import Probe
from casacal.problem.problem import Problem
from casacal.unknowns import Unknown


def true_unknowns(problem: Problem, probe: Probe, error_scale: float, rng: np.random.Generator) -> dict[str, Array]:
    """Local coordinates of what moves the tip, drawn from the prior (flat: `start_std`) times `error_scale`."""
    own = problem.instrument.unknowns
    unknowns = {**problem.robot.parameters, **{key: own[key] for key in probe.moves}}
    return {key: error_scale * u.start_stds * rng.normal(size=u.size) for key, u in unknowns.items()}


def streams(seed: int, count: int) -> tuple[np.random.Generator, ...]:
    """Independent random numbers for each thing that is drawn; further ones leave the first as they are."""
    return tuple(np.random.default_rng(each) for each in np.random.SeedSequence(seed).spawn(count))


def plane_coordinates(plane: Unknown, nominal: Array, centre: Array, normal: Array) -> Array:
    """Local coordinates (3,) of a face about a nominal plane; none (0,) where the plane is held.

    centre: a point (3, mm) of the face; normal: its unit normal (3,), of either sign.
    """
    if not plane.size:
        return np.zeros(0)
    normal = normal if normal @ nominal[:3] > 0 else -normal
    raw = np.concatenate([normal, [normal @ (centre - nominal[9:12])]])
    return np.asarray(plane.raw_local(ca.DM(nominal), ca.DM(raw))).ravel()
