"""The samples file: what is understood, and what is refused with file, line, column and fix."""

import dataclasses
import math

import numpy as np
import pandas as pd
import pytest
from conftest import ROOT

from casacal import calibrate, load_problem
from casacal.data.repeats import copies_of
from casacal.data.samples import Layout, Samples, joined, write_samples
from casacal.errors import CasacalError, SamplesError

LAYOUT = Layout(("angle", "length"), {"reading": "length"}, ("plane",), {"force": "no force is measured"})
GOOD = """# a comment
q1_deg,q2_mm,reading_mm,plane,note

10,200.5,1.25,left,hello
-20.5,3e2,0.5,"right",
"""


def read(tmp_path, content, layout=LAYOUT):
    file = tmp_path / "s.csv"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return Samples.from_csv(file, layout)


def check_good(samples):
    np.testing.assert_allclose(samples.joints, [[math.radians(10), 200.5], [math.radians(-20.5), 300]])
    np.testing.assert_allclose(samples.columns["reading"], [1.25, 0.5])
    assert samples.labels["plane"] == ("left", "right")


def test_a_good_file(tmp_path):
    samples = read(tmp_path, GOOD)
    check_good(samples)
    assert samples.lines == (4, 5)
    assert samples.extra == {"note": ("hello", "")}
    assert len(samples.sha256) == 64
    with pytest.raises(ValueError, match="read-only"):
        samples.joints[0, 0] = 1
    assert samples.take([1]).lines == (5,)


@pytest.mark.parametrize(
    "content",
    [
        ("\ufeff" + GOOD).encode(),
        GOOD.encode("utf-16"),
        GOOD.replace("\n", "\r\n").encode(),
        GOOD.replace(",", ";").encode(),
        GOOD.replace(",", ";").replace(".", ",").encode(),
        GOOD.replace(",", "\t").encode(),
        GOOD.replace("q1_deg", "q1_rad")
        .replace("10,", f"{math.radians(10)},")
        .replace("-20.5", f"{math.radians(-20.5)}"),
        GOOD.replace("reading_mm", "reading_um").replace("1.25", "1250").replace(",0.5", ",500"),
        GOOD.replace("reading_mm", "reading_in")
        .replace("1.25", repr(1.25 / 25.4))
        .replace(",0.5", "," + repr(0.5 / 25.4)),
    ],
    ids=["bom", "utf-16", "crlf", "semicolon", "decimal comma", "tab", "radians", "micrometres", "inches"],
)
def test_other_spellings_of_the_same_file(tmp_path, content):
    check_good(read(tmp_path, content))


@pytest.mark.parametrize(
    ("content", "line", "column", "says"),
    [
        (GOOD.replace("200.5", "abc"), 4, "q2_mm", "'abc' is not a finite number"),
        (GOOD.replace("200.5", "nan"), 4, "q2_mm", "not a finite number"),
        (GOOD.replace("200.5", "inf"), 4, "q2_mm", "not a finite number"),
        (GOOD.replace("200.5", "1e999"), 4, "q2_mm", "not a finite number"),
        (GOOD.replace("200.5", "2_00"), 4, "q2_mm", "not a finite number"),
        (GOOD.replace("200.5", ""), 4, "q2_mm", "empty"),
        (GOOD.replace("10,", "1e6,"), 4, "q1_deg", "absurd"),
        (GOOD.replace("10,200.5", "10"), 4, None, "4 cells where the header has 5"),
        (GOOD.replace("hello", "hello,1"), 4, None, "6 cells"),
        (GOOD.replace("left", ""), 4, "plane", "label is empty"),
        (GOOD.replace("q2_mm", "q1_deg"), 2, "q1_deg", "twice"),
        (GOOD.replace("q2_mm", "q2"), 2, "q2", "no unit"),
        (GOOD.replace("q2_mm", "q2_deg"), 2, "q2_deg", "does not carry a unit"),
        (GOOD.replace("q2_mm", "Q2_mm"), 2, None, "did you mean 'Q2_mm'"),
        (GOOD.replace("note", "q1_rad"), 2, "q1_rad", "both give q1"),
        (GOOD.replace("note", "q3_deg"), 2, "q3_deg", "2 joints"),
        (GOOD.replace("note", "force_N"), 2, "force_N", "no force is measured"),
        (GOOD.replace("reading_mm", "depth"), 2, None, "no column for reading"),
        (GOOD.replace("note", ""), 2, None, "column 5 has no name"),
        (GOOD.replace("q1_deg,q2_mm,reading_mm,plane,note\n", ""), 3, None, "not column names"),
        ("q1_deg,q2_mm,reading_mm,plane\n", 1, None, "no line of data"),
        (GOOD.replace(",", ";").replace("200.5", "200,5"), None, None, "mixed"),
        (GOOD.replace('"right"', '"right'), 5, None, "quote"),
        (GOOD.replace("hello", "h\xe9llo").encode("latin-1"), 4, None, "UTF-8"),
        (b"", None, None, "empty"),
        (b"\n# only a comment\n", None, None, "empty"),
        (bytes(range(256)), None, None, "not a text file"),
        (b"\x01\x02q1_deg\n", None, None, "control characters"),
        (GOOD.encode("utf-16")[2:], None, None, "zero bytes"),
    ],
)
def test_bad_files_are_refused_by_name(tmp_path, content, line, column, says):
    with pytest.raises(SamplesError, match=says) as refusal:
        read(tmp_path, content)
    message = str(refusal.value)
    assert str(tmp_path / "s.csv") in message
    assert "\n" not in message
    if line is not None:
        assert f"line {line}" in message
    if column is not None:
        assert f"column '{column}'" in message
    assert refusal.value.fix


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    for place in (tmp_path / "none.csv", tmp_path):
        with pytest.raises(SamplesError):
            Samples.from_csv(place, LAYOUT)


