"""Several instruments on one arm: one answer, by Python and by the command line, and what goes wrong by the way."""

import copy
import dataclasses
import json
import pickle
import re
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.stats import chi2
from three_instruments import CELL, COUNTS, INSTRUMENTS, problem

from casacal import (
    CasacalError,
    DialOnPlane,
    FixedPoint,
    Measurements,
    Problem,
    TrackedPoint,
    bind,
    calibrate,
    check,
    ipopt,
    lm,
    load,
    simulate,
    tool_point,
    verify,
)
from casacal.calibration.verdict import verdict_of
from casacal.cli.main import main
from casacal.deployment.arm import covariance_of, for_instrument
from casacal.deployment.as_data import problem_data, problem_from
from casacal.deployment.predict import predict
from casacal.deployment.remark import remark
from casacal.errors import ProblemError, SimulationError, UnknownNameError
from casacal.simulation import Disturbances
from casacal.uncertainty.figures import nees
from casacal.uncertainty.priors import prior_tip_rms, scaled_to_accuracy
from casacal.uncertainty.tip_error import bayesian_bound, tip_rms, without_rigid, workspace_joints

SOURCE = "from three_instruments import problem, CELL\n\ncell = CELL\n"


@pytest.fixture(scope="module")
def simulated():
    return simulate(problem, CELL, samples=COUNTS, seed=3)


@pytest.fixture(scope="module")
def found(simulated):
    return calibrate(problem, simulated.measured)


def changed(simulated, name, **changes):
    """The same with other samples of one instrument."""
    sets = dict(zip(problem.names, simulated.measured.sets, strict=True))
    sets[name] = dataclasses.replace(sets[name], **changes)
    return Measurements(problem.names, tuple(sets.values()))


@pytest.mark.long
def test_every_unknown_has_a_name_and_the_shared_tool_is_there_once(simulated):
    names = bind(problem, simulated.measured).names
    assert [name for name in names if "tool" in name] == [
        *("tool_x", "tool_y", "tool_z"),
        *("tracker.tool_x", "tracker.tool_y", "tracker.tool_z"),
    ]
    assert "dial.plane.floor.offset" in names
    assert "tracker.station.rx" in names
    assert "spike.point.2_x" in names
    assert len(set(names)) == len(names)
    apart = Problem(problem.robot, INSTRUMENTS)
    assert len(bind(apart, simulated.measured).names) == len(names) + 3, "not shared, each has a tool of its own"


def test_all_instruments_together_are_the_sum_of_each(simulated):
    """Cost, gradient and information, put together by hand from problems with one instrument each."""
    whole = bind(problem, simulated.measured)
    x = np.random.default_rng(0).normal(size=whole.unknowns) * np.minimum(whole.prior_std, 1e-3)
    cost, gradient, information = 0.0, np.zeros(x.size), np.zeros((x.size, x.size))
    for name, samples in zip(problem.names, simulated.measured.sets, strict=True):
        one = bind(problem.measured_by(name), samples)
        places = [
            whole.names.index(each if each in whole.names else f"{name}.{each}")
            if name != "tracker" or "tool" not in each
            else whole.names.index(f"tracker.{each}")
            for each in one.names
        ]
        part = one.normal(x[places])
        cost += part.cost
        np.add.at(gradient, places, part.gradient)
        information[np.ix_(places, places)] += part.information
    got = whole.normal(x)
    assert got.cost == pytest.approx(cost, rel=1e-12)
    np.testing.assert_allclose(got.gradient, gradient, rtol=1e-9, atol=1e-9 * np.abs(gradient).max())
    np.testing.assert_allclose(got.information, information, rtol=1e-9, atol=1e-9 * np.abs(information).max())
    e, slopes = whole.residual(x), whole.jacobian(x)
    np.testing.assert_allclose(slopes.T @ e, gradient, rtol=1e-9, atol=1e-9 * np.abs(gradient).max())


