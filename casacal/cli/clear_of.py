"""What an arm must keep clear of, as `plan` and `measure` are told."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from casacal.cli.common import box_of

if TYPE_CHECKING:
    from casacal.planning.clearance import Clearance
    from casacal.problem.problem import Problem


def add_clearance(parser: argparse.ArgumentParser) -> None:
    """Boxes, the thickness of links, and shapes of a URDF."""
    parser.add_argument(
        "--keep-out",
        action="append",
        default=[],
        metavar="X0:X1,Y0:Y1,Z0:Z1",
        help="a box, mm, base frame, where neither arm nor tool may be; may be given several times",
    )
    parser.add_argument(
        "--link-radius",
        type=float,
        metavar="MM",
        help="how thick the links are; they keep off boxes, faces, each other",
    )
    parser.add_argument(
        "--ignore-shapes",
        action="store_true",
        help="do not look at the boxes, cylinders and spheres that a URDF has for its links",
    )


def clearance_of(options: argparse.Namespace, problem: Problem) -> Clearance | None:
    """What was said, and the shapes that a URDF has; None where there is nothing."""
    from casacal.planning.clearance import Clearance
    from casacal.planning.link_shapes import LinkShapes
    from casacal.robots.urdf_chain import UrdfChain

    shapes = None
    if isinstance(problem.robot.arm, UrdfChain) and not options.ignore_shapes:
        shapes = LinkShapes.of(problem.robot)
    if not options.keep_out and options.link_radius is None and shapes is None:
        return None
    boxes = tuple(box_of(text, option="--keep-out") for text in options.keep_out)
    return Clearance(boxes, options.link_radius, shapes)
