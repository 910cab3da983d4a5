"""A program while it is read: spans of text become numbers, names get values, and lines that puzzle are noted.

What a reader does not understand it raises as a CasacalError, here with what is wrong and what to do in two sentences.
"""

from __future__ import annotations

import math
import re
from bisect import bisect
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from casacal.errors import CasacalError
from casacal.programs.program import (
    DEGREE,
    NUMERAL,
    Form,
    Given,
    Motion,
    Number,
    ProgramMove,
    Puzzle,
    Target,
    TaughtProgram,
)
from casacal.values import Array
from casacal.wording import shortened

WORLD, FLANGE = "world", "flange"
"""Names of a base and a tool that every program has: where its world stands in the problem's base frame, and where the
controller's flange stands in that of the problem. Both are taken as the same unless they are given."""
NUMBERS, BY_HAND = "Write it with plain numbers", "Correct it by hand"
Kind = Literal["tool", "base"]
IN_FORCE: Mapping[Kind, str] = {"tool": "tool in force", "base": "base in force"}  # as frames
Span = tuple[int, int]
Tree = Span | list["Tree"]
"""A span of text, or a list in brackets of such."""


@dataclass(frozen=True)
class Ways:
    """Words of a language by which a program takes other ways than from line to line.

    opens, closes: ends of blocks, routines among them. turns: branches within a block. routine: the head of a routine,
    with its name. apart: what lets a routine run at any time. jumps, label: a jump and where it leads, each with its
    name, if any.
    """

    opens: re.Pattern[str]
    closes: re.Pattern[str]
    turns: re.Pattern[str]
    routine: re.Pattern[str]
    apart: re.Pattern[str]
    jumps: re.Pattern[str] = re.compile(r"(?!)()")
    label: re.Pattern[str] = re.compile(r"(?!)()")


EXTERNAL = "an external axis moves with it, and where that puts arm or work is not known"


