"""Numbers and names that nobody means: a sentence, in time, without a warning."""

import csv
import dataclasses
import os
import re
import shutil
import subprocess
import sys
from typing import ClassVar

import casadi as ca
import numpy as np
import pandas as pd
import pytest
from conftest import ROOT

from casacal import (
    DialOnPlane,
    Instrument,
    Parameter,
    Problem,
    Robot,
    Samples,
    bind,
    calibrate,
    chain,
    check,
    load_problem,
    simulate,
)
from casacal.calibration.verdict import verdict_of
from casacal.cli.main import main
from casacal.errors import ProblemError, SamplesError
from casacal.fit.methods import METHODS
from casacal.model.kinematics import position, rotate_z, translate_x

HSR = ROOT / "problems" / "hsr_jr680"


class Pole(DialOnPlane):
    """A residual that is infinite at the nominal arm."""

    def residual(self, pose, p, row):
        return super().residual(pose, p, row) + 1 / (p.a[1] - 900.32123)


class Hole(DialOnPlane):
    """A residual that is no number at the nominal arm and on one side of it."""

    def residual(self, pose, p, row):
        return super().residual(pose, p, row) + 1e-9 * ca.log(p.a[1] - 900.32123)


@pytest.mark.parametrize("kind", [Pole, Hole])
@pytest.mark.parametrize("method", METHODS)
def test_a_cost_that_is_not_finite_ends_in_a_sentence(hsr, kind, method):
    problem = Problem(hsr.problem.robot, kind(noise_std=0.01))
    found = calibrate(problem, hsr.samples, method=method, reference=False)
    assert np.isfinite(found.result.cost) or not found.passed


@pytest.mark.parametrize("std", ["1e300", "1e-300", "1e13", "1e-13"])
def test_a_prior_that_no_knowledge_is_is_refused(std, capsys):
    assert main(["calibrate", str(HSR), "--prior", f"a={std}"]) == 2
    said = capsys.readouterr().err
    assert "no prior knowledge" in said
    assert said.count("\n") == 1


@pytest.mark.long_unless("inf")
@pytest.mark.parametrize("std", ["1e12", "1e-12", "inf"])
def test_a_prior_that_is_merely_far_out_is_taken(std, capsys):
    assert main(["calibrate", str(HSR), "--prior", f"a={std}", "--method", "lm", "--no-reference"]) in (0, 1)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("count", ["1000000000000", "0", "-3", "1e12", "many"])
def test_absurd_numbers_of_samples_are_refused(count, tmp_path, capsys):
    assert main(["simulate", str(HSR), "--out", str(tmp_path / "s.csv"), "--samples", count]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["two\nlines", "a\r*/ int x; /*", "bell\a", "tab\t"])
def test_names_that_cannot_stand_on_a_line_are_refused(name):
    with pytest.raises(ProblemError, match="printed on one line"):
        Robot.from_dh(name, alpha=[0.0, 1.0], a=[1.0, 1.0], d=[0.0, 0.0], theta=[0.0, 0.0])


@pytest.mark.long
def test_a_folder_of_any_name_gives_exports_that_compile(tmp_path):
    place = tmp_path / "my\n*/ #error arm"
    shutil.copytree(HSR, place)
    found = calibrate(place, method="lm", reference=False)
    assert "\n" not in found.source.name
    for form in ("dh", "zeros", "c"):
        text = found.export(form)
        assert not [line for line in text.splitlines() if line.startswith("*/ #error")]
    if shutil.which("gcc"):
        typed = ["gcc", "-std=c99", "-fsyntax-only", "-x", "c", "-"]
        done = subprocess.run(typed, input=found.export("c"), capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr


@pytest.mark.long
def test_commas_and_quotes_in_labels_stay_in_their_cells(hsr, tmp_path):
    tool = Parameter((0.0, 0.0, 100.0), prior_std=1.0, labels=(", x", '"y"', ";z"))
    problem = Problem(hsr.problem.robot, DialOnPlane(noise_std=0.01, tool=tool))
    samples = simulate(problem, hsr.cell, seed=1).samples
    calibrate(problem, samples, method="lm", reference=False).save(tmp_path)
    with (tmp_path / "parameters.csv").open(newline="") as file:
        next(file)  # the mark
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows[-3:]] == ["tool, x", 'tool"y"', "tool;z"]
    assert all(float(row["std"]) >= 0 and row["known_from"] for row in rows)


@pytest.mark.long
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no full device")
@pytest.mark.parametrize("typed", [["calibrate", str(HSR), "--no-reference"], ["check", str(HSR)]], ids=" ".join)
def test_a_full_output_is_said(typed):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-m", "casacal", *typed], stdout=full, stderr=subprocess.PIPE, text=True,
                              env=environment, check=False)  # fmt: skip
    assert done.returncode == 2
    assert "Standard output cannot be written" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.long
