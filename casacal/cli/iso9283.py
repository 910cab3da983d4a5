"""`casacal iso9283`: targets of the cube of ISO 9283, and pose and path accuracy from what was measured there."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from casacal.cli import cell, common
from casacal.cli.cell import clearance_of, in_cell
from casacal.cli.common import DONE, JSON, add, of_instrument, spare
from casacal.cli.terminal import answer
from casacal.errors import CasacalError
from casacal.wording import times

if TYPE_CHECKING:
    from collections.abc import Iterator

    from casacal.verification.performance import Criterion, PoseAccuracy

HELP = "pose accuracy and repeatability by ISO 9283"
OF_PLAN = ("sheet", "centre", "side", "plane", "tool", "instrument", "table", "keep_out", "link_radius")
OF_ROWS = ("before", "in_base")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal iso9283`."""
    parser.description = (
        "Without MEASURED: write five poses and a straight path in a cube of the workspace as targets, which "
        "casacal compensate and predict take. With MEASURED: say from what a tracker saw at these targets how accurate "
        "and how repeatable poses (AP, RP), their distance (AD, RD) and the path (AT, RT) are."
    )
    add(parser, "PROBLEM", "a problem or a result.json, whose arm as drawn is planned for; with MEASURED, the targets")
    words = "CSV with x_mm,y_mm,z_mm, and point and cycle; of a dial reading_mm in place of the three"
    add(parser, "[MEASURED]", words)
    add(parser, "--out FILE", "CSV of the targets, or of the figures")
    add(parser, "--before FILE", "the same measured before calibration, shown beside")
    add(parser, "--in-base", "MEASURED is in the base frame; default: fitted to the targets, which AP then leaves out")
    add(parser, "--sheet FILE", "also write a CSV to fill in, a line for each measurement")
    add(parser, "--centre X,Y,Z", "centre of the cube, mm, base frame; default: that of about the largest cube")
    add(parser, "--side MM", "side of the cube", kind=float)
    add(parser, "--plane NAME", "diagonal plane, by where its upward normal leans: x+, x-, y+ or y-; default: the best")
    add(parser, "--tool X,Y,Z", "measured point in the flange frame, mm; default: the instrument's tip")
    add(parser, *common.INSTRUMENT)
    cell.add_clearance(parser)
    add(parser, *JSON)


def run(options: argparse.Namespace) -> int:
    """Plan or judge as the options say; returns 0."""
    judging = options.measured is not None
    for name in OF_PLAN if judging else OF_ROWS:
        if getattr(options, name) not in (None, False, []):
            fix = "Leave it out" if judging else "Name TARGETS and what was MEASURED there"
            raise CasacalError(f"--{name.replace('_', '-')} is for {'planning' if judging else 'measured rows'}", fix)
    return _judge(options) if judging else _plan(options)


def _plan(options: argparse.Namespace) -> int:
    from casacal.deployment.result_file import read_result
    from casacal.files import write_text
    from casacal.model.problem_file import load_problem
    from casacal.verification.cube import plan_cube

    if options.out is None:
        raise CasacalError("--out is missing", "Name a CSV for the targets; MEASURED, after TARGETS, is judged")
    is_result = options.problem.lower().endswith(".json")
    source = read_result(options.problem).source if is_result else load_problem(options.problem)
    named = options.instrument or source.problem.names[0]
    source = in_cell(of_instrument(source, named), options)
    outs = [options.out, *([] if options.sheet is None else [options.sheet])]
    spare(outs, options.problem if is_result else None, *(file.path for file in source.files), source.samples)
    plan = plan_cube(
        source.problem,
        centre=None if options.centre is None else _triple("--centre", options.centre),
        side=options.side,
        plane=options.plane,
        tool=None if options.tool is None else _triple("--tool", options.tool),
        cell=source.cell,
        clearance=clearance_of(options),
    )
    if len(set(outs)) < len(outs):
        raise CasacalError("--out and --sheet are the same file", "Name two")
    write_text(options.out, plan.text())
    if options.sheet is not None:
        write_text(options.sheet, plan.sheet_text())
    (x, y, z), (a, b, c) = plan.centre, plan.tool
    found = {"centre_mm": [x, y, z], "side_mm": plan.side, "plane": plan.plane, "tool_mm": [a, b, c]}
    answer(
        options,
        {**found, "targets": len(plan.names), "notes": [plan.words], "written": outs},
        f"Cube of {plan.side:g} mm about {x:g}, {y:g}, {z:g} mm, diagonal plane {plan.plane}, tool normal to it"
        + ("; found by a search, so a larger one may exist" if options.side is None else ""),
        f"Measured point: {a:g}, {b:g}, {c:g} mm in the flange frame"
        + (", the instrument's tip; give that of a tracker's reflector by --tool" if options.tool is None else ""),
        "Poses: 30 cycles P5, P4, P3, P2, P1, after P1. Path: 10 times the line L0 to L12",
        plan.words,
        f"Written: {', '.join(outs)}",
    )
    return DONE


