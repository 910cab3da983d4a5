"""`casacal export`: write a calibrated arm as DH table, URDF, zero offsets or C."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from casacal.cli.common import DONE, add, add_force, add_instrument, add_json, add_result, made_from, spare
from casacal.cli.terminal import say_json, say_paragraph
from casacal.errors import CasacalError

if TYPE_CHECKING:
    pass


HELP = "write a calibrated arm as DH table, URDF, zero offsets or C"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Say what `casacal export` takes."""
    parser.description = "Write a calibrated arm in a form that other programs read."
    add_result(parser)
    add_instrument(parser, "instrument whose tip is meant; default: the first")
    add(
        parser,
        "--to",
        "DH table (CSV, or TOML where FILE ends in .toml), URDF, zero corrections (CSV), the kinematics file of "
        "ur_description (YAML), C99, or the frame of a work object (--faces or --points)",
        choices=("dh", "urdf", "zeros", "ur", "c", "frame"),
        required=True,
    )
    add(parser, "--out FILE", "file to write", required=True)
    add(parser, "--source FILE", "for dh and urdf: a file of yours to copy with only its numbers changed")
    add(parser, "--prefix WORD", "for c: prefix of function names; default: the problem's name")
    add(parser, "--faces A,B,C", "for frame: z of the first face, x of the second, all three")
    add(parser, "--points A,B,C", "for frame: origin, a point along x, a point beside it")
    add_force(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Write a calibrated arm in the form that --to names; returns 0."""
    from casacal.compensation.result_file import read_result, verdict_part
    from casacal.compensation.seen_by import seen_by
    from casacal.export import remark
    from casacal.export.forms import export
    from casacal.export.work_frame import frame_text
    from casacal.files import write_text

    if options.to != "frame" and (options.faces or options.points):
        raise CasacalError(f"--to {options.to} has no work object", "Leave out --faces and --points")
    if options.source is not None and options.to not in ("dh", "urdf"):
        raise CasacalError(f"--to {options.to} writes no file back", "Leave out --source")
    spare([options.out], options.result, options.source)
    result = seen_by(read_result(options.result), options.instrument)
    spare([options.out], *made_from(result))
    prefix = options.prefix if options.to == "c" else None
    if options.to == "frame":
        faces, points = (
            text and tuple(part.strip() for part in text.split(",")) for text in (options.faces, options.points)
        )
        write_text(options.out, frame_text(result, faces=faces, points=points, force=options.force))
    else:
        export(result, options.to, options.out, source=options.source, prefix=prefix, force=options.force)
    if options.json:
        said = {"form": options.to, "verdict": verdict_part(result), "remarks": remark(result, form=options.to)}
        say_json({**said, "written": [options.out]})
        return DONE
    say_paragraph(f"Written: {options.out}")
    for line in remark(result, form=options.to):
        say_paragraph(line)
    return DONE
