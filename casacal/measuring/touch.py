"""One measurement as somebody made it, rows of several, and what may have been mistyped in one."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from casacal.array_types import Array
from casacal.errors import CasacalError, came, refuse_unknown
from casacal.instruments.description import OVERTRAVEL, readings_within
from casacal.planning.route import FIT
from casacal.problem.problem import Problem
from casacal.samples.samples import LARGEST, WRITTEN, Layout, Samples
from casacal.values import FrozenMapping, Value, is_finite, read_only


@dataclass(frozen=True, eq=False)
class Touch(Value):
    """One measurement: joints (n,; rad, mm), what was read by column, labels by column.

    number: of the plan's touch that it answers, or None. purpose: "fit", "again" or "check", as in a plan.
    kept: whether somebody looked at it again and said that it is right.
    """

    joints: Array
    columns: Mapping[str, float]
    labels: Mapping[str, str]
    number: int | None = None
    purpose: str = FIT
    kept: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", read_only(np.array(self.joints, dtype=np.float64)))
        object.__setattr__(self, "columns", FrozenMapping({k: float(v) for k, v in self.columns.items()}))
        object.__setattr__(self, "labels", FrozenMapping(self.labels))

    @staticmethod
    def of(samples: Samples, k: int, number: int | None = None, purpose: str = FIT, *, kept: bool = False) -> Touch:
        """A row of samples."""
        columns = {name: float(values[k]) for name, values in samples.columns.items()}
        labels = {name: labels[k] for name, labels in samples.labels.items()}
        return Touch(samples.joints[k], columns, labels, number, purpose, kept)


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
    """What the instrument read by column; raises CasacalError where it does not fit."""
    asked = list(layout.columns)
    wanted = ", ".join(asked) or "no reading at all"
    if reading is None or isinstance(reading, Mapping):
        given: Mapping[str, float] = reading or {}
    elif len(asked) != 1:
        raise CasacalError(f"Got one reading, but a touch has {wanted}", "Give them by name")
    else:
        given = {asked[0]: reading}
    refuse_unknown("column of a touch", given, asked)
    for name in asked:
        value = given.get(name)
        if not is_finite(value):
            raise CasacalError(f"Got {came(value)} as the {name}", f"Give a number; a touch has {wanted}")
    return {name: float(given[name]) for name in asked}


def labels_of(plane: str | Mapping[str, str] | None, layout: Layout, planned: Touch | None) -> dict[str, str]:
    """Labels by column, where none is given those of the plan; raises CasacalError where they do not fit."""
    asked = list(layout.labels)
    if isinstance(plane, str):
        if len(asked) != 1:
            raise CasacalError(f"Got the label '{plane}', but a touch has {', '.join(asked) or 'none'}", "Give it so")
        given: Mapping[str, str] = {asked[0]: plane.strip()}
    else:
        given = {} if plane is None else plane
    refuse_unknown("label of a touch", given, asked)
    found = {name: given.get(name, "" if planned is None else planned.labels[name]) for name in asked}
    for name, label in found.items():
        if not isinstance(label, str) or not label:
            raise CasacalError(f"The touch has no {name}", "Name it")
    return found


def _shown(problem: Problem, columns: Mapping[str, float]) -> bool:
    """Whether an instrument can show these readings at all."""
    try:
        refuse_beyond_travel(problem, columns)
    except CasacalError:
        return False
    return True


def refuse_beyond_travel(problem: Problem, columns: Mapping[str, float]) -> None:
    """Raise CasacalError for a reading that the dial cannot show; calibrate would not take it."""
    probe = problem.instrument.probe
    if probe is None or probe.column is None:
        return
    reading, (low, high) = columns[probe.column], readings_within(probe.travel)
    if max(low - reading, reading - high) > OVERTRAVEL * (high - low):
        fix = "Check sign, point and unit; if the dial does show this, declare its travel in the problem file"
        raise CasacalError(f"{reading:g} mm is outside the dial's range of {low:g} to {high:g} mm", fix)


SHOWN = 3  # decimals of a reading in mm as people type it, and of a joint value in degrees or mm
MOST_TURNS = 2  # turns of a pointer that may be forgotten


@dataclass(frozen=True, eq=False)
class Slip(Value):
    """A mistake: its kind, words, what the touch was without it, and how likely it is beside others (a logarithm)."""

    kind: str
    words: str
    touch: Touch
    weight: float


def slips_of(problem: Problem, touch: Touch, planned: Touch | None, labels: Mapping[str, Sequence[str]]) -> list[Slip]:
    """What may have been typed wrong in a touch.

    planned: what was to be done there, or None. labels: by column, what there is to choose from.
    """
    found = [*_of_labels(touch, labels), *_of_readings(problem, touch), *_of_joints(problem, touch, planned)]
    return [slip for slip in found if np.isfinite(slip.touch.joints).all() and _shown(problem, slip.touch.columns)]


def _of_labels(touch: Touch, labels: Mapping[str, Sequence[str]]) -> Iterator[Slip]:
    for column, names in labels.items():
        for name in names:
            if name != touch.labels[column]:
                words = f"the {column} was '{name}', not '{touch.labels[column]}'"
                yield Slip("label", words, replace(touch, labels={**touch.labels, column: name}), -1.0)


def _of_readings(problem: Problem, touch: Touch) -> Iterator[Slip]:
    probe = problem.instrument.probe
    for name, dimension in problem.layout().columns.items():
        value = touch.columns[name]

        def slip(kind: str, words: str, said: float, weight: float, name: str = name) -> Slip:
            return Slip(kind, words, replace(touch, columns={**touch.columns, name: said}), weight)

        unit, factor = WRITTEN[dimension][0].replace("_", " ").strip(), WRITTEN[dimension][1]
        yield slip("sign", f"the sign of the {name}", -value, -1.0)
        if probe is not None and name == probe.column and probe.turn:
            for turns in (1, -1, 2, -2)[: 2 * MOST_TURNS]:
                said = value + turns * probe.turn
                many = "a turn" if abs(turns) == 1 else f"{abs(turns)} turns"
                way = "forgotten" if turns > 0 else "too many"
                yield slip("revolution", f"{many} of the pointer {way}: {said:.{SHOWN}f} {unit}", said, -abs(turns))
        if dimension == "length":
            for inch, words in ((25.4, "inches, not mm"), (1 / 25.4, "mm, not inches")):
                yield slip("unit", f"the {name} in {words}", value * inch, -4.0)
        for typed, weight in _mistyped(value * factor):
            yield slip("digit", f"a digit of the {name}: {typed:.{SHOWN}f} {unit}".rstrip(), typed / factor, weight)


def _of_joints(problem: Problem, touch: Touch, planned: Touch | None) -> Iterator[Slip]:
    turns, joints = problem.robot.revolute, touch.joints
    factor = np.where(turns, 180 / math.pi, 1.0)
    unit = np.where(turns, "degrees", "mm")

    def slip(kind: str, words: str, changed: Mapping[int, float], weight: float) -> Slip:
        other = joints.copy()
        for i, value in changed.items():
            other[i] = value
        return Slip(kind, words, replace(touch, joints=other), weight)

    if turns.sum() > 1 and np.abs(np.degrees(joints[turns])).max() < 2 * math.pi:
        in_rad = {int(i): math.degrees(joints[i]) for i in np.flatnonzero(turns)}
        yield slip("radians", "joint values in radians, not degrees", in_rad, -3.0)
    for i, value in enumerate(joints):
        if planned is not None and abs(planned.joints[i] - value) > 1e-9:
            as_planned = float(planned.joints[i])
            words = f"joint {i + 1} as planned: {as_planned * factor[i]:.{SHOWN}f} {unit[i]}"
            yield slip("joint", words, {i: as_planned}, -1.0)
        yield slip("joint sign", f"the sign of joint {i + 1}", {i: -float(value)}, -3.0)
        for said, weight in _mistyped(float(value * factor[i])):
            words = f"a digit of joint {i + 1}: {said:.{SHOWN}f} {unit[i]}"
            yield slip("joint", words, {i: said / float(factor[i])}, weight - 2.0)
        for k in range(i):
            if turns[i] == turns[k]:
                words = f"joints {k + 1} and {i + 1} in each other's place"
                yield slip("joints swapped", words, {i: float(joints[k]), k: float(value)}, -4.0)


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