class Draft:
    """The files of a program, texts in which comments and strings are blank, and what was found so far."""

    def __init__(self, language: str, form: Form, files: Mapping[str, str], given: Given, aside: str) -> None:
        self.language, self.form, self.given = language, form, given
        self.paths, self.raw = tuple(files), tuple(files.values())
        self.texts = [blanked(text, aside) for text in self.raw]
        self.ends = [[found.end() for found in re.finditer(r"\r\n|\n|\r", text)] for text in self.raw]
        self.names = dict[str, Target | CasacalError]()  # by name in small letters, or why one has no value
        self.frames = dict[str, Array | CasacalError]()  # likewise
        self.seen = [bytearray(len(text)) for text in self.raw]  # letters that were understood
        self.framed = set[str]()  # names that stand for a tool or a base
        self.changed = set[str]()  # names that the program gives another value on its way
        self.targets = dict[Number, Target]()
        self.moves: list[tuple[int, int, Motion, Number]] = []
        self.posed: list[Span] = []  # file and letter of moves to poses
        self.sets: list[tuple[Kind, int, int, Array | None]] = []  # file, letter, and what is in force from there on
        self.puzzles: list[Puzzle] = []

    def line(self, file: int, at: int) -> int:
        """Number of the line in which a letter stands."""
        return bisect(self.ends[file], at) + 1

    def see(self, file: int, span: Span) -> None:
        """Note that a span is understood."""
        self.seen[file][span[0] : span[1]] = b"\x01" * (span[1] - span[0])

    @contextmanager
    def understanding(self, file: int, at: int) -> Iterator[None]:
        """Note the line as a puzzle, once, where what is done with it raises CasacalError."""
        try:
            yield
        except CasacalError as error:
            line = self.line(file, at)
            if not any((each.file, each.line) == (file, line) for each in self.puzzles):
                self.puzzles.append(Puzzle(file, line, error.what, error.fix))

    def refuse(self, file: int, pattern: re.Pattern[str], allowed: re.Pattern[str] | None = None) -> None:
        """Note whatever a pattern finds, but for words that another takes, as moves that are not understood."""
        for found in pattern.finditer(self.texts[file]):
            if allowed is None or not allowed.fullmatch(found[1]):
                with self.understanding(file, found.start(1)):
                    what = f"{found[1]} moves or shifts the arm in a way that is not understood"
                    raise CasacalError(what, BY_HAND)

    def refuse_other_uses(self, file: int, follows: str, moves: str) -> None:
        """Note targets named where nothing was understood, unless a pattern finds what follows them."""
        after = re.compile(follows)
        for found in re.finditer(r"(?<![\w.\\$#])\w+", self.texts[file]):
            if isinstance(self.names.get(found[0].lower()), Target) and not self.seen[file][found.start()]:
                with self.understanding(file, found.start()):
                    if not after.match(self.texts[file], found.end()):
                        what = f"what is done with the target '{found[0]}' here is not understood"
                        raise CasacalError(what, f"Move to it with {moves}")

    def number(self, file: int, span: Span, unit: float = 1.0, least: int = -1) -> Number:
        """The number that a span holds."""
        text = self.raw[file][slice(*span)]
        if NUMERAL.fullmatch(text) is None or not math.isfinite(float(text)):
            raise CasacalError(f"'{' '.join(text.split())[:40]}' is not a plain number", NUMBERS)
        return Number(file, *span, float(text), unit, least)

    def pose(self, file: int, spans: Sequence[Span], name: str, config: tuple[int | None, ...] = ()) -> Target:
        """The pose whose numbers stand in some spans."""
        least = (self.form.least[0],) * 3 + (self.form.least[1],) * (len(self.form.units) - 3)
        if len(spans) != len(least):
            what = f"a pose has {len(least)} numbers, and here are {len(spans)}"
            raise CasacalError(what, f"Write {self.form.named}")
        parts = zip(spans, self.form.units, least, strict=True)
        numbers = tuple(self.number(file, span, unit, digits) for span, unit, digits in parts)
        self.form.pose([number.value for number in numbers])
        return Target(name, file, self.line(file, spans[0][0]), "pose", numbers, config)

    def joints(self, file: int, spans: Sequence[Span], name: str, least: int, unit: float = DEGREE) -> Target:
        """The joint values that stand in some spans."""
        if len(spans) != 6:
            raise CasacalError(f"here are {len(spans)} joint values, not six", NUMBERS)
        numbers = tuple(self.number(file, span, unit, least) for span in spans)
        return Target(name, file, self.line(file, spans[0][0]), "joints", numbers)

    def define(self, name: str, make: Callable[[], Target | Array], *, part: bool = False) -> None:
        """Give a name the value that `make` makes, or the reason why it makes none; a second value is none.

        part: whether a part of its value is set alone, which then is another.
        """
        if part or name.lower() in self.names or name.lower() in self.frames:
            self.changed.add(name.lower())
        if (key := name.lower()) in self.names or key in self.frames:
            self.names[key] = self.frames[key] = CasacalError(f"'{name}' is set more than once", NUMBERS)
            return
        try:
            found = make()
        except CasacalError as error:
            lost = CasacalError(f"'{name}' is not known here: {error.what}", error.fix)
            self.names[key] = self.frames[key] = lost
            return
        if isinstance(found, Target):
            self.names[key] = found
        else:
            self.frames[key] = found

    def named(self, name: str) -> Target:
        """The target of a name."""
        found = self.names.get(name.lower(), CasacalError(f"the target '{name}' is not set in this program", NUMBERS))
        if isinstance(found, CasacalError):
            raise CasacalError(found.what, found.fix)
        return found

    def frame(self, kind: Kind, name: str) -> Array:
        """A tool or base by its name: as the options give it, or as the program does."""
        self.framed.add(name.lower())
        given = self.given.tools if kind == "tool" else self.given.bases
        found = given.get(name.lower(), self.frames.get(name.lower()))
        if name.lower() in self.changed:  # what an option states holds before or after, not all along
            what = f"the program itself sets the {kind} '{name}', more than once or in parts"
            raise CasacalError(what, "Set it once, with plain numbers, or correct its moves by hand")
        if found is None and isinstance(target := self.names.get(name.lower()), Target) and target.kind == "pose":
            found = self.form.pose(target.values)
        if found is None:
            raise CasacalError(f"the {kind} '{name}' is not defined here", self.given_as(kind, name))
        if isinstance(found, CasacalError):
            raise CasacalError(found.what, self.given_as(kind, name) if name != IN_FORCE[kind] else found.fix)
        return found

    def given_as(self, kind: Kind, name: str) -> str:
        """What to do about a frame that only the options can give."""
        return f"Give it: --{kind} '{name}={self.form.named}'"

    def set_in_force(self, kind: Kind, make: Callable[[], Array], at: Span | None = None) -> None:
        """Let a frame be in force, or the reason why it is not known: from a letter of a file on, -1 its begin.

        Without a place it holds for one move.
        """
        try:
            self.frames[IN_FORCE[kind]] = found = make()
        except CasacalError as error:
            self.frames[IN_FORCE[kind]] = error
            found = None
        if at is not None:
            self.sets.append((kind, *at, found))

    def refuse_other_ways(self, file: int, ways: Ways) -> None:
        """Note moves to poses whose tool or base depends on the way that the program takes to them.

        Certain is a frame that never changes, and one that was set in the block of the move, or in one around it, with
        nothing in between that sets another: no branch, no routine that is called, nothing later in a loop.
        """
        text = self.texts[file]
        blocks = _blocks(text, ways)
        routines = {
            head[1].lower(): (head.start(), next((b for a, b in blocks if a == head.start()), len(text)))
            for head in ways.routine.finditer(text)
        }
        for kind in IN_FORCE:
            sets = [(at, frame) for k, where, at, frame in self.sets if (k, where) == (kind, file)]
            known = [frame for at, frame in sets if frame is not None or at >= 0]
            first = known[0] if known else None
            if not known or (first is not None and all(f is not None and np.allclose(f, first) for f in known)):
                continue
            places = [at for at, _ in sets if at >= 0]
            setting = _setting(text, routines, places)
            apart = ways.apart.search(text) is not None and len(setting) > 1
            for where, at in self.posed:
                before = max((place for place in places if place < at), default=-1)
                another = any(before < a < at < b for a, b in routines.values())
                certain = not apart and not another and _straight(text, ways, blocks, before, at, places, setting)
                if where != file or certain:
                    continue
                lines = shortened(sorted({self.line(file, place) for place in places}))
                with self.understanding(file, at):
                    what = f"which {kind} holds here depends on the way of the program, which sets it in lines {lines}"
                    raise CasacalError(what, "Set it right before the move, in the same block")

    def known(self, name: str) -> Array | None:
        """A frame that a joint target can do without."""
        self.framed.add(name.lower())
        found = self.frames.get(name.lower())
        return None if isinstance(found, CasacalError) else found

    def move(self, at: Span, motion: Motion, target: Target, base: Array | None, tool: Array | None) -> None:
        """Note a move, at file and letter, to a target, whose frames are from here on those in force."""
        key = target.numbers[0]
        known = self.targets.setdefault(key, replace(target, tool=tool, base=None if target.kind == "joints" else base))
        if known.kind == "pose":
            assert base is not None
            pairs = ((known.base, base), (known.tool, tool))
            if not all(np.allclose(one, two, atol=1e-9) for one, two in pairs):  # type: ignore[arg-type]
                what = f"'{target.name}' is reached with another tool or base than before: no one correction suits both"
                raise CasacalError(what, "Give each use a target of its own")
            if known.near != target.near:
                what = f"'{target.name}' is reached from other joint values than before: no one correction suits both"
                raise CasacalError(what, "Give each use a target of its own")
            self.posed.append(at)
        self.moves.append((at[0], self.line(*at), motion, key))

    def finished(self) -> TaughtProgram:
        """The program; raises CasacalError for a tool or base of the options that it does not name."""
        for kind, given, own in (("tool", self.given.tools, FLANGE), ("base", self.given.bases, WORLD)):
            if strange := sorted(set(given) - self.framed - {own}):
                fix = (
                    f"Its names: {', '.join(sorted(self.framed)) or 'none'}; '{own}' moves where the controller has it"
                )
                raise CasacalError(f"The program names no {kind} '{strange[0]}'", fix)
        index = {key: i for i, key in enumerate(self.targets)}
        world, flange = self.given.bases.get(WORLD, np.eye(4)), self.given.tools.get(FLANGE, np.eye(4))
        targets = tuple(
            replace(
                target,
                base=None if target.base is None else world @ target.base,
                tool=None if target.tool is None else flange @ target.tool,
            )
            for target in self.targets.values()
        )
        idle = [each for each in self.names.values() if isinstance(each, Target) and each.numbers[0] not in index]
        unused = tuple(each.name for each in idle if each.name.lower() not in self.framed)
        moves = tuple(ProgramMove(file, line, motion, index[key]) for file, line, motion, key in self.moves)
        puzzles = tuple(sorted(self.puzzles, key=lambda each: (each.file, each.line)))
        return TaughtProgram(
            self.language, self.paths, self.raw, targets, moves, puzzles, unused, self.form, self.given
        )


