"""KRL (KUKA): POS, E6POS, FRAME, AXIS, E6AXIS in a .src and its .dat; PTP, LIN, CIRC, SPTP, SLIN, SCIRC, SPL.

Source: KUKA Roboter, KUKA System Software 8.3, Operating and Programming Instructions for System Integrators: the
chapters on motion programming, on Status and Turn, and on inline forms, with FDAT, $TOOL and $BASE.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Literal

import numpy as np

from casacal.programs.program import (
    DEGREE,
    Draft,
    Form,
    Given,
    Motion,
    Number,
    Program,
    Target,
    blanked,
    covered,
    nested,
    spans_of,
)
from casacal.values import Array

FORM = Form(1.0, "zyx", (3, 4), "X,Y,Z,A,B,C in mm and degrees")
JOINT_DIGITS = 5
ASIDE = r'"[^"\r\n]*"|;[^\r\n]*'
ASSIGNED = re.compile(
    r"(?im)^[ \t]*(?:(?:GLOBAL|DECL|CONST)[ \t]+)*(?:\w+[ \t]+)?(\$?\w+(?:\[[^\]\r\n]*\])?)((?:\.\w+)*)[ \t]*"
    r"=(?!=)[ \t]*([^\r\n]*)"
)
MOVES = re.compile(r"(?im)^[ \t]*(S?PTP|S?LIN|S?CIRC|SPL)[ \t]+([^\r\n]*)")
OTHERS = re.compile(r"(?im)^[ \t]*((?:S?PTP|S?LIN|S?CIRC)_\w+|ASYPTP|SEARCH\w*|(?:PTP|LIN|CIRC)_OFFS)\b")
FRAMES = re.compile(r"(?i)BAS[ \t]*\([ \t]*#(TOOL|BASE|EX_BASE)[ \t]*,[ \t]*([^)\r\n]*)\)")
CONTINUED = re.compile(r"(?<=,)[ \t]*\r?\n[ \t]*(?=\$)")
MOTIONS: Mapping[str, tuple[Motion, ...]] = {
    "PTP": ("joint",), "LIN": ("linear",), "CIRC": ("via", "end"), "SPL": ("spline",)
}  # fmt: skip
PARTS = ("X", "Y", "Z", "A", "B", "C")
AXES = ("A1", "A2", "A3", "A4", "A5", "A6")
UPRIGHT = (0.0, 0.0, 90.0, 0.0, 0.0, 0.0)
"""Posture (degrees) whose elbow counts as not turned: at zero the arm is stretched."""
UNSET = "the program does not set {} before this move"
Frames = dict[str, Array | str]


def configuration(joints: Array, bits: Array) -> Array:
    """Bits 0 and 1 of S: wrist behind axis 1, elbow as with A3 at 90 degrees; and of T: axes 1 to 6 below zero."""
    return np.column_stack([bits[:, 0], 1 - bits[:, 1], joints < 0]).astype(int)


def read(files: Mapping[str, str], given: Given) -> Program:
    """Read a .src, and the .dat beside it where there is one."""
    draft = Draft("krl", FORM, files, given)
    texts = [CONTINUED.sub(lambda found: " " * len(found[0]), blanked(text, ASIDE)) for text in draft.texts]
    targets, frames, data, spans = _values(draft, texts)
    for file, text in enumerate(texts):
        _moves(draft, file, text, targets, frames, data, spans[file])
    return draft.finished(each for each in targets.values() if isinstance(each, Target))


def _values(
    draft: Draft, texts: list[str]
) -> tuple[dict[str, Target | str], Frames, dict[str, dict[str, str]], list[list[tuple[int, int]]]]:
    """Targets, frames and FDAT by name in capitals, or why one has no value, and the spans of their lines by file."""
    targets, frames, data = dict[str, Target | str](), Frames({"$NULLFRAME": np.eye(4)}), dict[str, dict[str, str]]()
    spans = list[list[tuple[int, int]]]([] for _ in texts)
    for file, text in sorted(enumerate(texts), reverse=True):  # the .dat first
        for found in ASSIGNED.finditer(text):
            name, value = found[1].upper(), found[3]
            if name.startswith("$"):
                continue
            spans[file].append(found.span())
            if found[2] or (name in targets and value.strip()):
                targets[name] = frames[name] = f"'{found[1]}' is set again at run time"
                continue
            if not value.startswith("{"):
                targets[name] = frames[name] = f"'{found[1]}' is computed at run time"
                continue
            if "[" in name:
                draft.framed.add(name.lower())
            try:
                parts = _structure(text, found.start(3), found.end())
                if "TOOL_NO" in parts or "BASE_NO" in parts:
                    data[name] = {key: draft.texts[file][slice(*span)] for key, span in parts.items()}
                    continue
                targets[name] = _target(draft, file, found[1], found.start(3), parts)
                frames[name] = _frame(draft, file, parts)
            except ValueError as error:
                targets.setdefault(name, f"'{found[1]}' is not understood: {error}")
                frames[name] = f"'{found[1]}' is not understood: {error}"
    return targets, frames, data, spans


def _structure(text: str, start: int, end: int) -> dict[str, tuple[int, int]]:
    """Spans of the values in {X 1, Y 2, ...} by name in capitals; raises ValueError for what is no such."""
    tree, last = nested(text, start, "{}")
    if text[last:end].strip():
        raise ValueError("it is computed")
    parts = dict[str, tuple[int, int]]()
    for left, right in spans_of(tree):
        found = re.fullmatch(r"(?is)(?:\w+\s*:\s*)?([A-Z_]\w*(?:\[\])?)\s+(\S.*)", text[left:right])
        found = found or re.fullmatch(r"(?is)([A-Z_]\w*(?:\[\])?)()", text[left:right])
        if found is None or found[1].upper() in parts:
            raise ValueError("it is no structure of names and values")
        parts[found[1].upper()] = (left + found.start(2), left + found.end(2))
    return parts


def _target(draft: Draft, file: int, name: str, at: int, parts: Mapping[str, tuple[int, int]]) -> Target:
    """A POS, E6POS, FRAME, AXIS or E6AXIS; raises ValueError for anything else."""
    line = draft.line(file, at)
    if "A1" in parts:
        if missing := [each for each in AXES if each not in parts]:
            raise ValueError(f"it leaves {missing[0]} as it is")
        spans = [parts[each] for each in AXES]
        return Target(name, file, line, "joints", draft.joint_numbers(file, spans, DEGREE, JOINT_DIGITS))
    if missing := [each for each in PARTS if each not in parts]:
        raise ValueError(f"it leaves {missing[0]} as it is")
    numbers = draft.pose_numbers(file, [parts[each] for each in PARTS])
    for each in ("E1", "E2", "E3", "E4", "E5", "E6"):
        if each in parts and draft.number(file, parts[each]).value:
            raise ValueError(f"the external axis {each} moves with it, and where that puts arm or work is not known")
    status = _bits(draft, file, parts.get("S"), 3)
    turn = _bits(draft, file, parts.get("T"), 6)
    turns = ((turn[0], tuple(range(2, 8))),) if turn else ()
    config = (*((status[1] & 1, status[1] >> 1 & 1) if status else (None, None)),)
    config += tuple(turn[1] >> i & 1 for i in range(6)) if turn else (None,) * 6
    return Target(name, file, line, "pose", numbers, config, turns)


def _bits(draft: Draft, file: int, span: tuple[int, int] | None, count: int) -> tuple[Number, int] | None:
    """Status or Turn as a number; raises ValueError for what is none, or not decimal."""
    if span is None:
        return None
    number = draft.number(file, span)
    if not number.value.is_integer() or not 0 <= number.value < 1 << (count + 2):
        raise ValueError(f"Status or Turn is {number.value:g}, which no arm with six turning joints has")
    return number, int(number.value)


def _frame(draft: Draft, file: int, parts: Mapping[str, tuple[int, int]]) -> Array | str:
    """The transform of a structure, or why it has none."""
    if any(each not in parts for each in PARTS):
        return "it is no frame"
    return draft.transform(file, [parts[each] for each in PARTS])


def _moves(
    draft: Draft,
    file: int,
    text: str,
    targets: Mapping[str, Target | str],
    frames: Frames,
    data: Mapping[str, dict[str, str]],
    spans: list[tuple[int, int]],
) -> None:
    """Note the moves of a file, with what $TOOL and $BASE are where they stand."""
    force: dict[str, Array | str] = {kind: _start(draft, kind) for kind in ("tool", "base")}
    act = ""
    marks = [*MOVES.finditer(text), *FRAMES.finditer(text), *ASSIGNED.finditer(text), *OTHERS.finditer(text)]
    for mark in sorted(marks, key=lambda mark: mark.start()):
        if mark.re is MOVES:
            spans.append(mark.span())
            _move(draft, file, text, mark, targets, dict(force) | _of_spline(draft, mark[2], frames, data))
        elif mark.re is OTHERS:
            draft.puzzle(
                file, mark.start(), f"{mark[1]} moves the arm in a way that is not understood", "Correct it by hand"
            )
        elif mark.re is FRAMES:
            kind: Literal["tool", "base"] = "tool" if mark[1].upper() == "TOOL" else "base"
            found = "the base moves with another machine" if mark[1].upper() == "EX_BASE" else mark[2]
            force[kind] = (
                found if "moves" in found else _named(draft, kind, f"{kind.upper()}_DATA[{mark[2].strip()}]", frames)
            )
        elif mark[1].upper() == "FDAT_ACT":
            act = mark[3].strip().upper()
            force |= _of_data(draft, act, frames, data)
        elif mark[1].upper() in ("$TOOL", "$BASE"):
            kind = "tool" if mark[1].upper() == "$TOOL" else "base"
            force[kind] = _set(draft, file, text, kind, mark, frames)
    inside = covered(len(text), spans)
    for found in re.finditer(r"(?<![\w.$#])\w+", text):
        if inside[found.start()] or not isinstance(targets.get(found[0].upper()), Target):
            continue
        if not re.compile(r"(?m)[ \t]*(\.|=|\r?$)").match(text, found.end()):
            what = f"what is done with the target '{found[0]}' here is not understood"
            draft.puzzle(file, found.start(), what, "Move to it with PTP, LIN, CIRC, SPTP, SLIN, SCIRC or SPL")


def _start(draft: Draft, kind: Literal["tool", "base"]) -> Array | str:
    given = draft.given.tools if kind == "tool" else draft.given.bases
    return given.get(f"${kind}", UNSET.format(f"${kind.upper()}"))


def _named(draft: Draft, kind: Literal["tool", "base"], name: str, frames: Frames) -> Array | str:
    """A frame by its name, or why it is not known."""
    numbered = re.fullmatch(r"(?i)(TOOL|BASE)_DATA\[\s*(\d+)\s*\]", name.strip())
    name = f"{numbered[1].upper()}_DATA[{int(numbered[2])}]" if numbered else name.strip().upper()
    if numbered and not int(numbered[2]) and name not in frames:
        return np.eye(4)  # number 0 is $NULLFRAME
    try:
        return draft.frame(kind, name, {key.lower(): value for key, value in frames.items() if key == name})
    except LookupError as error:
        return str(error.args[0])


def _of_data(draft: Draft, name: str, frames: Frames, data: Mapping[str, dict[str, str]]) -> Frames:
    """Tool and base of an FDAT."""
    found = data.get(name)
    if found is None or "TOOL_NO" not in found or "BASE_NO" not in found:
        return dict.fromkeys(("tool", "base"), f"'{name}' does not stand in the .dat with TOOL_NO and BASE_NO")
    if found.get("IPO_FRAME", "#BASE").strip().upper() != "#BASE":
        return dict.fromkeys(("tool", "base"), f"'{name}' has the robot hold the work")
    return {
        "tool": _named(draft, "tool", f"TOOL_DATA[{found['TOOL_NO'].strip()}]", frames),
        "base": _named(draft, "base", f"BASE_DATA[{found['BASE_NO'].strip()}]", frames),
    }


def _of_spline(draft: Draft, words: str, frames: Frames, data: Mapping[str, dict[str, str]]) -> Frames:
    """Tool and base of an inline form: WITH ..., $TOOL = STOOL2(FP1), $BASE = SBASE(FP1.BASE_NO), ..."""
    if not re.search(r"(?i)\bWITH\b", words) or not re.search(r"(?i)\$(TOOL|BASE)\s*=", words):
        return {}
    found = re.search(r"(?i)\$TOOL\s*=\s*STOOL2?\s*\(\s*(\w+)", words)
    if found is None:
        return dict.fromkeys(("tool", "base"), "its WITH sets $TOOL or $BASE in a way that is not understood")
    return _of_data(draft, found[1].upper(), frames, data)


def _set(
    draft: Draft, file: int, text: str, kind: Literal["tool", "base"], mark: re.Match[str], frames: Frames
) -> Array | str:
    """What a line that sets $TOOL or $BASE makes it, or why that is not known."""
    if mark[2]:
        return f"line {draft.line(file, mark.start())} changes a part of {mark[1].upper()}"
    if mark[3].startswith("{"):
        try:
            return _frame(draft, file, _structure(text, mark.start(3), mark.end(3)))
        except ValueError as error:
            return f"{mark[1].upper()} in line {draft.line(file, mark.start())} is not understood: {error}"
    return _named(draft, kind, mark[3], frames)


def _move(
    draft: Draft,
    file: int,
    text: str,
    mark: re.Match[str],
    targets: Mapping[str, Target | str],
    force: Mapping[str, Array | str],
) -> None:
    """Note a move, or why it is not understood."""
    motions = MOTIONS[mark[1].upper().lstrip("S") if mark[1].upper() != "SPL" else "SPL"]
    at, end = mark.start(2), mark.end(2)
    found = list[Target]()
    try:
        for i in range(len(motions)):
            target, at = _target_at(draft, file, text, at, end, targets)
            found.append(target)
            if i + 1 < len(motions):
                comma = re.compile(r"\s*,\s*").match(text, at, end)
                if comma is None:
                    raise LookupError("a circle needs a point on its way and an end", "Write both")
                at = comma.end()
        if text[at:end].lstrip().startswith(":"):
            raise LookupError("the target is computed at run time", "Declare the shifted target with numbers")
        for kind in ("tool", "base"):
            if isinstance(words := force[kind], str) and any(target.kind == "pose" for target in found):
                wanted = re.search(r"\w+_DATA\[\d+\]", words, re.I)
                name = wanted[0].upper() if wanted else f"${kind.upper()}"
                raise LookupError(words, f"Give it: --{kind} '{name}={FORM.named}'")
    except LookupError as error:
        draft.puzzle(file, mark.start(), *error.args)
        return
    base, tool = (None if isinstance(force[kind], str) else force[kind] for kind in ("base", "tool"))
    for target, motion in zip(found, motions, strict=True):
        draft.move(file, mark.start(), motion, target, base, tool)  # type: ignore[arg-type]


def _target_at(
    draft: Draft, file: int, text: str, at: int, end: int, targets: Mapping[str, Target | str]
) -> tuple[Target, int]:
    """The target that stands at a place, and where it ends; LookupError with what is wrong and what to do."""
    fix = "Write it with all its numbers"
    if text[at : at + 1] == "{":
        try:
            _, last = nested(text, at, "{}")
            return _target(draft, file, "{...}", at, _structure(text, at, last)), last
        except ValueError as error:
            raise LookupError(f"the target is not understood: {error}", fix) from None
    named = re.compile(r"(\$?\w+)(\s*[\[.(])?").match(text, at, end)
    if named is None or named[2] or named[1].startswith("$"):
        raise LookupError(f"the target {text[at:end].strip()[:40]} is computed at run time", "Declare it with numbers")
    found = targets.get(named[1].upper(), f"the target '{named[1]}' is not in this program's files")
    if isinstance(found, str):
        raise LookupError(found, fix)
    return found, named.end(1)
