"""Plans: exchange against every choice there is, the reference's figures, many true arms, the file to take along."""

import dataclasses
import itertools
import json
import re
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from instruments_on_ur5 import PROBLEMS

from casacal import CasacalError, bind, calibrate, load_problem, simulate
from casacal.cli.main import main
from casacal.data.columns import Labels
from casacal.linalg import posterior_covariance
from casacal.model.robot import AXIS_WEIGHT
from casacal.planning.candidates import pool_of
from casacal.planning.choice import Choice, _Without
from casacal.planning.plan import _by_label, kept_to_verify, plan, plan_text, touches_for
from casacal.planning.route import AGAIN, CHECK, FIT, read_route, shortest_way
from casacal.planning.set_ups import SetUp, worth_most
from casacal.uncertainty.tip_error import (
    accuracy_in_box,
    planned_accuracy,
    tip_rms,
    tip_stds,
    up_to_base,
    without_rigid,
    workspace_joints,
)

HSR = ROOT / "problems" / "hsr_jr680"


@pytest.fixture(scope="module")
def forty(hsr):
    """Forty touches to fit, none else; the reference's pool."""
    return plan(hsr.problem, hsr.cell, touches=40, check=0.0, again=0.0)


@pytest.mark.parametrize("criterion", ["tip", "parameters"])
@pytest.mark.parametrize("size", [1, 3])
def test_what_a_plan_less_one_row_gains_is_that_of_its_own_inverse(size, criterion):
    """For every row left out, one of which alone tells of an unknown: there the difference is of two large numbers."""
    rng = np.random.default_rng(3)
    rows, half = rng.normal(size=(30, size, 9)), rng.normal(size=(9, 9))
    rows[1:, :, 8] = 0.0
    choice = Choice(rows, 1e-9 * np.eye(9), half @ half.T)
    plan = np.arange(12)
    without = _Without.of(choice, plan)
    for one in plan:
        left = np.delete(rows, [one, *range(12, 30)], axis=0).reshape(-1, 9)
        covariance = np.linalg.inv(choice.known + left.T @ left)
        found, total = without.gains(one, criterion)
        assert total == pytest.approx(np.trace(covariance @ choice.weight), rel=1e-9)
        for row, gain in zip(rows, found, strict=True):
            after = np.linalg.inv(np.linalg.inv(covariance) + row.T @ row)
            fall = np.trace((covariance - after) @ choice.weight)
            fall = np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(after)[1] if criterion == "parameters" else fall
            assert gain == pytest.approx(fall, rel=1e-6, abs=1e-6 * max(total, 1.0) if one == 0 else 1e-9)


@pytest.mark.parametrize("size", [1, 3])
def test_exchange_finds_the_best_of_all_choices(size):
    """Of 12 measurements 4, 495 ways; the error from the definition."""
    rng = np.random.default_rng(size)
    rows, half = rng.normal(size=(12, size, 5)), rng.normal(size=(5, 5))
    known, weight = np.diag(rng.uniform(0.1, 1, 5)), half @ half.T

    def error(chosen):
        told = known + sum(rows[k].T @ rows[k] for k in chosen)
        return np.sqrt(np.trace(np.linalg.inv(told) @ weight))

    best = min(error(chosen) for chosen in itertools.combinations(range(12), 4))
    found = [Choice(rows, known, weight).exchange(rng.choice(12, 4, replace=False)) for _ in range(6)]
    assert min(left for _, left in found) == pytest.approx(best, rel=1e-9)
    for chosen, left in found:
        assert len(set(chosen.tolist())) == 4
        assert left == pytest.approx(error(chosen), rel=1e-9)
        assert left < 1.25 * best
        for place, other in itertools.product(range(4), set(range(12)) - set(chosen.tolist())):
            swapped = chosen.copy()
            swapped[place] = other
            assert error(swapped) > left * (1 - 1e-6), "no single exchange is better"


def test_no_measurement_is_planned_twice():
    """One that tells ten times as much would be taken four times if it could be."""
    rng = np.random.default_rng(3)
    rows = rng.normal(size=(9, 1, 3))
    rows[4] *= 10
    chosen, _ = Choice(rows, np.eye(3), np.eye(3)).exchange(np.array([0, 1, 2, 3]))
    assert sorted(set(chosen.tolist())) == sorted(chosen.tolist())
    assert 4 in chosen