@pytest.mark.long
def test_the_minimum_is_that_of_ipopt(simulated, found):
    bound = bind(problem, simulated.measured)
    mine, theirs = lm(bound), ipopt(bound)
    assert mine.converged
    assert theirs.converged
    assert mine.cost == pytest.approx(theirs.cost, rel=1e-8)
    np.testing.assert_allclose(mine.x, theirs.x, atol=1e-6)
    assert abs(found.reference.relative_gap) < 1e-8, "with effects beside the geometry, too"


@pytest.mark.long
def test_the_truth_is_recovered_and_covariances_are_right():
    """Over 40 arms: normalised errors, and tip errors against their Bayesian bound."""
    total, freedom, ratios = 0.0, 0, []
    joints = workspace_joints(problem.robot)
    for seed in range(40):
        one = simulate(problem, dataclasses.replace(CELL, resolution=0.0), samples=COUNTS, seed=seed)
        bound = bind(problem, one.measured)
        truth, result = one.truth(bound), lm(bound)
        assert result.converged
        arm = np.flatnonzero(np.isfinite(bound.prior_std))
        total += nees((result.x - truth)[arm], result.covariance[np.ix_(arm, arm)])
        freedom += arm.size
        tips = bound.tips(truth, joints)
        best = bayesian_bound(
            bound.information(truth), bound.prior_information, bound.tip_jacobian(truth, joints), tips
        )
        ratios.append(tip_rms(without_rigid((bound.tips(result.x, joints) - tips).ravel(), tips)) / best)
    low, high = chi2.ppf([0.0005, 0.9995], freedom)
    assert low < total < high
    assert 0.85 < float(np.sqrt(np.mean(np.square(ratios)))) < 1.15


def test_instruments_measure_one_arm_with_noise_of_their_own(simulated):
    """The same seed is the same arm, and not the same noise, whichever instrument looks."""
    dial, tracker, spike = simulated.parts
    for key in problem.robot.parameters:
        np.testing.assert_array_equal(dial.local[key], tracker.local[key])
        np.testing.assert_array_equal(dial.local[key], simulated.local[key])
    np.testing.assert_array_equal(dial.local["tool"], spike.local["tool"])
    assert np.abs(dial.local["tool"] - tracker.local["tool"]).max() > 0.05
    alone = simulate(problem.measured_by("dial"), CELL, samples=COUNTS["dial"], seed=3)
    np.testing.assert_array_equal(alone.samples.joints, dial.samples.joints, err_msg="the first measures as alone")
    again = simulate(problem.measured_by("spike"), Disturbances(), samples=24, seed=3)
    assert np.abs(again.samples.joints - spike.samples.joints).max() > 0.1, "another session"
    joints = np.zeros((3, 6)) + 0.3
    np.testing.assert_array_equal(simulated.true_tips(joints), dial.true_tips(joints))
    far = simulated.of("tracker").true_tips(joints) - simulated.true_tips(joints)
    assert 20 < np.linalg.norm(far, axis=1).min() < 60, "the reflector is beside the tip"


