"""Proof that lines are plain: that a reader which knows delimiters and line ends alone reads what the grammar reads.

Whatever is not proven is not wrong, only not plain: it is read cell by cell.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casacal.tables.grammar import NUMBER

NEWLINE = ord("\n")
DIGITS = b"0123456789+-.eE"
"""Of which numbers are made, apart from a decimal comma."""
SHOWN = bytes(range(32, 127)) + b"\t\r"
HIGH = bytes(range(128, 256))

DIGIT, BLANK, HASH, OTHER, FOREIGN, POINT, COMMA = (1 << k for k in range(7))
"""What a cell may hold, as bits: of numbers, blanks, #, other signs of ASCII, what lies beyond, and decimal marks."""
NUMERIC = DIGIT | BLANK | POINT | COMMA


@dataclass(frozen=True)
class Form:
    """How a file is written: its delimiter, the names of its columns, which hold numbers, which are kept as text."""

    delimiter: str
    names: tuple[str, ...]
    numbers: tuple[str, ...]
    texts: tuple[str, ...]


@dataclass(frozen=True)
class Plain:
    """Lines that are proven plain, all ended by a newline, without quotes; their number; their decimal mark, or ""."""

    data: bytes
    lines: int
    mark: str


def proven(data: bytes, form: Form) -> Plain | None:
    """Whole lines as plain ones, or None where that is not proven."""
    delimiter = form.delimiter.encode()
    if not data.endswith(b"\n"):
        data += b"\n"
    unusual = data.translate(None, DIGITS + b",\n" + delimiter)
    if unusual.translate(None, SHOWN + HIGH) or not _decodes(data):
        return None
    if b"\r" in unusual:
        if data.count(b"\r\n") != unusual.count(b"\r"):
            return None
        data = data.replace(b"\r\n", b"\n")
    lines = count(data, b"\n")
    if not unusual and len(form.numbers) == len(form.names):
        # a cell too many leaves a line with one too few, and no reader takes an empty cell for a number
        whole = count(data, delimiter) == lines * (len(form.names) - 1)
        marks = "" if form.delimiter == "," else "".join(mark for mark in ",." if mark.encode() in data)
        return Plain(data, lines, marks) if whole and len(marks) < 2 else None
    ends = _ends(data, lines, form)
    if ends is not None and b'"' in unusual:
        if not _quotes_whole_cells(data, ends):
            return None
        data = data.replace(b'"', b"")
        ends = _ends(data, lines, form)
    mark = None if ends is None else _mark_of_cells(data, ends, form)
    return None if mark is None else Plain(data, lines, mark)


def count(data: bytes, sign: bytes) -> int:
    """How often one sign stands in data; many times as fast as bytes.count where it stands often."""
    return int(np.count_nonzero(np.frombuffer(data, dtype=np.uint8) == ord(sign)))


def _decodes(data: bytes) -> bool:
    try:
        return data.isascii() or bool(data.decode("utf-8"))
    except UnicodeDecodeError:
        return False


def _ends(data: bytes, lines: int, form: Form) -> NDArray[np.intp] | None:
    """Where the cells of lines end; None unless each line has as many as the header, none longer than may be."""
    signs, width = np.frombuffer(data, dtype=np.uint8), len(form.names)
    breaks = signs == NEWLINE
    ends = np.flatnonzero(breaks | (signs == ord(form.delimiter)))
    if len(ends) != lines * width or not breaks[ends[width - 1 :: width]].all():
        return None
    return ends if np.diff(ends, prepend=-1).max() <= csv.field_size_limit() else None


def _quotes_whole_cells(data: bytes, ends: NDArray[np.intp]) -> bool:
    """Whether each quote opens or closes a cell, with no delimiter, line end or further quote between the two."""
    quotes = np.flatnonzero(np.frombuffer(data, dtype=np.uint8) == ord('"'))
    opening, closing = quotes[::2], quotes[1::2]
    if len(opening) != len(closing):
        return False
    cell = np.searchsorted(ends, opening)
    first = np.where(cell > 0, ends[cell - 1] + 1, 0)
    return bool((opening == first).all() and (closing == ends[cell] - 1).all())


def _mark_of_cells(data: bytes, ends: NDArray[np.intp], form: Form) -> str | None:
    """The decimal mark of all numbers; None where there are two, where numbers hold other signs, or # begins a line."""
    kinds = np.frombuffer(data.translate(_KINDS[form.delimiter]), dtype=np.uint8)
    starts = np.concatenate([[0], ends[:-1] + 1])
    held = np.bitwise_or.reduceat(kinds, starts).reshape(-1, len(form.names))
    numbers = [form.names.index(name) for name in form.numbers]
    found = int(np.bitwise_or.reduce(held[:, numbers], axis=None))
    first = held[:, 0]  # where it is blank, a # after it begins the line, if tabs are between the cells
    if b"#" in data and ((first & HASH) | ((first & (DIGIT | POINT | COMMA | OTHER)) == 0)).any():
        return None
    if found & ~NUMERIC:
        return None
    if form.delimiter == ",":
        return ""
    marks = {mark for mark, bit in ((",", COMMA), (".", POINT)) if found & bit}
    held[:, numbers] = 0  # others may hold numbers, too; or dates, which are none
    odd = np.flatnonzero((held & (POINT | COMMA)).astype(bool) & ~(held & (OTHER | HASH)).astype(bool))
    for written in {data[start:end] for start, end in zip(starts[odd].tolist(), ends[odd].tolist(), strict=True)}:
        text = written.decode("utf-8").strip()
        if NUMBER.fullmatch(text.replace(",", ".")):
            marks.add("," if "," in text else ".")
    return "".join(marks) if len(marks) < 2 else None


def _kinds(delimiter: str) -> bytes:
    """For each byte, what a cell that has it holds; nothing for what ends a cell."""
    kinds = np.full(256, OTHER, dtype=np.uint8)
    kinds[128:] = FOREIGN
    kinds[list(DIGITS)] = DIGIT
    kinds[list(b" \t")], kinds[ord("#")], kinds[ord(".")], kinds[ord(",")] = BLANK, HASH, POINT, COMMA
    kinds[[NEWLINE, ord(delimiter)]] = 0
    return kinds.tobytes()


_KINDS = {delimiter: _kinds(delimiter) for delimiter in ",;\t"}
