"""An earlier result as the prior of new rows: against a dense solve, the true tip, the file, and the command lines."""

import dataclasses
import json
import math
import re
from functools import cache

import numpy as np
import pytest
from conftest import ROOT
from scipy.optimize import least_squares
from scipy.stats import chi2
from test_changed import calibration, cell_of, off, robot, touched

from casacal import (
    CasacalError,
    Conventions,
    Problem,
    Robot,
    TrackedPoint,
    bind,
    calibrate,
    changed,
    load,
    load_problem,
    simulate,
    tool_point,
    verify,
)
from casacal.calibration.fresh import JOINTS, joint_direction, shift_columns, with_shifts
from casacal.cli.main import main
from casacal.data.samples import write_samples
from casacal.deployment import CalibratedArm, read_result
from casacal.files import write_json
from casacal.fit.filters import sckf
from casacal.fit.least_squares import Gaussian, LeastSquares
from casacal.fit.lm import lm
from casacal.kernels.losses import huber
from casacal.simulation.simulate import simulate_one
from casacal.simulation.touches import Draw
from casacal.uncertainty.tip_error import tip_rms, without_rigid, workspace_joints

HSR = str(ROOT / "problems" / "hsr_jr680")


@cache
def plain(seed=3):
    """A calibration of geometry alone, with the noise as stated: what a dense solve can follow."""
    source, cell, _ = robot("hsr_jr680")
    rows = simulate(source.problem, cell, samples=120, seed=seed).samples
    return calibrate(source.problem, rows, reference=False, noise="stated", discrepancy="none", method="lm").arm


def values(document):
    return {row["name"]: row["estimate"] - row["nominal"] for row in document["parameters"]}


