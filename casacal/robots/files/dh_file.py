"""A DH table in a file: read it, write it.

docs/files.md says how the files look, as CSV and as TOML.
"""

from __future__ import annotations

from pathlib import Path

from casacal.robots.dh_table import DHTable
from casacal.robots.files.dh_fields import BLOCK_FIELDS, table_of
from casacal.robots.files.dh_text import ENTRY, csv_text, decode, read_csv, read_toml, toml_text


def read_dh_file(path: str | Path) -> DHTable:
    """Read a DH table, as TOML when the name ends in .toml, else as CSV.

    Raises ProblemError that names the file, the line or joint, and what to do.
    """
    return table_of(read_toml(path) if is_toml(path) else read_csv(path))


def unread_keys(path: str | Path) -> tuple[str, ...]:
    """Keys in comments of a CSV that mean nothing, such as `units` of '# units: m', each once; none in TOML."""
    found = () if is_toml(path) else (ENTRY.fullmatch(line) for line in decode(Path(path)).splitlines())
    unread = dict.fromkeys(each[1] for each in found if each and each[1] not in BLOCK_FIELDS)
    return tuple(key for key in unread if key != "casacal")  # what exports say of themselves


def dh_file_text(table: DHTable, path: str | Path) -> str:
    """A DH table as the text of a file of that name: TOML when it ends in .toml, else CSV."""
    return toml_text(table) if is_toml(path) else csv_text(table)


def is_toml(path: str | Path) -> bool:
    """Whether a file of that name holds TOML."""
    return Path(path).suffix.lower() == ".toml"
