"""Numbers and names that nobody means: a sentence, in time, without a warning."""

import csv
import os
import shutil
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT

from casacal import DialOnPlane, Parameter, Problem, ProblemError, Robot, calibrate, simulate
from casacal.calibration.given import METHODS
from casacal.calibration.verdict import verdict_of
from casacal.cli.main import main

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