def test_a_data_frame_reads_like_the_file(tmp_path):
    frame = pd.DataFrame(
        {"q1_deg": [10, -20.5], "q2_mm": [200.5, 300.0], "reading_mm": [1.25, 0.5], "plane": ["left", "right"]}
    )
    check_good(Samples.from_frame(frame, LAYOUT))
    with pytest.raises(SamplesError, match="line 2, column 'q2_mm'"):
        Samples.from_frame(frame.assign(q2_mm=[1.0, math.nan]), LAYOUT)
    for missing in (math.nan, None, pd.NA):
        for numbers in (frame, frame.astype({"q1_deg": object})):
            with pytest.raises(SamplesError, match="the label is empty"):
                Samples.from_frame(numbers.assign(plane=["floor", missing]), LAYOUT)
    for numbers in (frame, frame.astype({"q1_deg": object})):  # a label that is a number is called as a file calls it
        assert Samples.from_frame(numbers.assign(plane=[1.0, 2.5]), LAYOUT).labels["plane"].names == ("1", "2.5")


def test_written_samples_read_back(tmp_path, hsr, corner_simulation):
    odd = dataclasses.replace(corner_simulation.samples, labels={"plane": tuple(f'a "{i % 3}", b' for i in range(120))})
    write_samples(tmp_path / "w.csv", hsr.problem.layout(), odd, ["a comment"])
    again = hsr.problem.read(tmp_path / "w.csv")
    assert again.labels["plane"] == odd.labels["plane"]
    np.testing.assert_allclose(again.joints, odd.joints, atol=2e-9)
    np.testing.assert_allclose(again.columns["reading"], odd.columns["reading"], atol=6e-5)


def test_written_numbers_keep_their_size_and_what_terms_ask_for(tmp_path):
    layout = Layout(("angle",), {"field": "number"}, (), further=("payload_kg",))
    given = Samples.from_arrays(
        {"q1_rad": [0.1, 0.2], "field": [1.23456789e-10, 3.3e7], "payload_kg": [1.5, 2.0]}, layout
    )
    write_samples(tmp_path / "s.csv", layout, given, ())
    again = Samples.from_file(tmp_path / "s.csv", layout)
    assert again.columns["field"].tolist() == [1.23456789e-10, 3.3e7]
    assert again.extra["payload_kg"].tolist() == [1.5, 2.0]


