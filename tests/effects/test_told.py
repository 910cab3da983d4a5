"""Effects that columns of a file tell: corrected where rows have these, counted where they lack them; oracle: NumPy."""

import copy
import ctypes
import dataclasses
import json
import subprocess

import casadi as ca
import numpy as np
import pandas as pd
import pytest
from conftest import ROOT
from instruments_on_ur5 import ROBOT, TABLE, TOOL
from instruments_on_ur5 import flanges as drawn
from instruments_on_ur5 import tips as as_drawn

from casacal import (
    CasacalError,
    Problem,
    TrackedPoint,
    bind,
    calibrate,
    changed,
    huber,
    load,
    load_problem,
    plan,
    simulate,
    tool_point,
    verify,
)
from casacal.calibration.verdict import warnings
from casacal.cli.main import main
from casacal.deployment.predict import predict
from casacal.deployment.result_file import check_document
from casacal.effects import Backlash, GravitySag, LinkSag, TorqueCompliance, with_kit
from casacal.errors import ProblemError, SamplesError
from casacal.model.links import Links
from casacal.shopfloor import Session
from casacal.simulation import Disturbances
from casacal.uncertainty.tip_error import tip_rms, without_rigid, workspace_joints

GIVE = np.array([60.0, 120.0, 90.0, 200.0, 250.0, 300.0]) * 1e-6
PLAY = np.array([50.0, 80.0, 60.0, 100.0, 150.0, 90.0]) * 1e-6
USUAL = np.array([2.0, 40.0, 20.0, 4.0, 3.0, 1.0])
TORQUES = tuple(f"torque{j}_Nm" for j in range(1, 7))
CAME = tuple(f"came{j}" for j in range(1, 7))
NOISE = 0.02
POINT = TrackedPoint(noise_std=NOISE, tool=tool_point(*TOOL, prior_std=1.0))
WORDS = "joint compliance under measured torque"


_errors = np.random.default_rng(11).normal(size=(4, 6)) * np.array([[3e-4], [0.3], [0.3], [3e-4]])
_errors[2:, 0] = 0.0  # they would move the base, which no row shows
WRONG = [values + error for values, error in zip(TABLE, _errors, strict=False)]


def flanges(joints):
    """Flange poses (N, 4, 4; mm) of an arm that is not quite as drawn, at joint values (N, 6; rad), by hand."""
    found = np.tile(np.eye(4), (len(joints), 1, 1))
    for turn, alpha, a, d, zero in zip(joints.T, *WRONG, _errors[3], strict=True):
        c, s = np.cos(turn + zero), np.sin(turn + zero)
        ca_, sa_, o = np.full_like(c, np.cos(alpha)), np.full_like(c, np.sin(alpha)), np.zeros_like(c)
        link = [[c, -s * ca_, s * sa_, a * c], [s, c * ca_, -c * sa_, a * s], [o, sa_, ca_, o + d], [o, o, o, o + 1]]
        found = found @ np.array(link).transpose(2, 0, 1)
    return found


def tips(joints):
    return flanges(joints)[:, :3] @ np.array([*TOOL, 1.0])


def measured(off, columns, count=80, seed=1, tips=tips):
    """Rows of an arm, tips by NumPy, whose joints stand `off`(joints) beside what the controller says."""
    still = Disturbances(resolution=0.0, repeatability=0.0, error_scale=0.0)
    samples = simulate(Problem(ROBOT, POINT), still, samples=count, seed=seed).samples
    rng = np.random.default_rng(seed)
    stands = tips(samples.joints + off(samples.joints)) + rng.normal(size=(count, 3)) * NOISE
    text = {name: tuple(f"{value:.9f}" for value in values) for name, values in columns.items()}
    return dataclasses.replace(samples, columns=dict(zip("xyz", stands.T, strict=True)), extra=text)


def by_name(names, values):
    return dict(zip(names, values.T, strict=True))


