"""Where a result comes from: its schema, the problem and its files, the arm as data; the head of result.json."""

from __future__ import annotations

import logging
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from casacal.compensation.result_file import SCHEMA
from casacal.errors import CasacalError
from casacal.least_squares.result import Result
from casacal.problem.as_data import problem_data
from casacal.problem.problem_file import ProblemFile

_LOG = logging.getLogger("casacal")


def head_of(source: ProblemFile, result: Result, seed: int, backend: str, folder: Path | None) -> dict[str, Any]:
    """The head of result.json in a folder; of a document that stays in memory where there is none."""
    files = [{**asdict(file), "path": seen_from(folder, file.path)} for file in source.files]
    try:
        arm = problem_data(source.problem)
    except CasacalError as error:
        arm = None
        _LOG.warning("casacal: the result needs its problem file, for it cannot hold the arm: %s", error)
    return {
        "schema": SCHEMA,
        "problem": {
            "name": source.name,
            "path": seen_from(folder, source.path),
            "sha256": source.sha256,
            "files": files,
        },
        "arm": arm,
        "method": result.method,
        "status": result.message,
        "converged": result.converged,
        "seed": seed,
        "backend": backend,
    }


def seen_from(folder: Path | None, file: str) -> str:
    """A path as a file in a folder names it; as it is where there is no folder, no such file, or no way between."""
    if folder is None or not file or not Path(file).exists():
        return file
    try:
        return Path(os.path.relpath(Path(file).resolve(), folder.resolve())).as_posix()
    except ValueError:  # another drive
        return Path(file).resolve().as_posix()
