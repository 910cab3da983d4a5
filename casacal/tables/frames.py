"""pandas frames as tables: for those who have their rows in memory."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from casacal.tables.text import Table


def is_frame(value: Any) -> bool:
    """Whether a value is a pandas DataFrame, without importing pandas for those who have none."""
    return type(value).__name__ == "DataFrame" and hasattr(value, "itertuples")


def table_of_frame(frame: Any, source: str = "DataFrame") -> Table:
    """The cells of a frame as text; "line" is then its row, counted from 1."""
    header = tuple(str(name) for name in frame.columns)
    rows = tuple(tuple(_cell(value) for value in row) for row in frame.itertuples(index=False, name=None))
    digest = hashlib.sha256(repr((header, rows)).encode()).hexdigest()
    return Table(source, digest, header, 0, rows, tuple(range(1, len(rows) + 1)), decimal_comma=False)


def _cell(value: Any) -> str:
    return repr(float(value)) if isinstance(value, (float, np.floating)) else str(value).strip()
