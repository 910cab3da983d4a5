"""The size of the arm: what readings of a dial and a known step say of it, and a dial whose gain is wrong."""

import dataclasses

import numpy as np
import pytest
from conftest import ROOT
from linear import Matrix
from scipy.stats import t as student

from casacal import (
    Distance,
    Face,
    Problem,
    Step,
    bind,
    calibrate,
    check,
    dial_gain,
    gauge_block,
    ipopt,
    lm,
    load_problem,
    scaled_to_accuracy,
    simulate,
)
from casacal.calibration.numbers import SCALE, wrong_scale
from casacal.calibration.verdict import verdict_of
from casacal.errors import ProblemError
from casacal.model.dial import DialOnBody
from casacal.uncertainty.moves import common_scale
from casacal.uncertainty.tip_error import bayesian_bound, conditional_scale_std, marginal_scale_std, workspace_joints


def exact(hsr, instrument, faces, travel, samples):
    """The nominal arm in exact contact."""
    problem = Problem(hsr.problem.robot, instrument)
    cell = dataclasses.replace(hsr.cell, faces=faces, travel=travel, error_scale=0.0, repeatability=0.0, resolution=0.0)
    return bind(problem, simulate(problem, cell, samples=samples, seed=1).samples)


@pytest.mark.parametrize(("travel", "ppm"), [(1.0, 1650), (10.0, 165)])
def test_dial_travel_alone_says_little_of_size(hsr, travel, ppm):
    # 120 readings uniform over the travel, 0.01 mm, all else known
    bound = exact(hsr, hsr.problem.instruments[0], hsr.cell.faces, travel, 120)
    assert 1e6 * conditional_scale_std(bound) == pytest.approx(ppm, rel=0.1)
    assert marginal_scale_std(bound) > conditional_scale_std(bound)


def raised_faces(hsr):
    faces = [
        Face(f"{face.label} raised", tuple(np.array(face.centre) + 100 * face.axes[0]), face.normal, (300, 300))
        for face in hsr.cell.faces
    ]
    steps = {face.label: Step(face.label.removesuffix(" raised"), 100.0) for face in faces}
    return (*hsr.cell.faces, *faces), steps


def test_a_known_step_fixes_the_size(hsr):
    # 480 touches, half of them on faces raised by a certified 100 mm: 100 ppm / sqrt(240), a little less for tilt
    faces, steps = raised_faces(hsr)
    dial = dataclasses.replace(hsr.problem.instruments[0], steps=steps)
    bound = exact(hsr, dial, faces, 1.0, 480)
    assert 1e6 * conditional_scale_std(bound) == pytest.approx(6, rel=0.1)


@pytest.mark.parametrize("seed", range(1, 4))
def test_knowing_the_length_of_a_gauge_block_lowers_the_expected_tip_error(hsr, seed):
    # the same touches twice: once the block's faces are two more planes, once their distance is certified
    joints, robot = workspace_joints(hsr.problem.robot), hsr.problem.robot
    stepped = Problem(robot, dataclasses.replace(hsr.problem.instruments[0], steps={"top": Step("base", 100.0)}))
    faces = (*hsr.cell.faces, *gauge_block((1200.0, 100.0, 450.0)))
    simulation = simulate(stepped, dataclasses.replace(hsr.cell, faces=faces), samples=200, seed=seed)
    bounds = []
    for problem in (hsr.problem, stepped):
        bound = bind(problem, simulation.samples)
        result = lm(bound)
        assert result.cost == pytest.approx(ipopt(bound).cost, rel=1e-8)
        error = (result.x - simulation.truth(bound)) / result.std
        assert np.abs(error).max() < 4.5
        tips, slopes = bound.tips(bound.x0, joints), bound.tip_jacobian(bound.x0, joints)
        bounds.append(bayesian_bound(bound.normal(bound.x0).information, bound.prior_information, slopes, tips))
    assert bounds[1] < 0.75 * bounds[0]


def test_certified_angles_need_fewer_unknowns_and_agree(hsr):
    normals = {face.label: face.normal for face in hsr.cell.faces}
    problem = Problem(hsr.problem.robot, DialOnBody(noise_std=0.01, normals=normals))
    simulation = simulate(problem, hsr.cell, seed=2)
    bound = bind(problem, simulation.samples)
    assert bound.unknowns == 24 + 3 + 3
    result = lm(bound)
    assert result.converged
    reference = ipopt(bound)
    assert reference.converged
    assert result.cost == pytest.approx(reference.cost, rel=1e-8)
    error = (result.x - simulation.truth(bound))[:24] / result.std[:24]
    assert np.abs(error).max() < 4.5


