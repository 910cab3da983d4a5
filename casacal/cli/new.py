"""`casacal new`: make a problem folder from a DH table or a URDF."""

from __future__ import annotations

import argparse
import math
import tempfile
from dataclasses import replace
from typing import TYPE_CHECKING

from casacal.cli.cell import TABLE
from casacal.cli.common import DONE, add, box_of, number_or_range
from casacal.cli.terminal import say_paragraphs
from casacal.errors import CasacalError

if TYPE_CHECKING:
    from casacal.model.problem_text import Answers, Plate

HELP = "make a problem folder from a DH table or a URDF"
SHORTEST = 2.0  # mm; a tool shorter than this was given in metres


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal new`."""
    parser.description = (
        "Write a problem folder for an arm given as a DH table or a URDF. A DH table in CSV has a row for each joint "
        "and the columns alpha_deg, a_mm, d_mm, theta_deg, and for joint limits lower_deg, upper_deg (rad and m as "
        "well). A line above them says '# convention: standard', or modified (Craig's)."
    )
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
    add(parser, "--noise MM", "standard deviation of one reading; default: 0.01", kind=float, default=0.01)
    add(parser, "--accuracy MM", "absolute accuracy of the arm as its maker states it", kind=float)
    words = "face to touch: its middle in the base frame, mm, its normal (default: upwards) and side (300)"
    add(parser, "--plate NAME:X,Y,Z[:NX,NY,NZ][:SIDE] ...", words)
    words = "height of a gauge block on the first plate, which tells the size of the arm"
    add(parser, "--block MM", words, kind=float)
    add(parser, *TABLE, kind=float)
    add(parser, "--keep-out X0:X1,Y0:Y1,Z0:Z1 ...", "a box, mm, base frame, that arm and tool must avoid")
    add(parser, "--out DIR", "where to make the folder; default: here", default=".")


def run(options: argparse.Namespace) -> int:
    """Write a problem folder for a DH table or a URDF; returns 0."""
    from casacal.model.dh_file import BLOCK_FIELDS, unread_keys
    from casacal.model.new import new_from_dh, new_from_urdf
    from casacal.model.problem_text import Answers

    sign = None if options.sign is None else int(options.sign)
    tool = None if options.tool is None else _triple(options.tool)
    plates = tuple(map(_plate, options.plate))
    boxes = tuple(box_of(text, option="--keep-out") for text in options.keep_out)
    stated = {name: getattr(options, name) for name in ("travel", "noise", "accuracy", "block", "table")}
    answers = Answers(tool=tool, sign=sign, plates=plates, keep_out=boxes, **stated)
    if not plates and (boxes or options.block is not None or options.table is not None):
        answers = _with_proposed_plates(answers, options)
    missing = list(answers.missing)
    if options.dh is not None:
        if options.tip or options.base:
            raise CasacalError("--tip and --base name links of a URDF", "Leave them out with --dh")
        folder, table = new_from_dh(options.name, options.dh, options.out, answers=answers)
        say_paragraphs(f"{table.name}: {len(table.joints)} joints, {table.convention} DH")
        if unread := unread_keys(options.dh):
            known = ", ".join(BLOCK_FIELDS)
            say_paragraphs(f"Taken for remarks, not for settings: {', '.join(unread)}. Known are {known}")
        if not table.limited:
            missing.append("joint limits: the table gives none, so each joint has those of any, -180 to 180 degrees")
        if table.note:
            say_paragraphs(table.note)
        elif table.parallel:
            axes = ", ".join(f"{row} and {row + 1}" for row in table.parallel)
            say_paragraphs(f"Parallel axes: {axes}; there Hayati's angle beta is calibrated in place of d")
    else:
        tip, base = options.tip, options.base
        folder, arm = new_from_urdf(options.name, options.urdf, options.out, tip=tip, base=base, answers=answers)
        say_paragraphs(f"{arm.name}: {len(arm.moving)} joints from '{arm.chain[0].parent}' to '{arm.chain[-1].child}'")
    place = folder.as_posix()
    for face in answers.faces:
        where = ", ".join(f"{number:g}" for number in face.centre)
        towards = "" if face.normal == (0.0, 0.0, 1.0) else f", facing {', '.join(f'{n:g}' for n in face.normal)}"
        begun = "Proposed face" if answers.proposed else "Face"
        say_paragraphs(f"{begun} '{face.label}': middle at {where} mm{towards}, {face.side:g} mm wide")
    say_paragraphs(*(f"warning: {each}" for each in answers.remarks))
    say_paragraphs(f"Written: {place}", *(f"To fill in: {words}" for words in missing))
    following = f"casacal simulate {place} --out out/{options.name}_samples.csv"
    say_paragraphs(f"Next: {f'fill these in {place}/problem.py, then ' if missing else ''}{following}")
    say_paragraphs(f"Or go the whole way, beside the robot, on a page: casacal serve {place}")
    return DONE


def _plate(text: str) -> Plate:
    """A plate from NAME:X,Y,Z[:NX,NY,NZ][:SIDE]."""
    from casacal.model.problem_text import Plate

    name, *parts = text.split(":")
    fix = "Write NAME:X,Y,Z, :NX,NY,NZ for its normal where it does not lie, and :SIDE, in mm: floor:600,0,50:300"
    try:
        numbers = [tuple(float(number) for number in part.split(",")) for part in parts]
    except ValueError:
        raise CasacalError(f"--plate {text} is no plate", fix) from None
    shape = [len(each) for each in numbers]
    if not name.strip() or shape not in ([3], [3, 1], [3, 3], [3, 3, 1]):
        raise CasacalError(f"--plate {text} is no plate", fix)
    normal = numbers[1] if len(numbers) > 1 and shape[1] == 3 else (0.0, 0.0, 1.0)
    return Plate(name.strip(), numbers[0], normal, numbers[-1][0] if shape[-1] == 1 else Plate.side)  # type: ignore[arg-type]


def _with_proposed_plates(answers: Answers, options: argparse.Namespace) -> Answers:
    """Plates where this arm reaches them, in front of its base and on its table, as `plan` would take them."""
    from casacal.model.new import new_from_dh, new_from_urdf
    from casacal.model.problem_file import load_problem
    from casacal.model.problem_text import Plate
    from casacal.simulation.places import default_cell

    bare = replace(answers, block=None)
    with tempfile.TemporaryDirectory() as place:
        if options.dh is not None:
            folder, _ = new_from_dh("arm", options.dh, place, answers=bare)
        else:
            folder, _ = new_from_urdf("arm", options.urdf, place, tip=options.tip, base=options.base, answers=bare)
        cell = default_cell(load_problem(folder).problem, table=answers.table or 0.0, keep_out=answers.keep_out)
    plates = [
        Plate(
            face.label,
            (round(face.centre[0]), round(face.centre[1]), math.ceil(face.centre[2])),
            (round(face.normal[0], 4), round(face.normal[1], 4), round(face.normal[2], 4)),
            math.floor(min(face.size)),
        )
        for face in cell.faces
    ]
    return replace(answers, plates=tuple(plates), proposed=True)


def _triple(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise CasacalError(f"--tool {text} is not X,Y,Z", "Give three numbers of mm, such as 0,0,120") from None
    if 0 < (far := math.hypot(x, y, z)) < SHORTEST:
        raise CasacalError(f"--tool {text} is a tool of {far:g} mm", "Give it in mm: 0.12 m are 120")
    return x, y, z
