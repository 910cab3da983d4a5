"""Which effects are corrected: they win by transfer, all that moves the arm uses them, nothing else claims to."""

import ctypes
import dataclasses
import json
import subprocess

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT
from scipy.spatial.transform import Rotation

from casacal import (
    CasacalError,
    Problem,
    TrackedPoint,
    bind,
    calibrate,
    lm,
    load,
    load_problem,
    simulate,
    tool_point,
    verify,
)
from casacal.calibration import motion
from casacal.calibration.motion import used_arm
from casacal.calibration.verdict import verdict_of
from casacal.cli.main import main
from casacal.data.holdout import FACES, REGIONS, splits
from casacal.deployment.export import export
from casacal.effects import Backlash, Drift, GravitySag, JointField, TransmissionError, kit
from casacal.effects.selection import at_most, gains, in_sample_gains, times_found, with_effects
from casacal.errors import ProblemError
from casacal.files import sealed
from casacal.simulation import Disturbances
from casacal.study.benchmark import left
from casacal.uncertainty.evidence import NormalEquations, evidence
from casacal.uncertainty.noise import found_noise
from casacal.uncertainty.tip_error import tip_rms, without_rigid, workspace_joints
from casacal.wording import mm

UR5 = ROOT / "problems" / "ur5"


@pytest.fixture(scope="module")
def sagging():
    """A small arm that sags by 0.3 mm, seen with a step that says its size."""
    source = load_problem(UR5)
    made = simulate(source.problem, dataclasses.replace(source.cell, compliance=0.3), samples=120, seed=1)
    return made, calibrate(source, made.samples, reference=False)


def tip_error(made, positions, joints):
    true = made.true_tips(joints)
    return tip_rms(without_rigid((positions - true).ravel(), true))


def dense(slopes, heights, stds):
    """Logarithm of the density of y = J x + e, e ~ N(0, I), x ~ N(0, diag(stds^2)), but for a constant.

    What unknowns of infinite deviation do is projected out.
    """
    flat = ~np.isfinite(stds)
    across = slopes[:, flat]
    beside = np.linalg.svd(across)[0][:, np.linalg.matrix_rank(across) :] if across.any() else np.eye(len(heights))
    inside = beside.T @ (slopes[:, ~flat] * stds[~flat])
    root = np.linalg.cholesky(np.eye(len(inside)) + inside @ inside.T)
    left = np.linalg.solve(root, beside.T @ heights)
    return -np.log(np.diagonal(root)).sum() - float(left @ left) / 2


def test_evidence_is_the_dense_density_but_for_a_constant():
    rng = np.random.default_rng(0)
    slopes, heights = rng.normal(size=(40, 6)), rng.normal(size=40)
    told = NormalEquations.of(slopes, heights)
    one, other = np.full(6, 0.7), np.array([0.7, 0.7, 0.1, 2.0, 0.7, 1e-4])
    ours = evidence(told, np.diag(one**-2.0)) - evidence(told, np.diag(other**-2.0))
    assert ours == pytest.approx(dense(slopes, heights, one) - dense(slopes, heights, other), abs=1e-8)


def test_gains_are_those_of_rows_left_out_one_part_after_another(sagging):
    """The density of each part given the others, from dense covariances."""
    found = sagging[1]
    fit, x = found.fit, found.result.x
    slopes = fit.jacobian(x)
    heights, stds = slopes @ x - fit.residual(x), fit.prior_std
    without = np.where(np.array(fit.beside) == "wave1", 1e-12, stds)
    ours = gains(fit, x, ["wave1"])["wave1"]
    parts = splits(fit.block.samples, fit.problem.instrument.groups)
    assert set(ours) == set(parts) == {FACES, REGIONS}
    for name, rows in parts.items():
        by_hand = 0.0
        for part in rows:
            rest = np.setdiff1d(np.arange(len(heights)), part)
            for sign, sizes in ((1, stds), (-1, without)):
                whole, others = dense(slopes, heights, sizes), dense(slopes[rest], heights[rest], sizes)
                by_hand += sign * (whole - others)
        assert ours[name] == pytest.approx(by_hand, abs=0.02)


