"""What several commands share: how problems, samples and results are named, and exit codes."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from casacal.errors import CasacalError

if TYPE_CHECKING:
    from casacal.compensation.arm import CalibratedArm
    from casacal.problem.problem_file import ProblemFile

DONE, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


def add_problem(parser: argparse.ArgumentParser) -> None:
    """The problem a command is about."""
    parser.add_argument("problem", metavar="PROBLEM", help="a folder with a problem.py, or such a file")


def add_result(parser: argparse.ArgumentParser) -> None:
    """The result a command is about."""
    parser.add_argument(
        "result", metavar="RESULT", help="result.json of casacal calibrate, or the .truth.json of casacal simulate"
    )


def add_force(parser: argparse.ArgumentParser) -> None:
    """Whether a result counts whose verdict is not to use it."""
    parser.add_argument(
        "--force",
        action="store_true",
        help="take a result whose verdict is not to use it, and write that into the file",
    )


def spare(outs: Iterable[str | Path], *inputs: str | Path | None) -> None:
    """Raise CasacalError where a command would write over what it reads."""
    for out in outs:
        for given in inputs:
            if given is not None and Path(given).is_file() and Path(out).exists() and Path(out).samefile(given):
                raise CasacalError(f"'{out}' is to be written, and it is what the command reads", "Name another --out")


def made_from(result: CalibratedArm) -> list[Path]:
    """The files that a result's arm and samples came from, where they may still stand."""
    place = Path(result.file).parent
    data = result.document.get("data") or {}
    named = [file.path for file in result.source.files] + [data.get("file")]
    return [place / name for name in named if isinstance(name, str) and name]


def whole_number(text: str) -> int:
    """A seed, as argparse reads it: zero or a positive whole number."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number from zero on")
    return int(text)


def add_json(parser: argparse.ArgumentParser) -> None:
    """Whether the answer is for another program."""
    parser.add_argument("--json", action="store_true", help="print the answer as JSON, and nothing else")


def add_samples(parser: argparse.ArgumentParser) -> None:
    """The samples a command reads, and readings that come apart from them."""
    parser.add_argument(
        "samples",
        metavar="SAMPLES",
        nargs="?",
        help="CSV, .xlsx, .npy or .npz; default: samples.csv beside the problem",
    )
    parser.add_argument("--readings", metavar="FILE", help="CSV or .xlsx with the readings, when SAMPLES has none")
    parser.add_argument(
        "--id", default="pose", metavar="COLUMN", help="column that joins readings to their poses; default: pose"
    )


def samples_of(source: ProblemFile, given: str | None) -> str:
    """The samples file that was named, or the one beside the problem; raises CasacalError when there is none."""
    if given is not None:
        if not given.strip():
            raise CasacalError("SAMPLES is empty", "Name a file, or leave it out for samples.csv beside the problem")
        return given
    if source.samples is None or not source.samples.is_file():
        raise CasacalError(f"{source.path} has no samples.csv beside it", "Name a samples file")
    return source.samples.as_posix()
