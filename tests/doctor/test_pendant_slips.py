"""One number of the documented pendant rows copied wrongly, in every way a hand does it: the doctor says which one."""

import json
import math
import re
from collections import Counter

import numpy as np
import pytest
from conftest import ROOT
from test_convention_doctor import radians, robot_of, rows_of, true_case

from casacal import Robot, diagnose
from casacal.cli.main import main
from casacal.doctor import PendantRows
from casacal.doctor.diagnosis import Miss
from casacal.doctor.words import diagnosis_text
from casacal.errors import SamplesError

UR5 = Robot.from_dh(
    "UR5",
    alpha=tuple(math.radians(v) for v in (90, 0, 0, 90, -90, 0)),
    a=(0, -425, -392.25, 0, 0, 0),
    d=(89.159, 0, 0, 109.15, 94.65, 82.3),
    theta=(0,) * 6,
)
PAGE = (ROOT / "docs" / "your_robot.md").read_text(encoding="utf-8")
TABLE, PENDANT = (re.search(rf"`out/{n}.csv`:\n\n```csv\n(.*?)```", PAGE, re.S)[1] for n in ("ur5", "pendant"))
HEADER, *LINES = PENDANT.split()
NAMES, CELLS = HEADER.split(","), [line.split(",") for line in LINES]
PASSES = (*[0.2] * 6, *[3.0] * 3, *[0.003] * 3)
"""What may pass unnoticed: deg of a joint (3 mm or 3 mrad of the flange), mm of a position, rad of an orientation."""


def changed_digit(text):
    first = re.search("[1-9]", text).start()
    return text[:first] + str((int(text[first]) + 4) % 10) + text[first + 1 :]


def dropped_sign(text):
    return text.removeprefix("-") if text.startswith("-") else f"-{text}"


def moved_point(text):
    return f"{float(text) * 10:.4f}"


def swapped_digits(text):
    pair = next(m for m in re.finditer(r"(\d)(?=(\.?)(\d))", text) if m[1] != m[3])
    start, end = pair.start(), pair.end() + len(pair[2])
    return text[:start] + pair[3] + pair[2] + pair[1] + text[end + 1 :]


def wrong_unit(text):
    return f"{float(text) / 25.4:.4f}" if abs(float(text)) > 130 else f"{math.radians(float(text)):.4f}"


SLIPS = (changed_digit, dropped_sign, moved_point, swapped_digits, wrong_unit)


def rows_with(cells):
    numbers = np.array(cells, dtype=float)
    columns = tuple(NAMES)
    return PendantRows(numbers[:, :6], numbers[:, 6:9], numbers[:, 9:], "deg", "mm", "", (2, 3, 4), "p.csv", columns)


def with_slip(row, column, text):
    cells = [list(line) for line in CELLS]
    cells[row][column] = text
    return rows_with(cells)


def test_slips_are_what_a_hand_does():
    assert [slip("132.92") for slip in SLIPS] == ["532.92", "-132.92", "1329.2000", "312.92", "5.2331"]
    assert [slip("-0.0310") for slip in SLIPS] == ["-0.0710", "0.0310", "-0.3100", "-0.3010", "-0.0005"]


@pytest.mark.long
@pytest.mark.parametrize("slip", SLIPS)
def test_every_slip_is_found_in_its_row_and_cell(slip, monkeypatch):
    # how near the nearest comes takes long, and is not asked for here
    monkeypatch.setattr("casacal.doctor.diagnosis._nearest", lambda *_: Miss(1.0, 0.0))
    told = Counter()
    for column, name in list(enumerate(NAMES))[SLIPS.index(slip) % 2 :: 2]:
        row = (column + SLIPS.index(slip)) % 3  # over all kinds of slips every cell has its turn
        right = CELLS[row][column]
        typed = slip(right)
        found = diagnose(UR5, with_slip(row, column, typed))
        if found.meanings:
            assert abs(float(typed) - float(right)) < PASSES[column], (name, typed)
            assert found.certain
            assert found.slips == ()
            told["passes"] += 1
            continue
        assert [(s.line, s.column, s.shown) for s in found.slips] == [(row + 2, name, float(typed))], (name, typed)
        assert found.odd_lines == (row + 2,)
        np.testing.assert_allclose(found.slips[0].fitting, float(right), atol=0.02 if column < 9 else 2e-4)
        told["found"] += 1
    assert told["found"] >= 5, told  # 770 slips of all kinds in all cells: each above the size that passes was found


