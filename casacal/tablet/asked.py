"""What a window sends, read: texts, numbers, rows off a pendant, and files, which go back corrected."""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from casacal.data.text import Table
from casacal.deployment.arm import CalibratedArm
from casacal.errors import CasacalError, refuse_unknown
from casacal.shopfloor.conversation import both_marks, cells_of
from casacal.uncertainty.figures import rms
from casacal.wording import counted, mm

Frame = Literal["flange", "tip"]
ENOUGH_POSES, MOST_ROWS = 4, 50  # off a pendant
MOST_FILES, SHOWN = 20, 5  # of one upload; targets not reached that are named one by one


def text_of(asked: Mapping[str, Any], name: str, longest: int) -> str:
    """A text that a window sent; raises CasacalError."""
    text = asked.get(name)
    if not isinstance(text, str) or len(text) > longest:
        raise CasacalError(f"'{name}' is no text of at most {longest} letters", "Send it again")
    return text


def number_of(asked: Mapping[str, Any], name: str, low: float, high: float) -> float | None:
    """A number in a field, None where it was left empty; raises CasacalError."""
    text = text_of(asked, name, 40).strip().replace(",", ".")
    if not text:
        return None
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not (low < value <= high or value == low > 0):  # zero is no number of anything here, three touches are
        what = f"'{text}' is no {'number of touches' if name == 'touches' else name}"
        raise CasacalError(what, f"Give a number from {low:g} to {high:g}, or leave it empty")
    return value


ORIENTATIONS: Mapping[str, tuple[str, ...]] = {
    "abc": ("a_deg", "b_deg", "c_deg"),
    "wpr": ("w_deg", "p_deg", "r_deg"),
    "rxyz": ("rx_rad", "ry_rad", "rz_rad"),
    "rxyz_deg": ("rx_deg", "ry_deg", "rz_deg"),
    "oat": ("o_deg", "a_deg", "t_deg"),
    "quaternion": ("qw", "qx", "qy", "qz"),
}
"""Columns of an orientation as a pendant shows it, by the word that the page has for it."""


def pendant_table(asked: Mapping[str, Any], turns: Sequence[bool]) -> Table:
    """Rows of a pendant as a window sends them: joints, x, y, z and an orientation, one pose a line."""
    form, text = text_of(asked, "form", 20), text_of(asked, "rows", 20_000)
    refuse_unknown("form of an orientation", [form], ORIENTATIONS)
    joints = [f"q{k}_{'deg' if turning else 'mm'}" for k, turning in enumerate(turns, 1)]
    header = (*joints, "x_mm", "y_mm", "z_mm", *ORIENTATIONS[form])
    rows, lines = list[tuple[str, ...]](), list[int]()
    for number, line in enumerate(text.splitlines(), 1):
        cells = tuple(cells_of(line))
        if len(cells) != len(header):  # as where commas part whole numbers
            cells = tuple(cell for cell in re.split(r"[\s;,]+", line) if cell)
        if cells and len(cells) != len(header):
            what = f"Line {number} has {counted(len(cells_of(line)), 'number')}, not {len(header)}"
            raise CasacalError(what, f"{both_marks(line)}Write {', '.join(header)}, apart by blanks")
        if cells:
            rows.append(tuple(cell.replace(",", ".") for cell in cells))
            lines.append(number)
    if not ENOUGH_POSES <= len(rows) <= MOST_ROWS:
        raise CasacalError(f"Got {counted(len(rows), 'pose')}", f"Give {ENOUGH_POSES} or more, at most {MOST_ROWS}")
    return Table("the page", "", header, 0, tuple(rows), tuple(lines), decimal_comma=False)


