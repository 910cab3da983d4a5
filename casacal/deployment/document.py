"""A result.json as the typed value that it holds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from casacal.deployment.result import (
    TIP_ERRORS,
    CalibrationResult,
    EffectFound,
    EffectsFound,
    FaceNoise,
    FittedData,
    MirrorImage,
    NoiseFound,
    ParameterFound,
    TipErrors,
    Verdict,
)
from casacal.values import Array, FrozenMapping, read_only


def result_of(document: Mapping[str, Any]) -> CalibrationResult:
    """The value that a result.json holds, which `check_document` found sound."""
    said, tip = document.get("verdict"), document.get("tip") or {}
    unknowns = _values(document.get("unknowns"))
    names, covariance, image = (document.get(key) for key in ("covariance_of", "covariance", "mirror_image"))
    mirror = image and MirrorImage(tuple(image["reversed"]), tuple(image["half_turned"]), float(image["off_mm"]))
    return CalibrationResult(
        method=str(document.get("method") or ""),
        status=str(document.get("status") or ""),
        converged=bool(document.get("converged", False)),
        verdict=Verdict(said["level"], said["words"], tuple(said.get("reasons") or ())) if said else None,
        parameters=tuple(
            ParameterFound(
                row["name"],
                row.get("unit", ""),
                float(row["nominal"]),
                float(row["estimate"]),
                _number(row.get("std")),
                str(row.get("known_from", "")),
            )
            for row in document.get("parameters", ())
        ),
        unknowns=FrozenMapping(unknowns),
        proposed=FrozenMapping({k: _array(v) for k, v in (document.get("proposed") or {}).items()}),
        planes=tuple(document.get("planes") or ()),
        covariance_of=tuple(unknowns) if names is None else tuple(names),
        covariance=None if covariance is None else _square(covariance, len(unknowns if names is None else names)),
        tip=TipErrors(*(_number(tip.get(f"{key}_rms_mm")) for key in TIP_ERRORS)),
        noise=_noise(document.get("noise") or {}),
        effects=_effects(document.get("discrepancy") or {}),
        data=_data(document.get("data") or {}),
        cost=_number(document.get("cost")),
        mirror_image=mirror,
    )


def _noise(part: Mapping[str, Any]) -> NoiseFound:
    faces = {}
    for name, face in (part.get("by_face") or {}).items():
        stated, used = float(face["stated_mm"]), float(face["used_mm"])
        faces[name] = FaceNoise(stated, used, float(face.get("without_joints_mm", used)))  # lacking in older files
    ratio, low, high = (_number(part.get(key)) for key in ("ratio", "low", "high"))
    joints, shared = (float(part.get(key) or 0.0) for key in ("joints_rad", "shared"))
    return NoiseFound(ratio, low, high, joints, int(part.get("loose_joint") or 0), FrozenMapping(faces), shared)


def _effects(part: Mapping[str, Any]) -> EffectsFound:
    names, covariance = tuple(part.get("covariance_of", ())), part.get("covariance")
    usual, mean, spread = (
        FrozenMapping({name: float(value) for name, value in part.get(key, {}).items()})
        for key in ("usual", "mean", "spread")
    )
    return EffectsFound(
        effects=tuple(
            EffectFound(each["key"], each["words"], float(each["times"])) for each in part.get("effects", ())
        ),
        corrected=tuple(part.get("corrected", ())),
        values=FrozenMapping(_values(part.get("unknowns"))),
        of=FrozenMapping({row["name"]: row["effect"] for row in part.get("unknowns", ())}),
        without_corrections=FrozenMapping(_values(part.get("without_corrections"))),
        covariance_of=names,
        covariance=None if covariance is None else _square(covariance, len(names)),
        off=None if covariance is None else _array(part["off"]),
        estimate=None if covariance is None or "estimate" not in part else _array(part["estimate"]),
        usual=usual,
        mean=mean,
        spread=spread,
        ranges=FrozenMapping({k: (float(v["lowest"]), float(v["highest"])) for k, v in part.get("range", {}).items()}),
        further=FrozenMapping({key: tuple(columns) for key, columns in part.get("further", {}).items()}),
        uncorrected_mm=_number(part.get("expected_rms_mm_without_corrections")),
    )


def _data(part: Mapping[str, Any]) -> FittedData:
    file = part.get("file")
    several = {name: each["file"] for name, each in (part.get("instruments") or {}).items() if "file" in each}
    name = file if isinstance(file, str) else None
    return FittedData(name, str(part.get("sha256", "")), part.get("fitted_rows"), FrozenMapping(several))


def _values(rows: Sequence[Mapping[str, Any]] | None) -> dict[str, float]:
    return {row["name"]: float(row["value"]) for row in rows or ()}


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _array(values: Any) -> Array:
    return np.asarray(read_only(np.array(values, dtype=np.float64)))


def _square(rows: Sequence[Sequence[float | None]], count: int) -> Array:
    """A covariance as JSON holds it, null where one is infinite."""
    numbers = np.array([[math.inf if value is None else value for value in row] for row in rows], dtype=np.float64)
    return np.asarray(read_only(numbers.reshape(count, count)))
