"""FANUC TP as .ls: P[n] with UF, UT and CONFIG, X Y Z W P R or J1 to J6; motions J, L, C and A.

Source: FANUC Robotics, R-30iB Operator's Manual, chapters Program Structure (motion instructions, position data and its
configuration) and the ASCII form of programs. On arms whose joint 3 is shown against the floor, J3 counts as the
problem's model has it: a robot function of J2 + J3 takes care of that, this file does not.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from casacal.programs.program import DEGREE, Draft, Form, Given, Motion, Program, Target, blanked
from casacal.values import Array

FORM = Form(1.0, "xyz", (3, 3), "X,Y,Z,W,P,R in mm and degrees")
JOINT_DIGITS = 3  # as the controller writes them
ASIDE = r"(?m)^[ \t]*\d*[ \t]*:[ \t]*(?:!|//|--)[^\r\n]*"  # remarks
BLOCK = re.compile(r"(?ms)^P\[\s*(\d+)\s*(?::[^\]\r\n]*)?\]\s*\{(.*?)\}")
MOVES = re.compile(r"(?m)^[ \t]*\d*[ \t]*:[ \t]*([JLCA])[ \t]+([^\r\n;]*(?:\r?\n[ \t]+:[ \t]+[^\r\n;]*)*)")
NAMED = re.compile(r"(P|PR)[ \t]*\[([^\]\r\n]*)\]")
MOTIONS: Mapping[str, tuple[Motion, ...]] = {"J": ("joint",), "L": ("linear",), "C": ("via", "end"), "A": ("end",)}
SHIFTED = re.compile(r"(?i)\b(Tool_Offset|Offset|INC|RTCP|COORD|VOFFSET|AP_LD|RT_LD|INDEV|EV)\b")
CONFIG = re.compile(r"CONFIG\s*:\s*'\s*([NF])\s*([UD])\s*([TB])\s*,\s*([+-]?\d+)\s*,\s*([+-]?\d+)\s*,\s*([+-]?\d+)\s*'")


def configuration(joints: Array, bits: Array) -> Array:
    """F rather than N (joint 5 not below zero), D rather than U, B rather than T, and turns of joints 1, 4 and 6."""
    turns = np.floor((joints[:, [0, 3, 5]] + np.pi) / (2 * np.pi))
    return np.column_stack([joints[:, 4] >= 0, bits[:, 1], bits[:, 0], turns]).astype(int)


def read(files: Mapping[str, str], given: Given) -> Program:
    """Read a program."""
    draft = Draft("fanuc", FORM, files, given)
    text = blanked(draft.texts[0], ASIDE)
    begin, pos = (re.search(rf"(?m)^/{word}\b", text) for word in ("MN", "POS"))
    if begin is None or pos is None:
        return draft.finished(())
    targets, orphans = dict[int, Target | str](), list[Target]()
    frames = dict[int, tuple[str, str]]()
    for block in BLOCK.finditer(text, pos.end()):
        number = int(block[1])
        try:
            value: Target | str = _target(draft, block, frames)
        except ValueError as error:
            value = f"P[{number}] is not understood: {error}"
        targets[number] = f"P[{number}] stands twice in /POS" if number in targets else value
        orphans += [value] if isinstance(value, Target) else []
    body = text[: pos.start()]
    for each in re.finditer(r"(?m)^[^\r\n]*?:[ \t]*P[ \t]*\[\s*(\d+)[^\]\r\n]*\]\s*=", body):
        targets[int(each[1])] = f"P[{each[1]}] is set again in line {draft.line(0, each.start())}"
    for mark in MOVES.finditer(body, begin.end()):
        _move(draft, mark, targets, frames)
    for other in re.finditer(r"(?m)^[^\r\n]*?:[ \t]*(S[ \t]+P\[|MOVE[ \t]+TO|MOVE_LINE|CALL_MOTION)", body):
        draft.puzzle(0, other.start(), "this moves the arm in a way that is not understood", "Correct it by hand")
    return draft.finished(orphans)


def _target(draft: Draft, block: re.Match[str], frames: dict[int, tuple[str, str]]) -> Target:
    """The first group of a position; raises ValueError where it is not understood."""
    text, start = block[2], block.start(2)
    group = re.search(r"(?s)GP1\s*:(.*?)(?=GP[2-9]\s*:|\Z)", text)
    if group is None:
        raise ValueError("it has no group GP1")
    name, line, at = f"P[{block[1]}]", draft.line(0, block.start()), start + group.start(1)
    parts = dict[str, tuple[int, int]]()
    for found in re.finditer(r"\b([XYZWPR]|J[1-9]|E[1-9])\s*=\s*(\S*)\s*(mm|deg)\b", group[1]):
        if found[1] in parts:
            raise ValueError(f"{found[1]} stands twice")
        parts[found[1]] = (at + found.start(2), at + found.end(2))
    if "J1" in parts:
        joints = [parts[each] for each in ("J1", "J2", "J3", "J4", "J5", "J6") if each in parts]
        if "J7" in parts:
            raise ValueError("it has more than six joints")
        return Target(name, 0, line, "joints", draft.joint_numbers(0, joints, DEGREE, JOINT_DIGITS))
    numbers = draft.pose_numbers(0, [parts[each] for each in "XYZWPR" if each in parts])
    if any(draft.number(0, span).value for each, span in parts.items() if each.startswith("E")):
        raise ValueError("an external axis moves with it, and where that puts arm or work is not known")
    config, named = CONFIG.search(group[1]), re.search(r"UF\s*:\s*(\S+?)\s*,\s*UT\s*:\s*(\S+?)\s*,", group[1])
    if config is None:
        raise ValueError("its CONFIG is not understood")
    if named is None or not (named[1] + named[2]).isdecimal():
        raise ValueError("its UF and UT are no numbers")
    frames[int(block[1])] = named[1], named[2]
    spans = [(at + config.start(i), at + config.end(i)) for i in (4, 5, 6)]
    turns = tuple((draft.number(0, span), (3 + i,)) for i, span in enumerate(spans))
    entries = tuple(int(number.value) for number, _ in turns)
    if max(map(abs, entries)) > MOST_TURNS:
        raise ValueError("its turns are none that an arm makes")
    return Target(
        name,
        0,
        line,
        "pose",
        numbers,
        (int(config[1] == "F"), int(config[2] == "D"), int(config[3] == "B"), *entries),
        turns,
    )


MOST_TURNS = 100


def _move(
    draft: Draft, mark: re.Match[str], targets: Mapping[int, Target | str], frames: Mapping[int, tuple[str, str]]
) -> None:
    """Note a move, or why it is not understood."""
    found, motions = list[Target](), MOTIONS[mark[1]]
    try:
        named = NAMED.findall(mark[2])
        if len(named) < len(motions):
            raise LookupError("a move has too few positions", "Write it with P[...]")
        if shift := SHIFTED.search(NAMED.sub("", mark[2])):
            raise LookupError(f"{shift[1]} shifts the target at run time", "Write the shifted position as a P[...]")
        for kind, inner in named[: len(motions)]:
            number = inner.partition(":")[0].strip()
            if kind == "PR" or not number.isdecimal() or len(number) > 9:
                raise LookupError(f"the target {kind}[{inner[:30]}] is a register", "Write it as a P[...] with numbers")
            target = targets.get(int(number), f"P[{number}] does not stand in /POS")
            if isinstance(target, str):
                raise LookupError(target, "Write its numbers there")
            found.append(target)
        poses = list[tuple[Array | None, Array | None]]()
        for target in found:
            frame, tool = frames.get(int(target.name[2:-1]), ("", ""))
            if target.kind == "joints":
                poses.append((None, None))
            else:
                known = {"uf0": np.eye(4), "ut0": np.eye(4)}
                poses.append(
                    (draft.frame("base", f"UF{int(frame)}", known), draft.frame("tool", f"UT{int(tool)}", known))
                )
    except LookupError as error:
        draft.puzzle(0, mark.start(), *error.args)
        return
    for target, motion, (base, tool_pose) in zip(found, motions, poses, strict=True):
        draft.move(0, mark.start(1), motion, target, base, tool_pose)
