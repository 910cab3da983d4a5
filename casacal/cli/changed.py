"""`casacal changed`: whether the robot has changed since it was calibrated, what, and by how much."""

from __future__ import annotations

import argparse
from pathlib import Path

from casacal.cli import common
from casacal.cli.common import DONE, FAILED, JSON, add, whole_number
from casacal.cli.fresh import add_fresh_rows, fresh_rows
from casacal.cli.terminal import answer

HELP = "detect changes since calibration: what, and by how much"

TOUCHES = 6  # how many touches are proposed where causes cannot be told apart


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal changed`."""
    parser.description = (
        "Tell from fresh rows whether an encoder zero, the tool, the base or a face has changed since the "
        "calibration, which one and by how much. Where the rows cannot tell, plan the touches that would. Exit 1 if "
        "something changed or is undecided."
    )
    add_fresh_rows(parser, "faces that have not been moved since the calibration")
    add(parser, "--alarm RATE", "rate of false alarms, 0.001 to 0.5; default: 0.01", kind=float, default=0.01)
    add(parser, "--drift NAME=STD ...", "allowed drift since, a standard deviation in mm or rad, such as theta=2e-5")
    add(parser, "--touches FILE", f"write {TOUCHES} touches that would settle the cause, where needed")
    add(parser, "--seed K", "seed of random numbers; default: 0", kind=whole_number, default=0)
    add(parser, *JSON)


def run(options: argparse.Namespace) -> int:
    """Look as the options say; returns 0, or 1 when something changed or cannot be told."""
    from casacal.calibration.fresh import opened
    from casacal.changes.changed import looked, write_touches

    result, other, named, rows = fresh_rows(options)
    outs = [] if options.touches is None else [options.touches]
    read = (options.samples, options.readings, result.file, *common.made_from(result))
    common.spare(outs, *read, option="--touches")
    standing = common.names_of("--standing", options.standing)
    case = opened(result, rows, problem=other, instrument=named, standing=standing)
    drift = common.stds_of("--drift", options.drift, "theta=2e-5")
    touches = 0 if options.touches is None else TOUCHES
    found, _ = looked(case, standing, drift, alarm=options.alarm, touches=touches, seed=options.seed)
    said, written = found.summary().split("\n"), list[str]()
    if options.touches is not None and found.touches is not None:
        write_touches(options.touches, found, case.source.problem.layout(), case.source.name)
        written.append(Path(options.touches).as_posix())
        said.append(f"Written: {written[0]}")
    elif options.touches is not None:
        said.append(f"{options.touches} was not written: no touches are needed, or no useful ones are in reach.")
    answer(options, {**found.to_dict(), "written": written}, *said)
    return DONE if found.changed is False else FAILED
