"""What a summary must say beside its parameters: warnings, robust rows, standard deviations where users ask."""

import dataclasses
import json
import math

import numpy as np
import pytest
from conftest import ROOT

from casacal import Parameter, Problem, bind, calibrate, lm, load_problem, simulate, tool_point
from casacal.calibration.motion import tip_extremes
from casacal.calibration.summary import summary
from casacal.calibration.verdict import warnings
from casacal.cli.main import main
from casacal.errors import CasacalError, ProblemError
from casacal.kernels.losses import huber, tukey
from casacal.uncertainty.priors import prior_tip_rms, scaled_to_accuracy
from casacal.uncertainty.tip_error import (
    accuracy_in_box,
    classical_bound,
    planned_accuracy,
    tip_rms,
    tip_stds,
    up_to_base,
    without_rigid,
    workspace_joints,
)


@pytest.mark.long
def test_loose_priors_on_the_real_arm_are_refused(motoman_data):
    problem = load_problem(ROOT / "problems" / "motoman_ma1400").problem
    loose = problem.with_prior({"a": 10, "d": 10, "alpha": 0.01, "theta": 0.01})
    calibration = calibrate(
        loose, problem.read(motoman_data / "contacts.csv"), method="lm", reference=False, holdout=0.3
    )
    moved, std = tip_extremes(calibration.motion, calibration.workspace)
    text = summary(calibration, "motoman")
    assert moved > 3
    assert std > 3
    assert calibration.denied
    assert "the priors are too loose for this arm" in text
    assert "in places that the samples do not cover" in warnings(calibration)[-1]
    assert len(calibration.identifiability.weak) + len(calibration.identifiability.null) > 10
    assert "weak" in text


@pytest.mark.long
def test_a_parameter_that_moves_too_far_is_named(hsr):
    simulation = simulate(hsr.problem, dataclasses.replace(hsr.cell, error_scale=8.0), seed=1)
    found = calibrate(hsr.problem, simulation.samples, method="lm", reference=False)
    vars(found.unjudged)["data_errors"] = ()  # of the data check nothing is asked here, and it takes hundreds of fits
    said = warnings(found.unjudged)
    assert "more than 4 prior standard deviations" in said[0]


def test_no_parameter_table_without_verdicts(hsr):
    text = summary(
        calibrate(hsr.problem, simulate(hsr.problem, hsr.cell, seed=1).samples, method="lm", reference=False), "hsr"
    )
    table = [line for line in text.splitlines() if line[:2] in ("a1", "d6", "th")]
    assert len(table) >= 8
    assert all(line.endswith(("samples", "samples and prior", "prior alone")) for line in table)


@pytest.mark.parametrize("loss", [huber(), tukey()], ids=lambda loss: loss.name)
def test_losses_match_their_weights_and_ignore_gross_rows(hsr, loss):
    r = np.linspace(-8, 8, 41) + 0.013
    slope = (loss.cost(r + 1e-6) - loss.cost(r - 1e-6)) / 2e-6
    np.testing.assert_allclose(slope, loss.weight(r) * r, atol=1e-6)
    simulation = simulate(hsr.problem, hsr.cell, seed=4)
    reading = simulation.samples.columns["reading"].copy()
    reading[[5, 17, 60]] += (0.8, -0.6, 1.5)
    spoiled = dataclasses.replace(simulation.samples, columns={"reading": reading})
    bound = bind(hsr.problem, spoiled)
    truth, start = simulation.truth(bound), lm(bound, loss=huber()).x
    robust = lm(bound, loss=loss, start=start)
    assert robust.converged
    joints = workspace_joints(hsr.problem.robot)
    tips = bound.tips(truth, joints)
    plain_error, robust_error = (
        tip_rms(without_rigid((bound.tips(x, joints) - tips).ravel(), tips)) for x in (lm(bound).x, robust.x)
    )
    assert robust_error < plain_error
    assert (robust.weights[[5, 17, 60]] < 0.05).all()
    calibration = calibrate(hsr.problem, spoiled, method="lm", loss=loss)
    assert {6, 18, 61} <= set(calibration.down_weighted)
    assert any("robust loss" in sentence for sentence in warnings(calibration))
    with pytest.raises(CasacalError, match="Use one of lm"):
        calibrate(hsr.problem, spoiled, method="sckf", loss=loss)


@pytest.mark.long
def test_predicted_standard_deviations(tmp_path):
    problem = str(ROOT / "problems" / "hsr_jr680")
    joints = f"{problem}/samples.csv"
    assert main(["calibrate", problem, "--method", "lm", "--no-reference", "--out", str(tmp_path)]) == 0
    for frame in ("tip", "flange"):
        out = tmp_path / f"{frame}.csv"
        arguments = ["predict", str(tmp_path / "result.json"), joints, "--frame", frame, "--std", "--out", str(out)]
        assert main(arguments) == 0
        assert out.read_text().splitlines()[1] == "x_mm,y_mm,z_mm,qw,qx,qy,qz,std_mm"
        std = np.loadtxt(out, delimiter=",", skiprows=2)[:, 7]
        assert ((std > 0.01) & (std < 2)).all()
    assert main([*arguments, "--nominal"]) == 2
    document = json.loads((tmp_path / "result.json").read_text())
    assert len(document["covariance"]) == len(document["unknowns"]) == 33
    assert document["noise"]["low"] < document["noise"]["ratio"] < document["noise"]["high"]


