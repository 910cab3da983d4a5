"""Has the robot changed: false alarms as asked, the joint that shifted, tool, base, faces, rows that are off, words."""

import dataclasses
import json
import pickle
from functools import cache

import numpy as np
import pytest
from conftest import ROOT
from scipy.linalg import null_space
from scipy.stats import binom, chi2, f
from seals import resealed

from casacal import CasacalError, Problem, TrackedPoint, bind, calibrate, changed, load_problem, simulate, tool_point
from casacal.calibration.fresh import opened, with_memory
from casacal.changes import Change
from casacal.changes.explain import AllTests, Cause, Explanation, FittedCause, Look, contenders, explanations, row_bases
from casacal.data.samples import joined
from casacal.errors import SamplesError, UnknownNameError
from casacal.simulation.places import default_cell
from casacal.simulation.simulate import simulate_one
from casacal.simulation.touches import Draw
from casacal.uncertainty.fresh_rows import FreshRows, chances, likelihood, occam, visible_basis

STANDING = ("floor", "wall", "side")
STOOD = {"adept_cobra600": ("offset",)}
"""What stands, where that is not called a plane."""


@cache
def cell_of(name):
    """A problem and its cell."""
    source = load_problem(ROOT / "problems" / name)
    return source, source.cell or default_cell(source.problem)


@cache
def calibration(name, seed=3):
    """Of one true arm of a problem, in the cell of that."""
    source, cell = cell_of(name)
    rows = simulate(source.problem, cell, samples=120, seed=seed).samples
    return source, cell, calibrate(source.problem, rows, reference=False)


def robot(name, seed=3):
    """A problem, its cell, and one true arm of it that was calibrated."""
    source, cell, found = calibration(name, seed)
    return source, cell, found.arm


def touched(name, count, *, session=1, joint=None, shift=0.0, seed=3):
    """Fresh touches of the same true arm; a joint whose zero has shifted stands elsewhere than the controller says."""
    source, cell = cell_of(name)
    rows = simulate_one(source.problem, cell, count, Draw(seed, session=session)).samples
    joints = rows.joints.copy()
    if joint is not None:
        joints[:, joint] -= shift
    return dataclasses.replace(rows, joints=joints, file=f"fresh-{session}.csv")


def off(rows, k, by):
    readings = rows.columns["reading"].copy()
    readings[k] += by
    return dataclasses.replace(rows, columns={"reading": readings})


# ------------------------------------------------------------------------------------------------ the statistics


def an_example(rng, rows=24):
    slopes, own, half = rng.normal(size=(rows, 6)), rng.normal(size=(rows, 3)), rng.normal(size=(6, 6))
    return slopes @ half, own


def test_whitening_and_likelihood_ratios_against_dense_matrices():
    rng = np.random.default_rng(0)
    spread, own = an_example(rng)
    residual, columns = 3 * rng.normal(size=24), rng.normal(size=(24, 2))
    found = FreshRows(residual, spread, own)
    beside = null_space(own.T)
    inside = np.linalg.inv(beside.T @ (np.eye(24) + spread @ spread.T) @ beside)
    small, there = beside.T @ residual, beside.T @ columns
    assert found.freedom == 21
    assert found.chi_square == pytest.approx(small @ inside @ small)
    np.testing.assert_allclose(found.whitened(columns).T @ found.whitened(columns), there.T @ inside @ there, rtol=1e-9)
    shift = -np.linalg.solve(there.T @ inside @ there, there.T @ inside @ small)
    left = small + there @ shift
    basis = visible_basis(found.whitened(columns), np.ones(2))
    tests = AllTests(found, [basis], row_bases(found, 24, 1), np.inf)
    by_cause, by_row, whole = tests.falls(found.white[None])
    assert by_cause[0, 0] == pytest.approx(small @ inside @ small - left @ inside @ left)
    assert whole[0] == pytest.approx(found.chi_square)
    # row 7 by itself: the fall where it may be anywhere
    alone = beside.T @ np.eye(24)[:, [7]]
    away = small - alone @ np.linalg.solve(alone.T @ inside @ alone, alone.T @ inside @ small)
    assert by_row[0, 7] == pytest.approx(small @ inside @ small - away @ inside @ away)
    p_cause, p_row, p_all = tests.chances((by_cause, by_row, whole))
    assert p_cause[0, 0] == pytest.approx(chi2.sf(by_cause[0, 0], 2))
    assert p_row[0, 7] == pytest.approx(min(24 * chi2.sf(by_row[0, 7], 1), 1.0))
    assert p_all[0] == pytest.approx(chi2.sf(whole[0], 21))
    for by, least in ((np.zeros(24), 0), (15 * np.eye(24)[7], 1), (20 * columns[:, 0], 0)):
        one = FreshRows(residual / 3 + by, spread, own).white[None]
        every = [each.min() for each in tests.chances(tests.falls(one))]
        assert tests.smallest(one)[0] == pytest.approx(min(every), rel=1e-6)
        assert least == 0 or np.argmin(every) == 1, "single rows decide where one is off"
        # noise that is half as large as it was taken for
        double = [each.min() for each in tests.chances(tuple(4 * fall for fall in tests.falls(one)))]
        assert tests.smallest(one, 0.5)[0] == pytest.approx(min(double), rel=1e-6)


