"""result.json of an update: what the old one said, with everything that fresh rows tell put in its place."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from casacal.calibration.result_parts import geometry, rows_of, seen_from
from casacal.calibration.verdict import GAIN
from casacal.changes.change import CHANGED, Change
from casacal.changes.posterior import UpdatedState
from casacal.compensation.arm import CalibratedArm
from casacal.compensation.result_file import sealed
from casacal.compensation.spread import position_stds
from casacal.files import jsonable
from casacal.samples.repeats import listing
from casacal.uncertainty.identifiability import known_from
from casacal.uncertainty.workspace import workspace_joints
from casacal.verification.fresh import Fresh
from casacal.verification.opened import Opened
from casacal.wording import counted, sentence

KEPT = ("schema", "problem", "arm", "seed", "backend", "noise", "versions")  # what an update leaves as it was


def updated_document(
    given: Opened, fresh: Fresh, state: UpdatedState, found: Change, folder: Path | None
) -> dict[str, Any]:
    """The whole of it, sealed; paths are relative to the folder that it will stand in, if any."""
    arm, x, bound, n = given.arm, state.x, fresh.bound, fresh.bound.unknowns
    old, place = arm.document, Path(arm.file).parent
    files = [{**file, "path": _elsewhere(file["path"], place, folder)} for file in old["problem"].get("files", ())]
    stds = np.sqrt(np.maximum(np.diagonal(state.covariance), 0.0))
    known = [known_from(*each) for each in zip(stds[:n].tolist(), bound.prior_std.tolist(), strict=True)]
    of_arm = np.flatnonzero([not key for key in bound.beside])
    effects = {row["name"] for row in (old.get("discrepancy") or {}).get("unknowns", ())}
    others = {name: n + i for i, name in enumerate(state.moved) if name not in effects}
    rows = np.array([*of_arm, *others.values()], dtype=np.intp)
    document = {
        **{key: old[key] for key in KEPT if key in old},
        "problem": {**old["problem"], "path": _elsewhere(old["problem"]["path"], place, folder), "files": files},
        "method": "update",
        "status": "Converged: old posterior and fresh rows.",
        "converged": True,
        "data": _data(old, fresh, found, arm, folder),
        "cost": state.chi_square / 2,
        "parameters": rows_of(bound, x, stds[:n], known),
        **_geometry(old, geometry(bound, x), {name: state.moved[name] for name in others}),
        "metrics": None,
        "discrepancy": _discrepancy(given, fresh, state),
        "identifiability": None,
        "cures": [],
        "correlations": [],
        "covariance_of": [*(bound.names[j] for j in of_arm), *others],
        "covariance": state.covariance[np.ix_(rows, rows)],
        "warnings": [],
        "reference": None,
        "updated_from": _provenance(arm, found, folder),
    }
    made = CalibratedArm(arm.file, arm.source, jsonable(document))
    document["tip"] = _tip(made, old)
    document["verdict"] = _verdict(old, document["tip"], found)
    return sealed(jsonable(document))


def _geometry(old: Mapping[str, Any], new: dict[str, Any], moved: Mapping[str, float]) -> dict[str, Any]:
    """Where everything stands: rows first, then what they did not see and the result knows."""
    before = {row["name"]: row for row in old.get("unknowns", ())}
    rows = _moved([before[name] for name in moved if name in before], moved)
    seen = {row["name"].rsplit(".", 1)[0] for row in rows}
    kept = {key: value for key, value in (old.get("proposed") or {}).items() if key in seen}
    found = {**new, "unknowns": [*new["unknowns"], *rows], "proposed": {**kept, **new["proposed"]}}
    for kind in ("planes", "directions", "frames"):
        known = old.get(kind) or {}
        labels = {name.split(".", 1)[-1] for name in seen}
        found[kind] = {**{key: value for key, value in known.items() if key in labels}, **new[kind]}
    return found


def _discrepancy(given: Opened, fresh: Fresh, state: UpdatedState) -> Any:
    """Effects beside the geometry: corrected ones as the rows put them, others as they were, with what is known."""
    said = given.arm.document.get("discrepancy")
    if not said:
        return said
    bound, n, was = fresh.bound, fresh.bound.unknowns, given.arm.found.values(alone=False)
    was |= given.arm.found.of_effects
    corrected = set(given.arm.corrected)
    inside = {name: j for j, name in enumerate(bound.names) if not bound.beside[j] or bound.beside[j] in corrected}
    at = inside | {name: n + i for i, name in enumerate(state.moved)}
    moves = {**state.moved, **{name: float(state.x[j] - was[name]) for name, j in inside.items() if name in was}}
    part = {**said, "unknowns": _moved(said["unknowns"], moves)}
    if "without_corrections" in said:
        part["without_corrections"] = _moved([row for row in said["without_corrections"] if row["name"] in at], moves)
    if "covariance" in said:
        known = said["covariance_of"]
        names = [name for name in at if not (name in inside and bound.beside[inside[name]] and name not in known)]
        rows = [at[name] for name in names]
        off = dict(zip(known, part["off"], strict=True))
        away = {row["name"] for row in said["unknowns"] if row["effect"] not in corrected}
        part["off"] = [float(off.get(name, 0.0)) + (moves.get(name, 0.0) if name in away else 0.0) for name in names]
        part["covariance_of"], part["covariance"] = names, state.covariance[np.ix_(rows, rows)]
    return part


def _moved(rows: Iterable[Mapping[str, Any]], moves: Mapping[str, float]) -> list[dict[str, Any]]:
    """Unknowns with their values moved."""
    return [{**row, "value": float(row["value"]) + moves.get(row["name"], 0.0)} for row in rows]


def _tip(arm: CalibratedArm, old: Mapping[str, Any]) -> dict[str, Any]:
    """Tip error to expect over the workspace, mm RMS, apart from the position of the base."""
    joints = workspace_joints(arm.source.problem.robot)
    before = old.get("tip") or {}
    errors = {}
    for frame, key in (("tip", "expected_rms_mm"), ("flange", "flange_expected_rms_mm")):
        known = before.get(key) is not None
        spread = position_stds(arm, joints, frame, None) if known or frame == "tip" else None
        errors[key] = None if spread is None else float(np.sqrt((spread**2).mean()))
    return {**before, **errors, "without_prior_rms_mm": None, "unseen": None}


def _verdict(old: Mapping[str, Any], tip: Mapping[str, Any], found: Change) -> dict[str, Any]:
    """The old verdict governs; a change that was estimated from few rows is to be verified first."""
    before, reasons = old["verdict"], list(old["verdict"].get("reasons") or ())
    earlier = (old.get("tip") or {}).get("expected_rms_mm")
    was = f" (before these rows: {earlier:.3f} mm)" if earlier is not None else ""
    expected = (
        f"expect a tip error of {tip['expected_rms_mm']:.3f} mm RMS over the workspace, apart from the position of "
        f"the base{was}, if the noise and the earlier result are right"
    )
    doubts = []
    if found.ended == CHANGED:
        (cause,) = found.causes
        doubts.append(f"{cause.called} changed, by {cause.amount}, and no fresh rows have verified it since")
    if before["level"] != "calibrated":
        doubts.append("the earlier result was to be used with care")
    prior = tip.get("prior_rms_mm")
    if prior is not None and tip["expected_rms_mm"] > GAIN * prior:
        doubts.append("little was gained")
    if not doubts:
        return {"level": "calibrated", "words": f"Calibrated: {expected}.", "reasons": []}
    words = f"Use with care: {expected}; but {' and '.join(doubts[:2])}."
    return {"level": "use with care", "words": words, "reasons": [*map(sentence, doubts), *reasons]}


def _elsewhere(path: str, place: Path, folder: Path | None) -> str:
    """A path that stood relative to one folder, relative to another; itself where there is no such file."""
    there = place / path if path else Path()
    return seen_from(folder, there.as_posix()) if path and there.exists() else path


def _data(
    old: Mapping[str, Any], fresh: Fresh, found: Change, arm: CalibratedArm, folder: Path | None
) -> dict[str, Any]:
    """Which rows: the fresh ones, and those that were fitted before, so that neither counts as fresh again."""
    samples, before = fresh.bound.block.samples, dict(old.get("data") or {})
    listed, earlier = listing(samples, fresh.bound.problem.layout()), before.pop("fitted_rows", None)
    if earlier is not None and earlier["columns"] == listed["columns"]:
        rows = earlier["rows"] + listed["rows"]
        listed = {**listed, "rows": rows, "values": [*earlier["values"], *listed["values"]]}
    if isinstance(before.get("file"), str):
        before["file"] = _elsewhere(before["file"], Path(arm.file).parent, folder)
    return {
        "file": seen_from(folder, samples.file),
        "sha256": samples.sha256,
        "samples": len(samples),
        "heldout": 0,
        "heldout_by": "rows",
        "fitted": len(samples),
        "fitted_rows": listed,
        "set_aside": 0,
        "copies": len(found.judged.copied_lines),
        "earlier": before,
    }


def _provenance(arm: CalibratedArm, found: Change, folder: Path | None) -> dict[str, Any]:
    """Which result it was made from, and what was found to have changed."""
    old = arm.document
    causes = [
        {"name": c.name, "kind": c.kind, "labels": c.labels, "units": c.units, "shift": c.shift, "std": c.std}
        for c in found.causes
    ]
    return {
        "result": seen_from(folder, arm.file),
        "sha256": (old.get("seal") or {}).get("sha256"),
        "verdict": old["verdict"],
        "rows": counted(found.judged.rows, "row"),
        "standing": found.judged.standing,
        "drift": dict(found.drift),
        "alarm": found.alarm,
        "p": found.p,
        "changed": causes,
        "earlier": old.get("updated_from"),
    }
