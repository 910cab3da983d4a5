"""Was the promise kept: fresh rows against the covariance that a calibration promised, without fitting it again."""

import dataclasses
import json
import pickle
from functools import cache

import numpy as np
import pandas as pd
import pytest
from conftest import ROOT
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2, kstest
from seals import resealed

from casacal import (
    CasacalError,
    Plane,
    Problem,
    Robot,
    Samples,
    TrackedPoint,
    bind,
    calibrate,
    load_problem,
    simulate,
    tool_point,
    verify,
)
from casacal.calibration.result_json import geometry, rows_of, spreads
from casacal.cli.main import main
from casacal.data.repeats import MOST, copies, fitted_among, is_listing, listing
from casacal.data.samples import Layout, joined
from casacal.deployment.arm import CalibratedArm
from casacal.errors import SamplesError, UnknownNameError
from casacal.files import jsonable, write_json
from casacal.fit.lm import lm
from casacal.uncertainty.fresh_rows import FreshRows, chance, learnt
from casacal.verification.verification import LEVEL

ROBOTS = ("hsr_jr680", "ur5", "kuka_iiwa14", "adept_cobra600")
FITTED, FRESH = 90, 60


@cache
def drawn(name):
    """A problem, postures that touch the faces of its cell, and the joint of each that moves the touch most."""
    source = load_problem(ROOT / "problems" / name)
    bound = bind(source.problem, simulate(source.problem, source.cell, samples=FITTED + FRESH, seed=11).samples)
    joints, step = bound.block.samples.joints, 1e-5
    at = moved(bound, joints).plain_residual(bound.x0)
    steps = (moved(bound, joints + step * one).plain_residual(bound.x0) - at for one in np.eye(joints.shape[1]))
    slopes = np.array(list(steps)).T / step
    which = np.abs(slopes).argmax(axis=1)
    return source, bound, which, slopes[np.arange(len(joints)), which]


def moved(bound, joints):
    return bound.on(dataclasses.replace(bound.block.samples, joints=joints))


def touched(name, x, rng, within=None):
    """The same rows touched by a true arm x (n,): a joint of each gives way until the residual is the noise drawn."""
    _, bound, which, slopes = drawn(name)
    bound = bound if within is None else within
    wanted = rng.normal(size=bound.rows) * bound.block.noise.ravel()
    joints, rows = bound.block.samples.joints.copy(), np.arange(bound.rows)
    for _ in range(3):
        joints[rows, which] -= (moved(bound, joints).plain_residual(x) - wanted) / slopes
    return dataclasses.replace(bound.block.samples, joints=joints)


def halves(samples):
    """Rows to calibrate from, and fresh ones."""
    one, two = samples.take(range(FITTED)), samples.take(range(FITTED, len(samples)))
    return dataclasses.replace(one, sha256="fitted"), dataclasses.replace(two, sha256="fresh")


def fitted(source, samples):
    """A calibration by LM with the noise as stated: of its result.json no more than verification reads."""
    bound = bind(source.problem, samples)
    result = lm(bound)
    document = {
        "data": {"sha256": samples.sha256},
        "parameters": rows_of(bound, result.x, result.std, ["samples"] * bound.unknowns),
        **geometry(bound, result.x),
        **spreads(result.covariance, bound.names, bound),
    }
    return CalibratedArm("a calibration", source, jsonable(document))


def true_arm(bound, rng):
    """An arm as the priors say; faces stand where the drawn one sees them."""
    size = np.where(np.isfinite(bound.prior_std), bound.prior_std, 0.0)
    return size * rng.normal(size=bound.unknowns)


# ------------------------------------------------------------------------------------------------ the statistic itself


def an_example(rng, rows=24, known=6, own=3):
    slopes, free = rng.normal(size=(rows, known)), rng.normal(size=(rows, own))
    half = rng.normal(size=(known, known))
    return slopes, free, half


def test_restricted_likelihood_against_dense_matrices():
    rng = np.random.default_rng(0)
    slopes, own, half = an_example(rng)
    residual = 3 * rng.normal(size=24)
    found = FreshRows(residual, slopes @ half, own)
    beside, total = null_space(own.T), np.eye(24) + slopes @ half @ half.T @ slopes.T
    inside = beside.T @ total @ beside
    assert found.freedom == 21
    assert found.chi_square == pytest.approx(
        residual @ beside @ np.linalg.solve(inside, beside.T @ residual), rel=1e-10
    )
    np.testing.assert_allclose(found.left, beside @ beside.T @ residual, atol=1e-12)
    np.testing.assert_allclose(found.std**2, np.diagonal(beside @ inside @ beside.T), rtol=1e-10)
    # row 5 as the other 23 predict it, by generalised least squares
    others = np.arange(24) != 5
    weight = np.linalg.inv(total[np.ix_(others, others)])
    place = np.linalg.solve(own[others].T @ weight @ own[others], own[others].T @ weight @ residual[others])
    pull = total[5, others] @ weight
    miss = residual[5] - own[5] @ place - pull @ (residual[others] - own[others] @ place)
    gap = own[5] - pull @ own[others]
    spread = total[5, 5] - pull @ total[others, 5]
    spread += gap @ np.linalg.solve(own[others].T @ weight @ own[others], gap)
    assert found.deleted[5] == pytest.approx(miss / np.sqrt(spread), rel=1e-10)
    prior = np.linalg.inv(half @ half.T)
    np.testing.assert_allclose(
        np.linalg.inv(learnt(half @ half.T, slopes, own)), prior + slopes.T @ beside @ beside.T @ slopes, rtol=1e-8
    )