def test_noise_that_was_found_gives_f_and_t():
    assert chances(np.array([3.0]), 2.0, 30.0)[0] == pytest.approx(f.sf(1.5, 2, 30))
    assert chances(np.array([3.0]), 0.0)[0] == 1.0
    assert likelihood(12.0, 5, 1e9) == pytest.approx(likelihood(12.0, 5), rel=1e-6)
    assert likelihood(12.0, 5, 10.0) == pytest.approx(-7.5 * np.log(2.2))
    columns = np.random.default_rng(0).normal(size=(9, 2))
    inside = np.eye(9) + columns @ np.diag([4.0, 9.0]) @ columns.T
    assert occam(columns, np.array([2.0, 3.0])) == pytest.approx(np.linalg.slogdet(inside)[1] / 2)


@pytest.mark.long_unless("0.05-25.0")
@pytest.mark.parametrize(("alarm", "noise"), [(0.01, np.inf), (0.1, np.inf), (0.05, 25.0)])
def test_false_alarms_come_at_the_rate_that_was_asked_for(alarm, noise):
    """Fresh sets as they are promised, drawn in the rows themselves; the noise off by what nobody knows of it."""
    rng = np.random.default_rng(1)
    spread, own = an_example(rng)
    causes = [rng.normal(size=(24, k)) for k in (1, 1, 1, 3)]
    causes[1] = causes[0] + 0.1 * causes[1]  # tests that nearly agree
    count, alarms = 4000, 0
    first = FreshRows(np.zeros(24), spread, own)
    bases = [visible_basis(first.whitened(each), np.ones(each.shape[1])) for each in causes]
    tests = AllTests(first, bases, row_bases(first, 24, 1), noise)
    level = tests.level(alarm, seed=7)
    size = np.sqrt(rng.chisquare(noise, count) / noise) if np.isfinite(noise) else np.ones(count)
    for k in range(count):
        rows = rng.normal(size=24) + spread @ rng.normal(size=6)
        rows = rows / size[k] + own @ rng.normal(size=3) * 100
        whitened = FreshRows(rows, spread, own).white
        alarms += tests.smallest(whitened[None])[0] < level
    low, high = binom.ppf([0.001, 0.999], count, alarm)
    assert low - 0.1 * alarm * count <= alarms <= high + 0.1 * alarm * count  # the level itself was drawn


def test_the_level_is_the_same_for_the_same_seed_and_lower_than_the_rate():
    rng = np.random.default_rng(2)
    whitened = FreshRows(rng.normal(size=24), *an_example(rng))
    tests = AllTests(whitened, [np.zeros((24, 0))], row_bases(whitened, 24, 1), np.inf)
    assert tests.level(0.05, 0, draws=2000) == tests.level(0.05, 0, draws=2000)
    assert tests.level(0.05, 0, draws=2000) != tests.level(0.05, 1, draws=2000)
    assert 0.02 < tests.level(0.05, 0, draws=2000) < 0.05


# ------------------------------------------------------------------------------------------------ arms of problems/


