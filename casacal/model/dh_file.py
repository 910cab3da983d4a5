"""Files of Denavit-Hartenberg tables, CSV and TOML: read with their units, refused with the place, and written."""

from __future__ import annotations

import json
import math
import re
import sys
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeAlias

from casacal.data.text import LINE_END, NUMBER, decode, read_table
from casacal.errors import ProblemError, SamplesError
from casacal.model.dh_table import DHTable, degrees, plain
from casacal.model.joints import MOST_JOINTS, Conventions, Joint

FARTHEST = 20_000.0  # mm: no arm has such a length
FAR_FEET, EXACTLY = 3_000.0, 1e-9  # mm along an axis beyond which common normals are not used; sine of parallel axes

Row: TypeAlias = Mapping[str, Any]

ANGLE = {"deg": math.pi / 180, "rad": 1.0}
LENGTH = {"mm": 1.0, "m": 1000.0}
UNITS = {"alpha": ANGLE, "a": LENGTH, "d": LENGTH, "theta": ANGLE, "beta": ANGLE}  # numbers of a row
ROW_FIELDS = (
    "joint",
    "kind",
    "note",
    *(f"{field}_{unit}" for field, units in UNITS.items() for unit in units),
    *(f"{side}_{unit}" for side in ("lower", "upper") for unit in (*ANGLE, *LENGTH)),
)
OFFSETS = tuple(f"offsets_{unit}" for unit in (*ANGLE, *LENGTH))
LIKE = {"parallel": "[1, 2]", "signs": "[1, 2]", **dict.fromkeys(OFFSETS, "[0.0, 90.0]"), "coupling": "[[3, 2, -1.0]]"}
"""Lists that say something of all joints, and what each looks like in TOML."""
BLOCK_FIELDS = ("name", "convention", *LIKE)
MISNAMED = {"type": "kind", "joint_type": "kind"}  # names of fields in other tables, and the name here
HALF_TURN = math.pi * (1 + 1e-6)
KINDS = {"revolute": "revolute", "r": "revolute", "prismatic": "prismatic", "p": "prismatic"}
FileRows: TypeAlias = list[tuple[str, Row]]  # rows as read, numbers as numbers, each with its place: "arm.csv, line 3"


def table_of(file: str, block: Mapping[str, Any], rows: FileRows) -> DHTable:
    """The DH table that a file's block and rows make; raises ProblemError that names the file and the place."""
    convention = block.get("convention")
    if convention not in ("standard", "modified"):
        came = "does not say its convention" if convention is None else f"has the convention '{convention}'"
        fix = "Say standard or modified (Craig's): '# convention: standard' above a CSV's header, 'convention' in TOML"
        raise ProblemError(f"{file}: the file {came}", fix)
    if not rows:
        raise ProblemError(f"{file}: there is no joint", "Give one row per joint")
    for where, row in rows:
        check_names(row, ROW_FIELDS, where)
    columns: dict[str, Any] = {
        field: tuple(quantity(row, field, UNITS[field], where) for where, row in rows)
        for field in ("alpha", "a", "d", "theta")
    }
    joints = tuple(joint_of(row, where, i) for i, (where, row) in enumerate(rows, 1))
    parallel = tuple(block.get("parallel", ()))
    beta = dict.fromkeys(parallel, 0.0)
    for i, (where, row) in enumerate(rows, 1):
        if any(f"beta_{unit}" in row for unit in ANGLE):
            beta_i = quantity(row, "beta", ANGLE, where)
            if beta_i and i not in parallel:
                fix = "Name it there, if its axis is parallel to the next one"
                raise ProblemError(f"{where}: row {i} has beta but is not named in parallel", fix)
            beta[i] = beta_i
    conventions = conventions_of(file, block, joints)
    with _located(file):
        table = DHTable(
            name=block.get("name") or file.replace("\\", "/").rsplit("/", 1)[-1].rsplit(".", 1)[0],
            joints=joints,
            convention=convention,
            parallel=parallel,
            beta=tuple(beta[i] for i in parallel),
            conventions=conventions,
            limited=all(any(name.startswith(end) for name in row) for _, row in rows for end in ("lower", "upper")),
            **columns,
        )
    near = table.parallel_axes()
    far = max((abs(table.d[row - 1]) for row in near if abs(math.sin(table.twist(row))) > EXACTLY), default=0.0)
    if far > FAR_FEET and not parallel and convention == "standard":
        together = near == tuple(range(near[0], near[-1] + 1))
        axes = f"{near[0]} to {near[-1] + 1}" if together else " and ".join(f"{row} to {row + 1}" for row in near)
        note = (
            f"Joints {axes} are nearly parallel, which puts a d of {far / 1000:.3g} m into the file: the same arm is "
            f"written with parallel={near}, beta, and d where the axes stand"
        )
        table = replace(table.with_feet_near(), note=note)
    largest = max(map(abs, (*table.a, *table.d)))
    if 0 < largest < 5 or largest > FARTHEST:  # no arm: lengths given in the wrong unit
        unit = "m" if largest < 5 else "mm"
        fix = f"Name a and d by their unit: a_{unit}, d_{unit}"
        raise ProblemError(f"{file}: the largest length is {largest:g} mm", fix)
    return table


