"""Samples by the million: large text files and arrays give what small ones do, or are refused as they are."""

import math

import numpy as np
import pandas as pd
import pytest

from casacal import bind
from casacal.data.columns import Labels, combinations
from casacal.data.samples import Layout, Samples, read_columns
from casacal.data.text import read_table
from casacal.errors import SamplesError

LAYOUT = Layout(("angle", "length"), {"reading": "length"}, ("plane",))
ROWS = 3000


def columns_of_rows():
    rng = np.random.default_rng(0)
    return {
        "q1_deg": np.round(rng.uniform(-180, 180, ROWS), 7),
        "q2_mm": np.round(rng.uniform(0, 900, ROWS), 4),
        "reading_um": np.round(rng.uniform(0, 9000, ROWS), 1),
        "plane": np.array(["left", "upper wall", "N/A"])[rng.integers(3, size=ROWS)],
    }


def text(delimiter=",", decimal="."):
    made = columns_of_rows()
    lines = [delimiter.join(made)]
    for row in zip(*made.values(), strict=True):
        lines.append(delimiter.join(str(cell).replace(".", decimal) for cell in row))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("spoil", "line"),
    [
        (lambda lines: [*lines[:100], "", *lines[100:]], None),  # a blank line is fine
        (lambda lines: [*lines[:100], "# pause", *lines[100:]], None),
        (lambda lines: [*lines[:100], "1,2,3,left\r1,2,3,left", "", *lines[101:]], None),
        (lambda lines: [*lines[:100], "nan,1,2,left", *lines[101:]], 101),
        (lambda lines: [*lines[:100], "1,,2,left", *lines[101:]], 101),
        (lambda lines: [*lines[:100], "1,2,left", *lines[101:]], 101),
        (lambda lines: [*lines[:100], "1,2,3,left,5", *lines[101:]], 101),
        (lambda lines: [*lines[:100], "1,2,3,", *lines[101:]], 101),
        (lambda lines: [*lines[:100], "1_0,2,3,left", *lines[101:]], 101),
        (lambda lines: [*lines[:100], "3700,2,3,left", *lines[101:]], 101),
    ],
)
def test_what_is_odd_in_a_large_file_is_read_or_refused_line_by_line(tmp_path, spoil, line):
    file = tmp_path / "s.csv"
    file.write_text("\n".join(spoil(text().splitlines())) + "\n")
    if line is None:
        expected = Samples.from_table(read_table(file), LAYOUT)
        assert tuple(Samples.from_csv(file, LAYOUT).lines) == tuple(expected.lines)
        return
    with pytest.raises(SamplesError, match=f"line {line}"):
        Samples.from_csv(file, LAYOUT)


def test_a_row_without_a_cell_is_refused_whatever_stands_in_the_last_column(tmp_path):
    lines = [f"{line},{'note' if i == 0 else 20 + i % 7}" for i, line in enumerate(text().splitlines())]
    lines[1234] = ",".join(lines[1234].split(",")[1:])
    file = tmp_path / "s.csv"
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(SamplesError, match="line 1235: the line has 4 cells where the header has 5"):
        Samples.from_csv(file, LAYOUT)


def test_numbers_alone_are_refused_with_a_cell_moved_to_the_next_line(tmp_path):
    rows = ["1,2,3"] * 500
    rows[100], rows[101] = "1,2", "1,2,3,4"  # together as many as there should be
    file = tmp_path / "s.csv"
    file.write_text("\n".join(["q1_deg,q2_mm,reading_mm", *rows]) + "\n")
    with pytest.raises(SamplesError, match="line 102: the line has 2 cells where the header has 3"):
        Samples.from_csv(file, LAYOUT)


