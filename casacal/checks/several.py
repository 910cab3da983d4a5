"""`check` of several instruments: what is wrong with the rows of each, and whether they agree about one arm."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

from casacal.binding.all_rows import Alone, each_alone
from casacal.binding.bound_problem import bind
from casacal.checks.causes import SUSPICIOUS
from casacal.checks.finding import Finding
from casacal.checks.setup import NO_LENGTH, enough_rows
from casacal.checks.undone import misfit
from casacal.errors import CasacalError
from casacal.problem.problem import Problem
from casacal.samples.measurements import Measurements
from casacal.wording import times

UNBOUND = "cannot be bound"

APART = 1.5
"""Times the misfit of the instrument that fits worst alone, beyond which all together contradict one another."""

OF_ALL = ("few rows", NO_LENGTH)
"""What is asked of the rows of all instruments together, not of each; what faces do not tell, another may."""


def check_several(
    problem: Problem, measured: Measurements, check_one: Callable[[Alone], tuple[Finding, ...]]
) -> tuple[Finding, ...]:
    """What is wrong with each instrument's samples, and with all together.

    An instrument whose rows cannot be fitted without the others is looked at row by row alone.
    """
    found = [*_of_each(problem, measured, check_one)]
    try:
        bound = bind(problem, *measured.sets)
    except CasacalError as error:
        if any(finding.about == UNBOUND for finding in found):  # said already of the instrument that it is about
            return tuple(found)
        return (Finding("error", UNBOUND, error.what, error.fix), *found)
    found += enough_rows(bound)
    if all(finding.severity != "error" for finding in found):
        found += _contradict(problem, measured)
    return tuple(found)


def _of_each(
    problem: Problem, measured: Measurements, check_one: Callable[[Alone], tuple[Finding, ...]]
) -> Iterator[Finding]:
    for alone in each_alone(problem, measured.sets):
        for finding in check_one(alone):
            if finding.about not in OF_ALL:
                fix = finding.fix.replace("--set ", f"--set {alone.name}.")
                yield replace(finding, instrument=alone.name, fix=fix)


def _contradict(problem: Problem, measured: Measurements) -> list[Finding]:
    """An error where each instrument fits by itself and all together do not."""
    together = misfit(problem, measured)
    sizes = {each.name: misfit(each.problem, each.samples) for each in each_alone(problem, measured.sets)}
    worst = max((size for size in sizes.values() if math.isfinite(size)), default=1.0)
    if together <= max(APART * worst, SUSPICIOUS):
        return []
    shared = "".join(f"; '{key}' is declared as the same for {' and '.join(by)}" for key, by in problem.shared.items())
    return [
        Finding(
            "error",
            "instruments contradict each other",
            f"each fits alone (residuals up to {times(worst)} times the stated noise), but not together "
            f"({times(together)} times){shared}",
            "Check that arm, tool and base were the same for all, and that what is declared as shared is one and the "
            "same; too small a stated noise of one instrument can also be the cause",
        )
    ]