@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="names of files are bytes on Linux alone")
def test_names_of_files_may_be_any_bytes(tmp_path):
    odd = os.fsencode(tmp_path) + b"/s\xff.csv"
    shutil.copy(os.fsencode(str(HSR / "samples.csv")), odd)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    typed = [sys.executable, "-m", "casacal", "calibrate", str(HSR), odd, "--method", "lm", "--no-reference"]
    out = os.fsencode(tmp_path) + b"/o\xfe"
    done = subprocess.run([*typed, "--out", out], capture_output=True, env=environment, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert os.path.exists(out + b"/result.json")


@pytest.mark.long_unless("ipopt")
@pytest.mark.parametrize("method", ["lm", "sckf", "annealing", "ipopt", "plane-only"])
def test_a_problem_with_nothing_free_says_so(hsr, method):
    held = hsr.problem.fix("alpha", "a", "d", "theta", "plane")
    found = calibrate(held, hsr.samples, method=method)
    assert found.fit.unknowns == 0
    assert found.result.x.size == 0
    if method in ("lm", "plane-only"):  # the arm is the same, as drawn, and its verdict takes many fits
        assert verdict_of(found).level != "calibrated"


class Wire(Instrument):
    """A wire from an eye to the tip whose length is a norm, which has no derivative where the tip is at the eye."""

    columns: ClassVar = {"gap": "length"}
    column_stds: ClassVar = {"gap": 0.05}
    unknowns: ClassVar = {"mark": Parameter((700.0, 0.0), unit="mm", prior_std=1.0)}

    def residual(self, pose, p, row):
        return ca.norm_2(position(pose)[:2] - p.mark) - row.gap


def _two_links(rows):
    arm = Robot(
        "two-link",
        joints=2,
        pose=lambda p, q: chain(rotate_z(q[0]), translate_x(p.l1), rotate_z(q[1]), translate_x(p.l2)),
        parameters={"l1": Parameter(400.0, unit="mm", prior_std=1.0), "l2": Parameter(300.0, unit="mm", prior_std=1.0)},
    )
    problem = Problem(arm, Wire())
    return problem, Samples.from_frame(pd.DataFrame(rows, columns=["q1_rad", "q2_rad", "gap_mm"]), problem.layout())


def test_a_row_without_a_derivative_is_refused_by_line_and_instrument():
    angles = np.random.default_rng(0).uniform(-1.5, 1.5, (12, 2))
    tips = 400.6 * np.exp(1j * angles[:, 0]) + 299.5 * np.exp(1j * angles.sum(axis=1))
    rows = np.column_stack([angles, np.abs(tips - 700.0)])
    problem, samples = _two_links(rows)
    assert calibrate(problem, samples, reference=False).result.converged
    problem, samples = _two_links(np.insert(rows, 4, (0.0, 0.0, 0.2), axis=0))
    said = r"DataFrame, line 5: the residual of Wire has no finite derivative in this row.*sqrt\(sumsqr\(v\) \+ 1e-6\)"
    for ask in (bind, calibrate):
        with pytest.raises(ProblemError, match=said):
            ask(problem, samples)
    (found,) = check(problem, samples)
    assert found.about == "cannot be bound"
    assert "line 5" in found.cause


class Total(Instrument):
    """The sum of two link lengths, as a drawing has it: an instrument of very few rows."""

    columns: ClassVar = {"total": "length"}
    residual_std = 0.02

    def residual(self, pose, p, row):
        return p.a[1] + p.a[2] - row.total


@pytest.mark.long_unless("-0.7-2", "-0.7-1")
@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("off", [-0.7, 0.0, 0.02])
def test_an_instrument_of_one_row_or_two_agrees_or_contradicts_the_others(count, off):
    source = load_problem(ROOT / "problems" / "ur5")
    problem = Problem(source.problem.robot, {"dial": source.problem.instrument, "total": Total()})
    samples = source.problem.read(source.samples)
    alone = calibrate(source.problem, samples, reference=False).parameters["estimate"]
    total = alone["a2"] + alone["a3"] + off
    rows = pd.DataFrame({**{f"q{i}_deg": np.arange(count) for i in range(1, 7)}, "total_mm": [total] * count})
    given = {"dial": samples, "total": rows}
    if abs(off) < 0.1:
        found = calibrate(problem, given, reference=False)
        assert found.parameters["estimate"][["a2", "a3"]].sum() == pytest.approx(total, abs=0.03)
        return
    with pytest.raises(SamplesError, match=rf"contradict each other: {count} of {count} rows? of total lie far off"):
        calibrate(problem, given, reference=False)


def test_no_rows_are_said(hsr):
    samples = hsr.problem.read(hsr.samples)
    for ask in (calibrate, bind):
        with pytest.raises(SamplesError, match="there are no rows"):
            ask(hsr.problem, samples.take([]))
    (found,) = check(hsr.problem, samples.take([]))
    assert "there are no rows" in found.cause


@pytest.mark.long_unless("5e-324", "1e-300", "1e+200")
@pytest.mark.parametrize("noise", [5e-324, 1e-300, 1e-100, 1e-11, 1e11, 1e200])
def test_no_noise_ends_in_a_traceback(hsr, noise):
    problem, samples = hsr.problem.with_settings({"noise_std": noise}), hsr.problem.read(hsr.samples)
    check(problem, samples)
    if 1e-30 < noise < 1e30:
        calibrate(problem, samples, reference=False).summary()
        return
    with pytest.raises(ProblemError, match="State noise_std between 1e-30 and 1e\\+30"):
        calibrate(problem, samples)


@pytest.mark.parametrize("value", [1e150, -1e300, 1e13])
@pytest.mark.parametrize("which", ["length", "joints"])
def test_values_that_nothing_shows_are_refused_by_line(value, which):
    source = load_problem(ROOT / "problems" / "instruments" / "ball_bar")
    samples = source.problem.read(source.samples)
    far, joints = np.array(samples.columns["length"]), samples.joints.copy()
    (far if which == "length" else joints[:, 2])[3] = value
    samples = dataclasses.replace(samples, joints=joints, columns={**samples.columns, "length": far})
    said = (
        rf"line {samples.lines[3]}: {re.escape(f'{value:g}')} as {'length' if which == 'length' else 'joint 3'} is no"
    )
    with pytest.raises(SamplesError, match=said):
        calibrate(source.problem, samples)
    check(source.problem, samples)
