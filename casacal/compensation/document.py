"""What a result.json must hold: refused in a sentence that names the part, before anything relies on it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

from casacal.errors import CasacalError
from casacal.samples.layout import LARGEST
from casacal.samples.repeats import is_listing

LEVELS = ("calibrated", "use with care", "do not use")  # of a verdict
HUGE = 1e300  # numbers that no arm has; an integer may be too long for any float
FIX = "Restore the file, or calibrate again"


def is_text(value: Any) -> bool:
    """Whether a value is a string."""
    return isinstance(value, str)


def is_number(value: Any) -> bool:
    """Whether a value is a finite number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < HUGE


def is_number_or_null(value: Any) -> bool:
    """Whether a value is a finite number, or null: infinite."""
    return value is None or is_number(value)


def _is_noise(noise: Mapping[str, Any]) -> bool:
    faces = noise.get("by_face")
    some = list(faces.values()) if isinstance(faces, dict) else [None]
    interval = all(map(is_number_or_null, map(noise.get, ("low", "high"))))
    return interval and all(isinstance(face, dict) and all(map(_is_size, map(face.get, STDS))) for face in some)


def _is_size(value: Any) -> bool:
    return is_number(value) and value > 0


def _is_fitted(data: Mapping[str, Any]) -> bool:
    fitted = data.get("fitted_rows")
    return fitted is None or (isinstance(fitted, dict) and is_listing(fitted))


def _is_verdict(value: Any) -> bool:
    return isinstance(value, dict) and value.get("level") in LEVELS and is_text(value.get("words"))


def _is_row(value: Any) -> bool:
    return isinstance(value, list) and all(map(is_number, value))


Shape = Callable[[Any], bool]
STDS = ("stated_mm", "used_mm")
FILE: Mapping[str, Shape] = {"path": is_text, "sha256": is_text, "text": is_text}
PARAMETER: Mapping[str, Shape] = {"name": is_text, "unit": is_text, "nominal": is_number, "estimate": is_number}
UNKNOWN: Mapping[str, Shape] = {"name": is_text, "value": is_number}
OPTIONAL: Mapping[str, Shape] = {
    "method": is_text,
    "status": is_text,
    "converged": lambda value: isinstance(value, bool),
    "cost": is_number_or_null,
    "schema": lambda value: isinstance(value, int) and not isinstance(value, bool),
    "metrics": lambda value: isinstance(value, dict) and all(isinstance(each, dict) for each in value.values()),
    "tip": lambda value: isinstance(value, dict) and all(map(is_number_or_null, value.values())),
    "verdict": _is_verdict,
    "arm": lambda value: isinstance(value, dict),
    "data": lambda value: isinstance(value, dict) and is_text(value.get("sha256")) and _is_fitted(value),
    "noise": lambda value: isinstance(value, dict) and _is_noise(value),
    "proposed": lambda value: isinstance(value, dict) and all(map(_is_row, value.values())),
    "versions": lambda value: isinstance(value, dict) and all(map(is_text, value.values())),
}


def check_document(file: str, document: Any) -> None:
    """Raise CasacalError unless a document is a result whose parts can be relied on."""
    if not isinstance(document, dict) or not isinstance(document.get("problem"), dict):
        raise CasacalError(f"{file}: this is not a result of casacal", "Give a result.json or a truth.json")
    _check(file, "problem", document["problem"], {"name": is_text, "path": is_text, "sha256": is_text})
    _rows(file, "problem.files", document["problem"].get("files", []), FILE)
    parameters = _rows(file, "parameters", document.get("parameters"), PARAMETER, "estimate")
    for row in parameters:
        if not is_number_or_null(row.get("std")):
            raise CasacalError(f"{file}: the std of '{row['name']}' is {_short(row['std'])}", FIX)
    unknowns = _rows(file, "unknowns", document.get("unknowns", []), UNKNOWN, "value")
    for what, rows in (("parameters", parameters), ("unknowns", unknowns)):
        twice = sorted(name for name, count in Counter(row["name"] for row in rows).items() if count > 1)
        if twice:
            raise CasacalError(f"{file}: '{twice[0]}' appears twice among its {what}", FIX)
    values = {row["name"]: row["value"] for row in unknowns}
    for row in parameters:
        change = row["estimate"] - row["nominal"]
        if abs(values.get(row["name"], change) - change) > 1e-6 * (1 + abs(change)):
            raise CasacalError(f"{file}: it says two things of '{row['name']}'", FIX)
    for key, fits in OPTIONAL.items():
        if document.get(key) is not None and not fits(document[key]):
            raise CasacalError(f"{file}: its '{key}' is {_short(document[key])}", FIX)
    if document.get("verdict") is None and document.get("schema") and document.get("method") != "truth":
        raise CasacalError(f"{file}: it holds no verdict", FIX)
    some = document.get("covariance_of", list(values))
    if not isinstance(some, list) or not all(map(is_text, some)) or not set(some) <= set(values):
        raise CasacalError(f"{file}: its 'covariance_of' is {_short(some)}", FIX)
    _check_covariance(file, document.get("covariance"), len(some))
    if document.get("discrepancy") is not None:
        _check_discrepancy(file, document["discrepancy"])


