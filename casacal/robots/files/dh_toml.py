"""DH tables as TOML: name, convention, parallel, a [conventions] block, and a [[joint]] table a joint."""

from __future__ import annotations

import json
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from casacal.errors import ProblemError
from casacal.robots.conventions import Conventions
from casacal.robots.dh_table import DHTable
from casacal.robots.files.decimals import degrees, plain
from casacal.robots.files.dh_fields import BLOCK_FIELDS, OFFSETS, Fields, check_names
from casacal.robots.joints import Joint

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


def toml_text(table: DHTable) -> str:
    """A DH table as TOML, degrees and millimetres."""
    lines = [f"name = {json.dumps(table.name, ensure_ascii=False)}", f'convention = "{table.convention}"']
    if table.parallel:
        lines.append(f"parallel = {list(table.parallel)}")
    text = "\n".join(lines) + "\n"
    if table.conventions is not None:
        text += "\n" + conventions_toml(table.conventions, table.joints)
    for i, joint in enumerate(table.joints):
        turn = joint.turns
        unit, shown = ("deg", degrees) if turn else ("mm", plain)
        rows = [f'kind = "{joint.kind}"', f"alpha_deg = {degrees(table.alpha[i])}", f"a_mm = {plain(table.a[i])}"]
        rows += [f"d_mm = {plain(table.d[i])}", f"theta_deg = {degrees(table.theta[i])}"]
        if i + 1 in table.parallel:
            rows.append(f"beta_deg = {degrees(table.beta[table.parallel.index(i + 1)])}")
        rows += [f"lower_{unit} = {shown(joint.lower)}", f"upper_{unit} = {shown(joint.upper)}"]
        text += "\n[[joint]]\n" + "\n".join(rows) + "\n"
    return text


def conventions_toml(conventions: Conventions, joints: Sequence[Joint] | None = None) -> str:
    """The [conventions] block of a TOML file; offsets in degrees, or mm for those `joints` that slide."""
    turns = [True] * len(conventions.signs) if joints is None else [joint.turns for joint in joints]
    degs = [degrees(o) if turn else "0" for o, turn in zip(conventions.offsets, turns, strict=True)]
    lines = ["[conventions]", f"signs = {list(conventions.signs)}", f"offsets_deg = [{', '.join(degs)}]"]
    if not all(turns):
        mms = [plain(0.0 if turn else o) for o, turn in zip(conventions.offsets, turns, strict=True)]
        lines.append(f"offsets_mm = [{', '.join(mms)}]")
    if conventions.coupling:
        entries = (f"[{i}, {j}, {plain(factor)}]" for i, j, factor in conventions.coupling)
        lines.append(f"coupling = [{', '.join(entries)}]  # joint, joint that is added to it, factor")
    return "\n".join(lines) + "\n"


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
