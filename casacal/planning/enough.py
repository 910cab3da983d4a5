"""Whether a plan leaves enough to calibrate from: rows in all, and rows of each face that it touches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casacal.binding.enough_rows import instances
from casacal.planning.exchange import Chosen
from casacal.planning.route import FIT, Route
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples


def rows_needed(problem: Problem, route: Route) -> tuple[int, int]:
    """How many touches a plan has to fit, and how many `calibrate` takes at least for all unknowns of arm and faces."""
    fitted = np.flatnonzero([purpose == FIT for purpose in route.purposes])
    own = sum(
        u.size * len(instances(problem.instrument, key, u, route.samples.take(fitted)))
        for key, u in problem.instrument.unknowns.items()
    )
    total = own + sum(unknown.size for unknown in problem.robot.parameters.values())
    return len(fitted), -(-total // problem.models[0].components)


def seldom(problem: Problem, pool: Samples, chosen: Chosen) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Measurements of a pool (N,) of faces that the chosen ones touch too seldom to say where they are.

    Such touches place the face at best, and tell nothing of the arm. Of all such faces, and of the one that is touched
    least but touched.
    """
    taken = np.zeros(len(pool), dtype=bool)
    taken[chosen] = True
    all_of_them, least, fewest = np.zeros(len(pool), dtype=bool), np.zeros(len(pool), dtype=bool), len(pool)
    for key in problem.instrument.datum:
        unknown = problem.instrument.unknowns[key]
        flat = int((~np.isfinite(unknown.prior_stds)).sum())
        for _, rows in instances(problem.instrument, key, unknown, pool):
            count = int(taken[rows].sum())
            if count * problem.models[0].components > flat:
                continue
            all_of_them[rows] = True
            if 0 < count < fewest:
                fewest, least = count, np.zeros(len(pool), dtype=bool)
                least[rows] = True
    return all_of_them, least