@pytest.mark.long
def test_one_command_from_samples_to_a_verified_arm(tmp_path, capsys):
    place, out = tmp_path / "cell", tmp_path / "out"
    place.mkdir()
    (place / "problem.py").write_text(SOURCE, encoding="utf-8")
    counts = [word for name, count in COUNTS.items() for word in ("--samples", f"{name}={count}")]
    assert main(["simulate", str(place), "--out", str(place / "samples.csv"), *counts, "--seed", "5"]) == 0
    fresh = tmp_path / "fresh.csv"
    assert main(["simulate", str(place), "--out", str(fresh), "--samples", "40", "--seed", "5"]) == 0
    for name in COUNTS:  # the same arm, other postures: a session of their own would begin with the same ones
        rows = (tmp_path / f"fresh-{name}.csv").read_text(encoding="utf-8").splitlines(keepends=True)
        (tmp_path / f"fresh-{name}.csv").write_text("".join([*rows[:2], *rows[-14:]]), encoding="utf-8")
    assert main(["check", str(place)]) == 0
    capsys.readouterr()
    assert main(["calibrate", str(place), "--out", str(out)]) == 0
    assert "Calibrated" in capsys.readouterr().out
    document = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert document["verdict"]["level"] == "calibrated"
    assert set(document["data"]["instruments"]) == set(COUNTS)
    assert {name: part["samples"] for name, part in document["data"]["instruments"].items()} == COUNTS
    assert set(document["planes"]) == {"dial floor", "dial wall", "dial side"}
    assert problem_from(document["arm"]) == problem
    for name in COUNTS:
        metrics = document["metrics_by_instrument"][name]
        assert metrics["after"]["fit"]["rmse_mm"] < 0.1 < metrics["before"]["fit"]["rmse_mm"]
        assert main(["verify", str(out), str(tmp_path / f"fresh-{name}.csv")]) == 0, capsys.readouterr().out
        assert main(["verify", str(out), str(place / f"samples-{name}.csv")]) == 2, "these were fitted"
    page = (out / "report.html").read_text(encoding="utf-8")
    for name in COUNTS:
        assert f"By the {name}" in page
    ids = [part.split('"')[0] for part in page.split(' id="')[1:]]
    assert len(set(ids)) == len(ids), "every part of the page has a name of its own"
    poses = tmp_path / "poses.csv"
    tips = []
    for name in ("dial", "tracker"):
        words = ["--frame", "tip", "--std", "--instrument", name]
        assert main(["predict", str(out), str(tmp_path / "fresh-tracker.csv"), "--out", str(poses), *words]) == 0
        tips.append(np.loadtxt(poses, delimiter=",", skiprows=2)[:, :3])
    assert np.linalg.norm(tips[0] - tips[1], axis=1).min() > 20, "each instrument has a tip of its own"
    assert main(["export", str(out), "--to", "dh", "--out", str(tmp_path / "arm.csv")]) == 0
    capsys.readouterr()
    other = tmp_path / "other.csv"
    assert (
        main(["predict", str(out), str(place / "samples-dial.csv"), "--out", str(other), "--instrument", "lamp"]) == 2
    )
    assert not other.exists()
    assert "There is no instrument named 'lamp'" in capsys.readouterr().err


@pytest.mark.long
def test_samples_by_name_on_the_command_line(tmp_path, capsys):
    place = tmp_path / "cell"
    place.mkdir()
    (place / "problem.py").write_text(SOURCE, encoding="utf-8")
    assert main(["simulate", str(place), "--out", str(tmp_path / "x.csv"), "--samples", "30", "--seed", "1"]) == 0
    files = [word for name in COUNTS for word in ("--samples", f"{name}={tmp_path / f'x-{name}.csv'}")]
    assert main(["calibrate", str(place), *files, "--json", "--no-reference"]) == 0
    out = capsys.readouterr().out
    assert json.loads(out[out.index("{") :])["data"]["samples"] == 90
    for words, said in (
        ([], "There are no samples of the dial"),
        ([str(tmp_path / "x-dial.csv")], "Got one file for 3 instruments"),
        (files[:4], "There are no samples of the spike"),
        ([*files, "--samples", "lamp=x.csv"], "There is no instrument named 'lamp'"),
        ([*files, "--samples", "dial=x.csv"], "--samples gives 'dial' twice"),
        ([*files[:4], "--samples", "spike"], "--samples spike is not NAME=FILE"),
        ([*files[:5], f"spike={tmp_path / 'nowhere.csv'}"], "nowhere.csv"),
        ([*files[:2], "--samples", f"tracker={tmp_path / 'x-dial.csv'}", *files[4:]], "x-dial.csv"),
    ):
        assert main(["calibrate", str(place), *words]) == 2
        assert said in capsys.readouterr().err
    for text in ("many", "lamp=4", "dial=many", "0"):
        assert main(["simulate", str(place), "--out", str(tmp_path / "y.csv"), "--samples", text]) == 2
        assert not (tmp_path / "y-dial.csv").exists()


