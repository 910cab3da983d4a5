"""Options of commands that know the cell: table, faces, what to keep clear of, where the tip works, the controller."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from casacal.cli.common import add, box_of
from casacal.errors import CasacalError

if TYPE_CHECKING:
    from casacal.model.problem_file import ProblemFile
    from casacal.model.robot import Robot
    from casacal.planning.clearance import Clearance
    from casacal.values import Array, Box

THINNEST = 5.0  # mm; a radius of links below it was given in metres
TABLE = (
    "--table Z",
    "height of what the arm stands on, mm, base frame: nothing goes below it; default: 0, the base plane; -inf: none",
)
TILT = "--tilt DEG", "largest angle between plunger and face normal; default: 30, or as the problem's cell has it"


def add_where(parser: argparse.ArgumentParser) -> None:
    """Add --box and --targets: where the tip will work."""
    add(parser, "--box X0:X1,Y0:Y1,Z0:Z1", "region where the tip will work, mm, base frame")
    add(parser, "--targets FILE", "joint values where it will work, in place of a box")


def where(options: argparse.Namespace, source: ProblemFile) -> tuple[Box | None, Array | None]:
    """The box and the joint values (M, n) that were named."""
    from casacal.deployment.predict import joints_from

    box = None if options.box is None else box_of(options.box)
    return box, None if options.targets is None else joints_from(options.targets, source).joints


def table_of(source: ProblemFile, options: argparse.Namespace) -> float:
    """Height of the table, mm: as it was named, or as the problem file's cell has it, or the base plane."""
    if options.table is not None:
        return float(options.table)
    return 0.0 if source.cell is None else source.cell.table


def in_cell(source: ProblemFile, options: argparse.Namespace, *, tilt: float | None = None) -> ProblemFile:
    """The cell with table and tilt (degrees) as named, and faces above it where the file has no cell of its own.

    Raises CasacalError for a tilt where no faces are touched.
    """
    from casacal.simulation.cell import Cell, Disturbances
    from casacal.simulation.places import default_cell

    problem = source.problem
    faced = [name for name, each in zip(problem.names, problem.instruments, strict=True) if each.probe is not None]
    table, cell = table_of(source, options), source.cell
    if cell is None:
        cell = default_cell(problem.measured_by(faced[0]), table=table) if faced else Disturbances(table=table)
    if tilt is not None and not (isinstance(cell, Cell) and faced):
        what = f"--tilt is about faces, and {type(problem.instrument).__name__} touches none"
        raise CasacalError(what, "Leave it out")
    cell = replace(cell, table=table)
    return replace(source, cell=cell if tilt is None else replace(cell, tilt=math.radians(tilt)))


def add_clearance(parser: argparse.ArgumentParser) -> None:
    """Add --table, --keep-out and --link-radius."""
    add(parser, *TABLE, kind=float)
    words = "a box, mm, base frame, that arm and tool must avoid; may be repeated"
    add(parser, "--keep-out X0:X1,Y0:Y1,Z0:Z1 ...", words)
    words = "radius of the links, to keep clear of table, boxes, faces and each other; default: from the reach; 0: none"
    add(parser, "--link-radius MM", words, kind=float)


def clearance_of(options: argparse.Namespace, source: ProblemFile | None = None) -> Clearance:
    """Clearance from --keep-out and --link-radius, and from the boxes of a problem file's cell where it is given."""
    from casacal.planning.clearance import Clearance

    radius = options.link_radius
    if radius is not None and radius and radius < THINNEST:
        raise CasacalError(f"--link-radius is {radius:g} mm, which no link is", "Give mm: 0.05 m are 50")
    boxes = tuple(box_of(text, option="--keep-out") for text in options.keep_out)
    return Clearance((*boxes, *(() if source is None or source.cell is None else source.cell.keep_out)), radius)


def add_joints(parser: argparse.ArgumentParser) -> None:
    """Add --joints: a controller that is asked where the arm stands."""
    words = "ask the controller where the arm stands, and only read: rtde:ADDRESS (Universal Robots), rws:ADDRESS (ABB)"
    add(parser, "--joints KIND:ADDRESS", words)


def stands_of(spelled: str, robot: Robot) -> Callable[[], Array]:
    """Joint values (n,; rad, mm) as the controller that --joints names shows them when it is asked."""
    from casacal.shopfloor.controllers import controller

    return controller(spelled, robot).standing
