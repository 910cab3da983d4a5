"""Dials that are set to zero anywhere: a travel of two ends, readings a little beyond it, zeros that were set anew."""

import contextlib
import dataclasses
import math
import re
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT

import casacal
from casacal import DialOnBody, DialOnPlane, Problem, calibrate, check, dial_zero, simulate
from casacal.calibration.faults import zero_moved
from casacal.calibration.verdict import verdict_of
from casacal.cli.main import main
from casacal.data.columns import Labels
from casacal.data.samples import Samples
from casacal.errors import ProblemError, SimulationError
from casacal.uncertainty.tip_error import without_rigid, workspace_joints

HSR = ROOT / "problems" / "hsr_jr680"
MIDDLE = (-5.0, 5.0)
ARM = "# convention: standard\nalpha_deg,a_mm,d_mm,theta_deg\n-90,0,300,0\n0,400,0,0\n90,0,0,0\n"


@pytest.fixture(scope="module")
def middle(hsr):
    """The example arm with a dial that was set to zero in the middle, and its samples."""
    problem = hsr.problem.with_settings({"travel": MIDDLE})
    return problem, simulate(problem, hsr.cell, seed=0).samples


def test_readings_on_both_sides_of_zero_are_as_good_as_others(middle, hsr):
    problem, samples = middle
    readings = samples.columns["reading"]
    assert readings.min() < -4
    assert readings.max() > 4
    found = calibrate(problem, samples, method="lm", reference=False)
    usual = simulate(hsr.problem, hsr.cell, seed=0).samples
    assert found.tip_std[1] == pytest.approx(
        calibrate(hsr.problem, usual, method="lm", reference=False).tip_std[1], rel=0.1
    )


def test_who_did_not_declare_it_is_told_the_option_that_does(middle, tmp_path, capsys):
    _, samples = middle
    path = tmp_path / "samples.csv"
    lines = (HSR / "samples.csv").read_text(encoding="utf-8").splitlines()
    (start,) = (k for k, line in enumerate(lines) if line.startswith("q1"))
    rows = [
        ",".join([*(f"{math.degrees(q):.9f}" for q in samples.joints[i]), f"{samples.columns['reading'][i]:.3f}",
                  samples.labels["plane"][i]])
        for i in range(len(samples))
    ]  # fmt: skip
    path.write_text("\n".join([*lines[: start + 1], *rows]) + "\n", encoding="utf-8")
    options = ["calibrate", str(HSR), str(path), "--method", "lm", "--no-reference"]
    assert main(options) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "outside 0 to 10 mm" in said
    assert "(--set travel=-5:5)" in said
    assert main([*options, "--set", "travel=-5:5"]) == 0
    assert "Calibrated" in capsys.readouterr().out
    assert main([*options, "--set", "travel=5:-5"]) == 2
    assert "the smallest and the largest reading" in capsys.readouterr().err
    assert main([*options, "--set", "sign=-1:1"]) == 2
    assert "is one number" in capsys.readouterr().err


@pytest.mark.parametrize(("beyond", "severity"), [(0.04, "warning"), (0.3, "error")])
def test_a_little_beyond_the_travel_is_a_warning(hsr, beyond, severity):
    samples = hsr.problem.read(HSR / "samples.csv")
    reading = samples.columns["reading"].copy()
    problem = hsr.problem.with_settings({"travel": float(reading.max()) - beyond})
    (found,) = (each for each in check(problem, samples) if each.about == "readings outside travel")
    assert found.severity == severity
    assert len(found.lines) == int((reading > reading.max() - beyond).sum())


@pytest.mark.parametrize("travel", [0.0, -3.0, math.nan, (5.0, -5.0), (1.0, 2.0, 3.0), ("a", "b"), (0.0, math.inf)])
def test_travels_that_are_none(travel):
    with pytest.raises(ProblemError, match="the smallest and the largest reading"):
        DialOnPlane(noise_std=0.01, travel=travel)


