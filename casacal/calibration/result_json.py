"""result.json of a calibration: what other tools read, part by part."""

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
from casacal.calibration.motion import effect_keys, tip_error
from casacal.calibration.verdict import WithVerdict, warnings
from casacal.data.repeats import listing
from casacal.data.samples import Measurements, Samples
from casacal.deployment.as_data import problem_data
from casacal.deployment.result import SCHEMA, Verdict
from casacal.effects.effect import effects_of
from casacal.errors import CasacalError
from casacal.files import sealed
from casacal.fit.bound_problem import SHARED, BoundProblem, repeatability, without_joints
from casacal.fit.least_squares import Result
from casacal.model.problem_file import ProblemFile
from casacal.model.term import Site
from casacal.public import __version__
from casacal.uncertainty.identifiability import correlated_pairs, known_from
from casacal.uncertainty.tip_error import without_rigid, workspace_joints
from casacal.values import Array
from casacal.wording import listed, mm

_LOG = logging.getLogger("casacal")


def calibration_document(
    calibration: WithVerdict, source: ProblemFile | None = None, *, folder: Path | None = None
) -> dict[str, Any]:
    """The whole of result.json for a calibration; paths are relative to the folder that it will stand in, if any."""
    found, cures, reference = calibration.identifiability, iter(calibration.advice), calibration.reference
    document = found_part(calibration, source, folder=folder)
    document["metrics"] = calibration.metrics
    if by := calibration.metrics_by_instrument:
        document["metrics_by_instrument"] = by
    document["leave_one_face_out"] = [{**asdict(face), "ratio": face.ratio} for face in calibration.left_out]
    document["identifiability"] = {
        **_picked(found, "unknowns", "rank", "condition", "singular_values"),
        "null": [{**_picked(d, "kind", "words", "tip_mm", "structural"), "cure": next(cures)} for d in found.null],
        "weak": [{**_picked(d, "words", "singular_value", "tip_mm"), "cure": next(cures)} for d in found.weak],
    }
    keys = ("words", "touches", "expected_rms_mm", "recommended")
    document["cures"] = [_picked(cure, *keys) for cure in calibration.cures]
    keys_of_error = ("key", "words", "chance", "size", "unit", "shown")
    document["dial_errors"] = [_picked(error, *keys_of_error) for error in calibration.dial_errors]
    document["trusted_constants"] = [asdict(each) for each in calibration.leverages]
    pairs = correlated_pairs(calibration.covariance, calibration.seen.names)
    document["correlations"] = [{"names": [one, two], "value": value} for one, two, value in pairs]
    document["warnings"] = warnings(calibration.unjudged)
    document["prior_moves"] = asdict(calibration.prior_moves)
    document["set_aside"] = [asdict(finding) for finding in calibration.aside]
    document["down_weighted_lines"] = calibration.down_weighted
    if (
        known := calibration.fit.constraints
    ) is not None:  # range of each, the estimate in it, and what holds that there
        result, values = calibration.result, known.evaluate(calibration.result.x)[0].tolist()
        at, rows = dict(zip(known.names, values, strict=True)), list[dict[str, Any]]()
        for each in (each for each in calibration.fit.problem.exact if each.name in at):
            pull = {"multiplier": result.multipliers[each.name], "active": each.name in result.active}
            rows.append({**_picked(each, "name", "unit", "low", "high"), "value": at[each.name], **pull})
        document["constraints"] = rows
    document["reference"] = None
    if reference is not None:
        ended = {"kkt": reference.result.kkt, "iterations": reference.result.steps}
        document["reference"] = {**_picked(reference, "solver", "cost", "relative_gap"), **ended}
    return sealed(document)


