"""One measurement as somebody made it, rows of several, what may have been mistyped in one, and the file they go into.

Each touch is in the file as soon as it is made, and a session that was cut off goes on from there. Touches kept for
checking stand in a file of their own beside it, so that `calibrate` never sees them.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from casacal.data.samples import JOINT_DECIMALS, LARGEST, WRITTEN, Layout, Samples, samples_text
from casacal.errors import CasacalError, SamplesError, came, refuse_unknown
from casacal.files import place_whole, recover, together, writable, write_text
from casacal.model.instrument import OVERTRAVEL, readings_within
from casacal.model.problem import Problem
from casacal.planning.route import CHECK, FIT, PURPOSES
from casacal.values import Array, FrozenMapping, Value, is_finite, read_only

SHOWN = 3  # decimals of a reading in mm as people type it, and of a joint value in degrees or mm
SESSION_COLUMNS = ("order", "touch", "purpose", "kept")
"""Columns that a session adds to those of samples: order, number in the plan, purpose, how a doubt was answered."""
KEPT, CORRECTED, NONE = "yes", "corrected", "-"
LEFT_OUT = "left out: touch "  # begins the comment that names touches of the plan that nobody makes


@dataclass(frozen=True, eq=False)
class Touch(Value):
    """One measurement: joints (n,; rad, mm), what was read by column, labels by column.

    number: of the plan's touch that it answers, or None. purpose: "fit", "again" or "check", as in a plan.
    kept: whether somebody looked at it again and said that it is right. corrected: whether a suggestion changed it.
    """

    joints: Array
    columns: Mapping[str, float]
    labels: Mapping[str, str]
    number: int | None = None
    purpose: str = FIT
    kept: bool = False
    corrected: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", read_only(np.array(self.joints, dtype=np.float64)))
        object.__setattr__(self, "columns", FrozenMapping({k: float(v) for k, v in self.columns.items()}))
        object.__setattr__(self, "labels", FrozenMapping(self.labels))

    @staticmethod
    def of(samples: Samples, k: int, number: int | None = None, purpose: str = FIT, answer: str = NONE) -> Touch:
        """A row of samples; `answer` as a file of touches has it in its column `kept`."""
        columns = {name: float(values[k]) for name, values in samples.columns.items()}
        labels = {name: labels[k] for name, labels in samples.labels.items()}
        return Touch(samples.joints[k], columns, labels, number, purpose, answer == KEPT, answer == CORRECTED)


def rows_of(touches: Sequence[Touch]) -> Samples:
    """The touches as rows, in their order; one or more."""
    first = touches[0]
    return Samples(
        np.array([touch.joints for touch in touches]),
        {name: np.array([touch.columns[name] for touch in touches]) for name in first.columns},
        {name: [touch.labels[name] for touch in touches] for name in first.labels},  # type: ignore[misc]
        tuple(range(1, len(touches) + 1)),
        {},
        "the session",
        "",
    )


def joints_of(q: Sequence[float] | Array, layout: Layout) -> Array:
    """Joint values (n,), rad and mm; raises CasacalError for others."""
    try:
        values = np.asarray(q, dtype=np.float64)
    except (TypeError, ValueError):
        raise CasacalError(f"Got {came(q)} as joint values", f"Give {len(layout.joints)} numbers") from None
    if values.shape != (len(layout.joints),) or not np.isfinite(values).all():
        fix = f"Give {len(layout.joints)} numbers, rad and mm"
        raise CasacalError(f"Joint values have the shape {values.shape}, or some are not finite", fix)
    for i, (value, kind) in enumerate(zip(values, layout.joints, strict=True), 1):
        if abs(value) > LARGEST[kind]:
            raise CasacalError(f"Joint {i} is {value:g}, which no robot can take", "Give rad, and mm where it slides")
    return values


def columns_of(reading: float | Mapping[str, float] | None, layout: Layout) -> dict[str, float]:
    """Readings of the instrument by column; raises CasacalError where they do not fit."""
    names = list(layout.columns)
    wanted = ", ".join(names) or "no reading at all"
    if reading is not None and not isinstance(reading, Mapping):
        if len(names) != 1:
            raise CasacalError(f"Got one reading, but a touch has {wanted}", "Give them by name")
        reading = {names[0]: reading}
    values = reading or {}
    refuse_unknown("column of a touch", values, names)
    for name in names:
        if not is_finite(value := values.get(name)):
            raise CasacalError(f"Got {came(value)} as the {name}", f"Give a number; a touch has {wanted}")
    return {name: float(values[name]) for name in names}


def labels_of(plane: str | Mapping[str, str] | None, layout: Layout, planned: Touch | None) -> dict[str, str]:
    """Labels by column, where none is given those of the plan; raises CasacalError where they do not fit."""
    columns = list(layout.labels)
    if isinstance(plane, str):
        if len(columns) != 1:
            raise CasacalError(f"Got the label '{plane}', but a touch has {', '.join(columns) or 'none'}", "Give it so")
        plane = {columns[0]: plane.strip()}
    labels = {} if plane is None else plane
    refuse_unknown("label of a touch", labels, columns)
    found = {name: labels.get(name, "" if planned is None else planned.labels[name]) for name in columns}
    for name, label in found.items():
        if not isinstance(label, str) or not label:
            raise CasacalError(f"The touch has no {name}", "Name it")
    return found


def beyond_travel(problem: Problem, columns: Mapping[str, float]) -> str | None:
    """Words for a reading that the dial cannot show, which calibrate would not take; None where it can."""
    probe = problem.instrument.probe
    if probe is None or probe.column is None:
        return None
    reading, (low, high) = columns[probe.column], readings_within(probe.travel)
    if max(low - reading, reading - high) <= OVERTRAVEL * (high - low):
        return None
    return f"{reading:g} mm is outside the dial's range of {low:g} to {high:g} mm"


@dataclass(frozen=True, eq=False)
class Slip(Value):
    """A typing mistake: its kind, words, the touch without it, and the logarithm of its prior weight."""

    kind: str
    words: str
    touch: Touch
    weight: float


def slips_of(problem: Problem, touch: Touch, planned: Touch | None, labels: Mapping[str, Sequence[str]]) -> list[Slip]:
    """Typing mistakes that may be in a touch, by what was planned there, if anything, and by the labels there are."""
    found = []
    for column, names in labels.items():
        for name in names:
            if name != touch.labels[column]:
                words = f"the {column} was '{name}', not '{touch.labels[column]}'"
                found.append(Slip("label", words, replace(touch, labels={**touch.labels, column: name}), -1.0))
    found += [*_of_readings(problem, touch), *_of_joints(problem, touch, planned)]
    possible = (slip for slip in found if np.isfinite(slip.touch.joints).all())
    return [slip for slip in possible if beyond_travel(problem, slip.touch.columns) is None]


def _of_readings(problem: Problem, touch: Touch) -> Iterator[Slip]:
    probe = problem.instrument.probe

    def slip(kind: str, words: str, said: float, weight: float) -> Slip:
        return Slip(kind, words, replace(touch, columns={**touch.columns, name: said}), weight)

    for name, dimension in problem.layout().columns.items():
        value = touch.columns[name]
        unit, factor = WRITTEN[dimension][0].replace("_", " ").strip(), WRITTEN[dimension][1]
        yield slip("sign", f"the sign of the {name}", -value, -1.0)
        if probe is not None and name == probe.column and probe.turn:
            for turns, many in ((1, "a turn"), (-1, "a turn"), (2, "2 turns"), (-2, "2 turns")):
                said, way = value + turns * probe.turn, "forgotten" if turns > 0 else "too many"
                yield slip("revolution", f"{many} of the pointer {way}: {said:.{SHOWN}f} {unit}", said, -abs(turns))
        if dimension == "length":
            yield slip("unit", f"the {name} in inches, not mm", value * 25.4, -4.0)
            yield slip("unit", f"the {name} in mm, not inches", value / 25.4, -4.0)
        for typed, weight in _mistyped(value * factor):
            yield slip("digit", f"a digit of the {name}: {typed:.{SHOWN}f} {unit}".rstrip(), typed / factor, weight)


def _of_joints(problem: Problem, touch: Touch, planned: Touch | None) -> Iterator[Slip]:
    turns, joints = problem.robot.revolute, touch.joints
    factor = np.where(turns, 180 / math.pi, 1.0)
    unit = np.where(turns, "degrees", "mm")

    def slip(kind: str, words: str, changed: Mapping[int, float], weight: float) -> Slip:
        other = joints.copy()
        other[list(changed)] = list(changed.values())
        return Slip(kind, words, replace(touch, joints=other), weight)

    if turns.sum() > 1 and np.abs(np.degrees(joints[turns])).max() < 2 * math.pi:
        in_rad = {i: math.degrees(joints[i]) for i in np.flatnonzero(turns).tolist()}
        yield slip("radians", "joint values in radians, not degrees", in_rad, -3.0)
    elsewhere = [] if planned is None else np.flatnonzero(np.abs(planned.joints - joints) > 1e-9).tolist()
    beside = len(elsewhere) > len(joints) / 2  # jogged there, or sent there by the session
    if planned is not None and beside:
        drawn = {i: float(planned.joints[i]) for i in elsewhere}
        yield slip("joint", "the arm stood at the joint values of the plan", drawn, -6.0)
    for i, value in enumerate(joints.tolist()):
        if planned is not None and i in elsewhere and not beside:
            words = f"joint {i + 1} as planned: {planned.joints[i] * factor[i]:.{SHOWN}f} {unit[i]}"
            yield slip("joint", words, {i: float(planned.joints[i])}, -1.0)
        yield slip("joint sign", f"the sign of joint {i + 1}", {i: -value}, -3.0)
        for said, weight in _mistyped(value * float(factor[i])):
            words = f"a digit of joint {i + 1}: {said:.{SHOWN}f} {unit[i]}"
            yield slip("joint", words, {i: said / float(factor[i])}, weight - 2.0)
        for k in np.flatnonzero(turns[:i] == turns[i]).tolist():
            words = f"joints {k + 1} and {i + 1} in each other's place"
            yield slip("joints swapped", words, {i: float(joints[k]), k: value}, -4.0)


def _mistyped(value: float) -> list[tuple[float, float]]:
    """Numbers that were meant where this one was typed: one digit wrong, two exchanged, the point misplaced."""
    text = f"{abs(value):.{SHOWN}f}"
    places = [k for k, letter in enumerate(text) if letter.isdigit()]
    wrong = {f"{text[:k]}{digit}{text[k + 1 :]}": -math.log(9 * len(places)) for k in places for digit in "0123456789"}
    for k, after in pairwise(places):
        letters = list(text)
        letters[k], letters[after] = letters[after], letters[k]
        wrong["".join(letters)] = -math.log(len(places)) - 0.5
    found = [(float(other), weight) for other, weight in wrong.items() if other != text]
    found += [(abs(value) * times, -2.0) for times in (10.0, 0.1) if value]
    return [(math.copysign(other, value), weight) for other, weight in found]


@dataclass(frozen=True)
class TouchFile(Value):
    """A file of touches to fit and, next to it, one to verify with; `mark`: the first line, which names the session."""

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

    def stamps(self) -> tuple[tuple[int, ...], ...]:
        """What is seen of both files from outside, by which it is noticed whether somebody else writes there."""
        return tuple(stamp(path) for path in self._paths)

    def read(self) -> tuple[list[Touch], frozenset[int], bool]:
        """Touches so far, in order, those of the plan that are left out, and whether a last line was cut off.

        Raises SamplesError for files of another session.
        """
        recover(self.path.parent)
        found: list[tuple[int, Touch]] = []
        skipped, cut = set[int](), False
        for path in (path for path in self._paths if path.exists()):
            data = path.read_bytes()
            whole = data[: data.rfind(b"\n") + 1]
            if not f"# {self.mark}\n".encode().startswith(data):  # not even its first line is whole
                self._check_mark(path, data.decode("utf-8", errors="replace").lstrip().partition("\n")[0].rstrip())
            if len(whole) < len(data):
                cut = True
                place_whole(path, partial(Path.write_bytes, data=whole), own=True) if whole else path.unlink()
            lines = [line.strip() for line in whole.decode("utf-8", errors="replace").splitlines()]
            for line in lines:
                if line.startswith(f"# {LEFT_OUT}"):
                    skipped |= {int(number) for number in re.findall(r"\b\d{1,9}\b", line)}
            if sum(bool(line) and not line.startswith("#") for line in lines) < 2:  # the header alone
                continue
            samples = Samples.from_file(path, self.layout)
            missing = (NONE,) * len(samples)
            entries = zip(*(map(str, samples.extra.get(name, missing)) for name in SESSION_COLUMNS), strict=True)
            for k, (order, number, purpose, answer) in enumerate(entries):
                counts = [order] if number == NONE else [order, number]
                if not all(each.isdecimal() and len(each) < 10 for each in counts) or purpose not in PURPOSES:
                    fix = "Restore them, or start a new file"
                    raise SamplesError(path.as_posix(), "order, touch or purpose were changed", fix)
                of_plan = None if number == NONE else int(number)
                found.append((int(order), Touch.of(samples, k, of_plan, purpose, answer)))
        found.sort(key=lambda pair: pair[0])
        return [touch for _, touch in found], frozenset(skipped), cut

    def append(self, touch: Touch, order: int, skipped: Collection[int] = ()) -> None:
        """Add one touch, so that it is on the disk when this returns; a new file begins with what is left out."""
        path = self.check_path if touch.purpose == CHECK else self.path
        if path.exists() and path.stat().st_size:
            text = self._text([(order, touch)], ()).split("\n", 2)[2]  # without the mark and the header
        else:
            text = self._text([(order, touch)], skipped)
        _added(path, text.encode())

    def rewrite(self, touches: Sequence[Touch], skipped: Collection[int] = ()) -> None:
        """Write all touches anew, and those of the plan that are left out; both files or neither, none without any."""
        with together(self.path.parent, [path.name for path in self._paths], own=True) as place:
            for path in self._paths:
                check = path == self.check_path
                rows = [(k, touch) for k, touch in enumerate(touches, 1) if (touch.purpose == CHECK) == check]
                if rows:
                    write_text(place / path.name, self._text(rows, skipped))

    def _text(self, rows: Sequence[tuple[int, Touch]], skipped: Collection[int]) -> str:
        touches = [touch for _, touch in rows]
        extra = {
            "order": [str(order) for order, _ in rows],
            "touch": [NONE if touch.number is None else str(touch.number) for touch in touches],
            "purpose": [touch.purpose for touch in touches],
            "kept": [KEPT if touch.kept else CORRECTED if touch.corrected else NONE for touch in touches],
        }
        comments = [self.mark, *([f"{LEFT_OUT}{', '.join(map(str, sorted(skipped)))}"] if skipped else [])]
        return samples_text(self.layout, rows_of(touches), comments, after=extra, least_decimals=JOINT_DECIMALS)

    def _check_mark(self, path: Path, first: str) -> None:
        """Raise SamplesError unless the first line of a file is that of this session: nothing is changed before."""
        if first == f"# {self.mark}":
            return
        what = "this file exists already and belongs to another problem or plan"
        fix = "Name another --out, or continue with the plan that it was begun with"
        if self.mark in first:
            what = "another program has changed this file"
            fix = "Undo the change, or calibrate with its rows as they are and continue in another file"
        raise SamplesError(path.as_posix(), what, fix)


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


def stamp(path: Path) -> tuple[int, ...]:
    """Size and time of the last change, by which changes of others are seen; empty where there is nothing."""
    try:
        found = path.stat()
    except OSError:
        return ()
    return found.st_mode, found.st_size, found.st_mtime_ns