@pytest.mark.long
def test_forty_planned_touches_do_what_a_hundred_and_twenty_random_ones_do(hsr, forty):
    """Reference: 40 planned 0.520, 120 random 0.545, 40 random 1.00 mm (another pool, another tool)."""
    bound = bind(hsr.problem, forty.samples)
    assert planned_accuracy(bound)[1] == pytest.approx(forty.error, rel=1e-4)
    many = simulate(hsr.problem, hsr.cell, samples=120, seed=5).samples
    assert forty.error < 1.02 * planned_accuracy(bind(hsr.problem, many))[1]
    assert forty.error < 0.56
    assert 0.85 < forty.at_random < 1.2
    assert 0.10 < forty.best < 0.13
    assert sorted(np.bincount(forty.samples.labels["plane"].codes))[0] >= 8, "every face is touched"
    curve = list(forty.curve.items())
    assert [count for count, _ in curve] == [10, 20, 30, 40, 60]
    assert all(one > two for (_, one), (_, two) in itertools.pairwise(curve))


@pytest.mark.long
def test_true_arms_follow_the_promise(hsr, forty):
    """Twelve arms drawn from the prior read what they read at the planned postures; tips of fresh ones, by hand."""
    nominal = bind(hsr.problem, forty.samples)
    joints, ratios = workspace_joints(hsr.problem.robot), []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        x = nominal.x0 + nominal.start_std * rng.normal(size=nominal.unknowns)
        readings = forty.samples.columns["reading"]
        # the residual is linear in the reading: two say where it vanishes
        r = [
            nominal.on(with_readings(forty.samples, readings + shift)).plain_residual(x).ravel() for shift in (0.0, 1.0)
        ]
        true = readings - r[0] / (r[1] - r[0]) + rng.normal(size=len(readings)) * 0.01
        found = calibrate(
            hsr.problem, with_readings(forty.samples, true), reference=False, discrepancy="none", outliers="keep"
        )
        error = (found.fit.tips(found.result.x, joints) - nominal.tips(x, joints)).ravel()
        ratios.append(tip_rms(without_rigid(error, nominal.tips(nominal.x0, joints))) / forty.error)
    assert 0.75 < np.sqrt(np.mean(np.square(ratios))) < 1.25


def with_readings(samples, readings):
    return dataclasses.replace(samples, columns={**samples.columns, "reading": readings})


@pytest.mark.long_unless("adept_cobra600")
@pytest.mark.parametrize("name", ["ur5", "kuka_iiwa14", "adept_cobra600"])
def test_any_arm_is_planned_for(name):
    source = load_problem(ROOT / "problems" / name)
    found = plan(source.problem, source.cell, touches=40, pool=600, starts=1)
    low, high = source.problem.robot.limits
    assert (found.samples.joints >= low).all()
    assert (found.samples.joints <= high).all()
    assert found.error < 0.9 * found.at_random
    assert found.best < found.error < found.before
    check = 9 if name == "adept_cobra600" else 6  # two place each of its three faces, and one more may be lost
    assert [found.purposes.count(each) for each in (FIT, CHECK, AGAIN)] == [38 - check, check, 2]
    assert found.purposes[-2:] == (AGAIN, AGAIN)
    rows = [tuple(row) for row in found.samples.joints]
    assert len(set(rows)) == 38
    assert all(rows.index(row) < 38 for row in rows[-2:]), "what comes again has come before"
    assert {found.purposes[rows.index(row)] for row in rows[-2:]} == {FIT}
    assert (
        np.abs(bind(source.problem, found.samples).plain_residual(bind(source.problem, found.samples).x0)).max() < 1e-3
    )


@pytest.mark.parametrize("name", ["TrackedPoint", "Distance", "TrackedPose"])
def test_any_instrument_is_planned_for(name):
    found = plan(PROBLEMS[name], touches=20, pool=200, starts=1)
    assert found.error < 0.97 * found.at_random


