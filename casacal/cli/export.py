"""`casacal export`: write a calibrated arm as DH table, URDF, zero offsets or C."""

from __future__ import annotations

import argparse

from casacal.cli.common import DONE, FORCE, INSTRUMENT, JSON, RESULT, add, read_arm
from casacal.cli.terminal import answer
from casacal.errors import CasacalError

HELP = "write a calibrated arm as DH table, URDF, zero offsets or C"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal export`."""
    parser.description = "Write a calibrated arm in a form that other programs read."
    add(parser, *RESULT)
    add(parser, *INSTRUMENT)
    words = "DH table (CSV, or TOML where FILE ends in .toml), URDF, zero corrections (CSV), the kinematics file of "
    words += "ur_description (YAML), C99, a casadi.Function, or the frame of a work object (--faces or --points)"
    add(parser, "--to", words, choices=("dh", "urdf", "zeros", "ur", "c", "casadi", "frame"), required=True)
    add(parser, "--out FILE", "file to write", required=True)
    add(parser, "--source FILE", "for urdf: a file of yours to copy with only its numbers changed")
    add(parser, "--prefix WORD", "for c: prefix of function names; default: the problem's name")
    add(parser, "--faces A,B,C", "for frame: z normal to the first, x to the second, origin in all three")
    add(parser, "--points A,B,C", "for frame: origin, a point along x, a point beside it")
    add(parser, *FORCE)
    add(parser, *JSON)


def run(options: argparse.Namespace) -> int:
    """Write a calibrated arm in the form that --to names; returns 0."""
    from casacal.deployment.export import export
    from casacal.deployment.remark import remark
    from casacal.deployment.work_frame import frame_text
    from casacal.files import write_text

    if options.to != "frame" and (options.faces or options.points):
        raise CasacalError(f"--to {options.to} has no work object", "Leave out --faces and --points")
    if options.source is not None and options.to != "urdf":
        raise CasacalError(f"--to {options.to} writes no file back", "Leave out --source")
    if options.prefix is not None and options.to != "c":
        raise CasacalError(f"--to {options.to} has no names of functions", "Leave out --prefix")
    result = read_arm(options, options.source)
    if options.to == "frame":
        labels = (options.faces, options.points)
        faces, points = (text and tuple(part.strip() for part in text.split(",")) for text in labels)
        write_text(options.out, frame_text(result, faces=faces, points=points, force=options.force))
    else:
        export(result, options.to, options.out, source=options.source, prefix=options.prefix, force=options.force)
    remarks = remark(result, form=options.to)
    found = {"form": options.to, "verdict": result.verdict, "remarks": remarks, "written": [options.out]}
    answer(options, found, f"Written: {options.out}", *remarks)
    return DONE
