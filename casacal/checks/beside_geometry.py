"""Warnings of what arm and cell do beside the geometry, and what to do about each."""

from __future__ import annotations

from collections.abc import Iterator

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem, bind
from casacal.checks.finding import Finding
from casacal.estimators import lm
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.uncertainty.discrepancy import dial_errors, effect_sizes_of, with_effects
from casacal.uncertainty.noise import found_noise
from casacal.wording import sized

COUNTED = "Calibrate anyway: the kit of effects accounts for this"

FIXES = {
    "gain": "Declare gain=dial_gain(0.15), or give its certificate",
    "cycle": "Declare cycle=dial_cycle(3), or use another dial",
    "form": "Clean the faces, or use a better plate",
    "play": "Approach every touch from the same side",
    "give": f"{COUNTED}. Measure with the load that the arm will carry",
    "wave1": COUNTED,
    "wave2": COUNTED,
    "field": "Look for causes that depend on posture, such as hoses, cables or a soft base",
    "drift": "Let the dial warm up, fasten it and the faces, and repeat one touch from time to time",
    "growth": "Let the arm warm up by running its production program before measuring",
}

OTHERWISE = "Look for its cause, or declare it as an effect of the problem"


def beside_geometry(problem: Problem, samples: Samples) -> list[Finding]:
    """Warnings of what the rows show beside the geometry, with noise and sizes as `calibrate` finds them.

    In blocks, as nothing is worth compiling for one look.
    """
    bound = bind(problem.without_terms, samples, backend="blocks")
    bound = with_effects(bound.with_noise(found_noise(bound).scale), problem)
    fit = lm(bound)
    if not fit.converged:
        return []
    found: dict[str, Finding] = {}
    for key, words, evidence, size in _shown(bound, fit.x):
        fix = FIXES.get(key, OTHERWISE)
        cause = f"the rows show it ({evidence}): its most likely size is {size}"
        found.setdefault(fix, Finding("warning", words, cause, fix))  # one that calls for the same says no more
    return list(found.values())


def _shown(bound: BoundProblem, x: Array) -> Iterator[tuple[str, str, str, str]]:
    """Key, words, evidence and size of what rows show at the minimum x (n,): of the dial, and of the arm."""
    for error in dial_errors(bound, x):
        if error.shown:
            size = f"{error.shown_size}, which moves the tip by {error.tip_mm:.2g} mm RMS"
            yield error.key, error.words, f"p = {error.chance:.1g}", size
    for each in effect_sizes_of(bound, x):
        if each.shown and each.size > each.expected_size:
            yield each.key, each.words, f"log likelihood {each.gain:+.0f}", sized(each.size, each.unit)
