"""Ways to calibrate that the benchmark compares; what a method is, casacal/study/benchmark.py says."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from casacal.calibration.calibrate import calibrate
from casacal.calibration.verdict import verdict_of
from casacal.data.samples import Samples
from casacal.effects import LinkSag, TransmissionError
from casacal.errors import CasacalError
from casacal.fit.bound_problem import bind
from casacal.fit.controls import scipy_least_squares
from casacal.fit.lm import lm
from casacal.model.problem import Problem
from casacal.study.benchmark import Told, left
from casacal.values import Array

MOST_OF_A_PROCESS = 1500  # rows that a Gaussian process is made of; of more, some


def drawn(problem: Problem, fitted: Samples, unseen: Samples) -> Array:
    """The arm as drawn; only what belongs to the instrument is fitted: tool, faces, stations."""
    arm = problem.without_terms
    bound = bind(arm.fix(*(key for key, unknown in arm.robot.parameters.items() if unknown.size)), fitted)
    return left(bound, lm(bound).x, unseen)


def offsets(problem: Problem, fitted: Samples, unseen: Samples) -> Array:
    """Zero offsets of the joints alone, as makers' own masterings find them."""
    arm = problem.without_terms
    if "theta" not in arm.robot.parameters:
        raise CasacalError("This arm has no 'theta', the zero offsets of its joints", "Leave this method out")
    held = [key for key, unknown in arm.robot.parameters.items() if key != "theta" and unknown.size]
    bound = bind(arm.fix(*held), fitted)
    return left(bound, lm(bound).x, unseen)


def geometry(problem: Problem, fitted: Samples, unseen: Samples) -> Array:
    """Lengths, twists and offsets by SciPy's least squares, as most papers do; priors as the set declares them."""
    bound = bind(problem.without_terms, fitted)
    return left(bound, scipy_least_squares(bound).x, unseen)


def casacal_geometry(problem: Problem, fitted: Samples, unseen: Samples) -> Told:
    """`calibrate` with geometry as all there is: noise as found, gross rows set aside."""
    found = calibrate(problem, fitted, reference=False, discrepancy="none")
    return Told(left(found.fit, found.result.x, unseen), verdict_of(found).level)


def casacal_whole(problem: Problem, fitted: Samples, unseen: Samples) -> Told:
    """`calibrate` as it comes: effects beside the geometry, corrected where they won by transfer on the fitted rows."""
    found = calibrate(problem, fitted, reference=False)
    return Told(left(found.fit, found.used_x, unseen), verdict_of(found).level)


def casacal_layers(problem: Problem, fitted: Samples, unseen: Samples) -> Told:
    """Geometry, the weight of every link and two low harmonics of every joint, corrected whatever the rows say of them.

    And with the set's own effects, such as measured torque.
    """
    layers = (TransmissionError(order=1), TransmissionError(order=2), LinkSag())
    own = tuple(effect for effect in problem.terms if effect.key not in {each.key for each in layers})
    found = calibrate(problem.with_terms(*layers, *own), fitted, reference=False)
    return Told(left(found.fit, found.result.x, unseen), verdict_of(found).level)


def geometry_and_process(problem: Problem, fitted: Samples, unseen: Samples) -> Array:
    """Geometry, and a Gaussian process over the joint values on what it leaves: leaks where rows have neighbours."""
    bound = bind(problem.without_terms, fitted)
    x = lm(bound).x
    known, rest = bound.plain_residual(x).reshape(len(fitted), -1), left(bound, x, unseen)
    some = np.unique(np.linspace(0, len(fitted) - 1, min(len(fitted), MOST_OF_A_PROCESS)).astype(int))
    return rest - _process(fitted.joints[some], known[some], unseen.joints)


def _process(joints: Array, values: Array, elsewhere: Array) -> Array:
    """What values (N, m) at joints (N, n) say of other joints (M, n): squared exponential, sizes by likelihood."""
    spread = np.maximum(joints.std(axis=0), 1e-9)
    here, there = joints / spread, elsewhere / spread
    apart = ((here[:, None] - here) ** 2).sum(axis=2)

    def covariance(log: Array) -> Array:
        size, reach, noise = np.exp(log)
        return np.asarray(size**2 * np.exp(-apart / (2 * reach**2)) + (noise**2 + 1e-9 * size**2) * np.eye(len(here)))

    def unlikely(log: Array) -> float:
        try:
            factor = cho_factor(covariance(log), lower=True)
        except np.linalg.LinAlgError:
            return 1e12
        half = float(np.log(np.diagonal(factor[0])).sum()) * values.shape[1]
        return float(half + float((values * cho_solve(factor, values)).sum()) / 2)

    scale = max(float(np.sqrt((values**2).mean())), 1e-9)
    start = np.log([scale, 1.0, scale / 2])
    best = minimize(unlikely, start, method="Nelder-Mead", options={"maxiter": 60}).x
    size, reach, _ = np.exp(best)
    across = size**2 * np.exp(-((there[:, None] - here) ** 2).sum(axis=2) / (2 * reach**2))
    return np.asarray(across @ cho_solve(cho_factor(covariance(best), lower=True), values))


methods = {
    "as drawn": drawn,
    "joint offsets": offsets,
    "geometry (SciPy)": geometry,
    "geometry + Gaussian process": geometry_and_process,
    "casacal, geometry": casacal_geometry,
    "casacal": casacal_whole,
    "casacal, all layers": casacal_layers,
}
