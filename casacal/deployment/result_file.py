"""result.json read again: checked against its schema part by part, sealed by a hash, returned as a typed result."""

from __future__ import annotations

import ast
import json
import math
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from casacal.data.repeats import is_listing
from casacal.deployment.arm import CalibratedArm, for_instrument
from casacal.deployment.as_data import problem_from
from casacal.deployment.result import SCHEMA
from casacal.errors import CasacalError, came
from casacal.files import BY, recover, seal_of
from casacal.model.dh_table import DHTable
from casacal.model.problem import Problem
from casacal.model.problem_file import ProblemFile, SourceFile, load_problem
from casacal.model.robot import Arm
from casacal.model.unknown import Parameter
from casacal.wording import lower

FIX = "Restore the file, or calibrate again"
RESTORE = "Restore it, or calibrate again"
LARGEST_SOURCE = 100_000_000  # bytes beyond which a file is none that an arm was made from


def schema_text() -> str:
    """The JSON schema (draft 2020-12) of result.json, as `casacal schema` prints it."""
    return (resources.files("casacal.deployment") / "result.schema.json").read_text(encoding="utf-8")


@cache
def _schema() -> dict[str, Any]:
    return json.loads(schema_text())  # type: ignore[no-any-return]


def check_document(file: str, document: Any) -> None:
    """Raise CasacalError unless a document is a result whose parts can be relied on."""
    if not isinstance(document, dict) or not isinstance(document.get("problem"), dict):
        raise CasacalError(f"{file}: this is not a result of casacal", "Give a result.json or a truth.json")
    for path, value in misfits(_schema(), document):
        raise CasacalError(f"{file}: {_words(document, path)} is {_short(value)}", FIX)
    values = {row["name"]: row["value"] for row in document.get("unknowns", ())}
    for what in ("parameters", "unknowns"):
        count = Counter(row["name"] for row in document.get(what, ()))
        if twice := sorted(name for name in count if count[name] > 1):
            raise CasacalError(f"{file}: '{twice[0]}' appears twice among its {what}", FIX)
    for row in document["parameters"]:
        change = row["estimate"] - row["nominal"]
        if abs(values.get(row["name"], change) - change) > 1e-6 * (1 + abs(change)):
            raise CasacalError(f"{file}: it says two things of '{row['name']}'", FIX)
    listed = (document.get("data") or {}).get("fitted_rows")
    if listed is not None and not is_listing(listed):
        raise CasacalError(f"{file}: its 'data' lists no rows: {_short(listed)}", FIX)
    if document.get("verdict") is None and document.get("schema") and document.get("method") != "truth":
        raise CasacalError(f"{file}: it holds no verdict", FIX)
    some = document.get("covariance_of", list(values))
    if not set(some) <= set(values):
        raise CasacalError(f"{file}: its 'covariance_of' is {_short(some)}", FIX)
    _check_covariance(file, document.get("covariance"), len(some))
    if document.get("discrepancy") is not None:
        _check_discrepancy(file, document["discrepancy"])


def _check_discrepancy(file: str, part: Mapping[str, Any]) -> None:
    if "told" in part:
        what = f"{file}: it is of an earlier version, with an arm for each choice of columns"
        raise CasacalError(what, "Calibrate again with this version")
    corrected, further = part.get("corrected", []), part.get("further", {})
    if not set(corrected) <= {effect["key"] for effect in part["effects"]}:
        raise CasacalError(f"{file}: the 'corrected' of its discrepancy is {_short(corrected)}", FIX)
    if corrected and not part.get("without_corrections"):
        raise CasacalError(f"{file}: its discrepancy does not give the arm without corrections", FIX)
    if not set(further) <= set(corrected):
        raise CasacalError(f"{file}: its columns of effects are {_short(further)}", FIX)
    if further and not (part.get("mean") and set(part["mean"]) == set(part.get("spread", ()))):
        raise CasacalError(f"{file}: it does not say what the columns of effects held in the fitted rows", FIX)
    names = part.get("covariance_of", [])
    if "covariance" in part:
        if not names or len(set(names)) < len(names):
            raise CasacalError(f"{file}: the 'covariance_of' of its discrepancy is {_short(names)}", FIX)
        for each in ("off", "estimate"):
            if len(part.get(each, () if each == "off" else names)) != len(names):  # older files have no estimate
                raise CasacalError(f"{file}: the '{each}' of its discrepancy is {_short(part.get(each))}", FIX)
        _check_covariance(file, part["covariance"], len(names))


