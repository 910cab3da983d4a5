"""Columns of numbers and labels without a Python object a cell: what every form of rows is read as.

Labels are held as the different ones and their numbers: a million rows touch a handful of planes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, overload

import numpy as np
from numpy.typing import NDArray

from casacal.errors import CasacalError, SamplesError, came
from casacal.values import Array, Index

Codes: TypeAlias = NDArray[np.int32]

MANY_ROWS = 100_000  # rows from which lines are numbers in an array rather than Python objects

Dimension: TypeAlias = Literal["length", "angle", "number"]  # dimension of a column's numbers: length, angle, or none


class Labels(Sequence[str]):
    """Labels of rows; reads like a tuple of str and equals one with the same labels.

    names: the different labels, in order of first appearance. codes: of each row (N,), its place in `names`; read-only.
    """

    def __init__(self, names: Sequence[str], codes: NDArray[Any]) -> None:
        codes = np.asarray(codes, dtype=np.int32)
        first, self.codes = _in_order(codes)
        self.names = tuple(names[int(codes[row])] for row in first)
        self.codes.setflags(write=False)

    @staticmethod
    def of(values: Iterable[str]) -> Labels:
        """Labels from one str per row."""
        if isinstance(values, Labels):
            return values
        places: dict[str, int] = {}
        codes = np.array([places.setdefault(value, len(places)) for value in values], dtype=np.int32)
        return Labels(tuple(places), codes)

    @staticmethod
    def alike(name: str, rows: int) -> Labels:
        """Labels that are the same in all rows."""
        return Labels((name,), np.zeros(rows, dtype=np.int32))

    @staticmethod
    def coded(names: Iterable[str], codes: NDArray[Any]) -> Labels:
        """Labels from names, stripped of blanks, and the index of each row's name among them."""
        stripped = [str(name).strip() for name in names]
        places = {name: k for k, name in enumerate(dict.fromkeys(stripped))}
        return Labels(tuple(places), np.array([places[name] for name in stripped], dtype=np.int32)[codes])

    @staticmethod
    def joined(parts: Sequence[Labels]) -> Labels:
        """Labels of rows that come one after another."""
        before = np.cumsum([0, *(len(part.names) for part in parts)])
        codes = [part.codes + first for part, first in zip(parts, before, strict=False)]
        return Labels.coded([name for part in parts for name in part.names], np.concatenate(codes))

    def take(self, rows: Index) -> Labels:
        """Labels of some rows."""
        return Labels(self.names, self.codes[rows])

    def rows(self) -> dict[str, Index]:
        """Rows of each label, in order."""
        return dict(zip(self.names, rows_by_code(self.codes, len(self.names)), strict=True))

    def __len__(self) -> int:
        return int(self.codes.size)

    @overload
    def __getitem__(self, index: int) -> str: ...
    @overload
    def __getitem__(self, index: slice) -> Labels: ...
    def __getitem__(self, index: int | slice) -> str | Labels:
        if isinstance(index, slice):
            return Labels(self.names, self.codes[index])
        return self.names[int(self.codes[index])]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, (Labels, tuple, list)) and tuple(self) == tuple(other)

    __hash__ = None  # type: ignore[assignment]  # compared by its labels

    def __reduce__(self) -> tuple[type[Labels], tuple[tuple[str, ...], Codes]]:
        return Labels, (self.names, np.array(self.codes))

    def __deepcopy__(self, memo: object) -> Labels:
        return self

    def __repr__(self) -> str:
        shown = ", ".join(repr(label) for label in self[:4])
        return f"<{len(self)} labels: {shown}{', ...' if len(self) > 4 else ''}>"

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        return np.array(self.names, dtype=dtype)[self.codes]


def row_numbers(rows: Any, count: int) -> Index:
    """Numbers of some of `count` rows, from numbers or from a mask of them; raises CasacalError for others."""
    index = np.asarray(rows)
    if index.dtype == bool and index.shape == (count,):
        return np.flatnonzero(index)
    if index.ndim != 1 or (index.size and index.dtype.kind not in "iu"):
        what = f"Got {came(rows)} of {index.dtype} as numbers of rows"
        raise CasacalError(what, f"Give whole numbers below {count}, or a mask of {count}")
    return index.astype(np.intp, copy=False)


@dataclass(frozen=True)
class Columns:
    """Named columns of equal length: what every form of rows is read as; `number` and `text` read one of them.

    header_line: where a text file has its header, 0 for arrays. lines: of each row in its file; for arrays its row,
    counted from 1. texts: all columns as they were written, for rows that were read cell by cell; none otherwise.
    """

    file: str
    sha256: str
    header: tuple[str, ...]
    header_line: int
    lines: Sequence[int]
    number: Callable[[str], Array]
    text: Callable[[str], Labels]
    texts: Callable[[], Mapping[str, tuple[str, ...]]] = dict

    def refusal(self, what: str, fix: str, column: str | None) -> SamplesError:
        """An error about the header, at its line where there is one."""
        return SamplesError(self.file, what, fix, line=self.header_line or None, column=column)

    def cell(self, name: str, row: int) -> str:
        """One cell as it was written, or where nobody keeps that, its number."""
        texts = self.texts()
        return texts[name][row] if name in texts else f"{self.number(name)[row]:g}"


def combinations(columns: Sequence[Labels], rows: int) -> tuple[list[tuple[str, ...]], Codes]:
    """Distinct combinations of labels, in order of first appearance, and the index of each row's own (N,)."""
    numbers = np.zeros(rows, dtype=np.int64)
    for column in columns:
        numbers = numbers * len(column.names) + column.codes
    first, codes = _in_order(numbers)
    return [tuple(column[int(row)] for column in columns) for row in first], codes


def rows_by_code(codes: NDArray[Any], count: int) -> list[Index]:
    """Rows, in order, that have each of the codes 0 ... count - 1 (N,)."""
    starts = np.cumsum(np.bincount(codes, minlength=count))[:-1]
    return np.split(np.argsort(codes, kind="stable"), starts) if count else []


def _in_order(values: NDArray[Any]) -> tuple[Index, Codes]:
    """First row of each distinct value, in order, and the index of each row's value (N,) among them."""
    if values.size and values.min() >= 0 and values.max() < 4 * values.size:  # counting is sooner done than sorting
        firsts = np.full(int(values.max()) + 1, values.size, dtype=np.intp)
        np.minimum.at(firsts, values, np.arange(values.size))
        found = np.flatnonzero(firsts < values.size)
        order = np.argsort(firsts[found])
        numbered = np.zeros(len(firsts), dtype=np.int32)
        numbered[found[order]] = np.arange(len(found))
        return firsts[found[order]], numbered[values]
    _, first, inverse = np.unique(values, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")
    return first[order], np.argsort(order).astype(np.int32)[inverse.ravel()]