@pytest.mark.long
def test_a_result_reads_back_and_its_parts_say_the_same(found, tmp_path):
    found.save(tmp_path / "out")
    back = load(tmp_path / "out")
    q = np.array([[0.1, -0.4, 0.3, 0.2, 0.5, -0.6]])
    np.testing.assert_allclose(back.predict(q).positions, found.predict(q).positions, atol=1e-9)
    assert back.arm.source.problem == problem
    assert pickle.loads(pickle.dumps(problem)) == problem
    assert problem_from(json.loads(json.dumps(problem_data(problem)))) == problem
    assert copy.deepcopy(found) is found
    assert pickle.loads(pickle.dumps(found)) == found
    assert Problem(problem.robot, INSTRUMENTS) != problem, "what is shared is part of a problem"


def test_the_summary_speaks_of_each_instrument(found):
    text = found.summary()
    for name, count in COUNTS.items():
        assert f"{count} of the {name}" in text
        assert f"{name}: after, fitted rows" in text
        assert f"24 more samples of the {name}" in text
    assert "tracker                   " in text, "left out as a whole"
    assert "dial floor" in text
    assert "<casacal calibration" in repr(found)
    assert found.plot_residuals() is not None


@pytest.mark.long
def test_an_instrument_left_out_is_predicted_by_the_others(found):
    """The tracker's rows, judged by an arm that dial and spike alone give: fitted here without it from the start."""
    left = {each.face: each for each in found.left_out}["tracker"]
    alone = Problem(
        problem.robot,
        {name: INSTRUMENTS[name] for name in ("dial", "spike")},
        terms=found.fit.problem.terms,
        shared={"tool": ("dial", "spike")},
    )
    sets = dict(zip(problem.names, found.fit.samples, strict=True))
    others = calibrate(alone, {name: sets[name] for name in ("dial", "spike")}, noise="stated", outliers="keep")
    assert others.tip_std[1] > 5 * found.tip_std[1], "without the tracker the arm is known much worse"
    assert 0.3 < left.ratio < 2.0
    assert left.predicted_mm > 5 * 0.03


@pytest.mark.long
def test_what_is_wrong_with_one_instrument_is_said_of_it(simulated):
    """Metres, a mirrored frame, a wrong sign, a mislabelled place: named, with the instrument."""
    clean = check(problem, simulated.measured)
    assert all(finding.severity != "error" for finding in clean)
    assert {finding.instrument for finding in clean} <= {"dial", "tracker", "spike", ""}
    tracker, dial = simulated.measured.sets[1], simulated.measured.sets[0]
    metres = changed(simulated, "tracker", columns={k: v / 1000 for k, v in tracker.columns.items()})
    mirrored = changed(simulated, "tracker", columns={**tracker.columns, "y": -tracker.columns["y"]})
    pushed = changed(simulated, "dial", columns={"reading": 10 - dial.columns["reading"]})
    for samples, instrument, about in (
        (metres, "tracker", "unit of the readings"),
        (mirrored, "tracker", "left-handed frame"),
        (pushed, "dial", "wrong dial sign"),
    ):
        errors = [finding for finding in check(problem, samples) if finding.severity == "error"]
        assert [(each.instrument, each.about) for each in errors] == [(instrument, about)]
        assert str(errors[0]).startswith(f"error: {instrument}: ")
        assert verdict_of(calibrate(problem, samples, reference=False)).level == "do not use"


@pytest.mark.long
def test_instruments_that_contradict_one_another_are_named():
    """The spike is touched by a tip 4 mm longer than the dial's, and both are declared as one."""
    longer = tool_point(0, 0, 104, prior_std=0.5)
    true = Problem(problem.robot, {**INSTRUMENTS, "spike": FixedPoint(noise_std=0.03, tool=longer)})
    samples = simulate(true, CELL, samples=COUNTS, seed=3).measured
    errors = [finding for finding in check(problem, samples) if finding.severity == "error"]
    assert [each.about for each in errors] == ["instruments contradict each other"]
    assert "'tool' is declared as the same for dial and spike" in errors[0].cause
    assert verdict_of(calibrate(problem, samples, reference=False)).level != "calibrated"
    assert all(each.severity != "error" for each in check(true, samples))


