"""The names of a problem's instruments, and which unknowns some of them have in common."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from casacal.errors import ProblemError, UnknownNameError, came
from casacal.instruments import Instrument
from casacal.values import FrozenMapping

NAME = re.compile("[A-Za-z][A-Za-z0-9_-]*")

Shared = Mapping[str, tuple[str, ...]]
"""Keys of unknowns that instruments have in common, and the names of these."""


def named(given: Sequence[Any]) -> tuple[tuple[str, ...], tuple[Any, ...]]:
    """Names and instruments: of a mapping as it says, else "instrument1" and so on; an only one needs no name.

    Raises ProblemError for a name that is none.
    """
    if len(given) == 1 and isinstance(given[0], Mapping):
        for name in given[0]:
            if not isinstance(name, str) or not NAME.fullmatch(name):
                fix = "Use letters, digits, - and _, a letter first, such as 'tracker'"
                raise ProblemError(f"An instrument is called {name!r}", fix)
        return tuple(given[0]), tuple(given[0].values())
    return tuple(f"instrument{i}" for i in range(1, len(given) + 1)), tuple(given)


def shared_by(shared: Any, instruments: Mapping[str, Instrument]) -> Shared:
    """What was declared as shared; raises ProblemError where instruments do not have it, or not alike."""
    if not isinstance(shared, Mapping):
        fix = 'Name it and the instruments, such as shared={"tool": ("dial", "spike")}'
        raise ProblemError(f"{came(shared)} came as what instruments share", fix)
    found: dict[str, tuple[str, ...]] = {}
    for key, names in shared.items():
        if isinstance(names, str) or not isinstance(names, Sequence) or len(set(names)) < 2:
            fix = f'Name two instruments or more, such as shared={{"{key}": ("dial", "spike")}}'
            raise ProblemError(f"'{key}' is shared by {names!r}", fix)
        for name in names:
            if name not in instruments:
                raise UnknownNameError("instrument", str(name), list(instruments))
            if key not in instruments[name].unknowns:
                have = ", ".join(instruments[name].unknowns) or "none"
                raise ProblemError(f"'{name}' has no unknown '{key}' to share", f"It has: {have}")
        first, *others = (instruments[name].unknowns[key] for name in names)
        if any(other != first for other in others):
            raise ProblemError(
                f"'{key}' is declared in different ways by {' and '.join(names)}, which share it",
                "Declare it once, and give the same to each",
            )
        found[str(key)] = tuple(names)
    return FrozenMapping(found)


def full_names(names: Sequence[str], instruments: Sequence[Instrument], shared: Shared) -> Iterator[dict[str, str]]:
    """For each instrument the full name of each of its unknowns: after its own name unless it is shared or alone."""
    for name, instrument in zip(names, instruments, strict=True):
        before = "" if len(instruments) == 1 else f"{name}."
        yield {key: key if name in shared.get(key, ()) else before + key for key in instrument.unknowns}
