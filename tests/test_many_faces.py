"""Many faces: each plane is taken out by itself, and every figure is that of the one large matrix."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT

from casacal import (
    Problem,
    ProblemError,
    Step,
    bind,
    calibrate,
    check,
    huber,
    lm,
    load,
    load_problem,
    plane_only,
    sckf,
    simulate,
)
from casacal.binding import evaluated_rows
from casacal.binding.marginal import seen
from casacal.calibration.verdict import verdict_of
from casacal.checks.check import _few_of_each_face
from casacal.estimators.ipopt_objective import Objective
from casacal.least_squares import arrow
from casacal.least_squares.arrow import Arrow, Groups
from casacal.least_squares.information import determined
from casacal.least_squares.linalg import posterior_covariance
from casacal.uncertainty.expectation import classical_accuracy, expected_accuracy
from casacal.uncertainty.figures import leverages, noise_interval
from casacal.uncertainty.prior_moves import prior_scatter


@pytest.fixture(scope="module")
def samples(hsr):
    """Seven touches of each of 40 faces."""
    return by_face(simulate(hsr.problem, hsr.cell, samples=7 * 40, seed=3).samples, 7)


@pytest.fixture(scope="module")
def more(hsr):
    """Five touches of each of 100 faces, which are many without being told so."""
    return by_face(simulate(hsr.problem, hsr.cell, samples=5 * 100, seed=3).samples, 5)


def by_face(samples, rows):
    """The touches of a few large faces as those of many: so many rows each."""
    number, labels = {}, []
    for label in samples.labels["plane"]:
        number[label] = number.get(label, -1) + 1
        labels.append(f"{label}{number[label] // rows}")
    kept = [i for i, label in enumerate(labels) if labels.count(label) == rows]
    return dataclasses.replace(samples.take(kept), labels={"plane": tuple(labels[i] for i in kept)})


@pytest.fixture(scope="module")
def pair(hsr, samples):
    """The same problem twice: faces taken out one by one, and as one large matrix."""
    return both(hsr.problem, samples)


def both(problem, samples):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluated_rows, "MANY", 10)
        apart = bind(problem, samples)
        assert apart.groups is not None
        patch.setattr(evaluated_rows, "MANY", 10_000)
        whole = bind(problem, samples)
        assert whole.groups is None
    return apart, whole


@pytest.fixture(scope="module")
def found(pair):
    return tuple(lm(bound) for bound in pair)


def test_the_arrow_is_the_matrix(pair):
    apart, whole = pair
    x = 0.3 * apart.start_std * np.random.default_rng(0).normal(size=apart.unknowns)
    one, other = apart.normal(x), whole.normal(x)
    assert isinstance(one.information, Arrow)
    np.testing.assert_allclose(one.information.dense(), other.information, rtol=1e-12)
    np.testing.assert_allclose(one.gradient, other.gradient, rtol=1e-10)
    assert one.cost == pytest.approx(other.cost, rel=1e-13)
    v = np.random.default_rng(1).normal(size=x.size)
    np.testing.assert_allclose(one.information @ v, other.information @ v, rtol=1e-9)
    np.testing.assert_array_equal(one.information.diagonal(), np.diagonal(one.information.dense()))


@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
@pytest.mark.parametrize("kind", ["damped_step", "revealing_step"])
def test_steps_are_those_of_the_matrix(pair, damping, kind):
    apart, whole = pair
    x = 0.1 * apart.start_std * np.random.default_rng(2).normal(size=apart.unknowns)
    one, other = (getattr(bound, kind)(x, bound.normal(x), damping) for bound in pair)
    np.testing.assert_allclose((one.x - x) / whole.start_std, (other.x - x) / whole.start_std, atol=1e-8)
    assert one.squared_length == pytest.approx(other.squared_length, rel=1e-8)
    assert one.predicted == pytest.approx(other.predicted, rel=1e-8)


@pytest.mark.parametrize("left", [0.0, 1e-14, 1e-13])
def test_a_shared_unknown_that_groups_explain_is_not_solved_from_rounding(left):
    """One group whose own unknown does what the shared one does, but for a part that no difference can hold."""
    groups = Groups(np.array([0]), (np.array([[1]]),))
    alike = Arrow(groups, np.array([[1.0 + left]]), (np.array([[[1.0]]]),), (np.array([[[1.0]]]),))
    assert alike.solution(np.ones(2)) is None
    told = alike.plus(np.array([0.5, 0.0])).solution(np.array([1.0, 2.0]))
    np.testing.assert_allclose(told, np.linalg.solve([[1.5 + left, 1.0], [1.0, 1.0]], [1.0, 2.0]))


def test_the_minimum_its_spread_and_its_counts_are_those_of_the_matrix(pair, found):
    one, other = found
    assert one.converged
    assert one.cost == pytest.approx(other.cost, rel=1e-10)
    np.testing.assert_allclose(one.x / other.std, other.x / other.std, atol=1e-7)
    np.testing.assert_allclose(one.std, other.std, rtol=1e-6)
    shared = pair[0].groups.shared
    size = np.outer(other.std[shared], other.std[shared])
    np.testing.assert_allclose(one.spread[0] / size, other.covariance[np.ix_(shared, shared)] / size, atol=1e-7)
    np.testing.assert_allclose(noise_interval(one), noise_interval(other), rtol=1e-8)
    assert one.kkt < 1e-3
    jacobian, covariance = pair[1].jacobian(other.x), other.covariance
    hat = np.trace(jacobian @ covariance @ jacobian.T)
    for result, bound in zip(found, pair, strict=True):
        told = bound.normal(result.x).information
        assert determined(told, bound.prior_std) == pytest.approx(hat, rel=1e-6)


def test_figures_of_the_arm_are_those_of_the_matrix(pair, found):
    one, other = ((seen(bound, result.x)) for bound, result in zip(pair, found, strict=True))
    assert len(one[1]) == 24
    np.testing.assert_allclose(expected_accuracy(*one), expected_accuracy(*other), rtol=1e-6)
    assert classical_accuracy(*one) == pytest.approx(classical_accuracy(*other), rel=1e-4)
    pieces = [prior_scatter(bound) for bound in pair]
    assert pieces[0].rms == pytest.approx(pieces[1].rms, rel=1e-9)
    assert pieces[0].chance_below(0.2) == pytest.approx(pieces[1].chance_below(0.2), rel=1e-6)
    spreads = [leverages(bound, result) for bound, result in zip(pair, found, strict=True)]
    np.testing.assert_allclose(spreads[0], spreads[1], rtol=1e-6)


def test_a_robust_loss_weighs_the_same_rows(pair):
    one, other = (lm(bound, loss=huber(1.0)) for bound in pair)
    assert one.cost == pytest.approx(other.cost, rel=1e-9)
    np.testing.assert_allclose(one.std, other.std, rtol=1e-5)
    np.testing.assert_allclose(noise_interval(one), noise_interval(other), rtol=1e-6)
    spreads = [leverages(bound, result) for bound, result in zip(pair, (one, other), strict=True)]
    np.testing.assert_allclose(spreads[0], spreads[1], rtol=1e-4)


def test_planes_alone_are_fitted_one_by_one(pair):
    one, other = (plane_only(bound) for bound in pair)
    assert one.converged
    assert one.cost == pytest.approx(other.cost, rel=1e-10)
    np.testing.assert_allclose(one.std, other.std, rtol=1e-6)
    np.testing.assert_array_equal(one.x[:24], 0.0)


def test_what_nothing_holds_is_unbounded_in_both(hsr, samples):
    """Flat priors: where the base stands is seen by no face, of one height of three at right angles."""
    robot = hsr.problem.robot
    flat = {key: dataclasses.replace(p, prior_std=np.inf) for key, p in robot.parameters.items()}
    problem = Problem(dataclasses.replace(robot, parameters=flat), hsr.problem.instrument)
    apart, whole = both(problem, samples)
    one, other = (apart.normal(apart.x0).information, whole.normal(whole.x0).information)
    dense = posterior_covariance(other, whole.prior_std)
    result = dataclasses.replace(plane_only(apart), information=one)
    np.testing.assert_array_equal(np.isinf(result.std), np.isinf(np.diagonal(dense)))
    assert np.isinf(result.std).any()
    assert determined(one, apart.prior_std) == determined(other, whole.prior_std)
    assert determined(one, apart.prior_std) == round(determined(one, apart.prior_std))


def test_labels_that_share_a_plane_stay_together(hsr, samples):
    """A known step stands on another face: both labels see one plane, and the step is shared."""
    names = samples.labels["plane"].names
    steps = {names[1]: Step(names[0], 5.0, std=0.01)}
    apart, whole = both(Problem(hsr.problem.robot, dataclasses.replace(hsr.problem.instrument, steps=steps)), samples)
    assert [own.shape for own in apart.groups.own] == [(len(names) - 1, 3)]
    assert "step_1" in {apart.names[j] for j in apart.groups.shared}
    one, other = (bound.damped_step(bound.x0, bound.normal(bound.x0), 1e-3) for bound in (apart, whole))
    longest = float(np.abs(other.x / whole.start_std).max())  # a height that is not true asks for a long step
    np.testing.assert_allclose(one.x / apart.start_std, other.x / whole.start_std, atol=1e-8 * longest)


@pytest.mark.long
def test_ipopt_agrees_and_the_verdict_is_one_of_calibrated(hsr, more, tmp_path):
    made = calibrate(hsr.problem, more, method="lm")
    assert made.fit.groups is not None
    assert made.reference.agrees
    assert made.metrics["after"]["fit"]["rmse_mm"] < 0.011
    made.save(tmp_path)
    kept = load(tmp_path)
    joints = np.full((3, 6), 0.4)
    np.testing.assert_array_equal(kept.predict(joints).positions, made.predict(joints).positions)
    np.testing.assert_allclose(kept.predict(joints, std=True).std, made.predict(joints, std=True).std, rtol=1e-9)


def test_the_references_hessian_is_that_of_its_gradient(pair):
    """Of the Lagrangian, entry by entry, against central differences of gradients; what is not held is zero."""
    bound = pair[0]
    objective, rng = Objective(bound.graph, bound), np.random.default_rng(5)
    n, constraints = bound.graph.start.size, bound.graph.constraints
    y, multipliers = 0.1 * rng.normal(size=n), rng.normal(size=constraints.numel_out(0))
    v = ca.SX.sym("v", n)
    pull = ca.Function("pull", [v], [ca.jtimes(constraints(v), v, ca.DM(multipliers), True)])

    def gradient(at):
        return 0.7 * objective(at)[1] + objective.scales * np.asarray(pull(objective.raw(at))).ravel()

    found = np.zeros((n, n))
    found[objective.rows, objective.columns] = objective.lagrangian(y, 0.7, multipliers)
    found += np.triu(found, 1).T
    for j in rng.choice(n, 25, replace=False):
        step = 1e-5 * np.eye(n)[j]
        slope = (gradient(y + step) - gradient(y - step)) / 2e-5
        np.testing.assert_allclose(found[:, j], slope, atol=1e-5 * np.abs(slope).max())


@pytest.mark.long
def test_the_data_check_finds_its_causes_among_many_faces(hsr, monkeypatch):
    """Among six, taken for many: each of some hundred faults is tried with all of them."""
    monkeypatch.setattr(evaluated_rows, "MANY", 5)
    samples = by_face(simulate(hsr.problem, hsr.cell, samples=20 * 6, seed=3).samples, 20)
    assert bind(hsr.problem, samples).groups is not None
    ((name, values),) = samples.columns.items()
    turned = dataclasses.replace(samples, columns={name: -np.asarray(values)})
    assert "wrong dial sign" in {finding.about for finding in check(hsr.problem, turned)}


def test_filters_say_what_they_cannot_hold(hsr, more):
    bound = bind(hsr.problem, more)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(arrow, "MOST_UNKNOWNS", 300)
        with pytest.raises(ProblemError, match="Use lm"):
            sckf(bound)
        with pytest.raises(ProblemError, match="300 at most"):
            _ = lm(bound).covariance


def test_few_rows_of_many_faces_are_whole_faces(hsr):
    """The data check looks at 600 rows: of 300 faces of seven touches that is a dozen each, or none."""
    touches = by_face(simulate(hsr.problem, hsr.cell, samples=2100, seed=3).samples, 7)
    few = _few_of_each_face(hsr.problem, touches)
    counts = np.bincount(few.faces().codes)
    assert 300 <= len(few) <= 600
    assert set(counts.tolist()) == {7}
    one_face = dataclasses.replace(touches, labels={"plane": ("a",) * (len(touches) - 9) + ("b",) * 9})
    assert np.bincount(_few_of_each_face(hsr.problem, one_face).faces().codes).tolist() == [300, 9]


BIG = """
import sys
sys.path.insert(0, "tests")
from test_many_faces import by_face
from casacal import calibrate, load_problem, simulate
hsr = load_problem("problems/hsr_jr680")
samples = by_face(simulate(hsr.problem, hsr.cell, samples=2600, seed=3).samples, 4)
made = calibrate(hsr.problem, samples, method="lm", reference=False)
assert made.success and made.fit.unknowns > 1900
assert "tip error" in made.summary()
print(open("/proc/self/status").read().split("VmHWM:")[1].split()[0])
"""


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="Linux tells how much a program held at most")
def test_hundreds_of_faces_take_no_large_matrix():
    """One matrix of 1,950 unknowns takes 30 MB, and a calibration would hold about ten."""
    done = subprocess.run([sys.executable, "-c", BIG], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 300_000


@pytest.mark.long
def test_dozens_of_faces_and_the_effects_of_any_arm():
    """60 faces have 204 unknowns, their forms 360 more: these decide nothing of how many there are."""
    source = load_problem(ROOT / "problems" / "hsr_jr680")
    faces = [dataclasses.replace(source.cell.faces[k % 3], label=f"face {k}", size=(200.0, 200.0)) for k in range(60)]
    samples = simulate(
        source.problem, dataclasses.replace(source.cell, faces=tuple(faces)), samples=420, seed=1
    ).samples
    found = calibrate(source.problem, samples, reference=False)
    assert any(found.fit.beside)
    assert found.fit.unknowns > 500
    assert verdict_of(found).level == "calibrated"
    assert found.tip_std[1] < 0.5 * found.tip_std[0]


def test_declared_effects_are_taken_out_with_their_own_priors(hsr, samples):
    """By the dense Schur complement; faces stand before effects, so that places among the shared are none in x."""
    from casacal.discrepancy import GearRipple, GravitySag, kit

    effects = [each for each in kit() if not isinstance(each, (GearRipple, GravitySag))]
    apart, whole = both(hsr.problem.with_effects(*effects), samples)
    x = 0.1 * apart.start_std
    found = seen(apart, x)[0]
    kept = found.free
    out = np.setdiff1d(np.arange(x.size), kept)
    scale = apart.start_std
    dense = (
        whole.information(x) + np.diag(np.where(np.isin(np.arange(x.size), out), whole.prior_information, 0.0))
    ) * (scale[:, None] * scale)
    schur = dense[np.ix_(kept, kept)] - dense[np.ix_(kept, out)] @ np.linalg.solve(
        dense[np.ix_(out, out)], dense[np.ix_(out, kept)]
    )
    rows = found.compact_jacobian(x[kept]) * scale[kept]
    np.testing.assert_allclose(rows.T @ rows, schur, rtol=1e-6, atol=1e-6 * np.abs(schur).max())
