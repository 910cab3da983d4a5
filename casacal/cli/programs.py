"""Options of commands that take a robot program, and the program as they complete it."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

from casacal.cli.common import add, number, settings_of
from casacal.errors import CasacalError

if TYPE_CHECKING:
    from casacal.programs.program import TaughtProgram

PROGRAM = "RAPID (.mod), KRL (.src with its .dat), URScript (.script), FANUC TP (.ls), Yaskawa (.jbi)"
PROGRAM_OPTIONS = ("tool", "base", "near", "pulses")


def add_program(parser: argparse.ArgumentParser) -> None:
    """Add what a robot program leaves to its controller."""
    pose = "the numbers of a pose as the program's language has them: NAME=X,Y,Z,..."
    add(parser, "--tool NAME=POSE ...", f"a tool that a program names and does not hold, or 'flange'; {pose}")
    add(parser, "--base NAME=POSE ...", f"a base, work object or user frame likewise, or 'world'; {pose}")
    add(parser, "--near Q1,...", "joint values (degrees) where a program begins whose poses state no configuration")
    add(parser, "--pulses N1,...", "pulses per degree of the six axes, for Yaskawa's positions in pulses")


def read_program_of(options: argparse.Namespace, path: str) -> tuple[TaughtProgram, list[float] | None]:
    """A robot program as the options complete it, and where it begins (6,; rad) if they say."""
    from casacal.programs.read import read_program

    tools, bases = (
        settings_of(
            f"--{kind}", getattr(options, kind), "NAME=NUMBERS", f"a pose such as {kind}1=0,0,150,0,0,0", _numbers
        )
        for kind in ("tool", "base")
    )
    pulses, near = (
        None
        if (text := getattr(options, kind)) is None
        else settings_of(f"--{kind}", [f"={text}"], "six numbers", "six", _numbers)[""]
        for kind in ("pulses", "near")
    )
    if near is not None and not (len(near) == 6 and all(map(math.isfinite, near))):
        raise CasacalError(f"--near has {len(near)} joint values, or some that are infinite", "Give six, in degrees")
    begin = None if near is None else [math.radians(value) for value in near]
    return read_program(path, tools=tools, bases=bases, pulses=pulses), begin


def _numbers(text: str) -> list[float]:
    return [number(part) for part in text.split(",")]