def test_steps_and_bodies_that_make_no_sense_are_refused(hsr):
    dial = hsr.problem.instruments[0]
    for steps in ({"a": Step("a", 1.0)}, {"a": Step("b", 1.0), "b": Step("c", 1.0)}, {"a": Step("b", 0.0)}):
        with pytest.raises(ProblemError, match="Step"):
            dataclasses.replace(dial, steps=steps)
    with pytest.raises(ProblemError, match="not parallel"):
        DialOnBody(noise_std=0.01, normals={"a": (0, 0, 1), "b": (0, 0, -1)})
    body = Problem(hsr.problem.robot, DialOnBody(noise_std=0.01, normals={"floor": (0, 0, 1), "wall": (-1, 0, 0)}))
    with pytest.raises(ProblemError, match="the body does not have"):
        bind(body, simulate(hsr.problem, hsr.cell, seed=1).samples)


class LinkLengths(Matrix):
    """Rows that are linear in eight lengths of an arm and in four of its angles."""

    slots, unknowns = (), 12
    lengths = np.array([600.0, 500.0, 200.0, 150.0, 120.0, 100.0, 0.0, 0.0])

    def parameters(self):
        yield from ((f"l{j}", "mm", length, j) for j, length in enumerate(self.lengths))
        yield from ((f"t{j}", "rad", 0.0, 8 + j) for j in range(4))


def drawn(rng, *, used, part):
    """Such rows of an arm that uses so much of its priors, all lengths wrong by a part, and their posterior."""
    prior, a = np.array([0.7] * 8 + [1e-3] * 4), rng.normal(size=(40, 12)) * ([1.0] * 8 + [500.0] * 4)
    true = used * prior * rng.normal(size=12) + part * np.append(LinkLengths.lengths, np.zeros(4))
    y = a @ true + 0.05 * rng.normal(size=40)
    covariance = np.linalg.inv(a.T @ a / 0.05**2 + np.diag(prior**-2.0))
    return LinkLengths(a, y, np.zeros(12), prior), covariance @ (a.T @ y / 0.05**2), covariance


@pytest.mark.long_unless("5.0")
@pytest.mark.parametrize("used", [0.1, 1.0, 5.0])
def test_chance_of_a_common_scale_is_one_however_well_priors_fit(used):
    rng = np.random.default_rng(3)
    chances = np.array([common_scale(*drawn(rng, used=used, part=0.0)).chance for _ in range(400)])
    assert np.abs(np.quantile(chances, [0.05, 0.25, 0.5, 0.75]) - [0.05, 0.25, 0.5, 0.75]).max() < 0.08
    assert 0.02 < (chances < 0.05).mean() < 0.08


@pytest.mark.parametrize(("used", "part"), [(0.1, 0.01), (1.0, -0.02), (5.0, 0.1)])
def test_a_common_scale_is_found_and_what_it_did_to_the_arm_is_told(used, part):
    rng = np.random.default_rng(4)
    for size in (part, -part):
        found = common_scale(*drawn(rng, used=used, part=size))
        assert found.chance < 1e-4
        assert found.part == pytest.approx(size, rel=0.5)
        assert found.off[:6] == pytest.approx(size * LinkLengths.lengths[:6], rel=0.5)
        assert np.abs(found.off[8:]).max() < 1e-3


def test_a_scale_beyond_all_measure_and_lengths_that_no_row_sees_end_in_a_number_or_nothing():
    rng = np.random.default_rng(5)
    arm, x, covariance = drawn(rng, used=1.0, part=0.0)
    far = common_scale(arm, x + 1e6 * np.append(LinkLengths.lengths, np.zeros(4)), covariance)
    assert far.chance == 0
    unseen = covariance.copy()
    unseen[:8], unseen[:, :8] = 0.0, 0.0
    unseen[range(8), range(8)] = arm.prior_std[:8] ** 2
    assert common_scale(arm, x, unseen) is None
    assert common_scale(arm, np.full(12, np.nan), covariance) is None


def showing(samples, times):
    """The same touches on a dial that shows so many times as much."""
    readings = times * samples.columns["reading"]
    return dataclasses.replace(samples, columns={**samples.columns, "reading": readings})


def shown(hsr, gain):
    return showing(simulate(hsr.problem, hsr.cell, samples=90, seed=3).samples, 1 + gain)


@pytest.mark.parametrize("accuracy", [None, 30.0])
def test_a_dial_of_a_wrong_scale_is_refused_however_wide_the_priors(hsr, accuracy):
    # no residual shows it: the arm grows with the readings, as far as its priors let it
    problem = hsr.problem if accuracy is None else scaled_to_accuracy(hsr.problem, accuracy)
    for gain, way in ((-0.01, "small together"), (0.01, "large together")):
        verdict = verdict_of(calibrate(problem, shown(hsr, gain), reference=False))
        assert verdict.level == "do not use"
        assert SCALE in verdict.words
        assert way in verdict.reasons[0]
        assert "elsewhere" not in " ".join(verdict.reasons)
    assert verdict_of(calibrate(problem, shown(hsr, 0.0), reference=False)).level == "calibrated"