def test_a_plan_is_the_same_for_the_same_seed(hsr):
    one, two, other = (plan(hsr.problem, hsr.cell, touches=20, pool=200, starts=1, seed=seed) for seed in (3, 3, 4))
    assert one == two
    assert one != other


def test_a_box_and_targets_are_where_the_tip_is_best(hsr):
    box = ((700.0, 1000.0), (-200.0, 200.0), (300.0, 700.0))
    given = {"touches": 18, "pool": 400, "check": 0.0, "again": 0.0}
    whole, inside = plan(hsr.problem, hsr.cell, **given), plan(hsr.problem, hsr.cell, box=box, **given)
    errors = []
    for each in (whole, inside):
        bound = bind(hsr.problem, each.samples)
        errors.append(accuracy_in_box(bound, bound.x0, box)[0])
    assert errors[1] < 0.97 * errors[0]
    assert inside.error == pytest.approx(errors[1], rel=1e-4)
    targets = inside.samples.joints[:3]
    one = plan(hsr.problem, hsr.cell, targets=targets, **given)
    bound, frame = bind(hsr.problem, one.samples), workspace_joints(hsr.problem.robot)
    covariance = posterior_covariance(bound.information(bound.x0), bound.prior_information)
    at, over = ((bound.tip_jacobian(bound.x0, q), bound.tips(bound.x0, q)) for q in (targets, frame))
    stds = tip_stds(covariance, up_to_base(*at, *over))
    assert one.error == pytest.approx(np.sqrt((stds**2).sum(axis=1).mean()), rel=1e-4)
    assert one.error < 0.9 * one.at_random


def length_of(robot, joints):
    """How far the joint that has furthest to go goes from posture to posture (N, n), all steps together, rad."""
    places = joints / np.where(robot.revolute, 1.0, AXIS_WEIGHT)
    return float(np.abs(np.diff(places, axis=0)).max(axis=1).sum())


def test_the_way_is_short_and_comes_everywhere(hsr):
    rng, robot = np.random.default_rng(0), hsr.problem.robot
    few = rng.uniform(-1, 1, (7, 6))
    order = shortest_way(robot, few)
    ways = [length_of(robot, few[[order[0], *rest]]) for rest in itertools.permutations(order[1:])]
    assert sorted(order.tolist()) == list(range(7))
    assert length_of(robot, few[order]) < 1.15 * min(ways)
    many = rng.uniform(-1, 1, (80, 6))
    order = shortest_way(robot, many)
    assert sorted(order.tolist()) == list(range(80))
    assert length_of(robot, many[order]) < 0.6 * length_of(robot, many)
    assert shortest_way(robot, many[:1]).tolist() == [0]
    nearest = [order[0]]  # the nearest next, by hand; crossings are undone beyond that
    while len(nearest) < 80:
        left = [k for k in range(80) if k not in nearest]
        nearest.append(min(left, key=lambda k: np.abs(many[k] - many[nearest[-1]]).max()))
    assert length_of(robot, many[order]) < 0.97 * length_of(robot, many[nearest])


def test_what_comes_again_counts(hsr):
    found = plan(hsr.problem, hsr.cell, touches=30, pool=120, starts=1, check=0.2, again=0.3)
    fitted = [k for k, purpose in enumerate(found.purposes) if purpose in (FIT, AGAIN)]
    assert len(fitted) == 24
    rows = found.samples.take(fitted)
    assert found.error == pytest.approx(planned_accuracy(bind(hsr.problem, rows))[1], rel=1e-4)


