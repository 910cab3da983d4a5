"""KRL (KUKA): POS, E6POS, FRAME, AXIS, E6AXIS in a .src and its .dat; PTP, LIN, CIRC, SPTP, SLIN, SCIRC, SPL.

Source: KUKA Roboter, KUKA System Software 8.3, Operating and Programming Instructions for System Integrators: the
chapters on motion programming, on Status and Turn, and on inline forms, with FDAT, $TOOL and $BASE.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from casacal.errors import CasacalError
from casacal.programs.draft import EXTERNAL, IN_FORCE, NUMBERS, Draft, Kind, Span, Ways, nested, spans_of
from casacal.programs.program import Form, Given, Motion, Target, TaughtProgram
from casacal.values import Array

FORM = Form(1.0, "zyx", (3, 4), "X,Y,Z,A,B,C in mm and degrees")
UPRIGHT = (0.0, 0.0, 90.0, 0.0, 0.0, 0.0)
"""Posture (degrees) whose elbow counts as not turned: at zero the arm is stretched."""
JOINT_DIGITS = 5
ASIDE = r'"[^"\r\n]*"|;[^\r\n]*|(?<=,)[ \t]*\r?\n[ \t]*(?=\$)'  # also the line ends within a WITH
ASSIGNED = re.compile(
    r"(?im)^[ \t]*(?:(?:GLOBAL|DECL|CONST)[ \t]+)*(?:\w+[ \t]+)?(\$?\w+(?:\[[^\]\r\n]*\])?)((?:\.\w+)*)[ \t]*"
    r"=(?!=)[ \t]*([^\r\n]*)"
)
MOVES = re.compile(r"(?im)^[ \t]*S?(PTP|LIN|CIRC|(?<=S)PL)[ \t]+([^\r\n]*)")
SPLINES = re.compile(r"(?im)^[ \t]*(END|PTP_|)SPLINE(?!\w)([^\r\n]*)")
OTHERS = re.compile(
    r"(?im)(?:^[ \t]*|\bWITH\b[^\r\n]*?)((?:S?PTP|S?LIN|S?CIRC)_\w+|ASYPTP|SEARCH\w*|\$IPO_MODE[ \t]*=[ \t]*#TCP|"
    r"\$ACT_(?:TOOL|BASE)(?=[ \t]*=)|ANIN[ \t]+ON)(?!\w)"
)
OWN = re.compile(r"(?i)\bWITH\b.*\$(TOOL|BASE)\s*=")  # frames of a move or a block alone: $TOOL = STOOL2(FP1), ...
SETS = re.compile(r"(?i)BAS[ \t]*\([ \t]*#(TOOL|BASE|EX_BASE)[ \t]*,[ \t]*([^)\r\n]*)\)")
MOTIONS: Mapping[str, tuple[Motion, ...]] = {
    "PTP": ("joint",), "LIN": ("linear",), "CIRC": ("via", "end"), "PL": ("spline",)
}  # fmt: skip
PARTS = ("X", "Y", "Z", "A", "B", "C")
AXES = ("A1", "A2", "A3", "A4", "A5", "A6")
KINDS: tuple[Kind, Kind] = ("tool", "base")
WAYS = Ways(
    opens=re.compile(r"(?im)^[ \t]*(?:GLOBAL[ \t]+)?(?:DEF|DEFFCT|IF|FOR|WHILE|LOOP|REPEAT|SWITCH)(?!\w)"),
    closes=re.compile(r"(?im)^[ \t]*(?:END|ENDFCT|ENDIF|ENDFOR|ENDWHILE|ENDLOOP|UNTIL|ENDSWITCH)(?!\w)"),
    turns=re.compile(r"(?im)^[ \t]*(?:ELSE|CASE|DEFAULT|GOTO)(?!\w)"),
    routine=re.compile(r"(?im)^[ \t]*(?:GLOBAL[ \t]+)?DEF(?:FCT[ \t]+\w+)?[ \t]+(\w+)"),
    apart=re.compile(r"(?i)(?<!\w)(?:INTERRUPT[ \t]+DECL|GLOBAL[ \t]+INTERRUPT|TRIGGER)(?!\w)"),
    jumps=re.compile(r"(?im)(?<![\w])GOTO[ \t]+(\w+)"),
    label=re.compile(r"(?im)^[ \t]*(\w+)[ \t]*:(?!=)"),
)


def configuration(joints: Array, bits: Array) -> Array:
    """Bits 0 and 1 of S: wrist behind axis 1, elbow as with A3 at 90 degrees; and of T: axes 1 to 6 below zero."""
    return np.column_stack([bits[:, 0], 1 - bits[:, 1], joints < 0]).astype(int)


def read(files: Mapping[str, str], given: Given) -> TaughtProgram:
    """Read a .src, and the .dat beside it where there is one."""
    draft = Draft("krl", FORM, files, given, ASIDE)
    draft.frames |= {"$nullframe": np.eye(4)}
    data = dict[str, dict[str, str]]()
    for file in reversed(range(len(files))):  # the .dat first
        for found in ASSIGNED.finditer(draft.texts[file]):
            if not found[1].startswith("$"):
                draft.see(file, found.span())
                if found[3]:
                    make = partial(_assigned, draft, file, found, data)
                    draft.define(found[1], make, part=bool(found[2]))
    for file in range(len(files)):
        _moves(draft, file, data)
        draft.refuse(file, OTHERS)
        draft.refuse_other_ways(file, WAYS)
        draft.refuse_other_uses(file, r"[ \t]*(\.|=|\r?\n)", "PTP, LIN, CIRC, SPTP, SLIN, SCIRC or SPL")
    return draft.finished()


def _assigned(draft: Draft, file: int, found: re.Match[str], data: dict[str, dict[str, str]]) -> Target:
    """What a line gives its name, a part of which may be set at run time."""
    if found[2] or not found[3].startswith("{"):
        raise CasacalError("it is computed at run time", NUMBERS)
    parts = _structure(draft, file, found.span(3))
    if "TOOL_NO" in parts:
        data[found[1].lower()] = {key: draft.raw[file][slice(*span)].strip().upper() for key, span in parts.items()}
    if "[" in found[1]:
        draft.framed.add(found[1].lower())
    return _target(draft, file, found[1], parts)


def _structure(draft: Draft, file: int, span: Span) -> dict[str, Span]:
    """Spans of the values in {X 1, Y 2, ...} by name in capitals."""
    text = draft.texts[file]
    tree, last = nested(text, span[0], "{}")
    if text[last : span[1]].strip():
        raise CasacalError("it is computed at run time", NUMBERS)
    parts = dict[str, Span]()
    for left, right in spans_of(tree):
        found = re.fullmatch(r"(?is)(?:\w+\s*:\s*)?([A-Z_]\w*(?:\[\])?)\s*((?<=\s)\S.*|\".*)?", text[left:right])
        if found is None or found[1].upper() in parts:
            raise CasacalError("it is no structure of names and values", NUMBERS)
        parts[found[1].upper()] = (left + found.start(2), left + found.end(2)) if found[2] else (right, right)
    return parts


def _target(draft: Draft, file: int, name: str, parts: Mapping[str, Span]) -> Target:
    """A POS, E6POS, FRAME, AXIS or E6AXIS."""
    wanted = AXES if "A1" in parts else PARTS
    if missing := [each for each in wanted if each not in parts]:
        raise CasacalError(f"it leaves {missing[0]} as it is", "Write all six numbers")
    if any(re.fullmatch("E[1-6]", each) and draft.number(file, parts[each]).value for each in parts):
        raise CasacalError(EXTERNAL, "Correct it by hand")
    if wanted is AXES:
        return draft.joints(file, [parts[each] for each in AXES], name, JOINT_DIGITS)
    status, turn = (draft.number(file, parts[each]) if each in parts else None for each in "ST")
    for each in (status, turn):
        if each is not None and (not each.value.is_integer() or not 0 <= each.value < 64):
            raise CasacalError("its Status or Turn is none of an arm with six turning joints", "Write S and T")
    config: tuple[int | None, ...] = tuple(int(status.value) >> i & 1 for i in range(2)) if status else (None,) * 2
    config += tuple(int(turn.value) >> i & 1 for i in range(6)) if turn else (None,) * 6
    pose = draft.pose(file, [parts[each] for each in PARTS], name, config)
    return replace(pose, turns=((turn, tuple(range(2, 8))),) if turn else ())


def _moves(draft: Draft, file: int, data: Mapping[str, dict[str, str]]) -> None:
    """Note the moves of a file, with what $TOOL and $BASE are where they stand."""
    text = draft.texts[file]
    for kind in KINDS:
        draft.set_in_force(kind, partial(draft.frame, kind, f"${kind}"), (file, -1))
    marks = [*MOVES.finditer(text), *SETS.finditer(text), *ASSIGNED.finditer(text), *SPLINES.finditer(text)]
    before: dict[str, Array | CasacalError] | None = None  # a spline's own frames
    for mark in sorted(marks, key=lambda mark: mark.start()):
        word = mark[1].upper()
        if mark.re is SPLINES:
            if before is not None:
                draft.frames, before = before, None
            if word != "END" and OWN.search(mark[2]):
                before = dict(draft.frames)
                _set_by(draft, _of_spline(mark[2]), data)
        elif mark.re is MOVES:
            draft.see(file, mark.span())
            with draft.understanding(file, mark.start()):
                _move(draft, file, mark, data, own=before is not None)
        elif mark.re is SETS:
            for kind in KINDS:
                if word.endswith(kind.upper()):
                    name = f"{word}_DATA[{mark[2].strip()}]"
                    draft.set_in_force(kind, partial(_frame, draft, kind, name), (file, mark.start()))
        elif word == "FDAT_ACT":
            _set_by(draft, mark[3].strip(), data, (file, mark.start()))
        elif word in ("$TOOL", "$BASE"):
            kind = "tool" if word == "$TOOL" else "base"
            draft.set_in_force(kind, partial(_set, draft, file, mark), (file, mark.start()))


def _frame(draft: Draft, kind: Kind, name: str) -> Array:
    """A frame by its name; of numbers 0 is $NULLFRAME."""
    numbered = re.fullmatch(r"(?i)(TOOL|BASE)_DATA\[\s*0*(\d+)\s*\]", name)
    if numbered and numbered[2] == "0" and name.lower() not in draft.names:
        return np.eye(4)
    return draft.frame(kind, f"{numbered[1].upper()}_DATA[{numbered[2]}]" if numbered else name)


def _set(draft: Draft, file: int, mark: re.Match[str]) -> Array:
    """What a line makes $TOOL or $BASE."""
    if mark[2]:
        raise CasacalError(f"line {draft.line(file, mark.start())} changes a part of {mark[1].upper()}", NUMBERS)
    if mark[3].startswith("{"):
        return FORM.pose(_target(draft, file, mark[1], _structure(draft, file, mark.span(3))).values[:6])
    return _frame(draft, "tool" if mark[1].upper() == "$TOOL" else "base", mark[3].strip())


def _set_by(draft: Draft, name: str, data: Mapping[str, dict[str, str]], at: Span | None = None) -> None:
    """Let the frames of an FDAT be $TOOL and $BASE."""

    def numbered(kind: Kind) -> Array:
        found = data.get(name.lower(), {})
        number = found.get(f"{kind.upper()}_NO")
        if number is None or found.get("IPO_FRAME", "#BASE") != "#BASE":
            what = f"'{name}' does not stand in the .dat with tool and base, or the robot holds the work"
            raise CasacalError(what, "Correct such moves by hand")
        return _frame(draft, kind, f"{kind.upper()}_DATA[{number}]")

    for kind in KINDS:
        draft.set_in_force(kind, partial(numbered, kind), at)


def _of_spline(words: str) -> str:
    """Name of the FDAT by which a WITH sets its frames."""
    found = re.search(r"(?i)\$TOOL\s*=\s*STOOL2?\s*\(\s*(\w+)", words)
    return found[1] if found else "its WITH"


def _move(draft: Draft, file: int, mark: re.Match[str], data: Mapping[str, dict[str, str]], *, own: bool) -> None:
    """Note a move; own: whether its block says itself which frames are its own."""
    motions, at, kept = MOTIONS[mark[1].upper()], mark.start(2), dict(draft.frames)
    targets = list[Target]()
    for i in range(len(motions)):
        comma = re.compile(r"\s*,\s*" if i else "").match(draft.texts[file], at, mark.end(2))
        if comma is None:
            raise CasacalError("a circle needs a point on its way and an end", "Write both")
        target, at = _at(draft, file, comma.end(), mark.end(2))
        targets.append(target)
    if draft.texts[file][at : mark.end(2)].lstrip().startswith(":"):
        raise CasacalError("the target is computed at run time", NUMBERS)
    if OWN.search(mark[2]):
        own = True
        _set_by(draft, _of_spline(mark[2]), data)
    try:
        for target, motion in zip(targets, motions, strict=True):
            look = draft.frame if target.kind == "pose" else lambda _, name: draft.known(name)
            base, tool = (look(kind, IN_FORCE[kind]) for kind in ("base", "tool"))
            draft.move((file, mark.start()), motion, target, base, tool)
        if own:
            draft.posed = [each for each in draft.posed if each != (file, mark.start())]
    finally:
        draft.frames = kept


def _at(draft: Draft, file: int, at: int, end: int) -> tuple[Target, int]:
    """The target that stands at a place, and where it ends."""
    text = draft.texts[file]
    if text[at : at + 1] == "{":
        last = nested(text, at, "{}")[1]
        return _target(draft, file, "{...}", _structure(draft, file, (at, last))), last
    named = re.compile(r"(\w+)(?![\w$])(?!\s*[\[.(])").match(text, at, end)
    if named is None:
        raise CasacalError(f"the target {text[at:end].strip()[:40]} is computed at run time", NUMBERS)
    return draft.named(named[1]), named.end(1)