def test_tip_stds_are_those_of_sampled_parameters():
    rng = np.random.default_rng(0)
    root, field = rng.normal(size=(4, 4)), rng.normal(size=(6, 4))
    covariance = root @ root.T
    drawn = field @ (root @ rng.normal(size=(4, 40000)))
    np.testing.assert_allclose(tip_stds(covariance, field).ravel(), drawn.std(axis=1), rtol=0.03)
    covariance[3, :] = covariance[:, 3] = 0.0
    covariance[3, 3] = np.inf
    assert np.isinf(tip_stds(covariance, field)).all()


def test_a_rigid_motion_is_taken_out_anywhere():
    rng = np.random.default_rng(1)
    tips, others = rng.uniform(-1000, 1000, (50, 3)), rng.uniform(-1000, 1000, (7, 3))
    turn, shift = rng.normal(size=3) * 1e-3, rng.normal(size=3)
    moved = lambda points: (np.cross(turn, points) + shift).ravel()[:, None]  # noqa: E731
    np.testing.assert_allclose(up_to_base(moved(others), others, moved(tips), tips), 0, atol=1e-9)
    np.testing.assert_allclose(without_rigid(moved(tips), tips), 0, atol=1e-9)


def test_the_classical_bound_is_infinite_where_a_tip_moves_unseen():
    tips = np.array([[0.0, 0, 0], [1000, 0, 0], [0, 1000, 0], [300, 200, 900]])
    field = np.random.default_rng(2).normal(size=(12, 3))
    jacobian = np.array([[1.0, 0.2, 0], [0.3, 2.0, 0], [0.5, 0.1, 0]])
    bound, blind = classical_bound(jacobian, np.ones(3), field, tips)
    assert (bound, blind) == (math.inf, 1)
    field[:, 2] = 0.0
    bound, blind = classical_bound(jacobian, np.ones(3), field, tips)
    seen = without_rigid(field, tips)[:, :2]
    expected = np.trace(seen @ np.linalg.inv(jacobian[:, :2].T @ jacobian[:, :2]) @ seen.T)
    assert blind == 0
    assert bound == pytest.approx(math.sqrt(expected / 4))


def test_a_user_without_a_prior_gets_one_by_unit():
    np.testing.assert_allclose(Parameter((1.0, 2.0)).prior_stds, 0.7)
    np.testing.assert_allclose(Parameter(0.1, unit="rad").prior_stds, 1e-3)
    assert math.isinf(Parameter(1.0, prior_std=math.inf).prior_stds[0])
    with pytest.raises(ProblemError, match="no prior_std"):
        Parameter(1.0, unit="N/m")


def test_priors_scale_to_the_maker_s_accuracy(hsr):
    assert 2 < prior_tip_rms(hsr.problem) < 4
    scaled = scaled_to_accuracy(hsr.problem, 1.2)
    assert prior_tip_rms(scaled) == pytest.approx(1.2)
    before, after = (p.robot.parameters["a"].prior_stds for p in (hsr.problem, scaled))
    np.testing.assert_allclose(after / before, after[0] / before[0])
    with pytest.raises(ProblemError, match=r"Give mm, 0\.01 or more"):
        scaled_to_accuracy(hsr.problem, -1)
    assert main(["calibrate", str(hsr.path), "--accuracy", "1.2", "--method", "lm", "--no-reference"]) == 0


def test_what_to_expect_of_a_plan_and_inside_a_box(hsr, capsys):
    bound = bind(hsr.problem, simulate(hsr.problem, hsr.cell, seed=3).samples)
    before, after = planned_accuracy(bound)
    assert before > 2.5
    assert 0.3 < after < 1.0
    rms, worst = accuracy_in_box(bound, bound.x0, ((1000.0, 1700.0), (-400.0, 400.0), (400.0, 1000.0)))
    assert rms <= worst < 2 * after
    command = ["calibrate", str(hsr.path), "--method", "lm", "--no-reference", "--box"]
    assert main([*command, "1000:1700,-400:400,400:1000"]) == 0
    assert "Inside 1000:1700,-400:400,400:1000 mm: " in capsys.readouterr().out
    assert main([*command, "9000:9100,0:1,0:1"]) == 0, "the calibration stands all the same"
    assert "Only 0 of 40000 random postures" in capsys.readouterr().out
    assert main([*command, "1000:1700,0:100"]) == 2
    assert "X0:X1" in capsys.readouterr().err


@pytest.mark.long
def test_the_flange_is_promised_what_drawn_arms_keep(hsr):
    """By drawing arms of the posterior and of the prior: the spread of the flange, a tool of its own beside it."""
    arm = Problem(
        hsr.problem.robot, dataclasses.replace(hsr.problem.instrument, tool=tool_point(0, 0, 300, prior_std=3))
    )
    calibration = calibrate(arm, simulate(arm, hsr.cell, seed=2).samples, reference=False)
    rng, joints = np.random.default_rng(0), workspace_joints(arm.robot)
    fit, center = calibration.fit, calibration.x
    right = fit.poses(center, joints)[:, :3, 3]
    root = np.linalg.cholesky(calibration.result.covariance)
    drawn = {"now": [center + root @ rng.normal(size=center.size) for _ in range(200)]}
    free = np.where(np.isfinite(fit.prior_std), fit.prior_std, 0.0)
    drawn["before"] = [center + free * rng.normal(size=center.size) for _ in range(200)]
    sizes = {
        name: math.sqrt(np.mean([tip_rms(without_rigid((fit.poses(x, joints)[:, :3, 3] - right).ravel(), right)) ** 2
                                 for x in states]))
        for name, states in drawn.items()
    }  # fmt: skip
    assert calibration.flange_std == pytest.approx((sizes["before"], sizes["now"]), rel=0.1)
    assert calibration.tip_std[0] > 1.2 * calibration.flange_std[0]
