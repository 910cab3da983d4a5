"""URScript (Universal Robots): movej, movel, movep, movec; poses p[...] in m with rotation vectors, joints in rad.

Source: Universal Robots, The URScript Programming Language, chapters Motion (movec, movej, movel, movep, set_tcp) and
Types. A pose names no posture: the controller takes the one nearest to where it comes from, so the move before does.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from casacal.errors import CasacalError
from casacal.programs.draft import IN_FORCE, NUMBERS, Draft, Span, Ways, arguments, nested, spans_of
from casacal.programs.program import DEGREE, Form, Given, Motion, Target, TaughtProgram
from casacal.values import Array

FORM = Form(1000.0, "vector", (6, 6), "X,Y,Z,RX,RY,RZ in m and rad")
ASIDE = r'"[^"\r\n]*"|#[^\r\n]*'
ASSIGNED = re.compile(r"(?m)(?<![\w.\[,(])(\w+)\s*(\[[^\]\r\n]*\])?\s*[-+*/]?=(?!=)[ \t]*([^\r\n]*)")
CALLS = re.compile(r"(?<![\w.])(\w+)\s*\(")
MOTIONS: Mapping[str, tuple[Motion, ...]] = {
    "movej": ("joint",), "movel": ("linear",), "movep": ("linear",), "movec": ("via", "end"),
    "optimovej": ("joint",), "optimovel": ("linear",),
}  # fmt: skip
OTHERS = re.compile(
    r"(?<![\w.])(servo[jcl]|speed[jl]\w*|force_mode|conveyor_\w+|path_offset_\w+|move[jlpc]_\w+|teach_mode|"
    r"(?!(?:move[jlpc]|optimove[jl])\b)\w*move\w*(?=\s*\(\s*p?\[))\s*\("
)
QUIET = re.compile(
    r"set_tcp|get_inverse_kin\w*|pose_\w+|point_dist|interpolate_pose|textmsg|popup|str_cat|to_str|is_within_\w+"
)
"""Functions that only look at a pose."""
TCP = "tcp"
WAYS = Ways(
    opens=re.compile(r"(?m)(?<![\w.])(?:def|thread|sec|if|while|for)(?!\w)"),
    closes=re.compile(r"(?<![\w.])end(?!\w)"),
    turns=re.compile(r"(?<![\w.])(?:elif|else)(?!\w)"),
    routine=re.compile(r"(?<![\w.])(?:def|thread|sec)\s+(\w+)"),
    apart=re.compile(r"(?<![\w.])(?:thread|run)(?!\w)"),
)


def configuration(joints: Array, _: Array) -> Array:
    """Entries of a pose: none."""
    return np.zeros((len(joints), 0), dtype=int)


def read(files: Mapping[str, str], given: Given) -> TaughtProgram:
    """Read a script."""
    draft = Draft("urscript", FORM, files, given, ASIDE)
    text = draft.texts[0]
    draft.set_in_force("tool", lambda: draft.frame("tool", TCP), (0, -1))
    calls = [(found, _end_of(text, found.end() - 1)) for found in CALLS.finditer(text)]
    inside = bytearray(len(text))
    for found, end in calls:
        inside[found.end() : end] = b"\x01" * (end - found.end())
    for found in ASSIGNED.finditer(text):
        if not inside[found.start()]:  # else an argument by its name
            draft.see(0, found.span())
            draft.define(found[1], lambda found=found: _assigned(draft, found))  # type: ignore[misc]
    for found, end in calls:
        with draft.understanding(0, found.start()):
            if found[1] == "set_tcp":
                first = arguments(text, found.end(), end)[0]
                make = partial(_tool, draft, first)
                draft.set_in_force("tool", make, (0, found.start()))
            elif found[1] in MOTIONS:
                draft.see(0, (found.start(), end))
                _move(draft, found, end)
        if QUIET.fullmatch(found[1]):
            draft.see(0, (found.start(), end))
    draft.refuse(0, OTHERS)
    draft.refuse_other_ways(0, WAYS)
    draft.refuse_other_uses(0, r"(?!.)", "movej, movel, movep or movec")
    return draft.finished()


def _end_of(text: str, at: int) -> int:
    """Where the bracket that opens at a place closes, or the text ends."""
    depth = 0
    for found in re.compile(r"[()]").finditer(text, at):
        depth += 1 if found[0] == "(" else -1
        if not depth:
            return found.start()
    return len(text)


def _assigned(draft: Draft, found: re.Match[str]) -> Target:
    if found[2]:
        raise CasacalError("a part of it is set at run time", NUMBERS)
    return _value(draft, found.span(3), found[1])


def _value(draft: Draft, span: Span, name: str) -> Target:
    """The pose or the joint values that a span holds."""
    text, (start, end) = draft.texts[0], span
    words = text[start:end].rstrip()
    pose = words.startswith("p[")
    tree, last = nested(text, start + pose) if pose or words.startswith("[") else ([], start)
    if not tree or text[last:end].strip():
        raise CasacalError(f"the target {words[:40]} is computed at run time", NUMBERS)
    spans = spans_of(tree)
    if pose:
        return draft.pose(0, spans, name)
    turned = [re.fullmatch(r"d2r\s*\(\s*(\S+?)\s*\)", text[left:right]) for left, right in spans]
    inner = [
        (left + d.start(1), left + d.end(1)) if d else (left, right)
        for d, (left, right) in zip(turned, spans, strict=True)
    ]
    made = draft.joints(0, inner, name, 7, 1.0)
    numbers = zip(made.numbers, turned, strict=True)
    return replace(made, numbers=tuple(replace(n, unit=DEGREE, least=5) if d else n for n, d in numbers))


def _at(draft: Draft, span: Span) -> Target:
    """What an argument names or holds."""
    words = draft.texts[0][slice(*span)]
    return draft.named(words) if re.fullmatch(r"[A-Za-z_]\w*", words) else _value(draft, span, words[:24])


def _tool(draft: Draft, span: Span) -> Array:
    """The transform that a pose stands for."""
    return FORM.pose(_pose(draft, span).values)


def _pose(draft: Draft, span: Span) -> Target:
    if (found := _at(draft, span)).kind == "joints":
        raise CasacalError(f"'{found.name}' is no pose", NUMBERS)
    return found


def _inner(draft: Draft, span: Span, name: str) -> list[Span]:
    """Arguments of a function where a span is a call of it; none where it is not."""
    text = draft.texts[0]
    found = re.match(rf"{name}\s*\(", text[slice(*span)])
    whole = found is not None and _end_of(text, span[0] + found.end() - 1) == span[1] - 1
    return arguments(text, span[0] + found.end(), span[1] - 1) if found and whole else []


def _move(draft: Draft, call: re.Match[str], end: int) -> None:
    parts, motions = arguments(draft.texts[0], call.end(), end), MOTIONS[call[1]]
    if len(parts) < len(motions):
        raise CasacalError(f"{call[1]} has too few targets", "Write it with its targets")
    ends = zip([_target(draft, span) for span in parts[: len(motions)]], motions, strict=True)
    for (target, base, own), motion in ends:
        tool = own
        if tool is None:
            tool = draft.frame("tool", IN_FORCE["tool"]) if target.kind == "pose" else draft.known(IN_FORCE["tool"])
        draft.move((0, call.start()), motion, target, base, tool)


HINTS = ("qnear", "maxPositionError", "maxOrientationError", "tcp")  # of get_inverse_kin, after the pose


def _target(draft: Draft, span: Span) -> tuple[Target, Array, Array | None]:
    """A target, its base, and a tool of its own if any.

    Of get_inverse_kin(pose, qnear, ..., tcp) it is the pose, of pose_trans(frame, pose) a pose in a frame.
    """
    near, base, tool = None, np.eye(4), None
    if inner := _inner(draft, span, "get_inverse_kin"):
        span, *hints = inner
        for k, (start, end) in enumerate(hints):
            named = re.match(r"(\w+)\s*=\s*", draft.texts[0][start:end])
            name = named[1] if named else HINTS[k] if k < len(HINTS) else ""
            value = (start + (named.end() if named else 0), end)
            if name not in HINTS:
                raise CasacalError(f"what get_inverse_kin is told by '{name}' is not understood", NUMBERS)
            if name == "qnear":
                near = tuple(_at(draft, value).joints.tolist())
            elif name == "tcp" and draft.raw[0][slice(*value)].strip("\"'") != "active_tcp":
                tool = _tool(draft, value)
    if len(inner := _inner(draft, span, "pose_trans")) == 2:
        words = draft.texts[0][slice(*inner[0])]
        base = draft.frame("base", words) if words.isidentifier() else FORM.pose(_pose(draft, inner[0]).values)
        return replace(_pose(draft, inner[1]), near=near), base, tool
    return replace(_at(draft, span), near=near), base, tool
