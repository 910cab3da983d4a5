"""Options that several commands share: what is held, freed and set in a problem, and what an arm must keep clear of."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

from casacal.cli.common import add, box_of
from casacal.errors import CasacalError

if TYPE_CHECKING:
    from casacal.array_types import Array
    from casacal.planning.clearance import Clearance
    from casacal.problem.problem import Problem
    from casacal.problem.problem_file import ProblemFile
    from casacal.uncertainty.expectation import Box


Read = TypeVar("Read")


def add_adjustments(parser: argparse.ArgumentParser) -> None:
    """The options that change a problem without an editor."""
    add(parser, "--fix NAMES ...", "parameters to hold at nominal: alpha,a3,...")
    add(parser, "--free NAMES ...", "parameters to estimate that are held: tool,...")
    words = "another number of the instrument, such as sign=-1, travel=-5:5 or noise_std=0.02"
    add(parser, "--set NAME=NUMBER ...", words)
    add(parser, "--prior NAME=STD ...", "prior standard deviation in mm or rad, or inf")
    add(parser, "--accuracy MM", "scale the arm's priors to the accuracy that its maker states", kind=float)


def adjusted(problem: Problem, options: argparse.Namespace) -> Problem:
    """The problem as the options want it; raises CasacalError for what cannot be read or does not exist."""
    if options.accuracy is not None:
        from casacal.uncertainty.learned_priors import scaled_to_accuracy

        problem = scaled_to_accuracy(problem, options.accuracy)
    if options.set:
        example = "sign=-1, noise_std=0.02 or travel=-5:5"
        problem = problem.with_settings(_read("--set", options.set, "NAME=NUMBER", example, number_or_range))
    free, fix = names_of("--free", options.free), names_of("--fix", options.fix)
    priors = numbers_of("--prior", options.prior, "NAME=STD", "mm or rad, such as a3=0.5")
    problem = problem.free(*free).with_prior(priors).fix(*fix)
    left = problem.free_names() if fix else [*free, *priors]
    for asked, names in (("freed (--free)", free), ("given a prior (--prior)", priors)):
        for name in names:
            if name not in left:
                raise CasacalError(f"'{name}' is both {asked} and held (--fix)", "Give it in one of the two")
    return problem


def adjustments(options: argparse.Namespace) -> list[str]:
    """The same options as words of another command line."""
    accuracy = [] if options.accuracy is None else [f"{options.accuracy:g}"]
    given = {"--fix": options.fix, "--free": options.free, "--set": options.set, "--prior": options.prior}
    return [word for name, each in {**given, "--accuracy": accuracy}.items() for one in each for word in (name, one)]


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
    return _read(option, settings, form, example, _number)


def _read(
    option: str, settings: Sequence[str], form: str, example: str, read: Callable[[str], Read]
) -> dict[str, Read]:
    """What stands by name after an option, read by a function that raises ValueError."""
    found = dict[str, Read]()
    for setting in settings:
        name, _, value = setting.partition("=")
        if name.strip() in found:
            raise CasacalError(f"{option} gives '{name.strip()}' twice", "Give it once")
        try:
            found[name.strip()] = read(value)
        except (ValueError, argparse.ArgumentTypeError):
            raise CasacalError(f"{option} {setting} is not {form}", f"Give {example}") from None
    return found


def add_where(parser: argparse.ArgumentParser) -> None:
    """Where the tip will work: a box, or joint values."""
    add(parser, "--box X0:X1,Y0:Y1,Z0:Z1", "region where the tip will work, mm, base frame")
    add(parser, "--targets FILE", "joint values where it will work, in place of a box")


def where(options: argparse.Namespace, source: ProblemFile) -> tuple[Box | None, Array | None]:
    """The box and the joint values (M, n) that were named."""
    from casacal.compensation.predict import read_joints

    box = None if options.box is None else box_of(options.box)
    return box, None if options.targets is None else read_joints(options.targets, source).joints


def _number(text: str) -> float:
    if math.isnan(value := float(text)):
        raise ValueError(text)
    return value


def number_or_range(text: str) -> float | tuple[float, float]:
    """10, or -5:5; raises ArgumentTypeError for anything else, as argparse asks."""
    try:
        if ":" not in text:
            return _number(text)
        low, high = (_number(part) for part in text.split(":"))
        return low, high
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is no number, nor a range of two such as -5:5") from None


THINNEST = 5.0  # mm; a radius of links below it was given in metres
TABLE = (
    "--table Z",
    "height of what the arm stands on, mm, base frame: nothing goes below it; default: 0, the base plane; -inf: none",
)


def table_of(source: ProblemFile, options: argparse.Namespace) -> float:
    """Height of the table, mm: as it was named, or as the problem file's cell has it, or the base plane."""
    own = 0.0 if source.cell is None else source.cell.table
    return own if options.table is None else float(options.table)


def on_table(source: ProblemFile, options: argparse.Namespace) -> ProblemFile:
    """The same with the table that was named, and faces above it where the problem file has no cell of its own."""
    from casacal.simulation.cell import Disturbances
    from casacal.simulation.touches import default_cell

    problem = source.problem
    faced = [name for name, each in zip(problem.names, problem.instruments, strict=True) if each.probe is not None]
    table, cell = table_of(source, options), source.cell
    if cell is None:
        cell = default_cell(problem.measured_by(faced[0]), table=table) if faced else Disturbances(table=table)
    return replace(source, cell=replace(cell, table=table))


def add_clearance(parser: argparse.ArgumentParser) -> None:
    """The table, boxes, and the thickness of links."""
    add(parser, *TABLE, kind=float)
    words = "a box, mm, base frame, that arm and tool must avoid; may be repeated"
    add(parser, "--keep-out X0:X1,Y0:Y1,Z0:Z1 ...", words)
    add(parser, "--link-radius MM", "radius of the links, to keep clear of boxes, faces and each other", kind=float)


def clearance_of(options: argparse.Namespace) -> Clearance | None:
    """What was said; None where there is nothing."""
    from casacal.planning.clearance import Clearance

    if not options.keep_out and options.link_radius is None:
        return None
    if options.link_radius is not None and options.link_radius < THINNEST:
        raise CasacalError(f"--link-radius is {options.link_radius:g} mm, which no link is", "Give mm: 0.05 m are 50")
    boxes = tuple(box_of(text, option="--keep-out") for text in options.keep_out)
    return Clearance(boxes, options.link_radius)
