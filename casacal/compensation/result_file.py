"""result.json and truth.json, read back: the document, and the problem it answers."""

from __future__ import annotations

import json
import pickle
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from casacal.compensation.arm import CalibratedArm
from casacal.errors import CasacalError
from casacal.files import place_whole
from casacal.problem.problem import Problem
from casacal.problem.problem_file import ProblemFile, load_problem
from casacal.samples.layout import LARGEST
from casacal.unknowns import Parameter

PROBLEM_BESIDE = "problem.pickle"
"""The problem as a value, beside a result that was saved, so that the folder can go elsewhere."""


def read_result(path: str | Path, *, problem: Problem | None = None) -> CalibratedArm:
    """Read a result.json or a truth, or a folder with a result.json, and find its problem.

    The problem is the one that is given, else the problem.py that the result names, where that exists, else what was
    saved beside the result. A result runs its problem's code, as problem.py does: read only results that you trust.

    Raises CasacalError when it is not one, or when its problem is gone or has changed since.
    """
    place = Path(path) / "result.json" if Path(path).is_dir() else Path(path)
    file = str(place)
    try:
        document = json.loads(place.read_text(encoding="utf-8"))
        _ = document["problem"]["path"], document["problem"]["sha256"]
        numbers = [(row["name"], row["estimate"]) for row in document["parameters"]]
    except FileNotFoundError:
        raise CasacalError(
            f"{file}: there is no such file", "Give the result.json that calibrate --out wrote"
        ) from None
    except (OSError, ValueError, KeyError, TypeError):
        raise CasacalError(f"{file}: this is not a result of casacal", "Give a result.json or a truth.json") from None
    _check_numbers(file, numbers)
    source = _problem_of(place, document) if problem is None else ProblemFile.of(problem, document["problem"]["name"])
    _check_nominal(file, source, document)
    return CalibratedArm(file, source, document)


def _check_numbers(file: str, numbers: Sequence[tuple[str, Any]]) -> None:
    """Refuse a result that somebody edited: estimates that are no numbers, absurd, or there twice."""
    for name, estimate in numbers:
        known = isinstance(estimate, (int, float)) and not isinstance(estimate, bool)
        if not known or not abs(estimate) < LARGEST["length"]:
            raise CasacalError(
                f"{file}: the estimate of '{name}' is {estimate!r}", "Restore the file, or calibrate again"
            )
    twice = {name for name, count in Counter(name for name, _ in numbers).items() if count > 1}
    if twice:
        raise CasacalError(f"{file}: '{sorted(twice)[0]}' stands there twice", "Restore the file, or calibrate again")


def _problem_of(place: Path, document: Mapping[str, Any]) -> ProblemFile:
    """The problem that a result answers, from its own file or from what was saved beside the result."""
    named, digest = document["problem"]["path"], document["problem"]["sha256"]
    saved = place.parent / PROBLEM_BESIDE
    for path in (Path(named), place.parent / named) if named else ():
        if path.exists():
            source = load_problem(path)
            if source.sha256 != digest:
                raise CasacalError(
                    f"{place}: its problem {source.path} has changed since the calibration",
                    "Calibrate again, or restore the problem file",
                )
            return source
    if saved.is_file() and (source := _saved_problem(saved)).sha256 == digest:
        return source
    if named:
        return load_problem(named)  # which says what is missing
    raise CasacalError(
        f"{place}: its problem was made in Python and '{PROBLEM_BESIDE}' is not beside it",
        "Give the problem: casacal.load(path, problem=...)",
    )


def _saved_problem(saved: Path) -> ProblemFile:
    try:
        source = pickle.loads(saved.read_bytes())
    except CasacalError:
        raise
    except Exception as error:  # another version of casacal or of what the problem imports
        raise CasacalError(
            f"{saved} cannot be read here: {type(error).__name__}: {' '.join(str(error).split())}",
            "Give the problem: casacal.load(path, problem=...)",
        ) from error
    if not isinstance(source, ProblemFile):
        raise CasacalError(f"{saved} holds no problem", "Restore the file, or give the problem")
    return source


def save_problem(folder: Path, source: ProblemFile) -> Path | None:
    """Write a problem as a value beside a result; None, and nothing, where its code cannot be taken elsewhere."""
    try:
        data = pickle.dumps(source)
    except Exception:  # a user's class may hold anything
        return None
    place_whole(folder / PROBLEM_BESIDE, lambda place: place.write_bytes(data))
    return folder / PROBLEM_BESIDE


def _check_nominal(file: str, source: ProblemFile, document: Mapping[str, Any]) -> None:
    """Refuse a result whose arm has changed since, as where problem.py reads a URDF that was edited."""
    began = {row["name"]: row.get("nominal") for row in document["parameters"]}
    for key, unknown in source.problem.robot.parameters.items():
        if not isinstance(unknown, Parameter) or unknown.nominal is None:
            continue
        for name, value in zip(unknown.component_names(key), np.ravel(unknown.nominal), strict=True):
            was = began.get(name)
            if isinstance(was, (int, float)) and abs(was - value) > 1e-9 * (1 + abs(value)):
                raise CasacalError(
                    f"{file}: its arm has changed since the calibration ('{name}' was {was:g} and is {value:g})",
                    "Calibrate again, or restore the file that the problem reads",
                )
