"""Lines of text in which bytes can be cells in one way alone: what pandas may read.

Whoever writes cells without a delimiter, quote or line end within them needs no grammar. That this is so is shown on
the bytes; where it is not shown, `large` reads the lines by the grammar.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from casacal.array_types import Array
from casacal.tables.columns import Labels
from casacal.tables.grammar import is_number

IN_NUMBERS = b"0123456789+-eE .,\t"
"""The bytes that numbers and blanks around them are made of; a delimiter is none of them."""
BYTE_ORDER_MARK = "\ufeff".encode()


@dataclass(frozen=True)
class Form:
    """How a file is written: its delimiter and header, which columns are read as numbers, which are kept as labels."""

    file: str
    delimiter: str
    line: int
    header: tuple[str, ...]
    numbers: tuple[str, ...]
    labels: tuple[str, ...]


@dataclass(frozen=True)
class Rows:
    """Rows of one section: numbers, labels, lines.

    marks: the decimal marks that all numbers may have. doubtful: whether a comment holds a number in their columns.
    """

    numbers: dict[str, Array]
    labels: dict[str, Labels]
    lines: Sequence[int]
    marks: frozenset[str]
    doubtful: bool = False


def _plain_cells(data: bytes, lines: int, form: Form) -> bytes | None:
    """Lines without comments whose cells end at each delimiter, quotes taken off; None where that is not shown.

    Each line has a cell for each column, and the columns of numbers hold nothing but what numbers are made of.
    """
    delimiter = form.delimiter.encode()
    step = csv.field_size_limit() // 2  # where a line ends in each stretch of that length, no cell is too long
    if any(data.find(b"\n", at, at + step) < 0 for at in range(0, len(data) - step + 1, step)):
        return None
    if not lines or data.startswith(BYTE_ORDER_MARK):  # which pandas would take off
        return None
    if b'"' in data:
        if not _quotes_whole_cells(data, form.delimiter):
            return None
        data = data.replace(b'"', b"")
    if b"+" in data and (b" " in data or b"\t" in data):  # pandas is less exact about +1.5 with blanks around it
        blanks = b" \t".replace(delimiter, b"")  # beside the end of a cell they are no part of it
        data = re.sub(rb"[%b]*(\n|%b)[%b]*" % (blanks, delimiter, blanks), rb"\1", data)
        if re.search(rb"\+[0-9.]+[eE][ \t]", data):  # and takes +1e 5 for a number
            return None
    rest = np.frombuffer(data.translate(None, IN_NUMBERS.replace(delimiter, b"")), dtype=np.uint8)
    ends = np.flatnonzero((rest == ord("\n")) | (rest == delimiter[0]))
    if len(ends) != lines * len(form.header) or not (rest[ends[len(form.header) - 1 :: len(form.header)]] == 10).all():
        return None
    sizes = np.diff(ends, prepend=-1).reshape(lines, -1)
    return data if (sizes[:, [form.header.index(name) for name in form.numbers]] == 1).all() else None


def _quotes_whole_cells(data: bytes, delimiter: str) -> bool:
    """Whether each quote opens or closes a cell, with no delimiter, line end or further quote between the two."""
    signs, ends = np.frombuffer(data, dtype=np.uint8), [ord("\n"), ord(delimiter)]
    quotes = np.flatnonzero(signs == ord('"'))
    if len(quotes) % 2:
        return False
    beside = np.concatenate([signs[quotes[::2] - 1], signs[quotes[1::2] + 1]])  # before the first is the last newline
    structure = data.translate(None, bytes(sign for sign in range(256) if sign not in (*ends, ord('"'))))
    return bool(np.isin(beside, ends).all()) and b'"' not in structure.replace(b'""', b"")


def read_plain(data: bytes, lines: Sequence[int], form: Form, marks: frozenset[str]) -> Rows | None:
    """Rows of lines without comments; None where cells are not plain, or a number is none with either decimal mark."""
    import pandas as pd

    if (plain := _plain_cells(data, len(lines), form)) is None:
        return None
    fits = {mark: frame for mark in sorted(marks) if (frame := _frame(plain, form, mark)) is not None}
    if not fits:
        return None
    frame, fitting = next(iter(fits.values())), frozenset(fits)
    if form.delimiter != ",":
        for name in frame.columns.difference(form.numbers):  # others may hold numbers, too; or dates, which are none
            for cell in pd.unique(frame[name]):
                if ("," in cell or "." in cell) and is_number(cell.strip()):
                    fitting &= {"," if "," in cell else "."}
    if not fitting:
        raise ValueError("two decimal marks")
    numbers = {name: frame[name].to_numpy() for name in form.numbers}
    labels = {}
    for name in form.labels:
        codes, names = pd.factorize(frame[name])
        labels[name] = Labels.coded(names, codes)
    return Rows(numbers, labels, lines, fitting)


def _frame(data: bytes, form: Form, mark: str) -> Any:
    """The cells as pandas reads them: columns of finite numbers, and others as they are written; or None.

    Where columns that nobody asked for may tell the decimal mark, they are read, too.
    """
    import pandas as pd

    kinds = dict.fromkeys(form.header if form.delimiter != "," else form.labels, "object") | dict.fromkeys(
        form.numbers, "float64"
    )
    # before 3.1 pandas had a faster way that may be wrong in the last digit
    version = tuple(int(part) for part in pd.__version__.split(".")[:2])
    exact: Any = {} if version >= (3, 1) else {"float_precision": "round_trip"}
    try:
        frame = pd.read_csv(
            io.BytesIO(data), sep=form.delimiter, decimal=mark, names=list(form.header), header=None,
            usecols=list(kinds), index_col=False, dtype=kinds, keep_default_na=False, na_filter=False,
            encoding="utf-8", quoting=csv.QUOTE_NONE, skip_blank_lines=False, low_memory=False, **exact,
        )  # fmt: skip
    except ValueError:
        return None
    return frame if all(np.isfinite(frame[name].to_numpy()).all() for name in form.numbers) else None
