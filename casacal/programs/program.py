"""A robot program as its bytes, and the moves and targets in them: the one value between all languages.

Text is decoded as Latin-1, in which every byte is a letter: what stands between numbers of targets stays byte for
byte, whatever its encoding and line ends are.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from casacal.errors import CasacalError, harmless
from casacal.values import Array, Value
from casacal.wording import shortened

NUMERAL = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
MOST_DIGITS = 6  # decimals that the mantissa of a number with an exponent has at least
DEGREE = math.pi / 180
SUFFIX = {"rapid": "RAPID", "krl": "KRL", "urscript": "URScript", "fanuc": "FANUC TP", "yaskawa": "Yaskawa INFORM"}

Motion = Literal["joint", "linear", "via", "end", "spline"]
Turned = Literal["quaternion", "vector", "zyx", "xyz"]
"""How orientations are written: w, x, y, z; a rotation vector; angles about z, then the new y, then the new x; the
same three the other way round, x first, which are turns about the fixed axes x, y, z."""


@dataclass(frozen=True)
class Form:
    """How a language writes poses: length of its unit in mm, orientation, decimals that lengths and turns get at least.

    named: the numbers of a pose, as a sentence asks for them.
    """

    unit: float
    turned: Turned
    least: tuple[int, int]
    named: str

    @property
    def units(self) -> tuple[float, ...]:
        """Mm or rad per unit of each number; a quaternion has none."""
        turns = 4 if self.turned == "quaternion" else 3
        return (self.unit,) * 3 + (DEGREE if self.turned in ("zyx", "xyz") else 1.0,) * turns

    def pose(self, numbers: Sequence[float]) -> Array:
        """The transform (4, 4; mm) that numbers stand for; raises CasacalError for what is none."""
        values = np.array(numbers, dtype=np.float64) * self.units
        found, turn = np.eye(4), values[3:]
        if not np.isfinite(values).all():
            raise CasacalError("a number of a pose is not finite", f"Give {self.named}")
        if self.turned == "quaternion":
            if abs(np.linalg.norm(turn) - 1) > UNIT_LENGTH:
                what = f"a quaternion has the length {np.linalg.norm(turn):.6g}, not 1"
                raise CasacalError(what, "Give a unit quaternion")
            found[:3, :3] = Rotation.from_quat(np.roll(turn, -1)).as_matrix()
        elif self.turned == "vector":
            found[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
        else:
            found[:3, :3] = Rotation.from_euler("ZYX" if self.turned == "zyx" else "xyz", turn).as_matrix()
        found[:3, 3] = values[:3]
        return found

    def numbers(self, pose: Array, near: Sequence[float]) -> Array:
        """Numbers of a transform (4, 4; mm): of those that stand for one orientation, the nearest to some others."""
        old = np.array(near, dtype=np.float64)[3:]
        if self.turned == "quaternion":
            turn = np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)
            turn = turn * (1.0 if turn @ old >= 0 else -1.0)
        elif self.turned == "vector":
            turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
            size = float(np.linalg.norm(turn))
            axis = turn / size if size > 1e-12 else np.zeros(3)
            turn = min((turn + axis * 2 * math.pi * k for k in (-1, 0, 1)), key=lambda v: float(((v - old) ** 2).sum()))
        else:
            first = old if self.turned == "zyx" else old[::-1]
            turn = _angles(pose[:3, :3], first * DEGREE) / DEGREE
            turn = turn if self.turned == "zyx" else turn[::-1]
        return np.concatenate([pose[:3, 3] / self.unit, turn])


UNIT_LENGTH = 1e-3  # how far a quaternion may be from unit length: more than rounding leaves is a mistake
STRAIGHT = 1e-9  # cosine of the second angle below which the first and the third turn about one axis


def _angles(turn: Array, near: Array) -> Array:
    """Angles (3,; rad) about z, new y, new x of a rotation (3, 3), the nearest to some others."""
    best, distance = near, math.inf
    level = math.atan2(-turn[2, 0], math.hypot(turn[0, 0], turn[1, 0]))
    for b in (level, math.pi - level):
        if abs(math.cos(b)) < STRAIGHT:
            a = float(near[0])
        else:
            a = math.atan2(turn[1, 0] / math.cos(b), turn[0, 0] / math.cos(b))
        rest = Rotation.from_euler("ZY", [a, b]).as_matrix().T @ turn
        angles = np.array([a, b, math.atan2(rest[2, 1], rest[1, 1])])
        angles += 2 * math.pi * np.round((near - angles) / (2 * math.pi))
        if (away := float(((angles - near) ** 2).sum())) < distance:
            best, distance = angles, away
    return best


@dataclass(frozen=True)
class Number:
    """A number in a file's text: where it stands, its value as written, mm or rad per unit, decimals it gets at least.

    What is a whole number by nature, such as pulses or a turn, has `least` below zero.
    """

    file: int
    start: int
    end: int
    value: float
    unit: float = 1.0
    least: int = -1

    def written(self, old: str, value: float) -> str:
        """A value (its own unit) in the form of the old digits, which stay where they say the same."""
        if self.least < 0:
            return old if round(value) == self.value else str(round(value))
        if (mark := re.search("[eE]", old)) is not None:
            digits = max(len(old[: mark.start()].partition(".")[2]), MOST_DIGITS)
            text = f"{value:.{digits}{mark[0]}}"
        else:
            decimals = max(len(old.partition(".")[2]), self.least)
            text = f"{value:.{decimals}f}"
            if abs(value - self.value) <= 0.5 * 10.0**-decimals:
                return old
        if float(text) == self.value:
            return old
        sign, size = ("-", text[1:]) if text.startswith("-") else ("", text)
        if re.match(r"[+-]?\.", old) and size.startswith("0."):
            size = size[1:]
        return ("+" if old.startswith("+") and not sign else sign if float(size) else "") + size


@dataclass(frozen=True, eq=False)
class Target(Value):
    """A target in a program: six joint values, or a pose in a base frame of a tool's tip.

    numbers: of joints (6), or of a pose, as its language's `Form` has them. config: entries of its configuration by
    the language's function, None where it says nothing. turns: numbers that hold entries which whole turns change,
    each with the indices of these, lowest bit first. near: joint values (6,; rad) beside which its posture is meant.
    base, tool: transforms (4, 4; mm) in force; of joints the tool alone, where it is known.
    """

    name: str
    file: int
    line: int
    kind: Literal["joints", "pose"]
    numbers: tuple[Number, ...]
    config: tuple[int | None, ...] = ()
    turns: tuple[tuple[Number, tuple[int, ...]], ...] = ()
    near: tuple[float, ...] | None = None
    tool: Array | None = None
    base: Array | None = None

    @property
    def values(self) -> tuple[float, ...]:
        """The numbers as written."""
        return tuple(number.value for number in self.numbers)

    @property
    def joints(self) -> Array:
        """Joint values (6,; rad)."""
        return np.array([number.value * number.unit for number in self.numbers])


@dataclass(frozen=True)
class ProgramMove:
    """A move to a target, by its index; a circle is a move via one and a move to its end."""

    file: int
    line: int
    motion: Motion
    target: int


@dataclass(frozen=True)
class Puzzle:
    """A line that is not understood: why, and what to do."""

    file: int
    line: int
    what: str
    fix: str


@dataclass(frozen=True, eq=False)
class Given(Value):
    """What a program leaves to its controller: tools and bases (4, 4; mm) by name in small letters, pulses a degree."""

    tools: Mapping[str, Array]
    bases: Mapping[str, Array]
    pulses: tuple[float, ...] | None = None


@dataclass(frozen=True, eq=False)
class TaughtProgram(Value):
    """A program: paths and texts of its files, the targets that moves go to, the moves in the order of their lines.

    puzzles: lines that move the arm or change a target in a way that is not understood. unused: names of targets that
    no move goes to. given: what its reading was told, so that it can be read again.
    """

    language: str
    paths: tuple[str, ...]
    texts: tuple[str, ...]
    targets: tuple[Target, ...]
    moves: tuple[ProgramMove, ...]
    puzzles: tuple[Puzzle, ...]
    unused: tuple[str, ...]
    form: Form
    given: Given

    def __repr__(self) -> str:
        return (
            f"<{SUFFIX[self.language]} program {self.paths[0]}: {len(self.moves)} moves, {len(self.targets)} targets>"
        )

    def where(self, place: Target | Puzzle) -> str:
        """The line of a place, and its file where there are several."""
        line = f"line {place.line}"
        return line if len(self.paths) == 1 else f"{self.paths[place.file]}, {line}"

    def refuse_puzzles(self) -> None:
        """Raise CasacalError where a line is not understood."""
        if self.puzzles:
            first, *others = self.puzzles
            also = f" (likewise lines {shortened(each.line for each in others)})" if others else ""
            what = f"{self.paths[first.file]}, line {first.line}: {first.what}{also}"
            raise CasacalError(what, f"{first.fix}; or leave such moves as they are with --skip-unknown")

    @cached_property
    def puzzled(self) -> dict[int, str]:
        """Targets that stand, or are named, in lines which are not understood: why they stay as they are, by index."""
        lines = [re.split(r"\r\n|\n|\r", text) for text in self.texts]
        at = {(each.file, each.line) for each in self.puzzles}
        named = {
            word.lower(): line for f, line in sorted(at) for word in re.findall(r"P\[\d+|[\w$]+", lines[f][line - 1])
        }
        found = dict[int, str]()
        for i, target in enumerate(self.targets):
            key = target.name.lower().rstrip("]")
            line = target.line if (target.file, target.line) in at else named.get(key)
            own = next((m.line for m in self.moves if m.target == i and (m.file, m.line) in at), None)
            if (where := own or line) is not None:
                found[i] = f"line {where} has it, which is not understood"
        return found

    def refuse_targets(self, why: Mapping[int, str], fix: str = "") -> None:
        """Raise CasacalError for targets that are lost, for a reason by index."""
        target, also = self.targets[min(why)], f" (and {len(why) - 1} more)" if len(why) > 1 else ""
        what = f"{self.paths[target.file]}, line {target.line}, target '{target.name}': {why[min(why)]}{also}"
        raise CasacalError(what, fix or "Mend it, or leave such targets as they are with --skip-unknown")

    def with_numbers(self, values: Mapping[Number, float]) -> tuple[str, ...]:
        """The texts with other values of some numbers, in the form of the old ones."""
        texts = list(self.texts)
        for number in sorted(values, key=lambda number: -number.start):
            text = texts[number.file]
            new = number.written(text[number.start : number.end], values[number])
            texts[number.file] = text[: number.start] + new + text[number.end :]
        return tuple(texts)

    def changed_lines(self, texts: Sequence[str]) -> str:
        """What other texts change, as a unified diff; empty where nothing does."""
        parts = list[str]()
        for path, old, new in zip(self.paths, self.texts, texts, strict=True):
            before, after = (readable_text(text).splitlines() for text in (old, new))
            parts += difflib.unified_diff(before, after, path, f"{path} (corrected)", n=0, lineterm="")
        return harmless("\n".join(parts))


def readable_text(text: str) -> str:
    """Text as people read it: UTF-8 where its bytes are that, else Latin-1."""
    try:
        return text.encode("latin-1").decode("utf-8-sig")
    except UnicodeError:
        return text