def table(joints, **columns):
    degrees = by_name([f"q{j}_deg" for j in range(1, 7)], np.degrees(joints))
    return pd.DataFrame({**degrees, **columns})


def postures(rng, count):
    """Joint values far from singular ones."""
    return rng.uniform(-0.6, 0.6, size=(count, 6)) + np.array([0.3, -1.0, 1.4, -1.0, -1.5, 0.1])


def rms(errors):
    return float(np.sqrt((np.asarray(errors) ** 2).sum(axis=-1).mean()))


@pytest.fixture(scope="module")
def loaded():
    rng = np.random.default_rng(6)
    torques = rng.normal(size=(80, 6)) * USUAL
    rows = measured(lambda _: GIVE * torques, by_name(TORQUES, torques))
    return calibrate(Problem(ROBOT, POINT, terms=(TorqueCompliance(columns_of=TORQUES),)), rows, reference=False)


@pytest.fixture(scope="module")
def asked():
    """New postures and torques, a table of them whose columns stand in another order, where the tip then is."""
    rng = np.random.default_rng(9)
    joints, torques = postures(rng, 24), rng.normal(size=(24, 6)) * USUAL
    shuffled = table(joints, **by_name(TORQUES, torques))[[*TORQUES[::-1], *(f"q{j}_deg" for j in range(1, 7))]]
    return joints, torques, shuffled, tips(joints + GIVE * torques)


def test_torques_are_corrected_where_rows_have_them(loaded, asked):
    joints, _, rows, true = asked
    known, unknown = (loaded.predict(q, frame="tip", std=True) for q in (rows, joints))
    assert rms(known.positions - true) < 0.02
    assert 0.3 < rms(known.positions - true) / np.sqrt((known.std**2).mean()) < 2.0
    assert not known.missing
    assert unknown.missing == {WORDS: TORQUES}
    assert rms(unknown.positions - true) > 1.0
    assert 0.5 < rms(unknown.positions - true) / np.sqrt((unknown.std**2).mean()) < 1.5, "it counts as an error"
    assert loaded.corrected == loaded.told == ("yield",)
    assert loaded.tip_std[1] < 0.02
    assert loaded.to_dict()["discrepancy"]["expected_rms_mm_without_columns"] > 1.0


def test_without_columns_an_arm_stands_as_in_the_fitted_rows_on_average(loaded, asked):
    joints, fitted = asked[0], torques_of(loaded.samples)
    mean = table(joints, **by_name(TORQUES, np.tile(fitted.mean(axis=0), (24, 1))))
    np.testing.assert_allclose(loaded.predict(joints).positions, loaded.predict(mean).positions, atol=1e-9)
    squares = sum(
        ((tips(joints + GIVE * np.eye(6)[j] * fitted[:, j].std()) - tips(joints)) ** 2).sum(axis=1) for j in range(6)
    )
    found = loaded.predict(joints, frame="tip", std=True).std
    np.testing.assert_allclose(found, np.sqrt(squares), rtol=0.05)


def test_how_well_a_place_is_known_follows_its_torques(loaded, asked):
    joints = asked[0]
    none, many = (
        loaded.predict(table(joints, **by_name(TORQUES, np.tile(times * USUAL, (24, 1)))), frame="tip", std=True).std
        for times in (0.0, 20.0)
    )
    assert (many > 2 * none).all()


def test_a_row_without_one_of_the_torques_is_told_which(loaded, asked, tmp_path):
    _, _, rows, _ = asked
    found = loaded.predict(rows.drop(columns=TORQUES[3]))
    assert found.missing == {WORDS: (TORQUES[3],)}
    np.savez(tmp_path / "rows.npz", **{name: rows[name].to_numpy() for name in rows})
    np.testing.assert_array_equal(loaded.predict(tmp_path / "rows.npz").positions, loaded.predict(rows).positions)
    with pytest.raises(SamplesError, match="DataFrame, line 1, column 'torque3_Nm': 'much' is not a finite number"):
        loaded.predict(rows.assign(torque3_Nm="much"))