def test_chances_are_uniform_where_the_promise_is_true():
    rng = np.random.default_rng(1)
    slopes, own, half = an_example(rng)
    spread, chances = slopes @ half, []
    for _ in range(400):
        residual = rng.normal(size=24) + spread @ rng.normal(size=6) + own @ rng.normal(size=3) * 1e3
        found = FreshRows(residual, spread, own)
        arm, seen = found.toward(slopes)
        chances.append((chance(found.chi_square, found.freedom), chance(arm, seen)))
    for one in np.array(chances).T:
        assert kstest(one, "uniform").pvalue > 0.01
    assert seen == 6
    assert found.toward(slopes * np.array([1e-3, 1, 1, 1, 1, 1]))[1] == 5  # the prior knows it better


def test_noise_that_was_found_itself_widens_what_is_expected():
    assert chance(150.0, 100) == pytest.approx(chi2.sf(150, 100), rel=1e-9)
    ratio = np.random.default_rng(2).chisquare(100, 200_000) / 100
    ratio /= np.random.default_rng(3).chisquare(40, 200_000) / 40
    assert chance(150.0, 100, 40.0) == pytest.approx((ratio > 1.5).mean(), rel=0.03)
    assert chance(0.0, 0) == 1.0


def test_gross_rows_are_named_one_by_one_and_never_where_all_are_off():
    rng = np.random.default_rng(4)
    slopes, own, half = an_example(rng, rows=80)
    residual = rng.normal(size=80)
    assert FreshRows(residual, slopes @ half, own).gross().size == 0
    residual[[7, 31]] += (40.0, -25.0)
    assert FreshRows(residual, slopes @ half, own).gross().tolist() == [7, 31]
    residual += 30 * rng.normal(size=80)  # all of them are off: it is not single rows
    assert FreshRows(residual, slopes @ half, own).gross().size == 0


# ------------------------------------------------------------------------------------------------ arms of problems/


@pytest.mark.long_unless("adept_cobra600")
@pytest.mark.parametrize("name", ROBOTS)
def test_the_promise_of_a_good_arm_is_kept(name):
    source, bound, *_ = drawn(name)
    rng, found = np.random.default_rng(5), []
    for _ in range(20):
        some, fresh = halves(touched(name, true_arm(bound, rng), rng))
        found.append(verify(fitted(source, some), fresh))
    kept = sum(one.kept for one in found)
    assert kept >= binom.ppf(1e-3, len(found), 1 - LEVEL)
    ratios = np.array([one.chi_square / one.freedom for one in found])
    assert abs(ratios.mean() - 1) < 4 * np.sqrt(2 / found[0].freedom / len(found))
    rms = np.array([[one.after_mm, one.predicted_mm, one.before_mm] for one in found]) ** 2
    assert rms[:, 0].mean() == pytest.approx(rms[:, 1].mean(), rel=0.1)
    assert rms[:, 2].mean() > 10 * rms[:, 0].mean()
    assert sum(face.rows for face in found[0].faces) == found[0].judged.rows == FRESH
    assert 0 < found[0].hidden_tip_mm < found[0].promised_tip_mm


def arm_that_changed(bound, rng):
    """0.3 mm, or a tenth of a degree where there are no lengths, in a part of the arm that touches can see."""
    names = [j for j, name in enumerate(bound.names) if name in ("a2", "d4", "link2")]
    return names[int(rng.integers(len(names)))], 0.3


@pytest.mark.parametrize("name", ROBOTS)
def test_an_arm_that_changed_since_is_noticed(name):
    source, bound, *_ = drawn(name)
    rng, kept = np.random.default_rng(6), 0
    for _ in range(6):
        x = true_arm(bound, rng)
        j, by = arm_that_changed(bound, rng)
        some, _ = halves(touched(name, x, rng))
        x[j] += by
        kept += verify(fitted(source, some), halves(touched(name, x, rng))[1]).kept
    assert kept <= 3


@pytest.mark.parametrize("name", ["hsr_jr680", "ur5", "adept_cobra600"])
def test_a_dial_that_reads_otherwise_is_noticed(name):
    source, bound, *_ = drawn(name)
    rng, kept = np.random.default_rng(7), {1.01: 0, -1.0: 0}
    for _ in range(6):
        some, fresh = halves(touched(name, true_arm(bound, rng), rng))
        arm = fitted(source, some)
        for factor in kept:
            other = dataclasses.replace(fresh, columns={"reading": factor * fresh.columns["reading"]})
            kept[factor] += verify(arm, other).kept
    assert kept[1.01] <= 1
    assert kept[-1.0] == 0


def test_another_tool_is_noticed(hsr):
    dial = hsr.problem.instrument
    longer = Problem(hsr.problem.robot, dataclasses.replace(dial, tool=tool_point(0.5, 0, 0, free=False)))
    _, bound, *_ = drawn("hsr_jr680")
    rng = np.random.default_rng(8)
    x = true_arm(bound, rng)
    some, _ = halves(touched("hsr_jr680", x, rng))
    there = bind(longer, bound.block.samples)
    _, fresh = halves(touched("hsr_jr680", x, rng, within=there))
    assert not verify(fitted(hsr, some), fresh).kept


# ------------------------------------------------------------------------------------------------ what is kept, and new


@pytest.fixture(scope="module")
def good(hsr):
    """A calibration with its fresh rows, and the true arm behind both."""
    _, bound, *_ = drawn("hsr_jr680")
    rng = np.random.default_rng(9)
    x = true_arm(bound, rng)
    some, fresh = halves(touched("hsr_jr680", x, rng))
    return fitted(hsr, some), fresh, x, some


