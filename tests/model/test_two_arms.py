"""Two arms as one chain, and balls on them that touch: by hand, simulated, and on the arms of others."""

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from instruments_on_ur5 import ROBOT, flanges
from scipy.stats import chi2
from two_arms import balls, problem

from casacal import (
    Parameter,
    Problem,
    Robot,
    Samples,
    SelfContact,
    bind,
    calibrate,
    check,
    deg,
    ipopt,
    lm,
    load,
    simulate,
    tool_point,
)
from casacal.calibration.verdict import verdict_of
from casacal.cli.main import main
from casacal.errors import ProblemError
from casacal.model import facing
from casacal.simulation import Disturbances
from casacal.uncertainty.figures import nees
from casacal.uncertainty.tip_error import bayesian_bound, tip_rms, without_rigid, workspace_joints

DATA = Path(os.environ.get("CASACAL_DATA", Path(__file__).parent.parent.parent.parent / "shared" / "data"))
BALL = (0.0, 0.0, 354.0)
HELD = ("other_alpha", "other_a", "other_d", "other_theta")


def test_the_chain_is_what_one_flange_sees_of_the_other():
    """Both arms of a kind on one base, poses multiplied out in NumPy."""
    two = Problem(facing(ROBOT, ROBOT), balls)
    joints = np.random.default_rng(0).uniform(-2, 2, size=(7, 12))
    bound = bind(two, Samples.of_joints(joints))
    wanted = np.linalg.inv(flanges(joints[:, 6:])) @ flanges(joints[:, :6])
    np.testing.assert_allclose(bound.poses(bound.x0, joints), wanted, atol=1e-9)
    tips = wanted[:, :3] @ [0, 0, 120, 1]
    np.testing.assert_allclose(bound.plain_residual(bound.x0), np.linalg.norm(tips - [5, 0, 100], axis=1) - 40)


def test_joints_that_both_share_come_once():
    two = facing(ROBOT, ROBOT, shared=2)
    assert len(two.axes) == 10
    joints = np.random.default_rng(1).uniform(-2, 2, size=(5, 10))
    theirs = np.hstack([joints[:, :2], joints[:, 6:]])
    problem = Problem(two, balls)
    bound = bind(problem, Samples.of_joints(joints))
    wanted = np.linalg.inv(flanges(theirs)) @ flanges(joints[:, :6])
    np.testing.assert_allclose(bound.poses(bound.x0, joints), wanted, atol=1e-9)


@pytest.mark.long
def test_touches_of_two_arms_are_simulated_fitted_and_read_back(tmp_path):
    simulated = simulate(problem, Disturbances(resolution=0.0), samples=90, seed=2)
    assert all(finding.severity != "error" for finding in check(problem, simulated.samples))
    bound = bind(problem, simulated.samples)
    mine, theirs = lm(bound), ipopt(bound)
    assert mine.cost == pytest.approx(theirs.cost, rel=1e-8)
    truth = simulated.truth(bound)
    assert np.abs((mine.x - truth) / mine.std).max() < 4.5
    found = calibrate(problem, simulated.samples, reference=False)
    found.save(tmp_path)
    back = load(tmp_path)
    joints = simulated.samples.joints[:3]
    np.testing.assert_allclose(back.predict(joints).positions, found.predict(joints).positions, atol=1e-9)