def test_a_saved_result_and_the_command_line_correct_them(loaded, asked, tmp_path, capsys):
    joints, _, rows, true = asked
    loaded.save(tmp_path / "made")
    np.testing.assert_allclose(load(tmp_path / "made").predict(rows, frame="tip").positions, true, atol=0.06)
    rows.to_csv(tmp_path / "rows.csv", index=False)
    table(joints).to_csv(tmp_path / "bare.csv", index=False)
    result, out = str(tmp_path / "made"), str(tmp_path / "out.csv")
    assert main(["predict", result, str(tmp_path / "rows.csv"), "--out", out, "--frame", "tip"]) == 0
    np.testing.assert_allclose(pd.read_csv(out, comment="#")[["x_mm", "y_mm", "z_mm"]], true, atol=0.06)
    said = capsys.readouterr().out
    assert "on average" not in said
    assert "Corrected by columns of the rows: joint compliance under measured torque." in said
    assert main(["predict", result, str(tmp_path / "bare.csv"), "--out", out, "--std"]) == 0
    said = capsys.readouterr().out
    assert "Without torque1_Nm, " in said
    assert "torque6_Nm, joint compliance under measured torque is corrected as in the fitted rows on average" in said
    assert main(["compensate", result, str(tmp_path / "bare.csv"), "--out", out, "--json"]) in (0, 1)
    assert any("Without torque1_Nm" in note for note in json.loads(capsys.readouterr().out)["notes"])
    assert main(["compensate", result, str(tmp_path / "rows.csv"), "--out", out]) == 0
    assert "on average" not in (tmp_path / "out.csv").read_text()


def test_compensated_targets_are_reached_under_their_torques(loaded, asked):
    joints, torques, rows, _ = asked
    meant = drawn(joints)
    sent = loaded.compensate(rows)
    assert sent.reached.all()
    missed = (flanges(sent.joints + GIVE * torques) - meant)[:, :3, 3]
    assert rms(missed) < 0.1 < 1.0 < rms((flanges(joints + GIVE * torques) - meant)[:, :3, 3])
    poses = loaded.predict(joints, nominal=True)
    where = by_name(("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz"), np.hstack([poses.positions, poses.quaternions]))
    as_poses = loaded.compensate(rows.assign(**where))
    np.testing.assert_allclose(as_poses.joints, sent.joints, atol=1e-6)


def test_exports_take_torques_as_a_further_input(loaded, asked, tmp_path):
    joints, torques, rows, true = asked
    meant = loaded.predict(rows).poses
    pose, tip = loaded.pose_function(), loaded.tip_function()
    np.testing.assert_allclose(
        [np.array(tip(q, t)).ravel() for q, t in zip(joints, torques, strict=True)], true, atol=0.06
    )
    loaded.export("casadi", tmp_path / "arm.casadi")
    (tmp_path / "arm.c").write_text(loaded.export("c", prefix="arm"), encoding="utf-8")
    assert "told: torque1_Nm, torque2_Nm" in (tmp_path / "arm.c").read_text()
    command = ["gcc", "-std=c99", "-shared", "-fPIC", "-o", str(tmp_path / "arm.so"), str(tmp_path / "arm.c"), "-lm"]
    subprocess.run(command, check=True)
    compiled, six = ctypes.CDLL(str(tmp_path / "arm.so")), ctypes.c_double * 6
    read, out, step, slopes = ca.Function.load(str(tmp_path / "arm.casadi")), (ctypes.c_double * 16)(), six(), six()
    jacobian = (ctypes.c_double * 36)()
    compiled.arm_step.argtypes = [six, six, ctypes.c_double * 16, ctypes.c_double, six, six]
    for q, t, there in zip(joints, torques, meant, strict=True):
        compiled.arm_pose(six(*q), six(*t), out)
        for found in (np.reshape(out, (4, 4)), np.array(pose(q, t)), np.array(read(q, t))):
            np.testing.assert_allclose(found, there, atol=1e-9)
        compiled.arm_step(six(*q), six(*t), out, 1.0, step, slopes)
        np.testing.assert_allclose(step, q, atol=1e-9)
    compiled.arm_jacobian(six(*joints[0]), six(*torques[0]), jacobian)
    ahead = np.array(pose(joints[0] + np.eye(6)[1] * 1e-5, torques[0]))
    np.testing.assert_allclose(np.reshape(jacobian, (6, 6))[:3, 1], (ahead - meant[0])[:3, 3] / 1e-5, atol=0.05)
    text = loaded.export("dh")
    assert f"not in this form: {WORDS}, which predict, compensate and the forms c and casadi correct" in text
    assert "expected tip error: 3." in text
    assert [*loaded.pose_function(nominal=True).name_in()] == ["q"]


