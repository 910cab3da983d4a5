"""Lines that begin with #: comments, rows that were taken out, and labels; both readers of text take them alike."""

import numpy as np
import pytest
from conftest import ROOT

from casacal import Robot, load_problem
from casacal.data.samples import Layout, Samples, read_columns
from casacal.data.text import joined_tables, read_table
from casacal.deployment.compensate import read_targets
from casacal.deployment.predict import joints_from
from casacal.doctor import read_pendant_rows
from casacal.errors import ProblemError, SamplesError

HSR = ROOT / "problems" / "hsr_jr680"
LAYOUT = Layout(("angle", "length"), {"reading": "length"}, ("plane",))
LABEL_FIRST = "plane,q1_deg,q2_mm,reading_mm"
NUMBER_FIRST = "q1_deg,q2_mm,reading_mm,plane"
WAYS_OUT = r'Rename its label, or in a CSV file quote it, as in "#1"; delete a comment, or put it above the header'


def rows(first):
    """Rows whose labels stand first, or last, or that are counted before their labels."""
    numbers = [f"{k},{k}.5,0.{k}" for k in range(10, 60)]
    before = {"label": "left,{}", "number": "{},left"}[first]
    return [before.format(row) for row in numbers]


def read(tmp_path, header, lines, *, delimiter=",", end="\n"):
    file = tmp_path / "s.csv"
    text = end.join([header, *lines]) + end
    file.write_bytes(text.replace(",", delimiter).encode())
    return Samples.from_file(file, LAYOUT)


@pytest.mark.parametrize(
    "written", ["#1,7,7.5,0.7", "  #1,7,7.5,0.7", "# left,7,7.5,0.7", "#,7,7.5,0.7", "#1,7,7.5,0.7,"]
)
@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("at", [0, 24, 50])
def test_a_row_whose_label_begins_with_a_hash_is_asked_about(tmp_path, written, delimiter, at):
    lines = rows("label")
    lines.insert(at, written)
    with pytest.raises(SamplesError, match=WAYS_OUT) as refusal:
        read(tmp_path, LABEL_FIRST, lines, delimiter=delimiter)
    assert f"{tmp_path / 's.csv'}, line {at + 2}: the line begins with #" in str(refusal.value)


def test_decimal_commas_and_windows_lines_hide_no_row(tmp_path):
    lines = [row.replace(",", ";").replace(".", ",") for row in [*rows("label"), "#1,7,7.5,0.7"]]
    (tmp_path / "s.csv").write_bytes("\r\n".join([LABEL_FIRST.replace(",", ";"), *lines]).encode())
    with pytest.raises(SamplesError, match="line 52: the line begins with #"):
        Samples.from_file(tmp_path / "s.csv", LAYOUT)


@pytest.mark.parametrize(
    "written",
    [
        "# measured by Ann, on Monday, with care",
        "# left, 7, 7.5, see below",
        "# left: 7, 7.5",
        "#,,,",
        "# at 7, 8, 9 and 10 o'clock",
        "# " + "x" * 140_000 + ",7,7.5,0.7",
    ],
)
@pytest.mark.parametrize("first", ["label", "number"])
def test_prose_is_a_comment(tmp_path, written, first):
    header = {"label": LABEL_FIRST, "number": NUMBER_FIRST}[first]
    found = read(tmp_path, header, [*rows(first)[:30], written, *rows(first)[30:]])
    assert len(found) == 50
    assert list(found.lines) == [*range(2, 32), *range(33, 53)]


def test_a_row_of_numbers_that_was_taken_out_is_a_comment(tmp_path):
    lines = rows("number")
    lines[20] = "#" + lines[20]
    assert len(read(tmp_path, NUMBER_FIRST, lines)) == 49


def test_a_counted_row_that_was_taken_out_is_a_comment(tmp_path):
    """What counts rows is no quantity, but a number."""
    lines = [f"{k},{row}" for k, row in enumerate(rows("number"))]
    lines[20] = "#" + lines[20]
    assert len(read(tmp_path, f"n,{NUMBER_FIRST}", lines)) == 49
    lines[45] = "x" + lines[45]
    with pytest.raises(SamplesError, match="line 22: the line begins with #"):
        read(tmp_path, f"n,{NUMBER_FIRST}", lines)
    lines[45] = '"1,a"' + lines[45].removeprefix("x45")
    with pytest.raises(SamplesError, match="line 22: the line begins with #"):
        read(tmp_path, f"n,{NUMBER_FIRST}", lines)


