"""The file of a session: each touch is in it as soon as it is made, and a session that was cut off goes on from there.

Touches kept for checking stand in a file of their own beside it, so that `calibrate` never sees them.
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from casacal.errors import CasacalError, SamplesError
from casacal.files import write_text
from casacal.measuring.touch import Touch
from casacal.planning.route import AGAIN, CHECK, FIT
from casacal.samples.layout import Layout
from casacal.samples.samples import JOINT_DECIMALS, WRITTEN, Samples
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

    def begun(self) -> bool:
        """Whether there is a file already."""
        return self.path.exists() or self.check_path.exists()

    def refuse_others(self) -> None:
        """Raise CasacalError for a path where no CSV can grow."""
        if self.path.suffix.lower() in (".xlsx", ".npy", ".npz"):
            raise CasacalError(f"'{self.path}' would not be a {self.path.suffix} file", "Name one that ends in .csv")
        for path in (self.path, self.check_path):
            if path.exists() and not path.is_file():
                raise CasacalError(f"'{path}' is no file that can grow", "Name a file")
            self._try(path)

    @staticmethod
    def _try(path: Path) -> None:
        """Raise CasacalError where a file cannot be made, before anybody makes a touch for it."""
        there = path.exists()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            os.close(os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666))
            if not there:
                path.unlink()
        except OSError as error:
            raise CasacalError(f"'{path}' cannot be written ({error.strerror})", "Choose another place") from error

    def sizes(self) -> tuple[int, int]:
        """Bytes of both files, by which it is seen whether somebody else writes there."""
        one, two = (path.stat().st_size if path.exists() else 0 for path in (self.path, self.check_path))
        return one, two

    def read(self) -> tuple[list[Touch], bool]:
        """Touches made so far, in their order, and whether a last line was cut off and is left out.

        Raises SamplesError for a file that is none of this session's.
        """
        found: list[tuple[int, Touch]] = []
        cut = False
        for path in (self.path, self.check_path):
            if path.exists():
                torn = self._mend(path)
                cut, found = cut or torn, found + self._touches(path)
        found.sort(key=lambda pair: pair[0])
        return [touch for _, touch in found], cut

    def append(self, touch: Touch, order: int) -> None:
        """Add one touch, so that it is on the disk when this returns."""
        path = self.check_path if touch.purpose == CHECK else self.path
        text = _line(self._cells(touch, order))
        if not path.exists() or not path.stat().st_size:
            text = self._head() + text
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            out = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
            try:
                _write_all(out, text.encode())
                os.fsync(out)
            finally:
                os.close(out)
        except OSError as error:
            raise CasacalError(f"'{path}' cannot be written ({error.strerror})", "Choose another place") from error

    def rewrite(self, touches: Sequence[Touch]) -> None:
        """Write all touches anew, each file whole or not at all; a file without any is removed."""
        for path, check in ((self.path, False), (self.check_path, True)):
            rows = [(k, touch) for k, touch in enumerate(touches, 1) if (touch.purpose == CHECK) == check]
            if rows:
                write_text(path, self._head() + "".join(_line(self._cells(touch, k)) for k, touch in rows))
            else:
                path.unlink(missing_ok=True)

    def _head(self) -> str:
        joints = [f"q{i}{WRITTEN[kind][0]}" for i, kind in enumerate(self.layout.joints, 1)]
        columns = [name + WRITTEN[kind][0] for name, kind in self.layout.columns.items()]
        return f"# {self.mark}\n" + _line([*joints, *columns, *self.layout.labels, *BESIDE])

    def _cells(self, touch: Touch, order: int) -> list[str]:
        cells = [_number(value, kind) for value, kind in zip(touch.joints, self.layout.joints, strict=True)]
        cells += [_number(touch.columns[name], kind) for name, kind in self.layout.columns.items()]
        cells += [touch.labels[name] for name in self.layout.labels]
        number = NONE if touch.number is None else str(touch.number)
        return [*cells, str(order), number, touch.purpose, KEPT if touch.kept else NONE]

    def _mend(self, path: Path) -> bool:
        """Cut off a last line that is not whole; whether there was one."""
        data = path.read_bytes()
        whole = data[: data.rfind(b"\n") + 1]
        if len(whole) == len(data):
            return False
        write_text(path, whole.decode(errors="replace")) if whole else path.unlink()
        return True

    def _touches(self, path: Path) -> list[tuple[int, Touch]]:
        if not path.exists():
            return []
        lines = [line for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
        if not lines:
            return []
        if lines[0] != f"# {self.mark}" and self.mark in lines[0]:
            raise SamplesError(
                path.as_posix(),
                "another program has changed this file",
                "Undo the change, or calibrate with its rows as they are and continue in another file",
            )
        if lines[0] != f"# {self.mark}":
            raise SamplesError(
                path.as_posix(),
                "this file exists already and belongs to another problem or plan",
                "Name another --out, or continue with the plan that it was begun with",
            )
        if len(lines) < 3:
            return []
        samples = Samples.from_file(path, self.layout)
        found = []
        for k in range(len(samples)):
            order, number, purpose, kept = (samples.extra.get(name, (NONE,) * len(samples))[k] for name in BESIDE)
            if (
                not order.isdecimal()
                or not (number == NONE or number.isdecimal())
                or purpose not in (FIT, AGAIN, CHECK)
            ):
                raise SamplesError(
                    path.as_posix(), "order, touch or purpose were changed", "Restore them, or start a new file"
                )
            touch = Touch(
                samples.joints[k],
                {name: float(values[k]) for name, values in samples.columns.items()},
                {name: labels[k] for name, labels in samples.labels.items()},
                None if number == NONE else int(number),
                purpose,
                kept == KEPT,
            )
            found.append((int(order), touch))
        return found


def _number(value: float, kind: str) -> str:
    _, factor, decimals = WRITTEN[kind]
    return f"{value * factor:.{max(decimals, JOINT_DECIMALS)}f}"


def _line(cells: Sequence[str]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(cells)
    return text.getvalue()


def _write_all(out: int, data: bytes) -> None:
    while data:
        data = data[os.write(out, data) :]
