"""Workbooks, and readings in a file of their own, give the samples that one CSV file gives."""

import datetime
import re
import sys
import zipfile

import numpy as np
import pytest
from openpyxl import Workbook

from casacal.cli.main import main
from casacal.data.archives import read_workbook
from casacal.data.samples import Layout, Samples
from casacal.data.text import joined_tables, read_table
from casacal.errors import SamplesError

LAYOUT = Layout(("angle", "length"), {"reading": "length"}, ("plane",))
HEADER = ["q1_deg", "q2_mm", "reading_mm", "plane", "when"]
ROWS = [[10, 200.5, 1.25, "left", datetime.datetime(2026, 1, 2, 3, 4)], [-20.5, 300.0, "0.5", " right ", None]]


def workbook(path, rows):
    book = Workbook()
    for row in rows:
        book.active.append(row)
    book.save(path)
    return path


def test_a_workbook_is_read_like_the_csv_file_it_would_be_saved_as(tmp_path):
    file = workbook(tmp_path / "s.xlsx", [["# measured on Friday"], [], HEADER, ROWS[0], [], ROWS[1]])
    (tmp_path / "s.csv").write_text("q1_deg,q2_mm,reading_mm,plane\n10,200.5,1.25,left\n-20.5,300,0.5,right\n")
    found, expected = Samples.from_file(file, LAYOUT), Samples.from_file(tmp_path / "s.csv", LAYOUT)
    np.testing.assert_array_equal(found.joints, expected.joints)
    np.testing.assert_array_equal(found.columns["reading"], expected.columns["reading"])
    assert found.labels["plane"] == expected.labels["plane"]
    assert found.lines == (4, 6)
    assert len(found.sha256) == 64


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([], "empty"),
        ([HEADER], "no line of data"),
        ([HEADER, [1, 2, "=1+", "left", ""]], "line 2, column 'reading_mm'"),
        ([HEADER, [1, 2, None, "left", ""]], "the cell is empty"),
        ([HEADER, [1, 2, 3, "left", "", "", 7]], "line 2: a cell has no name in the header"),
        ([["q1_deg", "q1_deg"], [1, 2]], "twice"),
    ],
)
def test_bad_sheets_are_refused(tmp_path, rows, words):
    with pytest.raises(SamplesError, match=words):
        Samples.from_file(workbook(tmp_path / "s.xlsx", rows), LAYOUT)