def test_so_many_touches_as_a_tolerance_takes(hsr):
    count = touches_for(hsr.problem, hsr.cell, 1.0)
    assert 12 < count < 40
    found = plan(hsr.problem, hsr.cell, touches=count, pool=1000, starts=1, check=0.0, again=0.0)
    assert found.error < 1.05
    box = ((700.0, 1000.0), (-200.0, 200.0), (300.0, 700.0))
    assert touches_for(hsr.problem, hsr.cell, 1.0, box=box) < count, "a part of the workspace is known sooner"
    with pytest.raises(CasacalError, match=r"leave .* mm, more than 0\.01 mm"):
        touches_for(hsr.problem, hsr.cell, 0.01, most=24)
    for wrong in (0.0, -1.0, float("nan"), "a"):
        with pytest.raises(CasacalError, match="as the tolerance"):
            touches_for(hsr.problem, hsr.cell, wrong)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"touches": 2}, "as the touches. Give a whole number from 3 on"),
        ({"touches": 60, "pool": 30}, "as the pool. Give a whole number from 60 on"),
        ({"touches": True}, "as the touches"),
        ({"starts": 0}, "as the starts"),
        ({"check": 1.0}, "as the part 'check'"),
        ({"again": -0.1}, "as the part 'again'"),
        ({"check": 0.6, "again": 0.39}, "Fewer than three of"),
        ({"targets": [[1.0, 2.0]]}, "Targets have the shape"),
        ({"box": ((0, 1), (0, 1), (5, 4))}, "The box 0:1,0:1,5:4 is empty"),
        ({"box": ((0, 1), (0, 1), (4, 5)), "targets": [[0.0] * 6]}, "Got a box and targets"),
    ],
)
def test_what_makes_no_plan_is_said(hsr, given, said):
    with pytest.raises(CasacalError, match=said):
        plan(hsr.problem, hsr.cell, **{"touches": 20, "pool": 60, **given})


def test_several_instruments_are_planned_one_by_one():
    several = load_problem(ROOT / "problems" / "ur5_three_instruments")
    with pytest.raises(CasacalError, match="measured_by"):
        plan(several.problem)
    assert len(plan(several.problem.measured_by("spike"), touches=12, pool=60, starts=1)) == 12


@pytest.mark.long
@pytest.mark.usefixtures("set_ups_of_few")
def test_the_command_line_plans(tmp_path, capsys):
    out = tmp_path / "plan.csv"
    small = ["--pool", "80", "--touches", "20"]
    assert main(["plan", str(HSR), "--out", str(out), *small]) == 0
    told = capsys.readouterr().out
    assert "20 touches: 16 to fit, 1 of them once more, 3 kept to verify" in told
    lines = out.read_text().splitlines()
    assert lines[0].endswith("not a measurement")
    assert [line.split(":")[0] for line in lines[3:7]] == [
        "# Collisions looked at",
        *(f"# Face {each}" for each in ("floor", "wall", "side")),
    ]
    assert lines[7].startswith("# A face is left out"), "one of three has no touch"
    assert lines[11] == "touch,purpose,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,expected_reading_mm,plane"
    assert len(lines) == 32
    source = load_problem(HSR)
    assert out.read_text() == plan_text(
        plan(source.problem, source.cell, touches=20, pool=80), source.problem, source.name
    )
    assert main(["calibrate", str(HSR), str(out)]) == 2
    assert "reading" in capsys.readouterr().err, "a plan is no measurement"