def test_masked_values_and_missing_dates_are_no_values():
    layout = Layout(("angle",), {"reading": "length"}, ("plane",))
    arrays = {
        "q1_rad": np.array([0.1, 0.2]),
        "reading_mm": np.ma.array([1.0, -999.0], mask=[0, 1]),
        "plane": ["a", "b"],
    }
    with pytest.raises(SamplesError, match="line 2, column 'reading_mm': the value is masked"):
        Samples.from_arrays(arrays, layout)
    arrays |= {"reading_mm": np.array([1.0, 2.0]), "plane": np.array(["2020-01-01", "NaT"], "M8[D]")}
    with pytest.raises(SamplesError, match="line 2, column 'plane': the label is empty"):
        Samples.from_arrays(arrays, layout)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("q1_rad;reading_mm;plane\n0,1;1,5;1.2\n0,2;1,5;1.3\n", None),
        (
            "q1_rad;reading_mm;plane\n0.1;1,5;a\n0.2;1,5;b\n",
            "points are mixed: '0.1', and another column has commas",
        ),
        ("q1_rad;reading_mm;plane\n0,1;1,5;a\n0,2;1.5;b\n", "decimal commas and decimal points are mixed"),
    ],
)
def test_labels_with_points_are_no_numbers_beside_decimal_commas(text, said, tmp_path):
    layout = Layout(("angle",), {"reading": "length"}, ("plane",))
    (tmp_path / "s.csv").write_text(text)
    if said is not None:
        with pytest.raises(SamplesError, match=said):
            Samples.from_file(tmp_path / "s.csv", layout)
        return
    read = Samples.from_file(tmp_path / "s.csv", layout)
    assert read.joints.ravel().tolist() == [0.1, 0.2]
    assert list(read.labels["plane"]) == ["1.2", "1.3"]


def test_without_labels_all_rows_share_one(tmp_path):
    assert read(tmp_path, "q1_deg,q2_mm,reading_mm\n1,2,3\n").labels["plane"] == ("plane",)


@pytest.mark.parametrize("given", [None, "q1", lambda: None])
def test_what_is_no_layout_is_refused_in_a_sentence(hsr, given):
    """As people try the problem, or its method, first."""
    layouts = (given, hsr.problem, hsr.problem.layout)
    for layout in layouts:
        with pytest.raises(CasacalError, match=r"as the layout of samples. Give problem.layout\(\)"):
            Samples.from_file(hsr.samples, layout)
        with pytest.raises(CasacalError, match=r"as the layout of samples. Give problem.layout\(\)"):
            Samples.from_frame(pd.DataFrame({"q1_deg": [1.0]}), layout)


def test_blank_lines_and_comments_between_rows_change_no_result(hsr, tmp_path):
    """What comes after what is a matter of rows: drift and growth go by their order, not by the lines they stand on."""
    text = (ROOT / "problems" / "hsr_jr680" / "samples.csv").read_text(encoding="utf-8")
    lines = text.splitlines()
    spread = tmp_path / "spread.csv"
    spread.write_text("\n".join([*lines[:60], "", "", "# a pause", "", *lines[60:]]) + "\n", encoding="utf-8")
    one, two = (
        calibrate(hsr.problem, hsr.problem.read(path), method="lm", reference=False)
        for path in (ROOT / "problems" / "hsr_jr680" / "samples.csv", spread)
    )
    assert one.cost == two.cost
    np.testing.assert_array_equal(one.x, two.x)


@pytest.mark.parametrize(
    ("heading", "right"),
    [
        ("q{} [°]", "q{}_deg"),
        ("J{}(deg)", "q{}_deg"),
        ("Axis {} (rad)", "q{}_rad"),
        ("joint{}_deg", "q{}_deg"),
        ("A{} degrees", "q{}_deg"),
    ],
)
def test_headings_of_other_software_are_named_all_at_once(heading, right, tmp_path):
    layout = load_problem(ROOT / "problems" / "instruments" / "tracker").problem.layout()
    names = [*(heading.format(k) for k in range(1, 7)), "X [mm]", "Y(mm)", "z_mm", "session"]
    file = tmp_path / "rows.csv"
    file.write_text(",".join(names) + "\n" + ",".join(["0"] * 9) + ",1\n", encoding="utf-8")
    with pytest.raises(SamplesError) as caught:
        Samples.from_file(file, layout)
    for k in range(1, 7):
        assert f"'{heading.format(k)}' to {right.format(k)}" in str(caught.value)
    assert "'X [mm]' to x_mm, 'Y(mm)' to y_mm" in str(caught.value)
    assert "z_mm" not in str(caught.value)


FURTHER = Layout(("angle",), {"reading": "length"}, (), further=("load",))
ARRAYS = {"q1_deg": np.array([10.0, 20, 30]), "reading_mm": np.array([1.0, 2, 3]), "load": np.array([7.0, 8, 9])}


