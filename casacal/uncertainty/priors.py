"""Priors: the defaults, scaled to a maker's accuracy, or learned from arms that were calibrated."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Protocol

import numpy as np
from scipy.optimize import minimize

from casacal.errors import CasacalError, ProblemError, came
from casacal.fit.bound_problem import BoundProblem
from casacal.fit.least_squares import Result
from casacal.model.problem import Problem
from casacal.model.problem_text import FINEST
from casacal.uncertainty.evidence import NormalEquations, evidence, normal_equations
from casacal.uncertainty.tip_error import without_rigid, workspace_joints
from casacal.values import Array, FrozenMapping, Index, Value

MOST = math.log(100.0)  # logarithm of the times beyond which no prior is scaled
ROUNDS, SETTLED = 6, 1e-3  # moves of fits to where scaled priors have them; change of the logarithms that is none
STEP = 0.05  # step of the logarithms for the curvature, from which the intervals come
NORMAL_95 = 1.959964  # quantile of the normal distribution for 95 %


def prior_tip_rms(problem: Problem) -> float:
    """Tip error (mm RMS over the workspace) that the priors of the arm's parameters predict.

    Apart from where the base stands. The instrument's own unknowns, such as its tool, do not count; flat priors make
    it infinite.
    """
    model, joints = problem.models[0], workspace_joints(problem.robot)
    z = np.zeros(model.tip_jacobian.numel_in(0))
    data = np.zeros((len(joints), model.tip_jacobian.numel_in(2)))
    data[:, : joints.shape[1]] = joints
    tips, slopes = model.batch("tip_jacobian")(z, np.zeros(model.tip_jacobian.numel_in(1)), data)
    arm = sum(unknown.size for unknown in problem.robot.parameters.values())
    field = without_rigid(slopes.reshape(3 * len(joints), -1)[:, :arm], tips)
    stds = np.concatenate([unknown.prior_stds for unknown in problem.robot.parameters.values()] or [np.zeros(0)])
    if not np.isfinite(stds).all():
        return math.inf
    return math.sqrt(float(((field * stds) ** 2).sum()) / len(tips))


def scaled_to_accuracy(problem: Problem, accuracy: float, *, held: Sequence[str] = ()) -> Problem:
    """Copy whose arm priors, all scaled alike, predict a tip error of `accuracy` mm RMS, as the maker states it.

    held: parameters that are to be held, and then err by nothing. Raises ProblemError unless the accuracy is 0.01 mm or
    more, and the priors are finite and move the tip.
    """
    if not FINEST <= accuracy < math.inf:
        raise ProblemError(f"The maker's accuracy is {accuracy:g} mm", f"Give mm, {FINEST} or more")
    present = prior_tip_rms(problem.fix(*held))
    if not 0 < present < math.inf:
        what = f"The arm's priors predict a tip error of {present:g} mm"
        raise ProblemError(what, "Give finite priors before scaling them")
    return _scaled(problem, {}, accuracy / present)


def _scaled(problem: Problem, times: Mapping[str, float], others: float = 1.0) -> Problem:
    """Copy of a problem with the arm's finite priors scaled by a factor for each unit."""
    stds = {
        name: times.get(unit, others) * float(std)
        for key, unknown in problem.robot.parameters.items()
        for name, unit, std in zip(unknown.names(key), unknown.units, unknown.prior_stds, strict=True)
        if math.isfinite(std)
    }
    return problem.with_prior(stds)


class CalibrationFit(Protocol):
    """Protocol of a calibration made in this process."""

    @property
    def fit(self) -> BoundProblem:
        """Its rows."""

    @property
    def result(self) -> Result:
        """Its fit."""


@dataclass(frozen=True, eq=False)
class LearnedPriors(Value):
    """Times by which prior standard deviations of the arm's parameters should be scaled, by unit.

    times: such as {"mm": 0.4, "rad": 1.8}. intervals: 95 % of each. arms: how many calibrations say so.
    """

    times: Mapping[str, float]
    intervals: Mapping[str, tuple[float, float]]
    arms: int

    def of(self, problem: Problem) -> Problem:
        """Copy of a problem with the arm's finite priors scaled so."""
        return _scaled(problem, self.times)

    def __repr__(self) -> str:
        ends = ((unit, f"{low:.2g} to {high:.2g}") for unit, (low, high) in self.intervals.items())
        said = ", ".join(f"{unit} times {self.times[unit]:.2g} ({between})" for unit, between in ends)
        return f"<Priors as {self.arms} arm{'s' * (self.arms != 1)} show{'s' * (self.arms == 1)} them: {said}>"