def test_what_the_rows_say_of_an_effect_is_the_sum_of_all(sagging):
    found = sagging[1]
    fit, x = found.fit, found.result.x
    slopes = fit.jacobian(x)
    heights, stds = slopes @ x - fit.residual(x), fit.prior_std
    without = np.where(np.array(fit.beside) == "wave2", 1e-12, stds)
    by_hand = dense(slopes, heights, stds) - dense(slopes, heights, without)
    assert in_sample_gains(fit, x, ["wave2"])["wave2"] == pytest.approx(by_hand, abs=0.01)


def test_regions_hold_like_postures_and_every_row_once(sagging):
    samples = sagging[1].fit.block.samples
    for parts in splits(samples, "plane").values():
        assert sorted(np.concatenate(parts).tolist()) == list(range(len(samples)))
    regions = splits(samples, "plane")[REGIONS]
    assert len(regions) == 4
    assert max(map(len, regions)) - min(map(len, regions)) <= 1
    joints = samples.joints / samples.joints.std(axis=0)
    apart = np.mean([np.var(joints[rows], axis=0).sum() for rows in regions])
    assert apart < 0.8 * np.var(joints, axis=0).sum()


@pytest.mark.long
def test_a_sag_that_transfers_is_corrected_and_the_tip_follows(sagging):
    made, found = sagging
    joints = workspace_joints(found.fit.problem.robot)
    assert found.corrected == ("give",)
    told = found.tried[0]
    assert told.key == "give"
    assert min(told.unseen.values()) > 100
    error = tip_error(made, found.predict(joints, frame="tip").positions, joints)
    alone = dataclasses.replace(found, tried=())
    uncorrected = tip_error(made, alone.predict(joints, frame="tip").positions, joints)
    assert error < 0.35 * uncorrected
    assert 0.5 < error / found.tip_std[1] < 1.6
    assert 0.5 < uncorrected / alone.tip_std[1] < 1.6


@pytest.mark.parametrize(("faces", "regions", "wins"), [(99.0, 4.9, False), (4.9, 99.0, False), (5.1, 5.1, True)])
def test_every_split_must_speak_for_a_correction(sagging, monkeypatch, faces, regions, wins):
    found = sagging[1]
    told = {key: {FACES: faces, REGIONS: regions} for key in ("give", "wave1", "wave2")}
    monkeypatch.setattr(motion, "gains", lambda fit, x, keys: {key: told[key] for key in keys})
    tried = {each.key: each for each in motion.tried_corrections(found.fit, found.result)}
    assert tried["give"].corrected is wins
    assert not tried["wave1"].unseen  # the rows as a whole do not speak for it, so nobody asks
    assert not tried["wave1"].corrected


@pytest.mark.long
def test_more_touches_of_a_corrected_arm_do_not_make_it_worse(sagging):
    """Cures weigh a touch by the noise that is left beside the effects, not by what geometry alone leaves."""
    found = sagging[1]
    assert found.cures
    assert max(cure.expected_rms_mm for cure in found.cures) < 1.02 * found.tip_std[1]


def test_a_correction_that_does_not_help_the_tip_is_left_out(sagging, monkeypatch):
    found = sagging[1]
    monkeypatch.setattr(motion, "tip_error", lambda fit, result, keys, usual: 0.1 + len(keys))
    told = next(each for each in motion.tried_corrections(found.fit, found.result) if each.key == "give")
    assert not told.corrected
    assert told.helps is False
    assert "not corrected" in told.became
    assert "no gain at the tip" in told.became


