"""Columns that tell effects, from files of every form, frames and arrays: kept to the bit, or refused by the cell."""

import numpy as np
import pytest
from instruments_on_ur5 import ROBOT
from test_told import POINT, TORQUES, USUAL, by_name, postures, table

from casacal import Problem, Samples, bind
from casacal.calibration.inputs import samples_from
from casacal.deployment.compensate import read_targets
from casacal.deployment.predict import joints_from
from casacal.effects import GravitySag, TorqueCompliance
from casacal.errors import SamplesError
from casacal.model.problem_file import ProblemFile

PROBLEM = Problem(ROBOT, POINT, terms=(TorqueCompliance(columns_of=TORQUES), GravitySag(payload="payload_kg")))
SOURCE = ProblemFile.of(PROBLEM)
LOADS = np.array([0.0, 0.1, 2.5, 5.0, 1e-7, 3.0])


@pytest.fixture
def frame():
    rng = np.random.default_rng(5)
    torques, points = rng.normal(size=(6, 6)) * USUAL, by_name(("x_mm", "y_mm", "z_mm"), rng.normal(size=(6, 3)) * 300)
    notes = {"note": ["a", "b", "", "d", "e", "f"]}
    return table(postures(rng, 6), **points, **by_name(TORQUES, torques), payload_kg=LOADS, **notes)


def arrays_of(frame):
    return {name: frame[name].to_numpy() for name in frame if name != "note"}


def as_records(frame):
    numbers = frame.drop(columns="note")
    return np.array(list(numbers.itertuples(index=False)), dtype=[(name, float) for name in numbers])


def written(form, frame, folder):
    """The same rows as a file of one form, a frame or arrays."""
    file = folder / f"rows.{form}"
    if form in ("frame", "arrays"):
        return frame if form == "frame" else arrays_of(frame)
    if form == "npz":
        np.savez(file, **arrays_of(frame))
    elif form == "npy":
        np.save(file, as_records(frame))
    elif form == "xlsx":
        frame.to_excel(file, index=False)
    else:
        frame.to_csv(file, index=False, sep=";" if form == "txt" else ",", decimal="," if form == "txt" else ".")
    return file


@pytest.mark.parametrize("form", ["csv", "txt", "xlsx", "npz", "npy", "frame", "arrays"])
def test_columns_of_effects_are_kept_to_the_bit(form, frame, tmp_path):
    samples = samples_from(written(form, frame, tmp_path), SOURCE)
    for name in (*TORQUES, "payload_kg"):
        # a workbook keeps sixteen digits
        np.testing.assert_allclose(samples.extra[name], frame[name], rtol=1e-15 if form == "xlsx" else 0.0, atol=0.0)
    assert samples.take([4]).extra["payload_kg"].tolist() == [1e-7]
    assert ("note" in samples.extra) == (form in ("csv", "txt", "xlsx"))


def test_a_frame_and_a_file_are_the_same_rows_to_whoever_fits_them(frame, tmp_path):
    both = [bind(PROBLEM, samples_from(written(form, frame, tmp_path), SOURCE)) for form in ("csv", "frame")]
    one, other = (bound.residual(np.full(bound.unknowns, 1e-3)) for bound in both)
    np.testing.assert_array_equal(one, other)


NEAR = {"torque6_nm": "torque6_Nm", "Torque2_Nm": "torque2_Nm", "paylod_kg": "payload_kg", "Payload_kg": "payload_kg",
        "payload": "payload_kg", "torque6": "torque6_Nm"}  # fmt: skip


@pytest.mark.parametrize("form", ["csv", "npz", "frame"])
@pytest.mark.parametrize("near", NEAR)
def test_a_column_that_is_nearly_called_so_is_asked_about(near, form, frame, tmp_path):
    given = written(form, frame.rename(columns={NEAR[near]: near}), tmp_path)
    said = rf"there is no column '{NEAR[near]}' \(did you mean '{near}'\?\)\. Call it {NEAR[near]}"
    for read in (samples_from, joints_from):
        with pytest.raises(SamplesError, match=said):
            read(given, SOURCE)
    if form == "csv":
        with pytest.raises(SamplesError, match=said):
            read_targets(given, SOURCE)


def test_a_column_that_is_merely_absent_or_another_thing_is_no_question(frame, tmp_path):
    given = written("csv", frame.drop(columns=["torque6_Nm", "payload_kg"]).assign(load_cell_mV=1.0), tmp_path)
    for read in (samples_from, joints_from, read_targets):
        rows = read(given, SOURCE)
        assert set(TORQUES[:5]) <= set(rows.extra)
        assert not {"torque6_Nm", "payload_kg"} & set(rows.extra)


@pytest.mark.parametrize("cell", ["", "nan", "5kg", "inf", "1,5"])
@pytest.mark.parametrize("form", ["csv"])
def test_one_bad_cell_is_named_with_line_and_column(cell, form, frame, tmp_path):
    cells = frame["payload_kg"].astype(object)
    cells[3] = cell
    given = written(form, frame.assign(payload_kg=cells), tmp_path)
    what = f"'{cell}' is not a finite number" if cell else "the cell is empty"
    for read in (samples_from, joints_from):
        with pytest.raises(SamplesError, match=f"rows.{form}, line 5, column 'payload_kg': {what}"):
            read(given, SOURCE)


@pytest.mark.parametrize("form", ["npz", "frame", "arrays"])
def test_one_number_that_is_none_is_named_with_its_row(form, frame, tmp_path):
    frame.loc[3, "torque2_Nm"] = np.nan
    with pytest.raises(SamplesError, match="line 4, column 'torque2_Nm': 'nan' is not a finite number"):
        samples_from(written(form, frame, tmp_path), SOURCE)


@pytest.mark.parametrize("form", ["csv", "npy", "frame"])
@pytest.mark.parametrize(
    ("column", "value", "said"),
    [
        ("payload_kg", 1e300, r"1e\+300 is no payload from 0 to 10,000 kg"),
        ("payload_kg", 10_001.0, "10001 is no payload from 0 to 10,000 kg"),
        ("torque3_Nm", -1e308, r"-1e\+308 is absurd \(beyond 100,000 Nm\)"),
    ],
)
def test_absurd_amounts_are_refused_with_line_and_column(column, value, said, form, frame, tmp_path):
    frame.loc[2, column] = value
    samples = samples_from(written(form, frame, tmp_path), SOURCE)
    line = 4 if form == "csv" else 3
    with pytest.raises(SamplesError, match=f"line {line}, column '{column}': {said}"):
        bind(PROBLEM, samples)


def test_rows_that_were_read_for_a_problem_without_the_effect_hold_text_that_is_as_good(frame, tmp_path):
    given = written("csv", frame, tmp_path)
    plain = Samples.from_csv(given, PROBLEM.without_terms.layout())
    asked = Samples.from_csv(given, PROBLEM.layout())
    x = np.full(bind(PROBLEM, asked).unknowns, 1e-3)
    np.testing.assert_array_equal(*(bind(PROBLEM, samples).residual(x) for samples in (plain, asked)))