def uploaded(asked: Mapping[str, Any], place: Path) -> dict[Path, str]:
    """Files that a window sent, under names of ours in a folder of their own, with their names; raises CasacalError."""
    from casacal.programs.endings import ENDINGS

    files = asked.get("files")
    if not isinstance(files, list) or not 1 <= len(files) <= MOST_FILES:
        what = f"{len(files)} files came" if isinstance(files, list) and files else "No file came"
        raise CasacalError(what, f"Choose targets or programs, of KRL both files, at most {MOST_FILES} files")
    kept, stems = dict[Path, str](), dict[str, int]()
    for each in files:
        sent: Mapping[str, Any] = each if isinstance(each, dict) else {}
        name = re.split(r"[/\\]", text_of(sent, "name", 300))[-1]
        stem, suffix = Path(name).stem.lower(), Path(name).suffix.lower()
        if suffix not in (".csv", ".dat", *ENDINGS):
            raise CasacalError(f"A file that ends in '{suffix[:20]}' came", f"Give .csv, {', '.join(ENDINGS)}")
        try:
            data = base64.b64decode(text_of(sent, "data", 4_000_000), validate=True)
        except binascii.Error:
            raise CasacalError(f"'{name}' came damaged", "Choose it again") from None
        path = place / f"targets{stems.setdefault(stem, len(stems))}{suffix}"
        if path in kept:
            raise CasacalError(f"Two files called '{name}' came", "Choose one of them")
        kept[path] = name
        path.write_bytes(data)
    for path, name in kept.items():
        if path.suffix == ".dat" and path.with_suffix(".src") not in kept:
            raise CasacalError(f"'{name}' came without the .src of its name", "Choose both files of the program")
    return kept


def corrected(
    arm: CalibratedArm, path: Path, name: str, frame: Frame, *, leave: bool = False
) -> tuple[list[tuple[str, bytes]], list[str]]:
    """Endings and bytes of corrected targets or of a program, and sentences; raises CasacalError where it is refused.

    name: what the file is called where it came from. frame: what goes where it was meant to go. leave: whether moves of
    a program that cannot be corrected stay as they are, and are named.
    """
    from casacal.deployment.arm import FLANGE_UNKNOWN, cautions, column_notes
    from casacal.deployment.compensate import Outcome, compensate, read_targets
    from casacal.deployment.programs import no_gain, notes, rounding_of, text_of
    from casacal.programs.correct import compensate_program
    from casacal.programs.endings import is_program
    from casacal.programs.read import read_program

    if is_program(path):
        found = compensate_program(arm, read_program(path), frame=frame, skip_unknown=leave)
        off, left = found.correction_mm[found.reached], found.expected_mm[found.reached]
        said = [f"Left as it is: line {each.line}, {each.what}" for each in found.program.puzzles]
        said += [f"Left as it is: {found.program.targets[i].name}: {why}" for i, why in found.why.items()]
        said += no_gain(off, left)
        said.append(f"{counted(len(off), 'target')} corrected, by up to {mm(float(off.max(initial=0.0)))}")
        said.append(f"position error of the {frame} to expect: {mm(rms(left)) if len(left) else 'unknown'} RMS")
        posed = any(target.kind == "pose" for target in found.program.targets)
        said += [*cautions(arm, posed=posed), *column_notes(arm, found.missing, ())]
        said += [FLANGE_UNKNOWN] if frame == "flange" and not arm.flange_known else []
        texts = zip(found.program.paths, found.texts, strict=True)
        return [(Path(each).suffix, text.encode("latin-1")) for each, text in texts], said
    targets = replace(read_targets(path, arm.source), file=name)
    made = compensate(arm, targets, frame=frame, rounding=rounding_of("csv", arm.source.problem.robot))
    lost = [i for i, outcome in enumerate(made.outcomes) if outcome is not Outcome.REACHED]
    said = [f"Not reached: line {targets.lines[i]}, {made.outcomes[i].meaning}{made.left(i)}" for i in lost[:SHOWN]]
    if lost:
        count = f"{len(lost)} of {counted(len(targets), 'target')}"
        said.insert(0, f"warning: {count} not reached: these rows must not be driven; the column status names them")
    said += sorted(notes(made, arm), key=lambda note: not note.startswith("warning"))
    return [(".csv", text_of(made, "csv", arm).encode())], said
