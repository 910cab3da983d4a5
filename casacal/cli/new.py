"""`casacal new`: a problem folder from a DH table or a URDF."""

from __future__ import annotations

import argparse

from casacal.cli.common import DONE
from casacal.errors import CasacalError

HELP = "a problem folder from a DH table or a URDF"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Say what `casacal new` takes."""
    parser.description = "Write a problem folder for an arm that comes as a DH table or as a URDF."
    parser.add_argument("name", metavar="NAME", help="of the folder, which must not exist")
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--dh", metavar="FILE", help="DH table in CSV or TOML")
    source.add_argument("--urdf", metavar="FILE", help="URDF, xacro already expanded")
    parser.add_argument("--tip", metavar="LINK", help="link that is the flange; default: the only last one")
    parser.add_argument("--base", metavar="LINK", help="link that is the base frame; default: the root")
    parser.add_argument("--out", metavar="DIR", default=".", help="where the folder goes; default: here")


def run(options: argparse.Namespace) -> int:
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
    return DONE
