"""Effects that columns of a file tell, such as torques: corrected row by row, or as in the fitted rows on average."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from casacal.array_types import Array
from casacal.compensation.arm import CalibratedArm
from casacal.discrepancy.effect import effects_of, refuse_unless
from casacal.problem.term import Site
from casacal.samples.samples import Samples
from casacal.values import FrozenMapping
from casacal.wording import listed

NOTHING_TOLD: Mapping[str, Array] = FrozenMapping({})

MOST_SPANS, FAR_SPANS, NEAR_NOTHING = 10.0, 0.5, 0.02
"""How far from the fitted rows an amount may be, in spans of these: more is refused, or else said; and how little all
amounts of a file may be, but for none at all."""


@dataclass(frozen=True, eq=False)
class TellingColumns:
    """Values of the columns that tell effects, for effects that are corrected by columns.

    columns: by name in the row model, each (N,); their means in the fitted rows where these rows lack them.
    missing: by an effect's words the columns that these rows lack. beyond: a sentence for each column with amounts far
    from those of the fitted rows. deviations: standard deviation, in the fitted rows, of each column at its mean.
    """

    columns: Mapping[str, Array]
    missing: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    beyond: tuple[str, ...] = ()
    deviations: Mapping[str, float] = field(default_factory=dict)

    @staticmethod
    def by(arm: CalibratedArm, rows: Samples) -> TellingColumns:
        """Columns of rows that drive an effect; raises SamplesError where one holds what it may not."""
        further = arm.found.effects.further
        if not further:
            return NOTHING
        site, said = Site(arm.source.problem.robot, arm.source.problem.instrument), arm.found.effects
        columns, lacking = dict[str, Array](), dict[str, tuple[str, ...]]()
        away, beyond = dict[str, float](), list[str]()
        for effect in effects_of(arm.used):
            if effect.key not in further:
                continue
            if absent := tuple(name for name in further[effect.key] if name not in rows.extra):
                lacking[effect.words] = absent
                for name in set(effect.columns(site)) & set(said.mean):
                    columns[name] = np.full(len(rows), said.mean[name])
                    away[name] = said.spread[name]
            else:
                columns |= effect.told(site, rows)
                beyond += _beyond(rows, effect.amounts(site, rows), said.ranges)
        return TellingColumns(columns, FrozenMapping(lacking), tuple(beyond), FrozenMapping(away))


NOTHING = TellingColumns(NOTHING_TOLD)
"""Of an arm that no column tells anything."""


def _beyond(rows: Samples, amounts: Mapping[str, Array], ranges: Mapping[str, tuple[float, float]]) -> list[str]:
    """A sentence for each column (N,) of an effect far from its fitted range; SamplesError if out of all proportion."""
    known = {name: ranges[name] for name in amounts if name in ranges}
    span = max((max(high, 0.0) - min(low, 0.0) for low, high in known.values()), default=0.0)
    said = []
    for name, (low, high) in known.items():
        values, fitted = amounts[name], f"the {low:g} to {high:g} of the fitted rows"
        away = np.maximum(low - values, values - high)
        fix = "Give it in their unit, such as kg and not g, or Nm and not mNm; or calibrate with such rows"
        good = (away <= MOST_SPANS * span) | (span == 0)  # of one that was always zero nothing is in proportion
        refuse_unless(good[:, None], rows, (name,), values[:, None], f"is out of all proportion to {fitted}", fix)
        row = int(np.argmax(away))
        if away[row] > FAR_SPANS * span:
            where = f"warning: {name} is {values[row]:g} on line {int(rows.lines[row])}"
            said.append(f"{where}, far from {fitted}, so what it corrects there is extrapolated.")
    largest = max((float(np.abs(amounts[name]).max(initial=0.0)) for name in known), default=0.0)
    if 0 < largest < NEAR_NOTHING * span:
        said.append(
            f"warning: {listed(list(known))} reach {largest:g} in these rows, next to nothing beside the {span:g} of "
            "the fitted rows: are they in the unit of those, such as Nm and not kNm?"
        )
    return said


def whole_rows(
    first: Array, joints: int, names: Sequence[str], told: Mapping[str, Array], elsewhere: Array | float = 0.0
) -> Array:
    """Rows (N, n + k) of a row model: the first columns (N, m), told ones (N,) by name, and `elsewhere` in others."""
    rows = np.zeros((len(first), joints + len(names)))
    rows[:, joints:] = elsewhere
    rows[:, : first.shape[1]] = first
    for name, values in told.items():
        rows[:, joints + names.index(name)] = values
    return rows


def told_notes(arm: CalibratedArm, missing: Mapping[str, tuple[str, ...]], beyond: Sequence[str]) -> list[str]:
    """What the columns of rows corrected, which are far beyond the fitted ones, and what they lack, a sentence each."""
    found = arm.found
    told = [words for key, words in found.called.items() if key in found.effects.further]
    done = listed([words for words in told if words not in missing])
    lacking = [
        f"Without {listed(names)}, {words} is corrected as in the fitted rows on average, and what rows differ by "
        "counts as an error; with them, each is corrected by its own."
        for words, names in missing.items()
    ]
    return [*([f"Corrected by columns of the rows: {done}."] if done else []), *beyond, *lacking]
