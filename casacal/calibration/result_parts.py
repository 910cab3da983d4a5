"""Parts of result.json, each from a calibration; columns that drive effects, and what they are worth."""

from __future__ import annotations

import logging
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from casacal.calibration.calibration import Calibration, parts_of
from casacal.calibration.inputs import Reference
from casacal.calibration.motion import effect_keys, tip_error
from casacal.deployment.as_data import problem_data
from casacal.deployment.result import Verdict
from casacal.deployment.result_file import SCHEMA
from casacal.effects.effect import effects_of
from casacal.errors import CasacalError
from casacal.fit.bound_problem import REPEATABILITY, BoundProblem, without_joints
from casacal.fit.least_squares import Result
from casacal.fit.slots import Slot
from casacal.model.problem_file import ProblemFile
from casacal.model.term import Site
from casacal.public import __version__
from casacal.uncertainty.identifiability import known_from
from casacal.uncertainty.tip_error import without_rigid, workspace_joints
from casacal.values import Array
from casacal.wording import listed, mm


def column_statistics(calibration: Calibration) -> dict[str, tuple[Array, Array]]:
    """Mean and standard deviation, over the fitted rows, of each column that drives a corrected effect."""
    problem, found = calibration.fit.problem, dict[str, list[Array]]()
    for instrument, block in zip(problem.instruments, calibration.fit.blocks, strict=True):
        for effect in problem.terms:
            if effect.key in calibration.told:
                for name, values in effect.told(Site(problem.robot, instrument), block.samples).items():
                    found.setdefault(name, []).append(values)
    every = {name: np.concatenate(parts) for name, parts in found.items()}
    return {name: (values.mean(), values.std()) for name, values in every.items()}


def without_columns(calibration: Calibration) -> float:
    """Expected tip error, mm RMS over the workspace, where those columns are missing and stand at their means.

    Root of tip_std^2 plus the mean square motion of the tip by one standard deviation of each column.
    """
    block, known = calibration.fit.blocks[0], column_statistics(calibration)
    joints = workspace_joints(calibration.fit.problem.robot)
    names, x = list(block.model.names), calibration.used_x
    at = np.array([known.get(name, (away, 0.0))[0] for name, away in zip(names, block.elsewhere, strict=True)])
    tips = block.tips_where(x, joints, at)
    squares = calibration.tip_std[1] ** 2
    for name, (_, spread) in known.items():
        moved = block.tips_where(x, joints, at + spread * (np.array(names) == name)) - tips
        squares += 3 * float((without_rigid(moved.ravel(), tips) ** 2).mean())
    return math.sqrt(squares)


def columns_part(calibration: Calibration) -> dict[str, Any]:
    """Columns that drive effects: usual value, mean, spread and range in the fitted rows; empty without any."""
    block = calibration.fit.blocks[0]
    usual = {
        name: float(value)
        for name, value, away in zip(block.model.names, block.usual, block.elsewhere, strict=True)
        if value != away
    }
    if not calibration.told:
        return {"usual": usual} if usual else {}
    known = column_statistics(calibration)
    return {
        "usual": usual,
        "mean": {name: float(mean) for name, (mean, _) in known.items()},
        "spread": {name: float(spread) for name, (_, spread) in known.items()},
        "range": _ranges(calibration),
        "further": {each.key: list(each.further) for each in calibration.tried if each.told},
    }


def _ranges(calibration: Calibration) -> dict[str, dict[str, float]]:
    """Lowest and highest value in the fitted rows of the columns that drive an effect by amounts."""
    problem, found = calibration.fit.problem, dict[str, list[Array]]()
    effects = [effect for effect in effects_of(problem) if effect.key in calibration.told]
    for instrument, block in zip(problem.instruments, calibration.fit.blocks, strict=True):
        for effect in effects:
            for column, values in effect.amounts(Site(problem.robot, instrument), block.samples).items():
                found.setdefault(column, []).append(values)
    return {
        column: {
            "lowest": min(float(each.min()) for each in parts),
            "highest": max(float(each.max()) for each in parts),
        }
        for column, parts in found.items()
    }


