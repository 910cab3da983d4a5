"""How a set's own page splits it, as its description says."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from casacal.errors import CasacalError

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