def test_a_cell_refuses_them_too(hsr):
    with pytest.raises(SimulationError, match="the smallest and the largest reading"):
        dataclasses.replace(hsr.cell, travel=(5.0, -5.0))
    rows = simulate(hsr.problem, dataclasses.replace(hsr.cell, travel=(-2.0, -1.0)), samples=12, seed=0).samples
    assert -2 < rows.columns["reading"].min() < rows.columns["reading"].max() < -1


@pytest.mark.parametrize("sign", [1, -1])
def test_a_shifted_zero_moves_the_residual_along_the_plunger(sign):
    """By hand: n . (R (t + sign r u) + p) - h, and sign s n . R u for a zero that stands s elsewhere."""
    angle, normal = 0.3, np.array([0.0, 0.6, 0.8])
    pose = np.eye(4)
    pose[1:3, 1:3] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    pose[:3, 3] = 100.0, 200.0, 300.0
    tool, axis, reading, shift = np.array([1.0, 2.0, 120.0]), np.array([0.0, 0.0, 1.0]), 2.5, 0.7
    away = pose[:3, :3] @ (tool + sign * (reading + shift) * axis) + pose[:3, 3]
    dial = DialOnPlane(noise_std=0.01, sign=sign, zero_shift=dial_zero())
    plane = SimpleNamespace(normal=ca.DM(normal), distance=lambda point: ca.dot(ca.DM(normal), point) - 50.0)
    p = SimpleNamespace(tool=ca.DM(tool), plunger=ca.DM(axis), plane=plane, zero_shift=shift)
    found = float(dial.residual(ca.DM(pose), p, SimpleNamespace(reading=reading)))
    assert found == pytest.approx(normal @ away - 50.0, abs=1e-10)
    tip = np.array(dial.tip(ca.DM(pose), p, SimpleNamespace(reading=reading))).ravel()
    np.testing.assert_allclose(tip, away - sign * shift * pose[:3, :3] @ axis, atol=1e-10)


@pytest.mark.long
def test_a_zero_that_was_set_anew_is_found(middle, hsr):
    problem, samples = middle
    later = np.arange(len(samples)) >= len(samples) // 2
    reading = samples.columns["reading"] - 1.3 * later
    labels = {**samples.labels, "session": Labels(("morning", "evening"), later.astype(int))}
    both = dataclasses.replace(samples, columns={"reading": reading}, labels=labels)
    dial = dataclasses.replace(problem.instrument, travel=(-8.0, 8.0), zero_shift=dial_zero())
    found = calibrate(Problem(problem.robot, dial), both, method="lm", reference=False)
    shifts = {name: x for name, x in zip(found.fit.names, found.x, strict=True) if name.startswith("zero_shift")}
    assert shifts["zero_shift.evening"] - shifts["zero_shift.morning"] == pytest.approx(1.3, abs=0.01)
    assert found.success
    once = calibrate(problem, samples, method="lm", reference=False)
    assert found.tip_std[1] > once.tip_std[1], "where the first zero stands is not known either"
    unsaid = calibrate(Problem(problem.robot, dataclasses.replace(dial, zero_shift=None)), both, method="lm")
    assert not unsaid.success


def test_a_saved_result_knows_its_travel(middle, tmp_path):
    problem, samples = middle
    calibrate(problem, samples, method="lm", reference=False).save(tmp_path)
    again = casacal.load(tmp_path)
    assert again.arm.source.problem.instrument.probe.travel == MIDDLE
    old = dataclasses.replace(problem.instrument.probe, travel=10.0)
    assert old.travel == 10.0


def test_certified_faces_take_it_as_well():
    body = DialOnBody(noise_std=0.01, travel=MIDDLE, zero_shift=dial_zero(), normals={"a": (0, 0, 1), "b": (0, 1, 0)})
    assert "zero_shift" in body.unknowns
    assert body.probe.travel == MIDDLE
    with pytest.raises(ProblemError, match="without a dial"):
        DialOnPlane(noise_std=0.01, reading=False, zero_shift=dial_zero())