def _blocks(text: str, ways: Ways) -> list[Span]:
    """Blocks of a text, each from where it opens to where it closes, or to the end."""
    marks = sorted(
        [(m.start(), 1) for m in ways.opens.finditer(text)] + [(m.start(), 0) for m in ways.closes.finditer(text)]
    )
    open_, found = list[int](), list[Span]()
    for at, opens in marks:
        if opens:
            open_.append(at)
        elif open_:
            found.append((open_.pop(), at))
    labels = {mark[1].lower(): mark.start() for mark in ways.label.finditer(text)}
    jumps = ((labels.get(mark[1].lower(), len(text)), mark.start()) for mark in ways.jumps.finditer(text))
    back = [(at, jump) for at, jump in jumps if at < jump]  # a loop like any other
    return found + back + [(at, len(text)) for at in open_]


def _setting(text: str, routines: Mapping[str, Span], places: Sequence[int]) -> set[str]:
    """Routines that set a frame, or call one that does."""
    setting = {name for name, (a, b) in routines.items() if any(a <= at < b for at in places)}
    for _ in routines:
        setting |= {name for name, (a, b) in routines.items() if _calls(text, text.find("(", a) + 1, b, setting)}
    return setting


def _calls(text: str, start: int, end: int, routines: set[str]) -> bool:
    """Whether some routine is called between two letters."""
    named = "|".join(map(re.escape, sorted(routines))) or "(?!)"
    return re.compile(rf"(?i)(?<!\w)(?:{named})\s*\(").search(text, start, end) is not None


