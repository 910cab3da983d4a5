"""DH tables in files, as CSV and as TOML; docs/files.md says how these look."""

from __future__ import annotations

import json
import math
import re
import sys
import tomllib
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from casacal.errors import ProblemError, SamplesError
from casacal.robots.dh_table import DHTable
from casacal.robots.files.dh_fields import (
    BLOCK_FIELDS,
    OFFSETS,
    ROW_FIELDS,
    Fields,
    check_names,
    degrees,
    plain,
    table_of,
)
from casacal.robots.joints import Conventions, Joint
from casacal.tables import grammar
from casacal.tables.text import read_table

ENTRY = re.compile(r"\s*#\s*(\w+)\s*:\s*(.*?)\s*")
COLUMNS = (
    "joint",
    "alpha_deg",
    "a_mm",
    "d_mm",
    "theta_deg",
    "beta_deg",
    "kind",
    "lower_deg",
    "upper_deg",
    "lower_mm",
    "upper_mm",
)
"""Of a CSV that is written, as far as the table has them."""


def read_dh_file(path: str | Path) -> DHTable:
    """Read a DH table, as TOML when the name ends in .toml, else as CSV.

    Raises ProblemError that names the file, the line or joint, and what to do.
    """
    return table_of(read_toml(path) if is_toml(path) else read_csv(path))


def unread_keys(path: str | Path) -> tuple[str, ...]:
    """Keys in comments of a CSV that mean nothing, such as `units` of '# units: m', each once; none in TOML."""
    found = () if is_toml(path) else (ENTRY.fullmatch(line) for line in decode(Path(path)).splitlines())
    unread = dict.fromkeys(each[1] for each in found if each and each[1] not in BLOCK_FIELDS)
    return tuple(key for key in unread if key != "casacal")  # what exports say of themselves


def dh_file_text(table: DHTable, path: str | Path) -> str:
    """A DH table as the text of a file of that name: TOML when it ends in .toml, else CSV."""
    return toml_text(table) if is_toml(path) else csv_text(table)


def is_toml(path: str | Path) -> bool:
    """Whether a file of that name holds TOML."""
    return Path(path).suffix.lower() == ".toml"


def read_csv(path: str | Path) -> Fields:
    """Fields of a CSV; raises ProblemError that names file and line."""
    try:
        table = read_table(path)
    except SamplesError as error:
        fix = error.fix.replace("one line per sample", "one line per joint")
        raise ProblemError(error.what, fix) from None
    rows: list[dict[str, Any]] = []
    check_names(dict.fromkeys(table.header), ROW_FIELDS, f"{table.file}, header")  # before their cells are read
    for cells, line in zip(table.rows, table.lines, strict=True):
        row: dict[str, Any] = {}
        for name, cell in zip(table.header, cells, strict=True):
            if not cell:
                continue
            text = cell.replace(",", ".") if table.decimal_comma else cell
            row[name] = text if name in ("kind", "note") else _number(text, f"{table.file}, line {line}, '{name}'")
        rows.append(row)
    places = tuple(f"line {line}" for line in table.lines)
    return Fields(table.file, _block(decode(Path(path)), table.file), tuple(rows), places)


def decode(path: Path) -> str:
    """Text of a file that `read_table` accepts, line ends as they are."""
    return grammar.decode(path.read_bytes(), str(path))


def _block(text: str, file: str) -> dict[str, Any]:
    """Known keys of the comments; other comments stay comments, but a key that is nearly a known one is refused."""
    block: dict[str, Any] = {}
    for number, line in enumerate(grammar.LINE_END.split(text), 1):
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
        block[key] = _value(key, value, where)
    return block


def _value(key: str, text: str, where: str) -> Any:
    """What a key's text means: a word, whole numbers, numbers, or couplings 'i j factor' between semicolons."""
    if key in ("name", "convention"):
        return text
    if key == "coupling":
        entries = [_numbers(entry, where) for entry in text.split(";") if entry.strip()]
        if any(len(entry) != 3 or entry[0] % 1 or entry[1] % 1 for entry in entries):
            raise ProblemError(f"{where}: coupling is '{text}'", "Write joint, joint and factor, such as 3 2 -1")
        return entries
    numbers = _numbers(text, where)
    if key in OFFSETS:
        return numbers
    if any(number % 1 for number in numbers):
        raise ProblemError(f"{where}: {key} is '{text}'", "Give whole numbers")
    return [int(number) for number in numbers]


