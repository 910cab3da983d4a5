"""Proof that lines are plain: that a reader which knows delimiters and line ends alone reads what the grammar reads.

Whatever is not proven is not wrong, only not plain: it is read cell by cell. What numbers are made of is taken out
first, once: the seventh part that remains holds all that there is to prove, and is soon gone through.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NEWLINE, QUOTE = ord("\n"), ord('"')
DIGITS = b"0123456789+-eE"
"""Of which numbers are made, apart from decimal marks."""
NUMERIC = {",": DIGITS + b" \t.", ";": DIGITS + b" \t.,", "\t": DIGITS + b" .,"}
"""By delimiter, of what a cell may be made that is read as a number; or refused, as 1.2.3 is."""
BYTE_ORDER_MARK = "\ufeff".encode()
SHOWN = bytes(range(32, 127)) + b"\t"
HIGH = bytes(range(128, 256))

OTHER, FOREIGN, POINT, COMMA = (1 << k for k in range(4))
"""What the rest of a cell may hold, as bits: signs of ASCII, what lies beyond, and decimal marks."""


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
    if not cells_are_short(data) or (ended := ended_by_newlines(data)) is None:
        return None
    data = ended
    rest = data.translate(None, _TAKEN_OUT[form.delimiter])
    if rest.startswith(BYTE_ORDER_MARK) or rest.translate(None, SHOWN + HIGH + b"\n") or not _decodes(data):
        return None
    if b"#" in rest and _has_comment(data):
        return None
    if b'"' in rest:
        if not _quotes_whole_cells(data, rest, form.delimiter):
            return None
        data, rest = data.replace(b'"', b""), rest.replace(b'"', b"")
    ends = _ends(rest, form)
    mark = None if ends is None else _mark_of_cells(rest, ends, form)
    return None if ends is None or mark is None else Plain(data, len(ends) // len(form.names), mark)


def ended_by_newlines(data: bytes) -> bytes | None:
    """The same lines, each ended by a newline alone; None where a line ends otherwise."""
    if not data.endswith(b"\n"):
        data += b"\n"
    if b"\r" not in data:
        return data
    return data.replace(b"\r\n", b"\n") if data.count(b"\r\n") == count(data, b"\r") else None


def cells_are_short(data: bytes) -> bool:
    """Whether no line, and so no cell, is longer than a cell may be: twice a stretch in which each time one ends."""
    step = max(csv.field_size_limit() // 2, 1)
    return all(data.find(b"\n", at, at + step) >= 0 for at in range(0, len(data) - step + 1, step))


def count(data: bytes, sign: bytes) -> int:
    """How often one sign stands in data; many times as fast as bytes.count where it stands often."""
    return int(np.count_nonzero(np.frombuffer(data, dtype=np.uint8) == ord(sign)))


def _decodes(data: bytes) -> bool:
    try:
        return data.isascii() or bool(data.decode("utf-8"))
    except UnicodeDecodeError:
        return False


def _has_comment(data: bytes) -> bool:
    """Whether # begins a line, be it after blanks."""
    signs = np.frombuffer(data, dtype=np.uint8)
    starts = np.concatenate([[0], np.flatnonzero(signs[:-1] == NEWLINE) + 1])
    odd = starts[_BEFORE_COMMENTS[signs[starts]]].tolist()
    return any(data[at : data.index(b"\n", at)].decode("utf-8").lstrip().startswith("#") for at in odd)


def _quotes_whole_cells(data: bytes, rest: bytes, delimiter: str) -> bool:
    """Whether each quote opens or closes a cell, with no delimiter, line end or further quote between the two."""
    signs = np.frombuffer(data, dtype=np.uint8)
    quotes = np.flatnonzero(signs == QUOTE)
    if len(quotes) % 2:
        return False
    beside = np.concatenate([signs[quotes[::2] - 1], signs[quotes[1::2] + 1]])  # before the first is the last newline
    pairs = rest.translate(None, _NO_STRUCTURE[delimiter]).replace(b'""', b"")
    return b'"' not in pairs and bool(((beside == NEWLINE) | (beside == ord(delimiter))).all())


def _ends(rest: bytes, form: Form) -> NDArray[np.intp] | None:
    """Where the cells of lines end; None unless each line has as many as the header."""
    signs, width = np.frombuffer(rest, dtype=np.uint8), len(form.names)
    breaks = signs == NEWLINE
    ends = np.flatnonzero(breaks | (signs == ord(form.delimiter)))
    lines, beyond = divmod(len(ends), width)
    return ends if not beyond and np.count_nonzero(breaks) == lines and breaks[ends[width - 1 :: width]].all() else None


def _mark_of_cells(rest: bytes, ends: NDArray[np.intp], form: Form) -> str | None:
    """The decimal mark of all numbers, or of what may be one; None where there are two, or numbers hold other signs."""
    width, numbers = len(form.names), [form.names.index(name) for name in form.numbers]
    sizes = np.diff(ends, prepend=-1)  # each with its end
    if form.delimiter == ",":
        return "" if all((sizes[column::width] == 1).all() for column in numbers) else None
    kinds = np.frombuffer(rest.translate(_KINDS[form.delimiter]), dtype=np.uint8)
    held = np.bitwise_or.reduceat(kinds, ends - sizes + 1).reshape(-1, width)
    found = int(np.bitwise_or.reduce(held[:, numbers], axis=None))
    if found & (OTHER | FOREIGN):
        return None
    marks = {mark for mark, bit in ((",", COMMA), (".", POINT)) if found & bit}
    held[:, numbers] = 0  # others may hold numbers, too; or dates, which are none
    odd = np.flatnonzero((held & (POINT | COMMA)).astype(bool) & ~(held & OTHER).astype(bool))
    for left in {rest[end - size + 1 : end] for end, size in zip(ends[odd].tolist(), sizes[odd].tolist(), strict=True)}:
        if left.count(b",") + left.count(b".") == 1:
            marks.add("," if b"," in left else ".")
    return "".join(marks) if len(marks) < 2 else None


def _kinds(delimiter: str) -> bytes:
    """For each byte, what a cell that has it holds; nothing for what ends a cell."""
    kinds = np.full(256, OTHER, dtype=np.uint8)
    kinds[128:] = FOREIGN
    kinds[ord(".")], kinds[ord(",")] = POINT, COMMA
    kinds[[NEWLINE, ord(delimiter)]] = 0
    return kinds.tobytes()


_KINDS = {delimiter: _kinds(delimiter) for delimiter in ";\t"}
_TAKEN_OUT = {end: signs if end == "," else signs.translate(None, b".,") for end, signs in NUMERIC.items()}
"""All of them, but for decimal marks where there are two."""
_NO_STRUCTURE = {end: bytes(sign for sign in range(256) if sign not in b'\n"' + end.encode()) for end in ",;\t"}
_BEFORE_COMMENTS = np.isin(np.arange(256), list(b"# \t" + HIGH))
"""What a line that is a comment may begin with."""