def found_part(
    calibration: WithVerdict, source: ProblemFile | None = None, *, folder: Path | None = None
) -> dict[str, Any]:
    """The part of result.json that other tools rely on; the rest is for people and takes longer to compute."""
    result, fit, denied, samples = calibration.result, calibration.fit, calibration.denied, calibration.samples
    (before, now), (alone, unseen) = calibration.tip_std, calibration.tip_std_without_prior
    drawn, flange = calibration.flange_std
    tip = {"expected_rms_mm": now, "prior_rms_mm": before, "without_prior_rms_mm": alone, "unseen": unseen}
    return {
        **head_of(source or calibration.source, result, calibration.seed, fit.backend, folder),
        "verdict": asdict(calibration.verdict),
        "data": {
            **rows_file(samples, folder),
            "heldout": 0 if calibration.heldout is None else len(calibration.heldout.measured),
            "heldout_by": calibration.heldout_by,
            "fitted": len(fit.measured),
            **_fitted_rows(calibration, folder),
            "set_aside": len(calibration.aside_lines),
            "copies": calibration.copies,
        },
        **_earlier(calibration, folder),
        "cost": result.cost,
        "mirror_image": None if denied or (image := calibration.mirror_image) is None else asdict(image),
        "parameters": parameter_rows(calibration),
        **geometry(fit, calibration.unjudged.used_x),
        "tip": None if denied else {**tip, "flange_expected_rms_mm": flange, "flange_prior_rms_mm": drawn},
        "noise": noise_part(calibration.unjudged),
        "discrepancy": _discrepancy(calibration),
        **spreads(None if denied else calibration.covariance, calibration.seen.names, fit),
        **closing(result, calibration.seconds),
    }


def _fitted_rows(calibration: Calibration, folder: Path | None) -> dict[str, Any]:
    """The rows that were fitted, to know them again; of several instruments by name, each with its file.

    With those of an earlier result: they tell the same arm, and are not fresh for this one either.
    """
    fit, measured, earlier = calibration.fit, Measurements.of(calibration.samples), calibration.earlier
    rows = [listing(some, fit.problem.layout(i)) for i, some in enumerate(fit.samples)]
    if len(rows) > 1:
        instruments = {}
        for name, some, own, these in zip(measured.names, measured.sets, fit.samples, rows, strict=True):
            instruments[name] = {**rows_file(some, folder), "fitted": len(own), "fitted_rows": these}
        return {"instruments": instruments}
    fitted, before = rows[0], None if earlier is None else earlier.fitted_rows
    if before is not None and before["columns"] == fitted["columns"]:
        values = [*before["values"], *fitted["values"]]
        fitted = {**fitted, "rows": before["rows"] + fitted["rows"], "values": values}
    return {"fitted_rows": fitted}


def _fitted_columns(calibration: Calibration, *, amounts: bool = False) -> dict[str, Array]:
    """Values over all fitted rows of each column that drives a corrected effect: as it tells it, or by amounts."""
    problem, found = calibration.fit.problem, dict[str, list[Array]]()
    for instrument, block in zip(problem.instruments, calibration.fit.blocks, strict=True):
        for effect in effects_of(problem):
            if effect.key in calibration.told:
                values = (effect.amounts if amounts else effect.told)(Site(problem.robot, instrument), block.samples)
                for name, some in values.items():
                    found.setdefault(name, []).append(some)
    return {name: np.concatenate(parts) for name, parts in found.items()}


def _without_columns(calibration: Calibration) -> float:
    """Expected tip error, mm RMS over the workspace, where those columns are missing and stand at their means.

    Root of tip_std^2 plus the mean square motion of the tip by one standard deviation of each column.
    """
    block, known = calibration.fit.blocks[0], _fitted_columns(calibration)
    joints = workspace_joints(calibration.fit.problem.robot)
    names, x, means = list(block.model.names), calibration.used_x, {name: each.mean() for name, each in known.items()}
    at = np.array([means.get(name, away) for name, away in zip(names, block.elsewhere, strict=True)])
    tips = block.tips_where(x, joints, at)
    squares = calibration.tip_std[1] ** 2
    for name, values in known.items():
        moved = block.tips_where(x, joints, at + values.std() * (np.array(names) == name)) - tips
        squares += 3 * float((without_rigid(moved.ravel(), tips) ** 2).mean())
    return math.sqrt(squares)


