"""Figures and tests of priors that belong together: a joint covariance, a certificate, a tie."""

import math
from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT
from scipy.stats import chi2

from casacal import Problem, TrackedPoint, bind, calibrate, load_problem, plan, simulate
from casacal.fit.lm import lm
from casacal.model import between, certified, equal
from casacal.shopfloor.known import LinearRows, known_before
from casacal.shopfloor.session import Session
from casacal.simulation import Disturbances
from casacal.simulation.touches import drawn_together
from casacal.uncertainty.moves import chance_of_move, common_scale, prior_moves, prior_scatter
from casacal.uncertainty.priors import learned_priors
from casacal.uncertainty.tip_error import planned_accuracy

THETAS = tuple(f"theta{k}" for k in range(1, 6))
TOGETHER = 1e-6 * (0.02 * np.eye(5) + 0.98)
LENGTHS = ("a2", "a3", "d1", "d4", "d5", "d6")
ALIKE = 0.49 * (0.0004 * np.eye(6) + 0.9996)


@pytest.fixture(scope="module")
def ur5():
    return load_problem(ROOT / "problems" / "ur5")


@pytest.fixture(scope="module")
def rows(ur5):
    return ur5.problem.read(ur5.samples)


def test_nothing_is_decided_where_nothing_was_measured(ur5, rows):
    for problem in (ur5.problem, ur5.problem.with_prior(covariance={THETAS: TOGETHER})):
        bound = bind(problem, rows)
        assert prior_moves(bound, bound.x0, bound.prior_covariance).decided == pytest.approx(0, abs=1e-8)
        assert common_scale(bound, bound.x0, bound.prior_covariance) is None


def test_a_move_against_the_covariance_is_as_unlikely_as_the_covariance_says(ur5, rows):
    bound = bind(ur5.problem.with_prior(covariance={THETAS: TOGETHER}), rows)
    own = np.array([bound.names.index(name) for name in THETAS])
    x, spread = bound.x0.copy(), bound.prior_covariance.copy()
    x[own] = np.array([1, -1, 0, 0, 0]) / math.sqrt(2) * math.sqrt(0.02e-6) * 6
    spread[np.ix_(own, own)] *= 1e-6
    expected = chi2.sf(float(x[own] @ np.linalg.solve(TOGETHER, x[own])), 5)
    assert expected < 1e-5
    assert chance_of_move(bound, x, spread, own) == pytest.approx(expected, rel=1e-3)
    moved = prior_moves(bound, x, spread)
    assert moved.factor**2 * moved.decided == pytest.approx(36, rel=1e-6)


def test_lengths_that_grow_by_their_size_are_a_scale_where_they_should_have_grown_alike(ur5, rows):
    """A part in a thousand is within independent priors of 0.7 mm; of ones whose differences are 0.02 mm it is not."""
    chances = []
    for known in (ALIKE, np.diag(np.diag(ALIKE))):
        bound = bind(ur5.problem.with_prior(covariance={LENGTHS: known}), rows)
        x = bound.x0 + np.random.default_rng(1).normal(size=bound.x0.size) * np.sqrt(np.diag(bound.prior_covariance))
        x[bound.datum] = bound.x0[bound.datum]
        drawn = {name: nominal for name, _, nominal, _ in bound.parameters()}
        for name in LENGTHS:
            x[bound.names.index(name)] = 1e-3 * drawn[name]
        found = common_scale(bound, x, 1e-6 * bound.prior_covariance)
        chances.append(found.chance)
    assert chances[0] < 1e-3 < 0.05 < chances[1]


def test_the_scatter_of_the_drawn_arm_counts_what_goes_together(ur5, rows):
    """Against the trace of P L'L, L the slopes that faces leave."""
    bound = bind(ur5.problem.with_prior(covariance={LENGTHS: ALIKE}), rows)
    slopes = bound.jacobian(bound.x0) * bound.noise[:, None]
    arm = np.isin(bound.names, [n for key, u in ur5.problem.robot.parameters.items() for n in u.component_names(key)])
    stands = bound.datum
    left = slopes[:, arm] - slopes[:, stands] @ np.linalg.lstsq(slopes[:, stands], slopes[:, arm], rcond=None)[0]
    power = np.trace(left @ bound.prior_covariance[np.ix_(arm, arm)] @ left.T) / len(left)
    assert prior_scatter(bound).rms == pytest.approx(math.sqrt(power + float((bound.noise**2).mean())), rel=1e-6)
    assert prior_scatter(bound).rms < 0.95 * prior_scatter(bind(ur5.problem, rows)).rms


class Fitted:
    """A problem and its fit, as `learned_priors` asks for them."""

    def __init__(self, problem, rows):
        self.fit = bind(problem, rows)
        self.result = lm(self.fit)


def test_priors_are_learned_beside_a_certificate(ur5, rows):
    """What a certificate says of a sum takes little from what the other lengths tell."""
    robot, dial = ur5.problem.robot, ur5.problem.instrument
    sure = Problem(robot, dial, constraints=(certified("s", lambda p: p.a[1] + p.a[2], -816.53, std=0.05),))
    plain, beside = (learned_priors([Fitted(problem, rows)]).times["mm"] for problem in (ur5.problem, sure))
    assert beside == pytest.approx(plain, rel=0.15)


