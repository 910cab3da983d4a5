"""The Python of a new problem file: numbers, tables, names, and what is to be filled in."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from casacal.errors import CasacalError
from casacal.model.capsules import Solid
from casacal.model.dh_table import degrees, plain
from casacal.model.instrument import Travel, readings_within
from casacal.model.joints import Conventions, Joint
from casacal.model.problem_file import FILL_IN
from casacal.model.unknown import tangent_basis

LEAST_NOISE = 1e-4  # mm; gauges that one reads by hand repeat no better
FINEST = 0.01  # mm; an accuracy below it was given in metres


@dataclass(frozen=True)
class Plate:
    """A flat face of a new cell: its label, centre (3, mm, base frame), normal towards the tool, and side (mm)."""

    label: str
    centre: tuple[float, float, float]
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    side: float = 300.0


BLOCK, BLOCK_SIDE = "block", 35.0  # label of a gauge block's top, and its side, mm
HIGHEST_BLOCK = 1000.0  # mm
FARTHEST = 1e5  # mm; no arm reaches a plate beyond it
FACING = 0.5  # cosine from which a plate is said to face something
ALIKE = math.cos(math.radians(1.0))  # cosine between normals that are one
LEAST_ROOM = 50.0  # mm that the shortest dial takes before a plate
NEAREST = 10.0  # mm; a plate nearer to the base's origin was given in metres


@dataclass(frozen=True, kw_only=True)
class Answers:
    """A user's answers about a new cell; None or empty for what was not said.

    tool: the tip at reading zero in the flange frame, mm. sign: +1 where a larger reading lengthens the tool, -1 where
    it shortens it. noise: standard deviation of a reading, mm. accuracy: absolute accuracy of the arm as its maker
    states it, mm. plates: the faces to touch, and whether they were only proposed. block: height of a gauge block on
    the first of them, mm. table: height of the table on which all stands, mm in the base frame, -inf for none.
    keep_out: ranges of x, y, z that the arm must not enter.

    Raises CasacalError for what cannot be.
    """

    tool: tuple[float, float, float] | None = None
    sign: int | None = None
    travel: Travel | None = None
    noise: float = 0.01
    accuracy: float | None = None
    plates: tuple[Plate, ...] = ()
    proposed: bool = False
    block: float | None = None
    table: float | None = None
    keep_out: tuple[tuple[tuple[float, float], tuple[float, float], tuple[float, float]], ...] = ()

    def __post_init__(self) -> None:
        if self.tool is not None and (len(self.tool) != 3 or not all(abs(each) <= FARTHEST for each in self.tool)):
            raise CasacalError(f"The tool is {self.tool!r}", "Give three numbers of mm, such as 0,0,120")
        if self.sign not in (None, 1, -1):
            raise CasacalError(f"The dial's sign is {self.sign!r}", "Give 1 or -1")
        low, high = readings_within(10.0 if self.travel is None else self.travel)
        if not -FARTHEST < low < high < FARTHEST or plain(low) == plain(high):
            raise CasacalError(f"The dial's travel is {self.travel!r}", "Give its range in mm, such as 10 or -5:5")
        if not LEAST_NOISE <= self.noise <= 1.0:
            what = f"The noise of a reading is {self.noise:g} mm"
            raise CasacalError(what, f"Give the standard deviation of one reading, {LEAST_NOISE:g} to 1 mm")
        if self.accuracy is not None and not FINEST <= self.accuracy < math.inf:
            raise CasacalError(f"The maker's accuracy is {self.accuracy:g} mm", f"Give mm, {FINEST} or more")
        if self.block is not None and not 1.0 <= self.block <= HIGHEST_BLOCK:
            raise CasacalError(f"The gauge block is {self.block:g} mm high", f"Give 1 to {HIGHEST_BLOCK:g} mm")
        if self.table is not None and not (abs(self.table) <= FARTHEST or self.table == -math.inf):
            fix = "Give its height in the base frame, mm, or -inf for none"
            raise CasacalError(f"The table is at {self.table:g} mm", fix)
        for box in self.keep_out:
            solid = Solid.box("box", box)
            if (solid.low < 0).all() and (solid.high > 0).all():
                what = f"The box to keep out of is {box!r}, and the arm stands in it"
                raise CasacalError(what, "Give ranges of x, y and z in the base frame, beside its origin")
        labels = [plate.label for plate in self.plates] + ([] if self.block is None else [BLOCK])
        if len(set(labels)) < len(labels):
            raise CasacalError(f"Two faces share a name ({', '.join(labels)})", "Name each differently")
        for k, plate in enumerate(self.plates):
            self._check(plate)
            if there := next((other.label for other in self.plates[:k] if _overlap(plate, other)), ""):
                what = f"Plates '{there}' and '{plate.label}' are in one place: in one plane, one over the other"
                raise CasacalError(what, "Give each plate once, or the second one a place of its own")

    def _check(self, plate: Plate) -> None:
        """Raise CasacalError for a plate that cannot be: no normal, in metres, below the table or facing it."""
        numbers = (*plate.centre, *plate.normal, plate.side)
        length = math.hypot(*plate.normal)
        if not plate.label.isprintable():
            raise CasacalError(f"A plate is named {plate.label!r}", "Use letters that can be printed on one line")
        if not all(abs(number) <= FARTHEST for number in numbers) or not length or plate.side <= 0:
            raise CasacalError(f"Plate '{plate.label}' is {numbers}", "Give a place, a normal that is not zero, a side")
        if math.hypot(*plate.centre) < NEAREST:
            what = f"Plate '{plate.label}' is {math.hypot(*plate.centre):.3g} mm from the base's origin"
            raise CasacalError(what, "Give mm in the base frame: 0.6 m are 600")
        if plate.side < NEAREST:
            raise CasacalError(f"Plate '{plate.label}' is {plate.side:g} mm wide", "Give its side in mm: 0.3 m are 300")
        table, unit = self.table or 0.0, np.array(plate.normal) / length
        above, *beside = np.abs([unit, *tangent_basis(unit).T] @ np.array(plate.centre))
        if above < LEAST_ROOM and max(beside) < plate.side / 2:
            fix = "Give its middle in mm in the base frame, beside the base, or a smaller side"
            raise CasacalError(f"Plate '{plate.label}' covers the origin of the base, where the arm stands", fix)
        low, high = np.array(self.keep_out).reshape(-1, 3, 2).transpose(2, 0, 1)
        if ((low < plate.centre) & (plate.centre < high)).all(axis=1).any():
            what = f"The middle of plate '{plate.label}' is in a box that the arm keeps out of (--keep-out)"
            raise CasacalError(what, "Make the box smaller, or put the plate elsewhere")
        lowest = plate.centre[2] - float(np.abs(tangent_basis(unit)[2]).sum()) * plate.side / 2
        if lowest < table - 1e-6:
            what = f"Plate '{plate.label}' reaches down to z = {lowest:.0f} mm, and the table is at {table:g} mm"
            raise CasacalError(what, "Say where the table is: --table Z")
        room = (plate.centre[2] - table) / -unit[2] if unit[2] < -FACING else math.inf
        if room < max(math.hypot(*(self.tool or (0.0, 0.0, 0.0))), LEAST_ROOM):
            what = f"Plate '{plate.label}' faces the table, {room:.0f} mm before it, where no tool has room"
            raise CasacalError(what, f"Its normal points to where the tool comes from: {_turned(plate)}")

    @property
    def remarks(self) -> list[str]:
        """What may be a mistake about plates: those that stand upright and turn their back on the arm."""
        return [
            f"plate '{each.label}' faces away from the arm's base. Its normal points to where the tool comes from; "
            f"where that is the arm's side, write {_turned(each)}"
            for each in self.plates
            if np.dot(each.centre[:2], each.normal[:2])
            > FACING * math.hypot(*each.centre[:2]) * math.hypot(*each.normal)
        ]

    @property
    def faces(self) -> tuple[Plate, ...]:
        """The plates, and the top of the gauge block in the middle of the first."""
        if self.block is None or not self.plates:
            return self.plates
        first = self.plates[0]
        length = math.hypot(*first.normal)
        top = [at + self.block * along / length for at, along in zip(first.centre, first.normal, strict=True)]
        return (*self.plates, Plate(BLOCK, (top[0], top[1], top[2]), first.normal, BLOCK_SIDE))

    @property
    def names(self) -> list[str]:
        """Names that problem.py imports for it."""
        scaled = [] if self.accuracy is None else ["scaled_to_accuracy"]
        cell = ["Cell", "Face"] if self.plates else []
        return ["DialOnPlane", "dial_gain", "tool_point", *cell, *([] if self.block is None else ["Step"]), *scaled]

    @property
    def context(self) -> dict[str, object]:
        """Context of templates/problem.py.txt for tool, dial and maker."""
        travel = 10.0 if self.travel is None else self.travel
        faces = [
            f"Face({quoted(face.label)}, {tuple_of(map(plain, face.centre))}, {tuple_of(map(plain, face.normal))}, "
            f"({plain(face.side)}, {plain(face.side)}))"
            for face in self.faces
        ]
        step = ""
        if self.block is not None and self.plates:
            step = f"{{{quoted(BLOCK)}: Step({quoted(self.plates[0].label)}, {plain(self.block)})}}"
        return {
            "faces": faces,
            "proposed": self.proposed,
            "step": step,
            "table": 'float("-inf")' if self.table == -math.inf else plain(self.table or 0.0),
            "keep_out": [tuple_of(tuple_of(map(plain, each)) for each in box) for box in self.keep_out],
            "todo": {name: "" if value is not None else f" {FILL_IN}." for name, value in vars(self).items()},
            "tool": ", ".join(map(plain, self.tool or (0.0, 0.0, 0.0))),
            "sign": "+1" if self.sign == 1 else "-1",
            "noise": plain(self.noise),
            "travel": f"({', '.join(map(plain, travel))})" if isinstance(travel, tuple) else plain(travel),
            "accuracy": None if self.accuracy is None else plain(self.accuracy),
        }

    @property
    def missing(self) -> list[str]:
        """Values still to fill in, and assumptions made."""
        assumed = {
            "tool": "the tool: the tip is assumed at the flange's origin, pointing along its z axis",
            "sign": "the dial's sign: -1 is assumed, a plunger that is pushed in reads more",
            "travel": "the dial's travel: 0 to 10 mm is assumed",
            "accuracy": "the maker's accuracy: errors of 0.7 mm and 1 mrad are assumed for every parameter",
        }
        return [words for name, words in assumed.items() if getattr(self, name) is None]


def _turned(plate: Plate) -> str:
    """The plate as an option, facing the other way."""
    return f"--plate {plate.label}:" + ":".join(
        ",".join(f"{value + 0.0:g}" for value in each)
        for each in (plate.centre, [-value for value in plate.normal], [plate.side])
    )


def _overlap(one: Plate, other: Plate) -> bool:
    """Whether two plates lie in one plane, to a millimetre and a degree, look the same way, and share a part of it."""
    normal, its = (np.array(each.normal) / math.hypot(*each.normal) for each in (one, other))
    apart = np.subtract(one.centre, other.centre)
    along = np.abs(tangent_basis(normal).T @ apart).max()
    return bool(normal @ its > ALIKE and abs(normal @ apart) < 1.0 and along < (one.side + other.side) / 2)


WIDTH = 120  # longest line of a problem file


def conventions(said: Conventions, joints: Sequence[Joint]) -> str:
    """The `Conventions(...)` of a table."""
    parts = [f"signs={tuple_of(map(str, said.signs))}"]
    if any(said.offsets):
        pairs = zip(said.offsets, joints, strict=True)
        each = (f"deg({degrees(offset)})" if joint.turns else plain(offset) for offset, joint in pairs)
        parts.append(f"offsets={angles(said.offsets) if all(j.turns for j in joints) else tuple_of(each, 8)}")
    if said.coupling:
        parts.append(f"coupling={tuple_of(f'({i}, {j}, {plain(factor)})' for i, j, factor in said.coupling)}")
    return listed("Conventions(", parts, ")", 4, taken=len("conventions="))


def conventions_line(said: Conventions, joints: Sequence[Joint]) -> str:
    """The argument of a robot that says them, on one line."""
    return f"conventions={' '.join(conventions(said, joints).split())}"


def angles(values: Sequence[float]) -> str:
    """Angles in rad as deg(...); a tuple also where there is one alone."""
    if len(values) == 1:
        return f"(deg({degrees(values[0])}),)"
    return listed("deg(", [degrees(value) for value in values], ")", 4, taken=8)


def tuple_of(items: Iterable[str], indent: int = 4) -> str:
    """Items as a tuple, also where there is one alone."""
    found = list(items)
    return f"({found[0]},)" if len(found) == 1 else listed("(", found, ")", indent, taken=8)


def listed(opening: str, items: list[str], closing: str, indent: int, *, taken: int = 0, wide: bool = False) -> str:
    """Items on one line where they fit behind `taken` characters, else one per line."""
    line = opening + ", ".join(items) + closing
    if not wide and indent + taken + len(line) + 1 <= WIDTH:
        return line
    inner = "".join(f"{' ' * (indent + 4)}{item},\n" for item in items)
    return f"{opening}\n{inner}{' ' * indent}{closing}"


def quoted(text: str) -> str:
    """A Python string, between double quotes unless it holds one."""
    return repr(text) if '"' in text else json.dumps(text, ensure_ascii=False)


def word(text: str) -> str:
    """A name for a sentence: one line, without what would end a docstring, not too long."""
    return " ".join(re.sub(r'["\\]', "", text).split())[:40] or "an arm"


def imported(names: Iterable[str]) -> str:
    """Names in the order of isort: classes before functions."""
    return ", ".join(sorted(names, key=lambda name: (name.islower(), name)))