def relabelled(samples, **names):
    return dataclasses.replace(
        samples, labels={"plane": [names.get(label, label) for label in samples.labels["plane"]]}
    )


def test_faces_that_still_stand_are_not_fitted_again(good):
    arm, fresh, _, _ = good
    free, held = verify(arm, fresh), verify(arm, fresh, standing=["floor", "plane.wall"])
    assert free.kept
    assert held.kept
    assert (free.freedom, held.freedom) == (FRESH - 9, FRESH - 3)
    assert held.judged.own == tuple(f"plane.side.{name}" for name in ("tilt1", "tilt2", "offset"))
    assert held.seen > free.seen
    # a wall that was moved 0.1 mm: its own place is fitted, so only those who hold it notice
    _, bound, *_ = drawn("hsr_jr680")
    elsewhere = good[2].copy()
    elsewhere[bound.names.index("plane.wall.offset")] += 0.1
    _, rows = halves(touched("hsr_jr680", elsewhere, np.random.default_rng(10)))
    assert verify(arm, rows).kept
    assert not verify(arm, rows, standing=["wall"]).kept
    new = verify(arm, relabelled(fresh, wall="a new one"))
    assert (new.freedom, new.chi_square) == (free.freedom, pytest.approx(free.chi_square, rel=1e-6))


def test_a_face_that_stands_needs_no_rows_of_its_own(good):
    arm, fresh, _, _ = good
    few = fresh.take([0])
    found = verify(arm, few, standing=[few.labels["plane"][0]])
    assert (found.judged.rows, found.freedom, found.judged.own) == (1, 1, ())
    with pytest.raises(CasacalError, match="has 1 row for 3 unknowns of its own"):
        verify(arm, few)


def test_priors_of_what_the_rows_alone_know_count_as_readings(good, hsr):
    arm, fresh, _, _ = good
    _, bound, *_ = drawn("hsr_jr680")
    floor = next(slot.nominal for slot in bound.slots if slot.name == "plane.floor")
    rows = fresh.take(np.flatnonzero(np.array(fresh.labels["plane"]) == "floor"))
    rows = dataclasses.replace(rows, labels={})

    def guessed(off):
        """With a floor that somebody surveyed to a hundredth, and wrote down so far off."""
        plane = Plane(tuple(floor[:3]), tuple(floor[9:12] + off * floor[:3]), prior_std=(1e-3, 0.01))
        dial = dataclasses.replace(hsr.problem.instrument, plane=plane)
        return verify(arm, rows, problem=Problem(hsr.problem.robot, dial))

    right, wrong = guessed(0.0), guessed(5.0)
    assert right.freedom == wrong.freedom == len(rows)  # three unknowns, and as many guesses beforehand
    assert right.kept
    assert not wrong.kept
    assert wrong.after_mm < 1.0  # the rows themselves lie on a plane, only not where it was surveyed


def test_gross_rows_are_named_by_their_lines(good):
    arm, fresh, _, _ = good
    reading = fresh.columns["reading"].copy()
    reading[[4, 30]] += (0.4, -0.3)
    found = verify(arm, dataclasses.replace(fresh, columns={"reading": reading}))
    assert not found.kept
    assert found.kept_without_gross
    assert found.gross_lines == (fresh.lines[4], fresh.lines[30])
    assert f"Lines {fresh.lines[4]}, {fresh.lines[30]} of" in found.summary()
    assert "Without them the promise is kept" in found.summary()
    assert verify(arm, fresh).gross_lines == ()


# ------------------------------------------------------------------------------------------------ a tracker: accuracy


def tracked(bound, x, tool, rng, noise=0.01, poses=40):
    """Points of a reflector on an arm x (n,), as a station that stands askew sees them; by hand."""
    joints = rng.uniform(-1.0, 1.0, (poses, 6))
    frames = bound.poses(x, joints)
    points = frames[:, :3, 3] + frames[:, :3, :3] @ tool
    seen = Rotation.from_rotvec([0.1, -0.2, 2.0]).apply(points) + np.array([3000.0, -500.0, 200.0])
    columns = dict(zip("xyz", (seen + rng.normal(size=seen.shape) * noise).T, strict=True))
    return Samples(joints, columns, {}, tuple(range(1, poses + 1)), {}, "tracker", "tracker")


def test_a_tracker_says_how_accurate_the_tip_is(good, hsr):
    arm, _, x, _ = good
    _, bound, *_ = drawn("hsr_jr680")
    tool = np.array([20.0, 10.0, 60.0])
    problem = Problem(hsr.problem.robot, TrackedPoint(noise_std=0.01, tool=tool_point(*tool, free=False)))
    rows = tracked(bound, x, tool, np.random.default_rng(11))
    found = verify(arm, rows, problem=problem)
    assert found.kept
    assert found.accuracy
    assert len(found.judged.own) == 6
    assert all(name.startswith("station.") for name in found.judged.own)
    assert found.freedom == 3 * 40 - 6
    # as drawn: what is left of the nominal points after the best rigid motion
    frames = bound.poses(bound.x0, rows.joints)
    nominal = frames[:, :3, 3] + frames[:, :3, :3] @ tool
    read = np.column_stack([rows.columns[name] for name in "xyz"])
    a, b = nominal - nominal.mean(axis=0), read - read.mean(axis=0)
    turned = Rotation.align_vectors(b, a)[0].apply(a)
    assert found.before_mm == pytest.approx(np.sqrt(((turned - b) ** 2).sum(axis=1).mean()), rel=1e-4)
    assert found.after_mm < 0.7 * found.before_mm
    assert 0.3 < found.after_mm / found.predicted_mm < 2
    assert found.hidden_tip_mm < 0.3 * found.promised_tip_mm
    assert "errors of the tip itself where it was measured" in found.summary()
    worse = x.copy()
    worse[bound.names.index("a2")] += 3.0
    assert not verify(arm, tracked(bound, worse, tool, np.random.default_rng(12)), problem=problem).kept


