"""Proof that cells are those of the grammar, after a quick reader found them: an account of the signs of their lines.

What the labels hold beside signs of numbers, with all delimiters and line ends, must be all that the lines hold beside
signs of numbers. Then nothing of the kind is left for the columns of numbers, and no cell was lost or moved. It is
sooner counted than looked for, but takes all columns; where one is not kept, `plain_lines` proves what can be proven.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.tables.grammar import NUMBER
from casacal.tables.plain_lines import HIGH, NUMERIC, SHOWN, Form, Plain, cells_are_short, count, ended_by_newlines
from casacal.tables.sections import Rows

PIECE = 1 << 16
"""Signs that are looked at together: as many as stay near the processor, and need no new memory of the system."""
FEW = 1000
"""Different labels that are soon gone through one by one, however many rows there are."""
USUAL = b"0123456789-."
"""Signs of numbers that are expected in every file."""
_WHOLLY_QUOTED = re.compile(r'"[^"]*"')


def accountable(data: bytes, lines: int, form: Form) -> Plain | None:
    """Whole lines, so many, that may turn out to be plain once their cells are known; None where none can tell."""
    if len({*form.numbers, *form.texts}) < len(form.names) or not cells_are_short(data):
        return None
    ended = ended_by_newlines(data)
    marks = "" if form.delimiter == "," else "".join(mark for mark in ",." if mark.encode() in data)
    return None if ended is None or len(marks) > 1 else Plain(ended, lines, marks)


def accounted(rows: Rows, plain: Plain, form: Form) -> Rows | None:
    """The rows that were read of lines, labels without their quotes; None unless both hold the same signs."""
    labels = {}
    written: list[tuple[str, int]] = []
    for name, (found, codes) in rows.labels.items():
        few = len(found) <= FEW + plain.lines // 4
        said = _said(found, form, first=name == form.names[0]) if few else None
        if said is None:
            return None
        labels[name] = said, codes
        written += zip(found, np.bincount(codes, minlength=len(found)).tolist(), strict=True)
    ends = plain.lines * len(form.names)
    for signs in (_likely(plain.data, form), NUMERIC[form.delimiter]):
        beside = sum(times * len(label.encode().translate(None, signs)) for label, times in written)
        if len(plain.data) - _count_of(plain.data, signs) == beside + ends:
            return replace(rows, labels=labels, mark=_mark(plain, written))
    return None


def _mark(plain: Plain, written: list[tuple[str, int]]) -> str:
    """The decimal mark, or "" where no number has it; labels may hold numbers, too."""
    if not plain.mark:
        return ""
    marked = [(label, times) for label, times in written if plain.mark in label]
    among = any(NUMBER.fullmatch(label.strip('"').strip().replace(",", ".")) for label, _ in marked)
    beside = sum(times * label.count(plain.mark) for label, times in marked)
    return plain.mark if among or count(plain.data, plain.mark.encode()) > beside else ""


def _said(written: Sequence[Any], form: Form, *, first: bool) -> list[str] | None:
    """Labels without their quotes; None where one is absent, makes a comment of its line, or its quotes are odd."""
    said = []
    for label in written:
        if not isinstance(label, str) or not label or label.encode().translate(None, SHOWN + HIGH):
            return None
        blank = form.delimiter == "\t" and not label.strip()  # what comes after it may begin the line
        if first and (blank or label.lstrip().startswith("#")):
            return None
        if '"' in label and not _WHOLLY_QUOTED.fullmatch(label):
            return None
        said.append(label.strip('"'))
    return said


def _likely(data: bytes, form: Form) -> bytes:
    """Signs of numbers without those that are seldom, unless they stand in the first line; the fewer the sooner."""
    cells = data[: data.index(b"\n")].split(form.delimiter.encode())
    numbers = b"".join(cell for name, cell in zip(form.names, cells, strict=False) if name in form.numbers)
    return bytes(sign for sign in NUMERIC[form.delimiter] if sign in USUAL or sign in numbers)


def _count_of(data: bytes, signs: bytes) -> int:
    """How often any of some signs stands in data."""
    spans: list[list[int]] = []
    for sign in sorted(signs):  # two spans are one, where what parts them is a sign that does not occur
        if spans and (sign == spans[-1][1] + 1 or (sign == spans[-1][1] + 2 and bytes([sign - 1]) not in data)):
            spans[-1][1] = sign
        else:
            spans.append([sign, sign])
    whole, found = np.frombuffer(data, dtype=np.uint8), 0
    bounds = [(np.uint8(low), np.uint8(high - low)) for low, high in spans]
    for at in range(0, len(whole), PIECE):
        here: NDArray[np.uint8] = whole[at : at + PIECE]
        found += sum(int(np.count_nonzero(here - low <= more)) for low, more in bounds)
    return found