@contextmanager
def _located(where: str) -> Iterator[None]:
    """Put a place before what a ProblemError says."""
    try:
        yield
    except ProblemError as error:
        raise ProblemError(f"{where}: {error.what}", error.fix) from None


def conventions_of(file: str, block: Mapping[str, Any], joints: Sequence[Joint]) -> Conventions | None:
    """The controller's joint conventions; None where the file states none."""
    count = len(joints)
    if not {"signs", *OFFSETS, "coupling"} & set(block):
        return None
    for name in ("signs", *OFFSETS):
        if name in block and len(block[name]) != count:
            what = f"{file}: {name} has {len(block[name])} numbers for {count} joints"
            raise ProblemError(what, "Give one per joint")
    signs, coupling = block.get("signs", [1] * count), block.get("coupling", [])
    offsets = [0.0] * count
    for unit in (*ANGLE, *LENGTH):
        values = block.get(f"offsets_{unit}", [0.0] * count)
        for i, (value, joint) in enumerate(zip(values, joints, strict=True)):
            if value and (unit in ANGLE) != (joint.turns):
                what = f"{file}: offsets_{unit} gives {value:g} for joint {i + 1}, which is {joint.kind}"
                fix = "Give offsets of turning joints in deg or rad, of sliding ones in mm or m; zero for the others"
                raise ProblemError(what, fix)
            offsets[i] += value * {**ANGLE, **LENGTH}[unit]
    with _located(file):
        whole = tuple(int(sign) if sign in (1, -1) else sign for sign in signs)
        made = Conventions(whole, tuple(offsets), tuple((int(i), int(j), float(f)) for i, j, f in coupling))
        made.check_joints(count, "The table")
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
    return quarter_turns(value) if unit == "rad" else value * units[unit]


def quarter_turns(value: float) -> float:
    """An angle in rad, whole quarter turns where it is these as rounded: 1.570796327 and 1.5708 are pi / 2."""
    turns = round(value / (math.pi / 2))
    digits = len(f"{value!r}".partition(".")[2])
    meant = turns * math.pi / 2
    return meant if turns and 3 <= digits < 17 and abs(value - meant) <= 0.5001 * 10.0**-digits else value


def joint_of(row: Row, where: str, number: int) -> Joint:
    """The joint of a row, numbered from 1, with its limits where the row has them."""
    if row.get("joint", number) != number:
        raise ProblemError(f"{where}: this is joint {row['joint']:g}", f"Number joints from 1; here {number} is due")
    kind = KINDS.get(str(row.get("kind", "revolute")).lower())
    if kind is None:
        raise ProblemError(f"{where}: the kind is '{row['kind']}'", "Use revolute or prismatic (R, P)")
    units = ANGLE if kind == "revolute" else LENGTH
    limits = [name for name in row if name.split("_")[0] in ("lower", "upper")]
    wrong = [name for name in limits if name.split("_")[1] not in units]
    if wrong:
        raise ProblemError(f"{where}: a {kind} joint has {wrong[0]}", f"Give its limits in {' or '.join(units)}")
    if not limits:
        bound = math.pi if kind == "revolute" else 1000.0
        return Joint(kind, -bound, bound)  # type: ignore[arg-type]
    lower, upper = (quantity(row, side, units, where) for side in ("lower", "upper"))
    with _located(where):
        return Joint(kind, lower, upper)  # type: ignore[arg-type]


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


ENTRY = re.compile(r"\s*#\s*(\w+)\s*:\s*(.*?)\s*")
COLUMNS = (
    *("joint", "alpha_deg", "a_mm", "d_mm", "theta_deg", "beta_deg", "kind"),
    *("lower_deg", "upper_deg", "lower_mm", "upper_mm"),
)
"""Columns of a CSV that is written, as far as the table has them."""


def read_dh_file(path: str | Path) -> DHTable:
    """Read a DH table, as TOML when the name ends in .toml, else as CSV; raises ProblemError that names the place."""
    return table_of(str(path), *(read_toml(path) if is_toml(path) else read_csv(path)))


