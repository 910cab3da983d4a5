"""Zip archives from anywhere: what they unpack to is known, and bounded, before anything in them is read."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path

from casacal.errors import SamplesError

MOST_MEMBERS = 10_000
UNPACKED = 1 << 26
"""Bytes that any archive may unpack to."""
GROWTH = 20
"""A larger archive may unpack to so many times its size; measurements seldom shrink to a half."""
PIECE = 1 << 20


def check_unpacked(path: Path, file: str) -> None:
    """Raise SamplesError for an archive with too many members, or that unpacks to too much.

    Raises zipfile.BadZipFile, OSError or the like for what is no archive.
    """
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
    size, most = sum(member.file_size for member in members), max(UNPACKED, GROWTH * path.stat().st_size)
    if len(members) > MOST_MEMBERS:
        what = f"the archive has {len(members)} members; at most {MOST_MEMBERS} are read"
        raise SamplesError(file, what, "Leave out what is not a sample")
    if size > most:
        what = f"the archive unpacks to {size >> 20} MB; at most {most >> 20} MB are read from one of its size"
        raise SamplesError(file, what, "Save the samples alone, or as CSV")


def pieces(path: Path) -> Iterator[bytes]:
    """All that an archive holds, piece by piece; a member ends where it was declared to."""
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            with archive.open(member) as stream:
                while piece := stream.read(PIECE):
                    yield piece
