"""Rows paired with the wrong posture from some line on, as by a detection that was lost: the line is named, exactly."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT

from casacal import check, load_problem
from casacal.calibration.cause import cause_of_rows
from casacal.calibration.faults import _slipped


def measured(name):
    source = load_problem(ROOT / "problems" / name)
    return source.problem, source.problem.read(source.samples)


def lost(samples, at, *, labels=False):
    """The file of readings lacks one: from that row on each stands beside the posture before its own."""
    read = np.delete(np.arange(len(samples)), at)
    columns = {name: values[read] for name, values in samples.columns.items()}
    rows = samples.take(np.arange(len(samples) - 1))
    return replace(rows, columns=columns, labels=samples.take(read).labels if labels else rows.labels)


def added(samples, at, *, labels=False):
    """The file of readings has one too many, the one before once more but for noise, so all after it stand too late."""
    read = np.insert(np.arange(len(samples)), at, at - 1)[: len(samples)]
    columns = {name: values[read] + 1e-3 * (np.arange(len(read)) == at) for name, values in samples.columns.items()}
    return replace(samples, columns=columns, labels=samples.take(read).labels if labels else samples.labels)


def only(problem, samples):
    (found,) = (finding for finding in check(problem, samples) if finding.severity == "error")
    assert found.about == "readings one row off"
    return found


@pytest.mark.long_unless("instruments/camera")
@pytest.mark.parametrize("name", ["instruments/tracker", "hsr_jr680", "instruments/camera"])
def test_a_detection_that_was_lost_in_the_middle(name):
    problem, samples = measured(name)
    at = len(samples) // 2
    found = only(problem, lost(samples, at))
    assert f"readings seem to belong to the joints of the next row, from line {samples.lines[at]} on:" in found.cause


def test_a_reading_too_many_in_the_middle():
    problem, samples = measured("instruments/tracker")
    found = only(problem, added(samples, 20))
    assert f"joints of the previous row, from line {samples.lines[21]} on:" in found.cause


@pytest.mark.parametrize(("change", "way", "line"), [(lost, "next", 0), (added, "previous", 1)])
def test_the_last_few_rows_are_no_outliers(change, way, line):
    problem, samples = measured("hsr_jr680")
    at = len(samples) - 8
    found = only(problem, change(samples, at))
    assert f"joints of the {way} row, from line {samples.lines[at + line]} on: with that undone, no row" in found.cause
    assert not found.lines


@pytest.mark.long
def test_labels_that_come_with_the_readings_slip_as_well():
    problem, samples = measured("instruments/tracker")
    found = only(problem, lost(samples, 14, labels=True))
    assert f"readings and labels seem to belong to the joints of the next row, from line {samples.lines[14]} on" in (
        found.cause
    )


def test_a_few_wrong_rows_are_not_said_to_have_slipped():
    problem, samples = measured("instruments/tracker")
    columns = {name: values.copy() for name, values in samples.columns.items()}
    for row in (10, 25, 39, 43):
        columns["x"][row] += 5.0
    (found,) = (each for each in check(problem, replace(samples, columns=columns)) if each.severity == "error")
    assert found.about == "outliers"
    tail = np.arange(len(samples)) >= len(samples) - 4
    columns["x"][tail] += (5.0, -3.0, 8.0, 4.0)  # nor are the last ones, where that does not mend them
    assert cause_of_rows(problem, replace(samples, columns=columns), tail) is None


def test_rows_are_put_back():
    _, samples = measured("instruments/tracker")
    for change, by in ((lost, 1), (added, -1)):
        mended = _slipped(change(samples, 9), 9, by=by, readings=True, labels=False)
        kept = np.delete(
            np.arange(len(samples)), [9, len(samples) - 1][: 1 + (by > 0)] if by > 0 else [len(samples) - 1]
        )
        np.testing.assert_array_equal(mended.joints, samples.joints[kept])
        np.testing.assert_array_equal(mended.columns["x"], samples.columns["x"][kept])