def unread_keys(path: str | Path) -> tuple[str, ...]:
    """Keys in comments of a CSV that mean nothing, such as `units` of '# units: m', each once; none in TOML."""
    if is_toml(path):
        return ()
    found = map(ENTRY.fullmatch, decode(Path(path).read_bytes(), str(path)).splitlines())
    known = (*BLOCK_FIELDS, "casacal")  # the latter is what exports say of themselves
    return tuple(dict.fromkeys(each[1] for each in found if each and each[1] not in known))


def dh_file_text(table: DHTable, path: str | Path) -> str:
    """A DH table as the text of a file of that name, degrees and millimetres: TOML when it ends in .toml, else CSV."""
    rows = list[dict[str, str]]()
    for i, joint in enumerate(table.joints):
        row = {"joint": str(i + 1), "kind": joint.kind, "alpha_deg": degrees(table.alpha[i])}
        row |= {"a_mm": plain(table.a[i]), "d_mm": plain(table.d[i]), "theta_deg": degrees(table.theta[i])}
        if i + 1 in table.parallel:
            row["beta_deg"] = degrees(table.beta[table.parallel.index(i + 1)])
        unit, shown = ("deg", degrees) if joint.turns else ("mm", plain)
        rows.append(row | {f"lower_{unit}": shown(joint.lower), f"upper_{unit}": shown(joint.upper)})
    if is_toml(path):
        lines = [f"name = {json.dumps(table.name, ensure_ascii=False)}", f'convention = "{table.convention}"']
        if table.parallel:
            lines.append(f"parallel = {list(table.parallel)}")
        if table.conventions is not None:
            lines += ["", conventions_toml(table.conventions, table.joints).rstrip("\n")]
        for row in rows:
            numbers = (f"{key} = {value}" for key, value in row.items() if key not in ("joint", "kind"))
            lines += ["", "[[joint]]", f'kind = "{row["kind"]}"', *numbers]
        return "\n".join(lines) + "\n"
    lines = [f"# name: {' '.join(table.name.split()).rstrip(',;')}", f"# convention: {table.convention}"]
    if table.parallel:
        lines.append(f"# parallel: {', '.join(map(str, table.parallel))}")
    if table.conventions is not None:
        meant = _meant(table.conventions, [joint.turns for joint in table.joints])
        lines += [f"# {key}: {('; ' if key == 'coupling' else ', ').join(each)}" for key, each in meant.items()]
    columns = [name for name in COLUMNS if any(name in row for row in rows)]
    lines += [",".join(columns), *(",".join(row.get(name, "") for name in columns) for row in rows)]
    return "\n".join(lines) + "\n"


def is_toml(path: str | Path) -> bool:
    """Whether a file of that name holds TOML."""
    return Path(path).suffix.lower() == ".toml"


def read_csv(path: str | Path) -> tuple[dict[str, Any], FileRows]:
    """Block and rows of a CSV; raises ProblemError that names file and line."""
    try:
        table = read_table(path)
    except SamplesError as error:
        fix = error.fix.replace("one line per sample", "one line per joint")
        raise ProblemError(error.what, fix) from None
    rows: FileRows = []
    check_names(dict.fromkeys(table.header), ROW_FIELDS, f"{table.file}, header")  # before their cells are read
    for cells, line in zip(table.rows, table.lines, strict=True):
        row, where = dict[str, Any](), f"{table.file}, line {line}"
        for name, cell in zip(table.header, cells, strict=True):
            text = cell.replace(",", ".") if table.decimal_comma else cell
            if text:
                row[name] = text if name in ("kind", "note") else _number(text, f"{where}, '{name}'")
        rows.append((where, row))
    return _block(decode(Path(path).read_bytes(), table.file), table.file, table.decimal_comma), rows


def _block(text: str, file: str, decimal_comma: bool) -> dict[str, Any]:
    """Known keys of the comments; other comments stay comments, but a key that is nearly a known one is refused."""
    block: dict[str, Any] = {}
    for number, line in enumerate(LINE_END.split(text), 1):
        found = ENTRY.fullmatch(line)
        if not found:
            continue
        key, value = found.group(1), found.group(2).rstrip(",;\t ")  # spreadsheets fill up lines with delimiters
        where = f"{file}, line {number}"
        if key not in BLOCK_FIELDS:
            close = get_close_matches(key.lower(), BLOCK_FIELDS, n=1, cutoff=0.8)
            if close:
                raise ProblemError(f"{where}: there is no key '{key}'", f"Write '# {close[0]}: ...', or no colon")
            continue
        if key in block:
            raise ProblemError(f"{where}: '{key}' comes a second time", "Leave one of them")
        block[key] = value
        if decimal_comma and key in (*OFFSETS, "coupling"):
            value = re.sub(r"(?<=\d),(?=\d)", ".", value)
        if key == "coupling":  # 'i j factor' between semicolons
            block[key] = [_numbers(entry, where) for entry in value.split(";") if entry.strip()]
        elif key not in ("name", "convention"):
            block[key] = _numbers(value, where)
        if key in LIKE and not _sound(key, block[key]):
            fix = "Write joint, joint and factor, such as 3 2 -1" if key == "coupling" else "Give whole numbers"
            raise ProblemError(f"{where}: {key} is '{value}'", fix)
    return block