def test_a_reflector_nobody_measured_belongs_to_its_rows(good, hsr):
    arm, _, x, _ = good
    _, bound, *_ = drawn("hsr_jr680")
    problem = Problem(hsr.problem.robot, TrackedPoint(noise_std=0.01))
    rows = tracked(bound, x, np.array([5.0, 0.0, 40.0]), np.random.default_rng(13))
    found = verify(arm, rows, problem=problem, tolerance=2.0)
    assert found.kept
    assert found.decision.verdict == "accept"
    assert len(found.judged.own) == 9
    assert "and of the reflector" in found.summary()
    with pytest.raises(SamplesError, match="3 rows for 9 unknowns"):
        verify(arm, rows.take([0, 1, 2]), problem=problem)


@dataclasses.dataclass(frozen=True, kw_only=True)
class OnShelves(TrackedPoint):
    """Points listed by where they were watched."""

    @property
    def groups(self):
        """The shelf."""
        return "shelf"


def test_groups_of_rows_with_three_residuals_each(good, hsr):
    arm, _, x, _ = good
    _, bound, *_ = drawn("hsr_jr680")
    tool = np.array([20.0, 10.0, 60.0])
    problem = Problem(hsr.problem.robot, OnShelves(noise_std=0.01, tool=tool_point(*tool, free=False)))
    rows = tracked(bound, x, tool, np.random.default_rng(14))
    rows = dataclasses.replace(rows, labels={"shelf": ["high", "low", "low", "low"] * 10})
    found = {face.label: face for face in verify(arm, rows, problem=problem).faces}
    alone = verify(arm, rows.take(np.flatnonzero(np.array(rows.labels["shelf"]) == "high")), problem=problem)
    assert (found["high"].rows, found["low"].rows) == (10, 30)
    assert found["high"].freedom == alone.freedom == 24
    assert found["high"].chi_square == pytest.approx(alone.chi_square, rel=1e-3)


def test_a_tool_goes_with_its_instrument():
    source, bound, *_ = drawn("ur5")
    some, fresh = halves(bound.block.samples)
    arm = fitted(source, some)
    assert "tool_x" not in verify(arm, fresh).judged.own
    problem = Problem(source.problem.robot, TrackedPoint(noise_std=0.01))
    rows = tracked(bound, bound.x0, np.array([0.0, 0.0, 50.0]), np.random.default_rng(15))
    assert {"tool_x", "tool_y", "tool_z"} < set(verify(arm, rows, problem=problem).judged.own)
    assert "tool_x" not in verify(arm, rows, problem=problem, standing=["tool"]).judged.own


# ------------------------------------------------------------------------------------------------ values and refusals


def test_what_the_calibration_held_stays_held_whoever_watches(good, hsr):
    _, fresh, x, some = good
    arm = fitted(dataclasses.replace(hsr, problem=hsr.problem.fix("alpha")), some)
    tool = np.array([20.0, 10.0, 60.0])
    problem = Problem(hsr.problem.robot, TrackedPoint(noise_std=0.01, tool=tool_point(*tool, free=False)))
    _, bound, *_ = drawn("hsr_jr680")
    found = verify(arm, tracked(bound, x, tool, np.random.default_rng(16)), problem=problem)
    assert found.unknowns == verify(arm, fresh).unknowns == 18


def test_nothing_is_promised_of_what_nothing_held(good, hsr):
    _, fresh, _, some = good
    loose = dataclasses.replace(hsr, problem=hsr.problem.with_prior({"a": np.inf, "d": np.inf}))
    found = verify(fitted(loose, some), fresh)
    assert found.kept
    assert found.hidden_tip_mm == np.inf
    assert "of any size could remain unseen" in found.summary()
    assert found.to_dict()["hidden_tip_mm"] is None


def test_a_verification_is_a_value(good):
    arm, fresh, _, _ = good
    found = verify(arm, fresh)
    assert pickle.loads(pickle.dumps(found)) == found == verify(arm, fresh)
    assert found != verify(arm, fresh, tolerance=1.0)
    assert "promise kept" in repr(found)
    with pytest.raises(dataclasses.FrozenInstanceError):
        found.p = 0.5
    document = json.loads(json.dumps(found.to_dict()))
    assert document["kept"] is document["passed"] is True
    assert [face["label"] for face in document["faces"]] == ["floor", "wall", "side"]


def test_19_rows_in_20_lie_within_the_figure_that_says_so(good):
    arm, fresh, _, _ = good
    found = verify(arm, fresh)
    assert found.after_mm < found.quantile_mm < 3 * found.after_mm
    assert found.to_dict()["quantile_mm"] == found.quantile_mm


