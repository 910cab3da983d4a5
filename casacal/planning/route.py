"""Touches to make, in their order: what a plan is, and what a session at the machine goes by."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from casacal.errors import SamplesError
from casacal.samples.layout import Layout, numeric_columns
from casacal.samples.samples import Samples
from casacal.tables.read import read_columns
from casacal.values import Value

FIT, AGAIN, CHECK = "fit", "again", "check"
"""What a touch is for: to be fitted; to be made a second time at the end; never to be fitted, but judged."""

EXPECTED = "expected_"
"""What the names of readings begin with that nobody has made yet."""


@dataclass(frozen=True, eq=False)
class Route(Value):
    """Touches in the order in which they should be made.

    samples: postures (N, n; rad, mm), readings to expect on the arm as drawn, and labels. purposes: of each (N,),
    "fit", "again" or "check".
    """

    samples: Samples
    purposes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.purposes)

    def __repr__(self) -> str:
        return f"<Route of {len(self)} touches>"


def read_route(path: str | Path, layout: Layout) -> Route:
    """Read what `write_plan` wrote, or a file of the same form; rows may be left out, moved and added by hand.

    layout: of the problem's samples. Raises SamplesError.
    """
    expected = _expected(layout)
    columns = read_columns(path, lambda header: numeric_columns(header, expected), layout.labels)
    measured = [name for name in columns.header if name.rpartition("_")[0] in layout.columns]
    if layout.columns and measured and not any(name.startswith(EXPECTED) for name in columns.header):
        fix = "Give what casacal plan wrote; its readings are called expected_..."
        raise SamplesError(columns.file, f"'{measured[0]}' is a measurement, and a plan has none", fix)
    read = Samples.from_columns(columns, expected)
    purposes = tuple(cell.strip() or FIT for cell in read.extra.get("purpose", (FIT,) * len(read)))
    for purpose, line in zip(purposes, read.lines, strict=True):
        if purpose not in (FIT, AGAIN, CHECK):
            fix = f"Write {FIT}, {AGAIN} or {CHECK}"
            raise SamplesError(read.file, f"'{purpose}' is no purpose", fix, line=line, column="purpose")
    readings = {name.removeprefix(EXPECTED): values for name, values in read.columns.items()}
    return Route(replace(read, columns=readings, extra={}), purposes)


def _expected(layout: Layout) -> Layout:
    """The same with readings that are to be expected."""
    return Layout(layout.joints, {EXPECTED + name: kind for name, kind in layout.columns.items()}, layout.labels)
