"""Figures and words on ways beside the usual one: an earlier result, a certificate, a box, another unit, a block."""

import json
import shutil
from argparse import Namespace
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT
from measured_world import World

from casacal import Cell, FixedPoint, Problem, TrackedPose, bind, calibrate, load_problem, plan, simulate, verify
from casacal.calibration.calibration import Calibration
from casacal.calibration.verdict import _known_before
from casacal.cli.common import adjusted
from casacal.cli.main import main
from casacal.deployment.result_file import read_result
from casacal.errors import CasacalError
from casacal.fit.lm import lm
from casacal.model import certified
from casacal.model.robot import random_joints
from casacal.planning.clearance import Clearance
from casacal.planning.route import Route
from casacal.planning.set_ups import with_block
from casacal.shopfloor.conversation import help_words, in_units, touch_of
from casacal.shopfloor.gauges import gauge
from casacal.shopfloor.session import Session
from casacal.uncertainty.noise import found_noise, noise_over_stated
from casacal.uncertainty.priors import prior_tip_rms

HSR = ROOT / "problems" / "hsr_jr680"
SUM = certified("reach", lambda p: p.a[0] + p.a[1], 1150.17326, std=0.02)


def test_cures_know_what_an_earlier_result_knows(hsr, tmp_path):
    """More rows of the same kind leave no more than there is already."""
    made = simulate(hsr.problem, hsr.cell, samples=110, seed=3).samples
    calibrate(hsr, made.take(np.arange(90)), method="lm", reference=False).save(tmp_path)
    few = made.take(np.arange(90, 110))
    kept = calibrate(
        hsr, few, method="lm", prior=read_result(tmp_path), standing=["floor", "wall", "side"], reference=False
    )
    same = next(cure for cure in kept.unjudged.cures if "of the same kind" in cure.words)
    assert same.expected_rms_mm < kept.unjudged.tip_std[1]


@pytest.fixture(scope="module")
def sure(hsr):
    return hsr.problem.with_parts(hsr.problem.robot, hsr.problem.instruments, constraints=(SUM,))


def test_cures_know_a_certificate(hsr, sure):
    made = calibrate(sure, simulate(hsr.problem, hsr.cell, samples=60, seed=3).samples, method="lm", reference=False)
    same = next(cure for cure in made.unjudged.cures if "of the same kind" in cure.words)
    assert same.expected_rms_mm < made.unjudged.tip_std[1]


def test_a_session_knows_a_certificate(hsr, sure):
    route = plan(hsr.problem, hsr.cell, touches=30, pool=200, starts=1, check=0.0, seed=2)
    route = Route(route.samples, route.purposes)
    world = World(hsr.problem, route, seed=1)
    errors = []
    for problem in (hsr.problem, sure):
        session = Session(problem, route)
        for number in range(1, 31):
            session = session.take(*world.touch(number), number=number)
            session = session if session.alarm is None else session.keep()
        errors.append(session.tip_error)
    assert errors[1] < 0.97 * errors[0]


def test_a_block_takes_nothing_away_from_a_problem(hsr, sure, tmp_path):
    blocked, _ = with_block(sure, hsr.cell, 100.0)
    assert [each.name for each in blocked.constraints] == ["reach"]
    shutil.copytree(HSR, tmp_path / "arm")
    file = tmp_path / "arm" / "problem.py"
    text = file.read_text()
    add = "from casacal.model import certified\n"
    add += 'SUM = certified("reach", lambda p: p.a[0] + p.a[1], 1150.17326, std=0.02)\n'
    add += "problem = problem.with_parts(problem.robot, problem.instruments, constraints=(SUM,))\n"
    file.write_text(f"{text}\n{add}")
    asked = ["plan", str(tmp_path / "arm"), "--touches", "40", "--pool", "150", "--block", "100"]
    assert main([*asked, "--out", str(tmp_path / "p.csv")]) == 0
    assert [each.name for each in load_problem(tmp_path / "arm_block").problem.constraints] == ["reach"]


def test_noise_of_orientations_counts_beside_that_of_places(hsr):
    """Five times as much as stated in three of six components is no noise as stated."""
    problem = Problem(hsr.problem.robot, TrackedPose(position_std=0.02, angle_std=1e-4))
    loud = Problem(hsr.problem.robot, TrackedPose(position_std=0.02, angle_std=5e-4))
    bound = bind(problem, simulate(loud, samples=60, seed=1).samples)
    found = found_noise(bound)
    ratio = noise_over_stated(lm(bound.with_noise(found.scale))).ratio
    assert ratio == pytest.approx(np.sqrt((1 + 25) / 2), rel=0.15)


def test_a_box_that_is_the_whole_workspace_errs_as_the_workspace(capsys):
    """The way that a method leaves to the minimum is part of both."""
    box = ",".join(["-9000:9000"] * 3)
    asked = ["calibrate", str(HSR), "--method", "annealing", "--no-reference", "--discrepancy", "none", f"--box={box}"]
    main([*asked, "--json"])
    said = json.loads(capsys.readouterr().out)
    assert said["box"]["expected_rms_mm"] == pytest.approx(said["tip"]["expected_rms_mm"], rel=0.1)


def test_conventions_that_were_confirmed_since_leave_no_image_open():
    asked = SimpleNamespace(earlier=SimpleNamespace(mirror_image="image"), source=SimpleNamespace(confirmed=True))
    assert Calibration.mirror_image.func(asked) is None
    asked.source.confirmed = False
    assert Calibration.mirror_image.func(asked) == "image"


