"""The command line's door: commands by name, refusals in one line, exit codes."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from typing import NoReturn

from casacal.cli import calibrate, check, compensate, doctor, export, new, predict, simulate, study
from casacal.cli.common import BAD_INPUT, FAILED, INTERRUPTED
from casacal.errors import CasacalError
from casacal.threads import one_thread_each

COMMANDS = {
    "calibrate": calibrate,
    "simulate": simulate,
    "check": check,
    "doctor": doctor,
    "predict": predict,
    "compensate": compensate,
    "study": study,
    "new": new,
    "export": export,
}
"""Each a module with `HELP`, `add_arguments(parser)` and `run(options)`; they import what they need when they run."""


class _Parser(argparse.ArgumentParser):
    """Refuses in one line, as every other refusal of casacal."""

    def error(self, message: str) -> NoReturn:
        raise CasacalError(f"{self.prog}: {message}", f"See {self.prog} --help")


def build_parser() -> argparse.ArgumentParser:
    """Parser whose `run` is one command's; it raises CasacalError in place of printing usage."""
    parser = _Parser(prog="casacal", description="Calibrate a robot arm with a dial indicator and a flat face.")
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)
    for name, command in COMMANDS.items():
        below = subparsers.add_parser(name, help=command.HELP)
        command.add_arguments(below)
        below.set_defaults(run=command.run)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns 0 done, 1 not converged or a check failed, 2 bad input."""
    one_thread_each()
    try:
        typed = sys.argv[1:] if arguments is None else list(arguments)
        options = build_parser().parse_args(typed)
        options.typed = shlex.join(["casacal", *typed])
        return int(options.run(options))
    except CasacalError as error:
        print(f"casacal: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("casacal: Interrupted. Nothing was written half.", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        sys.stderr.close()
        return FAILED
