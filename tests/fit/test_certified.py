"""Levenberg-Marquardt against certified answers: 27 regressions of NIST from two starts each, default settings."""

import numpy as np
import pytest
from nist_strd import MODELS, SETS, Regression
from oracles import central_difference
from scipy.optimize import least_squares

from casacal import bind, lm
from casacal.fit import Status

HARDEST = ("MGH17", 0)
"""Its decays are over before the second observation: a plateau from which every way leads up."""

RUNS = [(name, start) for name in SETS for start in (0, 1)]


@pytest.fixture(scope="module")
def runs():
    with np.errstate(all="ignore"):
        return {run: (problem := Regression(*run), lm(problem)) for run in RUNS}


def test_the_sets_are_whole():
    assert len(SETS) == len(MODELS) == 27
    assert sum(len(data["y"]) for data in SETS.values()) == 2176


@pytest.mark.parametrize("name", SETS)
def test_the_models_are_those_of_the_certified_sums_of_squares(name):
    problem = Regression(name, 0)
    whole = problem.rows - problem.unknowns
    slack = 1e-6 if name != "Lanczos1" else np.inf  # eleven digits of its answer leave more than its noise of 1e-13
    assert np.sum(problem.residual(problem.certified) ** 2) == pytest.approx(whole, rel=slack)
    steps = 1e-6 * np.abs(problem.certified)
    numeric = central_difference(problem.residual, problem.certified, steps)
    exact = problem.jacobian(problem.certified)
    assert np.abs(numeric - exact).max() <= 1e-5 * np.abs(exact).max()


def test_fifty_two_runs_reach_nine_digits(runs):
    digits = {run: problem.digits(result.x) for run, (problem, result) in runs.items()}
    assert sum(found >= 9 for found in digits.values()) >= 52, {k: v for k, v in digits.items() if v < 9}


def test_none_says_converged_below_six_digits(runs):
    wrong = [run for run, (problem, result) in runs.items() if result.converged and problem.digits(result.x) < 6]
    assert wrong == []
    assert runs[HARDEST][1].status in (Status.STUCK, Status.MAX_STEPS)


def test_what_it_says_of_uncertainty_is_certified_too(runs):
    for problem, result in runs.values():
        if problem.digits(result.x) >= 9:
            np.testing.assert_allclose(result.std, problem.certified_std, rtol=1e-3)


@pytest.mark.parametrize("flat", [("d",), ("alpha", "theta"), ("alpha", "a", "d", "theta")], ids="+".join)
def test_an_arm_without_priors_reaches_what_scipy_reaches(hsr, flat):
    """Up to five gauges, and near-parallel axes that leave a curved valley of singular values 2e10 apart."""
    problem = bind(hsr.problem.with_prior(dict.fromkeys(flat, np.inf)), hsr.problem.read(hsr.samples))
    pull, scale = np.sqrt(np.diagonal(problem.prior_information)), problem.start_std
    found = least_squares(
        lambda x: np.concatenate([problem.residual(x), pull * (x - problem.x0)]),
        problem.x0,
        lambda x: np.vstack([problem.jacobian(x), np.diag(pull)]),
        method="lm", x_scale=scale, xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=5000,
    )  # fmt: skip
    result = lm(problem)
    assert result.converged
    assert result.cost <= found.cost * (1 + 1e-8)