@pytest.mark.long
def test_every_way_to_the_pose_knows_of_the_correction(sagging, tmp_path):
    found = sagging[1]
    joints = workspace_joints(found.fit.problem.robot)[:20]
    flange, tip = found.predict(joints), found.predict(joints, frame="tip", std=True)
    pose, point = found.pose_function(), found.tip_function()
    np.testing.assert_allclose([np.array(pose(q)) for q in joints], flange.poses, atol=1e-9)
    np.testing.assert_allclose([np.array(point(q)).ravel() for q in joints], tip.positions, atol=1e-9)
    (tmp_path / "arm.c").write_text(found.export("c", prefix="arm"), encoding="utf-8")
    command = ["gcc", "-std=c99", "-shared", "-fPIC", "-o", str(tmp_path / "arm.so"), str(tmp_path / "arm.c"), "-lm"]
    subprocess.run(command, check=True)
    compiled, out = ctypes.CDLL(str(tmp_path / "arm.so")), (ctypes.c_double * 16)()
    for q, meant in zip(joints, flange.poses, strict=True):
        compiled.arm_pose((ctypes.c_double * 6)(*q), out)
        np.testing.assert_allclose(np.reshape(out, (4, 4)), meant, atol=1e-9)
    found.export("casadi", tmp_path / "arm.casadi")
    loaded = ca.Function.load(str(tmp_path / "arm.casadi"))
    np.testing.assert_allclose([np.array(loaded(q)) for q in joints], flange.poses, atol=1e-9)
    found.save(tmp_path)
    back = load(tmp_path).predict(joints, frame="tip", std=True)
    np.testing.assert_allclose(back.positions, tip.positions, atol=1e-9)
    np.testing.assert_allclose(back.std, tip.std, rtol=1e-9)


@pytest.mark.long
def test_compensated_targets_are_reached_by_the_arm_that_sags(sagging):
    found = sagging[1]
    near = found.fit.block.samples.joints[:40]
    sent = found.compensate(near)
    reached = found.predict(sent.joints).positions
    np.testing.assert_allclose(reached, found.predict(near, nominal=True).positions, atol=6e-3)
    done = np.array([outcome.value == "reached" for outcome in sent.outcomes])
    assert done.all()


@pytest.mark.long
def test_tables_of_lengths_and_angles_hold_the_arm_for_those_who_cannot_correct(sagging, tmp_path):
    found = sagging[1]
    joints = workspace_joints(found.fit.problem.robot)
    alone = dataclasses.replace(found, tried=())
    free, values = found.tip_function(free=True), found.values(frame="tip")
    given = {name: values.get(name, 0.0) for name in free.name_in() if name != "q"}
    points = np.array([np.array(free(**given, q=q)["tip"]).ravel() for q in joints])
    np.testing.assert_allclose(points, alone.predict(joints, frame="tip").positions, atol=1e-9)
    rows = [line for line in found.export("dh").splitlines() if not line.startswith("#")]
    assert rows == [line for line in alone.export("dh").splitlines() if not line.startswith("#")]
    text, told = found.export("dh"), found.summary()
    assert "not in this form: gravity sag" in text
    assert f"expected tip error: {alone.tip_std[1]:.3f} mm" in text
    assert "corrected beside the geometry: gravity sag" in found.export("c")
    assert f"expected tip error: {found.tip_std[1]:.3f} mm" in found.export("c")
    assert f"{found.tip_std[1]:.3f} mm" not in text  # not even in the words of a verdict
    assert f"with those alone expect a tip error of {mm(alone.tip_std[1])} RMS" in told
    assert "gravity sag, corrected" in told
    found.save(tmp_path)
    read = load(tmp_path)
    assert [row for row in read.export("dh").splitlines() if row[0] != "#"] == rows
    assert "Corrections that were tried" in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.long
def test_fresh_rows_of_an_arm_that_sags_are_expected_where_they_are(sagging, tmp_path):
    found = sagging[1]
    source = load_problem(UR5)
    found.save(tmp_path)
    cell = dataclasses.replace(source.cell, compliance=0.3)
    fresh = simulate(source.problem, cell, samples=60, seed=1).samples  # the same arm, other touches
    assert verify(load(tmp_path), fresh).kept
    result = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    part = result["discrepancy"]
    for row in part["unknowns"]:
        row["value"] = -row["value"]
        part["estimate"][part["covariance_of"].index(row["name"])] *= -1
    (tmp_path / "result.json").write_text(json.dumps(sealed(result)), encoding="utf-8")
    assert not verify(load(tmp_path), fresh).kept