@pytest.mark.parametrize(("said", "travel"), [("-5:5", (-5.0, 5.0)), ("12.5", 12.5), (None, 10.0)])
def test_a_new_problem_knows_the_range_that_was_said(said, travel, tmp_path):
    (tmp_path / "arm.csv").write_text(ARM)
    given = [] if said is None else [f"--travel={said}"]
    assert main(["new", "mine", "--dh", str(tmp_path / "arm.csv"), *given, "--out", str(tmp_path)]) == 0
    assert casacal.load_problem(tmp_path / "mine").problem.instruments[0].travel == travel


@pytest.mark.parametrize("said", ["5:-5", "0", "nan", "3:3"])
def test_a_range_that_is_none_makes_no_folder(said, tmp_path, capsys):
    (tmp_path / "arm.csv").write_text(ARM)
    arguments = ["new", "mine", "--dh", str(tmp_path / "arm.csv"), f"--travel={said}", "--out", str(tmp_path)]
    with contextlib.suppress(SystemExit):  # argparse leaves, the problem refuses
        assert main(arguments) == 2
    assert "travel" in capsys.readouterr().err
    assert not (tmp_path / "mine").exists()


def test_a_zero_of_each_session_is_simulated_with_one_session_and_fits_its_truth(hsr):
    dial = dataclasses.replace(hsr.problem.instrument, travel=MIDDLE, zero_shift=dial_zero(per="session"))
    simulation = simulate(Problem(hsr.problem.robot, dial), hsr.cell, seed=2)
    bound = casacal.bind(simulation.problem, simulation.samples)
    assert simulation.samples.labels["session"].names == ("first",)
    assert np.sqrt((bound.residual(simulation.truth(bound)) ** 2).mean()) == pytest.approx(1.0, abs=0.25)


@pytest.mark.long
def test_the_tip_of_a_session_is_that_of_its_zero_and_of_an_unseen_session_as_doubtful_as_its_prior(hsr):
    problem = hsr.problem.with_settings({"travel": MIDDLE, "sign": -1})
    samples = simulate(problem, hsr.cell, seed=0).samples
    later = np.arange(len(samples)) >= len(samples) // 2
    labels = {**samples.labels, "session": Labels(("morning", "evening"), later.astype(int))}
    reading = samples.columns["reading"] - 1.3 * later
    both = dataclasses.replace(samples, columns={"reading": reading}, labels=labels)
    dial = dataclasses.replace(problem.instrument, travel=(-8.0, 8.0), zero_shift=dial_zero())
    found = calibrate(Problem(problem.robot, dial), both, method="lm", reference=False)
    few = Samples.of_joints(workspace_joints(problem.robot))

    def tip_in(session):
        labels = {"session": Labels((session,), np.zeros(len(few), dtype=int))}
        return found.predict(dataclasses.replace(few, labels=labels), frame="tip", std=True)

    morning, evening, tomorrow = (tip_in(session) for session in ("morning", "evening", "tomorrow"))
    along = morning.poses[:, :3, 2] * problem.instrument.sign  # the plunger stands along the flange's z
    shifts = dict(zip(found.fit.names, found.x, strict=True))
    apart = shifts["zero_shift.evening"] - shifts["zero_shift.morning"]
    np.testing.assert_allclose(evening.positions - morning.positions, apart * along, atol=1e-9)
    assert (morning.unseen, tomorrow.unseen) == ((), ("tomorrow",))
    bare = found.predict(few, frame="tip", std=True)
    np.testing.assert_allclose(tomorrow.positions, bare.positions, atol=1e-12)
    assert morning.std.mean() < bare.std.mean(), "tool and zero err together, and their sum is known best"
    turned = without_rigid(10.0 * along.ravel(), bare.positions).reshape(-1, 3)
    doubt = np.hypot(bare.std, np.linalg.norm(turned, axis=1))
    np.testing.assert_allclose(tomorrow.std, doubt, rtol=1e-6)
    shown = dataclasses.replace(few, columns={"reading": np.zeros(len(few))})
    with pytest.raises(casacal.CasacalError, match="for each session"):
        found.predict(shown, frame="tip")
    assert len(found.predict(shown)) == len(few)