@pytest.mark.long_unless("adept_cobra600-True")
@pytest.mark.parametrize(("name", "stands"), [("hsr_jr680", False), ("ur5", True), ("adept_cobra600", True)])
def test_an_arm_that_did_not_change_is_not_called_changed(name, stands):
    standing, arm, alarms = STOOD.get(name, ("plane",)) if stands else (), robot(name)[2], 0
    for session in range(1, 7):
        found = changed(arm, touched(name, 24, session=session), standing=standing)
        alarms += found.changed is not False
        assert found.ended == "nothing" or found.causes or found.bad_lines
    assert alarms <= binom.ppf(0.999, 6, 0.01)


@pytest.mark.long_unless("hsr_jr680-0-0.002")
@pytest.mark.parametrize(
    ("name", "joint", "shift"),
    [
        ("hsr_jr680", 0, 2e-3),
        ("hsr_jr680", 2, 1e-3),
        ("hsr_jr680", 4, 20e-3),
        ("ur5", 1, 2e-3),
        ("adept_cobra600", 1, 3e-3),
    ],
)
def test_the_joint_that_shifted_is_named_with_its_shift(name, joint, shift):
    rows = touched(name, 40, joint=joint, shift=shift)
    found = changed(robot(name)[2], rows, standing=STOOD.get(name, ("plane",)))
    assert found.changed, found.summary()
    (cause,) = found.causes
    assert (cause.name, cause.kind, cause.units) == (f"joint {joint + 1}", "joint", ("rad",))
    assert abs(cause.shift[0] - shift) < 3.5 * cause.std[0] + 0.01 * shift
    assert cause.std[0] < shift / 4
    assert cause.p < found.level
    assert cause.share > 0.95
    assert f"the zero of joint {joint + 1}, by +{1e3 * cause.shift[0]:.2f} mrad" in found.summary()


def test_a_sliding_joint_is_named_in_mm():
    """Adept's third joint slides; against standing facets 1 mm shows."""
    rows = touched("adept_cobra600", 40, joint=2, shift=1.0)
    found = changed(robot("adept_cobra600")[2], rows, standing=STOOD["adept_cobra600"])
    names = {cause.name: cause for cause in found.causes}
    assert found.changed is not False
    assert "joint 3" in names, found.summary()
    assert names["joint 3"].units == ("mm",)
    assert abs(names["joint 3"].shift[0] - 1.0) < 4 * names["joint 3"].std[0]


def test_what_would_have_been_found_is_found_nine_times_of_ten():
    """The shift that is promised to show, put into rows as they are promised: an alarm in 90 %."""
    given = opened(robot("hsr_jr680")[2], touched("hsr_jr680", 20), problem=None, instrument=None, standing=STANDING)
    look = Look.at(given.fresh(STANDING), given.noise_freedom, 0.01, 0)
    rng, size = np.random.default_rng(3), len(look.tests.fresh.residual)
    for k in range(5):
        shift = look.found_from(k)
        drawn = rng.normal(size=(3000, size)) - look.slopes[k][:, 0] * shift
        power = (look.tests.smallest(drawn) < look.level).mean()
        assert 0.88 < power < 0.94  # a little more: others raise the alarm too
    names = [shown.name for shown in changed(given.arm, given.rows, standing=STANDING).joints]
    assert names == [f"joint {k + 1}" for k in range(6)]


def test_noise_that_was_found_asks_for_larger_shifts():
    given = opened(robot("hsr_jr680")[2], touched("hsr_jr680", 20), problem=None, instrument=None, standing=STANDING)
    look = Look.at(given.fresh(STANDING), 12.0, 0.01, 0)
    sure = Look.at(given.fresh(STANDING), np.inf, 0.01, 0)
    rng, size = np.random.default_rng(4), len(look.tests.fresh.residual)
    for k in (1, 3):
        assert look.found_from(k) > 1.1 * sure.found_from(k)
        drawn = rng.normal(size=(3000, size)) - look.slopes[k][:, 0] * look.found_from(k)
        noise = np.sqrt(rng.chisquare(12.0, 3000) / 12.0)
        assert 0.85 < (look.tests.smallest(drawn, noise) < look.level).mean() < 0.96


