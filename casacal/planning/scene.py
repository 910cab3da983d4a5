"""An arm in its cell as numbers, for whoever draws it in space: rods, faces, boxes, table, ways of approach."""

from __future__ import annotations

from typing import Any

import numpy as np

from casacal.data.samples import Samples
from casacal.fit.nominal import nominal_tips
from casacal.model.capsules import radii_of
from casacal.model.problem import Problem
from casacal.planning.clearance import Clearance, drawn_touch
from casacal.simulation.cell import Disturbances

DRAWN = 12.0  # radius of links of which nothing is known, mm
PLACES = 2  # decimals of places, mm


def scene(problem: Problem, cell: Disturbances | None, clearance: Clearance, samples: Samples) -> dict[str, Any]:
    """Places of everything, mm in the base frame, in JSON's own types.

    `table`: its height, or None. `reach`: of the arm. `radii`: of its rods. `solids`: boxes and faces, each with name,
    centre, axes (rows) and size, and whether it is touched. `arms`: of each row the nodes between rods, the tip last,
    and the direction of the plunger, from the tool to the face; None where there is none.
    """
    around = clearance.around(problem.robot, cell)
    place, tips = around.skeleton.place, nominal_tips(problem, 0, samples)
    nodes = tips[:, None] if place is None else np.concatenate([place(samples.joints), tips[:, None]], axis=1)
    probe = problem.instrument.probe
    plungers = None if probe is None else drawn_touch(problem, probe, samples)[3]
    solids = [
        {
            "name": solid.name.removeprefix("face ").strip("'"),
            "touched": solid.touched,
            "centre": np.round(solid.origin + (solid.low + solid.high) / 2 @ solid.axes, PLACES).tolist(),
            "axes": solid.axes.tolist(),
            "size": (solid.high - solid.low).tolist(),
        }
        for solid in around.solids
    ]
    arms = [
        {
            "nodes": np.round(each, PLACES).tolist(),
            "plunger": None if plungers is None else np.round(plungers[k], 5).tolist(),
        }
        for k, each in enumerate(nodes)
    ]
    return {
        "table": around.table if around.table > -np.inf else None,
        "reach": around.skeleton.reach or float(np.linalg.norm(tips, axis=1).max(initial=1.0)),
        "radii": radii_of(max(around.radius, DRAWN), nodes.shape[1] - 1).tolist(),
        "solids": solids,
        "arms": arms,
    }