@pytest.mark.long
def test_the_whole_way_of_touches_of_two_arms(tmp_path, capsys):
    """Simulate, check, calibrate, verify, report, by the command line."""
    place, out = tmp_path / "cell", tmp_path / "out"
    place.mkdir()
    (place / "problem.py").write_text("from two_arms import problem\n", encoding="utf-8")
    assert main(["simulate", str(place), "--out", str(tmp_path / "rows.csv"), "--samples", "140", "--seed", "4"]) == 0
    lines = (tmp_path / "rows.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    for name, some in (("fitted", lines[:112]), ("fresh", lines[:2] + lines[112:])):
        (tmp_path / f"{name}.csv").write_text("".join(some), encoding="utf-8")
    assert main(["check", str(place), str(tmp_path / "fitted.csv")]) == 0
    assert main(["calibrate", str(place), str(tmp_path / "fitted.csv"), "--out", str(out)]) == 0
    assert "distance between the balls" in (out / "report.html").read_text(encoding="utf-8").lower()
    assert main(["verify", str(out), str(tmp_path / "fresh.csv")]) == 0, capsys.readouterr().out


@pytest.mark.long
def test_estimates_of_two_arms_reach_their_bound_and_know_it():
    joints = workspace_joints(problem.robot)
    ratios, total, freedom = [], 0.0, 0
    for seed in range(50):
        simulated = simulate(problem, Disturbances(resolution=0.0), samples=80, seed=seed)
        bound = bind(problem, simulated.samples)
        truth, result = simulated.truth(bound), lm(bound)
        tips = bound.tips(truth, joints)
        best = bayesian_bound(
            bound.information(truth), bound.prior_information, bound.tip_jacobian(truth, joints), tips
        )
        ratios.append(tip_rms(without_rigid((bound.tips(result.x, joints) - tips).ravel(), tips)) / best)
        total += nees(result.x - truth, result.covariance)
        freedom += truth.size
    assert 0.9 < np.sqrt(np.mean(np.square(ratios))) < 1.1
    low, high = chi2.ppf([0.0005, 0.9995], freedom)
    assert low < total < high


def test_what_cannot_face_is_refused():
    for make, said in (
        (lambda: facing(ROBOT, 5), "as an arm"),
        (lambda: facing(ROBOT, ROBOT, shared=7), "Two arms share 7 joints"),
        (lambda: facing(ROBOT, ROBOT, shared=-1), "Two arms share -1 joints"),
        (lambda: facing(facing(ROBOT, ROBOT), ROBOT), "begin with 'other_'"),
    ):
        with pytest.raises(ProblemError, match=said):
            make()


def motoman(sense, **stds):
    """One of the two arms of the Motoman at the Czech Technical University."""
    table = {
        "alpha": deg(15 * sense, -90, 180, -90, 90, 90, 0),
        "a": (0, 150, 614, 200, 0, 30, 0),
        "d": (-263, 1415.9, 0, 0, -640, 0, 200),
        "theta": deg(-90, 0, -90, 0, 0, -90, 0),
    }
    return Robot.from_dh("Motoman", **table, **stds)


@pytest.fixture(scope="module")
def touches():
    place = DATA / "ctu_self_contact" / "self_contact.csv"
    if not place.is_file():
        pytest.skip(f"the touches of two arms are not at {place}; set CASACAL_DATA to the folder that holds theirs")
    rows = pd.read_csv(place).drop(columns="left_q1_rad")
    return rows.rename(columns={f"left_q{j}_rad": f"q{j + 6}_rad" for j in range(2, 8)})


def self_touching(**stds):
    """The right arm free, the left one as drawn, as in the authors' own fit."""
    seen = SelfContact(
        noise_std=0.45,
        tool=tool_point(*BALL, prior_std=10.0),
        other=tool_point(*BALL, free=False),
        apart=Parameter(116.0, unit="mm", free=False),
    )
    return Problem(facing(motoman(1, **stds), motoman(-1), shared=1), seen).fix(*HELD)


def test_self_contact_starts_where_its_authors_say(touches):
    problem = self_touching()
    for part, rms in (("train", 1.36063), ("test", 1.30756)):
        samples = Samples.from_frame(touches[touches["split"] == part], problem.layout())
        bound = bind(problem, samples)
        assert np.sqrt((bound.plain_residual(bound.x0) ** 2).mean()) == pytest.approx(rms, abs=5e-6)


@pytest.mark.long
def test_self_contact_alone_is_denied_where_no_prior_holds_the_arm(touches):
    """It fits to 0.1 mm and ruins the arm: a tracker then reads 1.3 to 2.5 times what it reads of the drawn one."""
    problem = self_touching(length_std=0.7, angle_std=1e-3)
    samples = Samples.from_frame(touches[touches["split"] == "train"], problem.layout())
    for discrepancy in ("none", "kit"):
        found = calibrate(problem, samples, reference=False, discrepancy=discrepancy)
        assert verdict_of(found).level == "do not use"