def test_refusals(good, hsr):
    arm, fresh, _, some = good
    ur5 = ROOT / "problems" / "ur5"
    longer = dataclasses.replace(
        hsr.problem.robot.parameters["a"], values=tuple(v + 1e-3 for v in hsr.problem.robot.parameters["a"].values)
    )
    robot = Robot(
        "HSR", hsr.problem.robot.joints, hsr.problem.robot.pose, {**hsr.problem.robot.parameters, "a": longer}
    )
    damaged = dataclasses.replace(arm, document={**arm.document, "proposed": {"plane.wall": [1.0, 2.0]}})
    refusals = [
        (lambda: verify(arm, some), SamplesError, "calibrated from, which say nothing new"),
        (lambda: verify(arm, fresh, problem=ur5), CasacalError, "the arm of the problem .UR5. is not the calibrated"),
        (
            lambda: verify(arm, fresh, problem=Problem(robot, hsr.problem.instrument)),
            CasacalError,
            "not the calibrated",
        ),
        (lambda: verify(arm, fresh, standing=["flor"]), UnknownNameError, "Did you mean 'floor'"),
        (lambda: verify(arm, fresh, standing="floor"), CasacalError, r"Give \['floor'\]"),
        (
            lambda: verify(arm, relabelled(fresh, wall="w"), standing=["w"]),
            CasacalError,
            "does not give the position of 'w'",
        ),
        (lambda: verify(damaged, fresh, standing=["wall"]), CasacalError, "does not give the position of 'wall'"),
        (lambda: verify(arm, fresh, tolerance=0), CasacalError, "The tolerance is 0"),
        (lambda: verify(3.0, fresh), CasacalError, "Got a float as the result"),
        (lambda: verify(arm, fresh, problem=3.0), CasacalError, "Got a float as the problem"),
        (lambda: verify(arm, dataclasses.replace(fresh, labels={})), SamplesError, "no label 'plane'"),
        (lambda: verify("nowhere", fresh), CasacalError, "no such file"),
    ]
    for call, kind, says in refusals:
        with pytest.raises(kind, match=says):
            call()
    held = fitted(dataclasses.replace(hsr, problem=hsr.problem.fix("plane")), some)
    with pytest.raises(CasacalError, match=r"'plane\.floor' was held in the calibration"):
        verify(held, fresh)


# ------------------------------------------------------------------------------------------ rows that are not fresh


@pytest.fixture(scope="module")
def spent(hsr):
    """A calibration as it is saved, its samples, and fresh touches of the same arm, in memory."""
    _, bound, *_ = drawn("hsr_jr680")
    rng = np.random.default_rng(31)
    x = true_arm(bound, rng)
    some, fresh = halves(touched("hsr_jr680", x, rng))
    return calibrate(hsr, some, method="lm", reference=False, outliers="keep").arm, some, fresh, x


def frame_of(samples):
    """Rows as they stand in a file: degrees, all digits."""
    columns = {f"q{i + 1}_deg": np.degrees(q) for i, q in enumerate(samples.joints.T)}
    return pd.DataFrame({**columns, "reading_mm": samples.columns["reading"], "plane": list(samples.labels["plane"])})


def in_radians(frame):
    joints = [name for name in frame if name.endswith("_deg")]
    rest = frame.drop(columns=joints)
    return pd.concat([pd.DataFrame({f"{name[:2]}_rad": np.radians(frame[name]) for name in joints}), rest], axis=1)


def with_shift(frame, columns, by):
    return frame.assign(**{name: frame[name] + by for name in columns})


JOINTS = tuple(f"q{i}_deg" for i in range(1, 7))
DISGUISES = {
    "none": lambda f: f,
    "shuffled": lambda f: f.sample(frac=1, random_state=0),
    "halved": lambda f: f.iloc[::2],
    "reversed": lambda f: f.iloc[::-1],
    "one row less": lambda f: f.iloc[1:],
    "one row": lambda f: f.iloc[[7]],
    "decimals cut": lambda f: f.round(dict.fromkeys(JOINTS, 2)),
    "decimals of all cut": lambda f: f.round(dict.fromkeys(JOINTS, 3) | {"reading_mm": 3}),
    "radians": in_radians,
    "labels renamed": lambda f: f.assign(plane=f["plane"] + " 2"),
    "joints moved": lambda f: with_shift(f, JOINTS, 1e-3),
    "one joint moved": lambda f: with_shift(f, ["q1_deg"], -1e-6),
    "readings moved": lambda f: with_shift(f, ["reading_mm"], -1e-3),
    "columns in another order": lambda f: f[list(f)[::-1]],
    "twice": lambda f: pd.concat([f, f]),
    "a remark added": lambda f: f.assign(day="Monday"),
}


@pytest.mark.parametrize("disguise", DISGUISES)
def test_fitted_rows_are_known_whatever_they_wear(spent, disguise):
    arm, some, _, _ = spent
    with pytest.raises(SamplesError, match=r"the arm was calibrated from, which say nothing new.*other postures"):
        verify(arm, DISGUISES[disguise](frame_of(some)))


def test_fresh_rows_among_fitted_ones_are_judged_alone(spent):
    arm, some, fresh, _ = spent
    new, old = frame_of(fresh), frame_of(some)
    found, alone = verify(arm, pd.concat([new, old.iloc[:20]])), verify(arm, new)
    assert (found.judged.rows, len(found.judged.fitted_lines), alone.judged.fitted_lines) == (FRESH, 20, ())
    assert found.chi_square == pytest.approx(alone.chi_square, rel=1e-9)
    assert "20 rows of DataFrame are among those that the arm was calibrated from and do not count." in found.summary()
    assert len(found.to_dict()["fitted_lines"]) == 20
    assert verify(arm, pd.concat([new, old.iloc[: FRESH - 1]])).judged.rows == FRESH
    with pytest.raises(SamplesError, match="half of the rows or more are those that the arm was calibrated from"):
        verify(arm, pd.concat([new, old.iloc[:FRESH]]))