@pytest.mark.parametrize("longer", [0.0, 0.5, -0.5])
def test_a_tool_that_is_declared_as_shared_and_is_not_is_named_with_its_length(longer):
    """Half a millimetre, which is one standard deviation of its prior: the noise found for each instrument hides it."""
    tip = tool_point(0, 0, 100 + longer, prior_std=0.5)
    true = Problem(problem.robot, {**INSTRUMENTS, "spike": dataclasses.replace(INSTRUMENTS["spike"], tool=tip)})
    samples = simulate(true, CELL, samples=COUNTS, seed=4).measured
    errors = [finding for finding in check(problem, samples) if finding.severity == "error"]
    verdict = verdict_of(calibrate(problem, samples, reference=False))
    assert [each.about for each in errors] == (["tool not the same"] if longer else [])
    assert (verdict.level == "do not use") == bool(longer)
    if longer:
        said = re.search(r"tool_z of spike is ([\d.]+) mm away", errors[0].cause)
        assert 0.3 < float(said[1]) < 0.8
        assert "tool not the same" in verdict.words
        assert sum("not the same" in reason for reason in verdict.reasons) == 1


@pytest.mark.long
def test_a_gross_row_is_set_aside_and_named_by_its_instrument(simulated, tmp_path):
    spike = simulated.measured.sets[2]
    joints = spike.joints.copy()
    joints[11, 2] += 0.01
    found = calibrate(problem, changed(simulated, "spike", joints=joints), reference=False)
    assert found.aside_lines == (f"spike {spike.lines[11]}",)
    assert [finding.instrument for finding in found.aside] == ["spike"]
    assert len(found.fit.samples[2]) == COUNTS["spike"] - 1
    assert f"spike {spike.lines[11]}" in found.report(tmp_path / "report.html").read_text(encoding="utf-8")


def test_rows_are_held_out_of_every_instrument(simulated):
    by_rows = calibrate(problem, simulated.measured, holdout=0.25, reference=False, discrepancy="none")
    assert [len(some) for some in by_rows.heldout.samples] == [22, 8, 6]
    assert by_rows.metrics_by_instrument["tracker"]["after"]["heldout"]["rmse_mm"] < 0.06
    by_face = calibrate(
        problem, simulated.measured, holdout=0.3, holdout_by="face", reference=False, discrepancy="none"
    )
    assert [len(some) for some in by_face.heldout.samples] == [30, 0, 8], "a tracker has no faces"
    assert by_face.metrics_by_instrument["tracker"]["after"]["heldout"] is None
    assert by_face.summary()
    with pytest.raises(UnknownNameError, match="session"):
        calibrate(problem, simulated.measured, holdout=0.3, holdout_by="session")


def test_noise_is_found_for_each_instrument():
    """The tracker stated at a fifth of what it is: its noise grows, and that of the others does not."""
    bold = dict(INSTRUMENTS, tracker=TrackedPoint(noise_std=0.006, tool=INSTRUMENTS["tracker"].tool))
    stated = Problem(problem.robot, bold, shared={"tool": ("dial", "spike")})
    samples = simulate(problem, CELL, samples=COUNTS, seed=4).measured
    found = calibrate(stated, samples, reference=False, discrepancy="none")
    assert 3.5 < found.fit.scale["tracker"] < 7
    assert found.fit.scale["dial"] < 1.4
    assert found.fit.scale["spike"] < 1.4


