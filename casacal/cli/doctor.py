"""`casacal doctor`: find a controller's conventions from poses on its pendant."""

from __future__ import annotations

import argparse
from contextlib import suppress
from dataclasses import asdict
from typing import TYPE_CHECKING

from casacal.cli.common import DONE, FAILED, JSON, PROBLEM, add, add_readings, program_table
from casacal.cli.terminal import say, say_json
from casacal.errors import CasacalError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from casacal.data.text import Table

HELP = "find a controller's conventions from poses on its pendant"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal doctor`."""
    parser.description = (
        "Find joint signs, quarter-turn offsets, coupled joints, units and the convention of orientation from poses "
        "that the pendant shows, and print them as a [conventions] block. If one number was copied wrongly, name it. "
        "Exit 1 if the answer is not certain or nothing fits."
    )
    add(parser, *PROBLEM)
    words = "CSV of three rows or more: q1,q2,...,x,y,z and qw,qx,qy,qz or rx,ry,rz or a,b,c; or a robot program"
    add(parser, "POSES", words)
    add_readings(parser, "what the pendant shows at joint targets, when POSES does not hold it")
    add(parser, "--tool POSE", "tool frame of the pendant, relative to the flange; default: the flange")
    add(parser, "--base POSE", "pose of the robot's base in the pendant's user frame; default: the same frame")
    add(parser, "--tolerance MM", "largest allowed error of a row, in mm and mrad; default: 3", kind=float, default=3.0)
    add(parser, "--keep", "if certain and nothing is to change, note it beside problem.py, so that nobody asks again")
    add(parser, *JSON)
    parser.epilog = (
        "POSE is X,Y,Z in mm, or X,Y,Z,QW,QX,QY,QZ. The doctor looks at poses; casacal check looks at samples."
    )


def run(options: argparse.Namespace) -> int:
    """Diagnose as the options say; returns 0, or 1 when the conventions are not certain."""
    from casacal.doctor.diagnosis import diagnose
    from casacal.doctor.pendant_rows import read_pendant_rows
    from casacal.doctor.words import diagnosis_text
    from casacal.model.joints import Conventions
    from casacal.model.problem_file import keep_conventions, load_problem

    source = load_problem(options.problem)
    robot = source.problem.robot
    rows = read_pendant_rows(_poses(options), robot.revolute.tolist())
    base, tool = _pose("--base", options.base), _pose("--tool", options.tool)
    found = diagnose(robot, rows, base=base, tool=tool, tolerance=options.tolerance)
    kept = None
    if options.keep:
        if not found.certain or found.meanings[0].simplest != Conventions.plain(len(robot.axes)):
            what = "the answer is not certain" if not found.certain else "the conventions differ from the problem's"
            raise CasacalError(f"Nothing is kept: {what}", "Run it without --keep to see what to do")
        kept = keep_conventions(source, file=str(options.poses), poses=found.postures)
    if not options.json:
        say(diagnosis_text(found, robot.axes).rstrip("\n"))
        if kept is not None:
            say(f"Kept: {kept.as_posix()}; calibrate and check no longer ask whether joints are counted the other way")
        return DONE if found.certain else FAILED
    meanings = [
        {
            "conventions": [asdict(each) for each in meaning.conventions],
            "joint_unit": meaning.joint_unit,
            "length_unit": meaning.length_unit,
            "rotations": [{"name": n, "unit": u, "miss_rad": miss} for (n, u), miss in meaning.rotations.items()],
            "miss_mm": meaning.miss_mm,
        }
        for meaning in found.meanings
    ]
    say_json(
        {
            "certain": found.certain,
            "more": found.more,
            "rows": len(found.rows),
            "postures": found.postures,
            "tolerance_mm": found.tolerance,
            "meanings": meanings,
            "further": None if found.further is None else asdict(found.further),
            "nearest": None if found.nearest is None else asdict(found.nearest),
            "odd_lines": found.odd_lines,
            "convention": found.convention,
            "order": found.order,
            "slips": [asdict(slip) for slip in found.slips],
            "kept": None if kept is None else kept.as_posix(),
        }
    )
    return DONE if found.certain else FAILED


def _poses(options: argparse.Namespace) -> str | Table:
    """POSES, joined to what --readings has of them."""
    from casacal.data.samples import read_any_table
    from casacal.data.text import joined_tables
    from casacal.programs.endings import is_program

    if is_program(options.poses):
        return program_table(options.poses, options, "poses")
    if options.readings is None:
        return str(options.poses)
    return joined_tables(read_any_table(options.poses), read_any_table(options.readings), key=options.id)


def _pose(option: str, text: str | None) -> NDArray[np.float64] | None:
    """A pose (4, 4; mm) from X,Y,Z or X,Y,Z,QW,QX,QY,QZ."""
    import numpy as np

    from casacal.model.kinematics import turns_of

    if text is None:
        return None
    numbers = np.zeros(0)
    with suppress(ValueError):
        numbers = np.array([float(part) for part in text.split(",")])
    if len(numbers) not in (3, 7) or not np.isfinite(numbers).all() or (len(numbers) == 7 and not numbers[3:].any()):
        raise CasacalError(f"{option} {text} is not a pose", "Give X,Y,Z in mm, or X,Y,Z,QW,QX,QY,QZ")
    pose = np.eye(4)
    pose[:3, 3] = numbers[:3]
    if len(numbers) == 7:
        pose[:3, :3] = turns_of(numbers[None, 3:])[0]
    return pose