def _check_discrepancy(file: str, part: Any) -> None:
    """Effects beside the geometry, with their sizes, and how well all that moves the tip is known."""
    whole = isinstance(part, dict) and all(isinstance(part.get(key), list) for key in ("effects", "unknowns"))
    if not whole:
        raise CasacalError(f"{file}: its 'discrepancy' is {_short(part)}", FIX)
    _rows(file, "effects", part["effects"], {"key": is_text, "words": is_text, "times": _is_size})
    _rows(file, "effects", part["unknowns"], {"name": is_text, "value": is_number, "effect": is_text})
    corrected = part.get("corrected", [])
    if not isinstance(corrected, list) or not set(map(str, corrected)) <= {effect["key"] for effect in part["effects"]}:
        raise CasacalError(f"{file}: the 'corrected' of its discrepancy is {_short(corrected)}", FIX)
    alone = _rows(file, "values without corrections", part.get("without_corrections", []), UNKNOWN, "value")
    if corrected and not alone:
        raise CasacalError(f"{file}: its discrepancy does not give the arm without corrections", FIX)
    _check_told(file, part)
    if "covariance" in part:
        names = part.get("covariance_of")
        if not isinstance(names, list) or not all(map(is_text, names)) or len(set(names)) < len(names):
            raise CasacalError(f"{file}: the 'covariance_of' of its discrepancy is {_short(names)}", FIX)
        if not _is_row(part.get("off")) or len(part["off"]) != len(names):
            raise CasacalError(f"{file}: the 'off' of its discrepancy is {_short(part.get('off'))}", FIX)
        _check_covariance(file, part["covariance"], len(names))


def _check_told(file: str, part: Mapping[str, Any]) -> None:
    """Columns that tell effects, and the arm for each choice of them."""
    usual, further, told = part.get("usual", {}), part.get("further", {}), part.get("told", [])
    keys = {effect["key"] for effect in part["effects"]}
    named = isinstance(further, dict) and set(further) <= keys and all(map(_is_texts, further.values()))
    if not named or not isinstance(usual, dict) or not all(map(is_number, usual.values())):
        raise CasacalError(f"{file}: its columns of effects are {_short(further)}, {_short(usual)}", FIX)
    shape = {"effects": _is_texts, "expected_rms_mm": is_number_or_null, "verdict": _is_verdict}
    for each in _rows(file, "effects that columns tell", told, shape):
        _rows(file, "values where columns tell effects", each.get("unknowns"), UNKNOWN, "value")
        count = len(part.get("covariance_of") or ())
        if "off" in each and not (_is_row(each["off"]) and len(each["off"]) == count):
            raise CasacalError(f"{file}: the 'off' where columns tell effects is {_short(each['off'])}", FIX)
    choices = {frozenset(each["effects"]) for each in told}
    if len(choices) < 2 ** len(further) - 1 or not all(some and some <= set(further) for some in choices):
        raise CasacalError(f"{file}: the arm is missing where columns tell effects", FIX)


def _is_texts(value: Any) -> bool:
    return isinstance(value, list) and all(map(is_text, value))


def _rows(
    file: str, what: str, rows: Any, shape: Mapping[str, Shape], estimate: str | None = None
) -> list[dict[str, Any]]:
    """Rows of a shape; estimates, where one of its keys holds them, must be of a size that an arm can have."""
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise CasacalError(f"{file}: its {what} are {_short(rows)}", FIX)
    for row in rows:
        _check(file, what, row, shape)
        if estimate is not None and not abs(row[estimate]) < LARGEST["length"]:
            raise CasacalError(f"{file}: the estimate of '{row['name']}' is {row[estimate]!r}", FIX)
    return rows


def _check(file: str, what: str, part: Mapping[str, Any], shape: Mapping[str, Shape]) -> None:
    for key, fits in shape.items():
        if key not in part or not fits(part[key]):
            named = f" of '{part['name']}'" if key != "name" and is_text(part.get("name")) else f" in its {what}"
            raise CasacalError(f"{file}: the {key}{named} is {_short(part.get(key))}", FIX)


def _check_covariance(file: str, rows: Any, count: int) -> None:
    """A square of numbers, null where a variance is infinite."""
    if rows is None:
        return
    lists = isinstance(rows, list) and len(rows) == count and all(isinstance(row, list) for row in rows)
    numbers = lists and all(len(row) == count and all(map(is_number_or_null, row)) for row in rows)
    if not numbers or not all(_symmetric(rows, i, j) for i in range(count) for j in range(i)):
        raise CasacalError(f"{file}: its covariance is no symmetric table of {count} x {count} numbers", FIX)
    if any((rows[i][i] or 0.0) < 0 for i in range(count)):
        raise CasacalError(f"{file}: its covariance has negative variances", FIX)


def _symmetric(rows: list[list[float | None]], i: int, j: int) -> bool:
    """Whether two elements are equal to rounding; null stands for infinite ones."""
    one, other = rows[i][j], rows[j][i]
    stds = [math.sqrt(abs(rows[k][k] or 0.0)) for k in (i, j)]
    return one is None or other is None or abs(one - other) <= 1e-8 * stds[0] * stds[1]


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."
