"""Which rows are fitted and which are not: as a set's own page says, at random, and in blocks without neighbours."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.errors import CasacalError, UnknownNameError
from casacal.samples.samples import Samples
from casacal.tables.columns import Labels
from casacal.uncertainty.transfer import REGIONS, splits

Rows = NDArray[np.intp]

FOLDS = 5
MOST_BLOCKS = 12

STATED, RANDOM, BLOCKED = "stated", "random", "blocked"


def folds(samples: Samples, kind: str, blocks: str, stated: Mapping[str, Any]) -> list[tuple[Rows, Rows]]:
    """Rows to fit and rows that are not seen, fold by fold: "stated", "random" or "blocked".

    stated: {"part": 0.3, "seed": 0}, the last of a permutation, of so many "rows" of it where these are said;
    {"folds": 5, "seed": 0}; {"column": "split", "value": "test"}; or nothing.

    Raises CasacalError where the set cannot be split so.
    """
    everything = np.arange(len(samples))
    if kind == RANDOM:
        return _against(everything, _folds(np.random.default_rng(0).permutation(len(samples)), FOLDS))
    if kind == BLOCKED:
        return _against(everything, _blocks(samples, blocks))
    return _stated(samples, stated)


def _stated(samples: Samples, stated: Mapping[str, Any]) -> list[tuple[Rows, Rows]]:
    everything = np.arange(len(samples))
    order = np.random.default_rng(stated.get("seed", 0)).permutation(len(samples))
    if "column" in stated:
        labels, value = _labels(samples, stated["column"]), stated["value"]
        if value not in labels.names:
            raise UnknownNameError(f"value of '{stated['column']}' in {samples.file}", value, labels.names)
        return _against(everything, [np.flatnonzero(labels.codes == labels.names.index(value))])
    asked = max(stated.get("folds", 2), stated.get("rows", 2))
    if asked > len(samples):
        raise CasacalError(f"{samples.file} has {len(samples)} rows, and its split needs {asked}", "State another")
    if "folds" in stated:
        return _against(everything, _folds(order, stated["folds"]))
    if "part" not in stated:
        return []
    order = order[: stated.get("rows", len(order))]
    return _against(order, [order[round((1 - stated["part"]) * len(order)) :]])


def _against(rows: Rows, unseen: list[Rows]) -> list[tuple[Rows, Rows]]:
    """Each of the unseen with the others of these rows."""
    return [(np.setdiff1d(rows, part), np.sort(part)) for part in unseen]


def _blocks(samples: Samples, blocks: str) -> list[Rows]:
    if blocks == "order":
        return _folds(np.arange(len(samples)), FOLDS)
    if blocks == "regions":
        return splits(samples, None)[REGIONS]
    labels = _labels(samples, blocks)
    groups = np.array_split(np.arange(len(labels.names)), min(MOST_BLOCKS, len(labels.names)))
    if len(groups) < 2:
        raise CasacalError(f"The column '{blocks}' of {samples.file} has one value", "Name one with several")
    return [np.flatnonzero(np.isin(labels.codes, group)) for group in groups]


def _labels(samples: Samples, column: str) -> Labels:
    if column in samples.labels:
        return samples.labels[column]
    if column in samples.extra:
        return Labels.of(samples.extra[column])
    raise UnknownNameError("column", column, [*samples.labels, *samples.extra])


def _folds(order: Rows, count: int) -> list[Rows]:
    return [np.sort(part) for part in np.array_split(order, count)]


WAYS_TO_SPLIT = 'part = 0.3, seed = 0 (of so many "rows"); folds = 5, seed = 0; or column = "split", value = "test"'


def checked_split(stated: object, place: str) -> Mapping[str, Any]:
    """The [stated] of a description, where it is one of the ways to split; nothing is one.

    Raises CasacalError that names the `place` where something else came.
    """
    if not isinstance(stated, Mapping):
        raise CasacalError(f"The stated split of {place} is {stated!r}", f"Use a table with {WAYS_TO_SPLIT}")
    if not stated:
        return stated
    way = next((name for name in FORMS if name in stated), "")
    known = FORMS.get(way, {})
    lost = sorted(known.keys() - stated.keys() - OPTIONAL)
    strange = [name for name in stated if name not in known or not known[name](stated[name])]
    if not way or lost or strange:
        told = f"has {strange[0]} = {stated[strange[0]]!r}" if strange else f"lacks {lost[0]}"
        raise CasacalError(f"The stated split of {place} {told}", f"Use {WAYS_TO_SPLIT}")
    return stated


def _whole(least: int) -> Callable[[object], bool]:
    return lambda value: isinstance(value, int) and not isinstance(value, bool) and value >= least


def _fraction(value: object) -> bool:
    return isinstance(value, float) and 0 < value < 1


def _label(value: object) -> bool:
    return isinstance(value, str)


FORMS: Mapping[str, Mapping[str, Callable[[object], bool]]] = {
    "part": {"part": _fraction, "seed": _whole(0), "rows": _whole(2)},
    "folds": {"folds": _whole(2), "seed": _whole(0)},
    "column": {"column": _label, "value": _label},
}
"""What each way to split says, and which values it takes."""

OPTIONAL = {"seed", "rows"}
