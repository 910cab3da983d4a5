"""RAPID (ABB): robtarget, jointtarget, tooldata, wobjdata; MoveAbsJ, MoveJ, MoveL, MoveC.

Source: ABB Robotics, Technical reference manual: RAPID Instructions, Functions and Data types (3HAC050917), on these
instructions and data types, and confdata for the quadrants and cfx.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from casacal.programs.program import (
    DEGREE,
    Draft,
    Form,
    Given,
    Motion,
    Program,
    Target,
    Tree,
    arguments,
    blanked,
    covered,
    nested,
    spans_of,
)
from casacal.values import Array

FORM = Form(1.0, "quaternion", (3, 7), "X,Y,Z,Q1,Q2,Q3,Q4 in mm and as a unit quaternion")
JOINT_DIGITS = 5
ASIDE = r'"(?:[^"\r\n]|"")*"|![^\r\n]*'  # strings and comments
DECLARED = re.compile(r"(?i)(?<![\w.\\])(robtarget|jointtarget|tooldata|wobjdata)\s+(\w+)\s*(\{[^}\r\n]*\})?\s*:=\s*")
MOVES = re.compile(r"(?i)(?<![\w.\\:])Move(AbsJ|J|L|C)(?:DO|AO|GO|Sync)?(?![\w:])([^;]*);")
OTHERS = re.compile(
    r"(?i)(?<![\w.\\:])(Trigg[JLC]|Trigg[JLC](?:IOs|DO)|Search[LC]|Arc[LC]\w*|Spot[JLM]\w*|Disp[LC]|Paint[LC]|CapL|"
    r"CSS\w+|EGMMove[LC]|EOffsOn|EOffsSet|PDispOn|PDispSet|MoveExtJ|MoveJ\w+|MoveL\w+|MoveC\w+|MoveAbsJ\w+)(?![\w:])"
)
KNOWN = re.compile(r"(?i)Move(?:AbsJ|J|L|C)(?:DO|AO|GO|Sync)?|MoveExtJ")
SHIFTS = re.compile(r"(?i)(?<![\w.\\:])(?:PDispOn|PDispSet|EOffsOn|EOffsSet|(PDispOff|EOffsOff))(?![\w:])")
NO_AXIS = 9e8  # 9E9 stands for an external axis that is not there
MOTIONS: Mapping[str, tuple[Motion, ...]] = {"absj": ("joint",), "j": ("joint",), "l": ("linear",), "c": ("via", "end")}


def configuration(joints: Array, bits: Array) -> Array:
    """Quadrants cf1, cf4, cf6, and the three bits of cfx: axis 5 negative, wrist behind lower arm, behind axis 1."""
    quadrants = np.floor(joints[:, [0, 3, 5]] / (np.pi / 2))
    return np.column_stack([quadrants, joints[:, 4] < 0, bits[:, 1], bits[:, 0]]).astype(int)


def read(files: Mapping[str, str], given: Given) -> Program:
    """Read a module."""
    draft = Draft("rapid", FORM, files, given)
    text = blanked(draft.texts[0], ASIDE)
    targets, frames, spans = _declarations(draft, text)
    changed = _assigned(text, spans)
    for name in changed & targets.keys():
        targets[name] = f"'{name}' is set again at run time"
    for name in changed & frames.keys():
        frames[name] = f"'{name}' is set again at run time"
    shift = None
    marks = sorted([*MOVES.finditer(text), *SHIFTS.finditer(text)], key=lambda mark: mark.start())
    for mark in marks:
        if mark.re is SHIFTS:
            shift = None if mark[1] else draft.line(0, mark.start())
        else:
            spans.append(mark.span())
            _move(draft, text, mark, targets, frames, shift)
    for other in OTHERS.finditer(text):
        if not KNOWN.fullmatch(other[1]):
            what = f"{other[1]} moves or shifts the arm in a way that is not understood"
            draft.puzzle(0, other.start(), what, "Correct its target by hand")
    _uses(draft, text, targets, spans)
    return draft.finished(each for each in targets.values() if isinstance(each, Target))


def _declarations(
    draft: Draft, text: str
) -> tuple[dict[str, Target | str], dict[str, Array | str], list[tuple[int, int]]]:
    """Targets and frames by name in small letters, or why one has no value, and the spans of their declarations."""
    targets, frames = dict[str, Target | str](), dict[str, Array | str]({"tool0": np.eye(4), "wobj0": np.eye(4)})
    spans = list[tuple[int, int]]()
    for found in DECLARED.finditer(text):
        kind, name = found[1].lower(), found[2]
        known: dict[str, Target | str] | dict[str, Array | str] = targets if kind.endswith("target") else frames
        end, value = found.end(), f"'{name}' is an array or computed"
        try:
            tree, end = nested(text, found.end()) if text[end : end + 1] == "[" and not found[3] else ([], end)
            if name.lower() in known:
                value = f"'{name}' is declared more than once"
            elif tree and kind.endswith("target"):
                targets[name.lower()] = _target(draft, name, kind, tree)
            elif tree:
                frames[name.lower()] = _frame(draft, kind, tree)
        except ValueError as error:
            value = f"'{name}' is not understood: {error}"
            tree = []
        if not tree or "more than once" in value:
            known[name.lower()] = value
        spans.append((found.start(), end))
    return targets, frames, spans


def _parts(tree: Tree, count: int) -> list[Tree]:
    if isinstance(tree, tuple) or len(tree) != count:
        raise ValueError(f"a list of {count} parts was expected")
    return tree


def _target(draft: Draft, name: str, kind: str, tree: list[Tree]) -> Target:
    """A robtarget or jointtarget; raises ValueError for what is none."""
    first = tree[0]
    while isinstance(first, list):
        if not first:
            raise ValueError("an empty list")
        first = first[0]
    line = draft.line(0, first[0])
    if kind == "jointtarget":
        joints, outer = _parts(tree, 2)
        spans_of(outer)
        return Target(name, 0, line, "joints", draft.joint_numbers(0, spans_of(joints), DEGREE, JOINT_DIGITS))
    place, turn, config, outer = _parts(tree, 4)
    numbers = draft.pose_numbers(0, [*spans_of(place), *spans_of(turn)])
    if any(abs(draft.number(0, span).value) < NO_AXIS and draft.number(0, span).value for span in spans_of(outer)):
        raise ValueError("an external axis moves with it, and where that puts arm or work is not known")
    quadrants = [draft.number(0, span) for span in spans_of(config)]
    if len(quadrants) != 4 or not all(each.value.is_integer() and abs(each.value) < 100 for each in quadrants):
        raise ValueError("its configuration is not four whole numbers")
    cf1, cf4, cf6, cfx = (int(each.value) for each in quadrants)
    if not 0 <= cfx <= 7:
        raise ValueError(f"cfx is {cfx}, which no arm with six turning joints has")
    turns = tuple((number, (i,)) for i, number in enumerate(quadrants[:3]))
    return Target(name, 0, line, "pose", numbers, (cf1, cf4, cf6, cfx & 1, cfx >> 1 & 1, cfx >> 2), turns)


def _frame(draft: Draft, kind: str, tree: list[Tree]) -> Array:
    """The transform of a tooldata or wobjdata; raises ValueError where what it says is not fixed in space."""
    held = tree[0]
    if not isinstance(held, tuple):
        raise ValueError("its first part is no truth value")
    robot_holds = draft.texts[0][slice(*held)].upper()

    def pose(tree: Tree) -> Array:
        place, turn = _parts(tree, 2)
        return draft.transform(0, [*spans_of(place), *spans_of(turn)])

    if kind == "tooldata":
        if robot_holds != "TRUE":
            raise ValueError("the tool stands still and the robot holds the work")
        return pose(_parts(tree, 3)[1])
    _, fixed, unit, user, work = _parts(tree, 5)
    if robot_holds != "FALSE" or not isinstance(fixed, tuple) or not isinstance(unit, tuple):
        raise ValueError("the robot holds the work object")
    if draft.texts[0][slice(*fixed)].upper() != "TRUE" or draft.texts[0][slice(*unit)] != '""':
        raise ValueError("a mechanical unit moves the work object")
    return np.asarray(pose(user) @ pose(work))


def _assigned(text: str, spans: list[tuple[int, int]]) -> set[str]:
    """Names, in small letters, that statements set."""
    inside = covered(len(text), spans)
    marks = re.finditer(r"(?<![\w.\\])(\w+)\s*(?:\.\w+|\{[^}\r\n]*\})*\s*:=", text)
    return {mark[1].lower() for mark in marks if not inside[mark.start()]}


def _move(
    draft: Draft,
    text: str,
    mark: re.Match[str],
    targets: Mapping[str, Target | str],
    frames: Mapping[str, Array | str],
    shift: int | None,
) -> None:
    """Note a move, or why it is not understood."""
    kind, begin = mark[1].lower(), mark.start()
    parts = [span for span in arguments(text, mark.start(2), mark.end(2)) if not text[slice(*span)].startswith("\\")]
    ends = len(MOTIONS[kind])
    try:
        if len(parts) < ends + 3:
            raise LookupError("the move has too few arguments", "Write it with target, speed, zone and tool")
        named = re.fullmatch(r"(?is)(\w+)(.*)", text[slice(*parts[ends + 2])])
        if named is None:
            raise LookupError("its tool is computed", "Name a tooldata")
        tool, base = None, None
        if kind != "absj":
            work = re.search(r"(?i)\\\s*WObj\s*:=\s*(\w+)", text[slice(*mark.span(2))])
            if work is None and re.search(r"(?i)\\\s*WObj", text[slice(*mark.span(2))]):
                raise LookupError("its work object is computed", "Name a wobjdata")
            base = draft.frame("base", work[1] if work else "wobj0", frames)
            tool = draft.frame("tool", named[1], frames)
        elif not isinstance(known := frames.get(named[1].lower(), ""), str):
            tool = known
        if shift is not None and kind != "absj":
            raise LookupError(f"line {shift} shifts the program", "Take the shift out before it is corrected")
        found = [_target_at(draft, text, span, kind, targets) for span in parts[:ends]]
    except LookupError as error:
        draft.puzzle(0, begin, *error.args)
        return
    for target, motion in zip(found, MOTIONS[kind], strict=True):
        draft.move(0, begin, motion, target, base, tool)


def _target_at(
    draft: Draft, text: str, span: tuple[int, int], kind: str, targets: Mapping[str, Target | str]
) -> Target:
    """The target that an argument names or holds; raises LookupError with what is wrong and what to do."""
    words = re.sub(r"(?is)\\.*", "", text[slice(*span)]).strip()
    wanted = "jointtarget" if kind == "absj" else "robtarget"
    if words.startswith("["):
        try:
            return _target(draft, words.partition(",")[0][:1] + "...]", wanted, nested(text, span[0])[0])
        except ValueError as error:
            raise LookupError(f"the target is not understood: {error}", f"Write a {wanted}") from None
    if not re.fullmatch(r"\w+", words):
        raise LookupError(
            f"the target {' '.join(words.split())[:40]} is computed at run time", "Declare it with numbers"
        )
    found = targets.get(words.lower(), f"the target '{words}' is not declared in this file")
    if isinstance(found, str):
        raise LookupError(found, f"Declare it here as a {wanted} with plain numbers")
    if (found.kind == "joints") != (kind == "absj"):
        raise LookupError(f"'{words}' is no {wanted}", f"Name a {wanted}")
    return found


def _uses(draft: Draft, text: str, targets: Mapping[str, Target | str], spans: list[tuple[int, int]]) -> None:
    """Note every other use of a target that could move the arm there."""
    inside = covered(len(text), spans)
    for found in re.finditer(r"(?<![\w.\\])\w+", text):
        if found[0].lower() not in targets or inside[found.start()]:
            continue
        if not text[found.end() : found.end() + 40].lstrip().startswith((".", ":=", "{")):
            what = f"what is done with the target '{found[0]}' here is not understood"
            draft.puzzle(0, found.start(), what, "Move to it with MoveAbsJ, MoveJ, MoveL or MoveC")