def _numbers(text: str, where: str) -> list[float]:
    found = [_number(part, where) for part in re.split(r"[,;\s]+", text.strip().strip("[]")) if part]
    return [int(number) if number.is_integer() else number for number in found]


def _number(text: str, where: str) -> float:
    value = float(text) if NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(value):
        raise ProblemError(f"{where}: '{text}' is not a number", "Write it like 12.5")
    return value


TOP = ("name", "convention", "parallel", "conventions", "joint")


def read_toml(path: str | Path) -> tuple[dict[str, Any], FileRows]:
    """Block and rows of a TOML file; raises ProblemError that names file and joint."""
    file = str(path)
    try:
        document = tomllib.loads(Path(path).read_bytes().decode("utf-8-sig"))
    except FileNotFoundError:
        raise ProblemError(f"{file}: there is no such file", "Check the path") from None
    except OSError as error:
        raise ProblemError(f"{file}: cannot be read ({error.strerror})", "Give a readable TOML file") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise ProblemError(f"{file}: this is not TOML ({error})", "Mend the file") from None
    except ValueError:  # all that TOML leaves to Python is how long a whole number may be
        raise ProblemError(f"{file}: a whole number has thousands of digits", "Write plain decimal numbers") from None
    check_names(document, TOP, file)
    inner, joints = document.get("conventions", {}), document.get("joint", [])
    if not isinstance(inner, dict):
        raise ProblemError(f"{file}: 'conventions' is {inner!r}", "Write a table [conventions]")
    if not isinstance(joints, list) or not all(isinstance(joint, dict) for joint in joints):
        raise ProblemError(f"{file}: 'joint' is not a list of tables", "Write [[joint]] above each joint")
    check_names(inner, ("signs", *OFFSETS, "coupling"), f"{file}, [conventions]")
    block = {**{key: document[key] for key in ("name", "convention", "parallel") if key in document}, **inner}
    for key, value in block.items():
        if key in ("name", "convention") and not isinstance(value, str):
            raise ProblemError(f"{file}: {key} is {value!r}", "Write it as a text between quotes")
        if key in LIKE and not _sound(key, value):
            raise ProblemError(f"{file}: {key} is {value!r}", f"Write it like {LIKE[key]}")
    rows = [(f"{file}, joint {i}", joint) for i, joint in enumerate(joints, 1)]
    for where, joint in rows:
        for key, value in joint.items():
            if key not in ("kind", "note") and not _is_number(value):
                raise ProblemError(f"{where}: {key} is {value!r}", "Write a number without quotes")
    return block, rows


def _sound(key: str, value: Any) -> bool:
    """Whether a value is a list of numbers, for coupling a list of [joint, joint, factor], whole where they count."""
    rows = value if key == "coupling" and isinstance(value, list) else [value]
    whole = {"parallel": MOST_JOINTS, "signs": MOST_JOINTS, "coupling": 2}.get(key, 0)
    if not all(isinstance(row, list) and all(map(_is_number, row)) for row in rows):
        return False
    return all((key != "coupling" or len(row) == 3) and not any(v % 1 for v in row[:whole]) for row in rows)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def conventions_toml(conventions: Conventions, joints: Sequence[Joint] | None = None) -> str:
    """The [conventions] block of a TOML file; offsets in degrees, or mm for those `joints` that slide."""
    turns = [True] * len(conventions.signs) if joints is None else [joint.turns for joint in joints]
    lines = ["[conventions]"]
    for key, each in _meant(conventions, turns).items():
        if key == "coupling":
            each = [f"[{entry.replace(' ', ', ')}]" for entry in each]
        remark = "  # joint, joint that is added to it, factor" if key == "coupling" else ""
        lines.append(f"{key} = [{', '.join(each)}]{remark}")
    return "\n".join(lines) + "\n"


def _meant(conventions: Conventions, turns: Sequence[bool]) -> dict[str, list[str]]:
    """Joint conventions from numbers as text, by key; `turns` says which joints turn."""
    pairs = list(zip(conventions.offsets, turns, strict=True))
    found = {"signs": [str(sign) for sign in conventions.signs]}
    found["offsets_deg"] = [degrees(offset if turn else 0.0) for offset, turn in pairs]
    if not all(turns):
        found["offsets_mm"] = [plain(0.0 if turn else offset) for offset, turn in pairs]
    if conventions.coupling:
        found["coupling"] = [f"{i} {j} {plain(factor)}" for i, j, factor in conventions.coupling]
    return found
