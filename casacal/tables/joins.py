"""Readings kept apart from the poses they belong to."""

from __future__ import annotations

import hashlib

from casacal.errors import SamplesError
from casacal.tables.text import Table

KEY = "pose"
"""Column by which readings find their pose, unless another one is named."""


def joined_tables(poses: Table, readings: Table, *, key: str = KEY) -> Table:
    """Each pose with the reading that carries the same id: the columns of both.

    Args:
        poses: rows of joint values.
        readings: rows of readings, in any order.
        key: column of both that holds the id, compared as text.

    Raises SamplesError when an id is missing, doubled, or without its counterpart.

    """
    for table in (poses, readings):
        if key not in table.header:
            raise SamplesError(
                table.file,
                f"there is no column '{key}' that says which reading belongs to which pose",
                "Name it by --id",
            )
    both = [name for name in readings.header if name in poses.header and name != key]
    if both:
        raise SamplesError(readings.file, f"'{poses.file}' has this column too", "Keep one of the two", column=both[0])
    poses, readings = poses.with_points(), readings.with_points()
    found = _by_id(readings, key)
    _by_id(poses, key)
    rows = []
    for row, line, name in zip(poses.rows, poses.lines, poses.column(key), strict=True):
        if name not in found:
            raise SamplesError(
                poses.file, f"pose '{name}' has no reading in {readings.file}", "Add it, or remove the line", line=line
            )
        extra = zip(readings.header, readings.rows[found.pop(name)], strict=True)
        rows.append((*row, *(cell for column, cell in extra if column != key)))
    for name, k in found.items():
        raise SamplesError(
            readings.file, f"'{name}' has no pose in {poses.file}", "Add it, or remove the line", line=readings.lines[k]
        )
    header = (*poses.header, *(column for column in readings.header if column != key))
    digest = hashlib.sha256((poses.sha256 + readings.sha256).encode()).hexdigest()
    return Table(
        f"{poses.file} with {readings.file}", digest, header, poses.header_line, tuple(rows), poses.lines, False
    )


def _by_id(table: Table, key: str) -> dict[str, int]:
    found: dict[str, int] = {}
    for k, (name, line) in enumerate(zip(table.column(key), table.lines, strict=True)):
        if not name or name in found:
            what = f"'{name}' appears twice" if name else "the id is empty"
            raise SamplesError(table.file, what, "Give each row its own id", line=line, column=key)
        found[name] = k
    return found
