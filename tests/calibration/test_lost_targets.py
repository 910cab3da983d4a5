"""Targets that a device lost are named row by row, all lines at once, and the other rows are looked at."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT

from casacal import CasacalError, KnownPoint, Problem, check, load_problem
from casacal.calibration.before_fit import lost_targets
from casacal.errors import SamplesError
from casacal.fit.bound_problem import bind

TRACKER = ROOT / "problems" / "instruments" / "tracker"
ROWS = [4, 13, 22, 31, 40]


@pytest.fixture(scope="module")
def tracker():
    source = load_problem(TRACKER)
    return source.problem, source.problem.read(source.samples)


def at(samples, rows, value):
    columns = {name: values.copy() for name, values in samples.columns.items()}
    for name in "xyz":
        columns[name][rows] = value
    return replace(samples, columns=columns)


def lines(samples, rows):
    return tuple(samples.lines[row] for row in rows)


@pytest.mark.parametrize("value", [0.0, -0.0, -3.697314e28, 1e300])
@pytest.mark.parametrize("rows", [ROWS, ROWS[:1]])
def test_what_no_device_tells_is_a_lost_target(tracker, value, rows):
    problem, samples = tracker
    (found,) = check(problem, at(samples, rows, value))
    assert (found.severity, found.about, found.lines) == ("error", "lost target", lines(samples, rows))


@pytest.mark.parametrize("value", [0.0, 9999.0, -3.697314e28])
def test_a_file_of_lost_targets_alone_is_called_so(tracker, value):
    problem, samples = tracker
    none = at(samples, np.arange(len(samples)), value)
    (found,) = check(problem, none)
    assert (found.severity, found.about, found.lines) == ("error", "lost target", tuple(samples.lines))
    assert "in any row" in found.cause
    if abs(value) < 1e12:
        with pytest.raises(CasacalError, match=rf"tell one place \({value:g}, .* of a target that was lost"):
            bind(problem, none)


@pytest.mark.long_unless(
    "-3.697314e+28-None-lost reading", "9999.0-None-lost reading", "-3.697314e+28-rows2-lost reading"
)
@pytest.mark.parametrize(
    ("value", "rows", "found"),
    [
        (-3.697314e28, None, "lost reading"),
        (9999.0, None, "lost reading"),
        (-3.697314e28, [3, 7, 20], "lost reading"),
        (12.0, None, "readings outside travel"),
    ],
)
def test_a_dial_that_was_not_read_is_called_so(hsr, value, rows, found):
    """In all rows or in some; a dial that always shows 12 mm of 10 is another matter."""
    samples = hsr.problem.read(hsr.samples)
    lost = np.arange(len(samples)) if rows is None else rows
    reading = samples.columns["reading"].copy()
    reading[lost] = value
    first = check(hsr.problem, replace(samples, columns={"reading": reading}))[0]
    assert (first.about, first.lines) == (found, lines(samples, lost))


@pytest.mark.long
def test_what_is_wrong_beside_lost_targets_is_found_too(tracker):
    problem, samples = tracker
    wrong = at(samples, ROWS, -3.697314e28)
    joints = wrong.joints * np.array([1, 1, -1, 1, 1, 1])
    assert {each.about for each in check(problem, replace(wrong, joints=joints))} == {"lost target", "joint 3 flipped"}


def test_zeros_that_are_measured_are_none(tracker):
    problem, samples = tracker
    assert not lost_targets(problem, at(samples, np.arange(30), 0.0))[0], "most rows: this is another mistake"
    columns = {**samples.columns, "x": np.where(np.arange(len(samples)) == 3, 0.0, samples.columns["x"])}
    assert not lost_targets(problem, replace(samples, columns=columns))[0], "one coordinate may be zero"
    plate = Problem(problem.robot, KnownPoint(points={"a": (0, 0, 0), "b": (9, 0, 0), "c": (0, 9, 0)}, noise_std=0.1))
    assert lost_targets(plate, samples) == ([], samples), "what reads no places loses none"


@pytest.mark.parametrize("cell", ["NaN", "", "-3.697314E+28"])
def test_the_reader_names_all_lines_at_once(tracker, tmp_path, cell):
    text = (TRACKER / "samples.csv").read_text().splitlines()
    for line in (6, 15, 33):
        cells = text[line - 1].split(",")
        text[line - 1] = ",".join([*cells[:6], cell, *cells[7:]])
    file = tmp_path / "rows.csv"
    file.write_text("\n".join(text))
    with pytest.raises(SamplesError, match=r"line 6, column 'x_mm': .*; lines 15, 33 likewise\. ") as refused:
        tracker[0].read(file)
    assert (refused.value.line, refused.value.column) == (6, "x_mm")


def test_arrays_and_bind_name_all_rows_too(tracker):
    problem, samples = tracker
    arrays = {f"q{k}_rad": values for k, values in enumerate(samples.joints.T, 1)}
    arrays |= {f"{name}_mm": values.copy() for name, values in samples.columns.items()}
    arrays["session"] = np.array(list(samples.labels["session"]))
    arrays["y_mm"][[2, 5]] = np.nan
    with pytest.raises(SamplesError, match="line 3, column 'y_mm': 'nan' is not a finite number; line 6 likewise"):
        type(samples).from_arrays(arrays, problem.layout())
    with pytest.raises(
        SamplesError, match="-3e\\+28 as x is no value that anything shows; lines 16, 25, 34, 43 likewise"
    ):
        bind(problem, at(samples, ROWS, -3e28))