def test_one_of_several_instruments_keeps_what_is_known_of_the_arm():
    three = load_problem(ROOT / "problems" / "ur5_three_instruments").problem
    known = three.with_prior(covariance={("d4", "d5"): [[0.49, 0.48], [0.48, 0.49]]})
    (kept,) = known.measured_by("dial").constraints
    assert kept == known.constraints[0]


def test_a_bound_that_held_numbers_meet_but_for_rounding(ur5, rows):
    robot, dial = ur5.problem.robot, ur5.problem.instrument
    drawn = robot.parameters["d"].values
    highest = np.nextafter(drawn[0] + drawn[3], -np.inf)
    tied = Problem(robot, dial, constraints=(between("sum", lambda p: p.d[0] + p.d[3], high=highest),))
    bound = bind(tied.fix("d1", "d4"), rows)
    assert bound.unknowns == bind(ur5.problem.fix("d1", "d4"), rows).unknowns


@pytest.fixture(scope="module")
def tied(hsr):
    """An arm of which three lengths are held at their drawn values by equalities."""
    a, d = (hsr.problem.robot.parameters[key].values for key in "ad")
    known = (
        equal("a1", lambda p: p.a[0], value=a[0]),
        equal("a2", lambda p: p.a[1], value=a[1]),
        equal("d4", lambda p: p.d[3], value=d[3]),
    )
    return Problem(hsr.problem.robot, hsr.problem.instrument, constraints=known)


def test_a_plan_counts_only_the_ways_that_equalities_leave(hsr, tied):
    made = plan(tied, hsr.cell, touches=30, pool=200, starts=1)
    fitted = made.samples.take([k for k, purpose in enumerate(made.purposes) if purpose != "check"])
    assert (made.before, made.error) == pytest.approx(planned_accuracy(bind(tied, fitted)), rel=1e-3)


def test_touches_at_the_machine_are_expected_by_priors_that_belong_together(ur5, rows):
    """The belief after some rows, by `LinearRows`, is the posterior of a fit from the drawing."""
    problem = ur5.problem.with_prior(covariance={LENGTHS: ALIKE})
    places = Session(problem, cell=ur5.cell)._setting.places
    known = known_before(problem, rows, places)
    mean = known.belief.mean
    found = LinearRows.of(known, rows).posterior(mean)
    bound = known.bound
    scale = bound.start_std
    information = bound.information(known.x) + np.linalg.inv(
        np.where(np.isfinite(bound.prior_covariance), bound.prior_covariance, np.diag(scale**2))
    )
    scaled = information * np.outer(scale, scale)  # in mm and rad it is too ill conditioned to be inverted
    assert found.covariance == pytest.approx(np.linalg.inv(scaled), rel=1e-5, abs=1e-9)


def test_a_box_under_a_loss_errs_as_the_workspace(ur5, rows):
    from casacal import huber

    found = calibrate(ur5, rows, loss=huber(0.3), reference=False)
    whole, _ = found.unjudged.tip_std_in(((-2000, 2000),) * 3)
    assert whole == pytest.approx(found.unjudged.tip_std[1], rel=0.02)
    motion = found.unjudged.motion
    plain = motion.arm.posterior(motion.arm.information(motion.x), motion.x)
    assert not np.allclose(plain, motion.covariance, rtol=0.02), "the loss says something else"


@pytest.mark.parametrize("tracked", [False, True])
def test_simulated_arms_keep_what_is_known_of_them(hsr, tracked):
    robot = hsr.problem.robot
    drawn = robot.parameters["a"].values
    instrument, cell = (TrackedPoint(noise_std=0.03), None) if tracked else (hsr.problem.instrument, hsr.cell)

    def true_lengths(known, seed, error_scale=1.0):
        problem = Problem(robot, instrument, constraints=known)
        disturbed = Disturbances(error_scale=error_scale) if cell is None else replace(cell, error_scale=error_scale)
        return simulate(problem, disturbed, samples=20, seed=seed).local["a"][:2] + drawn[:2]

    tie = (equal("tie", lambda p: p.a[1] - p.a[0] - 650.0),)
    sure = (certified("sum", lambda p: p.a[0] + p.a[1], drawn[0] + drawn[1] + 1.5, std=0.02),)
    plain = true_lengths((), 1)
    for seed in (1, 2):
        first, second = true_lengths(tie, seed)
        assert second - first == pytest.approx(650.0, abs=1e-9)
        assert sum(true_lengths(sure, seed)) == pytest.approx(drawn[0] + drawn[1] + 1.5, abs=0.08)
    nearest = plain - np.array([-1, 1]) * (plain[1] - plain[0] - 650.0) / 2
    assert true_lengths(tie, 1) == pytest.approx(nearest, abs=1e-6), "the nearest of what was drawn"
    assert true_lengths(tie, 1, 0.0) == pytest.approx(drawn[:2]), "an arm as drawn is as drawn"


def test_simulated_errors_go_together_as_their_covariance_says(hsr):
    covariance = np.array([[0.49, 0.48], [0.48, 0.49]])
    problem = hsr.problem.with_prior(covariance={("a1", "a2"): covariance})
    rng, parameters = np.random.default_rng(0), hsr.problem.robot.parameters
    found = np.array([drawn_together(problem, parameters, 2.0, rng)["a"][:3] for _ in range(4000)])
    assert np.cov(found[:, :2].T) == pytest.approx(4 * covariance, rel=0.08)
    assert abs(np.corrcoef(found.T)[0, 2]) < 0.06