def test_drift_adds_its_variance():
    fresh = opened(
        robot("hsr_jr680")[2], touched("hsr_jr680", 20), problem=None, instrument=None, standing=STANDING
    ).fresh(STANDING)
    names = [name for name, known in zip(fresh.bound.names, fresh.known, strict=True) if known]
    more = fresh.loosened({"theta4": 2e-3, "plane.wall": 0.1}).covariance - fresh.covariance
    wanted = np.zeros(len(names))
    wanted[names.index("theta4")] = 4e-6
    wanted[[k for k, name in enumerate(names) if name.startswith("plane.wall.")]] = 0.01
    np.testing.assert_allclose(more, np.diag(wanted), rtol=1e-6, atol=1e-15)


def test_effects_that_go_with_the_arm_are_as_the_fit_left_them():
    """Gears and give with their covariance with the geometry; warmth begins anew."""
    source, _, fit = calibration("hsr_jr680")
    given = opened(fit.arm, touched("hsr_jr680", 20), problem=None, instrument=None, standing=STANDING)
    fresh = given.fresh(STANDING)
    found = with_memory(fresh, given.arm)
    columns = np.flatnonzero(found.known)
    kinds = [fresh.bound.beside[j] for j in columns]
    kept = [k for k, kind in enumerate(kinds) if kind in ("", "wave1", "wave2", "give", "play")]
    places = [fit.fit.names.index(fresh.bound.names[columns[k]]) for k in kept]
    np.testing.assert_allclose(found.at[columns[kept]], fit.result.x[places], atol=1e-12)
    np.testing.assert_allclose(
        found.covariance[np.ix_(kept, kept)], fit.result.covariance[np.ix_(places, places)], rtol=1e-9, atol=1e-18
    )
    anew = [k for k, kind in enumerate(kinds) if kind in ("growth", "form", "drift")]
    assert anew
    assert not found.at[columns[anew]].any()
    np.testing.assert_array_equal(found.covariance[np.ix_(anew, anew)], fresh.covariance[np.ix_(anew, anew)])
    assert "growth" in kinds
    plain = calibrate(source.problem, fit.samples, reference=False, discrepancy="none").arm
    there = opened(plain, given.rows, problem=None, instrument=None, standing=()).fresh(())
    assert with_memory(there, plain) is there


def test_what_cannot_show_is_said():
    found = changed(robot("hsr_jr680")[2], touched("hsr_jr680", 24))
    assert "joint 1" in found.unseen
    assert "base" in found.unseen
    assert "a shift of joint 1" in found.summary()
    assert "joint 1 " not in found.summary().split("with 90 % probability:")[1].split("\n")[0]
    assert np.isinf(found.joints[0].shift)
    assert found.to_dict()["joints"][0]["shift"] is None


@pytest.mark.long_unless("4")
@pytest.mark.parametrize("k", [4, 11])
def test_a_row_that_is_off_is_named_in_place_of_the_arm(k):
    rows = off(touched("hsr_jr680", 24), k, 1.0)
    for standing in ((), STANDING):
        found = changed(robot("hsr_jr680")[2], rows, standing=standing)
        assert found.ended == "rows", found.summary()
        assert found.bad_lines == (rows.lines[k],)
        assert found.changed is None
        assert not found.causes
        assert f"Look at line {rows.lines[k]} first" in found.summary()


def test_a_row_that_is_off_does_not_hide_a_joint():
    rows = off(touched("hsr_jr680", 30, joint=3, shift=2e-3), 4, 1.0)
    found = changed(robot("hsr_jr680")[2], rows, standing=STANDING)
    assert found.ended == "changed", found.summary()
    assert found.causes[0].name == "joint 4"
    assert found.bad_lines == (rows.lines[4],)
    assert f"line {rows.lines[4]} fits neither" in found.summary().lower()


def moved_face(rows, label, by):
    """Readings of one face, by mm more: it stands further off along the plunger."""
    readings = rows.columns["reading"].copy()
    readings[[each == label for each in rows.labels["plane"]]] += by
    return dataclasses.replace(rows, columns={"reading": readings})


def test_a_face_that_moved_is_named_where_it_was_said_to_stand():
    rows = moved_face(touched("hsr_jr680", 45), "wall", 0.4)
    found = changed(robot("hsr_jr680")[2], rows, standing=STANDING)
    assert found.ended == "changed", found.summary()
    assert (found.causes[0].name, found.causes[0].kind) == ("plane.wall", "place")
    assert found.causes[0].labels == ("tilt1", "tilt2", "offset")
    assert "the position of 'plane.wall'" in found.summary()
    assert changed(robot("hsr_jr680")[2], rows).ended == "nothing", "fitted anew it may stand anywhere"


