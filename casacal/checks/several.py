"""What several instruments say of one arm together: whether all fit, and whether what they share is the same."""

from __future__ import annotations

import math

import numpy as np

from casacal.binding.bound_problem import BoundProblem, each_alone
from casacal.checks.causes import SUSPICIOUS
from casacal.checks.finding import Finding, misfit
from casacal.checks.fitted_faults import freed_of_unknowns, weighted
from casacal.estimators import lm
from casacal.least_squares.linalg import svd
from casacal.least_squares.result import Result
from casacal.samples.measurements import Measurements
from casacal.uncertainty.discrepancy import with_effects
from casacal.uncertainty.figures import chance_beyond
from casacal.uncertainty.noise import found_noise
from casacal.wording import listed, mm, sized, times

APART = 1.5
"""Times the misfit of the instrument that fits worst alone, beyond which all together contradict one another."""

BY_CHANCE = 1e-4  # chance of a difference, and more, of what is one and the same
DULL = 1e-3  # whitened effect of a difference as large as the prior's, below which rows do not see it


def contradictions(bound: BoundProblem, measured: Measurements) -> list[Finding]:
    """An error where each instrument fits by itself and all together do not, or not with what they share."""
    problem = bound.problem
    together = misfit(problem, measured)
    sizes = {each.name: misfit(each.problem, each.samples) for each in each_alone(problem, measured.sets)}
    worst = max((size for size in sizes.values() if math.isfinite(size)), default=1.0)
    if together <= max(APART * worst, SUSPICIOUS):
        if not problem.shared:
            return []
        fit = with_effects(bound.with_noise(found_noise(bound).scale), problem)
        return not_the_same(fit, lm(fit))
    shared = "".join(f"; '{key}' is declared as the same for {' and '.join(by)}" for key, by in problem.shared.items())
    cause = (
        f"each fits alone (residuals up to {times(worst)} times the stated noise), but not together "
        f"({times(together)} times){shared}"
    )
    fix = (
        "Check that arm, tool and base were the same for all, and that what is declared as shared is one and the "
        "same; too small a stated noise of one instrument can also be the cause"
    )
    return [Finding("error", "instruments contradict each other", cause, fix)]


def not_the_same(bound: BoundProblem, result: Result) -> list[Finding]:
    """An error for what is declared as shared and differs between instruments, at the estimate of all their rows.

    An instrument that had one of its own would see it by the derivative of its own rows. The fall of chi-square by such
    a difference, all unknowns following within their priors, has as many degrees of freedom as directions show.
    """
    owners = np.searchsorted(np.cumsum([len(some) for some in bound.samples]), bound.sample_of, side="right")
    found = []
    for key, names in bound.problem.shared.items():
        slots = [slot for slot in bound.slots if slot.key == key and slot.unknown.size]
        columns = np.array([j for slot in slots for j in slot.columns], dtype=np.intp)
        if not columns.size or not result.converged:
            continue
        scale, slopes = bound.start_std[columns], bound.jacobian(result.x)[:, columns]
        own = [np.where(owners == bound.problem.number(name), 1.0, 0.0)[:, None] * slopes * scale for name in names[1:]]
        left, sizes, along = svd(freed_of_unknowns(bound, result, np.hstack(own)))
        seen = sizes > DULL
        gains = left[:, seen].T @ weighted(bound, result, bound.residual(result.x))
        if not seen.any() or chance_beyond(float(gains @ gains), float(seen.sum())) > BY_CHANCE:
            continue
        apart = (-(along[seen].T @ (gains / sizes[seen]))).reshape(len(names) - 1, -1) * scale
        label = [name for slot in slots for name in slot.unknown.names(slot.name)]
        far = np.unravel_index(int(np.argmax(np.abs(apart / scale))), apart.shape)
        by, unit = abs(float(apart[far])), bound.units[columns[far[1]]]
        cause = (
            f"'{key}' is declared as the same for {listed(names)}, and is not: {label[far[1]]} of {names[1 + far[0]]} "
            f"is "
            f"{mm(by) if unit == 'mm' else sized(by, unit)} away from that of {names[0]}"
        )
        fix = f"Measure again with the same for all, or leave '{key}' out of `shared`: then each has its own"
        found.append(Finding("error", f"{key} not the same", cause, fix))
    return found
