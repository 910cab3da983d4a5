"""Yaskawa INFORM jobs (.jbi): C positions as pulses, degrees or X Y Z Rx Ry Rz with RCONF; MOVJ, MOVL, MOVC, MOVS.

Source: Yaskawa Electric, NX100 Options: instructions for data transmission function (HW0481924), chapter Job Data
Format; and Teaching, section Manipulator Types, for RCONF.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from casacal.errors import CasacalError
from casacal.programs.draft import Draft, Span
from casacal.programs.program import DEGREE, Form, Given, Motion, Target, TaughtProgram
from casacal.values import Array

FORM = Form(1.0, "xyz", (3, 4), "X,Y,Z,RX,RY,RZ in mm and degrees")
JOINT_DIGITS = 4
ASIDE = r"(?m)^[ \t]*'[^\r\n]*|//NAME[^\r\n]*|///COMM[^\r\n]*"
HEAD = re.compile(r"(?m)^///(POSTYPE|TOOL|USER|RCONF)\b[ \t]*([^\r\n]*)")
POINT = re.compile(r"(?m)^(C\d+)[ \t]*=[ \t]*([^\r\n]*)")
MOVES = re.compile(r"(?m)^[ \t]*(?:\d{4}[ \t]+)?(MOV[JLCS])\b[ \t]*([^\r\n]*)")
OTHERS = re.compile(
    r"(?m)^[ \t]*(?:\d{4}[ \t]+)?(IMOV|EIMOV[LC]|REFP|SMOV\w*|MFRAME|ARCSHIFT|MOV[JLCS]\w+|SFTON|SETTOOL|SETUSER)\b"
)
SHIFTS = re.compile(r"(?m)^[ \t]*(?:\d{4}[ \t]+)?(SFTON|SFTOF)\b")
MOTIONS: Mapping[str, Motion] = {"MOVJ": "joint", "MOVL": "linear", "MOVC": "via", "MOVS": "spline"}


def configuration(joints: Array, bits: Array) -> Array:
    """No-flip (axis R turned over), lower arm, rear; then whether axes R, T and S are beyond half a turn."""
    flipped = np.cos(joints[:, 3]) < 0
    beyond = np.clip(np.ceil(np.abs(joints[:, [3, 5, 0]]) / np.pi) - 1, 0, 2)  # two turns it cannot say
    return np.column_stack([flipped, bits[:, 1], bits[:, 0], beyond]).astype(int)


def read(files: Mapping[str, str], given: Given) -> TaughtProgram:
    """Read a job."""
    draft = Draft("yaskawa", FORM, files, given, ASIDE)
    text = draft.texts[0]
    found = re.search(r"(?m)^//INST\b", text)
    inst = found.start() if found else len(text)
    state, frames = {"POSTYPE": "PULSE", "TOOL": "", "USER": "", "RCONF": ""}, dict[str, dict[str, str]]()
    for mark in sorted([*HEAD.finditer(text, 0, inst), *POINT.finditer(text, 0, inst)], key=lambda mark: mark.start()):
        if mark.re is HEAD:
            state = state | {mark[1]: mark[2].strip().upper()}
        else:
            frames[mark[1]] = state
            draft.define(mark[1], lambda mark=mark, state=state: _target(draft, mark, state))  # type: ignore[misc]
    shift = None
    for mark in sorted([*MOVES.finditer(text, inst), *SHIFTS.finditer(text, inst)], key=lambda mark: mark.start()):
        if mark.re is SHIFTS:
            shift = draft.line(0, mark.start(1)) if mark[1] == "SFTON" else None
            continue
        with draft.understanding(0, mark.start(1)):
            if shift is not None:
                raise CasacalError(f"line {shift} shifts the job", "Take the shift out before it is corrected")
            _move(draft, mark, frames)
    draft.refuse(0, OTHERS)
    return draft.finished()


def _target(draft: Draft, mark: re.Match[str], state: Mapping[str, str]) -> Target:
    """A position of the arm with six joints."""
    spans: list[Span] = [
        (mark.start(2) + each.start(), mark.start(2) + each.end()) for each in re.finditer(r"[^,\s]+", mark[2])
    ]
    if state["POSTYPE"] == "ANGLE":
        return draft.joints(0, spans, mark[1], JOINT_DIGITS)
    if state["POSTYPE"] == "PULSE":
        if (pulses := draft.given.pulses) is None:
            fix = "Give --pulses S,L,U,R,B,T, pulses per degree"
            raise CasacalError("it stands in pulses, and how many make a degree is not known", fix)
        made = draft.joints(0, spans, mark[1], -1)
        numbers = zip(made.numbers, pulses, strict=True)
        return replace(made, numbers=tuple(replace(number, unit=DEGREE / each) for number, each in numbers))
    stated = [part.strip() for part in state["RCONF"].split(",")]
    if state["POSTYPE"] not in ("ROBOT", "BASE", "USER") or len(stated) < 6 or not set(stated[:6]) <= {"0", "1"}:
        raise CasacalError("its POSTYPE or its RCONF is not understood", "Write them as the controller does")
    return draft.pose(0, spans, mark[1], tuple(int(part) for part in stated[:6]))


def _move(draft: Draft, mark: re.Match[str], frames: Mapping[str, Mapping[str, str]]) -> None:
    words = mark[2].upper().split() or ["nothing"]
    if not re.fullmatch(r"C\d+", words[0]):
        raise CasacalError(f"the target {words[0][:30]} is a variable or computed", "Teach it in the job")
    if any(re.fullmatch(r"(BC|EC|BP|EX)\d+|\+MOV\w", word) for word in words[1:]):
        raise CasacalError("another machine moves with the arm", "Correct it by hand")
    target, base, tool = draft.named(words[0]), None, None
    if target.kind == "pose":
        state = frames[words[0]]
        base = draft.frame("base", f"USER{state['USER']}") if state["POSTYPE"] == "USER" else np.eye(4)
        tool = draft.frame("tool", f"TOOL{state['TOOL']}")
    draft.move((0, mark.start(1)), MOTIONS[mark[1]], target, base, tool)