def test_another_tool_is_named():
    """0.7 mm to the side in the flange frame, which no joint imitates."""
    source, cell, arm = robot("hsr_jr680")
    dial = dataclasses.replace(
        source.problem.instrument, tool=dataclasses.replace(source.problem.instrument.tool, values=(0.7, -0.5, 0.3))
    )
    other = Problem(source.problem.robot, dial)
    rows = simulate_one(other, cell, 60, Draw(3, session=5)).samples
    found = changed(arm, rows, standing=STANDING)
    assert found.ended == "changed", found.summary()
    assert found.causes[0].kind == "tool"
    assert "the position of the tool (or the zero of its dial)" in found.summary()
    assert "--free tool" in found.summary(), "which this problem holds"
    np.testing.assert_allclose(found.causes[0].shift, (0.7, -0.5, 0.3), atol=4 * found.causes[0].std.max())


def test_a_base_that_moved_is_named_against_what_stands():
    """All faces 0.5 mm nearer along x and turned a little: as if the base had moved the other way."""
    source, cell, arm = robot("hsr_jr680")
    turn = np.array([[1.0, -6e-4, 3e-4], [6e-4, 1.0, -4e-4], [-3e-4, 4e-4, 1.0]])
    faces = tuple(
        dataclasses.replace(
            face,
            centre=tuple((turn @ face.centre + np.array([0.5, -0.4, 0.3])).tolist()),
            normal=tuple((turn @ face.normal).tolist()),
        )
        for face in cell.faces
    )
    rows = simulate_one(source.problem, dataclasses.replace(cell, faces=faces), 60, Draw(3, session=6)).samples
    found = changed(arm, rows, standing=STANDING)
    cause = found.causes[0]
    assert cause.kind == "base", found.summary()
    moved = np.array([-0.5, 0.4, -0.3, -4e-4, -3e-4, -6e-4])
    assert (np.abs(cause.shift - moved) < 4 * cause.std + 0.02 * np.abs(moved)).all()
    assert (np.abs(cause.shift / cause.std)[:3] > 3).any()
    assert changed(arm, rows).ended == "nothing"


def test_two_things_at_once_are_not_called_one():
    rows = touched("hsr_jr680", 40, joint=2, shift=3e-3)
    joints = rows.joints.copy()
    joints[:, 4] -= 5e-3
    found = changed(robot("hsr_jr680")[2], dataclasses.replace(rows, joints=joints), standing=STANDING)
    assert found.ended == "undecided", found.summary()
    assert found.causes
    assert found.causes[0].left < 0.01
    assert "more than one thing changed" in found.summary()


def test_drift_that_is_allowed_for_is_no_change():
    rows, arm = touched("hsr_jr680", 24, joint=3, shift=1e-3), robot("hsr_jr680")[2]
    assert changed(arm, rows).ended == "changed"
    found = changed(arm, rows, drift={"theta4": 2e-3})
    assert found.ended == "nothing", found.summary()
    assert "drift theta4 0.002" in found.summary()
    assert found.drift == (("theta4", 2e-3),)
    assert changed(arm, rows, drift={"theta": 2e-3}).p > changed(arm, rows, drift={"theta": 1e-6}).p
    with pytest.raises(UnknownNameError, match="theta9"):
        changed(arm, rows, drift={"theta9": 1e-3})
    with pytest.raises(CasacalError, match="drift of 'theta4'"):
        changed(arm, rows, drift={"theta4": -1.0})


