"""Samples that an arm as calibrated could take next where no faces are touched: a pool to choose among."""

from __future__ import annotations

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.problem.cell import Disturbances
from casacal.samples.samples import Samples
from casacal.simulation.bench import bench_of
from casacal.simulation.rows import exact_rows
from casacal.simulation.true_arm import Draw

POOL = 240  # samples that are drawn, to choose among
ROUNDS = 3  # times that their postures are sought; what is not found then is hard to reach
FEWEST = 120  # samples without which there is nothing to choose among


def extra_samples(bound: BoundProblem, x: Array) -> Samples | None:
    """Rows at x (n,) in random postures, with labels as those that there are; None where hardly any can be taken.

    Also None for what touches faces.
    """
    problem, samples, rng = bound.problem.without_effects, bound.samples[0], np.random.default_rng(0)
    if len(bound.samples) > 1 or problem.instrument.probe is not None:
        return None
    stands = {slot.name: x[slot.columns] for slot in bound.slots}
    draw = Draw(0, known=stands, nominals={slot.name: slot.nominal for slot in bound.slots})
    labels = samples.take(rng.integers(len(samples), size=POOL)).labels
    bench = bench_of(problem, Disturbances(error_scale=0.0), labels, rng, POOL, draw)
    found = exact_rows(bench, labels, rng, rounds=ROUNDS)
    return found if len(found) >= FEWEST else None