def _check_covariance(file: str, rows: list[list[float | None]] | None, count: int) -> None:
    """A symmetric table of numbers, null where a variance is infinite."""
    if rows is None:
        return
    what = f"{file}: its covariance is no symmetric table of {count} x {count} numbers"
    if len(rows) != count or any(len(row) != count for row in rows):
        raise CasacalError(what, FIX)
    table = np.array(rows, dtype=np.float64).reshape(count, count)  # null becomes NaN
    variances = np.nan_to_num(np.diagonal(table))
    stds = np.sqrt(np.abs(variances))
    if (np.abs(table - table.T) > 1e-8 * np.outer(stds, stds)).any():
        raise CasacalError(what, FIX)
    if (variances < 0).any():
        raise CasacalError(f"{file}: its covariance has negative variances", FIX)


Way = tuple[str | int, ...]
TYPES: Mapping[str, Callable[[Any], bool]] = {
    "null": lambda value: value is None,
    "boolean": lambda value: isinstance(value, bool),
    "string": lambda value: isinstance(value, str),
    "integer": lambda value: TYPES["number"](value) and value % 1 == 0,  # JSON Schema takes 2.0 for an integer
    "number": lambda value: isinstance(value, (int, float)) and not isinstance(value, bool) and value == value,
    "array": lambda value: isinstance(value, list),
    "object": lambda value: isinstance(value, dict),
}


def misfits(schema: Mapping[str, Any], value: Any, path: Way = ()) -> Iterator[tuple[Way, Any]]:
    """Violations of result.schema.json in a value: the path to each, and the value there."""
    if "$ref" in schema:
        schema = {**_schema()["$defs"][schema["$ref"].rpartition("/")[2]], **schema}
    kinds = schema.get("type", ())
    some = (kinds,) if isinstance(kinds, str) else kinds
    if (some and not any(TYPES[kind](value) for kind in some)) or value not in schema.get("enum", (value,)):
        yield path, value
    elif TYPES["number"](value):
        within = schema.get("exclusiveMinimum", -math.inf) < value < schema.get("exclusiveMaximum", math.inf)
        if not within or value < schema.get("minimum", -math.inf):
            yield path, value
    elif isinstance(value, list):
        for place, item in enumerate(value if "items" in schema else ()):
            yield from misfits(schema["items"], item, (*path, place))
    elif isinstance(value, dict):
        yield from (((*path, key), None) for key in schema.get("required", ()) if key not in value)
        named, other = schema.get("properties", {}), schema.get("additionalProperties", {})
        for key, item in value.items():
            yield from misfits(named.get(key, other), item, (*path, key))


def _words(document: Any, path: Sequence[str | int]) -> str:
    """A part of a document in words, such as "the estimate of 'a2'" or "its 'verdict.level'"."""
    holder = document
    for step in path[:-1]:
        holder = holder[step]
    if isinstance(holder, dict) and isinstance(holder.get("name"), str) and path[-1] != "name" and len(path) > 1:
        return f"the {path[-1]} of '{holder['name']}'"
    return f"its '{'.'.join(map(str, path))}'"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."


def read_result(path: str | Path, *, problem: Problem | None = None) -> CalibratedArm:
    """Read a result.json or a truth, or a folder with a result.json.

    The problem is the one that is given, else the one that the result holds. A result from before results held one
    runs the problem.py that it names, once its SHA-256 is that of the calibration.

    Raises CasacalError when it is not one, is damaged, was changed after it was written, is newer than this version, or
    its arm has changed since.
    """
    if not isinstance(path, (str, Path)):
        raise CasacalError(f"Got {came(path)} as a result", "Give the path of a result.json, or of its folder")
    place = Path(path) / "result.json" if Path(path).is_dir() else Path(path)
    recover(place.parent)
    document = _read(place)
    if problem is not None:
        source = ProblemFile.of(problem, document["problem"]["name"])
    elif document.get("arm") is not None:
        source = _own_problem(place, document)
    else:
        source = _older_problem(place, document)
    began = {row["name"]: row["nominal"] for row in document["parameters"]}
    for key, unknown in source.problem.robot.parameters.items():  # is the arm the one that the result began with?
        if not isinstance(unknown, Parameter) or unknown.nominal is None:
            continue
        for name, value in zip(unknown.component_names(key), np.ravel(unknown.nominal), strict=True):
            was = began.get(name, value)
            if abs(was - value) > 1e-9 * (1 + abs(value)):
                what = f"{place}: its arm has changed since the calibration ('{name}' was {was:g} and is {value:g})"
                raise CasacalError(what, "Calibrate again, or restore the file that the problem reads")
    return CalibratedArm(str(place), source, document)


