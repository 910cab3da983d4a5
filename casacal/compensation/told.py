"""Effects that columns of a file tell, such as torques: corrected where rows have them, else counted as errors."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from casacal.array_types import Array
from casacal.compensation.arm import CalibratedArm
from casacal.discrepancy.effect import Site
from casacal.discrepancy.further import refuse_unless
from casacal.samples.samples import Samples
from casacal.values import FrozenMapping
from casacal.wording import listed

NOTHING_TOLD: Mapping[str, Array] = FrozenMapping({})

MOST_SPANS, FAR_SPANS = 10.0, 0.5
"""How far from the fitted rows an amount may be, in spans of these: more is refused, or else said."""


@dataclass(frozen=True, eq=False)
class Told:
    """An arm as some rows tell of it.

    arm: with the effects corrected that they tell. columns: of these effects, by name in the row model, each (N,).
    missing: by an effect's words the columns that these rows lack, so that it is not corrected. beyond: a sentence for
    each column with amounts far from those of the fitted rows.
    """

    arm: CalibratedArm
    columns: Mapping[str, Array]
    missing: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    beyond: tuple[str, ...] = ()

    @staticmethod
    def by(arm: CalibratedArm, rows: Samples) -> Told:
        """An arm as rows tell of it; raises SamplesError where a column that tells an effect holds what it may not."""
        further = columns_that_tell(arm)
        keys = [key for key, names in further.items() if set(names) <= set(rows.extra)]
        words = {effect["key"]: effect["words"] for effect in arm.discrepancy.get("effects", ())}
        lacking = {
            words[key]: tuple(name for name in names if name not in rows.extra)
            for key, names in further.items()
            if key not in keys
        }
        told, columns, beyond = where_told(arm, keys), dict[str, Array](), list[str]()
        if keys:
            site = Site(told.source.problem.robot, told.source.problem.instrument)
            for effect in told.used.effects:
                if effect.key in keys:
                    columns |= effect.told(site, rows)
                    beyond += _beyond(rows, effect.amounts(site, rows), arm.discrepancy.get("range", {}))
        return Told(told, columns, FrozenMapping(lacking), tuple(beyond))


def _beyond(rows: Samples, amounts: Mapping[str, Array], ranges: Mapping[str, Mapping[str, float]]) -> list[str]:
    """A sentence for each of an effect's columns (N,) that is far from its range in the fitted rows.

    The effect is proportional to its columns, which share a unit: the span is the largest of theirs, zero included.
    Results from before ranges were kept have none. Raises SamplesError for an amount that is out of all proportion.
    """
    known = {name: (ranges[name]["lowest"], ranges[name]["highest"]) for name in amounts if name in ranges}
    span = max((max(high, 0.0) - min(low, 0.0) for low, high in known.values()), default=0.0)
    said = []
    for name, (low, high) in known.items():
        values, fitted = amounts[name], f"the {low:g} to {high:g} of the fitted rows"
        away = np.maximum(low - values, values - high)
        fix = "Give it in their unit, such as kg and not g, or Nm and not mNm; or calibrate with such rows"
        good = (away <= MOST_SPANS * span)[:, None]
        refuse_unless(good, rows, (name,), values[:, None], f"is out of all proportion to {fitted}", fix)
        row = int(np.argmax(away))
        if away[row] > FAR_SPANS * span:
            where = f"warning: {name} is {values[row]:g} on line {int(rows.lines[row])}"
            said.append(f"{where}, far from {fitted}, so what it corrects there is extrapolated.")
    return said


def whole_rows(
    first: Array, joints: int, names: Sequence[str], told: Mapping[str, Array], elsewhere: Array | float = 0.0
) -> Array:
    """Whole rows (N, n + k) of a row model with k columns, of which the first (N, m) are given.

    told: columns (N,) by name, in their places. elsewhere: what the others hold (k,).
    """
    rows = np.zeros((len(first), joints + len(names)))
    rows[:, joints:] = elsewhere
    rows[:, : first.shape[1]] = first
    for name, values in told.items():
        rows[:, joints + names.index(name)] = values
    return rows


def columns_that_tell(arm: CalibratedArm) -> dict[str, tuple[str, ...]]:
    """By key, the columns of a file where an effect that they tell can be corrected."""
    return {str(key): tuple(map(str, names)) for key, names in arm.discrepancy.get("further", {}).items()}


def where_told(arm: CalibratedArm, keys: Collection[str] | None = None) -> CalibratedArm:
    """The arm where these effects are corrected as well, by default all that columns tell; itself where there is none.

    Its geometry is that beside them; its verdict and its tip error are those where the columns are known.
    """
    wanted = set(columns_that_tell(arm) if keys is None else keys)
    said, document = arm.discrepancy, arm.document
    if not wanted:
        return arm
    (chosen,) = (each for each in said["told"] if set(each["effects"]) == wanted)
    values = {row["name"]: float(row["value"]) for row in chosen["unknowns"]}
    changed: dict[str, Any] = {
        "verdict": chosen["verdict"],
        "parameters": [
            {**row, "estimate": row["nominal"] + values[row["name"]]} if row["name"] in values else row
            for row in document["parameters"]
        ],
        "unknowns": [{**row, "value": values.get(row["name"], row["value"])} for row in document.get("unknowns", ())],
        "discrepancy": {
            **{key: value for key, value in said.items() if key != "further"},
            "corrected": [*arm.corrected, *chosen["effects"]],
            **({"off": chosen["off"]} if "off" in chosen else {}),
        },
    }
    tip = {"expected_rms_mm": chosen["expected_rms_mm"], "flange_expected_rms_mm": None}
    changed["tip"] = {**(document.get("tip") or {}), **tip}
    if document.get("covariance") is None and "off" in chosen:  # the arm without the columns is denied, this one is not
        changed |= {name: said[name] for name in ("covariance", "covariance_of")}
    return replace(arm, document=FrozenMapping({**document, **changed}))


def told_despite(arm: CalibratedArm, missing: Collection[str]) -> CalibratedArm:
    """The arm as rows tell of it that lack the columns of some effects, by their words."""
    further, effects = columns_that_tell(arm), arm.discrepancy.get("effects", ())
    return where_told(arm, [each["key"] for each in effects if each["key"] in further and each["words"] not in missing])


def told_notes(arm: CalibratedArm, missing: Mapping[str, tuple[str, ...]], beyond: Sequence[str]) -> list[str]:
    """What the columns of rows corrected, which are far beyond the fitted ones, and what they lack, a sentence each."""
    keys = columns_that_tell(arm)
    words = [effect["words"] for effect in arm.discrepancy.get("effects", ()) if effect["key"] in keys]
    done = listed([each for each in words if each not in missing])
    said = f"Corrected by columns of the rows: {done}; the verdict is about the arm with them."
    lacking = [
        f"Without the column{'s' * (len(names) > 1)} {listed(names)}, {words} is not corrected and counts as an error; "
        f"give {'them' if len(names) > 1 else 'it'}, and it is corrected."
        for words, names in missing.items()
    ]
    return [*[said] * bool(done), *beyond, *lacking]