def changed(path, old, new):
    """The workbook with something else in the text of its first sheet."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    sheet = members["xl/worksheets/sheet1.xml"]
    assert old in sheet
    members["xl/worksheets/sheet1.xml"] = sheet.replace(old, new)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def test_a_size_that_is_said_wrong_loses_no_row(tmp_path):
    file = workbook(tmp_path / "s.xlsx", [HEADER, *[[k, 2, 3, "left", ""] for k in range(60)]])
    assert len(Samples.from_file(changed(file, b'ref="A1:E%d"' % 61, b'ref="B2:C5"'), LAYOUT)) == 60


@pytest.mark.parametrize("place", ["XFD20000", "XFD1048576"])
def test_a_cell_that_is_only_coloured_is_no_cell(tmp_path, place):
    file = workbook(tmp_path / "s.xlsx", [HEADER, ROWS[0]])
    row = f'<row r="{place[3:]}"><c r="{place}" s="0"/></row></sheetData>'
    assert len(Samples.from_file(changed(file, b"</sheetData>", row.encode()), LAYOUT)) == 1


def test_rows_out_of_their_order_are_refused(tmp_path):
    file = workbook(tmp_path / "s.xlsx", [HEADER, ROWS[0], ROWS[0]])  # of which the library drops one
    with pytest.raises(SamplesError, match="line 2: the rows are out of order"):
        read_workbook(changed(file, b'<row r="3"', b'<row r="2"'))


def test_hidden_rows_are_refused_where_they_hold_something(tmp_path):
    book = Workbook()
    for row in ([], ["# a remark"], HEADER, ROWS[0], ROWS[0]):
        book.active.append(row)
    for number in (1, 2):
        book.active.row_dimensions[number].hidden = True
    book.save(tmp_path / "s.xlsx")
    assert len(read_workbook(tmp_path / "s.xlsx").rows) == 2
    book.active.row_dimensions[5].hidden = True
    book.save(tmp_path / "s.xlsx")
    with pytest.raises(SamplesError, match="line 5: the row is hidden"):
        read_workbook(tmp_path / "s.xlsx")


def test_which_sheet_was_read_is_said_where_there_are_more(tmp_path):
    book = Workbook()
    book.active.title = "old"
    book.active.sheet_state = "hidden"
    for row in (HEADER, ROWS[0]):
        book.create_sheet("dial").append(row) if row is HEADER else book["dial"].append(row)
    book.create_sheet("remarks").append(["none"])
    book.save(tmp_path / "s.xlsx")
    assert read_workbook(tmp_path / "s.xlsx").file == f"{tmp_path / 's.xlsx'}, sheet 'dial'"
    assert Samples.from_file(tmp_path / "s.xlsx", LAYOUT).joints[0, 1] == 200.5


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_a_line_that_tells_a_spreadsheet_what_stands_between_cells_is_none(tmp_path, mark):
    rows = mark.join(HEADER[:4]) + "\n" + mark.join(["10", "200.5", "1.25", "left"]) + "\n"
    (tmp_path / "s.csv").write_text(f"sep={mark}\n{rows}")
    found = Samples.from_file(tmp_path / "s.csv", LAYOUT)
    assert (found.columns["reading"].tolist(), found.lines) == ([1.25], (3,))
    (tmp_path / "s.csv").write_text(f"{rows}sep={mark}\n")
    with pytest.raises(SamplesError, match="line 3"):
        Samples.from_file(tmp_path / "s.csv", LAYOUT)


def test_what_could_not_be_calculated_is_no_comment(tmp_path):
    file = workbook(tmp_path / "s.xlsx", [HEADER, ROWS[0], ["#REF!", *ROWS[0][1:]]])
    with pytest.raises(SamplesError, match="line 3, column 'q1_deg': '#REF!' is not a finite number"):
        Samples.from_file(file, LAYOUT)


def test_a_label_of_two_lines_is_refused(tmp_path):
    with pytest.raises(SamplesError, match="line 2, column 'plane': the label holds a line break") as refusal:
        Samples.from_file(workbook(tmp_path / "s.xlsx", [HEADER, [1, 2, 3, "left\nwall", ""]]), LAYOUT)
    assert "\n" not in str(refusal.value)


def test_without_its_library_a_workbook_is_refused_in_a_sentence(tmp_path, monkeypatch, hsr, capsys):
    file = workbook(tmp_path / "s.xlsx", [HEADER, ROWS[0]])
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    assert main(["check", str(hsr.path), str(file)]) == 2
    said = capsys.readouterr().err
    assert "needs a library" in said
    assert "pip install openpyxl" in said
    assert said.count("\n") == 1


def test_what_is_no_workbook_is_refused(tmp_path):
    (tmp_path / "s.xlsx").write_text("q1_deg\n")
    with pytest.raises(SamplesError, match="no readable workbook"):
        read_workbook(tmp_path / "s.xlsx")
    with pytest.raises(SamplesError, match="no such file"):
        read_workbook(tmp_path / "t.xlsx")


POSES = "pose;q1_deg;q2_mm;plane\nA;10,5;200,5;left\nB;-20,5;300;right\n"
READINGS = "reading_mm,pose\n0.5,B\n1.25,A\n"


def tables(tmp_path, poses=POSES, readings=READINGS):
    (tmp_path / "poses.csv").write_text(poses)
    (tmp_path / "readings.csv").write_text(readings)
    return read_table(tmp_path / "poses.csv"), read_table(tmp_path / "readings.csv")


def test_readings_find_their_poses(tmp_path):
    samples = Samples.from_table(joined_tables(*tables(tmp_path)), LAYOUT)
    np.testing.assert_allclose(np.degrees(samples.joints[:, 0]), [10.5, -20.5])
    np.testing.assert_array_equal(samples.columns["reading"], [1.25, 0.5])
    assert samples.labels["plane"] == ("left", "right")
    assert samples.lines == (2, 3)
    other = joined_tables(*tables(tmp_path, readings=READINGS.replace("0.5", "0.6")))
    assert Samples.from_table(other, LAYOUT).sha256 != samples.sha256


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"readings": READINGS.replace("pose", "id")}, "no column 'pose'"),
        ({"readings": READINGS.replace(",B", ",A")}, "'A' appears twice"),
        ({"poses": POSES.replace("B;", "A;")}, "'A' appears twice"),
        ({"readings": READINGS.replace("0.5,B\n", "")}, "pose 'B' has no reading"),
        ({"readings": READINGS + "3,C\n"}, "'C' has no pose"),
        ({"readings": READINGS.replace("A", "")}, "the id is empty"),
        ({"readings": "pose,plane\nA,x\nB,y\n"}, "has this column too"),
    ],
)
def test_poses_and_readings_that_do_not_match_are_refused(tmp_path, change, words):
    with pytest.raises(SamplesError, match=words):
        joined_tables(*tables(tmp_path, **change))


@pytest.mark.long
def test_the_command_line_takes_both(hsr, tmp_path, capsys):
    text = hsr.samples.read_text().splitlines()[1:]
    cells = [line.split(",") for line in text]
    poses = [["touch", *row[:6], row[7]] if k == 0 else [str(k), *row[:6], row[7]] for k, row in enumerate(cells)]
    readings = [["touch", row[6]] if k == 0 else [k, float(row[6])] for k, row in enumerate(cells)]
    (tmp_path / "poses.csv").write_text("\n".join(",".join(row) for row in poses) + "\n")
    workbook(tmp_path / "dial.xlsx", [readings[0], *reversed(readings[1:])])
    given = [str(hsr.path), str(tmp_path / "poses.csv"), "--readings", str(tmp_path / "dial.xlsx"), "--id", "touch"]
    assert main(["check", *given]) == 0
    assert main(["calibrate", *given, "--method", "lm", "--no-reference"]) == 0
    apart = capsys.readouterr().out
    assert main(["calibrate", str(hsr.path), "--method", "lm", "--no-reference"]) == 0
    assert capsys.readouterr().out.splitlines()[-5:] == apart.splitlines()[-5:]


def test_rows_of_formulas_without_results_are_not_passed_over(tmp_path):
    """As a program writes them that does not calculate. Formulas whose text is empty, as below the data, are none."""
    rows = [["q1_deg", "reading_mm"], [10, 1.5], ["=A2+10", "=B2+1"], [40, 4.5]]
    layout = Layout(("angle",), {"reading": "length"})
    file = workbook(tmp_path / "s.xlsx", rows)
    with pytest.raises(SamplesError, match=r"line 3.*formulas without results"):
        Samples.from_file(file, layout)
    with zipfile.ZipFile(file) as archive, zipfile.ZipFile(tmp_path / "t.xlsx", "w") as other:
        for name in archive.namelist():
            text = archive.read(name)
            if name.endswith("sheet1.xml"):
                text = re.sub(rb'<c r="([AB]3)"><f>', rb'<c r="\1" t="str"><f>', text)
            other.writestr(name, text)
    assert Samples.from_file(tmp_path / "t.xlsx", layout).lines == (2, 4)