def _read(place: Path) -> dict[str, Any]:
    fix = "Give the result.json that calibrate --out wrote"
    try:
        document = json.loads(place.read_text(encoding="utf-8"), object_pairs_hook=_without_twins)
    except FileNotFoundError:
        raise CasacalError(f"{place}: there is no such file", fix) from None
    except OSError as error:
        raise CasacalError(f"{place}: it cannot be read ({error.strerror})", fix) from None
    except (ValueError, RecursionError):
        raise CasacalError(f"{place}: this is not a result of casacal", fix) from None
    schema = document.get("schema") if isinstance(document, dict) else None
    if isinstance(schema, int) and schema > SCHEMA:
        what = f"{place}: a newer casacal wrote it (schema {schema}; this one reads up to {SCHEMA})"
        raise CasacalError(what, "Update casacal")
    check_document(str(place), document)
    if "seal" in document or "arm" in document:  # what an older casacal wrote has neither, and is refused later
        seal, digest = document.get("seal"), None
        if not isinstance(seal, dict) or not isinstance(seal.get("of"), list):
            raise CasacalError(f"{place}: its seal is gone, so it was changed after it was written", RESTORE)
        with suppress(ValueError, RecursionError):
            digest = seal_of(document, seal["of"]) if all(isinstance(key, str) for key in seal["of"]) else None
        if digest is None or seal.get("sha256") != digest:
            raise CasacalError(f"{place}: it was changed after it was written", RESTORE)
    document.pop(BY, None)
    return document  # type: ignore[no-any-return]


def _without_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) < len(pairs):
        raise ValueError("a key appears twice")
    return made


def _own_problem(place: Path, document: Mapping[str, Any]) -> ProblemFile:
    """The problem that a result holds; refused where the files that it was made from still stand and differ."""
    said = document["problem"]
    try:
        problem = problem_from(document["arm"])
    except CasacalError as error:
        raise CasacalError(f"{place}: {lower(error.what)}", error.fix) from error
    path = place.parent / said["path"]
    shown = path.as_posix() if said["path"] and path.is_file() else ""
    files = tuple(SourceFile(each["path"], each["sha256"], each["text"]) for each in said.get("files", []))
    for kept in files:
        path = Path(os.path.normpath(place.parent / kept.path))
        try:
            if not path.is_file() or path.stat().st_size > LARGEST_SOURCE:  # it went elsewhere: the result stands alone
                continue
            now = SourceFile.read(path)
        except OSError:
            continue
        same = now.sha256 == kept.sha256 or same_code(path, now.text, kept.text)
        if not same and not _same_arm(path, problem.robot.arm):
            fix = "Calibrate again, restore that file, or move the result elsewhere to use the arm as it was"
            raise CasacalError(f"{place}: {path} has changed since the calibration", fix)
    return ProblemFile(said["name"], shown, said["sha256"], problem, None, files)


def same_code(path: Path, one: str, other: str) -> bool:
    """Whether two Python files differ in comments and layout alone."""
    try:
        return path.suffix == ".py" and ast.dump(ast.parse(one)) == ast.dump(ast.parse(other))
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return False


def _same_arm(path: Path, arm: Arm | None) -> bool:
    """Whether a URDF or a DH table is the same but for comments and layout."""
    from casacal.model.dh_file import read_dh_file
    from casacal.model.urdf import UrdfChain

    try:
        if isinstance(arm, UrdfChain) and path.name == arm.file:
            there = UrdfChain.read(path, arm.chain[0].parent, arm.chain[-1].child, arm.conventions)
            return [replace(joint, line=0) for joint in there.chain] == [replace(joint, line=0) for joint in arm.chain]
        return isinstance(arm, DHTable) and path.suffix != ".py" and read_dh_file(path) == arm
    except CasacalError:
        return False


def _older_problem(place: Path, document: Mapping[str, Any]) -> ProblemFile:
    """The problem.py of a result that holds no problem of its own, which is run only if it is what it was."""
    named, digest = document["problem"]["path"], document["problem"]["sha256"]
    for path in (Path(named), place.parent / named) if named else ():
        file = path / "problem.py" if path.is_dir() else path
        if file.is_file():
            if SourceFile.read(file).sha256 != digest:
                fix = "Calibrate again, or restore the problem file"
                raise CasacalError(f"{place}: its problem {file.as_posix()} has changed since the calibration", fix)
            return load_problem(path)
    what = f"its problem '{named}' is not there" if named else "it holds no problem"
    raise CasacalError(f"{place}: {what}", "Give the problem: casacal.load(path, problem=...), or calibrate again")


def arm_from(source: Any) -> CalibratedArm:
    """The arm itself, or that of a calibration, with its first instrument; raises CasacalError."""
    arm = source if isinstance(source, CalibratedArm) else getattr(source, "arm", None)
    if not isinstance(arm, CalibratedArm):
        fix = "Give a calibration, or what casacal.load or casacal.deployment.read_result returns"
        raise CasacalError(f"Got {came(source)} as the calibrated arm", fix)
    return for_instrument(arm)