def test_what_cannot_be_is_said_in_a_sentence(simulated):
    dial, tracker = INSTRUMENTS["dial"], INSTRUMENTS["tracker"]
    robot = problem.robot
    for make, said in (
        (lambda: Problem(robot, {"the dial": dial}), "An instrument is called 'the dial'"),
        (lambda: Problem(robot, {"dial": 5}), "as an instrument"),
        (lambda: Problem(robot, {}), "has no instrument"),
        (lambda: Problem(robot, INSTRUMENTS, shared={"tool": ("dial", "tracker")}), "declared in different ways"),
        (lambda: Problem(robot, INSTRUMENTS, shared={"tool": ("dial", "lamp")}), "named 'lamp'"),
        (lambda: Problem(robot, INSTRUMENTS, shared={"tool": "dial"}), "shared by 'dial'"),
        (lambda: Problem(robot, INSTRUMENTS, shared={"lens": ("dial", "spike")}), "no unknown 'lens' to share"),
        (lambda: Problem(robot, INSTRUMENTS, shared=("tool",)), "as what instruments share"),
        (lambda: problem.measured_by("lamp"), "named 'lamp'"),
        (lambda: problem.instrument, "measured by 3 instruments"),
        (lambda: calibrate(problem, simulated.measured.sets[0]), "as samples of 3 instruments"),
        (
            lambda: calibrate(problem, {"dial": simulated.measured.sets[0]}),
            "No samples came of the instrument 'tracker'",
        ),
        (lambda: calibrate(problem, {"lamp": 3}), "no instrument is called that"),
        (lambda: calibrate(problem), "as samples of 3 instruments"),
        (lambda: check(problem, simulated.measured.sets[0]), "not those of the problem's instruments"),
        (lambda: simulate(problem, samples={"dial": 5}), "How many samples of the tracker"),
        (lambda: simulate(problem, samples={"lamp": 5}), "named 'lamp'"),
        (lambda: simulate(problem, dataclasses.replace(CELL, compliance=1.0)), "The cell has compliance"),
        (lambda: bind(problem, *simulated.measured.sets[:2]), "Got 2 sets of samples for 3 instruments"),
        (lambda: Problem(robot, dial, tracker).fix("tool_x"), "tool_x"),
    ):
        with pytest.raises((CasacalError, ProblemError, SimulationError)) as error:
            make()
        assert said in str(error.value)


def test_instruments_without_names_are_numbered(simulated):
    """As problem files had them before names."""
    plain = Problem(problem.robot, INSTRUMENTS["dial"], INSTRUMENTS["tracker"])
    bound = bind(plain, *simulated.measured.sets[:2])
    assert "instrument2.station.rx" in bound.names
    assert plain.names == ("instrument1", "instrument2")
    held = plain.fix("instrument1.tool").with_prior({"instrument2.tool": 0.2}).free("instrument1.tool_x")
    assert "instrument1.tool_y" not in held.free_names()
    assert "instrument1.tool_x" in held.free_names()
    everywhere = problem.fix("tool")
    assert all(everywhere.instruments[i].tool.size == 0 for i in (0, 2)), "what is shared is held for all"
    assert everywhere.instruments[1].tool.size == 3


def test_verify_asks_whose_rows_it_cannot_tell(found, simulated):
    rows = simulate(problem, CELL, samples=40, seed=3).measured.sets[1].take(range(30, 40))
    named = verify(found, rows, instrument="tracker")
    assert named == verify(found, rows), "columns tell a tracker"
    assert named.passed
    twice = Problem(problem.robot, {"left": INSTRUMENTS["tracker"], "right": INSTRUMENTS["tracker"]})
    both = simulate(twice, samples=20, seed=0)
    result = calibrate(twice, both.measured, reference=False, discrepancy="none")
    with pytest.raises(CasacalError, match="may be of left or right"):
        verify(result, rows)
    with pytest.raises(CasacalError, match="fit none of the instruments"):
        verify(result, simulated.measured.sets[0])
    with pytest.raises(UnknownNameError, match="middle"):
        verify(result, rows, instrument="middle")