def test_the_summary_says_what_torques_are_worth(loaded):
    said = " ".join(loaded.summary().split())
    assert "calibrated: expect a tip error of 0.01" in said.lower()
    without = (
        "torque6_Nm, in predict, compensate, verify and the exports c and casadi; without, expect a tip error of 2."
    )
    assert without in said


@pytest.mark.long
def test_each_effect_is_corrected_by_its_own_columns(asked):
    joints, torques, rows, _ = asked
    rng = np.random.default_rng(3)
    given, ways = rng.normal(size=(150, 6)) * USUAL, rng.choice([-1, 1], size=(150, 6))
    both = measured(lambda _: GIVE * given - PLAY * ways, {**by_name(TORQUES, given), **by_name(CAME, ways)}, count=150)
    effects = (TorqueCompliance(columns_of=TORQUES), Backlash(columns_of=CAME))
    found = calibrate(Problem(ROBOT, POINT, terms=effects), both, reference=False)
    now = rng.choice([-1, 1], size=(24, 6))
    true = tips(joints + GIVE * torques - PLAY * now)
    everything, torque, way = (
        rms(found.predict(q, frame="tip").positions - true)
        for q in (rows.assign(**by_name(CAME, now)), rows, table(joints, **by_name(CAME, now)))
    )
    assert everything < 0.03
    assert rms(tips(joints + GIVE * torques) - true) == pytest.approx(torque, rel=0.3)
    assert rms(tips(joints - PLAY * now) - true) == pytest.approx(way, rel=0.3)
    assert set(found.predict(rows).missing) == {"backlash"}
    assert set(found.to_dict()["discrepancy"]["range"]) == set(TORQUES), "a way of approach is no amount"
    with pytest.raises(SamplesError, match=r"line 1, column 'came1': [24] is no way of approach"):
        found.predict(rows.assign(**by_name(CAME, now + 3)))


def test_a_result_that_lost_the_arm_with_torques_is_refused(loaded):
    document = loaded.to_dict()
    check_document("this", document)
    for change in (
        lambda part: part.update(told=[]),
        lambda part: part.pop("mean"),
        lambda part: part["spread"].pop(next(iter(part["spread"]))),
        lambda part: part["mean"].update(dict.fromkeys(part["mean"], "much")),
        lambda part: part.update(corrected=[]),
        lambda part: part["further"].update(another=["x"]),
        lambda part: part.update(usual={"torque_1": "much"}),
        lambda part: part["range"]["torque1_Nm"].pop("highest"),
    ):
        wrong = copy.deepcopy(document)
        change(wrong["discrepancy"])
        with pytest.raises(CasacalError, match="this: "):
            check_document("this", wrong)


def torques_of(samples):
    return np.array([[float(text) for text in samples.extra[name]] for name in TORQUES]).T


