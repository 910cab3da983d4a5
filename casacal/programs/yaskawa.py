"""Yaskawa INFORM jobs (.jbi): C positions as pulses, degrees or X Y Z Rx Ry Rz with RCONF; MOVJ, MOVL, MOVC, MOVS.

Source: Yaskawa Electric, NX100 Options: instructions for data transmission function (HW0481924), chapter Job Data
Format; and Teaching, section Manipulator Types, for RCONF.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from casacal.programs.program import DEGREE, Draft, Form, Given, Motion, Number, Program, Target, blanked
from casacal.values import Array

FORM = Form(1.0, "xyz", (3, 4), "X,Y,Z,RX,RY,RZ in mm and degrees")
JOINT_DIGITS = 4
ASIDE = r"(?m)^[ \t]*'[^\r\n]*|//NAME[^\r\n]*|///COMM[^\r\n]*"
HEAD = re.compile(r"(?m)^///?(POSTYPE|TOOL|USER|RCONF|PULSE|RECTAN|ANGLE|INST|POS)\b[ \t]*([^\r\n]*)")
POINT = re.compile(r"(?m)^(B?P?E?[CPX]+\d+)[ \t]*=[ \t]*([^\r\n]*)")
MOVES = re.compile(r"(?m)^[ \t]*(?:\d{4}[ \t]+)?(MOV[JLCS])\b[ \t]*([^\r\n]*)")
OTHERS = re.compile(r"(?m)^[ \t]*(?:\d{4}[ \t]+)?(IMOV|REFP|SMOV\w*|MFRAME|ARCSHIFT|MOV[JLCS]\w+|SFTON|SFTOF)\b")
MOTIONS: Mapping[str, Motion] = {"MOVJ": "joint", "MOVL": "linear", "MOVC": "via", "MOVS": "spline"}


def configuration(joints: Array, bits: Array) -> Array:
    """No-flip (axis R turned over), lower arm, rear; then whether axes R, T and S are beyond half a turn."""
    flipped = np.cos(joints[:, 3]) < 0
    beyond = np.clip(np.ceil(np.abs(joints[:, [3, 5, 0]]) / np.pi) - 1, 0, 2)  # two turns it cannot say
    return np.column_stack([flipped, bits[:, 1], bits[:, 0], beyond]).astype(int)


def read(files: Mapping[str, str], given: Given) -> Program:
    """Read a job."""
    draft = Draft("yaskawa", FORM, files, given)
    text = blanked(draft.texts[0], ASIDE)
    inst = re.search(r"(?m)^//INST\b", text)
    if inst is None:
        return draft.finished(())
    targets, frames = dict[str, Target | str](), dict[str, tuple[str, str]]()
    state = {"POSTYPE": "PULSE", "TOOL": "", "USER": ""}
    conf: tuple[Number, ...] = ()
    marks = [*HEAD.finditer(text, 0, inst.start()), *POINT.finditer(text, 0, inst.start())]
    for mark in sorted(marks, key=lambda mark: mark.start()):
        if mark.re is HEAD:
            state[mark[1]] = mark[2].strip().upper()
            conf = _configuration(draft, mark) if mark[1] == "RCONF" else conf
            continue
        name = mark[1].upper()
        try:
            value: Target | str = _target(draft, mark, state, conf)
        except ValueError as error:
            value = f"{name} is not understood: {error}"
        targets[name] = f"{name} stands twice in //POS" if name in targets else value
        frames[name] = state["POSTYPE"] + " " + state["USER"], state["TOOL"]
    shifted = None
    for mark in sorted(
        [*MOVES.finditer(text, inst.end()), *OTHERS.finditer(text, inst.end())], key=lambda m: m.start()
    ):
        if mark.re is MOVES:
            _move(draft, mark, targets, frames, shifted)
        elif mark[1] == "SFTOF":
            shifted = None
        else:
            shifted = draft.line(0, mark.start()) if mark[1] == "SFTON" else shifted
            what = f"{mark[1]} moves or shifts the arm in a way that is not understood"
            draft.puzzle(0, mark.start(1), what, "Correct it by hand")
    return draft.finished(each for each in targets.values() if isinstance(each, Target))


def _configuration(draft: Draft, mark: re.Match[str]) -> tuple[Number, ...]:
    """The numbers of RCONF; none where these are not understood."""
    spans = [(mark.start(2) + each.start(), mark.start(2) + each.end()) for each in re.finditer(r"[^,\s]+", mark[2])]
    try:
        return tuple(draft.number(0, span) for span in spans[:6]) if len(spans) >= 6 else ()
    except ValueError:
        return ()


def _target(draft: Draft, mark: re.Match[str], state: Mapping[str, str], conf: tuple[Number, ...]) -> Target:
    """A position; raises ValueError for what is none of an arm with six joints."""
    name, line = mark[1].upper(), draft.line(0, mark.start())
    spans = [(mark.start(2) + each.start(), mark.start(2) + each.end()) for each in re.finditer(r"[^,\s]+", mark[2])]
    if state["POSTYPE"] in ("PULSE", "ANGLE"):
        if state["POSTYPE"] == "ANGLE":
            return Target(name, 0, line, "joints", draft.joint_numbers(0, spans, DEGREE, JOINT_DIGITS))
        if draft.given.pulses is None:
            raise ValueError("it stands in pulses, and how many make a degree is not known (--pulses)")
        numbers = draft.joint_numbers(0, spans, 1.0, -1)
        pulses = draft.given.pulses
        return Target(
            name,
            0,
            line,
            "joints",
            tuple(replace(n, unit=DEGREE / each) for n, each in zip(numbers, pulses, strict=True)),
        )
    if state["POSTYPE"] not in ("ROBOT", "BASE", "USER"):
        raise ValueError(f"its POSTYPE is {state['POSTYPE'] or 'missing'}")
    numbers = draft.pose_numbers(0, spans)
    if not conf or any(number.value not in (0, 1) for number in conf):
        raise ValueError("no RCONF of ones and zeros stands above it")
    return Target(name, 0, line, "pose", numbers, tuple(int(number.value) for number in conf))


def _move(
    draft: Draft,
    mark: re.Match[str],
    targets: Mapping[str, Target | str],
    frames: Mapping[str, tuple[str, str]],
    shifted: int | None,
) -> None:
    """Note a move, or why it is not understood."""
    words = mark[2].split()
    tool, base = None, None
    try:
        name = words[0].upper() if words else "nothing"
        if not re.fullmatch(r"C\d+", name):
            raise LookupError(f"the target {name[:30]} is a variable or computed", "Teach it in the job")
        if any(re.fullmatch(r"(BC|EC|BP|EX)\d+|\+MOV\w", word.upper()) for word in words[1:]):
            raise LookupError("another machine moves with the arm", "Correct it by hand")
        if shifted is not None:
            raise LookupError(f"line {shifted} shifts the job", "Take the shift out before it is corrected")
        target = targets.get(name, f"{name} does not stand in //POS")
        if isinstance(target, str):
            pulses = "--pulses" in target
            raise LookupError(target, "Give --pulses S,L,U,R,B,T, pulses per degree" if pulses else "Write it there")
        if target.kind == "pose":
            kind, number = frames[name][0].split(" ", 1)[0], frames[name][0].split(" ", 1)[1]
            base = draft.frame("base", f"USER{number}", {}) if kind == "USER" else np.eye(4)
            tool = draft.frame("tool", f"TOOL{frames[name][1]}", {})
    except LookupError as error:
        draft.puzzle(0, mark.start(1), *error.args)
        return
    draft.move(0, mark.start(1), MOTIONS[mark[1]], target, base, tool)