def _columns(calibration: Calibration) -> dict[str, Any]:
    """Columns that drive effects: usual value, mean, spread and range in the fitted rows; empty without any."""
    block = calibration.fit.blocks[0]
    pairs = zip(block.model.names, block.usual, block.elsewhere, strict=True)
    usual = {name: float(value) for name, value, away in pairs if value != away}
    if not calibration.told:
        return {"usual": usual} if usual else {}
    known, amounts = _fitted_columns(calibration), _fitted_columns(calibration, amounts=True)
    ends = {name: (float(values.min()), float(values.max())) for name, values in amounts.items()}
    return {
        "usual": usual,
        "mean": {name: float(values.mean()) for name, values in known.items()},
        "spread": {name: float(values.std()) for name, values in known.items()},
        "range": {name: {"lowest": low, "highest": high} for name, (low, high) in ends.items()},
        "further": {each.key: list(each.further) for each in calibration.tried if each.told},
    }


def verdict_lines(calibration: Calibration, verdict: Verdict) -> list[str]:
    """The verdict in words, and the tip error without the columns that drive effects."""
    if not calibration.told or verdict.level == "do not use":
        return [verdict.words]
    columns = listed([name for each in calibration.tried if each.told for name in each.further])
    return [
        verdict.words,
        f"That is where rows have {columns}, in predict, compensate, verify and the exports c and casadi; without, "
        f"expect a tip error of {mm(_without_columns(calibration))} RMS.",
    ]


def image_words(calibration: Calibration, verdict: Verdict) -> list[str]:
    """A sentence on the mirror image that the rows do not exclude; none where there is none, or nothing may be used."""
    image = None if verdict.level == "do not use" else calibration.mirror_image
    return [] if image is None else [image.words]


def head_of(source: ProblemFile, result: Result, seed: int, backend: str, folder: Path | None) -> dict[str, Any]:
    """The head of result.json in a folder; of a document that stays in memory where there is none."""
    files = [{**asdict(file), "path": relative_to(folder, file.path)} for file in source.files]
    about = {"name": source.name, "path": relative_to(folder, source.path), "sha256": source.sha256, "files": files}
    try:
        arm = problem_data(source.problem)
    except CasacalError as error:
        arm = None
        _LOG.warning("casacal: the result needs its problem file, for it cannot hold the arm: %s", error)
    found = {"method": result.method, "status": result.message, "converged": result.converged}
    return {"schema": SCHEMA, "problem": about, "arm": arm, **found, "seed": seed, "backend": backend}


def _earlier(calibration: Calibration, folder: Path | None) -> dict[str, Any]:
    """The earlier result, and how the rows agree with it; empty where the drawing was the prior."""
    if (earlier := calibration.earlier) is None:
        return {}
    found = {
        "result": relative_to(folder, earlier.file),
        "sha256": earlier.sha256,
        "verdict": asdict(earlier.verdict),
        "expected_rms_mm": earlier.expected_mm,
        "standing": earlier.standing,
        "loosened": dict(earlier.loosened),
        "chance": calibration.earlier_chance,
        "left_out_lines": earlier.left_out,
    }
    return {"earlier": found}


def rows_file(rows: Samples | Measurements, folder: Path | None) -> dict[str, Any]:
    """The file of some rows, its hash, and how many it holds."""
    return {"file": relative_to(folder, rows.file), "sha256": rows.sha256, "samples": len(rows)}


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
    used = {name: factor for name, factor in fit.scale.items() if name != SHARED}  # of one touch, not of some repeats
    scales = {"stated_mm": {}, "used_mm": used, "without_joints_mm": without_joints(used)}
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
        **dict(zip(("loose_joint", "joints_rad"), repeatability(fit.scale), strict=True)),
        "shared": fit.scale.get(SHARED, 0.0),
        "by_face": {
            name: {key: float(np.median(each[rows])) for key, each in noise.items()}
            | ({} if units.get(name, "mm") == "mm" else {"unit": units[name]})  # of what is no length
            for name, rows in faces.items()
        },
    }