@pytest.mark.long_unless("order1")
@pytest.mark.parametrize("order", [("dial", "tracker", "spike"), ("tracker", "spike", "dial")])
def test_each_instrument_has_its_own_tip_in_whatever_order(order, simulated):
    """Tracker and dial both have a "tool", and only the dial's is shared: none is taken for another."""
    sets = dict(zip(problem.names, simulated.measured.sets, strict=True))
    other = Problem(problem.robot, {name: INSTRUMENTS[name] for name in order}, shared=problem.shared)
    found = calibrate(other, {name: sets[name] for name in order}, reference=False, discrepancy="none")
    joints = sets["tracker"].joints[:5]
    for i, name in enumerate(order):
        arm = for_instrument(found.arm, name)
        tips = predict(arm, joints, frame="tip").positions
        np.testing.assert_allclose(tips, found.fit.tips(found.result.x, joints, i), atol=1e-6)
        _, columns = covariance_of(arm)
        known = {"dial": 24 + 3, "tracker": 24 + 3 + 6, "spike": 24 + 3}[name]
        assert len(columns) == known, "arm, tip and station; faces and places differ by label"


@pytest.mark.long
def test_numbers_of_each_instrument_are_set_by_its_name(tmp_path, capsys):
    wide = problem.with_settings({"dial.sign": -1, "tracker.noise_std": 0.2})
    assert (wide.instruments[0].sign, wide.instruments[1].noise_std, wide.instruments[2].noise_std) == (-1, 0.2, 0.03)
    assert wide.shared == problem.shared
    with pytest.raises(UnknownNameError, match="sign"):
        problem.with_settings({"sign": -1})
    (tmp_path / "problem.py").write_text(SOURCE, encoding="utf-8")
    assert main(["simulate", str(tmp_path), "--out", str(tmp_path / "samples.csv"), "--samples", "20"]) == 0
    assert main(["check", str(tmp_path), "--set", "dial.sign=-1"]) == 1
    assert "dial: wrong dial sign" in capsys.readouterr().out
    narrow = scaled_to_accuracy(problem, 0.5)
    assert prior_tip_rms(narrow) == pytest.approx(0.5)


@pytest.mark.long
def test_threads_share_a_problem_and_find_the_same(simulated):
    with ThreadPoolExecutor(4) as pool:
        jobs = [pool.submit(calibrate, problem, simulated.measured, reference=False) for _ in range(4)]
        xs = [job.result().x for job in jobs]
    for x in xs[1:]:
        np.testing.assert_array_equal(x, xs[0])


def test_the_arm_of_several_is_that_of_one_where_the_others_say_nothing():
    """A second dial whose noise is stated as a kilometre adds nothing."""
    two, deaf = (
        Problem(problem.robot, {"dial": INSTRUMENTS["dial"], "deaf": DialOnPlane(noise_std=std)}) for std in (0.01, 1e6)
    )
    samples = simulate(two, CELL, samples=60, seed=2).measured
    bound, alone = bind(deaf, samples), bind(deaf.measured_by("dial"), samples.sets[0])
    joints = workspace_joints(problem.robot)
    tips = [one.tips(lm(one).x, joints) for one in (bound, alone)]
    np.testing.assert_allclose(tips[0], tips[1], atol=1e-4)


@pytest.mark.long
def test_whose_noise_is_too_small_is_said(simulated):
    """The tracker stated ten times too good: it alone is named, with its own factor."""
    bold = dict(INSTRUMENTS, tracker=TrackedPoint(noise_std=0.003, tool=INSTRUMENTS["tracker"].tool))
    found = calibrate(Problem(problem.robot, bold, shared=problem.shared), simulated.measured, reference=False)
    reasons = " ".join(verdict_of(found).reasons)
    assert re.search(r"Times the stated noise: tracker (7|8|9|1\d)(\.\d)?, dial and spike as stated", reasons)