def test_nothing_is_corrected_where_nothing_errs():
    source = load_problem(UR5)
    found = calibrate(source, simulate(source.problem, source.cell, samples=120, seed=2).samples, reference=False)
    # backlash and growth need more than joints
    assert {each.key for each in found.tried} == {"coupling", "give", "wave1", "wave2"}
    assert found.corrected == ()
    assert not any(each.unseen for each in found.tried)
    assert "None of them is corrected" in found.summary()
    assert "not in this form" not in found.export("dh")
    document = found.to_dict()["discrepancy"]
    assert document["corrected"] == []
    assert "without_corrections" not in document


@pytest.mark.long
def test_a_wave_that_transfers_is_corrected_and_one_that_is_nowhere_is_not():
    source = load_problem(UR5)
    made = simulate(source.problem, dataclasses.replace(source.cell, gear_waves=((2, 1e-4),)), samples=120, seed=3)
    found = calibrate(source, made.samples, reference=False)
    assert found.corrected == ("wave2",)
    joints = workspace_joints(source.problem.robot)
    alone = dataclasses.replace(found, tried=())
    better, plain = (tip_error(made, each.predict(joints, frame="tip").positions, joints) for each in (found, alone))
    assert better < 0.8 * plain


@pytest.mark.long
def test_ones_own_kit_without_the_effect_corrects_nothing(sagging):
    made = sagging[0]
    source = load_problem(UR5)
    own = dataclasses.replace(source, problem=source.problem.with_terms(TransmissionError(order=1), Backlash()))
    without = calibrate(own, made.samples, reference=False)
    assert "give" not in {each.key for each in without.tried}
    mine = dataclasses.replace(source, problem=source.problem.with_terms(GravitySag(size=0.3)))
    assert calibrate(mine, made.samples, reference=False).corrected == ("give",)


def test_a_result_whose_correction_the_problem_does_not_have_is_refused_in_a_sentence(sagging, tmp_path):
    found = sagging[1]
    document = json.loads(json.dumps(found.to_dict(), default=float))
    arm = dataclasses.replace(found.arm, source=load_problem(UR5))
    lacking = dataclasses.replace(arm.source, problem=arm.source.problem.with_terms(Backlash()))
    with pytest.raises(CasacalError, match=r"corrects an effect .*'give'.* does not have"):
        export(dataclasses.replace(arm, source=lacking), "c")
    found.save(tmp_path)
    for spoil, words in (
        (lambda part: part.update(corrected=["nothing"]), "corrected"),
        (lambda part: part.update(corrected="give"), "corrected"),
        (lambda part: part.pop("without_corrections"), "without corrections"),
        (lambda part: part["without_corrections"][0].update(value="far"), "value"),
        (lambda part: part["unknowns"][0].pop("effect"), "effect"),
    ):
        spoilt = json.loads(json.dumps(document))
        spoil(spoilt["discrepancy"])
        (tmp_path / "result.json").write_text(json.dumps(sealed(spoilt)), encoding="utf-8")
        with pytest.raises(CasacalError, match=words):
            load(tmp_path)


def test_the_command_line_says_what_is_corrected(sagging, tmp_path, capsys):
    sagging[1].save(tmp_path)
    assert main(["export", str(tmp_path), "--to", "dh", "--out", str(tmp_path / "arm.csv")]) == 0
    assert "not in this form: gravity sag" in capsys.readouterr().out
    for form in ("c", "casadi"):
        assert main(["export", str(tmp_path), "--to", form, "--out", str(tmp_path / f"arm.{form}")]) == 0
        assert "corrected beside the geometry" in capsys.readouterr().out


def test_a_gross_row_that_hides_in_smooth_errors_is_set_aside(sagging):
    """0.15 mm are two of the standard deviations that geometry alone leaves, and fifteen of what a touch errs by."""
    made, found = sagging
    assert found.aside_lines == ()
    readings = np.array(made.samples.columns["reading"])
    readings[17] += 0.15
    spoilt = dataclasses.replace(made.samples, columns={"reading": readings})
    source = load_problem(UR5)
    again = calibrate(source, spoilt, reference=False)
    assert again.aside_lines == (made.samples.lines[17],)
    assert again.fit.block.noise.max() < 0.015
    assert calibrate(source, spoilt, reference=False, discrepancy="none").aside_lines == ()
    assert calibrate(source, spoilt, reference=False, outliers="keep").aside_lines == ()