def test_amounts_far_from_those_that_were_fitted_are_said_or_refused(loaded, asked, tmp_path, capsys):
    _, torques, rows, _ = asked
    fitted = torques_of(loaded.samples)
    kept = loaded.to_dict()["discrepancy"]["range"]
    assert {name: (each["lowest"], each["highest"]) for name, each in kept.items()} == {
        name: (low, high) for name, low, high in zip(TORQUES, fitted.min(axis=0), fitted.max(axis=0), strict=True)
    }
    assert loaded.predict(rows).beyond == ()
    span, high = np.ptp(fitted, axis=0).max(), fitted[:, 1].max()
    said = f"line 3, far from the {fitted[:, 1].min():g} to {high:g} of the fitted rows"
    for spans, beyond in ((0.49, False), (0.51, True), (9.99, True)):
        far = rows.assign(torque2_Nm=np.where(np.arange(24) == 2, high + spans * span, torques[:, 1]))
        for found in (loaded.predict(far), loaded.compensate(far)):
            assert [said in words and "torque2_Nm is " in words for words in found.beyond] == [True] * beyond
    loaded.save(tmp_path / "made")
    far.to_csv(tmp_path / "far.csv", index=False)
    for command in ("predict", "compensate"):
        given = [command, str(tmp_path / "made"), str(tmp_path / "far.csv"), "--out", str(tmp_path / "out.csv")]
        assert main(given) in (0, 1)
        assert "arning: torque2_Nm is " in capsys.readouterr().out
    absurd = rows.assign(torque2_Nm=np.where(np.arange(24) == 2, high + 10.01 * span, torques[:, 1]))
    for use in (loaded.predict, loaded.compensate, load(tmp_path / "made").predict):
        with pytest.raises(SamplesError, match=r"line 3, column 'torque2_Nm': \S+ is out of all proportion to the -"):
            use(absurd)
    assert loaded.predict(absurd, nominal=True).beyond == ()


def test_amounts_next_to_nothing_are_asked_about(loaded, asked):
    """Kilonewton metres under the name of newton metres; all of them zero is another thing."""
    joints, torques = asked[:2]
    for times, said in ((1e-3, True), (0.0, False), (0.5, False)):
        found = loaded.predict(table(joints, **by_name(TORQUES, times * torques)))
        assert any("next to nothing" in words for words in found.beyond) == said


@pytest.mark.long
def test_a_column_that_never_varies_makes_a_result_that_is_read(tmp_path, asked, capsys):
    """Torque about an upright axis: zero in every row, and so its mean without any spread."""
    torques = np.random.default_rng(6).normal(size=(80, 6)) * USUAL
    torques[:, 0] = 0.0
    rows = measured(lambda _: GIVE * torques, by_name(TORQUES, torques))
    problem = Problem(ROBOT, POINT, terms=(TorqueCompliance(columns_of=TORQUES),))
    calibrate(problem, rows, reference=False).save(tmp_path / "made")
    read = load(tmp_path / "made")
    assert min(read.arm.found.effects.spread.values()) == 0.0
    asked[2].to_csv(tmp_path / "rows.csv", index=False)
    table(asked[0]).to_csv(tmp_path / "bare.csv", index=False)
    for name, said in (("rows", "Corrected by columns"), ("bare", "Without torque1_Nm")):
        out = tmp_path / f"{name}-out.csv"
        assert main(["predict", str(tmp_path / "made"), str(tmp_path / f"{name}.csv"), "--out", str(out)]) == 0
        assert said in out.read_text().splitlines()[0], "a file that travels says it too"


def test_fresh_rows_in_another_unit_are_refused_and_heavy_ones_are_said(loaded):
    torques = np.random.default_rng(16).normal(size=(60, 6)) * USUAL
    centi, heavy = (
        measured(lambda _: GIVE * torques, by_name(TORQUES, times * torques), count=60, seed=5)
        for times in (100.0, 4.0)
    )
    with pytest.raises(
        SamplesError, match=r"'torque2_Nm': .* out of all proportion .* such as kg and not g, or Nm and"
    ):
        verify(loaded, centi)
    found = verify(loaded, heavy)
    assert any("torque2_Nm is" in words and "extrapolated" in words for words in found.judged.remarks)
    assert found.judged.remarks[0] in found.summary()
    assert found.to_dict()["remarks"] == list(found.judged.remarks)


