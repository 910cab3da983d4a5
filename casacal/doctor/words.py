"""A diagnosis as text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from casacal.doctor.diagnosis import ENOUGH, Diagnosis
from casacal.doctor.pendant_rows import MEANINGS
from casacal.model.dh_file import conventions_toml
from casacal.model.joints import Conventions, Joint
from casacal.model.problem_text import conventions_line
from casacal.wording import figures

SHOWN = 4  # values of one setting that are listed when it is open


def diagnosis_text(found: Diagnosis, joints: Sequence[Joint] | None = None) -> str:
    """Report in plain text: certain findings, open ones, rows that would settle them, and the block for a DH file.

    joints: the robot's, needed where some slide.
    """
    if not found.meanings:
        return "\n".join(_nothing_fits(found)) + "\n"
    best = found.meanings[0]
    lines = [
        f"{len(found.rows)} rows of {found.rows.file}, different postures: {found.postures}",
        _verdict(found),
        *(f"  {line}" for line in _settings(found)),
    ]
    ways = len(best.conventions)
    if ways > 1:
        lines.append(
            f"Equivalent: {ways} ways to write it give the same pose at all joint values, as with the two branches of "
            f"a spherical wrist; the one with the fewest changes is given"
        )
    lines += [*_further(found, joints), ""]
    if not found.certain:
        lines.append("# not certain: the simplest of the conventions that fit")
    name, unit = min(best.rotations, key=lambda key: best.rotations[key])
    turned = f", orientations {name}{f' in {unit}' if unit else ''}"
    lines.append(f"# the pendant shows joints in {best.joint_unit}, lengths in {best.length_unit}{turned}")
    lines.append("# joint values of the problem = signs * (the controller's + coupling) + offsets")
    if best.simplest == Conventions.plain(len(best.simplest.signs)):
        lines.append("# nothing to change: the controller's joint values are those of the problem")
    else:
        shown = [Joint()] * len(best.simplest.signs) if joints is None else joints
        lines.append(f"# goes into a DH table in TOML, or into problem.py: {conventions_line(best.simplest, shown)}")
    if -1 in best.simplest.signs or any(best.simplest.offsets):
        lines.append(
            "# joint limits are the controller's from then on: sign * (limit - offset) of the problem's, which turn "
            "round where the sign is -1; leave limits that are the controller's already"
        )
    return "\n".join(lines) + "\n" + conventions_toml(best.simplest, joints)


def _verdict(found: Diagnosis) -> str:
    best = found.meanings[0]
    fit = f"{best.miss_mm:.2f} mm and {1e3 * min(best.rotations.values()):.2f} mrad at worst"
    if found.certain:
        return f"Certain: one convention fits, {fit} (tolerance {found.tolerance:g} mm and mrad)"
    if len(found.meanings) > 1 or found.more:
        count = f"{'at least ' if found.more else ''}{len(found.meanings)}"
        return f"Ambiguous: {count} conventions fit within {found.tolerance:g} mm and mrad; the simplest: {fit}"
    if found.postures < ENOUGH:
        return f"Not certain: one convention fits, {fit}, with {found.postures} different postures, not {ENOUGH}"
    return f"Ambiguous: one convention of the joints fits, {fit}, but {len(best.rotations)} of the orientation do"


def _settings(found: Diagnosis) -> Iterable[str]:
    """One line per joint, then units and orientation: the value, and whether it is certain or open."""
    first = found.meanings[0].simplest

    def differing(other: Conventions) -> int:
        return sum(_joint(other, i) != _joint(first, i) for i in range(len(first.signs)))

    # each meaning as it differs least from the first, so that only what is open differs
    written = [min(meaning.conventions, key=differing) for meaning in found.meanings]
    sure = found.postures >= ENOUGH and not found.more
    for i in range(len(first.signs)):
        yield f"joint {i + 1}: {_open([_joint(each, i) for each in written], sure)}"
    units = [f"joint values in {m.joint_unit}, lengths in {m.length_unit}" for m in found.meanings]
    yield _open(units, sure) + _stated(found)
    names = [f"{name} in {unit}" if unit else name for m in found.meanings for name, unit in m.rotations]
    yield f"orientation: {_open(names, sure)}"
    for name in dict.fromkeys(name for m in found.meanings for name, _ in m.rotations):
        yield f"  {name}: {MEANINGS[name]}"


def _stated(found: Diagnosis) -> str:
    """A remark where the column names state units that do not fit."""
    best, rows = found.meanings[0], found.rows
    wrong = []
    if rows.joint_unit not in ("", best.joint_unit):
        wrong.append(f"{rows.joint_unit} for joints")
    if rows.length_unit not in ("", best.length_unit):
        wrong.append(f"{rows.length_unit} for lengths")
    angle = {unit for _, unit in best.rotations} - {""}
    if rows.angle_unit and angle and rows.angle_unit not in angle:
        wrong.append(f"{rows.angle_unit} for orientations")
    return f"; the file's column names say {', '.join(wrong)}, which is wrong" if wrong else ""


def _joint(conventions: Conventions, i: int) -> str:
    """Settings of one joint (counted from 0) in words."""
    words = [f"sign {conventions.signs[i]:+d}", f"offset {math.degrees(conventions.offsets[i]):.0f} deg"]
    words += [
        f"measured against joint {j} (factor {factor:+.0f})" for k, j, factor in conventions.coupling if k == i + 1
    ]
    return ", ".join(words)


def _open(values: Sequence[str], sure: bool) -> str:
    """One value, or those between which the choice is open."""
    different = list(dict.fromkeys(values))
    if len(different) == 1:
        return different[0] + (" (certain)" if sure else "")
    more = f" or {len(different) - SHOWN} others" if len(different) > SHOWN else ""
    return f"open: {' or '.join(f'[{value}]' for value in different[:SHOWN])}{more}"


def _further(found: Diagnosis, joints: Sequence[Joint] | None) -> list[str]:
    pose, best = found.further, found.meanings[0]
    if pose is None:
        return []
    least = f"{figures(pose.least_mm)} mm and {figures(math.degrees(pose.least_rad))} deg"
    if pose.separates == 0:
        return [f"No posture distinguishes them: the closest two never differ by more than {least}"]
    turns = [joint.turns for joint in joints] if joints is not None else [True] * len(pose.joints)
    units = [best.joint_unit if turn else best.length_unit for turn in turns]
    values = ", ".join(
        f"q{i} = {each[0]:g} {each[1]}" for i, each in enumerate(zip(pose.joints, units, strict=True), 1)
    )
    if len({*units}) == 1:
        values = ", ".join(f"q{i} = {value:g}" for i, value in enumerate(pose.joints, 1)) + f" ({units[0]})"
    what = "the conventions that fit" if len(found.meanings) > 1 else "this convention and those next to it"
    all_or = "all" if pose.separates == 1 else f"{100 * pose.separates:.0f} % of"
    return [
        f"To settle it, move to {values}, if nothing is in the way, and add a row: it "
        f"distinguishes {all_or} pairs of {what}, the closest by {least}"
    ]


def _nothing_fits(found: Diagnosis) -> Iterable[str]:
    if found.more:
        yield f"{len(found.rows)} rows of {found.rows.file}: too many conventions fit to check them all"
        yield f"Give {ENOUGH} rows or more in which every joint has a different value, none at zero"
        return
    yield f"{len(found.rows)} rows of {found.rows.file}: no convention fits within {found.tolerance:g} mm and mrad"
    if found.convention:
        yield f"They fit with the DH table read as {found.convention}: correct the convention that the problem states"
        return
    if found.order:
        yield f"They fit with the numbers of the quaternion in the order {found.order}: rename its columns accordingly"
        return
    if found.slips:
        listed = []
        for slip in found.slips:
            about = round(float(f"{slip.fitting:.5g}"), 4) + 0.0  # no more digits than rows that are rounded tell
            listed.append(f"{slip.column} in line {slip.line} ({slip.shown:.10g}; about {about:g} would fit)")
        where = ", ".join(map(str, sorted({slip.line for slip in found.slips})))
        one = "All rows fit but for one"
        if len(listed) == 1:
            yield f"{one} number: {listed[0]}. Compare it with the pendant; no other number explains it"
        elif len(listed) <= SHOWN:
            yield f"{one} number, either {' or '.join(listed)}. Compare them with the pendant"
        else:
            yield f"{one} of {len(listed)} numbers, in line {where}. Compare them with the pendant"
        return
    if found.nearest is None:
        yield "The positions are beyond the arm's reach in mm and in metres"
    else:
        near = found.nearest
        yield f"The nearest one misses by {near.mm:.1f} mm and {math.degrees(near.rad):.2f} deg at worst"
        if near.mm <= found.tolerance:
            yield "Positions fit, orientations do not: the pendant's tool may be rotated relative to the flange"
    lines = ", ".join(map(str, found.odd_lines))
    if len(found.odd_lines) == 1:
        yield f"Without line {lines} the others fit: look for a copying mistake there"
    elif lines:
        yield f"The others fit if any one of these lines is left out: {lines}"
    yield (
        "Check that this is the problem's robot, that the pendant shows the flange in the robot's base (else give "
        "--tool and --base), and that every row was read while the arm stood still"
    )
    yield (
        "Searched: signs, quarter turns, any joints measured against the one before or one against any other, deg and "
        "rad, mm and m, five conventions of three angles"
    )