@pytest.mark.long
def test_a_tracker_tells_joints_and_its_own_rows_apart():
    """Three residuals a row: the joint that shifted, the station that stands, one row that is off."""
    arm = Problem(robot("hsr_jr680")[0].problem.robot, TrackedPoint(noise_std=0.02, tool=tool_point(10, 20, 30)))
    found = calibrate(arm, simulate(arm, samples=60, seed=4).samples, reference=False)
    rows = simulate_one(arm, None, 20, Draw(4, session=2)).samples
    first = dataclasses.replace(rows, joints=rows.joints - np.array([1e-3, 0, 0, 0, 0, 0]))
    assert changed(found, first).ended == "nothing", "the station hides it"
    told = changed(found, first, standing=["station"])
    assert [cause.name for cause in told.causes] == ["joint 1"]
    assert told.causes[0].shift[0] == pytest.approx(1e-3, rel=0.05)
    name = next(iter(rows.columns))
    values = rows.columns[name].copy()
    values[3] += 2.0
    told = changed(found, dataclasses.replace(rows, columns={**rows.columns, name: values}))
    assert told.bad_lines == (rows.lines[3],)
    assert told.ended == "rows"


# ------------------------------------------------------------------------------------------------ causes and touches


def hard_to_tell(name="hsr_jr680"):
    """A set of few touches in which several causes remain."""
    for session in range(1, 40):
        rows = touched(name, 15, session=session, joint=2, shift=1.6e-3)
        found = changed(robot(name)[2], rows, touches=6)
        if found.ended == "undecided" and sum(cause.kind != "row" for cause in found.causes) > 1:
            return rows, found
    raise AssertionError("no such set")


@pytest.fixture(scope="module")
def doubtful():
    return hard_to_tell()


def test_causes_that_cannot_be_told_apart_are_all_named(doubtful):
    _, found = doubtful
    assert found.changed is None
    assert sum(cause.share for cause in found.causes) > 0.9
    shares = [cause.share for cause in found.causes]
    assert shares == sorted(shares, reverse=True)
    for cause in found.causes:
        assert cause.name in found.summary()
    assert "cannot distinguish" in found.summary()


@pytest.mark.parametrize(
    ("shift", "left", "named"),
    [(0.25, 0.9, ["joint 6", "tool"]), (0.25, 1e-3, ["joint 6"]), (0.01, 0.9, ["joint 6"])],
)
def test_a_joint_far_beyond_what_is_usual_does_not_stand_alone(shift, left, named):
    """Where its axis runs through the tip it could do what a knocked tool does, by a quarter of a radian."""
    joint = Cause("joint 6", "joint", np.array([5]), ("rad",), ("zero",), 5)
    tool = Cause("tool", "tool", np.arange(6, 9), ("mm",) * 3, ("x", "y", "z"))
    fits = [FittedCause(np.array(by), np.ones(len(by)), None, None) for by in ([shift], [0.5, 0.0, 0.0])]
    found = [Explanation(cause, -1, 0.0, left, 0.0, fitted=fit) for cause, fit in zip((joint, tool), fits, strict=True)]
    found = [dataclasses.replace(found[0], share=1 - 1e-9), dataclasses.replace(found[1], share=1e-9)]
    assert [each.cause.name for each in contenders(found)] == named


def read_at(postures, session, joint, shift):
    """Readings that the true arm takes there on the faces of a session, by Newton's method; noise as stated."""
    source, cell, _ = robot("hsr_jr680")
    there = simulate_one(source.problem, cell, 60, Draw(3, session=session))
    bound = bind(source.problem, there.samples)
    truth, joints = there.truth(bound), postures.joints.copy()
    joints[:, joint] += shift
    readings, rng = np.zeros(len(postures)), np.random.default_rng(0)
    for _ in range(4):
        at = [
            bound.on(dataclasses.replace(postures, joints=joints, columns={"reading": readings + step})).plain_residual(
                truth
            )
            for step in (0.0, 1.0)
        ]
        readings = readings - at[0] / (at[1] - at[0])
    noise = 0.01 * rng.normal(size=len(postures))
    return dataclasses.replace(postures, columns={"reading": readings + noise}, file="told.csv", sha256="told")


def test_the_touches_that_are_proposed_tell(doubtful):
    """The true arm makes them: its joint is likelier afterwards, and a cause that remained before is ruled out."""
    rows, found = doubtful
    assert len(found.touches) == 6
    assert found.tells > 1
    lower, upper = robot("hsr_jr680")[0].problem.robot.limits
    assert ((found.touches.joints >= lower) & (found.touches.joints <= upper)).all()
    made = read_at(found.touches, int(rows.file[6:-4]), 2, 1.6e-3)
    assert np.abs(made.columns["reading"] - found.touches.columns["reading"]).max() < 8.0, "they touch, as drawn"
    both = joined(rows, made)
    told = changed(robot("hsr_jr680")[2], both, touches=6)
    before, after = ({cause.name: cause.share for cause in each.causes} for each in (found, told))
    assert after.get("joint 3", 0.0) > max(before.get("joint 3", 0.0), 0.9), told.summary()