def test_a_result_from_before_ranges_were_kept_corrects_as_before(loaded, asked):
    document = loaded.to_dict()
    del document["discrepancy"]["range"]
    check_document("this", document)
    arm = dataclasses.replace(loaded.arm, document=document)
    np.testing.assert_array_equal(predict(arm, asked[2]).positions, loaded.predict(asked[2]).positions)


COMPLIANCE = np.array([0.0, 25.0, 30.0, 40.0, 30.0, 10.0]) * 1e-6  # rad/Nm
GRAVITY, OWN, STEP = 9.81, 8.0, 1e-5  # own: kilograms of the arm itself


def sag(joints, kilograms, hangs):
    """Joint motion (N, 6) under the arm's own weight and a payload, both at `hangs`: torques by differences."""
    found = np.zeros_like(joints)
    for j in range(6):
        step = np.eye(6)[j] * STEP
        lever = -(hangs(joints + step)[:, 2] - hangs(joints - step)[:, 2]) / (2 * STEP) / 1000
        found[:, j] = COMPLIANCE[j] * GRAVITY * (OWN + kilograms) * lever
    return found


def at_flange(joints):
    return flanges(joints)[:, :3, 3]


CENTRES = tuple(map(tuple, np.tile(Links.of(ROBOT).places[-1], (6, 1))))
SAGS = {
    "gravity": (GravitySag(payload="payload_kg", size=0.5), tips),
    "masses": (LinkSag(masses=(0, 0, 0, 0, 0, OWN), centres=CENTRES, payload="payload_kg", size=0.5), at_flange),
    "links": (LinkSag(payload="payload_kg", size=0.5), at_flange),
}


@pytest.mark.long_unless("gravity")
@pytest.mark.parametrize("kind", ["gravity", "masses", pytest.param("links", marks=pytest.mark.long)])
def test_one_calibration_mixes_payloads_and_tells_them_apart(kind):
    effect, hangs = SAGS[kind]
    kilograms = np.where(np.arange(120) % 2, 4.0, 0.0)
    rows = measured(lambda q: sag(q, kilograms, hangs), {"payload_kg": kilograms}, count=120, seed=2)
    found = calibrate(Problem(ROBOT, POINT, terms=(effect,)), rows, reference=False)
    assert found.told == ("give",)
    joints = postures(np.random.default_rng(4), 30)
    none, five = (table(joints, payload_kg=np.full(30, kg)) for kg in (0.0, 5.0))
    empty, heavy = (found.predict(q, frame="tip", std=True) for q in (none, five))
    where = [tips(joints + sag(joints, kg, hangs)) for kg in (0.0, 5.0)]
    for made, true in zip((empty, heavy), where, strict=True):
        assert rms(made.positions - true) < 0.05 < 0.3 < rms(true - tips(joints))
        assert 0.3 < rms(made.positions - true) / np.sqrt((made.std**2).mean()) < 2.0
    differ, meant = heavy.positions - empty.positions, where[1] - where[0]
    assert rms(meant) > 0.4
    assert rms(differ - meant) < 0.06 * rms(meant)
    bare = found.predict(joints)
    assert bare.missing == {effect.words: ("payload_kg",)}
    mixed = found.compensate(table(joints, payload_kg=np.where(np.arange(30) % 2, 5.0, 0.0)))
    now = sag(mixed.joints, np.where(np.arange(30) % 2, 5.0, 0.0), hangs)
    assert rms((flanges(mixed.joints + now) - drawn(joints))[mixed.reached, :3, 3]) < 0.06
    with pytest.raises(SamplesError, match="line 1, column 'payload_kg': -1 is no payload from 0 to 10,000 kg"):
        found.predict(table(joints, payload_kg=np.full(30, -1.0)))