def test_the_same_postures_touched_again_are_fresh(spent):
    """With readings of their own: of noise alone on the same faces, or on faces that moved."""
    arm, some, _, _ = spent
    rng = np.random.default_rng(32)
    old = frame_of(some)
    again = verify(arm, old.assign(reading_mm=old["reading_mm"] + rng.normal(size=len(old)) * 0.01))
    assert again.judged.rows > 0.7 * len(old)  # a reading may be the old one by chance
    assert f"{again.judged.rows} of {again.judged.rows} rows are in postures that were fitted." in again.summary()
    elsewhere = verify(arm, frame_of(spent[2]))
    assert all("would be mirrored" in words for words in elsewhere.judged.remarks)
    one = frame_of(spent[2]).assign(q1_deg=old["q1_deg"].iloc[:FRESH].to_numpy())
    assert not [said for said in verify(arm, one).judged.remarks if "postures" in said], (
        "one joint alone makes no posture"
    )
    moved = verify(arm, old.assign(reading_mm=old["reading_mm"] + 0.2 + rng.normal(size=len(old)) * 0.01))
    assert moved.judged.rows == len(old)
    assert moved.judged.fitted_lines == ()


def test_fresh_rows_of_the_seed_of_the_calibration_are_fresh(hsr):
    """What is simulated in memory is called by its seed: content decides, not the name."""
    some, fresh = (simulate(hsr.problem, hsr.cell, samples=rows, seed=5).samples for rows in (90, 60))
    assert some.sha256 == fresh.sha256
    found = calibrate(hsr, some, method="lm", reference=False, discrepancy="none")
    same = verify(found, dataclasses.replace(fresh, columns={"reading": fresh.columns["reading"] + 1.0}))
    assert same.judged.rows == 60
    with pytest.raises(SamplesError, match="say nothing new"):
        verify(found, some)


@pytest.mark.long
def test_rows_that_were_held_out_are_fresh(hsr):
    some = simulate(hsr.problem, hsr.cell, samples=90, seed=5).samples
    held = calibrate(hsr, some, method="lm", reference=False, holdout=0.3, discrepancy="none")
    assert verify(held, held.heldout.block.samples).judged.rows == len(held.heldout.block.samples)


def test_of_very_many_rows_a_spread_is_kept():
    rng = np.random.default_rng(33)
    layout = Layout(("angle", "length"), {"reading": "length"})

    def rows(count):
        joints = np.column_stack([rng.uniform(-3, 3, count), rng.uniform(0, 500, count)])
        return Samples(joints, {"reading": rng.uniform(0, 9, count)}, {}, range(1, count + 1), {}, "f", "s")

    many, other = rows(5 * MOST), rows(500)
    listed = json.loads(json.dumps(listing(many, layout)))
    assert len(listed["values"]) == MOST
    assert is_listing(listed)
    for part in (many, many.take(np.arange(0, len(many), 2)), many.take(rng.permutation(len(many))[:3000])):
        assert fitted_among(part, layout, listed)[1] == pytest.approx(1.0, abs=0.15)
    both = joined(many, other)
    same, share = fitted_among(both, layout, listed)
    assert share == pytest.approx(len(many) / len(both), rel=0.01)
    assert not same[len(many) :].any()
    assert fitted_among(other, layout, listed) == (pytest.approx(np.zeros(500)), 0.0)
    elsewhere = Layout(("angle", "length"), {"x": "length"})
    watched = dataclasses.replace(many, columns={"x": many.columns["reading"]})
    assert not fitted_among(watched, elsewhere, listed)[0].any()  # another instrument


def test_touches_that_were_made_again_are_not_those_that_were_fitted():
    """In the same postures some read the same by chance; rows that were pasted all do."""
    rng, layout = np.random.default_rng(35), Layout(("angle", "angle"), {"reading": "length"})
    joints, true = rng.uniform(-2, 2, (60, 2)), rng.uniform(0, 9, 60)
    first, again = (
        Samples(joints, {"reading": true + rng.normal(size=60) * 0.005}, {}, range(60), {}, "f", "s") for _ in range(2)
    )
    listed = listing(first, layout)
    near = np.abs(again.columns["reading"] - first.columns["reading"]) < 0.0024
    assert 5 < near.sum() < 30
    assert not fitted_among(again, layout, listed)[0].any()
    pasted = joined(again.take(np.arange(20)), first.take(np.arange(20, 60)))
    assert fitted_among(pasted, layout, listed)[0][20:].all()


def test_where_nothing_is_read_the_joints_are_the_reading():
    layout, joints = Layout(("angle", "angle"), {}), np.random.default_rng(34).uniform(-2, 2, (30, 2))
    listed = listing(Samples(joints, {}, {}, range(30), {}, "f", "s"), layout)
    for by, same in ((0.0, 1.0), (1e-6, 1.0), (1e-5, 0.0)):  # touched again, joints differ by the noise
        assert fitted_among(Samples(joints + by, {}, {}, range(30), {}, "f", "s"), layout, listed)[1] == same


@pytest.mark.parametrize(
    "damage",
    [
        {"rows": 1}, {"rows": "9"}, {"rows": True}, {"columns": "reading"}, {"columns": [1]}, {"values": []},
        {"values": ["1 2", "1"]}, {"values": ["1 x", "1 2"]}, {"values": ["1 " + "9" * 400, "1 2"]}, {"values": [1, 2]},
        {"values": ["1 -", "1 2"]}, {"values": ["1 --2", "1 2"]}, {"values": ["1 ²", "1 2"]}, {"rows": 10**40},
    ],
)  # fmt: skip
def test_a_list_of_rows_that_is_none_is_refused(damage):
    good = {"rows": 2, "columns": ["reading"], "values": ["1 2", "-3 4"]}
    assert is_listing(good)
    assert not is_listing(good | damage)