def _straight(
    text: str, ways: Ways, blocks: Sequence[Span], before: int, at: int, places: Sequence[int], setting: set[str]
) -> bool:
    """Whether what was set at one letter holds at a later one whatever way the program takes."""
    if before < 0:
        return False
    around = [block for block in blocks if block[0] < before < block[1]]
    entered = [block for block in blocks if before < block[0] < at < block[1]]
    if any(not a < at < b for a, b in around) or any(a < place < b for a, b in entered for place in places):
        return False
    closed = [block for block in blocks if before < block[0] and block[1] < at]
    turns = (mark.start() for mark in ways.turns.finditer(text, before, at))
    if any(not any(a < turn < b for a, b in [*closed, *entered]) for turn in turns):
        return False
    return not _calls(text, before, at, setting)


def blanked(text: str, pattern: str) -> str:
    """Text in which whatever a pattern finds, such as comments, is blanks, but for the quotes around a string."""

    def blanks(found: re.Match[str]) -> str:
        empty = re.sub(r"[^\r\n]", " ", found[0])
        return f'"{empty[1:-1]}"' if found[0].startswith('"') else empty

    return re.sub(pattern, blanks, text)


DEEPEST = 12  # brackets within one another


def nested(text: str, at: int, brackets: str = "[]") -> tuple[list[Tree], int]:
    """The list that begins at a bracket, and where it ends."""
    stack, begin = [list[Tree]()], at
    for found in re.compile(f"[,{re.escape(brackets)}]").finditer(text, at):
        mark, piece = found[0], stripped(text, begin, found.start())
        begin = found.end()
        if mark == brackets[0]:
            if piece[0] < piece[1] or len(stack) > DEEPEST:
                break
            stack.append([])
            continue
        if piece[0] < piece[1]:
            stack[-1].append(piece)
        if mark == brackets[1]:
            done = stack.pop()
            stack[-1].append(done)
            if len(stack) == 1:
                return done, found.end()
    raise CasacalError("a list is not written out", NUMBERS)


def stripped(text: str, start: int, end: int) -> Span:
    """A span without blanks at its ends."""
    piece = text[start:end]
    left = start + len(piece) - len(piece.lstrip())
    return left, left + len(piece.strip())


def spans_of(tree: Tree) -> list[Span]:
    """Spans of a list without lists in it."""
    if isinstance(tree, tuple) or not all(isinstance(each, tuple) for each in tree):
        raise CasacalError("a list of numbers was expected", NUMBERS)
    return [each for each in tree if isinstance(each, tuple)]


def arguments(text: str, start: int, end: int) -> list[Span]:
    """Spans of what commas outside of brackets separate, without blanks around them."""
    depth, begin, found = 0, start, list[Span]()
    for i in range(start, end):
        depth += (text[i] in "([{") - (text[i] in ")]}")
        if text[i] == "," and depth <= 0:
            found.append(stripped(text, begin, i))
            begin = i + 1
    return [*found, stripped(text, begin, end)]
