"""`casacal doctor`: a controller's conventions, from poses that its pendant shows."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from casacal.cli.common import DONE, FAILED, add_problem
from casacal.errors import CasacalError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


HELP = "a controller's conventions, from poses that its pendant shows"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Say what `casacal doctor` takes."""
    parser.description = (
        "Find joint signs, quarter-turn offsets, joints measured against others, units and the convention of "
        "orientation from pendant rows, and print them as [conventions]. Exit 1 when they are not certain or none fits."
    )
    add_problem(parser)
    parser.add_argument(
        "poses", metavar="POSES", help="CSV, three rows or more: q1,q2,...,x,y,z and qw,qx,qy,qz or rx,ry,rz or a,b,c"
    )
    parser.add_argument(
        "--tool", metavar="POSE", help="what the pendant shows, in the flange frame; default: the flange"
    )
    parser.add_argument("--base", metavar="POSE", help="the robot's base in the pendant's frame; default: the same")
    parser.add_argument("--tolerance", type=float, default=3.0, metavar="MM", help="mm, and mrad; default: 3")
    parser.epilog = "POSE is X,Y,Z in mm, or X,Y,Z,QW,QX,QY,QZ. It looks at poses; casacal check looks at samples."


def run(options: argparse.Namespace) -> int:
    """Diagnose as the options say; returns 0, or 1 when the conventions are not certain."""
    from casacal.doctor import diagnose, read_pendant_rows
    from casacal.doctor.words import diagnosis_text
    from casacal.problem.problem_file import load_problem

    robot = load_problem(options.problem).problem.robot
    rows = read_pendant_rows(options.poses, robot.revolute.tolist())
    base, tool = _pose("--base", options.base), _pose("--tool", options.tool)
    found = diagnose(robot, rows, base=base, tool=tool, tolerance=options.tolerance)
    print(diagnosis_text(found, robot.axes), end="")
    return DONE if found.certain else FAILED


def _pose(option: str, text: str | None) -> NDArray[np.float64] | None:
    """A pose (4, 4; mm) from X,Y,Z or X,Y,Z,QW,QX,QY,QZ."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    if text is None:
        return None
    try:
        numbers = np.array([float(part) for part in text.split(",")])
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) not in (3, 7) or not np.isfinite(numbers).all() or (len(numbers) == 7 and not numbers[3:].any()):
        raise CasacalError(f"{option} {text} is no pose", "Give X,Y,Z in mm, or X,Y,Z,QW,QX,QY,QZ")
    pose = np.eye(4)
    pose[:3, 3] = numbers[:3]
    if len(numbers) == 7:
        pose[:3, :3] = Rotation.from_quat(np.roll(numbers[3:], -1)).as_matrix()
    return pose
