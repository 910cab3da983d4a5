"""Warnings of what arm and cell do beside the geometry, and what to do about each."""

from __future__ import annotations

from casacal.binding.bound_problem import bind
from casacal.checks.finding import Finding
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.uncertainty.discrepancy import with_effects
from casacal.uncertainty.noise import found_noise
from casacal.uncertainty.scores import CLEAR

COUNTED = "Calibrate anyway: the kit of effects accounts for this"

FIXES = {
    "gain": "Declare gain=dial_gain(0.15), or give its certificate",
    "cycle": "Declare cycle=dial_cycle(3), or use another dial",
    "form": "Clean the faces, or use a better plate",
    "neighbours": "Clean the faces, or use a better plate",
    "play": "Approach every touch from the same side",
    "give": f"{COUNTED}. Measure with the load that the arm will carry",
    "wave1": COUNTED,
    "wave2": COUNTED,
    "field": "Look for causes that depend on posture, such as hoses, cables or a soft base",
    "drift": "Let the dial warm up, fasten it and the faces, and repeat one touch from time to time",
    "growth": "Let the arm warm up by running its production program before measuring",
    "succession": "Take the touches in a different order, and let arm and dial warm up",
    "repeatability": "State the joint repeatability (Joint(..., repeatability_std=...)); rows are then weighted by it",
    "repeats": "Look for what repeated touches of one place have in common; more repeats will not help",
}

OTHERWISE = "Look for its cause, or declare it as an effect of the problem"


def beside_geometry(problem: Problem, samples: Samples) -> list[Finding]:
    """Warnings of the effects that explain the rows beside the geometry; none where nothing is suspicious.

    Noise is that found beside the effects, as in `calibrate`. In blocks, as nothing is worth compiling for one look.
    """
    from casacal.uncertainty.score_tests import leading_tests  # scipy's sparse matrices take their time

    bound = bind(problem.without_effects, samples, backend="blocks")
    bound = bound.with_noise(found_noise(bound).scale)
    bound = bound.with_noise(with_effects(bound, problem).scale)
    found: dict[str, Finding] = {}
    for test in leading_tests(bound, problem, CLEAR):
        cause = (
            f"the rows show it (p = {test.p_holm:.1g}): its most likely size is "
            f"{test.shown_size}, which moves the tip by {test.tip_mm:.2g} mm RMS"
        )
        fix = FIXES.get(test.key, OTHERWISE)
        found.setdefault(fix, Finding("warning", test.words, cause, fix))  # one that calls for the same says no more
    return list(found.values())