def test_files_are_named_all_or_none(tmp_path, capsys):
    """Half named, half taken from the folder would fit rows of two cells together."""
    (tmp_path / "problem.py").write_text(SOURCE, encoding="utf-8")
    assert main(["simulate", str(tmp_path), "--out", str(tmp_path / "samples.csv"), "--samples", "12"]) == 0
    counts = ["--samples", "dial=30", "--samples", "12"]
    assert main(["simulate", str(tmp_path), "--out", str(tmp_path / "other.csv"), *counts]) == 0
    assert "30 samples of the dial, 12 samples of the tracker" in capsys.readouterr().out
    assert main(["check", str(tmp_path), "--samples", f"dial={tmp_path / 'other-dial.csv'}"]) == 2
    assert "There are no samples of the tracker" in capsys.readouterr().err


@pytest.mark.long
def test_advice_can_be_typed(simulated, found):
    """What a finding says to try names the instrument; whose tip is expected stands in the verdict."""
    dial = simulated.measured.sets[0]
    pushed = changed(simulated, "dial", columns={"reading": 10 - dial.columns["reading"]})
    assert "--set dial.sign=-1 tries it" in check(problem, pushed)[0].fix
    assert "expect a tip error (dial) of" in verdict_of(found).words
    with pytest.raises(CasacalError, match=r"There is no file 'nowhere\.csv' of fresh rows"):
        verify(found, "nowhere.csv")
    assert "not known" in " ".join(remark(for_instrument(found.arm, "tracker"))), "the figure is of the dial's tip"


def test_what_is_shared_is_true_of_all_that_share_it():
    """One station for two reflectors, of which one is held, so that fewer numbers are drawn before the station's."""
    held = TrackedPoint(noise_std=0.03, tool=tool_point(5, 5, 60, free=False))
    pair = Problem(problem.robot, {"near": INSTRUMENTS["tracker"], "far": held}, shared={"station": ("near", "far")})
    one = simulate(pair, samples=30, seed=2)
    np.testing.assert_array_equal(one.parts[0].local["station"], one.parts[1].local["station"])
    result = lm(bind(pair, one.measured))
    assert result.converged
    assert 2 * result.cost < 180 + 4 * np.sqrt(2 * 180), "both see the arm from one place"


def test_residuals_know_their_samples(simulated):
    """Counted one by one, from blocks of one and of three residuals a sample."""
    bound = bind(problem, simulated.measured)
    wanted, first = [], 0
    for block in bound.blocks:
        for _ in range(len(block.noise)):
            wanted.append(list(range(first, first + block.noise.shape[1])))
            first += block.noise.shape[1]
    assert [bound.residuals_of([k]).tolist() for k in range(len(wanted))] == wanted
    assert bound.residuals_of([2, 91]).tolist() == [*wanted[2], *wanted[91]]
    assert [bound.sample_of[rows[0]] for rows in wanted] == list(range(len(wanted)))
    e = np.random.default_rng(0).normal(size=bound.rows)
    np.testing.assert_array_equal(bound.largest(e), [e[rows].max() for rows in wanted])
    assert bound.measured.place(95) == f"tracker {simulated.measured.sets[1].lines[5]}"


def test_covariances_are_those_of_an_instruments_own_unknowns(found):
    """With effects beside the geometry, whose covariance names its rows: arm, tip and, of the tracker, station."""
    whole = found.unjudged.covariance
    for name, own in (("dial", ""), ("tracker", "tracker."), ("spike", "")):
        covariance, columns = covariance_of(for_instrument(found.arm, name))
        names = list(found.seen.names)
        assert len(columns) == (33 if name == "tracker" else 27)
        tool = [names.index(f"{own}tool_{axis}") for axis in "xyz"]
        local = [each for key, u in problem.measured_by(name).symbols.unknowns.items() for each in u.names(key)]
        at = [j for i, j in columns if local[i].startswith("tool_")]
        np.testing.assert_allclose(covariance[np.ix_(at, at)], whole[np.ix_(tool, tool)], rtol=1e-9)