@pytest.mark.long
def test_an_arm_that_sags_is_one_arm_whose_payload_is_known_or_as_it_was_on_average(tmp_path, capsys):
    kilograms = np.where(np.arange(90) % 2, 4.0, 0.0)
    rows = measured(lambda q: sag(q, kilograms, as_drawn), {"payload_kg": kilograms}, count=90, tips=as_drawn)
    effect = GravitySag(payload="payload_kg", size=0.5)
    found = calibrate(Problem(ROBOT, POINT, terms=(effect,)), rows, reference=False)
    joints = postures(np.random.default_rng(4), 30)
    loaded = table(joints, payload_kg=np.full(30, 4.0))
    assert found.success
    said = " ".join(found.summary().split())
    assert "That is where rows have payload_kg, in predict" in said
    found.save(tmp_path / "made")
    assert "That is where rows have payload_kg" in (tmp_path / "made" / "report.html").read_text()
    read = load(tmp_path / "made")
    for asked, kg, least in ((loaded, 4.0, 0.0), (joints, 0.0, 0.05), (joints, 4.0, 0.05)):
        here = read.predict(asked, frame="tip", std=True)
        off = rms(here.positions - as_drawn(joints + sag(joints, kg, as_drawn)))
        assert least < off < (0.05 if least == 0 else 0.5)
        assert 0.3 < off / np.sqrt((here.std**2).mean()) < 2.0
    sent = read.compensate(loaded)
    assert sent.reached.all()
    assert np.isfinite(sent.expected_mm).all()
    there = drawn(sent.joints + sag(sent.joints, 4.0, as_drawn)) - drawn(joints)
    assert rms(there[:, :3, 3]) < 0.05
    assert "expected tip error: 0.0" in read.export("c")
    fresh = measured(lambda q: sag(q, 2.0, as_drawn), {"payload_kg": np.full(40, 2.0)}, count=40, seed=5, tips=as_drawn)
    verified = verify(read, fresh)
    assert verified.kept
    assert not verified.denied
    loaded.to_csv(tmp_path / "loaded.csv", index=False)
    out = str(tmp_path / "out.csv")
    assert main(["compensate", str(tmp_path / "made"), str(tmp_path / "loaded.csv"), "--out", out]) == 0
    assert "Corrected by columns of the rows" in capsys.readouterr().out
    assert "against the verdict" not in (tmp_path / "out.csv").read_text()


def test_a_payload_that_is_missing_or_none_is_named(loaded):
    problem = Problem(ROBOT, POINT, terms=(GravitySag(payload="payload_kg"),))
    with pytest.raises(ProblemError, match="no column 'payload_kg' of payload"):
        bind(problem, loaded.samples)
    for kind in (GravitySag, LinkSag):
        with pytest.raises(ProblemError, match=r"Got 3\.0 as the payload"):
            kind(payload=3.0)


def test_fresh_rows_with_torques_verify_the_corrected_arm(loaded):
    torques = np.random.default_rng(16).normal(size=(60, 6)) * USUAL
    fresh, wrong = (
        measured(lambda _, sign=sign: sign * GIVE * torques, by_name(TORQUES, torques), count=60, seed=5)
        for sign in (1, -1)
    )
    found = verify(loaded, fresh)
    assert found.kept
    assert found.promised_tip_mm < 0.02
    assert not verify(loaded, wrong).kept
    with pytest.raises(ProblemError, match=r"has no column 'torque1_Nm', which says what joint .* each row\. Add it"):
        verify(loaded, dataclasses.replace(fresh, extra={}))