def test_values_compare_pickle_and_speak(doubtful):
    rows, found = doubtful
    again = pickle.loads(pickle.dumps(found))
    assert again == found
    assert isinstance(again, Change)
    assert found == changed(robot("hsr_jr680")[2], rows, touches=6)
    assert found != dataclasses.replace(found, p=0.5)
    assert "undecided" in repr(found)
    with pytest.raises(dataclasses.FrozenInstanceError):
        found.p = 1.0
    with pytest.raises(ValueError, match="read-only"):
        found.causes[0].std[:] = 0.0
    document = json.loads(json.dumps(found.to_dict()))
    assert document["ended"] == "undecided"
    assert document["changed"] is None
    assert document["causes"][0]["name"] == found.causes[0].name


def test_shares_are_of_the_evidence():
    given = opened(
        robot("hsr_jr680")[2],
        touched("hsr_jr680", 24, joint=3, shift=1e-3),
        problem=None,
        instrument=None,
        standing=(),
    )
    look = Look.at(given.fresh(()), given.noise_freedom, 0.01, 0)
    found = explanations(look)
    assert sum(each.share for each in found) == pytest.approx(1.0)
    assert [each.cause.name for each in contenders(found)] == ["joint 4"]
    first = {each.cause.name: each for each in explanations(look, linear=True) if each.cause}
    rows = look.fresh.linear
    residual, spread, own = rows.residual, rows.spread, rows.own
    beside = null_space(own.T)
    inside = beside @ np.linalg.inv(beside.T @ (np.eye(len(spread)) + spread @ spread.T) @ beside) @ beside.T
    for each in found:
        if (
            each.cause is None
        ):  # a row by itself: it leaves the others, is one of 24, and may be off by 100 times its noise
            weight = inside[each.row, each.row]
            left = residual @ inside @ residual - (inside @ residual)[each.row] ** 2 / weight
            wanted = likelihood(left, look.tests.fresh.freedom, given.noise_freedom)
            assert each.evidence == pytest.approx(wanted - np.log(1 + 1e4 * weight) / 2 - np.log(24), rel=1e-6)
    for each in found:
        if each.cause is not None and each.cause.kind == "joint":
            assert each.evidence == pytest.approx(first[each.cause.name].evidence, abs=0.3), "shifts are small"


# ------------------------------------------------------------------------------------------------ what is refused


def test_what_makes_no_sense_is_refused(tmp_path):
    source, cell, arm = robot("hsr_jr680")
    rows = touched("hsr_jr680", 24)
    for options in ({"alarm": 0.0}, {"alarm": 0.9}, {"alarm": "1 %"}, {"touches": -1}, {"seed": 1.5}):
        with pytest.raises(CasacalError, match="as the"):
            changed(arm, rows, **options)
    with pytest.raises(CasacalError, match="as the list of what has not moved"):
        changed(arm, rows, standing="floor")
    with pytest.raises(UnknownNameError, match="ceiling"):
        changed(arm, rows, standing=["ceiling"])
    with pytest.raises(SamplesError, match="too many"):
        changed(arm, many(rows))
    denied = {**arm.document, "covariance": None, "verdict": {"level": "do not use", "words": "Do not use it."}}
    (tmp_path / "result.json").write_text(json.dumps(resealed(denied)), encoding="utf-8")
    with pytest.raises(CasacalError, match="not to be used"):
        changed(tmp_path, rows)
    fitted = simulate(source.problem, cell, samples=120, seed=3).samples
    with pytest.raises(SamplesError, match="calibrated from"):
        changed(arm, fitted)


def many(rows):
    joints = np.tile(rows.joints, (70, 1)) + np.arange(70 * len(rows))[:, None] * 1e-4
    readings, labels = np.tile(rows.columns["reading"], 70), [*rows.labels["plane"]] * 70
    return dataclasses.replace(
        rows, joints=joints, columns={"reading": readings}, labels={"plane": labels}, lines=tuple(range(len(joints)))
    )