@pytest.mark.long_unless("2")
@pytest.mark.parametrize("times", [2, 5])
def test_rows_that_were_pasted_count_once(spent, times):
    arm, _, _, x = spent
    rng, kept = np.random.default_rng(35), 0
    for _ in range(10):
        fresh = frame_of(halves(touched("hsr_jr680", x, rng))[1])
        once, often = verify(arm, fresh), verify(arm, pd.concat([fresh] * times))
        assert len(often.judged.copied_lines) == (times - 1) * FRESH
        assert (often.judged.rows, often.chi_square) == (once.judged.rows, pytest.approx(once.chi_square, rel=1e-9))
        kept += often.kept
    assert kept >= binom.ppf(1e-3, 10, 1 - LEVEL)
    assert f"{(times - 1) * FRESH} rows of DataFrame repeat others to the last digit and count once." in often.summary()
    pasted = pd.concat([fresh, fresh.iloc[5:9]])
    some = verify(arm, pasted)
    assert some.judged.copied_lines == tuple(Samples.from_frame(pasted, arm.source.problem.layout()).lines[FRESH:])
    assert some.judged.rows == FRESH


def test_touches_made_again_on_a_coarse_dial_all_count():
    """Ten postures touched six times each, read to whole hundredths: equal readings are no copies."""
    rng = np.random.default_rng(36)
    joints = np.repeat(rng.uniform(-2, 2, (10, 3)), 6, axis=0)
    reading = np.round(3 + rng.normal(size=60) * 0.01, 2)
    rows = Samples(joints, {"reading": reading}, {}, range(60), {}, "f", "s")
    assert len(np.unique(np.column_stack([joints, reading]), axis=0)) < 45
    assert not copies(rows).any()
    assert copies(joined(rows, rows)).tolist() == [False] * 60 + [True] * 60
    assert copies(rows.take(np.repeat(np.arange(60), 3))).sum() == 120
    once = rows.take(np.arange(0, 60, 6))  # each posture once: whatever stands there again is a copy
    assert copies(once.take([*range(10), 2, 2, 7])).tolist() == [False] * 10 + [True] * 3


# ------------------------------------------------------------------------------------------------ files and commands


# ------------------------------------------------------------------------------------------------ what to do next


def test_a_promise_that_was_kept_calls_for_nothing(good):
    arm, fresh, _, _ = good
    assert "Next:" not in verify(arm, fresh).summary()


def rejected(found):
    return dataclasses.replace(found, decision=dataclasses.replace(found.decision, verdict="reject"))


def test_what_to_do_next_follows_from_what_is_off(good):
    """One row, one face, the arm, or all of it: each was changed by hand, and the last sentence says what to do."""
    arm, fresh, x, _ = good
    _, bound, *_ = drawn("hsr_jr680")
    rng = np.random.default_rng(10)

    def elsewhere(**changes):
        there = x.copy()
        for name, by in changes.items():
            there[bound.names.index(name.replace("__", "."))] += by
        return halves(touched("hsr_jr680", there, rng))[1]

    reading = fresh.columns["reading"].copy()
    reading[4] += 0.4
    on_wall = np.array([label == "wall" for label in fresh.labels["plane"]])
    rough = fresh.columns["reading"] + on_wall * rng.normal(0, 0.05, len(fresh))
    standing = ["floor", "wall", "side"]
    wrong = {
        "measure this row again": verify(arm, dataclasses.replace(fresh, columns={"reading": reading})),
        "only 'wall' does not agree. That face has moved": verify(
            arm, elsewhere(plane__wall__offset=0.1), standing=standing
        ),
        "only 'wall' does not agree. That face may have moved during": verify(
            arm, dataclasses.replace(fresh, columns={"reading": rough})
        ),
        "looks for mistakes in these rows": verify(
            arm, dataclasses.replace(fresh, columns={"reading": -fresh.columns["reading"]})
        ),
        "not with the arm as calibrated": dataclasses.replace(verify(arm, fresh), p=0.4, arm_p=1e-3),
        "calibrate with old and new rows": rejected(verify(arm, fresh, tolerance=1e-3)),
    }
    for words, found in wrong.items():
        *_, last = found.summary().split("\n")
        assert last.startswith("Next: "), words
        assert words in last


@pytest.fixture(scope="module")
def by_command(tmp_path_factory):
    """A calibration, fresh rows of its arm, and rows of another arm, all in files."""
    folder, hsr = tmp_path_factory.mktemp("verify"), str(ROOT / "problems" / "hsr_jr680")
    assert main(["simulate", hsr, "--out", str(folder / "all.csv"), "--samples", "180", "--seed", "21"]) == 0
    lines = (folder / "all.csv").read_text(encoding="utf-8").splitlines()
    start = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    for name, rows in (("fit", lines[start + 1 : start + 121]), ("fresh", lines[start + 121 :])):
        (folder / f"{name}.csv").write_text("\n".join([lines[start], *rows]) + "\n", encoding="utf-8")
    found = calibrate(hsr, folder / "fit.csv", method="lm", reference=False)
    write_json(folder / "result.json", found.to_dict())
    assert main(["simulate", hsr, "--out", str(folder / "other.csv"), "--samples", "60", "--seed", "22"]) == 0
    return folder