@pytest.mark.long_unless("0.002")
@pytest.mark.parametrize("shift", [0.0, 2e-3])
def test_with_an_earlier_result_torques_and_what_changed_are_corrected(loaded, asked, tmp_path, shift):
    joints, torques, rows, _ = asked
    moved = shift * np.eye(6)[3]
    given = np.random.default_rng(16).normal(size=(60, 6)) * USUAL
    fresh = measured(lambda _: GIVE * given + moved, by_name(TORQUES, given), count=60, seed=5)
    assert changed(loaded, fresh).changed is bool(shift)
    loosen = ["joint4"] if shift else []
    calibrate(loaded.source, fresh, prior=loaded, loosen=loosen, reference=False).save(tmp_path / "made")
    made = load(tmp_path / "made")
    known, unknown = (made.predict(q, frame="tip", std=True) for q in (rows, joints))
    for found, least in ((known, 0.3), (unknown, 0.5)):
        off = found.positions - tips(joints + moved + GIVE * torques)
        assert least < rms(off) / np.sqrt((found.std**2).mean()) < 2.0
    assert rms(known.positions - tips(joints + moved + GIVE * torques)) < 0.02 < 1.0 < rms(unknown.std[:, None])
    assert unknown.missing == {WORDS: TORQUES}
    assert "expected tip error: 0.0" in made.export("c")
    again = measured(lambda _: GIVE * given + moved, by_name(TORQUES, given), count=60, seed=8)
    assert verify(made, again).kept


@pytest.mark.long
def test_play_whose_way_is_told_is_corrected_before_faces_too():
    """Joints that come from either side: no zero of a joint stands for that, and it counts where nobody tells it."""
    source = load_problem(ROOT / "problems" / "ur5")
    made = simulate(source.problem, source.cell, samples=120, seed=3)
    rng = np.random.default_rng(7)
    half = np.array([40.0, 60.0, 60.0, 80.0, 80.0, 80.0]) * 1e-6
    came = rng.choice([-1, 1], size=(120, 6))
    rows = dataclasses.replace(
        made.samples,
        joints=made.samples.joints + half * came,
        extra={name: tuple(map(str, ways)) for name, ways in by_name(CAME, came).items()},
    )
    problem = source.problem.with_terms(*with_kit(source.problem).terms, Backlash(columns_of=CAME))
    found = calibrate(problem, rows, reference=False)
    assert found.told == ("play",)
    joints, now = workspace_joints(problem.robot), rng.choice([-1, 1], size=(400, 6))
    true = made.true_tips(joints)
    shown = table(joints + half * now)
    known, unknown = (found.predict(q, frame="tip", std=True) for q in (shown.assign(**by_name(CAME, now)), shown))
    off = [tip_rms(without_rigid((each.positions - true).ravel(), true)) for each in (known, unknown)]
    assert off[0] < 0.05 < off[1] + 0.02
    assert off[0] < 0.7 * off[1]
    for error, each in zip(off, (known, unknown), strict=True):
        assert error < 1.5 * np.sqrt((each.std**2).mean())


@pytest.mark.long
def test_what_columns_tell_is_left_out_of_plans_and_sessions_and_a_loss_says_so(loaded):
    source = load_problem(ROOT / "problems" / "ur5")
    problem = source.problem.with_terms(TorqueCompliance(columns_of=TORQUES))
    planned = [plan(each, source.cell, touches=30, pool=200, starts=1).error for each in (problem, source.problem)]
    assert planned[0] == planned[1]
    made = simulate(problem, source.cell, samples=45, seed=1).samples
    session = Session(problem)
    for q, reading, code in zip(made.joints, made.columns["reading"], made.labels["plane"].codes, strict=True):
        session = session.take(q, float(reading), made.labels["plane"].names[code])
    assert len(session) == 45
    assert session.tip_error < 1.0
    robust = calibrate(loaded.source.problem, loaded.samples, loss=huber(), reference=False)
    assert any("The problem declares" in each and "torque" in each for each in warnings(robust))
