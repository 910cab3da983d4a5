"""What a DH file holds, whatever its format: named fields with units, and the table they make."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, TypeAlias

from casacal.errors import ProblemError
from casacal.robots.dh_table import DHTable
from casacal.robots.joints import Conventions, Joint


def plain(value: float) -> str:
    """A number to twelve digits, without trailing zeros; zero, never -0, for what is rounding alone."""
    return f"{value:.12g}" if abs(value) > 1e-12 else "0"


def degrees(value: float) -> str:
    """An angle in rad, in degrees to twelve digits."""
    return plain(math.degrees(value))


Row: TypeAlias = Mapping[str, Any]

ANGLE = {"deg": math.pi / 180, "rad": 1.0}
LENGTH = {"mm": 1.0, "m": 1000.0}
UNITS = {"alpha": ANGLE, "a": LENGTH, "d": LENGTH, "theta": ANGLE, "beta": ANGLE}
"""The numbers of a row, and what one of each unit is in rad or mm."""
ROW_FIELDS = (
    "joint",
    "kind",
    "note",
    *(f"{field}_{unit}" for field, units in UNITS.items() for unit in units),
    *(f"{side}_{unit}" for side in ("lower", "upper") for unit in (*ANGLE, *LENGTH)),
)
OFFSETS = tuple(f"offsets_{unit}" for unit in (*ANGLE, *LENGTH))
BLOCK_FIELDS = ("name", "convention", "parallel", "signs", *OFFSETS, "coupling")
MISNAMED = {"type": "kind", "joint_type": "kind"}  # what other tables call a field that is called otherwise here
HALF_TURN = math.pi * (1 + 1e-6)
KINDS = {"revolute": "revolute", "r": "revolute", "prismatic": "prismatic", "p": "prismatic"}


@dataclass(frozen=True)
class Fields:
    """A file's block and rows as read, numbers as numbers; `places` say where each row stands in the file."""

    file: str
    block: Mapping[str, Any]
    rows: tuple[Row, ...]
    places: tuple[str, ...]


def table_of(fields: Fields) -> DHTable:
    """The DH table that a file's fields make; raises ProblemError that names the file and the place."""
    convention = fields.block.get("convention")
    if convention not in ("standard", "modified"):
        came = "does not say its convention" if convention is None else f"has the convention '{convention}'"
        fix = "Say standard or modified (Craig's): '# convention: standard' above a CSV's header, 'convention' in TOML"
        raise ProblemError(f"{fields.file}: the file {came}", fix)
    if not fields.rows:
        raise ProblemError(f"{fields.file}: there is no joint", "Give one row per joint")
    for row, place in zip(fields.rows, fields.places, strict=True):
        check_names(row, ROW_FIELDS, f"{fields.file}, {place}")
    columns = {
        field: tuple(
            quantity(row, field, UNITS[field], f"{fields.file}, {place}")
            for row, place in zip(fields.rows, fields.places, strict=True)
        )
        for field in ("alpha", "a", "d", "theta")
    }
    largest = max(abs(value) for key in ("a", "d") for value in columns[key])
    if 0 < largest < 5 or largest > 20_000:  # no arm: lengths given in the wrong unit
        unit = "m" if largest < 5 else "mm"
        fix = f"Name a and d by their unit: a_{unit}, d_{unit}"
        raise ProblemError(f"{fields.file}: the largest length is {largest:g} mm", fix)
    joints = tuple(joint_of(fields, i) for i in range(len(fields.rows)))
    parallel, beta = _parallel(fields)
    conventions = conventions_of(fields, joints)
    try:
        return DHTable(
            name=fields.block.get("name") or fields.file.replace("\\", "/").rsplit("/", 1)[-1].rsplit(".", 1)[0],
            joints=joints,
            convention=convention,
            parallel=parallel,
            beta=beta,
            conventions=conventions,
            **columns,  # type: ignore[arg-type]
        )
    except ProblemError as error:
        raise ProblemError(f"{fields.file}: {error.what}", error.fix) from None


def conventions_of(fields: Fields, joints: Sequence[Joint]) -> Conventions | None:
    """What the controller's joints mean, or None where the file says nothing of it."""
    block, count = fields.block, len(joints)
    if not {"signs", *OFFSETS, "coupling"} & set(block):
        return None
    for name in ("signs", *OFFSETS):
        if name in block and len(block[name]) != count:
            what = f"{fields.file}: {name} has {len(block[name])} numbers for {count} joints"
            raise ProblemError(what, "Give one per joint")
    signs, coupling = block.get("signs", [1] * count), block.get("coupling", [])
    offsets = [0.0] * count
    for unit in (*ANGLE, *LENGTH):
        values = block.get(f"offsets_{unit}", [0.0] * count)
        for i, (value, joint) in enumerate(zip(values, joints, strict=True)):
            if value and (unit in ANGLE) != (joint.turns):
                what = f"{fields.file}: offsets_{unit} gives {value:g} for joint {i + 1}, which is {joint.kind}"
                fix = "Give offsets of turning joints in deg or rad, of sliding ones in mm or m; zero for the others"
                raise ProblemError(what, fix)
            offsets[i] += value * {**ANGLE, **LENGTH}[unit]
    try:
        made = Conventions(
            tuple(int(s) if s in (1, -1) else s for s in signs),
            tuple(offsets),
            tuple((int(i), int(j), float(f)) for i, j, f in coupling),
        )
        made.check_joints(count, "The table")
    except ProblemError as error:
        raise ProblemError(f"{fields.file}: {error.what}", error.fix) from None
    return made