def test_rows_without_a_slip_accuse_nothing():
    found = diagnose(UR5, rows_with(CELLS))
    assert found.certain
    assert (found.slips, found.odd_lines) == ((), ())
    another = diagnose(robot_of(radians(((90, 0, 0, 90, -90, 0), (0, -425, -372, 0, 0, 0), (90, 0, 0, 109, 94, 82),
                                         (0,) * 6))), rows_with(CELLS))  # fmt: skip
    assert (another.meanings, another.slips) == ((), ()), "rows of another arm are wrong in more than a number"


def test_the_size_that_passes_is_that_of_the_tolerance():
    # of three parallel axes, each nearly does for another: but not as well as the rows themselves fit
    for column, near, far in ((0, 0.1, 0.5), (3, 0.1, 0.3), (6, 2.5, 4.0), (9, 0.0015, 0.005)):
        for size, passes in ((near, True), (far, False)):
            found = diagnose(UR5, with_slip(0, column, f"{float(CELLS[0][column]) + size:.4f}"))
            assert bool(found.meanings) is passes
            assert passes or [s.column for s in found.slips] == [NAMES[column]]


def test_two_wrong_numbers_blame_no_single_one():
    cells = [list(line) for line in CELLS]
    cells[0][0], cells[0][9] = "31.92", "1.0376"
    found = diagnose(UR5, rows_with(cells))
    assert (found.odd_lines, found.slips) == ((2,), ())
    assert "Without line 2 the others fit" in diagnosis_text(found)


def test_where_two_numbers_would_do_both_are_named():
    # the last joint and the last of three moved angles turn the flange about one axis
    table, truth, kind, rng = true_case(18)
    rows = rows_of(table, truth, kind, rng.uniform(-2.9, 2.9, (3, 6)))
    rows.joints[2, 5] += 10
    found = diagnose(robot_of(table), rows)
    assert {(s.line, s.column) for s in found.slips} == {(4, "q6"), (4, "rz")}
    for slip, numbers in zip(
        sorted(found.slips, key=lambda s: s.column), (rows.joints, rows.orientations), strict=True
    ):
        assert slip.shown == numbers[2, -1]
    assert found.slips[0].miss < 0.3
    text = diagnosis_text(found)
    assert re.search(r"either \w+ in line 4 \(.* or \w+ in line 4 \(.*Compare them with the pendant", text)


@pytest.mark.long_unless("ZYX", "vector")
@pytest.mark.parametrize("kind", ["quaternion", "xyz", "ZYX", "ZYZ", "XYZ", "vector"])
def test_slips_in_orientations_of_every_convention_are_found(kind):
    table, truth, _, rng = true_case(1)
    rows = rows_of(table, truth, kind, rng.uniform(-2.9, 2.9, (4, 6)))
    right = rows.orientations[1, 1]
    rows.orientations[1, 1] += 0.3 if kind in ("quaternion", "vector") else 30
    found = diagnose(robot_of(table), rows)
    assert [(s.line, s.column) for s in found.slips] == [(3, rows.names[10])]
    assert found.slips[0].fitting == pytest.approx(right, abs=0.05)


def test_the_command_names_the_number(tmp_path, capsys):
    (tmp_path / "ur5.csv").write_text(TABLE)
    assert main(["new", "ur5", "--dh", str(tmp_path / "ur5.csv"), "--out", str(tmp_path)]) == 0
    (tmp_path / "p.csv").write_text(PENDANT.replace("0.0376", "0.0176"))
    capsys.readouterr()
    assert main(["doctor", str(tmp_path / "ur5"), str(tmp_path / "p.csv")]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "All rows fit but for one number: rx in line 2 (0.0176; about 0.0376 would fit)" in said
    assert "the tool on the pendant may be turned" not in said
    assert main(["doctor", str(tmp_path / "ur5"), str(tmp_path / "p.csv"), "--json"]) == 1
    (slip,) = json.loads(capsys.readouterr().out)["slips"]
    assert (slip["line"], slip["column"], slip["shown"]) == (2, "rx", 0.0176)
    (tmp_path / "p.csv").write_text(PENDANT.replace("132.92", "132.92e20"))
    assert main(["doctor", str(tmp_path / "ur5"), str(tmp_path / "p.csv")]) == 2
    assert "line 2, column 'q1_deg': 1.3292e+22 is beyond any robot" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e200])
def test_arrays_that_no_robot_shows_are_refused_by_row_and_column(value):
    numbers = np.array(CELLS, dtype=float)
    numbers[1, 7] = value
    with pytest.raises(SamplesError, match=r"rows, line 2, column 'y': .* is beyond any robot"):
        PendantRows(numbers[:, :6], numbers[:, 6:9], numbers[:, 9:])