def verdict_lines(calibration: Calibration, verdict: Verdict) -> list[str]:
    """The verdict in words, and the tip error without the columns that drive effects."""
    if not calibration.told or verdict.level == "do not use":
        return [verdict.words]
    columns = listed([name for each in calibration.tried if each.told for name in each.further])
    return [
        verdict.words,
        f"That is where rows have {columns}, in predict, compensate, verify and the exports c and casadi; without, "
        f"expect a tip error of {mm(without_columns(calibration))} RMS.",
    ]


def image_words(calibration: Calibration, verdict: Verdict) -> list[str]:
    """A sentence on the mirror image that the rows do not exclude; none where there is none, or nothing may be used."""
    image = None if verdict.level == "do not use" else calibration.mirror_image
    return [] if image is None else [image.words]


_LOG = logging.getLogger("casacal")


def head_of(source: ProblemFile, result: Result, seed: int, backend: str, folder: Path | None) -> dict[str, Any]:
    """The head of result.json in a folder; of a document that stays in memory where there is none."""
    files = [{**asdict(file), "path": relative_to(folder, file.path)} for file in source.files]
    try:
        arm = problem_data(source.problem)
    except CasacalError as error:
        arm = None
        _LOG.warning("casacal: the result needs its problem file, for it cannot hold the arm: %s", error)
    return {
        "schema": SCHEMA,
        "problem": {
            "name": source.name,
            "path": relative_to(folder, source.path),
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


def earlier_part(calibration: Calibration, folder: Path | None) -> dict[str, Any]:
    """The earlier result, and how the rows agree with it; empty where the drawing was the prior."""
    earlier = calibration.earlier
    if earlier is None:
        return {}
    return {
        "earlier": {
            "result": relative_to(folder, earlier.file),
            "sha256": earlier.sha256,
            "verdict": asdict(earlier.verdict),
            "expected_rms_mm": earlier.expected_mm,
            "standing": earlier.standing,
            "loosened": dict(earlier.loosened),
            "chance": calibration.earlier_chance,
            "left_out_lines": earlier.left_out,
        }
    }


def relative_to(folder: Path | None, file: str) -> str:
    """Path of a file relative to a folder; unchanged where there is no folder, no such file, or no way between."""
    if folder is None or not file or not Path(file).exists():
        return file
    try:
        return Path(os.path.relpath(Path(file).resolve(), folder.resolve())).as_posix()
    except ValueError:  # another drive
        return Path(file).resolve().as_posix()


def parameter_rows(calibration: Calibration) -> list[dict[str, Any]]:
    """One entry per number of a parameter: name, unit, nominal, estimate, std, known_from."""
    fit = calibration.fit
    known = [known_from(*each) for each in zip(calibration.result.std.tolist(), fit.prior_std.tolist(), strict=True)]
    return rows_of(fit, calibration.used_x, calibration.std, known)


def rows_of(bound: BoundProblem, x: Array, stds: Array, known: Sequence[str]) -> list[dict[str, Any]]:
    """One entry per parameter at x (n,), with its standard deviation (n,) and what it is known from."""
    rows = []
    for name, unit, nominal, j in bound.parameters():
        if j is None:
            row = {"estimate": nominal, "std": 0.0, "known_from": "held"}
        else:
            row = {"estimate": nominal + float(x[j]), "std": float(stds[j]), "known_from": known[j]}
        rows.append({"name": name, "unit": unit, "nominal": nominal, **row})
    return rows


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
            | ({} if units.get(name, "mm") == "mm" else {"unit": units[name]})  # of what is no length
            for name, rows in faces.items()
        },
    }