def _numbers(text: str, where: str) -> list[float]:
    return [_number(part, where) for part in re.split(r"[,;\s]+", text.strip().strip("[]")) if part]


def _number(text: str, where: str) -> float:
    value = float(text) if grammar.NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(value):
        raise ProblemError(f"{where}: '{text}' is not a number", "Write it like 12.5")
    return value


TOP = ("name", "convention", "parallel", "conventions", "joint")


def read_toml(path: str | Path) -> Fields:
    """Fields of a TOML file; raises ProblemError that names file and joint."""
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
        if key in BLOCK_FIELDS[2:]:
            _check_list(key, value, file)
    for i, joint in enumerate(joints, 1):
        for key, value in joint.items():
            if key not in ("kind", "note") and not _is_number(value):
                raise ProblemError(f"{file}, joint {i}: {key} is {value!r}", "Write a number without quotes")
    return Fields(file, block, tuple(joints), tuple(f"joint {i}" for i in range(1, len(joints) + 1)))


def _check_list(key: str, value: Any, file: str) -> None:
    """Refuse what is no list of numbers, or for coupling no list of [joint, joint, factor]."""
    rows = value if key == "coupling" and isinstance(value, list) else [value]
    whole = {"parallel": 99, "signs": 99, "coupling": 2}.get(key, 0)  # how many of the numbers are whole
    for row in rows:
        good = isinstance(row, list) and all(_is_number(v) for v in row)
        if good and key == "coupling":
            good = len(row) == 3
        if not good or any(v % 1 for v in row[:whole]):
            kind = "[[3, 2, -1.0]]" if key == "coupling" else "[1, 2]" if whole else "[0.0, 90.0]"
            raise ProblemError(f"{file}: {key} is {value!r}", f"Write it like {kind}")


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def csv_text(table: DHTable) -> str:
    """A DH table as CSV, degrees and millimetres."""
    lines = [f"# name: {table.name}", f"# convention: {table.convention}"]
    if table.parallel:
        lines.append(f"# parallel: {', '.join(map(str, table.parallel))}")
    if table.conventions is not None:
        meant = _meant(table.conventions, [joint.turns for joint in table.joints])
        lines += [f"# {key}: {('; ' if key == 'coupling' else ', ').join(each)}" for key, each in meant.items()]
    rows = _rows(table)
    columns = [name for name in COLUMNS if any(name in row for row in rows)]
    lines += [",".join(columns), *(",".join(row.get(name, "") for name in columns) for row in rows)]
    return "\n".join(lines) + "\n"


def toml_text(table: DHTable) -> str:
    """A DH table as TOML, degrees and millimetres."""
    lines = [f"name = {json.dumps(table.name, ensure_ascii=False)}", f'convention = "{table.convention}"']
    if table.parallel:
        lines.append(f"parallel = {list(table.parallel)}")
    text = "\n".join(lines) + "\n"
    if table.conventions is not None:
        text += "\n" + conventions_toml(table.conventions, table.joints)
    for row in _rows(table):
        kind = f'kind = "{row["kind"]}"'
        numbers = [f"{key} = {value}" for key, value in row.items() if key not in ("joint", "kind")]
        text += "\n".join(["", "[[joint]]", kind, *numbers, ""])
    return text


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
    """What a controller's joints mean, numbers as text by key; `turns` says which joints turn."""
    pairs = list(zip(conventions.offsets, turns, strict=True))
    found = {"signs": [str(sign) for sign in conventions.signs]}
    found["offsets_deg"] = [degrees(offset) if turn else "0" for offset, turn in pairs]
    if not all(turns):
        found["offsets_mm"] = [plain(0.0 if turn else offset) for offset, turn in pairs]
    if conventions.coupling:
        found["coupling"] = [f"{i} {j} {plain(factor)}" for i, j, factor in conventions.coupling]
    return found


def _rows(table: DHTable) -> list[dict[str, str]]:
    """The fields of each joint as text."""
    rows = []
    for i, joint in enumerate(table.joints):
        row = {"joint": str(i + 1), "kind": joint.kind, "alpha_deg": degrees(table.alpha[i])}
        row |= {"a_mm": plain(table.a[i]), "d_mm": plain(table.d[i]), "theta_deg": degrees(table.theta[i])}
        if i + 1 in table.parallel:
            row["beta_deg"] = degrees(table.beta[table.parallel.index(i + 1)])
        unit, shown = ("deg", degrees) if joint.turns else ("mm", plain)
        rows.append(row | {f"lower_{unit}": shown(joint.lower), f"upper_{unit}": shown(joint.upper)})
    return rows