def test_zeros_of_sessions_are_no_doubt_of_the_arm(middle):
    """Three zeros within a millimetre say nothing against priors of the arm, wide as the zeros' own prior is."""
    problem, samples = middle
    third = np.arange(len(samples)) * 3 // len(samples)
    reading = samples.columns["reading"] - np.array([0.0, 0.7, -0.5])[third]
    labels = {**samples.labels, "session": Labels(("mon", "tue", "wed"), third)}
    rows = dataclasses.replace(samples, columns={"reading": reading}, labels=labels)
    dial = dataclasses.replace(problem.instrument, travel=(-8.0, 8.0), zero_shift=dial_zero())
    found = calibrate(Problem(problem.robot, dial), rows, method="lm", reference=False)
    assert verdict_of(found).level == "calibrated", verdict_of(found).reasons


@pytest.mark.long
def test_targets_of_a_session_are_refused_and_rows_without_one_share_a_zero(middle, tmp_path):
    problem, samples = middle
    again = Problem(problem.robot, dataclasses.replace(problem.instrument, zero_shift=dial_zero()))
    alone = dataclasses.replace(samples, labels={**samples.labels, "session": ("session",) * len(samples)})
    found = calibrate(again, alone, method="lm", reference=False)  # as a file without the column is read
    shift = dict(zip(found.fit.names, found.x, strict=True))["zero_shift.session"]
    shown = dataclasses.replace(Samples.of_joints(samples.joints), columns={"reading": samples.columns["reading"]})
    moved = (
        found.predict(shown, frame="tip").positions
        - calibrate(problem, samples, method="lm", reference=False).predict(shown, frame="tip").positions
    )
    along = found.predict(shown).poses[:, :3, 2]
    assert np.einsum("ij,ij->i", moved, along).mean() == pytest.approx(shift * problem.instrument.sign, abs=0.5)
    joints = ",".join(f"q{k}_deg" for k in range(1, 7))
    (tmp_path / "targets.csv").write_text(f"{joints},session\n0,-60,60,0,30,0,mon\n")
    with pytest.raises(casacal.CasacalError, match="targets cannot be of one session"):
        found.compensate(tmp_path / "targets.csv", frame="tip")


@pytest.mark.long_unless("62-0.4")
@pytest.mark.parametrize(("after", "by"), [(62, 0.4), (30, -0.1)])
def test_a_zero_that_moved_is_named_with_its_place_and_size(middle, after, by):
    problem, samples = middle
    reading = samples.columns["reading"] + by * (np.arange(len(samples)) >= after)
    found = check(
        problem.with_settings({"travel": (-6.0, 6.0)}), dataclasses.replace(samples, columns={"reading": reading})
    )
    assert found[0].about == "dial set to zero anew"
    place, size = re.search(r"near line (\d+), by (\S+) mm", found[0].cause).groups()
    assert int(place) == samples.lines[after]
    assert float(size) == pytest.approx(by, abs=0.01)
    assert "zero_shift=dial_zero()" in found[0].fix


@pytest.mark.long
def test_zeros_that_moved_twice_are_named_with_their_places_and_sizes(middle):
    problem, samples = middle
    order = np.arange(len(samples))
    reading = samples.columns["reading"] + 0.4 * (order >= 30) - 0.7 * (order >= 62)
    shifted = dataclasses.replace(samples, columns={"reading": reading})
    found = check(problem.with_settings({"travel": (-6.0, 6.0)}), shifted)
    assert found[0].about == "dial set to zero anew"
    told = re.findall(r"near line (\d+), by (\S+) mm", found[0].cause)
    assert [int(place) for place, _ in told] == [samples.lines[30], samples.lines[62]]
    assert [float(size) for _, size in told] == pytest.approx([0.4, -0.7], abs=0.01)
    undone = zero_moved(problem, shifted, column="reading").samples.columns["reading"]
    np.testing.assert_allclose(undone, samples.columns["reading"], atol=0.02)
