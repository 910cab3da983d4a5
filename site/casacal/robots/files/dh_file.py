"""A DH table in a file: read it, write it, or take from it what the controller's joints mean.

As CSV (commas, semicolons or tabs), a block of comments, then a header whose names carry their units:

    # name: UR5
    # convention: standard
    # parallel: 2, 3
    joint,alpha_deg,a_mm,d_mm,theta_deg,kind,lower_deg,upper_deg
    1,90,0,89.159,0,revolute,-360,360
    2,0,-425,0,0,revolute,-360,360

As TOML the same:

    name = "UR5"
    convention = "standard"
    parallel = [2, 3]

    [conventions]
    signs = [1, -1, 1, 1, 1, 1]
    offsets_deg = [0, 90, 0, 0, 0, 0]
    coupling = [[3, 2, -1.0]]

    [[joint]]
    kind = "revolute"
    alpha_deg = 90
    a_mm = 0
    d_mm = 89.159
    theta_deg = 0
    lower_deg = -360
    upper_deg = 360

- convention: standard, or modified (Craig's); it must be said. Row i is joint i.
- alpha, theta, beta end in _deg or _rad, a and d in _mm or _m; alpha, a, d and theta are needed in each row.
- kind: revolute (default) or prismatic; lower and upper, in _deg, _rad, _mm or _m, are the controller's limits, by
  default +-180 degrees and +-1000 mm. In CSV, cells that do not concern a row stay empty.
- parallel: rows, from 1, whose axis is parallel to the next one; beta is Hayati's turn there (see `DHTable`).
- signs, offsets, coupling (in CSV `# signs: 1, -1, 1`, `# offsets_deg: 0, 90, 0`, `# coupling: 3 2 -1; ...`): what the
  controller's joint values mean, as in `Conventions`. Offsets of sliding joints: offsets_mm. All may be left out.
- joint (the row's number) and note are optional. Any other name is refused.
"""

from __future__ import annotations

from pathlib import Path

from casacal.errors import ProblemError
from casacal.robots.dh_table import DHTable
from casacal.robots.files.dh_fields import BLOCK_FIELDS, Fields, conventions_of, joint_of, table_of
from casacal.robots.files.dh_text import ENTRY, csv_text, decode, read_csv, read_toml, toml_text
from casacal.robots.joints import Conventions, joints_of


def read_dh_file(path: str | Path) -> DHTable:
    """Read a DH table, as TOML when the name ends in .toml, else as CSV.

    Raises ProblemError that names the file, the line or joint, and what to do.
    """
    return table_of(_fields(path))


def read_conventions(path: str | Path) -> Conventions:
    """What the controller's joints mean, from a DH file or from one that holds that block alone.

    Raises ProblemError where the block is not well formed, or where there are neither joints nor signs.
    """
    fields = _fields(path)
    joints = tuple(joint_of(fields, i) for i in range(len(fields.rows)))
    if not joints:
        signs = fields.block.get("signs", [])
        if not signs:
            raise ProblemError(f"{fields.file}: there are neither joints nor signs", "Give signs = [1, -1, ...]")
        joints = joints_of(len(signs))
    return conventions_of(fields, joints) or Conventions.plain(len(joints))


def unread_keys(path: str | Path) -> tuple[str, ...]:
    """Keys in the comments of a CSV that mean nothing there, such as `units` of '# units: m'; none in TOML."""
    found = () if is_toml(path) else (ENTRY.fullmatch(line) for line in decode(Path(path)).splitlines())
    return tuple(each[1] for each in found if each and each[1] not in BLOCK_FIELDS)


def dh_file_text(table: DHTable, path: str | Path) -> str:
    """A DH table as the text of a file of that name: TOML when it ends in .toml, else CSV."""
    return toml_text(table) if is_toml(path) else csv_text(table)


def is_toml(path: str | Path) -> bool:
    """Whether a file of that name holds TOML."""
    return Path(path).suffix.lower() == ".toml"


def _fields(path: str | Path) -> Fields:
    return read_toml(path) if is_toml(path) else read_csv(path)