def dense(arm, rows, free=None):
    """All that the result knows and its covariance by SciPy: old covariance as the prior, planes of the rows free."""
    bound = bind(arm.source.problem, rows)
    names = arm.document.get("covariance_of") or [row["name"] for row in arm.document["unknowns"]]
    arms = [name for name in bound.names if not name.startswith("plane")]
    keys = [*arms, *(name for name in names if name not in bound.names)]
    places = [names.index(name) for name in keys]
    covariance = np.array(arm.document["covariance"], dtype=float)[np.ix_(places, places)]
    weight = np.linalg.inv(np.linalg.cholesky(covariance))
    known = {row["name"]: row["value"] for row in arm.document["unknowns"]}
    was, count, of_arm = np.array([known[name] for name in keys]), len(keys), len(arms)
    step = np.zeros(count)
    if free is not None:
        step[keys.index(free)] = 1.0

    def misses(state):
        away = state[:count] - was - step * (state[-1] if free else 0.0)
        x = np.concatenate([state[:of_arm], state[count : count + bound.unknowns - of_arm]])
        return np.concatenate([bound.residual(x), weight @ away])

    start = np.concatenate([was, np.zeros(bound.unknowns - of_arm + (free is not None))])
    scale = np.concatenate(
        [
            bound.start_std[:of_arm],
            np.full(count - of_arm, 1e-2),
            bound.start_std[of_arm:],
            np.full(int(free is not None), 1e-3),
        ]
    )

    def slopes(z):  # by steps of a size of their own: SciPy's are parts of z, which may be nothing
        steps = 1e-3 * np.eye(z.size)
        return np.stack([(misses((z + h) * scale) - misses((z - h) * scale)) / 2e-3 for h in steps], axis=1)

    found = least_squares(
        lambda z: misses(z * scale), start / scale, slopes, method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    spread = np.linalg.inv(found.jac.T @ found.jac) * np.outer(scale, scale)
    return dict(zip(keys, (found.x * scale)[:count], strict=True)), spread[:count, :count]


PLAIN = {"reference": False, "noise": "stated", "discrepancy": "none", "method": "lm"}


def since(name, rows, arm, **given):
    """New rows with an earlier result as their prior."""
    return calibrate(robot(name)[0], rows, prior=arm, reference=False, **given)


@pytest.mark.parametrize(("joint", "shift"), [(None, 0.0), (3, 2e-3)])
def test_it_is_the_minimum_that_a_dense_solve_finds(joint, shift):
    rows = touched("hsr_jr680", 40, session=2, joint=joint, shift=shift)
    loosen = () if joint is None else (f"joint{joint + 1}",)
    new = calibrate(robot("hsr_jr680")[0], rows, prior=plain(), loosen=loosen, **PLAIN)
    found, spread = dense(plain(), rows, free=None if joint is None else f"theta{joint + 1}")
    mine, places = dict(zip(new.fit.names, new.x, strict=True)), list(new.fit.names)
    names = [name for name in found if name in places and not name.startswith("plane")]
    assert len(names) > 20
    keys = list(found)
    index = [keys.index(name) for name in names]
    stds = np.sqrt(np.diag(spread))[index]
    for name, std in zip(names, stds, strict=True):
        assert abs(mine[name] - found[name]) < 2e-3 * std, name
    here = [places.index(name) for name in names]
    covariance = new.result.covariance[np.ix_(here, here)] / np.outer(stds, stds)
    np.testing.assert_allclose(covariance, spread[np.ix_(index, index)] / np.outer(stds, stds), atol=1e-2)


def test_what_was_known_beside_the_geometry_is_part_of_the_prior():
    """Gears, give and play with their covariance with the geometry, as the first fit left them all."""
    _, _, first = calibration("hsr_jr680")
    new = since("hsr_jr680", touched("hsr_jr680", 20), first, standing=["plane"])
    places = {name: j for j, name in enumerate(first.fit.names)}
    kept = [j for j, key in enumerate(new.fit.beside) if key in ("", "wave1", "wave2", "give", "play")]
    there = [places[new.fit.names[j]] for j in kept]
    assert len(kept) > new.fit.beside.count("")
    np.testing.assert_allclose(new.fit.x0[kept], first.result.x[there], atol=1e-12)
    covariance = new.fit.prior_covariance[np.ix_(kept, kept)]
    np.testing.assert_allclose(covariance, first.result.covariance[np.ix_(there, there)], rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize("standing", [(), ("plane",)])
def test_the_chance_of_the_rows_is_that_of_their_dense_covariance(standing):
    """Rows are normal about what the earlier result expects, with the covariance I + J C J'; faces anew are free."""
    rows = touched("hsr_jr680", 40, session=14)
    new = calibrate(robot("hsr_jr680")[0], rows, prior=plain(), standing=standing, **PLAIN)
    fit, covariance = new.fit, new.fit.prior_covariance
    held = np.isfinite(np.diag(covariance))
    assert held.sum() == fit.unknowns - (0 if standing else 9)
    r, j = fit.residual(fit.x0), fit.jacobian(fit.x0)
    beside = np.linalg.svd(j[:, ~held])[0][:, fit.unknowns - int(held.sum()) :] if not standing else np.eye(len(r))
    inside = beside.T @ (np.eye(len(r)) + j[:, held] @ covariance[np.ix_(held, held)] @ j[:, held].T) @ beside
    left = beside.T @ r
    expected = chi2.sf(left @ np.linalg.solve(inside, left), len(left))
    assert new.earlier_chance == pytest.approx(expected, rel=0.05)
    assert 1e-3 < expected < 0.999


def test_old_rows_and_new_are_one_fit_where_all_is_linear():
    """Against one fit of both: to 1e-6 where residuals are linear in the unknowns."""
    rng = np.random.default_rng(0)
    first, second = (Linear(rng.normal(size=(30, 5)), rng.normal(size=30)) for _ in range(2))
    told = lm(first)
    both = lm(Linear(np.vstack([first.slopes, second.slopes]), np.concatenate([first.heights, second.heights])))
    second.known = Gaussian(second.names, told.x, told.covariance)
    second.x0 = told.x
    found = lm(second)
    np.testing.assert_allclose(found.x, both.x, atol=1e-9)
    np.testing.assert_allclose(found.covariance, both.covariance, atol=1e-9)
    filtered = sckf(second)
    np.testing.assert_allclose(filtered.x, both.x, atol=1e-9)
    np.testing.assert_allclose(filtered.covariance, both.covariance, atol=1e-9)


class Linear(LeastSquares):
    """r = A x - y."""

    def __init__(self, slopes, heights):
        n = slopes.shape[1]
        self.slopes, self.heights = slopes, heights
        self.names, self.units = tuple("abcde"[:n]), ("mm",) * n
        self.x0, self.prior_std, self.start_std = np.zeros(n), np.ones(n), np.ones(n)
        self.datum = np.zeros(n, dtype=bool)

    @property
    def rows(self):
        return len(self.heights)

    def residual(self, x):
        return self.slopes @ x - self.heights

    def jacobian(self, x):
        return self.slopes

    def row(self, k, states):
        return states @ self.slopes[k] - self.heights[k]

    def row_jacobian(self, k, x):
        return float(self.slopes[k] @ x - self.heights[k]), self.slopes[k]


def true_error(name, arm, joint, shift):
    """Of the tip over the workspace, mm RMS apart from the base: the true arm, whose joint stands elsewhere."""
    source, cell = cell_of(name)
    sim = simulate(source.problem, cell, samples=120, seed=3)
    joints = workspace_joints(source.problem.robot)
    moved = joints.copy()
    moved[:, joint] += shift
    tips = sim.true_tips(moved)
    return tip_rms(without_rigid((arm.predict(joints, frame="tip").positions - tips).ravel(), tips))


@pytest.mark.long_unless("hsr_jr680-2-0.008")
@pytest.mark.parametrize(("name", "joint", "shift"), [("hsr_jr680", 2, 8e-3), ("ur5", 1, 8e-3)])
def test_a_loosened_joint_brings_the_true_tip_back(name, joint, shift, tmp_path):
    rows = touched(name, 40, session=3, joint=joint, shift=shift)
    arm = robot(name)[2]
    found = changed(arm, rows, standing=["plane"])
    assert found.changed, found.summary()
    assert f"--loosen joint{joint + 1} --standing plane)" in " ".join(found.summary().split())
    new = since(name, rows, arm, standing=["plane"], loosen=[f"joint{joint + 1}"])
    new.save(tmp_path / "new")
    before = true_error(name, load_of(arm), joint, 0.0)
    lost, now = (true_error(name, each, joint, shift) for each in (load_of(arm), new))
    assert lost > 3 * before
    assert now < 1.3 * before
    assert now < 3 * new.tip_std[1]
    again = load(tmp_path / "new")
    assert true_error(name, again, joint, shift) == pytest.approx(now, rel=1e-6)
    later = touched(name, 40, session=4, joint=joint, shift=shift)
    assert verify(again, later, standing=["plane"]).kept
    assert changed(again, later, standing=["plane"]).ended == "nothing"
    assert not verify(arm, later, standing=["plane"]).kept
    assert "WARNING" not in again.export("dh")
    assert again.to_dict()["verdict"]["level"] == "use with care"
    assert "no fresh rows have verified since" in again.to_dict()["verdict"]["words"]


@pytest.mark.parametrize("loosen", [(), ("joint5",), ("alpha",)])
def test_what_changed_and_was_not_loosened_is_refused(loosen):
    """An encoder zero that slipped by half a degree: rows contradict what was known, and nothing is promised."""
    rows = touched("hsr_jr680", 40, session=3, joint=2, shift=8e-3)
    new = since("hsr_jr680", rows, robot("hsr_jr680")[2], standing=["plane"], loosen=loosen)
    assert not new.success
    assert "contradict the earlier result" in new.arm.verdict["words"]
    assert math.isnan(new.tip_std[1])


def load_of(arm):
    from casacal.calibration.saved import SavedCalibration

    return SavedCalibration(arm)


def test_where_nothing_changed_it_is_known_better(tmp_path):
    source, cell, arm = robot("hsr_jr680")
    rows = touched("hsr_jr680", 60, session=5)
    new = since("hsr_jr680", rows, arm)
    new.save(tmp_path)
    document = load(tmp_path).to_dict()
    assert document["tip"]["expected_rms_mm"] < arm.document["tip"]["expected_rms_mm"]
    assert document["verdict"]["level"] == "calibrated"
    assert document["earlier"]["chance"] > 0.01
    old = {row["name"]: row["std"] for row in arm.document["parameters"]}
    assert all(row["std"] <= old[row["name"]] * (1 + 1e-9) for row in document["parameters"])
    assert document["data"]["fitted_rows"]["rows"] == 180
    for some in (rows, simulate(source.problem, cell, samples=120, seed=3).samples):
        with pytest.raises(CasacalError, match="calibrated from"):
            changed(tmp_path, some)
        with pytest.raises(CasacalError, match="calibrated from"):
            calibrate(source, some, prior=tmp_path)
    wide = since("hsr_jr680", rows, arm, loosen={"theta": 1e-3, "alpha": 1e-3})
    assert wide.tip_std[1] > new.tip_std[1]


def test_few_rows_that_alone_say_nothing_are_enough():
    """Twelve touches, fewer than there are unknowns: with the earlier result they are a calibration."""
    source, _, arm = robot("hsr_jr680")
    rows = touched("hsr_jr680", 12, session=6)
    with pytest.raises(CasacalError, match="rows are fitted for"):
        calibrate(source, rows, reference=False)
    new = since("hsr_jr680", rows, arm, standing=["plane"])
    assert new.success, new.arm.verdict
    assert new.tip_std[1] < arm.document["tip"]["expected_rms_mm"]


@pytest.mark.long
def test_a_face_that_moved_is_fitted_anew_and_others_stay():
    _, _, arm = robot("hsr_jr680")
    moves = []
    for session in (1, 2, 3):  # where a face stands is known to 0.2 mm from one session: their mean is nearer
        rows = touched("hsr_jr680", 45, session=session)
        readings = rows.columns["reading"].copy()
        readings[[label == "wall" for label in rows.labels["plane"]]] += 0.4
        rows = dataclasses.replace(rows, columns={"reading": readings})
        assert not since("hsr_jr680", rows, arm, standing=["floor", "wall", "side"]).success
        new = since("hsr_jr680", rows, arm, standing=["floor", "side"]).to_dict()
        old = arm.document["planes"]
        moves.append(
            [
                np.dot(np.subtract(new["planes"][label]["point_mm"], old[label]["point_mm"]), old[label]["normal"])
                for label in ("wall", "floor", "side")
            ]
        )
    wall, floor, side = np.abs(np.mean(moves, axis=0))
    assert wall == pytest.approx(0.4, abs=0.1)
    assert max(floor, side) < 0.1


def test_a_row_that_is_off_is_set_aside():
    rows = touched("hsr_jr680", 24, session=10)
    place = rows.lines.index(6)
    new = since("hsr_jr680", off(rows, place, 1.0), robot("hsr_jr680")[2], standing=["plane"])
    assert new.aside_lines == (6,)
    assert new.success
    kept = since("hsr_jr680", off(rows, place, 1.0), robot("hsr_jr680")[2], standing=["plane"], outliers="keep")
    assert not kept.success


def test_what_is_no_prior_is_refused():
    source, _, arm = robot("hsr_jr680")
    rows = touched("hsr_jr680", 24, session=10)
    held = source.problem.fix("theta3")
    ur5 = robot("ur5")[2]
    for problem, given, said in (
        (held, {"prior": arm}, "'theta3', which is free in the other"),
        (source, {"prior": ur5}, "is not the calibrated one"),
        (source, {"prior": arm, "loosen": "joint3"}, "Got the text 'joint3' as the list to loosen"),
        (source, {"prior": arm, "loosen": ["joint9"]}, "joint9"),
        (source, {"prior": arm, "loosen": ["tool"]}, "'tool' may have changed, but this problem holds it"),
        (source, {"prior": arm, "loosen": {"theta": -1.0}}, "The drift of 'theta' is -1.0"),
        (source, {"prior": arm, "standing": ["ceiling"]}, "ceiling"),
        (source, {"prior": 3}, "as the earlier result"),
        (source, {"prior": arm, "loss": huber()}, "Got a loss beside an earlier result"),
        (source, {"loosen": ["joint3"]}, "without an earlier result"),
        (source, {"standing": ["floor"]}, "without an earlier result"),
    ):
        with pytest.raises(CasacalError, match=re.escape(said)):
            calibrate(problem, rows, **given)
    with pytest.raises(CasacalError, match="it is no prior"):
        calibrate(source, rows, prior=refused(arm))
    true = CalibratedArm(arm.file, arm.source, {**arm.document, "method": "truth"})
    with pytest.raises(CasacalError, match="a true arm is not estimated"):
        calibrate(source, rows, prior=true)


def test_another_tool_is_found_on_an_arm_that_is_known():
    """Held by the earlier calibration, free now: fitted to these rows. The other way round it would be forgotten."""
    source, cell, arm = robot("hsr_jr680")
    dial = source.problem.instrument
    drawn, stands = (tool_point(*place, prior_std=1.0) for place in ((0, 0, 0), (0.7, -0.5, 0.3)))
    bent = Problem(
        source.problem.robot, dataclasses.replace(dial, tool=dataclasses.replace(dial.tool, values=stands.values))
    )
    rows = simulate_one(bent, cell, 60, Draw(3, session=5)).samples
    assert not since("hsr_jr680", rows, arm, standing=["plane"]).success
    free = Problem(source.problem.robot, dataclasses.replace(dial, tool=drawn))
    new = calibrate(free, rows, prior=arm, standing=["plane"], reference=False)
    assert new.success, new.arm.verdict
    places = [new.fit.names.index(f"tool_{axis}") for axis in "xyz"]
    off = new.x[places] - np.array([0.7, -0.5, 0.3])
    assert (np.abs(off) < 4 * new.std[places]).all()
    with pytest.raises(CasacalError, match="this problem holds 'tool_x', which is free in the other"):
        calibrate(source, touched("hsr_jr680", 24, session=10), prior=new, reference=False)


def test_a_method_that_does_not_arrive_says_nothing_of_the_rows():
    rows, arm = touched("hsr_jr680", 24, session=10), robot("hsr_jr680")[2]
    there, elsewhere = (
        since("hsr_jr680", rows, arm, standing=["plane"], method=method) for method in ("lm", "plane-only")
    )
    assert elsewhere.result.cost > 1.01 * there.result.cost
    assert elsewhere.earlier_chance == pytest.approx(there.earlier_chance)


def test_infinitely_loose_is_loosened_without_a_number():
    rows, arm = touched("hsr_jr680", 24, session=10), robot("hsr_jr680")[2]
    both = (
        since("hsr_jr680", rows, arm, standing=["plane"], loosen=each) for each in ({"theta3": math.inf}, ["theta3"])
    )
    np.testing.assert_array_equal(*(each.x for each in both))


def test_effects_that_were_corrected_stay_so():
    _, _, first = calibration("hsr_jr680")
    new = since("hsr_jr680", touched("hsr_jr680", 20), first, standing=["plane"])
    assert new.tried
    assert new.corrected == first.corrected
    for keys in ((), ("give",), ("give", "wave1")):
        was = dataclasses.replace(new.earlier, corrected=keys)
        assert {each.key for each in was.tried(new.fit, new.result) if each.corrected} == set(keys)


def refused(arm):
    """The same arm, were its verdict not to use it."""
    words = {"level": "do not use", "words": "Do not use this result: it is wrong.", "reasons": []}
    return CalibratedArm(arm.file, arm.source, {**arm.document, "verdict": words})


@pytest.mark.long
def test_a_joint_without_an_unknown_of_its_own_is_said():
    source, cell, _ = robot("hsr_jr680")
    rows = simulate(source.problem, cell, samples=120, seed=3).samples
    held = calibrate(source.problem.fix("theta3", "d1"), rows, reference=False, discrepancy="none").arm
    shifted = touched("hsr_jr680", 60, session=3, joint=2, shift=60e-3)
    found = changed(held, shifted, standing=["plane"])
    assert found.ended == "changed"
    with pytest.raises(CasacalError, match="no free unknown"):
        calibrate(held.source, shifted, prior=held, standing=["plane"], loosen=["joint3"])


@pytest.mark.parametrize("name", ["hsr_jr680", "ur5", "adept_cobra600"])
def test_a_joint_shifts_along_its_own_offset(name):
    """In a DH table: theta of a joint that turns, d of one that slides, by the joint's sign."""
    source, cell = cell_of(name)
    rows = simulate(source.problem, cell, samples=40, seed=1).samples
    bound = with_shifts(bind(source.problem, rows))
    keys = source.problem.robot.parameters
    arm = np.zeros(bound.unknowns, dtype=bool)
    for slot in bound.slots:
        arm[slot.columns] = slot.key in keys
    for i, (axis, column) in enumerate(zip(source.problem.robot.axes, shift_columns(bound, JOINTS), strict=True)):
        way = joint_direction(bound, bound.x0, int(column), arm)
        if way is None:
            continue
        named = {bound.names[j] for j in np.flatnonzero(way)}
        if len(named) == 1:
            assert named <= {f"{'theta' if axis.turns else 'd'}{i + 1}", "zero"}
            assert way[np.flatnonzero(way)] == pytest.approx(1.0)


@pytest.mark.long
def test_a_joint_that_counts_backwards_or_moves_another_shifts_them():
    """Signs, and a third joint that is measured against the ground: two offsets for one shift."""
    lengths = {"a": (250.0, 900.0, -206.0, 0, 0, 0), "d": (653.0, 0, 0, 1030.0, 0, 200.0)}
    turns = {"alpha": np.radians([-90, 0, 90, -90, 90, 0]).tolist(), "theta": [0.0, -1.5, 3.0, 0, 1.5, 0]}
    how = Conventions((1, -1, 1, 1, 1, -1), (0.0,) * 6, ((3, 2, -1.0),))
    arm = Robot.from_dh("backwards", **lengths, **turns, conventions=how)
    problem = Problem(arm, TrackedPoint(noise_std=0.05, tool=tool_point(40, 10, 30)))
    bound = with_shifts(bind(problem, simulate(problem, samples=30, seed=1).samples))
    of_arm = np.zeros(bound.unknowns, dtype=bool)
    for slot in bound.slots:
        of_arm[slot.columns] = slot.key in arm.parameters
    wanted = [{1: 1.0}, {2: -1.0, 3: -1.0}, {3: 1.0}, {4: 1.0}, {5: 1.0}, {6: -1.0}]
    for column, offsets in zip(shift_columns(bound, JOINTS), wanted, strict=True):
        way = joint_direction(bound, bound.x0, int(column), of_arm)
        found = {bound.names[j]: way[j] for j in np.flatnonzero(np.abs(way) > 1e-6)}
        assert found == pytest.approx({f"theta{i}": size for i, size in offsets.items()}, rel=1e-6)


# ------------------------------------------------------------------------------------------------ the command


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a result, fresh rows of the same arm, and of one whose joint has shifted."""
    folder = tmp_path_factory.mktemp("changed")
    source, _, found = calibration("hsr_jr680")
    (folder / "first").mkdir()
    write_json(folder / "first" / "result.json", found.to_dict())
    write_samples(folder / "same.csv", source.problem.layout(), touched("hsr_jr680", 24, session=11), [])
    other = touched("hsr_jr680", 40, session=12, joint=3, shift=2e-3)
    write_samples(folder / "other.csv", source.problem.layout(), other, [])
    return folder


@pytest.mark.long
def test_the_command_says_it_and_ends_as_it_should(place, capsys):
    result = str(place / "first")
    assert main(["changed", result, str(place / "same.csv")]) == 0
    assert capsys.readouterr().out.startswith("No change found: 24 fresh rows")
    assert main(["changed", result, str(place / "other.csv"), "--alarm", "0.05"]) == 1
    told = capsys.readouterr().out
    assert told.startswith("Changed: the zero of joint 4, by +")
    assert "5 %" in told
    assert main(["changed", result, str(place / "other.csv"), "--json"]) == 1
    answer = json.loads(capsys.readouterr().out)
    assert answer["ended"] == "changed"
    assert answer["changed"] is True
    assert answer["written"] == []
    since = ["calibrate", HSR, str(place / "other.csv"), "--prior-from", result]
    assert main([*since, "--loosen", "joint4", "--out", str(place / "new")]) == 0
    assert "joint4 may have changed" in " ".join(capsys.readouterr().out.split())
    new = read_result(place / "new")
    assert new.document["earlier"]["result"] == "../first/result.json"
    assert new.document["earlier"]["loosened"] == {"joint4": None}
    assert new.document["data"]["file"] == "../other.csv"
    assert main(since) == 1, "a joint has shifted"
    assert "contradict the earlier result" in " ".join(capsys.readouterr().out.split())
    assert main(["changed", str(place / "new"), str(place / "same.csv")]) == 1, "it is another arm now"
    capsys.readouterr()
    assert main(["predict", str(place / "new"), str(place / "same.csv"), "--std", "--out", str(place / "p.csv")]) == 0
    assert main(["changed", result, str(place / "other.csv"), "--drift", "theta4=5e-3"]) == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--loosen", "joint3"], "without --prior-from"),
        (["--standing", "floor"], "without --prior-from"),
        (["--prior-from", "nowhere"], "nowhere"),
        (["--prior-from", "first", "--prior", "a3=1"], "how good the drawing is"),
        (["--prior-from", "first", "--accuracy", "1"], "how good the drawing is"),
        (["--prior-from", "first", "--loosen", "theta=wide"], "--loosen theta=wide is not NAME=STD"),
        (["--prior-from", "first", "--loosen", "joint9"], "joint9"),
        (["--prior-from", "first", "--fix", "theta3"], "which is free in the other"),
        (["--prior-from", "first", "--out", "first"], "what the command reads"),
    ],
)
def test_what_cannot_be_a_prior_is_one_sentence(place, words, said, capsys, monkeypatch):
    monkeypatch.chdir(place)
    before = (place / "first" / "result.json").read_bytes()
    assert main(["calibrate", HSR, "same.csv", *words]) == 2
    told = capsys.readouterr()
    assert said in told.err
    assert told.err.count("\n") == 1
    assert (place / "first" / "result.json").read_bytes() == before


def test_touches_are_not_written_where_none_are_needed(place, capsys):
    out = place / "touches.csv"
    assert main(["changed", str(place / "first"), str(place / "same.csv"), "--touches", str(out)]) == 0
    assert "was not written" in capsys.readouterr().out
    assert not out.exists()


@pytest.mark.long
def test_touches_that_tell_are_written_as_a_plan(place, capsys):
    source, _, arm = robot("hsr_jr680")
    for session in range(1, 40):
        rows = touched("hsr_jr680", 15, session=session, joint=2, shift=1.6e-3)
        if changed(arm, rows, touches=6).touches is not None:
            break
    write_samples(place / "few.csv", source.problem.layout(), rows, [])
    out = place / "tell.csv"
    assert main(["changed", str(place / "first"), str(place / "few.csv"), "--touches", str(out)]) == 1
    assert f"Written: {out.as_posix()}" in capsys.readouterr().out.replace("\n", " ").replace("  ", " ")
    lines = out.read_text(encoding="utf-8").splitlines()
    assert lines[0].startswith("# touches that would settle what changed")
    header = next(line for line in lines if not line.startswith("#"))
    assert header.startswith("touch,purpose,q1_deg")
    assert "expected_reading_mm" in header
    assert sum(line.split(",")[1] == "fit" for line in lines if "," in line and not line.startswith("#")) == 6
    assert main(["changed", str(place / "first"), str(out)]) == 2, "a plan is no measurement"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nowhere", "same.csv"], "no such file"),
        (["first", "nowhere.csv"], "nowhere.csv"),
        (["first", ""], "SAMPLES is empty"),
        (["same.csv", "same.csv"], "not a result"),
        (["first", "empty.csv"], "empty.csv"),
        (["first", "same.csv", "--alarm", "1"], "false alarm rate"),
        (["first", "same.csv", "--alarm", "one"], "alarm"),
        (["first", "same.csv", "--drift", "theta4"], "--drift theta4 is not NAME=STD"),
        (["first", "same.csv", "--drift", "thetta=1e-5"], "thetta"),
        (["first", "same.csv", "--standing", "ceiling"], "ceiling"),
        (["first", "same.csv", "--standing", ","], "--standing is empty"),
        (["first", "same.csv", "--instrument", "tracker"], "tracker"),
        (["first", "same.csv", "--touches", "same.csv"], "what the command reads"),
        (["first", "same.csv", "--problem", "UR5"], "not the calibrated one"),
    ],
)
def test_bad_input_is_one_sentence(place, words, said, capsys, monkeypatch):
    monkeypatch.chdir(place)
    (place / "empty.csv").write_text("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,reading_mm,plane\n", encoding="utf-8")
    before = sorted(path.name for path in place.rglob("*"))
    words = [str(ROOT / "problems" / "ur5") if word == "UR5" else word for word in words]
    assert main(["changed", *words]) == 2
    told = capsys.readouterr()
    assert said in told.err
    assert told.out == ""
    assert told.err.count("\n") == 1
    assert sorted(path.name for path in place.rglob("*")) == before


# ------------------------------------------------------------------------------------------------ beside the geometry


@pytest.mark.long
def test_what_is_corrected_stays_so_and_is_known_better(tmp_path):
    """A small arm that sags, whose give is corrected: its value and its covariance follow the rows."""
    source = load_problem(ROOT / "problems" / "ur5")
    soft = dataclasses.replace(source.cell, compliance=0.3)
    made = simulate(source.problem, soft, samples=120, seed=1)
    old = calibrate(source, made.samples, reference=False).arm
    assert old.document["discrepancy"]["corrected"] == ["give"]
    rows = simulate(source.problem, soft, samples=60, seed=1).samples
    found = changed(old, rows, standing=["plane"])
    assert found.ended == "nothing", found.summary()
    new = calibrate(source, rows, prior=old, standing=["plane"], reference=False)
    new.save(tmp_path)
    assert new.corrected == ("give",)
    before, after = (arm.document["discrepancy"] for arm in (old, load(tmp_path).arm))
    was, now = ({row["name"]: row["value"] for row in part["unknowns"]} for part in (before, after))
    stds = [
        dict(zip(part["covariance_of"], np.sqrt(np.diag(np.array(part["covariance"], dtype=float))), strict=True))
        for part in (before, after)
    ]
    give = [row["name"] for row in before["unknowns"] if row["effect"] == "give" and row["value"]]
    assert give
    for name in give:
        assert now[name] != was[name]
        assert abs(now[name] - was[name]) < 4 * stds[0][name]
        assert stds[1][name] < stds[0][name]
    joints = workspace_joints(source.problem.robot)
    tips = made.true_tips(joints)
    errors = [
        tip_rms(without_rigid((load_of(arm).predict(joints, frame="tip").positions - tips).ravel(), tips))
        for arm in (old, load(tmp_path).arm)
    ]
    assert errors[1] < 1.2 * errors[0]
    later = simulate(source.problem, soft, samples=72, seed=1).samples
    assert verify(tmp_path, later).kept
    assert (
        new.predict(joints, frame="tip", std=True).std.mean()
        < load_of(old).predict(joints, frame="tip", std=True).std.mean()
    )