@pytest.mark.long_unless("2.0-False")
@pytest.mark.parametrize(("stated", "shared"), [(0.05, True), (0.2, True), (0.5, False), (0.8, False), (2.0, False)])
def test_noise_is_less_than_stated_only_where_all_errors_of_a_row_are_not(stated, shared):
    """A user states what one touch errs by; where most of that is alike in like postures, rows share it."""
    source = load_problem(ROOT / "problems" / "hsr_jr680")
    samples = simulate(source.problem, source.cell, samples=400, seed=4).samples
    q = samples.joints.T
    alike = 0.4 * np.sin(1.3 * q[0] + 0.7 * q[1]) * np.cos(q[2] - 0.5 * q[3])
    samples = dataclasses.replace(samples, columns={"reading": samples.columns["reading"] + alike})
    problem = Problem(source.problem.robot, dataclasses.replace(source.problem.instrument, noise_std=stated))
    bare = bind(problem, samples)
    fit = with_effects(bare.with_noise(found_noise(bare, None).scale), problem)
    least = bare.block.noise * (1 - 1e-9)
    assert (fit.block.noise < 0.06).all() if shared else (fit.block.noise >= least).all()


@pytest.mark.long
def test_an_effect_at_the_most_that_it_may_be_is_doubted_and_a_gear_not_corrected():
    """Waves of 1 mrad are twenty-five times what is expected: a gear like that is broken, or it is something else."""
    source = load_problem(UR5)
    broken = dataclasses.replace(source.cell, gear_waves=((2, 1e-3),))
    found = calibrate(source, simulate(source.problem, broken, samples=120, seed=3).samples, reference=False)
    assert "wave2" in {effect.key for effect in at_most(found.fit)}
    assert "wave2" not in found.corrected
    verdict = verdict_of(found)
    assert verdict.level == "use with care"
    assert any("the largest that casacal accepts" in reason for reason in verdict.reasons)


@pytest.fixture(scope="module")
def waving():
    """The same waves, seen by a tracker in a part of the workspace, and elsewhere: rows fitted, rows not seen."""
    problem = Problem(load_problem(UR5).problem.robot, TrackedPoint(noise_std=0.05, tool=tool_point(10, -20, 120)))
    still = Disturbances(resolution=0.0, repeatability=0.0, gear_waves=((2, 1e-3),))
    rows = simulate(problem, still, samples=360, seed=1).samples
    order = np.argsort(rows.joints[:, 1] + rows.joints[:, 2])
    return problem, rows.take(np.sort(order[:120])), rows.take(np.sort(order[120:]))


def test_where_the_tip_itself_is_seen_what_tells_of_unseen_rows_is_corrected_whatever_it_is(waving):
    problem, fitted, unseen = waving
    found = calibrate(problem, fitted, reference=False)
    assert [effect.key for effect in at_most(found.fit)] == ["wave2"]
    assert found.corrected == ("wave2",)
    assert any("the largest that casacal accepts" in reason for reason in verdict_of(found).reasons)
    alone = calibrate(problem, fitted, reference=False, discrepancy="none")
    rest = [float(np.sqrt(np.mean(left(each.fit, each.used_x, unseen) ** 2))) for each in (found, alone)]
    assert rest[0] < 0.1 * rest[1]


def test_geometry_mimics_what_is_not_corrected_where_the_tip_was_seen_too(waving):
    """Over the workspace alone it left 1.06 times what least squares of the geometry leave in these rows."""
    problem, fitted, _ = waving
    found = calibrate(problem, fitted, reference=False)
    alone = calibrate(problem, fitted, reference=False, discrepancy="none")
    rest = [each.fit.plain_residual(each.uncorrected_x) for each in (found, alone)]
    assert np.square(rest[0]).mean() < 1.02**2 * np.square(rest[1]).mean()
    far = [left(each.fit, each.uncorrected_x, waving[2]) for each in (found, alone)]
    assert np.square(far[0]).mean() < np.square(far[1]).mean(), "the workspace counts as well"


