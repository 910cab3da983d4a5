"""`casacal new`: make a problem folder from a DH table or a URDF."""

from __future__ import annotations

import argparse
import math

from casacal.cli.common import DONE, add, number_or_range
from casacal.cli.terminal import say_paragraphs
from casacal.errors import CasacalError

HELP = "make a problem folder from a DH table or a URDF"
SHORTEST = 2.0  # mm; a tool shorter than this was given in metres


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal new`."""
    parser.description = "Write a problem folder for an arm given as a DH table or a URDF."
    add(parser, "NAME", "name of the folder, which must not exist yet")
    source = parser.add_mutually_exclusive_group(required=True)
    add(source, "--dh FILE", "DH table in CSV or TOML")
    add(source, "--urdf FILE", "URDF, with xacro already expanded")
    add(parser, "--tip LINK", "link that is the flange; default: the last link, when there is only one")
    add(parser, "--base LINK", "link that is the base frame; default: the root link")
    add(parser, "--tool X,Y,Z", "tip of the plunger at reading zero in the flange frame, mm, such as 0,0,120")
    words = "-1: a larger reading shortens the tool (pushed in); +1: lengthens it"
    add(parser, "--sign", words, choices=("-1", "+1", "1"))
    add(parser, "--travel MM", "range of the dial, such as 10 or -5:5; default: 10", kind=number_or_range)
    add(parser, "--accuracy MM", "absolute accuracy of the arm as its maker states it", kind=float)
    add(parser, "--out DIR", "where to make the folder; default: here", default=".")


def run(options: argparse.Namespace) -> int:
    """Write a problem folder for a DH table or a URDF; returns 0."""
    from casacal.model.dh_table import BLOCK_FIELDS, unread_keys
    from casacal.model.new import new_from_dh, new_from_urdf
    from casacal.model.problem_text import Answers

    sign = None if options.sign is None else int(options.sign)
    tool = None if options.tool is None else _triple(options.tool)
    answers = Answers(tool=tool, sign=sign, travel=options.travel, accuracy=options.accuracy)
    if options.dh is not None:
        if options.tip or options.base:
            raise CasacalError("--tip and --base name links of a URDF", "Leave them out with --dh")
        folder, table = new_from_dh(options.name, options.dh, options.out, answers=answers)
        say_paragraphs(f"{table.name}: {len(table.joints)} joints, {table.convention} DH")
        if unread := unread_keys(options.dh):
            known = ", ".join(BLOCK_FIELDS)
            say_paragraphs(f"Taken for remarks, not for settings: {', '.join(unread)}. Known are {known}")
        if table.parallel:
            axes = ", ".join(f"{row} and {row + 1}" for row in table.parallel)
            say_paragraphs(f"Parallel axes: {axes}; there Hayati's angle beta is calibrated in place of d")
    else:
        tip, base = options.tip, options.base
        folder, arm = new_from_urdf(options.name, options.urdf, options.out, tip=tip, base=base, answers=answers)
        say_paragraphs(f"{arm.name}: {len(arm.moving)} joints from '{arm.chain[0].parent}' to '{arm.chain[-1].child}'")
    place = folder.as_posix()
    say_paragraphs(f"Written: {place}", *(f"To fill in: {words}" for words in answers.missing))
    following = f"casacal simulate {place} --out out/{options.name}_samples.csv"
    say_paragraphs(f"Next: {f'fill these in {place}/problem.py, then ' if answers.missing else ''}{following}")
    return DONE


def _triple(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise CasacalError(f"--tool {text} is not X,Y,Z", "Give three numbers of mm, such as 0,0,120") from None
    if 0 < (far := math.hypot(x, y, z)) < SHORTEST:
        raise CasacalError(f"--tool {text} is a tool of {far:g} mm", "Give it in mm: 0.12 m are 120")
    return x, y, z