def test_a_byte_order_mark_within_a_file_is_part_of_its_label(tmp_path):
    order = [3, 0, 1, 2]
    lines = [",".join(line.split(",")[k] for k in order) for line in text().replace("left", "\ufeffleft").splitlines()]
    file = tmp_path / "s.csv"
    for each in (lines, [f"{line},{'note' if k == 0 else 'x'}" for k, line in enumerate(lines)]):
        file.write_text("\n".join(each) + "\n")
        expected = Samples.from_table(read_table(file), LAYOUT)
        assert "\ufeffleft" in expected.labels["plane"].names
        assert Samples.from_csv(file, LAYOUT).labels["plane"] == expected.labels["plane"]


def test_as_many_labels_as_rows_are_labels(tmp_path):
    made = text().splitlines()
    lines = [line.replace("left", f"left {k}") for k, line in enumerate(made)]
    file = tmp_path / "s.csv"
    file.write_text("\n".join(lines) + "\n")
    expected = Samples.from_table(read_table(file), LAYOUT)
    assert Samples.from_csv(file, LAYOUT).labels["plane"] == expected.labels["plane"]


def test_two_decimal_marks_are_refused_however_far_apart(tmp_path):
    file = tmp_path / "s.csv"
    file.write_text(text(";", ",") + "1;2;3;left\n" * 3000 + "1.5;2.5;3;left\n" * 3000)  # each in its own sections
    with pytest.raises(SamplesError, match=f"line {ROWS + 3002}, column 'q1_deg': decimal commas and decimal points"):
        Samples.from_csv(file, LAYOUT)


def test_a_number_that_is_too_large_is_not_finite(tmp_path):
    file = tmp_path / "s.csv"
    file.write_text(text() + "1,1e999,3,left\n")
    with pytest.raises(SamplesError, match=f"line {ROWS + 2}, column 'q2_mm': '1e999' is not a finite number"):
        Samples.from_csv(file, LAYOUT)


def test_columns_that_nobody_named_are_read_when_asked_for(tmp_path):
    file = tmp_path / "s.csv"
    file.write_text(text())
    columns = read_columns(file)
    np.testing.assert_array_equal(columns.number("reading_um"), columns_of_rows()["reading_um"])
    assert columns.text("plane") == tuple(columns_of_rows()["plane"])
    assert columns.cell("q2_mm", 1700) == text().splitlines()[1701].split(",")[1]


@pytest.mark.parametrize("row", ["1,12\0,3,left", "1,12,3,left\0"])
def test_zero_bytes_are_no_text(tmp_path, row):
    file = tmp_path / "s.csv"
    lines = text().splitlines()
    lines[2500] = row
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(SamplesError, match="zero bytes"):
        Samples.from_csv(file, LAYOUT)


def check_arrays(found):
    made = columns_of_rows()
    np.testing.assert_allclose(found.joints, np.column_stack([np.radians(made["q1_deg"]), made["q2_mm"]]), rtol=1e-15)
    np.testing.assert_allclose(found.columns["reading"], made["reading_um"] / 1000, rtol=1e-15)
    assert found.labels["plane"] == tuple(made["plane"])
    assert found.lines[:2] == range(1, 3)


def test_arrays_are_samples_too(tmp_path):
    made = columns_of_rows()
    np.savez(tmp_path / "s.npz", **made)
    check_arrays(Samples.from_file(tmp_path / "s.npz", LAYOUT))
    fields = np.zeros(ROWS, dtype=[(name, values.dtype) for name, values in made.items()])
    for name, values in made.items():
        fields[name] = values
    np.save(tmp_path / "s.npy", fields)
    check_arrays(Samples.from_file(tmp_path / "s.npy", LAYOUT))
    assert len(Samples.from_file(tmp_path / "s.npy", LAYOUT).sha256) == 64


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"q1_deg": np.zeros(2)}, "q1_deg 2"),
        ({"q1_deg": np.full(ROWS, np.nan)}, "line 1, column .?q1_deg"),
        ({"q1_deg": np.full(ROWS, 4000.0)}, "absurd"),
        ({"q2_mm": np.zeros((ROWS, 2))}, "one number per row"),
        ({"q2_mm": np.full(ROWS, "12")}, "not numbers"),
        ({"plane": np.full(ROWS, " ")}, "the label is empty"),
        ({"q2_mm": None}, "there is no column for q2"),
        ({"plane": np.array([object()] * ROWS)}, "without Python objects"),
    ],
)
def test_bad_arrays_are_refused(tmp_path, change, words):
    made = {name: values for name, values in (columns_of_rows() | change).items() if values is not None}
    np.savez(tmp_path / "s.npz", **made)
    with pytest.raises(SamplesError, match=words):
        Samples.from_file(tmp_path / "s.npz", LAYOUT)


