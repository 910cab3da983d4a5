"""`casacal serve`: a page beside the robot, from the cell to corrected targets."""

from __future__ import annotations

import argparse
from contextlib import ExitStack, closing
from pathlib import Path

from casacal.cli import cell, common
from casacal.cli.common import DONE, PROBLEM, add, whole_number
from casacal.cli.measure import add_gauge, frame_of
from casacal.cli.terminal import say_paragraphs
from casacal.errors import CasacalError

HELP = "the whole way on a page, for a tablet beside the robot"

HOST = "127.0.0.1"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal serve`."""
    parser.description = (
        "Serve a page that leads from the cell over conventions, plan, touches, calibration and verification to "
        "corrected targets. It is for this machine alone unless --host says otherwise, and opens with the token in the "
        "address that is printed. What it measures is the file that casacal measure writes: both can take turns."
    )
    add(parser, *PROBLEM)
    add(parser, "--instrument NAME", "which one takes the readings, where a problem has several instruments")
    words = "folder of plan, touches and calibration, new or to go on with; default: NAME_page in this folder"
    add(parser, "--out DIR", words)
    add(parser, "--plan FILE", "what casacal plan wrote, in place of one made on the page")
    words = "label of these touches where the problem tells sessions apart; default: as the plan has it"
    add(parser, "--session NAME", words)
    add(
        parser,
        "--tolerance MM",
        "enough is measured when the tip error is below this with 95 %% probability",
        kind=float,
    )
    cell.add_clearance(parser)
    add(parser, *cell.TILT, kind=float)
    add_gauge(parser)
    cell.add_joints(parser)
    add(parser, "--since RESULT", "an earlier result of this arm: the page also says what has changed since")
    add(parser, "--host ADDRESS", f"address to serve at, such as 0.0.0.0 for a tablet; default: {HOST}", default=HOST)
    add(parser, "--port N", "port; default: 8765, 0 takes a free one", kind=whole_number, default=8765)


def run(options: argparse.Namespace) -> int:
    """Serve until interrupted; returns 0."""
    from casacal.deployment.result_file import read_result
    from casacal.model.problem_file import load_problem
    from casacal.shopfloor.gauges import SerialLine, gauge
    from casacal.tablet.server import address_of, listening, server, token_of
    from casacal.tablet.work import Work, Workplace

    source = common.of_instrument(load_problem(options.problem), options.instrument)
    source = cell.in_cell(source, options, tilt=options.tilt)
    folder = Path(options.out or f"{source.name}_page")
    if folder.exists() and not folder.is_dir():
        raise CasacalError(f"--out '{folder}' is no folder", "Name a folder, or one that does not exist yet")
    if options.port > 65535:
        raise CasacalError(f"--port is {options.port}", "Give a number up to 65535")
    columns = common.columns_of_today(source, options.session)
    workplace = Workplace(
        source,
        folder,
        gauge(options.gauge, pattern=options.pattern, unit=options.unit, asks=options.ask),
        cell.table_of(source, options),
        cell.clearance_of(options, source),
        options.tolerance,
        None if options.plan is None else Path(options.plan),
        None if options.joints is None else cell.stands_of(options.joints, source.problem.robot),
        None if options.since is None else read_result(options.since),
        {} if options.session is None else dict.fromkeys(columns, options.session),
    )
    with ExitStack() as open_things:
        line = None
        if options.serial is not None:
            serial = SerialLine(options.serial, baud=options.baud, **frame_of(options.frame))
            line = open_things.enter_context(closing(serial))
        place = open_things.enter_context(closing(listening(options.host, options.port)))
        port, token = place.getsockname()[1], token_of(folder)
        work = Work(workplace, line=line)
        say_paragraphs(
            f"{address_of(options.host, port)}/?token={token}", f"Files go to {folder.as_posix()}; Ctrl-C ends"
        )
        server(work, token, port, options.host).run(sockets=[place])
    return DONE
