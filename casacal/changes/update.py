"""A new result from an old one and fresh rows: the old posterior is the prior, and what changed is free."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from casacal.array_types import Array
from casacal.calibration.saved import AsArm, SavedCalibration
from casacal.changes.causes import JOINTS, joint_direction, shift_columns
from casacal.changes.change import ROWS, UNDECIDED, Change
from casacal.changes.changed import looked
from casacal.changes.document import updated_document
from casacal.changes.look import Look
from casacal.changes.posterior import updated_state, with_drift
from casacal.compensation.arm import CalibratedArm
from casacal.errors import CasacalError
from casacal.files import together, write_json
from casacal.samples.samples import Samples
from casacal.verification.fresh import Fresh
from casacal.verification.opened import Opened, opened

FILE = "result.json"


def updated(
    result: AsArm | CalibratedArm | str | Path,
    samples: Samples | Any,
    *,
    standing: Collection[str] = (),
    drift: Mapping[str, float] | None = None,
    alarm: float = 0.01,
    seed: int = 0,
    folder: str | Path | None = None,
) -> SavedCalibration:
    """The arm after a change, or known better where nothing changed: old posterior and new rows.

    All unknowns are estimated anew with the old posterior, its whole covariance, as the prior, plus drift; a joint that
    changed has no prior on its zero, a face that moved is fitted anew.

    Args:
        result, samples, standing, drift, alarm, seed: as for `changed`, which is asked first.
        folder: where result.json is written; nowhere by default.

    Returns:
        The arm, which predicts, compensates, is exported, verified and asked again.

    Raises CasacalError as `changed` does, where it cannot be told what changed, where rows are off, and where the
    problem has no unknown for what changed.

    """
    given = opened(result, samples, problem=None, instrument=None, standing=standing)
    found, look = looked(given, standing, drift or {}, alarm=alarm, touches=0, seed=seed)
    return after(given, found, look, None if folder is None else Path(folder))


def after(given: Opened, found: Change, look: Look, folder: Path | None) -> SavedCalibration:
    """The same where it has been looked already; written into a folder where one is named."""
    _refuse(given, found)
    standing, dropped = _still(look, found)
    fresh = with_drift(given.fresh(standing), dict(found.drift))
    state = updated_state(given.arm, fresh, _free(fresh, look, found), dropped)
    document = updated_document(given, fresh, state, found, folder)
    if folder is not None:
        with together(folder, [FILE]) as place:
            write_json(place / FILE, document)
    file = str(folder / FILE) if folder is not None else "this update"
    return SavedCalibration(CalibratedArm(file, given.arm.source, document))


def _refuse(given: Opened, found: Change) -> None:
    """Raise CasacalError for what cannot be updated."""
    document = given.arm.document
    if (words := given.arm.denial) is not None:
        fix = "Mend what the verdict names, and calibrate again"
        raise CasacalError(f"{given.arm.file}: {words.removesuffix('.')}, so it is not updated", fix)
    if document.get("method") == "truth":
        fix = "Give a calibration"
        raise CasacalError(f"{given.arm.file}: a true arm is not estimated, so nothing updates it", fix)
    if given.other or (document.get("data") or {}).get("instruments"):
        fix = "Calibrate again with all rows"
        raise CasacalError(f"{given.arm.file}: a result can be updated only by rows of its own instrument", fix)
    if found.ended == ROWS or found.bad_lines:
        lines = ", ".join(map(str, found.bad_lines))
        what = f"{found.judged.samples}: line {lines} is off, so nothing was updated"
        raise CasacalError(what, "Measure there again")
    if found.ended == UNDECIDED:
        fix = "Do what casacal changed advises next, or calibrate again"
        raise CasacalError(f"{found.judged.samples}: these rows do not show what changed, so nothing was updated", fix)


def _still(look: Look, found: Change) -> tuple[list[str], Any]:
    """What still stands where it was calibrated, and whether a name is of what does not."""
    there = [cause.name for cause in look.causes if cause.kind == "place"]
    moved = {cause.kind: cause.name for cause in found.causes}
    if "base" in moved:
        gone = {slot.name for slot in look.fresh.bound.slots if slot.datum}
        keys = {slot.key for slot in look.fresh.bound.slots if slot.datum}
        return [], lambda name: any(name == each or name.startswith(f"{each}.") for each in gone | keys)
    return [name for name in there if name != moved.get("place")], lambda _: False


def _free(fresh: Fresh, look: Look, found: Change) -> list[Array]:
    """Directions (n,) along which anything may have happened."""
    for cause in found.causes:
        if cause.kind == "joint":
            place = next(each.place for each in look.causes if each.name == cause.name)
            # what stands may differ from what stood in the look; the arm's unknowns come first in both
            arm, count = look.fresh.of_arm, look.shifted.unknowns
            bare = np.append(look.fresh.x, np.zeros(count - look.fresh.bound.unknowns))
            bare[np.array(look.shifted.beside, dtype=bool)] = 0.0  # gears that err are no part of an offset
            joint = int(shift_columns(look.shifted, JOINTS)[place])
            direction = joint_direction(look.shifted, bare, joint, np.isin(np.arange(count), arm))
            if direction is None:
                what = f"The zero of {cause.name} changed, and no free unknown of this problem does what it does"
                raise CasacalError(what, "Calibrate again with its offset free (--free)")
            return [np.append(direction[arm], np.zeros(fresh.bound.unknowns - arm.size))]
        if cause.kind == "tool":
            keys = fresh.bound.problem.robot.parameters
            slots = [slot for slot in fresh.bound.slots if slot.key == "tool" and slot.key not in keys]
            columns = [j for slot in slots if not slot.beside and not slot.datum for j in slot.columns]
            if not columns:
                fix = "Correct its position in the problem, or free it (--free tool), and calibrate again"
                raise CasacalError("The tool has moved, but this problem holds it", fix)
            return [*np.eye(fresh.bound.unknowns)[columns]]
    return []