def test_arrays_without_names_and_other_files_are_refused(tmp_path):
    np.save(tmp_path / "s.npy", np.zeros((5, 7)))
    with pytest.raises(SamplesError, match="no named columns"):
        Samples.from_file(tmp_path / "s.npy", LAYOUT)
    (tmp_path / "t.npz").write_text("q1_deg\n1\n")
    with pytest.raises(SamplesError, match="not an array file"):
        Samples.from_file(tmp_path / "t.npz", LAYOUT)
    with pytest.raises(SamplesError, match="no such file"):
        Samples.from_file(tmp_path / "u.npy", LAYOUT)


def test_a_frame_of_numbers_is_a_frame_of_text(tmp_path):
    frame = pd.DataFrame(columns_of_rows())
    numbers, words = Samples.from_frame(frame, LAYOUT), Samples.from_frame(frame.astype(str), LAYOUT)
    np.testing.assert_allclose(numbers.joints, words.joints, rtol=1e-15)
    assert numbers.labels["plane"] == words.labels["plane"]
    assert tuple(numbers.lines) == words.lines
    changed = frame.assign(q1_deg=frame["q1_deg"] + 1)
    assert Samples.from_frame(changed, LAYOUT).sha256 != numbers.sha256


def test_labels_read_like_a_tuple():
    labels = Labels.of(("b", "a", "b", "c"))
    assert labels.names == ("b", "a", "c")
    assert labels == ("b", "a", "b", "c")
    assert labels != ("b", "a", "b", "b")
    assert (labels[1], labels[-1], labels[1:3], len(labels)) == ("a", "c", ("a", "b"), 4)
    assert labels.take(np.array([3, 3])).names == ("c",)
    assert np.asarray(labels).tolist() == ["b", "a", "b", "c"]
    other = Labels.of(("x", "y", "x", "x"))
    distinct, codes = combinations([labels, other], 4)
    assert [distinct[code] for code in codes] == [("b", "x"), ("a", "y"), ("b", "x"), ("c", "x")]
    assert combinations([], 3)[0] == [()]


@pytest.mark.parametrize("spread", [1, 1000])
def test_labels_are_numbered_as_they_appear(spread):
    """Few numbers are counted, numbers far apart are sorted: both give the same."""
    codes = np.random.default_rng(3).integers(40, size=500)
    labels = Labels([f"n{k}" for k in range(40 * spread)], codes * spread)
    assert labels == tuple(f"n{code * spread}" for code in codes)
    assert labels.names == tuple(dict.fromkeys(labels))


def test_thousands_of_rows_propose_the_plane_that_few_do(hsr):
    rows = hsr.problem.read(hsr.samples)
    few, many = bind(hsr.problem, rows), bind(hsr.problem, rows.take(np.tile(np.arange(120), 200)))
    for one, other in zip(few.slots, many.slots, strict=True):
        np.testing.assert_allclose(one.nominal, other.nominal, rtol=1e-9, atol=1e-9)
    assert many.normal(many.x0).cost == pytest.approx(200 * few.normal(few.x0).cost, rel=1e-9)
    r, triangle = few.jacobian(few.x0), many.compact_jacobian(many.x0)
    np.testing.assert_allclose(triangle.T @ triangle, 200 * r.T @ r, rtol=1e-8, atol=1e-3)
    assert math.isfinite(many.cost(many.x0))
