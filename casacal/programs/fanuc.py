"""FANUC TP as .ls: P[n] with UF, UT and CONFIG, X Y Z W P R or J1 to J6; motions J, L, C and A.

Source: FANUC Robotics, R-30iB Operator's Manual, chapters Program Structure (motion instructions, position data and its
configuration) and the ASCII form of programs. On arms whose joint 3 is shown against the floor, J3 counts as the
problem's model has it: a robot function of J2 + J3 takes care of that, this file does not.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from casacal.errors import CasacalError
from casacal.programs.draft import EXTERNAL, NUMBERS, Draft, Span
from casacal.programs.program import Form, Given, Motion, Target, TaughtProgram
from casacal.values import Array

FORM = Form(1.0, "xyz", (3, 3), "X,Y,Z,W,P,R in mm and degrees")
JOINT_DIGITS = 3  # as the controller writes them
ASIDE = r"(?m)^[ \t]*\d*[ \t]*:[ \t]*(?:!|//|--)[^\r\n]*"  # remarks
BLOCK = re.compile(r"(?ms)^P\[\s*(\d{1,9})\s*(?::[^\]\r\n]*)?\]\s*\{(.*?)\}")
MOVES = re.compile(r"(?m)^[ \t]*\d*[ \t]*:[ \t]*([JLCA])[ \t]+([^\r\n;]*(?:\r?\n[ \t]+:[ \t]+[^\r\n;]*)*)")
SET = re.compile(r"(?m)^[^\r\n]*?:[ \t]*(P)[ \t]*\[\s*(\d+)[^\]\r\n]*\]\s*=")
NAMED = re.compile(r"(PR?)[ \t]*\[([^\]\r\n]*)\]")
OTHERS = re.compile(
    r"(?m)^[ \t]*\d*[ \t]*:[ \t]*(S(?=[ \t]+P\[)|MOVE[ \t]+TO|MOVE_LINE|CALL_MOTION|"
    r"Touch[ \t]+Offset(?![ \t]+End)|Search[ \t]+Start|Track[ \t]|UTOOL[ \t]*\[[^\r\n]*=|UFRAME[ \t]*\[[^\r\n]*=)"
)
MOTIONS: Mapping[str, tuple[Motion, ...]] = {"J": ("joint",), "L": ("linear",), "C": ("via", "end"), "A": ("end",)}
SHIFTED = re.compile(r"(?i)\b(Tool_Offset|Offset|INC|RTCP|VOFFSET|AP_LD|RT_LD|INDEV|EV)\b")
CONFIG = re.compile(r"'\s*([NF])\s*([UD])\s*([TB])\s*,\s*([+-]?\d\d?)\s*,\s*([+-]?\d\d?)\s*,\s*([+-]?\d\d?)\s*'")
ACTIVE = re.compile(r"(?im)^[ \t]*\d*[ \t]*:[ \t]*(UFRAME|UTOOL)_NUM[ \t]*=[ \t]*0*(\d+|R\[[^\]\r\n]*\])")
FRAMES = re.compile(r"UF\s*:\s*0*(\d+)\s*,\s*UT\s*:\s*0*(\d+)\s*,")


def configuration(joints: Array, bits: Array) -> Array:
    """F rather than N (joint 5 not below zero), D rather than U, B rather than T, and turns of joints 1, 4 and 6."""
    turns = np.floor((joints[:, [0, 3, 5]] + np.pi) / (2 * np.pi))
    return np.column_stack([joints[:, 4] >= 0, bits[:, 1], bits[:, 0], turns]).astype(int)


def read(files: Mapping[str, str], given: Given) -> TaughtProgram:
    """Read a program."""
    draft = Draft("fanuc", FORM, files, given, ASIDE)
    text = draft.texts[0]
    draft.frames |= {"uf0": np.eye(4), "ut0": np.eye(4)}
    pos = re.search(r"(?m)^/POS\b", text)
    frames = dict[str, tuple[str, str]]()
    for block in BLOCK.finditer(text, pos.end() if pos else len(text)):
        draft.define(f"P[{int(block[1])}]", lambda block=block: _target(draft, block, frames))  # type: ignore[misc]
    begin, end = re.search(r"(?m)^/MN\b", text), pos.start() if pos else len(text)
    for each in SET.finditer(text, 0, end):
        what = f"P[{each[2]}] is set again in line {draft.line(0, each.start(1))}"
        draft.names[f"p[{int(each[2])}]"] = CasacalError(what, NUMBERS)
    active = dict[str, str]()  # by the instructions UFRAME_NUM and UTOOL_NUM, in the order of the lines
    marks = [*MOVES.finditer(text, begin.end() if begin else end, end), *ACTIVE.finditer(text, 0, end)]
    for mark in sorted(marks, key=lambda mark: mark.start()):
        if mark.re is ACTIVE:
            active[mark[1].upper()] = mark[2]
            continue
        with draft.understanding(0, mark.start(1)):
            _move(draft, mark, frames, active)
    draft.refuse(0, OTHERS)
    return draft.finished()


def _target(draft: Draft, block: re.Match[str], frames: dict[str, tuple[str, str]]) -> Target:
    """The first group of a position."""
    group = re.search(r"(?s)GP1\s*:(.*?)(?=GP[2-9]\s*:|\Z)", block[2])
    if group is None:
        raise CasacalError("it has no group GP1", NUMBERS)
    other = re.search(r"GP[2-9]\s*:", block[2])
    if other and re.search(r"=\s*[-+]?0*\.?0*[1-9]", block[2][other.end() :]):
        raise CasacalError("another group moves with it, and where that puts arm or work is not known", NUMBERS)
    name, at, parts = f"P[{int(block[1])}]", block.start(2) + group.start(1), dict[str, Span]()
    for found in re.finditer(r"\b([XYZWPR]|J[1-9]|E[1-9])\s*=\s*(\S*)\s*(?:mm|deg)\b", group[1]):
        if found[1] in parts:
            raise CasacalError(f"{found[1]} stands twice", NUMBERS)
        parts[found[1]] = (at + found.start(2), at + found.end(2))
    if any(draft.number(0, span).value for each, span in parts.items() if each[0] == "E"):
        raise CasacalError(EXTERNAL, "Correct it by hand")
    if "J1" in parts:
        return draft.joints(0, [span for key, span in parts.items() if key[0] == "J"], name, JOINT_DIGITS)
    config, named = CONFIG.search(group[1]), FRAMES.search(group[1])
    if config is None or named is None:
        raise CasacalError("its UF, UT or CONFIG is not understood", "Write them as the controller does")
    frames[name] = f"UF{named[1]}", f"UT{named[2]}"
    turns = tuple((draft.number(0, (at + config.start(i), at + config.end(i))), (i - 1,)) for i in (4, 5, 6))
    entries = int(config[1] == "F"), int(config[2] == "D"), int(config[3] == "B"), *(int(n.value) for n, _ in turns)
    return replace(draft.pose(0, [parts[each] for each in "XYZWPR" if each in parts], name, entries), turns=turns)


def _move(draft: Draft, mark: re.Match[str], frames: Mapping[str, tuple[str, str]], active: Mapping[str, str]) -> None:
    named, motions = NAMED.findall(mark[2]), MOTIONS[mark[1]]
    if len(named) < len(motions):
        raise CasacalError("a move has too few positions", "Write it with P[...]")
    if re.search(r"(?i)\bCOORD\b", mark[2]):
        raise CasacalError("it moves together with another group", "Correct it by hand")
    if shift := SHIFTED.search(NAMED.sub("", mark[2])):
        raise CasacalError(f"{shift[1]} shifts the target at run time", "Write the shifted position as a P[...]")
    targets = list[Target]()
    for kind, inner in named[: len(motions)]:
        number = inner.partition(":")[0].strip()
        if kind == "PR" or not re.fullmatch(r"[0-9]{1,9}", number):
            shown = f"{kind}[{inner[:30]}{']' if '[' in inner else ''}]"
            known = "a register" if kind == "PR" or "R[" in inner else "no position of this program"
            raise CasacalError(f"the target {shown} is {known}", "Write it as a P[...] with numbers")
        targets.append(draft.named(f"P[{int(number)}]"))
    for target, motion in zip(targets, motions, strict=True):
        base, tool = None, None
        if target.kind == "pose":
            for name, kind in zip(frames[target.name], ("UFRAME", "UTOOL"), strict=True):
                if kind in active and active[kind] != name[2:]:
                    what = f"{target.name} stands in {name}, and {kind}_NUM is {active[kind]} here"
                    raise CasacalError(what, "Make them agree, as the controller asks")
            base, tool = (draft.frame(kind, frames[target.name][i]) for i, kind in enumerate(("base", "tool")))  # type: ignore[arg-type]
        draft.move((0, mark.start(1)), motion, target, base, tool)