@pytest.fixture
def run(capsys):
    def call(*arguments):
        code = main(["verify", *arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


@pytest.mark.long
def test_the_command_says_kept_or_not_and_exits_so(by_command, run):
    result, fresh = str(by_command), str(by_command / "fresh.csv")
    code, out, _ = run(result, fresh)
    assert code == 0
    assert out.startswith("Promise kept: 60 fresh rows of")
    assert "Small residuals are not accuracy" in out
    assert "could remain unseen" in out
    assert run(result, fresh, "--tolerance", "0.001")[0] == 1
    code, out, _ = run(result, fresh, "--standing", "floor,wall", "--standing", "side", "--json", "--tolerance", "1")
    document = json.loads(out)
    assert code == 0
    assert (document["freedom"], document["decision"]["verdict"]) == (60, "accept")
    assert document["chi_square"] == pytest.approx(verify(result, fresh, standing=["floor", "wall", "side"]).chi_square)
    code, out, _ = run(result, str(by_command / "other.csv"))
    assert code == 1
    assert out.startswith("Promise not kept: the residuals of 60 fresh rows")
    assert "could hide" not in out


def test_rows_that_do_not_say_which_face_they_are_on_are_told_so(by_command, run, tmp_path):
    bare = pd.read_csv(by_command / "fresh.csv")
    said = "The rows have no column 'plane' and count as one, while the calibration knows floor, side and wall"
    assert said not in " ".join(run(str(by_command), str(by_command / "fresh.csv"))[1].split())
    bare.drop(columns="plane").to_csv(tmp_path / "bare.csv", index=False)
    code, out, _ = run(str(by_command), str(tmp_path / "bare.csv"))
    assert code == 1
    assert said in " ".join(out.split())


@pytest.mark.long
def test_the_command_refuses_in_one_line(by_command, run):
    result, fresh = str(by_command), str(by_command / "fresh.csv")
    for arguments, says in (
        ((result, str(by_command / "fit.csv")), "say nothing new"),
        ((result, "none.csv"), "no such file"),
        ((result, " "), "SAMPLES is empty"),
        (("nowhere", fresh), "no such file"),
        ((result, fresh, "--problem", str(ROOT / "problems" / "ur5")), "is not the calibrated one"),
        ((result, fresh, "--tolerance", "-1"), "The tolerance is -1"),
    ):
        code, out, err = run(*arguments)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert says in err


def test_the_truth_of_a_simulation_keeps_its_promise(by_command, capsys):
    assert main(["verify", str(by_command / "other.truth.json"), str(by_command / "other.csv")]) == 0
    said = capsys.readouterr().out
    assert "Promise kept" in said
    assert "this is the true arm of a simulation, not a calibration" in said


def test_a_result_that_must_not_be_used_says_so(by_command, capsys):
    document = json.loads((by_command / "result.json").read_text(encoding="utf-8"))
    document["verdict"] = {"level": "do not use", "words": "Do not use this result: it is spoiled.", "reasons": []}
    spoiled = by_command / "spoiled.json"
    spoiled.write_text(json.dumps(resealed(document)), encoding="utf-8")
    assert main(["verify", str(spoiled), str(by_command / "fresh.csv")]) == 0
    out = capsys.readouterr().out
    assert "The result's own verdict: Do not use this result" in out
    assert "hide" not in out
    assert main(["verify", str(spoiled), str(by_command / "fresh.csv"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["promised_tip_mm"] is None


def test_noise_that_was_found_is_what_is_expected(by_command, capsys):
    document = json.loads((by_command / "result.json").read_text(encoding="utf-8"))
    document["discrepancy"] = None  # effects would add their own to both
    (by_command / "quiet.json").write_text(json.dumps(resealed(document)), encoding="utf-8")
    sizes = {name: {"stated_mm": 0.01, "used_mm": 0.03} for name in ("floor", "wall", "side")}
    document["noise"] = {"ratio": 3.0, "low": 2.6, "high": 3.5, "by_face": sizes}
    document["covariance"] = (9 * np.array(document["covariance"])).tolist()
    louder = by_command / "louder.json"
    louder.write_text(json.dumps(resealed(document)), encoding="utf-8")
    plain, found = (verify(by_command / name, by_command / "fresh.csv") for name in ("quiet.json", "louder.json"))
    assert found.predicted_mm == pytest.approx(3 * plain.predicted_mm, rel=0.1)
    assert found.chi_square < plain.chi_square / 5
    # what every face showed beside the dial, a tracker sees too; what one face showed is that face's own
    _, bound, *_ = drawn("hsr_jr680")
    problem = Problem(bound.problem.robot, TrackedPoint(noise_std=0.01, tool=tool_point(20.0, 10.0, 60.0, free=False)))
    rows = tracked(bound, bound.x0, np.array([20.0, 10.0, 60.0]), np.random.default_rng(17))
    everywhere = verify(louder, rows, problem=problem)
    document["noise"]["by_face"]["side"]["used_mm"] = 0.01
    louder.write_text(json.dumps(resealed(document)), encoding="utf-8")
    one = verify(louder, rows, problem=problem)
    assert everywhere.predicted_mm**2 - one.predicted_mm**2 == pytest.approx(3 * 0.0008, rel=0.1)
    for damaged in (
        {"ratio": 1},
        {"by_face": sizes, "low": "2"},
        {"by_face": {"floor": {"stated_mm": 0, "used_mm": 1}}},
        {"by_face": {"floor": 3}},
    ):
        document["noise"] = damaged
        louder.write_text(json.dumps(resealed(document)), encoding="utf-8")
        assert main(["verify", str(louder), str(by_command / "fresh.csv")]) == 2
        assert "its 'noise" in capsys.readouterr().err
