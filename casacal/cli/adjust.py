"""A problem as the options change it: what is held, freed, set, and how far it may be from the drawing."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from casacal.errors import CasacalError

if TYPE_CHECKING:
    from casacal.problem.problem import Problem


def add_adjustments(parser: argparse.ArgumentParser) -> None:
    """The options that change a problem without an editor."""
    parser.add_argument(
        "--fix", action="append", default=[], metavar="NAMES", help="parameters to hold at nominal: alpha,a3,..."
    )
    parser.add_argument(
        "--free", action="append", default=[], metavar="NAMES", help="parameters to estimate that are held: tool,..."
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=NUMBER",
        help="another number of the instrument, such as sign=-1, travel=25 or noise_std=0.02",
    )
    parser.add_argument(
        "--prior", action="append", default=[], metavar="NAME=STD", help="prior standard deviation in mm or rad, or inf"
    )
    parser.add_argument(
        "--accuracy", type=float, metavar="MM", help="scale the arm's priors to the accuracy that its maker states"
    )


def adjusted(problem: Problem, options: argparse.Namespace) -> Problem:
    """The problem as the options want it; raises CasacalError for what cannot be read or does not exist."""
    if options.accuracy is not None:
        from casacal.uncertainty.priors import scaled_to_accuracy

        problem = scaled_to_accuracy(problem, options.accuracy)
    if options.set:
        problem = problem.with_settings(numbers_of("--set", options.set, "NAME=NUMBER", "sign=-1 or noise_std=0.02"))
    free, fix = names_of("--free", options.free), names_of("--fix", options.fix)
    problem = problem.free(*free)
    problem = problem.with_prior(numbers_of("--prior", options.prior, "NAME=STD", "mm or rad, such as a3=0.5"))
    problem = problem.fix(*fix)
    left = problem.free_names() if fix else free
    for name in free:
        if name not in left:
            raise CasacalError(f"'{name}' is to be freed (--free) and held (--fix)", "Name it in one of the two")
    return problem


def names_of(option: str, groups: Sequence[str]) -> list[str]:
    """Names that stand after an option, which may come several times; raises CasacalError where one names nothing."""
    found = []
    for group in groups:
        names = [name.strip() for name in group.split(",") if name.strip()]
        if not names:
            raise CasacalError(f"{option} is empty", "Name something, or leave the option out")
        found += names
    return found


def stds_of(option: str, settings: Sequence[str]) -> dict[str, float]:
    """Standard deviations by name, as they stand after an option; raises CasacalError for what is none."""
    found = numbers_of(option, settings, "NAME=STD", "mm or rad, such as theta4=0.01")
    for name, std in found.items():
        if not 0 < std < math.inf:
            raise CasacalError(f"{option} {name}={std:g} is no standard deviation", "Give a positive number")
    return found


def numbers_of(option: str, settings: Sequence[str], form: str, example: str) -> dict[str, float]:
    """Numbers by name that stand after an option; raises CasacalError for what is none."""
    found = {}
    for setting in settings:
        name, equals, number = setting.partition("=")
        if name.strip() in found:
            raise CasacalError(f"{option} gives '{name.strip()}' twice", "Give it once")
        try:
            found[name.strip()] = float(number)
        except ValueError:
            equals = ""
        if not equals or math.isnan(found.get(name.strip(), math.nan)):
            raise CasacalError(f"{option} {setting} is not {form}", f"Give {example}")
    return found
