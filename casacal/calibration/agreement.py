"""Whether several instruments agree: in what they share, and in what each expects of another's rows."""

from __future__ import annotations

import numpy as np

from casacal.calibration.finding import Finding, freed_of_unknowns
from casacal.errors import CasacalError
from casacal.fit.bound_problem import BoundProblem, bind, each_alone
from casacal.fit.least_squares import Result
from casacal.fit.lm import lm
from casacal.linalg import svd
from casacal.uncertainty.figures import chance_beyond, effective_unknowns
from casacal.uncertainty.fresh_rows import spanned
from casacal.uncertainty.noise import FEWEST, found_noise
from casacal.uncertainty.tip_error import spread_rms, tip_rms, without_rigid, workspace_joints
from casacal.values import Array
from casacal.wording import chance, counted, listed, mm, sized

BY_CHANCE = 1e-4  # chance of a difference, and more, of what is one and the same
OBSERVABLE = 1e-3  # whitened effect of a difference as large as the prior's, below which rows do not see it
JUDGED_ROWS = 4096  # rows, evenly over all, that show whether instruments agree
HELD = 1e-9  # part of a row's variance below which nothing but the row itself says where it is
UNWEIGHTED = 1e6  # times its noise at which an instrument's rows say nothing
MOVED = 2.0  # tip errors that the others promise, by which rows may move the tip before they contradict them


def not_the_same(bound: BoundProblem, result: Result) -> list[Finding]:
    """An error for what is declared as shared and differs between instruments, at the estimate of all their rows.

    An instrument that had one of its own would see it by the derivative of its own rows. The fall of chi-square by such
    a difference, all unknowns following within their priors, has as many degrees of freedom as directions show.
    """
    owners = np.searchsorted(np.cumsum([len(some) for some in bound.samples]), bound.sample_of, side="right")
    found = []
    for key, names in bound.problem.shared.items():
        slots = [slot for slot in bound.slots if slot.key == key and slot.unknown.size]
        columns = np.array([j for slot in slots for j in slot.columns], dtype=np.intp)
        if not columns.size or not result.converged:
            continue
        scale, slopes = bound.start_std[columns], bound.jacobian(result.x)[:, columns]
        own = [np.where(owners == bound.problem.number(name), 1.0, 0.0)[:, None] * slopes * scale for name in names[1:]]
        whole, ways = freed_of_unknowns(bound, result, bound.residual(result.x), np.hstack(own))
        left, sizes, along = svd(ways)
        observable = sizes > OBSERVABLE
        gains = left[:, observable].T @ whole
        if not observable.any() or chance_beyond(float(gains @ gains), float(observable.sum())) > BY_CHANCE:
            continue
        apart = (-(along[observable].T @ (gains / sizes[observable]))).reshape(len(names) - 1, -1) * scale
        label = [name for slot in slots for name in slot.unknown.names(slot.name)]
        far = np.unravel_index(int(np.argmax(np.abs(apart / scale))), apart.shape)
        by, unit = abs(float(apart[far])), bound.units[columns[far[1]]]
        away = f"{mm(by) if unit == 'mm' else sized(by, unit)} away from that of {names[0]}"
        cause = f"'{key}' is declared as the same for {listed(names)}, and is not: "
        cause += f"{label[far[1]]} of {names[1 + far[0]]} is {away}"
        fix = f"Measure again with the same for all, or leave '{key}' out of `shared`: then each has its own"
        found.append(Finding("error", f"{key} not the same", cause, fix))
    return found


def disagreement(bound: BoundProblem) -> list[Finding]:
    """An error where the rows of one instrument are not where all others expect them, and the tip follows them.

    A few false rows that agree among themselves may pull the fit to them, so that none looks like an outlier. Each
    instrument has the noise that it shows by itself: what it errs by alone contradicts no other. Rows that move the tip
    by no more than the others leave open are no error, whatever chance says.
    """
    problem = bound.problem
    if len(bound.samples) < 2 or not bound.unknowns:
        return []
    own = _own_noise(bound)
    scale = {name: own[name.partition(" ")[0]] for name in bound.noise_labels.names}
    alike = bound.with_noise(scale).thinned(JUDGED_ROWS)
    fit = lm(alike)
    if not fit.converged:
        return []
    least, worst = _least_expected(alike, fit.x)
    if least > BY_CHANCE:
        return []
    name, count = problem.names[worst], len(bound.samples[worst])
    others = {each: UNWEIGHTED if each.partition(" ")[0] == name else scale[each] for each in scale}
    without = lm(alike.with_noise(others), start=fit.x)
    joints, instrument = workspace_joints(problem.robot), int(worst == 0)
    tips, slopes = (f(without.x, joints, instrument) for f in (alike.tips, alike.tip_jacobian))
    moved = tip_rms(without_rigid((alike.tips(fit.x, joints, instrument) - tips).ravel(), tips))
    promised = spread_rms(without.covariance, slopes, tips)
    if not without.converged or not moved > MOVED * promised:
        return []
    those = [each for each in problem.names if each != name]
    cause = (
        f"{counted(count, 'row')} of {name} {'is' if count == 1 else 'are'} not where {listed(those)} "
        f"expect{'s' if len(those) == 1 else ''} {'it' if count == 1 else 'them'} ({chance(least)}), and would move "
        f"the tip by {mm(moved)}, where {mm(promised)} was left open"
    )
    fix = f"Check unit, sign, frame, tool and noise of {name}, and what is shared with it; or leave its rows out"
    return [Finding("error", "instruments contradict each other", cause, fix)]


def _least_expected(bound: BoundProblem, x: Array) -> tuple[float, int]:
    """The instrument whose rows the others expect least at the minimum x (n,), after the chance of rows so far off.

    With e the whitened residuals of its rows and H their part of the hat matrix, e' (1 - H)^-1 e is chi-square where
    all agree: the residuals that the others predict, weighed by their covariance (Cook and Weisberg 1982).
    """
    basis, residual = spanned(np.vstack([bound.jacobian(x), bound.prior_rows])), bound.residual(x)
    found = list[tuple[float, int]]()
    for i in range(len(bound.samples)):
        rows = bound.sample_rows(i)
        along, sizes, _ = svd(basis[rows])
        left, pulled = 1.0 - sizes**2, (along.T @ residual[rows]) ** 2
        judged = left > HELD
        square = float(residual[rows] @ residual[rows] + (pulled[judged] * sizes[judged] ** 2 / left[judged]).sum())
        freedom = rows.stop - rows.start - int((~judged).sum())
        found.append((chance_beyond(square, freedom) if freedom > 0 else 1.0, i))
    return min(found)


def _own_noise(bound: BoundProblem) -> dict[str, float]:
    """Found over stated noise of each instrument by itself, one or more; of one with too few rows the largest other."""
    found = dict[str, float]()
    for alone in each_alone(bound.problem, bound.samples):
        try:
            part = bind(alone.problem, alone.samples)
        except CasacalError:  # it cannot be fitted without the others
            continue
        if part.rows - effective_unknowns(part, part.x0) >= FEWEST:
            found[alone.name] = max(found_noise(part).ratio, 1.0)
    largest = max(found.values(), default=1.0)
    return {name: found.get(name, largest) for name in bound.problem.names}