def test_above_the_header_all_is_a_comment(tmp_path):
    found = read(tmp_path, f"#1,7,7.5,0.7\n{LABEL_FIRST}", rows("label"))
    assert len(found) == 50


def test_labels_in_quotes_are_labels(tmp_path):
    found = read(tmp_path, LABEL_FIRST, [row.replace("left", '"#1"') for row in rows("label")])
    assert found.labels["plane"] == ("#1",) * 50


def test_labels_that_all_vanish_are_named(tmp_path):
    with pytest.raises(
        SamplesError, match=r"no line of data\. Give one line per sample, and quote labels that begin with #"
    ):
        read(tmp_path, LABEL_FIRST, [row.replace("left", "#1") for row in rows("label")])


def test_other_columns_of_text_are_no_numbers_to_look_for(tmp_path):
    lines = [f"{row},fine" for row in rows("label")]
    with pytest.raises(SamplesError, match="line 52: the line begins with #"):
        read(tmp_path, f"{LABEL_FIRST},note", [*lines, "#1,7,7.5,0.7,odd"])


def test_a_number_that_no_problem_asks_for_tells_prose(tmp_path):
    lines = [f"{row},21.5" for row in rows("label")]
    found = read(tmp_path, f"{LABEL_FIRST},temperature", [*lines, "#left,7,7.5,0.7,cold"])
    assert len(found) == 50


JOINTS = ",".join(f"q{k}_deg" for k in range(1, 7))
READERS = {
    "joints": (lambda path: joints_from(path, load_problem(HSR)), JOINTS, "1,2,3,4,5,6"),
    "targets": (lambda path: read_targets(path, load_problem(HSR)), JOINTS, "1,2,3,4,5,6"),
    "poses": (lambda path: read_targets(path, load_problem(HSR)), "x_mm,y_mm,z_mm,qw,qx,qy,qz", "1,2,3,1,0,0,0"),
    "pendant": (lambda path: read_pendant_rows(path, [True]), "q1_deg,x_mm,y_mm,z_mm,qw,qx,qy,qz", "1,2,3,4,1,0,0,0"),
    "columns": (lambda path: read_columns(path), "a,b", "1,2"),
    "readings": (lambda path: joined_tables(read_table(path), read_table(path), key="name"), "a,b", "1,2"),
}  # fmt: skip


@pytest.mark.parametrize("kind", READERS)
def test_every_reader_of_tables_asks(tmp_path, kind):
    reading, header, row = READERS[kind]
    file = tmp_path / "s.csv"
    lines = [f"name,{header}", f"first,{row}", f"#2,{row}", f"third,{row}"]
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(SamplesError, match="line 3: the line begins with #"):
        reading(file)


def test_a_joint_of_a_table_does_not_vanish(tmp_path):
    file = tmp_path / "arm.csv"
    file.write_text("note,alpha_deg,a_mm,d_mm,theta_deg\nbase,90,0,100,0\n#2,0,300,0,0\n")
    with pytest.raises(ProblemError, match="line 3: the line begins with #"):
        Robot.from_dh_file(file)


def test_a_row_of_a_workbook_does_not_vanish(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in (LABEL_FIRST, "left,1,2,0.5", "# measured by Ann,on Monday,,", "#N/A,1,2,0.5", "#1,7,7.5,0.7"):
        book.active.append([float(cell) if cell[:1].isdigit() else cell for cell in row.split(",")])
    book.save(tmp_path / "s.xlsx")
    with pytest.raises(SamplesError, match="line 5: the line begins with #"):
        Samples.from_file(tmp_path / "s.xlsx", LAYOUT)
    book.active.delete_rows(5)
    book.save(tmp_path / "s.xlsx")
    found = Samples.from_file(tmp_path / "s.xlsx", LAYOUT)
    assert found.labels["plane"] == ("left", "#N/A")
    np.testing.assert_allclose(found.columns["reading"], 0.5)
