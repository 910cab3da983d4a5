"""A tool that the samples put elsewhere than its prior allows: the commonest mistake, absorbed by a free tool."""

from __future__ import annotations

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.checks.finding import Finding
from casacal.checks.undone import quick_fit
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.uncertainty.prior_moves import chance_of_move

CHANCE = 1e-3
"""Chance that a tool as stated moves so far, all its components together."""

FAR = 2.0
"""Prior standard deviations that a component must move: where the model is wrong, small moves look improbable, too."""


def tool_moved(problem: Problem, samples: Samples) -> list[Finding]:
    """A warning where the tool moved far beyond its prior in a quick fit."""
    fitted = quick_fit(problem, samples)
    if fitted is None or fitted[0].groups is not None:
        return []
    bound, result = fitted
    return tool_elsewhere_at(bound, result.x, result.spread[0])


def tool_elsewhere_at(bound: BoundProblem, x: Array, covariance: Array) -> list[Finding]:
    """The same at an estimate (n,) with its covariance (n, n); nothing for a held tool, or for one without a prior."""
    moves = {
        full[key]
        for instrument, full in zip(bound.problem.instruments, bound.problem.full_names, strict=True)
        if (probe := instrument.probe) is not None
        for key in probe.moves
    }
    named = {
        name: j
        for slot in bound.slots
        if slot.key in moves
        for name, j, unit in zip(slot.unknown.names(slot.name), slot.columns, slot.unknown.units, strict=True)
        if unit == "mm" and np.isfinite(bound.prior_std[j])
    }
    own = np.array(list(named.values()), dtype=np.intp)
    far = (np.abs(x[own]) > FAR * bound.prior_std[own]).any()
    if not far or chance_of_move(bound, x, covariance, own) > CHANCE:
        return []
    moved = ", ".join(f"{name} by {x[j]:+.2f} mm (its prior: {bound.prior_std[j]:.2g})" for name, j in named.items())
    return [
        Finding(
            "warning",
            "tool elsewhere",
            f"the samples put the tool elsewhere than the problem says: {moved}",
            "Measure the tool again, and correct it or its prior in the problem",
        )
    ]
