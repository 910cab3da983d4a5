"""The command line's entry point: commands by name, refusals in one line, exit codes, interrupts that are heard."""

from __future__ import annotations

import argparse
import re
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, NoReturn

from casacal.cli.common import BAD_INPUT, DONE, FAILED, INTERRUPTED
from casacal.cli.terminal import complain, finish, prepare, redirect_words
from casacal.errors import CasacalError, RefusedResultError, refuse_unknown
from casacal.public import __version__
from casacal.threads import one_thread_each

AGAIN = 0.1  # seconds after which an interrupt that ended nothing is raised once more
GROUPS = {
    "describe the arm": ("new", "doctor"),
    "plan and measure": ("plan", "measure", "check", "serve"),
    "calibrate": ("calibrate", "verify", "iso9283", "changed"),
    "use the calibrated arm": ("predict", "compensate", "export"),
    "simulate and compare": ("simulate", "demo", "study", "bench"),
    "for other programs": ("schema", "completion"),
}
COMMANDS = tuple(name for names in GROUPS.values() for name in names)
"""In the order of the work. Each is a module of `casacal.cli` with `HELP`, `add_arguments(parser)` and `run(options)`,
imported when it is typed."""
EPILOG = (
    "The flange is the end of the arm (robot.pose of the problem); the tip is where the instrument touches. Lengths "
    "are in mm and angles in rad unless a name or a column says otherwise. Exit codes: 0 done; 1 the result must not "
    "be used, a check failed or a target was not reached; 2 bad input."
)
# a box, range or number below zero that argparse takes for an option
NEGATIVE = re.compile(r"-(inf$|[\d.]+([:,]|e-?\d))")


def heard(run: Callable[[], int]) -> int:
    """Run a command; re-raise an interrupt until it ends the command, except during its clean-up.

    Raises KeyboardInterrupt, also where the command went on to its end: what it says then may be wrong. Where there
    are no alarms (Windows), in a thread, and where others handle or ignore interrupts, all stays as it is.
    """
    if sys.platform == "win32" or threading.current_thread() is not threading.main_thread():
        return run()
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return run()
    came = over = False

    def interrupt(*_: Any) -> NoReturn:
        nonlocal came
        came = True
        signal.signal(signal.SIGALRM, remind)
        signal.setitimer(signal.ITIMER_REAL, AGAIN, AGAIN)
        raise KeyboardInterrupt

    def remind(*_: Any) -> None:
        error = sys.exception()
        while error is not None and not isinstance(error, KeyboardInterrupt):
            error = error.__context__
        tidying_up = error is not None  # in a `finally`, `except` or `with` that an interrupt passes
        if not (over or tidying_up):  # an alarm that was due as the run ended comes once it is over
            signal.raise_signal(signal.SIGINT)  # to whoever handles it now: it waits while files take their places

    before = signal.getsignal(signal.SIGALRM)
    signal.signal(signal.SIGINT, interrupt)
    try:
        code = run()
    finally:
        over = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if came:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)
    if came and code != INTERRUPTED:
        raise KeyboardInterrupt
    return code


class _Parser(argparse.ArgumentParser):
    """Refuses in one line, as every other refusal of casacal; `commands` are the parsers below it."""

    commands: dict[str, argparse.ArgumentParser]

    def format_help(self) -> str:
        """Help of argparse, but with the commands in their groups where there are any."""
        below = self._subparsers
        if below is None:
            return super().format_help()
        entry = {each.dest: each for each in below._group_actions[0]._get_subactions()}  # type: ignore[attr-defined]
        shown = self._get_formatter()
        shown.add_usage(self.usage, self._actions, self._mutually_exclusive_groups)
        shown.add_text(self.description)
        options = [each for each in self._actions if each.option_strings]
        listed = [(title, [entry[name] for name in names if name in entry]) for title, names in GROUPS.items()]
        for title, actions in [*listed, ("options", options)]:
            shown.start_section(title)
            shown.add_arguments(actions)
            shown.end_section()
        shown.add_text(self.epilog)
        return shown.format_help()

    def error(self, message: str) -> NoReturn:
        command = self.prog.removeprefix("casacal").strip()
        raise CasacalError(f"{command}: {message}" if command else message, f"See {self.prog} --help")


def build_parser(commands: Sequence[str] = COMMANDS) -> _Parser:
    """Parser whose `run` is one command's; it raises CasacalError in place of printing usage."""
    description = "Calibrate a robot arm with a dial indicator and a flat face."
    parser = _Parser(prog="casacal", description=description, epilog=EPILOG)
    parser.add_argument("--version", action="version", version=f"casacal {__version__}")
    parser.commands = {}
    subparsers = parser.add_subparsers(metavar="COMMAND", parser_class=_Parser)
    for name in commands:
        command = import_module(f"casacal.cli.{name}")
        below = subparsers.add_parser(name, help=command.HELP)
        command.add_arguments(below)
        below.set_defaults(run=command.run)
        parser.commands[name] = below
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns 0 done, 1 a result not to be used or a check failed, 2 bad input, 130 interrupted."""
    one_thread_each()
    prepare()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # NumPy's, of numbers that a sentence is said about
        code = _caught(sys.argv[1:] if arguments is None else list(arguments))
    try:
        finish()
    except CasacalError as error:
        complain(" ".join(str(error).split()))
        return BAD_INPUT
    return code


def _caught(typed: list[str]) -> int:
    try:
        named = [name for name in typed[:1] if name in COMMANDS]
        parser, typed = build_parser(named or COMMANDS), _ranges_joined(typed)
        if not typed:
            parser.print_help()
            return DONE
        if not typed[0].startswith("-"):
            refuse_unknown("command", typed[:1], COMMANDS)
        if typed[0] in COMMANDS:  # options may stand between what a command is about, which argparse lets none below
            options = parser.commands[typed[0]].parse_intermixed_args(typed[1:])
        else:
            options = parser.parse_args(typed)
        if "run" not in options:
            parser.error("a COMMAND is missing")
        out = getattr(options, "out", None)
        if out is not None and not out.strip():
            raise CasacalError("--out is empty", "Name where the answer is to be written")
        if out == "-":
            raise CasacalError("--out - names no file", "Standard output is /dev/stdout, a file of that name ./-")
        options.typed, options.whole = shlex.join(["casacal", *typed]), build_parser
        try:
            with redirect_words(out):
                return heard(lambda: int(options.run(options)))
        except SystemExit as end:
            raise CasacalError("Code of the problem's own ends the program (sys.exit)", "Take that out of it") from end
    except CasacalError as error:
        complain(" ".join(str(error).split()))
        return FAILED if isinstance(error, RefusedResultError) else BAD_INPUT
    except OSError as error:  # a name that is too long, say, which no reader or writer foresaw
        complain(f"'{error.filename or 'A file'}' cannot be used ({error.strerror}). Choose another name or place.")
        return BAD_INPUT
    except KeyboardInterrupt:
        complain("Interrupted. No file was left half-written.")
        return INTERRUPTED
    except SystemExit as end:  # argparse's, after --help and --version
        return DONE if end.code is None else int(end.code)


def _ranges_joined(typed: list[str]) -> list[str]:
    """--box -100:100,... as --box=-100:100,...: argparse takes what begins with a minus for an option."""
    found = list[str]()
    for each in typed:
        if found and found[-1].startswith("--") and "=" not in found[-1] and NEGATIVE.match(each):
            found[-1] += f"={each}"
        else:
            found.append(each)
    return found
