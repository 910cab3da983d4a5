"""Check of a result.json: refused in a sentence that names the part, before anything relies on it."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any

import numpy as np

from casacal.errors import CasacalError
from casacal.samples.repeats import is_listing

FIX = "Restore the file, or calibrate again"


def schema_text() -> str:
    """The JSON schema (draft 2020-12) of result.json, as `casacal schema` prints it."""
    return (resources.files("casacal.compensation") / "result.schema.json").read_text(encoding="utf-8")


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
        if len(part.get("off", ())) != len(names):
            raise CasacalError(f"{file}: the 'off' of its discrepancy is {_short(part.get('off'))}", FIX)
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
    """Where a value does not fit what result.schema.json uses of JSON Schema: the way there, and what stands there."""
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