def test_an_earlier_verdict_is_told_beside_what_was_loosened():
    verdict = SimpleNamespace(level="use with care", words="Use with care: mind the dial.")
    told = list(_known_before(SimpleNamespace(earlier=SimpleNamespace(loosened=("joint3",), verdict=verdict))))
    assert [each.clause.split()[0] for each in told] == ["joint3", "the"]
    assert "mind the dial" in told[1].sentence


@pytest.mark.parametrize("unit", ["in", "um", "mm"])
def test_a_bare_number_has_one_unit_whatever_is_typed_with_it(hsr, unit):
    meter, layout = gauge("plain", unit=unit), hsr.problem.layout()
    route = simulate(hsr.problem, hsr.cell, samples=3, seed=1).samples
    planned = Session(hsr.problem, Route(route, ("fit",) * 3)).next()
    factor = {"in": 25.4, "um": 1e-3, "mm": 1.0}[unit]
    joints = " ".join(f"{value:.4f}" for value in np.degrees(planned.joints))
    for line in ("0.05", "0.05 floor", f"{joints} 0.05", f"{joints} 0.05 floor"):
        assert touch_of(line, layout, planned, meter).readings["reading"] == pytest.approx(0.05 * factor), line
    assert in_units(layout, meter) == f"reading in {'inches' if unit == 'in' else unit}"
    assert f"reading in {'inches' if unit == 'in' else unit}" in help_words(hsr.problem, meter)


def test_warnings_of_a_program_are_in_json_as_well(tmp_path, capsys):
    asked = ["plan", str(HSR), "--touches", "40", "--pool", "150", "--program", "rapid", "--retreat", "400", "--json"]
    assert main([*asked, "--out", str(tmp_path / "p.csv")]) == 0
    said = " ".join(json.loads(capsys.readouterr().out)["warnings"])
    assert "cannot draw back by 400 mm" in said
    assert "are fitted, but" not in said, "those that repeat others are fitted, too"


@pytest.mark.parametrize("change", [{}, {"fix": ["alpha"]}, {"free": ["alpha"]}])
def test_an_accuracy_is_that_of_the_arm_as_it_is_calibrated(hsr, change):
    problem = hsr.problem.fix("alpha") if "free" in change else hsr.problem
    asked = {"accuracy": 1.0, "set": [], "free": [], "fix": [], "prior": [], **change}
    assert prior_tip_rms(adjusted(problem, Namespace(**asked))) == pytest.approx(1.0, rel=0.02)
    with pytest.raises(CasacalError, match="both given a prior"):
        adjusted(problem, Namespace(**{**asked, "fix": ["a3"], "prior": ["a3=1"]}))


def test_a_box_of_the_cell_that_is_named_again_is_one_box(hsr):
    box = ((-500.0, -400.0), (0.0, 100.0), (0.0, 100.0))
    around = Clearance((box,)).around(hsr.problem.robot, replace(hsr.cell, keep_out=(box,)))
    joints = random_joints(hsr.problem.robot, 5, np.random.default_rng(0))
    names = {other for _, other, _ in around.collisions(joints, np.zeros((5, 3)))}
    assert len([name for name in names if name.startswith("box")]) == 1
    assert isinstance(hsr.cell, Cell)


def test_an_earlier_result_leaves_what_evaluates_the_rows_to_the_user(hsr, tmp_path):
    made = simulate(hsr.problem, hsr.cell, samples=100, seed=3).samples
    calibrate(hsr, made.take(np.arange(80)), method="lm", reference=False, discrepancy="none").save(tmp_path)
    few, how = made.take(np.arange(80, 100)), {"method": "lm", "reference": False, "prior": tmp_path}
    assert calibrate(hsr, few, **how, backend="blocks").fit.backend == "blocks"
    assert calibrate(hsr, few, **how, backend="c").fit.backend == "c"
    with pytest.raises(CasacalError, match="nonsense"):
        calibrate(hsr, few, **how, backend="nonsense")


def test_set_ups_are_refused_before_a_plan_is_written(tmp_path, capsys):
    out = tmp_path / "plan.csv"
    tracked = str(ROOT / "problems" / "instruments" / "tracker")
    assert main(["plan", tracked, "--out", str(out), "--touches", "12", "--pool", "40", "--setups"]) == 2
    assert "there are no set-ups" in capsys.readouterr().err
    assert not out.exists()


def test_a_session_is_named_only_where_sessions_are_told_apart(tmp_path, capsys):
    plan_file = tmp_path / "plan.csv"
    assert main(["plan", str(HSR), "--out", str(plan_file), "--touches", "12", "--pool", "40"]) == 0
    capsys.readouterr()
    options = ["--plan", str(plan_file), "--out", str(tmp_path / "s.csv"), "--session", "monday"]
    assert main(["measure", str(HSR), *options]) == 2
    assert "no column that tells sessions apart" in capsys.readouterr().err


def test_fresh_rows_name_their_instrument_in_another_problem(hsr, tmp_path):
    """The calibration has a dial; the problem of the fresh rows has two instruments, of which one took them."""
    dial = hsr.problem.instrument
    made = simulate(hsr.problem, hsr.cell, samples=120, seed=3).samples
    calibrate(hsr, made.take(np.arange(90)), method="lm", reference=False, discrepancy="none").save(tmp_path)
    fresh = made.take(np.arange(90, 120))
    both = Problem(hsr.problem.robot, {"pointer": FixedPoint(noise_std=0.03), "dial": dial})
    with pytest.raises(CasacalError, match=r"measured by 2 instruments.*measured_by\('pointer'\)"):
        verify(tmp_path, fresh, problem=both)
    found, alone = (
        verify(tmp_path, fresh, problem=problem, instrument=name)
        for problem, name in ((both, "dial"), (hsr.problem, None))
    )
    assert found.p == alone.p
    assert found.kept