def _discrepancy(calibration: Calibration) -> dict[str, Any] | None:
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
    at, of_arm = dict(zip(fit.names, calibration.result.x.tolist(), strict=True)), effect_keys(motion.arm)
    pairs = zip(motion.arm.names, of_arm, strict=True)
    moving = ((name, effect) for name, effect in pairs if effect and moves[effect])
    unknowns = [{"name": name, "effect": effect, "value": at[name]} for name, effect in moving]
    names, off = list(motion.arm.names), np.zeros(motion.x.size) if motion.off is None else motion.off
    denied = bool(np.isnan(motion.covariance).any())
    estimate = [at[name] for name in names]
    known = {"covariance_of": names, "off": off, "estimate": estimate, "covariance": motion.covariance}
    tried = [asdict(each) | {"corrected": each.corrected} for each in calibration.tried]
    corrected = list(calibration.corrected)
    parts: dict[str, Any] = {"effects": effects, "tried": tried, "corrected": corrected, "unknowns": unknowns}
    if corrected:  # the arm for those who cannot correct an effect, and the tip error to expect of it
        alone = zip(fit.names, calibration.uncorrected_x, fit.beside, strict=True)
        parts["without_corrections"] = [{"name": n, "value": float(value)} for n, value, effect in alone if not effect]
        parts["expected_rms_mm_without_corrections"] = math.nan if denied else tip_error(fit, calibration.result, ())
    if calibration.told:
        parts["expected_rms_mm_without_columns"] = math.nan if denied else _without_columns(calibration)
    return {**parts, **({} if denied else known), **_columns(calibration)}


def _picked(of: object, *names: str) -> dict[str, Any]:
    """Some attributes of a value, by name."""
    return {name: getattr(of, name) for name in names}


def geometry(bound: BoundProblem, x: Array) -> dict[str, Any]:
    """Planes, directions and frames at x, the unknowns of the geometry, and nominal values from the samples."""
    found: dict[str, dict[str, Any]] = {"planes": {}, "directions": {}, "frames": {}}
    for slot in bound.slots:
        kind, shown = slot.unknown.shown(slot.nominal, x[slot.first : slot.first + slot.unknown.size])
        if kind in found:
            name = slot.name
            if kind == "planes":  # by the label of its face, after the name of its instrument where there are several
                of, _, key = slot.key.rpartition(".")
                face = slot.label if slot.label is not None else "" if of else key
                name = f"{of} {face}".strip() if len(bound.samples) > 1 else face
            found[kind][name] = shown
    rows = zip(bound.names, bound.units, x, bound.beside, strict=True)
    unknowns = [{"name": name, "unit": unit, "value": value} for name, unit, value, effect in rows if not effect]
    proposed = {slot.name: slot.nominal for slot in bound.slots if slot.unknown.nominal is None}
    return {**found, "unknowns": unknowns, "proposed": proposed}


def closing(result: Result, seconds: Mapping[str, float]) -> dict[str, Any]:
    """Effort, time and versions."""
    versions = {"casadi": metadata.version("casadi"), "numpy": np.__version__, "python": platform.python_version()}
    return {
        "evaluations": {"residual_rows": result.residual_rows, "jacobian_rows": result.jacobian_rows},
        "seconds": dict(seconds),
        "versions": {"casacal": __version__, **versions},
    }


def spreads(covariance: Array | None, names: Sequence[str], bound: BoundProblem) -> dict[str, Any]:
    """The covariance, with the names of its rows where unknowns of single labels have none in it."""
    some = {} if len(names) == bound.unknowns else {"covariance_of": list(names)}
    return {**some, "covariance": covariance}