def test_what_geometry_mimics_is_the_least_squares_of_workspace_and_rows_together(waving):
    """Both stacked by hand, stations free at the rows, rigid motions taken out over the workspace."""
    problem, fitted, _ = waving
    fit = calibrate(problem, fitted, reference=False).fit
    result = lm(fit)
    beside = np.array([bool(key) for key in fit.beside])
    moves = np.array([key in ("wave1", "wave2", "give") for key in fit.beside])
    joints = workspace_joints(problem.robot)
    tips = fit.tips(result.x, joints)
    field = without_rigid(fit.tip_jacobian(result.x, joints), tips) / np.sqrt(len(joints))
    rows = fit.jacobian(result.x) * np.median(fit.noise) / np.sqrt(len(fitted))
    geometry, station = ~beside & ~fit.datum, fit.datum
    columns = np.vstack(
        [
            np.hstack([field[:, geometry], np.zeros((len(field), station.sum()))]),
            np.hstack([rows[:, geometry], rows[:, station]]),
        ]
    )
    lost = np.concatenate([field[:, moves], rows[:, moves]]) @ result.x[moves]

    def left_over(change):
        free = np.linalg.lstsq(rows[:, station], lost[len(field) :] - rows[:, geometry] @ change, rcond=None)[0]
        return np.linalg.norm(columns @ np.concatenate([change, free]) - lost)

    best = np.linalg.norm(columns @ np.linalg.lstsq(columns, lost, rcond=1e-9)[0] - lost)
    found = left_over((used_arm(fit, result, ()) - result.x)[geometry])
    assert best <= found < 1.01 * best


@pytest.mark.long
def test_a_soft_arm_is_doubted_but_corrected():
    source = load_problem(UR5)
    soft = dataclasses.replace(source.cell, compliance=6.0)
    found = calibrate(source, simulate(source.problem, soft, samples=120, seed=1).samples, reference=False)
    assert [effect.key for effect in at_most(found.fit)] == ["give"]
    assert "give" in found.corrected
    assert any("gravity sag reached 5 times" in text.lower() for text in verdict_of(found).reasons)
    sag = np.array([found.fit.beside[j] == "give" for j in found.motion.arm.free])
    estimate = found.result.x[found.motion.arm.free]
    np.testing.assert_array_equal(found.motion.off[sag], estimate[sag])  # the whole correction may be an error


@pytest.mark.long
def test_a_dial_whose_gain_nobody_declared_is_doubted_where_its_prior_does_not_cover_it():
    source = load_problem(ROOT / "problems" / "hsr_jr680")
    made = simulate(source.problem, source.cell, samples=120, seed=1).samples
    verdicts = []
    for times in (1.0, 1.002, 1.006, 1.02):  # the standard deviation of a dial's gain is 0.15 %
        shown = dataclasses.replace(made, columns={"reading": made.columns["reading"] * times})
        verdicts.append(verdict_of(calibrate(source, shown, reference=False)))
    assert [verdict.level for verdict in verdicts] == ["calibrated"] * 2 + ["use with care", "do not use"]
    assert any("gain of the dial" in reason and "declare" in reason for reason in verdicts[2].reasons)
    assert "scale of the" in verdicts[3].words


@pytest.mark.long
def test_gravity_may_pull_another_way(sagging):
    """An arm at a wall: what sags sideways is found where the kit is told so, and not where it is not."""
    made = sagging[0]
    source = load_problem(UR5)
    own = dataclasses.replace(source, problem=source.problem.with_terms(*kit(down=(0.0, 1.0, 0.0))))
    right, wrong = (calibrate(each, made.samples, reference=False).tried for each in (source, own))
    gains = [next(each.evidence for each in tried if each.key == "give") for tried in (right, wrong)]
    assert gains[0] > 5 * max(gains[1], 1.0)


