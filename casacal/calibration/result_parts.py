"""The parts of result.json: parameters, what the samples see, the reference, geometry, spreads, versions."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib import metadata
from typing import Any

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.noise_scale import REPEATABILITY, without_joints
from casacal.binding.slots import Slot
from casacal.calibration.calibration import Calibration
from casacal.calibration.doubts import tip_without_corrections, without_motion, without_tips
from casacal.calibration.methods import Reference
from casacal.calibration.metrics import parts_of
from casacal.calibration.motion import besides
from casacal.least_squares.result import Result
from casacal.uncertainty.discrepancy import times_found
from casacal.uncertainty.identifiability import verdict
from casacal.version import __version__

NOTES = {
    "data": "determined by the samples",
    "prior": "partly determined by the samples, partly by the prior",
    "no": "not determined: the prior's value and spread stand",
    "held": "held at nominal",
}


def parameter_rows(bound: BoundProblem, x: Array, stds: Array, *, denied: bool = False) -> list[dict[str, Any]]:
    """One entry per number of a parameter: name, unit, nominal, estimate, std, identifiable, note.

    Where the verdict denies the result, a standard deviation would be worth nothing: NaN.
    """
    rows = []
    for name, unit, nominal, j in bound.parameters():
        if j is None:
            row = {"estimate": nominal, "std": 0.0, "identifiable": "no", "note": NOTES["held"]}
        else:
            std = float(stds[j])
            word = verdict(std, float(bound.prior_std[j]))
            row = {
                "estimate": nominal + float(x[j]),
                "std": math.nan if denied else std,
                "identifiable": word,
                "note": NOTES[word],
            }
        rows.append({"name": name, "unit": unit, "nominal": nominal, **row})
    return rows


def tip_part(calibration: Calibration) -> dict[str, Any]:
    """The tip error to expect: after, before, and from the samples alone, with the directions that they miss.

    Beside it that of the flange's origin, which any tool of the arm has.
    """
    (before, now), (alone, unseen) = calibration.tip_std, calibration.tip_std_without_prior
    drawn, flange = calibration.flange_std
    tip = {"expected_rms_mm": now, "prior_rms_mm": before, "without_prior_rms_mm": alone, "unseen": unseen}
    return {**tip, "flange_expected_rms_mm": flange, "flange_prior_rms_mm": drawn}


def noise_part(calibration: Calibration) -> dict[str, Any]:
    """Found over stated noise with its 95 % interval, and noise as stated and as used, a row's median, by face.

    `without_joints_mm` is of what was used without that which the joints do not repeat, where that was told apart.
    """
    found, fit = calibration.noise, calibration.fit
    scales = {"stated_mm": {}, "used_mm": fit.scale, "without_joints_mm": without_joints(fit.scale)}
    noise = {key: fit.with_noise(scale).noise for key, scale in scales.items()}
    faces = {name: fit.residuals_of(rows) for name, rows in fit.faces.rows().items()}
    units = parts_of(fit)
    if any(instrument.blocks for instrument in fit.problem.instruments):  # each in a unit of its own
        faces = fit.noise_labels.rows()
    return {
        "ratio": found.ratio,
        "low": found.low,
        "high": found.high,
        "repeats": None if found.repeats is None else asdict(found.repeats),
        "joints_rad": fit.scale.get(REPEATABILITY, 0.0),
        "by_face": {
            name: {key: float(np.median(each[rows])) for key, each in noise.items()}
            | _other_unit(units.get(name, "mm"))
            for name, rows in faces.items()
        },
    }


def _other_unit(unit: str) -> dict[str, str]:
    """The unit of what is no length, whatever the names of its figures say."""
    return {} if unit == "mm" else {"unit": unit}


def discrepancy_part(calibration: Calibration, *, denied: bool = False) -> dict[str, Any] | None:
    """What arm and cell do beside their geometry: sizes, and how well all that moves the tip is known.

    None where geometry was taken for all there is.
    """
    fit, motion = calibration.fit, calibration.motion
    if not any(fit.beside):
        return None
    effects, found = [], times_found(fit)
    for effect in fit.problem.effects:
        if (times := found.get(effect.key)) is not None:
            unit = effect.unit or fit.units[fit.beside.index(effect.key)]
            size = {"unit": unit, "expected_size": effect.size, "size": effect.size * times, "times": times}
            effects.append({"key": effect.key, "words": effect.words, "moves": effect.moves, **size})
    places = {name: j for j, name in enumerate(fit.names)}
    unknowns = [
        {"name": name, "effect": beside, "value": float(calibration.result.x[places[name]])}
        for name, beside in zip(motion.arm.names, besides(motion.arm), strict=True)
        if beside
    ]
    names, off = list(motion.arm.names), np.zeros(motion.x.size) if motion.off is None else motion.off
    known = {} if denied else {"covariance_of": names, "off": off, "covariance": motion.covariance}
    tried = [asdict(each) | {"corrected": each.corrected} for each in calibration.tried]
    parts = {"effects": effects, "tried": tried, "corrected": list(calibration.corrected), "unknowns": unknowns}
    return {**parts, **_without_corrections(calibration, denied), **known}


def _without_corrections(calibration: Calibration, denied: bool) -> dict[str, Any]:
    """The arm for those who cannot correct an effect, and the tip error to expect of it; nothing where none is."""
    if not calibration.corrected:
        return {}
    rows = zip(calibration.fit.names, calibration.uncorrected_x, calibration.fit.beside, strict=True)
    values = [{"name": name, "value": float(value)} for name, value, beside in rows if not beside]
    error = math.nan if denied else tip_without_corrections(calibration)
    return {"without_corrections": values, "expected_rms_mm_without_corrections": error}


def what_is_seen(calibration: Calibration, *, denied: bool = False) -> dict[str, Any]:
    """Rank, null and weak directions, each with its cure; without tip errors where the verdict denies them."""
    found, cures = calibration.identifiability, iter(calibration.advice)
    found = without_tips(found) if denied else found
    return {
        "unknowns": found.unknowns,
        "rank": found.rank,
        "condition": found.condition,
        "singular_values": found.singular_values,
        "null": [
            {"kind": d.kind, "words": d.words, "tip_mm": d.tip_mm, "structural": d.structural, "cure": next(cures)}
            for d in found.null
        ],
        "weak": [
            {"words": d.words, "singular_value": d.singular_value, "tip_mm": d.tip_mm, "cure": next(cures)}
            for d in found.weak
        ],
    }


def cures_part(calibration: Calibration) -> list[dict[str, Any]]:
    """What to do next, best first, with the tip error to expect after it."""
    return [
        {
            "words": cure.words,
            "touches": cure.touches,
            "expected_rms_mm": cure.expected_rms_mm,
            "recommended": cure.recommended,
        }
        for cure in calibration.cures
    ]


def score_tests_part(calibration: Calibration, *, denied: bool = False) -> list[dict[str, Any]]:
    """What arm and cell may do beside their geometry; without tip errors where the verdict denies them."""
    tests = without_motion(calibration.score_tests) if denied else calibration.score_tests
    return [asdict(test) | {"shown": test.shown} for test in tests]


def reference_part(reference: Reference | None) -> dict[str, Any] | None:
    """What the independent solver found; None where none was asked."""
    if reference is None:
        return None
    return {
        "solver": reference.solver,
        "cost": reference.cost,
        "relative_gap": reference.relative_gap,
        "kkt": reference.result.kkt,
        "iterations": reference.result.steps,
    }


def geometry(bound: BoundProblem, x: Array) -> dict[str, Any]:
    """Planes, directions and frames at the estimate, x itself, and what x counts from where the samples proposed it."""
    found: dict[str, dict[str, Any]] = {"planes": {}, "directions": {}, "frames": {}}
    for slot in bound.slots:
        kind, shown = slot.unknown.shown(slot.nominal, x[slot.first : slot.first + slot.unknown.size])
        if kind in found:
            name = slot.name if kind != "planes" else _face_of(bound, slot)
            found[kind][name] = shown
    rows = zip(bound.names, bound.units, x, bound.beside, strict=True)
    unknowns = [{"name": name, "unit": unit, "value": value} for name, unit, value, beside in rows if not beside]
    proposed = {slot.name: slot.nominal for slot in bound.slots if slot.unknown.nominal is None}
    return {**found, "unknowns": unknowns, "proposed": proposed}


def _face_of(bound: BoundProblem, slot: Slot) -> str:
    """A plane by the label of its face, after the name of its instrument where there are several."""
    of, _, key = slot.key.rpartition(".")
    face = slot.label if slot.label is not None else "" if of else key
    return f"{of} {face}".strip() if len(bound.samples) > 1 else face


def closing(result: Result, seconds: Mapping[str, float]) -> dict[str, Any]:
    """Effort, time and versions."""
    return {
        "evaluations": {"residual_rows": result.residual_rows, "jacobian_rows": result.jacobian_rows},
        "seconds": dict(seconds),
        "versions": {
            "casacal": __version__,
            "casadi": metadata.version("casadi"),
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
    }


def spreads(covariance: Array | None, names: Sequence[str], bound: BoundProblem) -> dict[str, Any]:
    """The covariance, with the names of its rows where unknowns of single labels have none in it."""
    some = {} if len(names) == bound.unknowns else {"covariance_of": list(names)}
    return {**some, "covariance": covariance}
