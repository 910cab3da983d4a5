"""RAPID (ABB): robtarget, jointtarget, tooldata, wobjdata; MoveAbsJ, MoveJ, MoveL, MoveC.

Source: ABB Robotics, Technical reference manual: RAPID Instructions, Functions and Data types (3HAC050917), on these
instructions and data types, and confdata for the quadrants and cfx.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from casacal.errors import CasacalError
from casacal.programs.draft import EXTERNAL, NUMBERS, Draft, Tree, arguments, nested, spans_of
from casacal.programs.program import Form, Given, Motion, Target, TaughtProgram
from casacal.values import Array

FORM = Form(1.0, "quaternion", (3, 7), "X,Y,Z,Q1,Q2,Q3,Q4 in mm and as a unit quaternion")
JOINT_DIGITS = 5
ASIDE = r'"(?:[^"\r\n]|"")*"|![^\r\n]*'  # strings and comments
WORD = r"(?i)(?<![\w.\\:])"
DECLARED = re.compile(rf"{WORD}(robtarget|jointtarget|tooldata|wobjdata)\s+(\w+)\s*(\{{[^}}\r\n]*\}})?\s*:=\s*")
ASSIGNED = re.compile(r"(?<![\w.\\])(\w+)\s*(?:\.\w+|\{[^}\r\n]*\})*\s*:=")
MOVES = re.compile(rf"{WORD}Move(AbsJ|J|L|C)(?:DO|AO|GO|Sync)?(?![\w:])([^;]*);")
KNOWN = re.compile(r"(?i)Move(?:AbsJ|J|L|C)(?:DO|AO|GO|Sync)?|MoveExtJ")
OTHERS = re.compile(
    rf"{WORD}(Trigg(?:AbsJ|[JLC])(?:IOs|DO)?|Search[LC]|Arc[LC]\w*|Spot[JLM]\w*|Disp[LC]|Paint[LC]|CapL|CSS\w+|EGMMove[LC]|"
    r"SetDataVal|CorrCon|EOffsOn|EOffsSet|PDispOn|PDispSet|Move(?:ExtJ|AbsJ|J|L|C)\w*)(?![\w:])"
)
LEFT_OPEN = re.compile(rf"{WORD}(Conf[LJ])\s*\\\s*Off(?!\w)")
SHIFTS = re.compile(rf"{WORD}(?:PDispOn|PDispSet|EOffsOn|EOffsSet|(PDispOff|EOffsOff))(?![\w:])")
NO_AXIS = 9e8  # 9E9 stands for an external axis that is not there
MOTIONS: Mapping[str, tuple[Motion, ...]] = {"absj": ("joint",), "j": ("joint",), "l": ("linear",), "c": ("via", "end")}


def configuration(joints: Array, bits: Array) -> Array:
    """Quadrants cf1, cf4, cf6, and the three bits of cfx: axis 5 negative, wrist behind lower arm, behind axis 1."""
    quadrants = np.floor(joints[:, [0, 3, 5]] / (np.pi / 2))
    return np.column_stack([quadrants, joints[:, 4] < 0, bits[:, 1], bits[:, 0]]).astype(int)


def read(files: Mapping[str, str], given: Given) -> TaughtProgram:
    """Read a module."""
    draft = Draft("rapid", FORM, files, given, ASIDE)
    text = draft.texts[0]
    draft.frames |= {"tool0": np.eye(4), "wobj0": np.eye(4)}
    for found in DECLARED.finditer(text):
        draft.define(found[2], lambda found=found: _value(draft, text, found))  # type: ignore[misc]
        draft.see(0, found.span())
    for found in ASSIGNED.finditer(text):
        if not draft.seen[0][found.start()]:
            for known in (draft.names, draft.frames):
                if found[1].lower() in known:
                    known[found[1].lower()] = CasacalError(f"'{found[1]}' is set again at run time", NUMBERS)
                    draft.changed.add(found[1].lower())
    _refuse_changed_frames(draft, text)
    for found in LEFT_OPEN.finditer(text):
        with draft.understanding(0, found.start(1)):
            what = (
                f"after {found[1]}\\Off the controller may take another configuration than the one that a target states"
            )
            raise CasacalError(what, "Switch it on, or correct such moves by hand")
    shift = None
    for mark in sorted([*MOVES.finditer(text), *SHIFTS.finditer(text)], key=lambda mark: mark.start()):
        if mark.re is SHIFTS:
            shift = None if mark[1] else draft.line(0, mark.start())
            continue
        draft.see(0, mark.span())
        with draft.understanding(0, mark.start()):
            _move(draft, text, mark, shift)
    draft.refuse(0, OTHERS, KNOWN)
    draft.refuse_other_uses(0, r"\s*(\.|:=|\{)", "MoveAbsJ, MoveJ, MoveL or MoveC")
    return draft.finished()


def _refuse_changed_frames(draft: Draft, text: str) -> None:
    """Let tools and work objects be unknown that something else than a move is told of: it may change them."""
    moves = [mark.span() for mark in MOVES.finditer(text)]
    for found in re.finditer(r"(?<![\w.\\])\w+(?![\w.])", text):
        name, at = found[0].lower(), found.start()
        known = isinstance(draft.frames.get(name), np.ndarray) and name not in ("tool0", "wobj0")
        if not known or draft.seen[0][at] or any(a <= at < b for a, b in moves):
            continue
        if not re.search(r"(?i)\\(?:Tool|WObj)\s*:=\s*$", text[max(at - 40, 0) : at]):
            what = f"'{found[0]}' is told to something in line {draft.line(0, at)} that may change it"
            draft.frames[name] = CasacalError(what, NUMBERS)


def _value(draft: Draft, text: str, found: re.Match[str]) -> Target | Array:
    """What a declaration gives its name."""
    if found[3] or text[found.end() : found.end() + 1] != "[":
        raise CasacalError("it is an array, or computed", NUMBERS)
    tree, end = nested(text, found.end())
    draft.see(0, (found.start(), end))
    return _target(draft, found[2], tree) if found[1].lower().endswith("target") else _frame(draft, tree)


def _parts(tree: Tree, *counts: int) -> list[Tree]:
    if isinstance(tree, tuple) or len(tree) not in counts:
        raise CasacalError(f"a list of {counts[0]} parts was expected", NUMBERS)
    return tree


def _target(draft: Draft, name: str, tree: list[Tree]) -> Target:
    """A robtarget, or a jointtarget where there are two parts."""
    first, *rest = _parts(tree, 4, 2)
    external = [draft.number(0, span).value for span in spans_of(rest[-1])]
    if any(value and abs(value) < NO_AXIS for value in external):
        raise CasacalError(EXTERNAL, "Correct it by hand")
    if len(rest) == 1:
        return draft.joints(0, spans_of(first), name, JOINT_DIGITS)
    quadrants = [draft.number(0, span) for span in spans_of(rest[1])]
    values = [int(each.value) for each in quadrants if each.value.is_integer() and abs(each.value) < 100]
    if len(values) != 4 or len(quadrants) != 4 or not 0 <= values[3] <= 7:
        raise CasacalError("its configuration is none of an arm with six turning joints", "Write cf1, cf4, cf6 and cfx")
    config = (*values[:3], values[3] & 1, values[3] >> 1 & 1, values[3] >> 2)
    pose = draft.pose(0, [*spans_of(first), *spans_of(rest[0])], name, config)
    return replace(pose, turns=tuple((number, (i,)) for i, number in enumerate(quadrants[:3])))


def _frame(draft: Draft, tree: list[Tree]) -> Array:
    """The transform of a tooldata, or of a wobjdata where there are five parts, if it is fixed in space."""

    def pose(tree: Tree) -> Array:
        place, turn = _parts(tree, 2)
        return FORM.pose(draft.pose(0, [*spans_of(place), *spans_of(turn)], "").values)

    held, *rest = _parts(tree, 3, 5)
    flags = [draft.raw[0][slice(*part)].upper() for part in (held, *rest) if isinstance(part, tuple)]
    if len(rest) == 2 and flags == ["TRUE"]:
        return pose(rest[0])
    if len(rest) == 4 and flags == ["FALSE", "TRUE", '""']:
        return np.asarray(pose(rest[2]) @ pose(rest[3]))
    raise CasacalError("the robot holds the work, or a mechanical unit moves it", "Correct such moves by hand")


def _move(draft: Draft, text: str, mark: re.Match[str], shift: int | None) -> None:
    kind, words = mark[1].lower(), text[mark.start(2) : mark.end(2)]
    parts = [span for span in arguments(text, *mark.span(2)) if not text[slice(*span)].startswith("\\")]
    ends = len(MOTIONS[kind])
    named = re.match(r"\w+(?=\s*(\\|$))", text[slice(*parts[ends + 2])]) if len(parts) > ends + 2 else None
    work = re.search(r"(?i)\\\s*WObj\s*(?::=\s*(\w+))?", words)
    if re.search(r"(?i)\\\s*Corr(?!\w)", words):
        raise CasacalError("a sensor corrects the path of the move", "Correct it by hand")
    if named is None or (work and not work[1]):
        raise CasacalError("the move's tool or work object is not named", "Write target, speed, zone, tool")
    tool, base = None, None
    if kind != "absj":
        base = draft.frame("base", work[1] if work else "wobj0")
        tool = draft.frame("tool", named[0])
        if shift is not None:
            raise CasacalError(f"line {shift} shifts the program", "Take the shift out before it is corrected")
    else:
        tool = draft.known(named[0])
    for target, motion in zip([_at(draft, text, parts[i]) for i in range(ends)], MOTIONS[kind], strict=True):
        if (target.kind == "joints") != (kind == "absj"):
            raise CasacalError(f"'{target.name}' is no target of such a move", "Name one of its kind")
        draft.move((0, mark.start()), motion, target, base, tool)


def _at(draft: Draft, text: str, span: tuple[int, int]) -> Target:
    """The target that an argument names or holds."""
    words = text[slice(*span)].partition("\\")[0].strip()
    if words.startswith("["):
        return _target(draft, "[...]", nested(text, span[0])[0])
    if not re.fullmatch(r"\w+", words):
        raise CasacalError(f"the target {' '.join(words.split())[:40]} is computed at run time", NUMBERS)
    return draft.named(words)
