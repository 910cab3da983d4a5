"""The commands `casacal new` and `casacal export`: a robot model in, a calibrated one out."""

from __future__ import annotations

import argparse

from casacal.errors import CasacalError


def new_command(options: argparse.Namespace) -> int:
    """Write a problem folder for a DH table or a URDF; returns 0."""
    from casacal.new_problem import new_from_dh, new_from_urdf

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
