"""A robot program as its bytes, and the moves and targets in them: the one value between all languages.

Text is decoded as Latin-1, in which every byte is a letter: what stands between numbers of targets stays byte for
byte, whatever its encoding and line ends are.
"""

from __future__ import annotations

import difflib
import math
import re
from bisect import bisect
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from casacal.errors import CasacalError, harmless
from casacal.values import Array, Value
from casacal.wording import shortened

NUMERAL = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
MOST_DIGITS = 6  # decimals that the mantissa of a number with an exponent has at least
MOST_BYTES = 1 << 25  # no controller holds a program of such a size
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
        """The transform (4, 4; mm) that numbers stand for; raises ValueError for what is none."""
        values = np.array(numbers, dtype=np.float64) * self.units
        found, turn = np.eye(4), values[3:]
        if not np.isfinite(values).all():
            raise ValueError("a number is not finite")
        if self.turned == "quaternion":
            if abs(np.linalg.norm(turn) - 1) > UNIT_LENGTH:
                raise ValueError(f"its quaternion has the length {np.linalg.norm(turn):.6g}, not 1")
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
class Move:
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
class Program(Value):
    """A program: paths and texts of its files, the targets that moves go to, the moves in the order of their lines.

    puzzles: lines that move the arm or change a target in a way that is not understood. unused: names of targets that
    no move goes to. given: what its reading was told, so that it can be read again.
    """

    language: str
    paths: tuple[str, ...]
    texts: tuple[str, ...]
    targets: tuple[Target, ...]
    moves: tuple[Move, ...]
    puzzles: tuple[Puzzle, ...]
    unused: tuple[str, ...]
    form: Form
    given: Given

    def __repr__(self) -> str:
        return (
            f"<{SUFFIX[self.language]} program {self.paths[0]}: {len(self.moves)} moves, {len(self.targets)} targets>"
        )

    def place(self, at: Target | Move | Puzzle) -> str:
        """Where something stands, for a sentence."""
        return f"{self.paths[at.file]}, line {at.line}"

    def refuse_puzzles(self) -> None:
        """Raise CasacalError where a line is not understood."""
        if self.puzzles:
            first, others = self.puzzles[0], [puzzle.line for puzzle in self.puzzles[1:]]
            also = f" (further lines that are not understood: {shortened(others)})" if others else ""
            what = harmless(f"{self.place(first)}: {first.what}{also}")
            raise CasacalError(what, f"{first.fix}; or leave such moves as they are with --skip-unknown")

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


def read_bytes(path: Path) -> str:
    """A file's bytes as letters; raises CasacalError for what is no program."""
    try:
        if path.stat().st_size > MOST_BYTES:
            raise CasacalError(f"'{path}' is larger than any program", "Name a program")
        data = path.read_bytes()
    except OSError as error:
        raise CasacalError(f"'{path}' cannot be read ({error.strerror})", "Check the path") from error
    if b"\x00" in data:
        raise CasacalError(f"'{path}' is not a text file (it holds zero bytes)", "Give the program as text")
    return data.decode("latin-1")


