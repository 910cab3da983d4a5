"""URScript (Universal Robots): movej, movel, movep, movec; poses p[...] in m with rotation vectors, joints in rad.

Source: Universal Robots, The URScript Programming Language, chapters Motion (movec, movej, movel, movep, set_tcp) and
Types. A pose names no posture: the controller takes the one nearest to where it comes from, so the move before does.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from casacal.programs.program import (
    DEGREE,
    Draft,
    Form,
    Given,
    Motion,
    Program,
    Target,
    arguments,
    blanked,
    covered,
    nested,
    spans_of,
)
from casacal.values import Array

FORM = Form(1000.0, "vector", (6, 6), "X,Y,Z,RX,RY,RZ in m and rad")
JOINT_DIGITS = {1.0: 7, DEGREE: 5}
ASIDE = r'"[^"\r\n]*"|#[^\r\n]*'
ASSIGNED = re.compile(r"(?m)(?<![\w.\[,(])(\w+)\s*(\[[^\]\r\n]*\])?\s*[-+*/]?=(?!=)\s*")
CALLS = re.compile(r"(?<![\w.])(\w+)\s*\(")
MOTIONS: Mapping[str, tuple[Motion, ...]] = {
    "movej": ("joint",), "movel": ("linear",), "movep": ("linear",), "movec": ("via", "end")
}  # fmt: skip
OTHERS = re.compile(
    r"servo[jcl]|speed[jl]\w*|force_mode|conveyor_\w+|set_conveyor\w*|path_offset_\w+|move[jlpc]_\w+|teach_mode"
)
QUIET = {
    "set_tcp", "get_inverse_kin", "get_inverse_kin_has_solution", "pose_trans", "pose_add", "pose_sub", "pose_inv",
    "pose_dist", "point_dist", "interpolate_pose", "textmsg", "popup", "str_cat", "to_str", "is_within_safety_limits",
}  # fmt: skip
"""Functions that only look at a pose."""
TCP = "tcp"


def configuration(joints: Array, _: Array) -> Array:
    """Entries of a pose: none."""
    return np.zeros((len(joints), 0), dtype=int)


def read(files: Mapping[str, str], given: Given) -> Program:
    """Read a script."""
    draft = Draft("urscript", FORM, files, given)
    text = blanked(draft.texts[0], ASIDE)
    calls = [(found, _end_of(text, found.end() - 1)) for found in CALLS.finditer(text)]
    named, spans = _assignments(draft, text, [(found.end(), end) for found, end in calls])
    tool: Array | str = given.tools.get(
        TCP, f"set_tcp does not stand before this move, so its tool '{TCP}' is not known"
    )
    for found, end in calls:
        word = found[1]
        if word == "set_tcp":
            tool = given.tools.get(TCP, _tool(draft, text, found.end(), end, named))
        elif word in MOTIONS:
            spans.append((found.start(), end))
            _move(draft, text, found, end, named, tool)
        elif OTHERS.fullmatch(word):
            draft.puzzle(
                0, found.start(), f"{word} moves the arm in a way that is not understood", "Correct it by hand"
            )
    inside = covered(len(text), spans)
    for found, end in calls:
        if inside[found.start()] or found[1] in QUIET:
            continue
        for name in re.findall(r"(?<![\w.])\w+", text[found.end() : end]):
            if isinstance(named.get(name), Target):
                what = f"what {found[1]} does with '{name}' is not understood"
                draft.puzzle(0, found.start(), what, "Move to it with movej, movel, movep or movec")
    return draft.finished(each for each in named.values() if isinstance(each, Target))


def _end_of(text: str, at: int) -> int:
    """Where the bracket that opens at a place closes, or the text ends."""
    depth = 0
    for found in re.compile(r"[()]").finditer(text, at):
        depth += 1 if found[0] == "(" else -1
        if not depth:
            return found.start()
    return len(text)


def _assignments(
    draft: Draft, text: str, calls: list[tuple[int, int]]
) -> tuple[dict[str, Target | str], list[tuple[int, int]]]:
    """Targets by name, or why one has no value, and the spans of their lines."""
    named, spans = dict[str, Target | str](), list[tuple[int, int]]()
    inside = covered(len(text), calls)
    for found in ASSIGNED.finditer(text):
        if inside[found.start()]:
            continue  # an argument by its name
        name, end = found[1], re.compile(r"[\r\n]|\Z").search(text, found.end())
        assert end is not None
        if name in named:
            named[name] = f"'{name}' is set more than once"
        elif found[2]:
            named[name] = f"'{name}' is set at run time"
        else:
            try:
                named[name] = _value(draft, text, (found.end(), end.start()), name)
            except ValueError:
                named[name] = f"'{name}' is computed at run time"
        spans.append((found.start(), end.start()))
    return named, spans


def _value(draft: Draft, text: str, span: tuple[int, int], name: str) -> Target:
    """The pose or the joint values that a span holds; raises ValueError where it holds neither."""
    start, end = span
    words = text[start:end].rstrip()
    pose = words.startswith("p[")
    if not pose and not words.startswith("["):
        raise ValueError("it is no list")
    tree, last = nested(text, start + pose)
    if text[last:end].strip():
        raise ValueError("it is computed")
    line, spans = draft.line(0, start), spans_of(tree)
    if pose:
        return Target(name, 0, line, "pose", draft.pose_numbers(0, spans))
    numbers = []
    for left, right in spans:
        turned = re.fullmatch(r"d2r\s*\(\s*(\S+?)\s*\)", text[left:right])
        unit = DEGREE if turned else 1.0
        inner = (left + turned.start(1), left + turned.end(1)) if turned else (left, right)
        numbers.append(draft.number(0, inner, unit, JOINT_DIGITS[unit]))
    if len(numbers) != 6:
        raise ValueError(f"here are {len(numbers)} joint values, not six")
    return Target(name, 0, line, "joints", tuple(numbers))


def _tool(draft: Draft, text: str, start: int, end: int, named: Mapping[str, Target | str]) -> Array | str:
    """The tool that set_tcp sets, or why it is not known."""
    first = arguments(text, start, end)[0]
    found = _at(draft, text, first, named)
    if isinstance(found, str):
        return f"the tool of set_tcp in line {draft.line(0, start)} is not known: {found}"
    if found.kind == "joints":
        return f"set_tcp in line {draft.line(0, start)} takes no pose"
    return FORM.pose(found.values)


def _at(draft: Draft, text: str, span: tuple[int, int], named: Mapping[str, Target | str]) -> Target | str:
    """What an argument names or holds, or why it is not known."""
    words = " ".join(text[slice(*span)].split())
    if re.fullmatch(r"[A-Za-z_]\w*", words):
        return named.get(words, f"the target '{words}' is not set in this file")
    try:
        return _value(draft, text, span, f"{words[:24]}{'...' if len(words) > 24 else ''}")
    except ValueError as error:
        written = words.startswith(("p[", "[")) and "plain" in str(error)
        return f"the target {words[:40]} is computed at run time" + (f": {error}" if written else "")


def _move(
    draft: Draft, text: str, call: re.Match[str], end: int, named: Mapping[str, Target | str], tool: Array | str
) -> None:
    """Note a move, or why it is not understood."""
    parts, word = arguments(text, call.end(), end), call[1]
    motions = MOTIONS[word]
    try:
        found = [_target(draft, text, span, named) for span in parts[: len(motions)]]
        if len(found) < len(motions):
            raise LookupError(f"{word} has too few arguments", "Write it with its targets")
        for _, base in found:
            if base is not None and isinstance(tool, str):
                raise LookupError(tool, f"Give it: --tool '{TCP}={FORM.named}'")
    except LookupError as error:
        draft.puzzle(0, call.start(), *error.args)
        return
    for (target, base), motion in zip(found, motions, strict=True):
        draft.move(0, call.start(), motion, target, base, None if isinstance(tool, str) else tool)


def _target(
    draft: Draft, text: str, span: tuple[int, int], named: Mapping[str, Target | str]
) -> tuple[Target, Array | None]:
    """A target and, for a pose, its base; raises LookupError with what is wrong and what to do."""
    words, near, base = text[slice(*span)], None, np.eye(4)
    if (inverse := re.match(r"get_inverse_kin\s*\(", words)) and words.endswith(")"):
        inner = arguments(text, span[0] + inverse.end(), span[1] - 1)
        for other in inner[1:]:
            hint = re.match(r"qnear\s*=\s*", text[slice(*other)])
            start = other[0] + (hint.end() if hint else 0)
            at = _at(draft, text, (start, other[1]), named)
            if isinstance(at, Target) and at.kind == "joints" and near is None:
                near = tuple(at.joints.tolist())
            elif near is None:
                raise LookupError("the posture that get_inverse_kin starts from is not known", "Give qnear as numbers")
        span = inner[0]
        words = text[slice(*span)]
    if (moved := re.match(r"pose_trans\s*\(", words)) and words.endswith(")"):
        inner = arguments(text, span[0] + moved.end(), span[1] - 1)
        frame = _at(draft, text, inner[0], named)
        name = text[slice(*inner[0])]
        known = FORM.pose(frame.values) if isinstance(frame, Target) and frame.kind == "pose" else str(frame)
        base = draft.frame("base", name, {name.lower(): known})
        if len(inner) != 2:
            raise LookupError("pose_trans has two arguments", "Write a frame and a pose")
        span = inner[1]
    found = _at(draft, text, span, named)
    if isinstance(found, str):
        raise LookupError(found, "Write it with plain numbers")
    if found.kind == "joints":
        return found, None
    return replace(found, near=near), base