def _triple(option: str, text: str) -> list[float]:
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        raise CasacalError(f"{option} {text} is not X,Y,Z", "Give three numbers of mm, such as 500,0,400") from None
    return [x, y, z]


def _judge(options: argparse.Namespace) -> int:
    from casacal.files import write_text
    from casacal.verification.performance import pose_accuracy

    if Path(options.problem).is_dir() or options.problem.endswith((".json", ".py")):
        what = f"'{options.problem}' holds no targets, and MEASURED is judged by the points that were commanded"
        raise CasacalError(what, "Plan with --out plan.csv alone, then casacal iso9283 plan.csv MEASURED")
    if options.out is not None:
        spare([options.out], options.problem, options.measured, options.before)
    found = pose_accuracy(options.problem, options.measured, in_base=options.in_base)
    before = None if options.before is None else pose_accuracy(options.problem, options.before, in_base=options.in_base)
    said = [*_lines(found, before), *found.notes]
    said += [] if before is None else [f"before: {note}" for note in before.notes if note not in found.notes]
    if options.out is not None:
        write_text(options.out, _csv(found, before))
        said.append(f"Written: {options.out}")
    answer(options, {**found.to_dict(), "before": None if before is None else before.to_dict()}, *said)
    return DONE


def _lines(found: PoseAccuracy, before: PoseAccuracy | None) -> Iterator[str]:
    """The table, without components of AP."""
    if before is not None:
        yield f"{'':8}{'now':>13}{'':13}{'before':>13}{'':13}{'ratio':>6}"
    for name, now, then, ratio in found.table(before):
        if name[:3] not in ("APx", "APy", "APz"):
            shown = "" if before is None else (" " * 26 if then is None else _told(then)) + f"{_times(ratio):>6}"
            yield f"{name:8}{_told(now)}{shown}   {now.cycles} cycles"


def _times(ratio: float | None) -> str:
    return "" if ratio is None else times(ratio)


def _told(figure: Criterion) -> str:
    spread = f"{figure.std:<9.4f}" if math.isfinite(figure.std) else f"{'unknown':9}"
    return f"{figure.value:>9.4f} {figure.unit:3} +- {spread}"


def _csv(found: PoseAccuracy, before: PoseAccuracy | None) -> str:
    from casacal.files import MADE

    lines = [f"# {MADE}: ISO 9283, {found.file}; frame: {found.frame}", *(f"# {note}" for note in found.notes)]
    lines.append("figure,unit,value,std,cycles" + ("" if before is None else ",before,before_std,before_cycles,ratio"))
    for name, now, then, ratio in found.table(before):
        cells = [name, now.unit, f"{now.value:.6f}", f"{now.std:.6f}", str(now.cycles)]
        if before is not None:
            past = ["", "", ""] if then is None else [f"{then.value:.6f}", f"{then.std:.6f}", str(then.cycles)]
            cells += [*past, "" if ratio is None else f"{ratio:.4f}"]
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"
