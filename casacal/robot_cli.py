"""The commands `casacal new` and `casacal export`: a robot model in, a calibrated one out."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from casacal.errors import CasacalError

if TYPE_CHECKING:
    from casacal.compensation.predict import ResultFile


def new_command(options: argparse.Namespace) -> int:
    """Write a problem folder for a DH table or a URDF; returns 0."""
    from casacal.problem.new import new_from_dh, new_from_urdf

    if options.dh is not None:
        if options.tip or options.base:
            raise CasacalError("--tip and --base name links of a URDF", "Leave them out with --dh")
        folder, table = new_from_dh(options.name, options.dh, options.out)
        print(f"{table.name}: {len(table.joints)} joints, {table.convention} DH")
        if table.parallel:
            axes = ", ".join(f"{row} and {row + 1}" for row in table.parallel)
            print(f"Parallel axes: {axes}; there Hayati's turn beta is calibrated in place of d")
    else:
        folder, arm = new_from_urdf(options.name, options.urdf, options.out, tip=options.tip, base=options.base)
        print(f"{arm.name}: {len(arm.moving)} joints from '{arm.chain[0].parent}' to '{arm.chain[-1].child}'")
    place = folder.as_posix()
    print(f"Written: {place}")
    print(f"Next: write your tool into {place}/problem.py, then casacal simulate {place} --out out/{options.name}.csv")
    return 0


def export_command(options: argparse.Namespace) -> int:
    """Write a calibrated arm in the form that --to names; returns 0."""
    from casacal.compensation.predict import read_result
    from casacal.export import remark
    from casacal.files import write_text

    if options.source is not None and options.to not in ("dh", "urdf"):
        raise CasacalError(f"--to {options.to} writes no file back", "Leave out --source")
    result = read_result(options.result)
    write_text(options.out, _exported(result, options))
    print(f"Written: {options.out}")
    for line in remark(result):
        print(line)
    return 0


def _exported(result: ResultFile, options: argparse.Namespace) -> str:
    """The text that is asked for."""
    from casacal.export import c_text, dh_text, ur_kinematics_text, urdf_text, zeros_text
    from casacal.robots.files.dh_file import is_toml

    if options.to == "dh":
        if options.source is not None and is_toml(options.source) != is_toml(options.out):
            raise CasacalError(
                f"'{options.out}' would hold what '{options.source}' holds", "End both names alike, in .csv or .toml"
            )
        return dh_text(result, options.source, toml=is_toml(options.out))
    if options.to == "urdf":
        return urdf_text(result, options.source)
    if options.to == "c":
        return c_text(result, prefix=options.prefix)
    return {"zeros": zeros_text, "ur": ur_kinematics_text}[options.to](result)