class Draft:
    """A program while it is read: the file under way, and what was found so far."""

    def __init__(self, language: str, form: Form, files: Mapping[str, str], given: Given) -> None:
        self.language, self.form, self.given = language, form, given
        self.paths, self.texts = tuple(files), tuple(files.values())
        self.ends = [[found.end() for found in re.finditer(r"\r\n|\n|\r", text)] for text in self.texts]
        self.targets: dict[tuple[int, int], Target] = {}
        self.moves: list[tuple[int, int, Motion, tuple[int, int]]] = []
        self.puzzles: list[Puzzle] = []
        self.framed = set[str]()  # names that stand for a tool or a base

    def line(self, file: int, at: int) -> int:
        """Number of the line in which a letter stands."""
        return bisect(self.ends[file], at) + 1

    def puzzle(self, file: int, at: int, what: str, fix: str) -> None:
        """Note a line that is not understood; one note a line."""
        line = self.line(file, at)
        if not any(each.file == file and each.line == line for each in self.puzzles):
            self.puzzles.append(Puzzle(file, line, what, fix))

    def number(self, file: int, span: tuple[int, int], unit: float = 1.0, least: int = -1) -> Number:
        """The number that a span holds; raises ValueError where it holds anything else."""
        text = self.texts[file][slice(*span)]
        if NUMERAL.fullmatch(text) is None:
            raise ValueError(f"'{' '.join(text.split())[:40]}' is not a plain number")
        if not math.isfinite(float(text)):
            raise ValueError(f"{text} is not finite")
        return Number(file, *span, float(text), unit, least)

    def pose_numbers(self, file: int, spans: Sequence[tuple[int, int]]) -> tuple[Number, ...]:
        """The numbers of a pose; raises ValueError where they are none."""
        least = (self.form.least[0],) * 3 + (self.form.least[1],) * (len(self.form.units) - 3)
        if len(spans) != len(least):
            raise ValueError(f"a pose has {len(least)} numbers ({self.form.named}), and here are {len(spans)}")
        parts = zip(spans, self.form.units, least, strict=True)
        found = tuple(self.number(file, span, unit, digits) for span, unit, digits in parts)
        self.form.pose([number.value for number in found])
        return found

    def joint_numbers(self, file: int, spans: Sequence[tuple[int, int]], unit: float, least: int) -> tuple[Number, ...]:
        """The numbers of six joint values; raises ValueError where they are none."""
        if len(spans) != 6:
            raise ValueError(f"here are {len(spans)} joint values, not six")
        return tuple(self.number(file, span, unit, least) for span in spans)

    def transform(self, file: int, spans: Sequence[tuple[int, int]]) -> Array:
        """A frame (4, 4; mm); raises ValueError where the spans hold none."""
        return self.form.pose([number.value for number in self.pose_numbers(file, spans)])

    def frame(self, kind: Literal["tool", "base"], name: str, known: Mapping[str, Array | str]) -> Array:
        """A tool or base by its name: as the options give it, or as the program does; LookupError with the reason.

        known: frames of the program, or why one has no value, by name in small letters.
        """
        given = self.given.tools if kind == "tool" else self.given.bases
        self.framed.add(name.lower())
        found = given.get(name.lower(), known.get(name.lower(), f"the {kind} '{name}' is not defined here"))
        if isinstance(found, str):
            raise LookupError(found, f"Give it: --{kind} '{name}={self.form.named}'")
        return found

    def move(self, file: int, at: int, motion: Motion, target: Target, base: Array | None, tool: Array | None) -> None:
        """Note a move to a target; the frames in force are those of the target from here on.

        A pose that moves reach in two frames is no one pose of the arm: it is a puzzle at the second.
        """
        key = (target.numbers[0].file, target.numbers[0].start)
        known = self.targets.get(key)
        if known is None and target.kind == "pose":
            assert base is not None
            assert tool is not None
            self.targets[key] = replace(target, base=base, tool=tool)
        elif known is None:
            self.targets[key] = replace(target, tool=tool)
        elif known.kind == "pose":
            pairs = ((known.base, base), (known.tool, tool))
            if not all(np.allclose(one, two, atol=1e-9) for one, two in pairs):  # type: ignore[arg-type]
                what = f"'{target.name}' is reached with another tool or base than before: no one correction suits both"
                self.puzzle(file, at, what, "Give each use a target of its own")
                return
        self.moves.append((file, self.line(file, at), motion, key))

    def finished(self, declared: Iterable[Target]) -> Program:
        """The program. Targets that a puzzle's move shares keep the corrections of their other moves."""
        index = {key: i for i, key in enumerate(self.targets)}
        world, flange = self.given.bases.get(WORLD), self.given.tools.get(FLANGE)
        targets = tuple(
            replace(
                target,
                base=target.base if target.base is None or world is None else world @ target.base,
                tool=target.tool if target.tool is None or flange is None else flange @ target.tool,
            )
            for target in self.targets.values()
        )
        idle = [t for t in declared if (t.numbers[0].file, t.numbers[0].start) not in index]
        unused = [target.name for target in idle if target.name.lower() not in self.framed]
        moves = tuple(Move(file, line, motion, index[key]) for file, line, motion, key in self.moves)
        puzzles = tuple(sorted(self.puzzles, key=lambda each: (each.file, each.line)))
        return Program(
            self.language, self.paths, self.texts, targets, moves, puzzles, tuple(unused), self.form, self.given
        )