def test_the_flange_does_not_depend_on_a_reading(sagging):
    found = sagging[1]
    joints = workspace_joints(found.fit.problem.robot)[:5]
    shown = dataclasses.replace(found.fit.block.samples.take(np.arange(5)), joints=joints)
    assert np.abs(shown.columns["reading"]).max() > 0.1
    np.testing.assert_allclose(found.predict(shown).positions, found.predict(joints).positions, atol=1e-12)


@pytest.mark.long
def test_the_first_row_is_not_blamed_for_backlash():
    source = load_problem(ROOT / "problems" / "hsr_jr680")
    cell = dataclasses.replace(source.cell, backlash=200e-6)
    for seed in range(3):
        samples = simulate(source.problem, cell, samples=120, seed=seed).samples
        assert calibrate(source, samples, method="lm", reference=False).aside_lines == ()


def test_simulated_files_say_when_more_than_geometry_moves_the_tip(tmp_path, capsys):
    for options, told in (([], False), (["--compliance", "0.3"], True), (["--gear-wave", "1=1e-4"], True)):
        command = ["simulate", str(UR5), "--samples", "20", "--out", str(tmp_path / "x.csv"), *options]
        assert main(command) == 0
        assert ("geometry alone" in capsys.readouterr().out) is told


@pytest.mark.long
def test_in_which_frame_a_tracker_reads_changes_nothing(waving):
    """Errors alike in like postures and drift are of every direction; along (1, 1, 1) alone they knew the frame."""
    problem, fitted, _ = waving
    rows = fitted
    smooth = 0.4 * np.cos(rows.joints[:, 1:4] * 0.6 + rows.joints[:, [0]] * 0.8)
    points = np.column_stack([rows.columns[name] for name in "xyz"]) + smooth
    turn = Rotation.from_rotvec([0.5, -0.9, 0.4]).as_matrix()
    found = []
    for seen in (points, points @ turn.T):
        same = dataclasses.replace(rows, columns=dict(zip("xyz", seen.T, strict=True)))
        found.append(calibrate(problem.with_terms(JointField(), Drift()), same, reference=False))
    sizes = [
        {key: times for key, times in times_found(each.fit).items() if key in ("field", "drift")} for each in found
    ]
    assert sizes[0]["field"] > 2, "the rows err together"
    for key, times in sizes[0].items():
        assert sizes[1][key] == pytest.approx(times, rel=0.02)
    assert found[1].tip_std[1] == pytest.approx(found[0].tip_std[1], rel=0.01)
    robot = [j for j, name in enumerate(found[0].fit.names) if not found[0].fit.datum[j] and not found[0].fit.beside[j]]
    apart = (found[1].result.x - found[0].result.x)[robot] / found[0].result.std[robot]
    assert np.abs(apart).max() < 0.02


def test_an_effect_of_as_many_components_as_none_is_refused():
    """One for all components, or one for each."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Two(Drift):
        def residual(self, here):
            return super().residual(here)[:2]

    problem = Problem(load_problem(UR5).problem.robot, TrackedPoint(noise_std=0.05), terms=(Two(),))
    with pytest.raises(ProblemError, match="'drift' has 2 components"):
        _ = problem.model


def test_geometry_does_not_stretch_the_last_link_for_a_micrometre_at_the_tip(sagging):
    _, found = sagging
    fit = found.fit
    used = used_arm(fit, found.result, ())
    known = np.isfinite(fit.prior_std) & (np.array(fit.beside) == "")
    assert np.abs(((used - found.result.x) / fit.prior_std)[known]).max() < 1


@pytest.mark.long
def test_geometry_stands_for_the_mean_of_both_ways_of_a_joint_with_play():
    source = load_problem(UR5)
    made = simulate(source.problem, dataclasses.replace(source.cell, backlash=1.5e-4), samples=120, seed=0)
    found, joints = calibrate(source, made.samples, reference=False), workspace_joints(source.problem.robot)
    assert times_found(found.fit)["play"] > 2
    assert tip_error(made, found.predict(joints, frame="tip").positions, joints) < 1.1 * found.tip_std[1]
