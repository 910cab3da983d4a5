"""`casacal export`: a calibrated arm as DH table, URDF, zero offsets or C."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from casacal.cli.common import DONE, add_json, add_result, made_from, spare
from casacal.cli.terminal import say_json, say_paragraph
from casacal.errors import CasacalError

if TYPE_CHECKING:
    from casacal.compensation.arm import CalibratedArm


HELP = "a calibrated arm as DH table, URDF, zero offsets or C"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Say what `casacal export` takes."""
    parser.description = "Write a calibrated arm in a form that other programs read."
    add_result(parser)
    parser.add_argument(
        "--to",
        required=True,
        choices=("dh", "urdf", "zeros", "ur", "c"),
        help="DH table (CSV, or TOML where FILE ends in .toml), URDF, zero corrections (CSV), the kinematics file of "
        "ur_description (YAML), or C99",
    )
    parser.add_argument("--out", required=True, metavar="FILE", help="file to write")
    parser.add_argument(
        "--source", metavar="FILE", help="for dh and urdf: a file to write back with only its numbers changed"
    )
    parser.add_argument(
        "--prefix", metavar="WORD", help="for c: what names of functions begin with; default: the problem's name"
    )
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Write a calibrated arm in the form that --to names; returns 0."""
    from casacal.compensation.result_file import read_result
    from casacal.export import remark
    from casacal.files import write_text

    if options.source is not None and options.to not in ("dh", "urdf"):
        raise CasacalError(f"--to {options.to} writes no file back", "Leave out --source")
    spare([options.out], options.result, options.source)
    result = read_result(options.result)
    spare([options.out], *made_from(result))
    write_text(options.out, _exported(result, options))
    if options.json:
        say_json({"form": options.to, "remarks": remark(result), "written": [options.out]})
        return DONE
    say_paragraph(f"Written: {options.out}")
    for line in remark(result):
        say_paragraph(line)
    return DONE


def _exported(result: CalibratedArm, options: argparse.Namespace) -> str:
    """The text that is asked for."""
    from casacal.export import c_text, dh_text, ur_kinematics_text, urdf_text, zeros_text
    from casacal.robots.files.dh_file import is_toml

    if options.to == "dh":
        if options.source is not None and is_toml(options.source) != is_toml(options.out):
            raise CasacalError(
                f"'{options.out}' and '{options.source}' are of different formats",
                "Let both names end in .csv, or both in .toml",
            )
        return dh_text(result, options.source, toml=is_toml(options.out))
    if options.to == "urdf":
        return urdf_text(result, options.source)
    if options.to == "c":
        return c_text(result, prefix=options.prefix)
    return {"zeros": zeros_text, "ur": ur_kinematics_text}[options.to](result)
