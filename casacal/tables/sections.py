"""Rows of a file that was read section by section, put together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.tables.columns import Columns
from casacal.tables.grammar import logical_lines, numbered_rows
from casacal.tables.labels import Labels
from casacal.tables.plain_lines import Form
from casacal.tables.text import read_table

MANY = 100_000
"""Rows from which lines are numbers in an array rather than Python objects."""


@dataclass(frozen=True)
class Rows:
    """Rows of one section: numbers, different labels and which a row has, their lines, their decimal mark, or "".

    doubtful: whether a comment among them is a row, should rows begin with text.
    """

    numbers: Mapping[str, Array]
    labels: Mapping[str, tuple[Sequence[str], NDArray[Any]]]
    lines: range | tuple[int, ...]
    mark: str
    doubtful: bool = False


class Gathered:
    """The rows of all sections, each put where it belongs."""

    def __init__(self, size: int, form: Form) -> None:
        self._form, self._count, self._marks, self.doubtful = form, 0, "", False
        most = size // (len(form.names) + len(form.numbers)) + 1  # bytes of a row; memory not used is free
        self._numbers = {name: np.empty(most) for name in form.numbers}
        self._codes = {name: np.empty(most, dtype=np.int32) for name in form.texts}
        self._known: dict[str, dict[str, int]] = {name: {} for name in form.texts}
        self._lines: list[range | tuple[int, ...]] = []

    def add(self, section: Sequence[Rows]) -> None:
        """All rows of the next section; raises ValueError where its numbers have another decimal mark."""
        for rows in section:
            self._add(rows)

    def _add(self, rows: Rows) -> None:
        here = slice(self._count, self._count + len(rows.lines))
        self._marks, self.doubtful = self._marks or rows.mark, self.doubtful or rows.doubtful
        if rows.mark not in ("", self._marks):
            raise ValueError("two decimal marks")
        for name, values in rows.numbers.items():
            self._numbers[name][here] = values
        for name, (labels, codes) in rows.labels.items():
            known = self._known[name]
            numbered = np.array([known.setdefault(label.strip(), len(known)) for label in labels], dtype=np.int32)
            self._codes[name][here] = numbered[codes]
        self._lines.append(rows.lines)
        self._count = here.stop

    def columns(self, path: Path, digest: str, line: int) -> Columns:
        """All rows; raises ValueError where there are none."""
        if not self._count:
            raise ValueError("no rows")
        numbers = {name: values[: self._count] for name, values in self._numbers.items()}
        labels = {name: Labels(tuple(self._known[name]), codes[: self._count]) for name, codes in self._codes.items()}
        lines = _joined(self._lines, self._count)

        def number(name: str) -> Array:
            return numbers[name] if name in numbers else read_table(path).columns.number(name)

        def text(name: str) -> Labels:
            return labels[name] if name in labels else read_table(path).columns.text(name)

        def cell(name: str, row: int) -> str:
            with path.open("rb") as file:
                text = next(islice(file, lines[row] - 1, None)).decode("utf-8")
            cells = numbered_rows(logical_lines(text), self._form.delimiter, str(path))[0][1]
            return cells[self._form.names.index(name)]

        return Columns(str(path), digest, self._form.names, line, lines, number, text, written=cell)


def _joined(lines: list[range | tuple[int, ...]], count: int) -> Sequence[int]:
    """Lines of all sections: a tuple of few, else a range where none was left out, else an array."""
    parts = [part for part in lines if part]
    first, last = parts[0][0], parts[-1][-1]
    whole = (
        range(first, last + 1) if last - first + 1 == count else np.concatenate([np.asarray(part) for part in parts])
    )
    return tuple(int(line) for line in whole) if count < MANY else cast(Sequence[int], whole)