def learned_priors(calibrations: Iterable[CalibrationFit]) -> LearnedPriors:
    """Deviations of arms of one make from their drawing over their priors, learned from calibrations of some of them.

    All lengths of the arms have one factor and all angles another: those at which the rows of all arms together are
    likeliest, everything else integrated out (restricted marginal likelihood). One arm says little; its interval says
    how little. Noise and effects stand as each calibration found them.

    Args:
        calibrations: as `calibrate` returns them, of one problem with the same priors, on one arm each.

    Raises CasacalError for none, for what is no calibration, and where priors differ, are flat or all held.

    """
    fitted = list(calibrations) if np.iterable(calibrations) else [calibrations]
    if not fitted:
        raise CasacalError("No calibrations came", "Give those of one arm or more")
    if wrong := [each for each in fitted if not hasattr(each, "fit")]:
        said = f"Got {came(wrong[0])} as a calibration"
        raise CasacalError(said, "Give what calibrate returns; files do not hold the rows")
    arms = [_Arm.of(each.fit, each.result.x) for each in fitted]
    if not (units := sorted(arms[0].units)):
        raise CasacalError("The arm has no parameter with a finite prior", "Give priors before scaling them")
    if any(not arms[0].alike(arm) for arm in arms[1:]):
        raise CasacalError("The calibrations are of arms with different priors", "Give those of one problem")
    if any(one.fit.measured == two.fit.measured for one, two in combinations(fitted, 2)):
        raise CasacalError("Two calibrations are of the same rows", "Give one for each arm")

    def unlikely(logs: Array) -> float:
        times = dict(zip(units, np.exp(logs), strict=True))
        return -sum(evidence(arm.rows, arm.scaled(times)) for arm in arms)

    best = np.zeros(len(units))
    for _ in range(ROUNDS):
        last, best = best, minimize(unlikely, best, method="Nelder-Mead", bounds=[(-MOST, MOST)] * len(units)).x
        arms = [arm.moved(dict(zip(units, np.exp(best), strict=True))) for arm in arms]
        if np.abs(best - last).max() < SETTLED:
            break
    spread = _spread(unlikely, np.asarray(best))
    intervals = {
        unit: (math.exp(log - NORMAL_95 * std), math.exp(log + NORMAL_95 * std)) if std < MOST else (0.0, math.inf)
        for unit, log, std in zip(units, best, spread, strict=True)
    }
    times = {unit: float(np.exp(log)) for unit, log in zip(units, best, strict=True)}
    return LearnedPriors(FrozenMapping(times), FrozenMapping(intervals), len(arms))


@dataclass(frozen=True)
class _Arm:
    """One arm's normal equations at its fit, prior information (n, n), and its unknowns by unit."""

    fit: BoundProblem
    rows: NormalEquations
    prior: Array
    units: Mapping[str, Index]

    @staticmethod
    def of(fit: BoundProblem, x: Array) -> _Arm:
        keys = set(fit.problem.robot.parameters)
        held = fit.prior_information
        found: dict[str, list[int]] = {}
        for j in (j for slot in fit.slots if slot.key in keys for j in slot.columns):
            if held[j, j] > 0:
                found.setdefault(fit.units[j], []).append(j)
        return _Arm(fit, normal_equations(fit, x), held, {unit: np.array(places) for unit, places in found.items()})

    def scaled(self, times: Mapping[str, float]) -> Array:
        """The prior's information (n, n) where it is so many times as wide."""
        wider = np.ones(len(self.prior))
        for unit, places in self.units.items():
            wider[places] = times[unit]
        return np.asarray(self.prior / np.outer(wider, wider))

    def moved(self, times: Mapping[str, float]) -> _Arm:
        """Rows relinearised at the fit under that prior."""
        away = np.linalg.solve(self.rows.information + self.scaled(times), self.rows.toward)
        return replace(self, rows=normal_equations(self.fit, self.fit.x0 + away))

    def alike(self, other: _Arm) -> bool:
        """Whether both have the same priors."""
        return self.units.keys() == other.units.keys() and all(
            mine.size == other.units[unit].size and np.allclose(self.prior[mine], other.prior[other.units[unit]])
            for unit, mine in self.units.items()
        )


def _spread(cost: Callable[[Array], float], at: Array) -> Array:
    """Standard deviations by the curvature of -log p; infinite where it does not bend upwards."""
    count = len(at)
    bend, steps = np.zeros((count, count)), np.eye(count) * STEP
    for i in range(count):
        for j in range(count):
            ends = [(a, b, cost(at + a * steps[i] + b * steps[j])) for a in (1, -1) for b in (1, -1)]
            bend[i, j] = sum(a * b * value for a, b, value in ends) / (4 * STEP**2)
    if not np.isfinite(bend).all() or np.linalg.eigvalsh(bend).min() <= 0:
        return np.full(count, np.inf)
    return np.asarray(np.sqrt(np.diagonal(np.linalg.inv(bend))))
