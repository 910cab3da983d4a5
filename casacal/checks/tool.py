"""A tool that the samples put elsewhere than its prior allows: the commonest mistake, absorbed by a free tool."""

from __future__ import annotations

import math

from casacal.checks.finding import Finding
from casacal.checks.undone import quick_fit
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.uncertainty.figures import chance_beyond

CHANCE = 1e-4
"""Chance that a tool as stated moves so far, all its components together."""


def tool_moved(problem: Problem, samples: Samples) -> list[Finding]:
    """A warning where a tool with a prior moved far beyond it; nothing for a held tool, or for one without a prior."""
    probe = problem.instrument.probe
    fitted = None if probe is None else quick_fit(problem, samples)
    if probe is None or fitted is None:
        return []
    bound, result = fitted
    own = {
        name: (float(result.x[j]), float(bound.prior_std[j]))
        for slot in bound.slots
        if slot.key in probe.moves
        for name, j, unit in zip(slot.unknown.names(slot.name), slot.columns, slot.unknown.units, strict=True)
        if unit == "mm" and bound.prior_std[j] < math.inf
    }
    if not own or chance_beyond(sum((by / std) ** 2 for by, std in own.values()), len(own)) > CHANCE:
        return []
    moved = ", ".join(f"{name} by {by:+.2f} mm (its prior: {std:.2g})" for name, (by, std) in own.items())
    return [
        Finding(
            "warning",
            "tool elsewhere",
            f"the samples put the tool elsewhere than the problem says: {moved}",
            "Measure the tool again, and correct it or its prior in the problem",
        )
    ]