def test_what_was_read_stays_whatever_becomes_of_its_source(tmp_path):
    """Neither a frame, nor a view that is read-only, nor a file that is mapped changes samples that were made of it."""
    frame = pd.DataFrame(ARRAYS)
    of_frame = Samples.from_frame(frame, FURTHER)
    frame.loc[1, "load"] = 99.0
    records = np.zeros(3, dtype=[(name, float) for name in ARRAYS])
    for name, values in ARRAYS.items():
        records[name] = values
    np.save(tmp_path / "s.npy", records)
    of_file = Samples.from_file(tmp_path / "s.npy", FURTHER)
    with (tmp_path / "s.npy").open("r+b") as file:
        file.seek(-72, 2)
        file.write(np.full(9, -1.0).tobytes())
    joints = np.array([[0.1], [0.2], [0.3]])
    view = joints.view()
    view.setflags(write=False)
    of_view = Samples.of_joints(view)
    joints[1] = 5.0
    for samples in (of_frame, of_file):
        np.testing.assert_array_equal(samples.extra["load"], ARRAYS["load"])
        np.testing.assert_allclose(samples.joints[:, 0], np.radians(ARRAYS["q1_deg"]))
    assert of_view.joints[1, 0] == 0.2
    for array in (of_file.take([0, 1]).ways, of_file.joints, of_file.extra["load"], of_view.joints):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_rows_are_taken_by_number_or_by_mask():
    samples = Samples.from_arrays(ARRAYS, FURTHER)
    assert tuple(samples.take(np.array([False, True, True])).lines) == (2, 3)
    assert tuple(samples.take([2, 0]).lines) == (3, 1)
    assert len(samples.take([])) == 0
    for wrong in ([0.0, 1.0], np.array([True, False]), [[0, 1]]):
        with pytest.raises(CasacalError, match="numbers of rows"):
            samples.take(wrong)


def test_each_row_keeps_the_way_it_was_come_to_by():
    """In whatever order rows are taken, and however often: as of a bootstrap. Equal samples are equal all the same."""
    samples = Samples.of_joints(np.array([[0.0], [1.0], [2.0], [1.0]]))
    assert samples.ways.ravel().tolist() == [0, 1, 1, -1]
    assert samples.take([3, 3, 3, 1]).ways.ravel().tolist() == [-1, -1, -1, 1]
    assert samples.take([3, 1]).take([1, 0, 1]).ways.ravel().tolist() == [1, -1, 1]
    other = Samples.of_joints(np.array([[5.0], [4.0], [3.0]]))
    assert joined(samples, other).ways.ravel().tolist() == [0, 1, 1, -1, 0, -1, -1]
    again = samples.take([0, 1, 2, 3])
    assert again == samples
    assert dataclasses.replace(again, came=again.ways[::-1]) == samples


def test_labels_of_bytes_are_their_text():
    """As files of other libraries hold them, within objects or not."""
    for kind in ("S8", object):
        labels = np.array([b"left", "wände".encode(), b"left"], dtype=kind)
        if kind == "S8":
            assert labels[1] == "wände".encode()
        for made in (
            Samples.from_arrays({**ARRAYS, "plane": labels}, dataclasses.replace(FURTHER, labels=("plane",))),
            Samples.from_frame(
                pd.DataFrame({**ARRAYS, "plane": list(labels)}), dataclasses.replace(FURTHER, labels=("plane",))
            ),
        ):
            assert made.labels["plane"] == ("left", "wände", "left")
    labels = np.array([b"left", b"\xff", b"left"], dtype=object)
    with pytest.raises(CasacalError, match="UTF-8"):
        Samples.from_arrays({**ARRAYS, "plane": labels}, dataclasses.replace(FURTHER, labels=("plane",)))


def test_arrays_of_no_shape_and_names_of_no_end_are_refused():
    with pytest.raises(SamplesError, match=r"q1_deg.*differ in length"):
        Samples.from_arrays({**ARRAYS, "q1_deg": [[1.0], [1.0, 2.0], [3.0]]}, FURTHER)
    with pytest.raises(SamplesError, match="longer than"):
        Samples.from_arrays({**ARRAYS, "q" + "1" * 5000: ARRAYS["load"]}, FURTHER)


def test_a_touch_that_was_made_again_is_no_copy_however_often():
    rows = {"q1_deg": [10.0] * 5, "reading_mm": [1.0, 1.0, 1.0, 1.0, 1.0]}
    samples = Samples.from_arrays(rows, dataclasses.replace(FURTHER, further=()))
    purposes = ("size", "again", "again", "again", "size")
    found = copies_of(dataclasses.replace(samples, extra={"purpose": purposes}))
    assert found.tolist() == [False, False, False, False, True]
