"""The file of a session: each touch is in it as soon as it is made, and a session that was cut off goes on from there.

Touches kept for checking stand in a file of their own beside it, so that `calibrate` never sees them.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from casacal.errors import CasacalError, SamplesError
from casacal.files import place_whole, recover, together, writable, write_text
from casacal.measuring.touch import Touch, rows_of
from casacal.planning.route import CHECK, PURPOSES
from casacal.samples.samples import JOINT_DECIMALS, Layout, Samples, samples_text
from casacal.values import Value

BESIDE = ("order", "touch", "purpose", "kept")
"""Columns beside those of samples: place in the session, number in the plan, purpose, whether it was kept."""

KEPT, NONE = "yes", "-"


@dataclass(frozen=True)
class TouchFile(Value):
    """Where touches are written: those to be fitted in `path`, those to check with beside it.

    mark: what the first line says of the session, such as its plan, by which it is known again.
    """

    path: Path
    layout: Layout
    mark: str

    @property
    def check_path(self) -> Path:
        """The file of touches kept for checking."""
        return self.path.with_name(f"{self.path.stem}_check{self.path.suffix}")

    @property
    def _paths(self) -> tuple[Path, Path]:
        return self.path, self.check_path

    def begun(self) -> bool:
        """Whether there is a file already."""
        recover(self.path.parent)
        return any(path.exists() for path in self._paths)

    def refuse_others(self) -> None:
        """Raise CasacalError for a path where no CSV can grow, before anybody makes a touch for it."""
        if self.path.suffix.lower() in (".xlsx", ".npy", ".npz"):
            raise CasacalError(f"'{self.path}' would not be a {self.path.suffix} file", "Name one that ends in .csv")
        for path in self._paths:
            there = path.exists()
            if there and not path.is_file():
                raise CasacalError(f"'{path}' is no file that can grow", "Name a file")
            _added(path, b"")
            if not there:
                path.unlink()

    def sizes(self) -> tuple[int, ...]:
        """Bytes of both files, by which it is seen whether somebody else writes there."""
        return tuple(path.stat().st_size if path.exists() else 0 for path in self._paths)

    def read(self) -> tuple[list[Touch], bool]:
        """Touches made so far, in their order, and whether a last line was cut off and is left out.

        Raises SamplesError for a file that is none of this session's.
        """
        found: list[tuple[int, Touch]] = []
        cut = False
        for path in self._paths:
            if path.exists():
                data = path.read_bytes()
                whole = data[: data.rfind(b"\n") + 1]
                if not f"# {self.mark}\n".encode().startswith(data):  # not even its first line is whole
                    self._check_mark(path, data.decode("utf-8", errors="replace").lstrip().partition("\n")[0].rstrip())
                if len(whole) < len(data):
                    cut = True
                    place_whole(path, partial(_filled, data=whole), own=True) if whole else path.unlink()
                found += self._touches(path)
        found.sort(key=lambda pair: pair[0])
        return [touch for _, touch in found], cut

    def append(self, touch: Touch, order: int) -> None:
        """Add one touch, so that it is on the disk when this returns."""
        path = self.check_path if touch.purpose == CHECK else self.path
        text = self._text([(order, touch)])
        if path.exists() and path.stat().st_size:
            text = text.split("\n", 2)[2]  # without the mark and the header
        _added(path, text.encode())

    def rewrite(self, touches: Sequence[Touch]) -> None:
        """Write all touches anew, both files or neither; a file without any is removed."""
        with together(self.path.parent, [path.name for path in self._paths], own=True) as place:
            for path in self._paths:
                check = path == self.check_path
                rows = [(k, touch) for k, touch in enumerate(touches, 1) if (touch.purpose == CHECK) == check]
                if rows:
                    write_text(place / path.name, self._text(rows))

    def _text(self, rows: Sequence[tuple[int, Touch]]) -> str:
        touches = [touch for _, touch in rows]
        cells = (
            [str(order) for order, _ in rows],
            [NONE if touch.number is None else str(touch.number) for touch in touches],
            [touch.purpose for touch in touches],
            [KEPT if touch.kept else NONE for touch in touches],
        )
        beside = dict(zip(BESIDE, cells, strict=True))
        return samples_text(self.layout, rows_of(touches), [self.mark], after=beside, least_decimals=JOINT_DECIMALS)

    def _check_mark(self, path: Path, first: str) -> None:
        """Raise SamplesError unless the first line of a file is that of this session: nothing is changed before."""
        if first == f"# {self.mark}":
            return
        if self.mark in first:
            fix = "Undo the change, or calibrate with its rows as they are and continue in another file"
            raise SamplesError(path.as_posix(), "another program has changed this file", fix)
        fix = "Name another --out, or continue with the plan that it was begun with"
        raise SamplesError(path.as_posix(), "this file exists already and belongs to another problem or plan", fix)

    def _touches(self, path: Path) -> list[tuple[int, Touch]]:
        if not path.exists():
            return []
        lines = [line for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
        if len(lines) < 3:
            return []
        samples, found = Samples.from_file(path, self.layout), []
        missing = (NONE,) * len(samples)
        beside = zip(*(map(str, samples.extra.get(name, missing)) for name in BESIDE), strict=True)
        for k, (order, number, purpose, kept) in enumerate(beside):
            if not _is_count(order) or not (number == NONE or _is_count(number)) or purpose not in PURPOSES:
                fix = "Restore them, or start a new file"
                raise SamplesError(path.as_posix(), "order, touch or purpose were changed", fix)
            of_plan = None if number == NONE else int(number)
            found.append((int(order), Touch.of(samples, k, of_plan, purpose, kept=kept == KEPT)))
        return found


def _is_count(text: str) -> bool:
    return text.isdecimal() and len(text) < 10


def _filled(place: Path, *, data: bytes) -> None:
    place.write_bytes(data)


def _added(path: Path, data: bytes) -> None:
    """Put bytes at the end of a file, on the disk when this returns; raises CasacalError where that cannot be."""
    with writable(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        out = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        try:
            while data:
                data = data[os.write(out, data) :]
            os.fsync(out)
        finally:
            os.close(out)