def discrepancy_part(calibration: Calibration) -> dict[str, Any] | None:
    """Non-geometric effects: sizes, joint covariance of all that moves the tip, columns that drive an effect.

    None where geometry was taken for all there is.
    """
    fit, motion = calibration.fit, calibration.motion
    if not any(fit.beside):
        return None
    moves = {effect.key: effect.moves for effect in fit.problem.terms}
    effects = [
        {**asdict(each), "shown": each.shown, "moves": moves[each.key], "times": each.size / each.expected_size}
        for each in calibration.effect_sizes
    ]
    places = {name: j for j, name in enumerate(fit.names)}
    unknowns = [
        {"name": name, "effect": effect, "value": float(calibration.result.x[places[name]])}
        for name, effect in zip(motion.arm.names, effect_keys(motion.arm), strict=True)
        if effect
    ]
    names, off = list(motion.arm.names), np.zeros(motion.x.size) if motion.off is None else motion.off
    denied = bool(np.isnan(motion.covariance).any())
    known = {} if denied else {"covariance_of": names, "off": off, "covariance": motion.covariance}
    tried = [asdict(each) | {"corrected": each.corrected} for each in calibration.tried]
    corrected = list(calibration.corrected)
    parts: dict[str, Any] = {"effects": effects, "tried": tried, "corrected": corrected, "unknowns": unknowns}
    if calibration.corrected:  # the arm for those who cannot correct an effect, and the tip error to expect of it
        alone = zip(fit.names, calibration.uncorrected_x, fit.beside, strict=True)
        parts["without_corrections"] = [{"name": n, "value": float(value)} for n, value, effect in alone if not effect]
        error = math.nan if denied else tip_error(fit, calibration.result, ())
        parts["expected_rms_mm_without_corrections"] = error
    if calibration.told:
        parts["expected_rms_mm_without_columns"] = math.nan if denied else without_columns(calibration)
    return {**parts, **known, **columns_part(calibration)}


def identifiability_part(calibration: Calibration) -> dict[str, Any]:
    """Rank, null and weak directions, each with its cure; a tip error that is denied is NaN."""
    found, cures = calibration.identifiability, iter(calibration.advice)
    return {
        **picked(found, "unknowns", "rank", "condition", "singular_values"),
        "null": [{**picked(d, "kind", "words", "tip_mm", "structural"), "cure": next(cures)} for d in found.null],
        "weak": [{**picked(d, "words", "singular_value", "tip_mm"), "cure": next(cures)} for d in found.weak],
    }


def picked(of: object, *names: str) -> dict[str, Any]:
    """Some attributes of a value, by name."""
    return {name: getattr(of, name) for name in names}


def constraints_part(calibration: Calibration) -> dict[str, Any]:
    """Constraints of the problem: their range, where the estimate is in it, and what holds it; empty without any."""
    known, result = calibration.fit.constraints, calibration.result
    if known is None:
        return {}
    values = dict(zip(known.names, known.evaluate(result.x)[0].tolist(), strict=True))
    pulls = {name: {"multiplier": result.multipliers[name], "active": name in result.active} for name in known.names}
    rows = [each for each in calibration.fit.problem.exact if each.name in values]
    keys = ("name", "unit", "low", "high")
    return {"constraints": [{**picked(r, *keys), "value": values[r.name], **pulls[r.name]} for r in rows]}


def reference_part(reference: Reference | None) -> dict[str, Any] | None:
    """The independent solver's result; None where none ran."""
    if reference is None:
        return None
    found = picked(reference, "solver", "cost", "relative_gap")
    return {**found, "kkt": reference.result.kkt, "iterations": reference.result.steps}


def geometry(bound: BoundProblem, x: Array) -> dict[str, Any]:
    """Planes, directions and frames at x, the unknowns of the geometry, and nominal values from the samples."""
    found: dict[str, dict[str, Any]] = {"planes": {}, "directions": {}, "frames": {}}
    for slot in bound.slots:
        kind, shown = slot.unknown.shown(slot.nominal, x[slot.first : slot.first + slot.unknown.size])
        if kind in found:
            name = slot.name if kind != "planes" else _face_of(bound, slot)
            found[kind][name] = shown
    rows = zip(bound.names, bound.units, x, bound.beside, strict=True)
    unknowns = [{"name": name, "unit": unit, "value": value} for name, unit, value, effect in rows if not effect]
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