WORLD, FLANGE = "world", "flange"
"""Names of a base and a tool that every program has: where its world stands in the problem's base frame, and where the
controller's flange stands in that of the problem. Both are taken as the same unless they are given."""


@dataclass(frozen=True, eq=False)
class Given(Value):
    """What a program leaves to its controller: tools and bases (4, 4; mm) by name in small letters, pulses a degree."""

    tools: Mapping[str, Array]
    bases: Mapping[str, Array]
    pulses: tuple[float, ...] | None = None


def blanked(text: str, pattern: str) -> str:
    """Text in which whatever a pattern finds, such as comments, is blanks, but for the quotes around a string."""

    def blanks(found: re.Match[str]) -> str:
        empty = re.sub(r"[^\r\n]", " ", found[0])
        return f'"{empty[1:-1]}"' if found[0].startswith('"') else empty

    return re.sub(pattern, blanks, text)


Tree = tuple[int, int] | list["Tree"]
"""A span of text, or a list in brackets of such."""


def nested(text: str, at: int, brackets: str = "[]") -> tuple[list[Tree], int]:
    """The list that begins at a bracket, and where it ends; raises ValueError where it does not end."""
    stack, begin = [list[Tree]()], at + 1
    for found in re.compile(f"[,{re.escape(brackets)}]").finditer(text, at):
        mark, here = found[0], found.start()
        piece = text[begin:here]
        if mark == brackets[0]:
            if here > at and piece.strip():
                raise ValueError("a list is not written out")
            stack.append([])
            if len(stack) > DEEPEST:
                break
        else:
            if piece.strip():
                left = begin + len(piece) - len(piece.lstrip())
                stack[-1].append((left, left + len(piece.strip())))
            if mark == brackets[1]:
                done = stack.pop()
                stack[-1].append(done)
                if len(stack) == 1:
                    return done, here + 1
        begin = here + 1
    raise ValueError("a bracket is not closed")


DEEPEST = 12  # brackets within one another


def spans_of(tree: Tree) -> list[tuple[int, int]]:
    """Spans of a list without lists in it; raises ValueError for another."""
    if isinstance(tree, tuple) or not all(isinstance(each, tuple) for each in tree):
        raise ValueError("a list of numbers was expected")
    return [each for each in tree if isinstance(each, tuple)]


def arguments(text: str, start: int, end: int) -> list[tuple[int, int]]:
    """Spans of what commas outside of brackets separate, without blanks around them."""
    depth, begin, found = 0, start, list[tuple[int, int]]()
    for i in range(start, end + 1):
        mark = text[i] if i < end else ","
        depth += (mark in "([{") - (mark in ")]}")
        if mark == "," and (depth <= 0 or i == end):
            piece = text[begin:i]
            left = begin + len(piece) - len(piece.lstrip())
            found.append((left, left + len(piece.strip())))
            begin = i + 1
    return found


def covered(length: int, spans: Iterable[tuple[int, int]]) -> bytearray:
    """For each letter of a text whether it stands in one of some spans."""
    found = bytearray(length)
    for start, end in spans:
        found[start:end] = b"\x01" * (end - start)
    return found