def quantity(row: Row, field: str, units: Mapping[str, float], where: str) -> float:
    """A field of a row in rad or mm; its key says its unit, such as alpha_deg."""
    found = [unit for unit in units if f"{field}_{unit}" in row]
    names = " or ".join(f"{field}_{unit}" for unit in units)
    if len(found) != 1:
        came = f"there is no {field}" if not found else f"there is more than one {field}"
        raise ProblemError(f"{where}: {came}", f"Name one of {names}; the name says the unit")
    unit = found[0]
    value = float(row[f"{field}_{unit}"])
    turns = abs(value) / (math.pi / 2)
    if unit == "rad" and abs(value) > 4 * math.pi + 1e-6:
        raise ProblemError(f"{where}: {field}_rad is {value:g}", f"That is no angle in rad; name it {field}_deg")
    if unit == "deg" and 0.5 < turns < 4.5 and abs(turns - round(turns)) < 1e-4:
        fix = f"Name it {field}_rad"
        raise ProblemError(f"{where}: {field}_deg is {value:g}, which is {round(turns)} quarter turns in rad", fix)
    if field in ("alpha", "beta") and abs(value * units[unit]) > HALF_TURN:
        same = math.remainder(value, 2 * math.pi / units[unit])
        fix = f"Write {plain(same)}, which is the same, if no digit is wrong"
        raise ProblemError(f"{where}: {field}_{unit} is {value:g}; a twist is within half a turn", fix)
    return value * units[unit]


def joint_of(fields: Fields, i: int) -> Joint:
    """The joint of row i (from 0), with its limits where the row has them."""
    row, where = fields.rows[i], f"{fields.file}, {fields.places[i]}"
    if "joint" in row and row["joint"] != i + 1:
        raise ProblemError(f"{where}: this is joint {row['joint']:g}", f"Number joints from 1; here {i + 1} is due")
    kind = KINDS.get(str(row.get("kind", "revolute")).lower())
    if kind is None:
        raise ProblemError(f"{where}: the kind is '{row['kind']}'", "Use revolute or prismatic (R, P)")
    units = ANGLE if kind == "revolute" else LENGTH
    given = [name for name in row if name.split("_")[0] in ("lower", "upper")]
    wrong = [name for name in given if name.split("_")[1] not in units]
    if wrong:
        raise ProblemError(f"{where}: a {kind} joint has {wrong[0]}", f"Give its limits in {' or '.join(units)}")
    if not given:
        bound = math.pi if kind == "revolute" else 1000.0
        return Joint(kind, -bound, bound)  # type: ignore[arg-type]
    lower, upper = (quantity(row, side, units, where) for side in ("lower", "upper"))
    try:
        return Joint(kind, lower, upper)  # type: ignore[arg-type]
    except ProblemError as error:
        raise ProblemError(f"{where}: {error.what}", error.fix) from None


def check_names(names: Row, known: Sequence[str], where: str) -> None:
    """Refuse a name that is none of the known ones; never a silent guess."""
    for name in names:
        if name not in known:
            units = [each for each in known if each.startswith(f"{name}_")]
            close = [MISNAMED[name]] if MISNAMED.get(name) in known else get_close_matches(name, known, n=1)
            hint = f"Did you mean '{close[0]}'? " if close else ""
            if units:
                hint = f"Say the unit: {' or '.join(units)}. "
            raise ProblemError(f"{where}: there is no field '{name}'", f"{hint}Known: {', '.join(known)}")


def _parallel(fields: Fields) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """Parallel rows and their beta."""
    rows = tuple(fields.block.get("parallel", ()))
    beta = {}
    for i, (row, place) in enumerate(zip(fields.rows, fields.places, strict=True), 1):
        if any(f"beta_{unit}" in row for unit in ANGLE):
            beta[i] = quantity(row, "beta", ANGLE, f"{fields.file}, {place}")
            if beta[i] and i not in rows:
                fix = "Name it there, if its axis is parallel to the next one"
                raise ProblemError(f"{fields.file}, {place}: row {i} has beta but is not named in parallel", fix)
    return rows, tuple(beta.get(row, 0.0) for row in rows)