@pytest.mark.long
@pytest.mark.usefixtures("set_ups_of_few")
def test_a_plan_for_targets_is_told_as_json(tmp_path, capsys):
    out = tmp_path / "plan.csv"
    small = ["--pool", "80", "--touches", "20"]
    assert main(["plan", str(HSR), "--out", str(out), *small]) == 0
    capsys.readouterr()
    assert main(["plan", str(HSR), "--out", str(tmp_path / "b.csv"), "--json", *small, "--targets", str(out)]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["touches"] == {"fit": 16, "check": 3, "again": 1}
    assert said["tip_rms_mm"]["expected"] < said["tip_rms_mm"]["at_random"]
    (warned,) = said["warnings"]
    assert "17 touches are fitted, but casacal calibrate needs at least 30" in warned, "one of 16 is touched twice"


@pytest.mark.long
@pytest.mark.usefixtures("set_ups_of_few")
def test_a_plan_is_simulated_as_it_would_be_measured(tmp_path, capsys):
    """The touches to fit in one file, those to verify with in another, each face with as many as place it."""
    files = {name: str(tmp_path / f"{name}.csv") for name in ("plan", "s", "s_check", "other", "flipped")}
    assert main(["plan", str(HSR), "--out", files["plan"], "--touches", "50", "--pool", "120", "--check", "0.2"]) == 0
    assert main(["simulate", str(HSR), "--plan", files["plan"], "--out", files["s"], "--json"]) == 0
    out = capsys.readouterr().out
    said, problem = json.loads(out[out.index("{") :]), load_problem(HSR).problem
    fitted, kept = (problem.read(files[name]) for name in ("s", "s_check"))
    assert said["samples"] == len(fitted)
    assert (said["left_out"], said["kept"]) == ([], 15), "four place each face, and one may be lost"
    assert len(fitted) == 35
    assert [Path(name).name for name in said["written"]] == ["s.csv", "s_check.csv", "s.truth.json"]
    assert len(kept) == 15
    assert set(kept.labels["plane"].names) == {"floor", "wall", "side"}
    assert min(len(rows) for rows in kept.labels["plane"].rows().values()) >= 4
    planned = read_route(files["plan"], problem.layout())
    for rows, purposes in ((fitted, (FIT, AGAIN)), (kept, (CHECK,))):
        wanted = planned.samples.take([k for k, purpose in enumerate(planned.purposes) if purpose in purposes])
        assert np.abs(wanted.joints - rows.joints).max() < 0.03
        assert list(wanted.labels["plane"]) == list(rows.labels["plane"])
        assert set(rows.extra["purpose"]) <= set(purposes)

    def flipped(line):
        cells = line.split(",")
        return ",".join([*cells[:3], str(-float(cells[3])), *cells[4:]]) if cells[0].isdecimal() else line

    text = Path(files["plan"]).read_text()
    Path(files["other"]).write_text("\n".join(map(flipped, text.splitlines())))
    words = ["simulate", str(HSR), "--plan", files["other"], "--out", files["flipped"], "--json"]
    assert main(words) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["left_out"]
    assert "cannot be made by the true arm" in said["warnings"][0]
    assert "as if made for another arm, tool or cell" in said["warnings"][1]
    Path(files["other"]).unlink()
    files["checks"] = str(tmp_path / "checks.csv")
    Path(files["checks"]).write_text(re.sub(",(fit|again),", ",check,", Path(files["plan"]).read_text()))
    for words, refused in (
        (["--plan", files["s"]], "which a plan does not have"),
        (["--plan", files["plan"], "--samples", "9"], "Give one of them"),
        (["--plan", files["plan"], "--repeats", "2"], "Give one of them"),
        (["--plan", files["plan"], "--tilt", "9"], "Give one of them"),
        (["--plan", files["checks"]], "are kept to verify"),
        (["--plan", str(tmp_path / "nowhere.csv")], "no such file"),
    ):
        assert main(["simulate", str(HSR), "--out", files["other"], *words]) == 2
        assert refused in capsys.readouterr().err
    assert main(["simulate", str(HSR), "--out", files["s"], "--samples", "40"]) == 0
    assert "s_check.csv is there from before" in capsys.readouterr().out
    three = str(ROOT / "problems" / "ur5_three_instruments")
    assert main(["simulate", three, "--plan", files["plan"], "--out", files["other"]]) == 2
    assert "A plan is of one instrument" in capsys.readouterr().err
    ur5 = str(ROOT / "problems" / "ur5")
    assert main(["simulate", ur5, "--plan", files["plan"], "--out", files["other"]]) == 2
    assert "was planned for 'hsr_jr680'" in capsys.readouterr().err
    (tmp_path / "other_check.csv").write_text("mine")
    assert main(["simulate", str(HSR), "--plan", files["plan"], "--out", files["other"]]) == 2
    assert "exists and was not written by casacal" in capsys.readouterr().err
    assert not (tmp_path / "other.csv").exists()


@pytest.mark.parametrize("name", ["adept_cobra600", "instruments/ball_bar", "instruments/plate"])
def test_what_is_kept_to_verify_can_be_verified(name):
    """Whatever is touched is placed by it: faces by tips that are not on a line, anchors by five lengths."""
    source = load_problem(ROOT / "problems" / name)
    pool = pool_of(source.problem, source.cell, 150, 0)
    for seed in range(4):
        kept = kept_to_verify(source.problem, pool, np.arange(20, 150), 11, np.random.default_rng(seed))
        assert kept.min() >= 20
        assert len(set(kept.tolist())) == 11
        bind(source.problem, pool.take(kept))


def test_the_command_line_refuses(tmp_path, capsys):
    out = tmp_path / "plan.csv"
    for wrong, said in (
        (["--touches", "20", "--tolerance", "1"], "Give one of them"),
        (["--touches", "2"], "whole number from 3 on"),
        (["--box", "1:2"], "is not X0:X1,Y0:Y1,Z0:Z1"),
        (["--targets", str(tmp_path / "none.csv")], "none.csv"),
        (["--tolerance", "-1"], "as the tolerance"),
    ):
        assert main(["plan", str(HSR), "--out", str(out), "--pool", "60", *wrong]) == 2
        assert said in capsys.readouterr().err
        assert not out.exists()
    samples = tmp_path / "problem"
    samples.mkdir()
    for name in ("problem.py", "samples.csv"):
        (samples / name).write_bytes((HSR / name).read_bytes())
    assert main(["plan", str(samples), "--out", str(samples / "samples.csv"), "--pool", "60", "--touches", "12"]) == 2
    assert "is what the command reads" in capsys.readouterr().err
    assert (samples / "samples.csv").read_bytes() == (HSR / "samples.csv").read_bytes()


def test_errors_of_no_rows_are_those_of_the_prior():
    known, weight = np.diag([4.0, 1.0]), np.diag([1.0, 9.0])
    assert Choice(np.zeros((0, 1, 2)), known, weight).error(np.zeros(0, dtype=int)) == pytest.approx(
        np.sqrt(0.25 + 9.0)
    )


@pytest.mark.long
@pytest.mark.usefixtures("set_ups_of_few")
def test_ranges_below_zero_need_no_equals_sign(tmp_path, capsys):
    out, common = tmp_path / "plan.csv", ["--pool", "120", "--touches", "12"]
    for option in (["--keep-out", "-100:100,-100:100,0:1"], ["--keep-out=-100:100,-100:100,0:1"]):
        assert main(["plan", str(HSR), "--out", str(out), *common, *option]) == 0
    assert main(["plan", str(HSR), "--out", str(out), *common, "--box", "-1:2"]) == 2
    assert "is not X0:X1,Y0:Y1,Z0:Z1" in capsys.readouterr().err


@pytest.mark.long
def test_without_a_number_the_plan_chooses_one_and_names_the_set_up_that_is_worth_most(hsr, tmp_path, capsys):
    """As many as tell more than averaged noise; HSR has no known length, so a gauge block is worth most."""
    count = touches_for(hsr.problem, hsr.cell)
    assert 1.5 * 33 <= count < 75, "half as many again as calibrate needs for 24 of the arm and 9 of the faces"

    def left(touches):
        return plan(hsr.problem, hsr.cell, touches=touches, pool=1000, starts=1, check=0.0, again=0.0).error

    assert left(round(1.5 * count)) > 0.78 * left(count), "noise alone would leave 0.82"
    out = tmp_path / "plan.csv"
    assert main(["plan", str(HSR), "--out", str(out), "--pool", "400", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["touches"]["fit"] == pytest.approx(count, abs=2)
    assert "gauge block" in found["setups"][0]["words"]
    assert main(["plan", str(HSR), "--out", str(out), "--pool", "400", "--touches", "50"]) == 0
    advice = capsys.readouterr().out.splitlines()[5]  # below what was kept clear of and where the faces stand
    assert advice.startswith("Consider another set-up first (as it is, and a gauge block of 100 mm on 'floor')")


def test_a_set_up_that_is_hardly_better_is_not_offered(hsr):
    as_it_is = SetUp("now", hsr.problem, hsr.cell, 1.0)
    better = SetUp("other", hsr.problem, hsr.cell, 0.8, "--tilt=45")
    assert worth_most([as_it_is, better]) is None
    best, now = worth_most([as_it_is, dataclasses.replace(better, error=0.5)])
    assert (best.words, now.words) == ("other", "now")


def test_touches_to_verify_take_turns_by_label_after_three_of_the_face_itself():
    assert _by_label(np.arange(8), Labels.of("abababab"), "a").tolist() == [0, 2, 4, 1, 6, 3, 5, 7]
    assert _by_label(np.array([1, 0, 3]), Labels.of("abab"), "a").tolist() == [0, 1, 3]
