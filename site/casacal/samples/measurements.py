"""What several instruments measured of one arm: the samples of each, one after another."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.samples.samples import Samples
from casacal.tables.columns import Labels
from casacal.values import Value

Places = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Measurements(Value):
    """Samples of each instrument; rows are numbered through all of them, in the order of the instruments.

    names: of the instruments; empty for an only one.
    """

    names: tuple[str, ...]
    sets: tuple[Samples, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "sets", tuple(self.sets))

    def __len__(self) -> int:
        return sum(map(len, self.sets))

    def __repr__(self) -> str:
        return f"<{', '.join(f'{len(some)} of {name}' for name, some in zip(self.names, self.sets, strict=True))}>"

    @staticmethod
    def of(samples: Samples | Measurements) -> Measurements:
        """Samples of an only instrument, or what there is of several."""
        return samples if isinstance(samples, Measurements) else Measurements(("",), (samples,))

    @property
    def plain(self) -> Samples | Measurements:
        """Samples where there is one instrument, else itself."""
        return self if len(self.sets) > 1 else self.sets[0]

    @cached_property
    def starts(self) -> Places:
        """Number of the first row of each instrument, and of all rows (instruments + 1,)."""
        return np.cumsum([0, *map(len, self.sets)])

    @property
    def joints(self) -> Array:
        """Joint values (N, n; rad, mm) of all rows."""
        return self.sets[0].joints if len(self.sets) == 1 else np.vstack([some.joints for some in self.sets])

    @property
    def lines(self) -> Sequence[int]:
        """Line of each row in the file of its instrument (N,)."""
        return self.sets[0].lines if len(self.sets) == 1 else tuple(line for some in self.sets for line in some.lines)

    @property
    def instruments(self) -> Places:
        """Which instrument each row is of (N,)."""
        return np.repeat(np.arange(len(self.sets)), [len(some) for some in self.sets])

    @property
    def file(self) -> str:
        """The files, in the order of the instruments."""
        return " and ".join(dict.fromkeys(some.file for some in self.sets))

    @property
    def sha256(self) -> str:
        """Of the only file, or of the hashes of all."""
        if len(self.sets) == 1:
            return self.sets[0].sha256
        return hashlib.sha256(" ".join(some.sha256 for some in self.sets).encode()).hexdigest()

    def place(self, row: int) -> int | str:
        """The line of a row; with the name of its instrument where there are several."""
        if len(self.sets) == 1:
            return int(self.sets[0].lines[row])
        i = int(np.searchsorted(self.starts, row, side="right")) - 1
        return f"{self.names[i]} {self.sets[i].lines[row - int(self.starts[i])]}"

    def take(self, rows: Sequence[int] | Places) -> Measurements:
        """Some rows, those of each instrument in the order in which they are named."""
        apart = self.apart(np.asarray(rows, dtype=np.intp))
        return Measurements(self.names, tuple(map(Samples.take, self.sets, apart)))

    def apart(self, rows: Places) -> list[Places]:
        """Rows of each instrument, numbered within it."""
        which = np.searchsorted(self.starts, rows, side="right") - 1
        return [rows[which == k] - first for k, first in enumerate(self.starts[:-1])]

    def labelled(self, groups: Sequence[str | None]) -> Labels:
        """Labels (N,) by a column of each instrument; where there are several, after the instrument's name."""
        faces = [some.faces(column) for some, column in zip(self.sets, groups, strict=True)]
        if len(faces) == 1:
            return faces[0]
        parts = []
        for name, some, column, own in zip(self.names, self.sets, groups, faces, strict=True):
            have = column is not None and column in some.labels
            parts.append(Labels([f"{name} {label}" if have else name for label in own.names], own.codes))
        return Labels.joined(parts)

    def by_instrument(self) -> Labels:
        """The name (N,) of the instrument that each row is of."""
        return Labels(self.names, self.instruments)

    def map(self, change: Callable[[Samples], Samples]) -> Measurements:
        """The samples of each instrument changed alike."""
        return Measurements(self.names, tuple(map(change, self.sets)))


def sets_of(samples: Sequence[Samples | Measurements]) -> tuple[Samples, ...]:
    """The samples of each instrument, whether they come one after another or together."""
    return tuple(some for each in samples for some in (each.sets if isinstance(each, Measurements) else (each,)))