def test_check_names_the_scale_and_a_gain_that_is_declared_takes_it(hsr):
    rows = shown(hsr, -0.01)
    assert [each.about for each in check(hsr.problem, rows) if each.severity == "error"] == [SCALE]
    (dial,) = hsr.problem.instruments
    declared = Problem(hsr.problem.robot, dataclasses.replace(dial, gain=dial_gain(1.0)))
    assert all(each.severity != "error" for each in check(declared, rows))
    doubted = Problem(hsr.problem.robot, dataclasses.replace(dial, gain=dial_gain(0.05)))
    (found,) = [each for each in check(doubted, rows) if each.severity == "error"]
    assert "--prior gain=" in found.fix


def test_a_known_step_takes_the_scale_from_the_dial(hsr):
    faces, steps = raised_faces(hsr)
    dial = dataclasses.replace(hsr.problem.instruments[0], steps=steps, gain=dial_gain(0.15))
    problem = Problem(hsr.problem.robot, dial)
    rows = simulate(problem, dataclasses.replace(hsr.cell, faces=faces), samples=200, seed=2).samples
    bound = bind(problem, showing(rows, 0.98))
    result = lm(bound)
    assert wrong_scale(bound, result.x, result.covariance) == []
    assert result.x[bound.names.index("gain")] == pytest.approx(2, abs=0.2)


def test_a_wire_of_a_wrong_scale_is_refused_or_doubted_and_named():
    """The arm grows with it, as far as its priors let it: 0.6 % of 425 and 392 mm are nearly four of them."""
    problem = Problem(load_problem(ROOT / "problems" / "ur5").problem.robot, Distance(noise_std=0.05))
    rows = simulate(problem, samples=90, seed=5).samples

    def told(part):
        longer = dataclasses.replace(rows, columns={**rows.columns, "length": (1 + part) * rows.columns["length"]})
        return calibrate(problem, longer, method="lm", reference=False, discrepancy="none")

    clean, doubted, refused = told(0.0), told(0.004), told(0.012)
    assert not clean.instrument_findings
    assert "priors and the scale of the lengths are right" in verdict_of(clean).words
    (finding,) = doubted.instrument_findings
    assert (finding.about, finding.severity) == (SCALE, "warning")
    assert any("lengths came out" in reason for reason in verdict_of(doubted).reasons)
    assert verdict_of(doubted).level == "use with care"
    assert verdict_of(refused).level == "do not use"
    assert "too large together" in verdict_of(refused).reasons[0]


def test_an_arm_that_is_warm_is_no_wrong_scale():
    """0.05 % of all its lengths, which are known to a hundredth of a millimetre: 20 degrees of aluminium."""
    exact = load_problem(ROOT / "problems" / "ur5").problem.robot
    tight = {**dict.fromkeys(("a", "d"), 0.01), **dict.fromkeys(("alpha", "theta", "beta"), 1e-5)}
    problem = Problem(exact, Distance(noise_std=0.002)).with_prior(tight)
    rows = simulate(problem, samples=120, seed=5).samples
    grown = dataclasses.replace(rows, columns={**rows.columns, "length": 1.0005 * rows.columns["length"]})
    found = calibrate(problem, grown, method="lm", reference=False, discrepancy="none").unjudged
    seen = common_scale(found.seen, found.seen_x, found.covariance)
    assert seen.chance < 1e-4
    assert seen.part == pytest.approx(5e-4, rel=0.1)
    assert not found.instrument_findings


def test_the_chance_of_a_common_scale_is_students_with_one_freedom_less():
    """Five moves that are as good as known, regressed on the lengths by hand."""

    class Few(LinkLengths):
        unknowns, lengths = 5, np.array([600.0, 500.0, 200.0])

        def parameters(self):
            yield from ((f"l{j}", "mm", x, j) for j, x in enumerate(self.lengths))
            yield from ((f"t{j}", "rad", 0.0, 3 + j) for j in range(2))

    prior, lengths = np.array([0.7] * 3 + [1e-3] * 2), np.array([600.0, 500.0, 200.0, 0, 0])
    a = np.diag(1 / prior) * 1e4
    x = prior * np.array([1.5, 0.9, -0.4, 0.8, -0.6])
    covariance = np.linalg.inv(a.T @ a + np.diag(prior**-2.0))
    z, v = x / prior, lengths / prior
    slope = z @ v / (v @ v)
    size = slope / np.sqrt(((z - slope * v) ** 2).sum() / 4 / (v @ v))
    found = common_scale(Few(a, a @ x, np.zeros(5), prior), x, covariance)
    assert found.chance == pytest.approx(2 * student.sf(abs(size), 4), rel=0.02)
