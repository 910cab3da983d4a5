"""Kalman filters for static parameters: square-root cubature (10)-(24), extended, and SCKF followed by LM (M7).

Rows are taken one by one. References: arXiv:2208.02652, section III, with its errata; Arasaratnam and Haykin,
Cubature Kalman Filters, IEEE Transactions on Automatic Control 54 (2009).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from casacal.fit.least_squares import ExtendedPass, FilterPass, LeastSquares, Result, Status, nothing_unknown
from casacal.fit.lm import MAX_STEPS, lm
from casacal.kernels.losses import Loss
from casacal.linalg import LEAST_SLOPE, downdated, nearest, svd, tria
from casacal.values import Array, Value


@dataclass(frozen=True, eq=False)
class Belief(Value):
    """A Gaussian over the unknowns: mean (n,) and lower triangular square root of the covariance (n, n)."""

    mean: Array
    root: Array


@dataclass(frozen=True)
class Update:
    """A filter's step: the new belief, the innovation z - z' and its standard deviation."""

    belief: Belief
    innovation: float
    innovation_std: float


def predict(belief: Belief, process_root: Array | None) -> Belief:
    """Let constant parameters drift: S <- Tria([S, S_Q]), eq (14) of arXiv:2208.02652 with erratum E10 corrected.

    `process_root` is S_Q (n, n), or None for no drift.
    """
    if process_root is None:
        return belief
    return Belief(belief.mean, tria(np.hstack([belief.root, process_root])))


def cubature_update(belief: Belief, h: Callable[[Array], Array], measured: float, noise_std: float) -> Update:
    """Take in one scalar measurement: eqs (15)-(24) of arXiv:2208.02652, with errata E9-E12 corrected.

    Square-root form of Arasaratnam and Haykin 2009, section VII.

    Args:
        belief: over n unknowns, best in prior-scaled coordinates, so that the points stay where h is smooth.
        h: predicted measurement (m,) at many states (m, n).
        measured: z.
        noise_std: standard deviation S_R of its error.

    """
    n = belief.mean.size
    offsets = math.sqrt(n) * belief.root.T  # row i is sqrt(n) S e_i
    points = np.vstack([belief.mean + offsets, belief.mean - offsets])  # E12: drawn from the predicted belief
    predictions = h(points)  # E11: what the model predicts, not the state itself
    mean = float(predictions.mean())
    spread = (predictions - mean) / math.sqrt(2 * n)  # calZ
    innovation_std = math.hypot(float(np.linalg.norm(spread)), noise_std)  # S_zz: Tria of one row is its length
    # calX = [S, -S] / sqrt(2), so calX calZ' = S v
    v = (spread[:n] - spread[n:]) / math.sqrt(2)
    gain = belief.root @ v / innovation_std**2
    innovation = measured - mean
    root = downdated(belief.root, v / innovation_std)
    if root is None:  # the measurement tells all there is, to rounding: the full triangularisation keeps S real
        states = np.hstack([belief.root, -belief.root]) / math.sqrt(2)
        root = tria(np.hstack([states - np.outer(gain, spread), noise_std * gain[:, None]]))
    return Update(Belief(belief.mean + gain * innovation, root), innovation, innovation_std)


def told(belief: Belief, rows: Array, values: Array) -> Belief:
    """Take in A x = b exactly, A (m, n) and b (m,): a measurement update without noise.

    With U S V' = A R, R the root: the mean moves by R V S^-1 U'(b - A x), and R (I - V V') is left of the root.
    """
    left, sizes, right = svd(rows @ belief.root)
    kept = sizes > LEAST_SLOPE * sizes.max(initial=0.0)
    seen, white = right[kept], (left.T @ (values - rows @ belief.mean))[kept] / sizes[kept]
    return Belief(belief.mean + belief.root @ (seen.T @ white), tria(belief.root - (belief.root @ seen.T) @ seen))


def begun(problem: LeastSquares) -> Belief:
    """The belief before any row, in units of `start_std` about x0: the prior, told of the equalities."""
    belief = Belief(np.zeros(problem.unknowns), problem.prior_root)
    if problem.constraints is None:
        return belief
    known, x = problem.constraints.part(problem.constraints.equalities), problem.feasible(problem.x0)
    rows = known.evaluate(x)[1] * problem.start_std
    return told(belief, rows, rows @ ((x - problem.x0) / problem.start_std))


BENDS = 8  # times that bounds are linearised anew: each time they bend a square less


def settled(problem: LeastSquares, belief: Belief) -> Belief:
    """The belief after all rows, within the constraints: both in units of `start_std` about x0.

    The mean is brought onto curved equalities, and the covariance turned into their tangent. Where it crosses bounds it
    becomes the point within them that is nearest in the metric of the covariance, and the bounds that hold it there are
    taken in as equalities: exact for a linear problem. A mean that nothing brings within stays where the rows left it.
    """
    known, scale = problem.constraints, problem.start_std
    if known is None or not np.isfinite(belief.root).all():
        return belief
    equal, bounds = known.part(known.equalities), known.part(~known.equalities)
    if (x := equal.restored(problem.x0 + scale * belief.mean)) is None:
        return belief
    rows = equal.evaluate(x)[1] * scale
    belief = Belief((x - problem.x0) / scale, belief.root - np.linalg.pinv(rows) @ (rows @ belief.root))
    found = belief
    for _ in range(BENDS):
        (_, _, above, least), y = bounds.linearised(x), (x - problem.x0) / scale
        step = nearest(above @ belief.root, least + above @ (y - belief.mean))
        if step is None or not step[1].any():
            break
        found = told(belief, above[step[1]], (least + above @ y)[step[1]])
        if (at := equal.restored(problem.x0 + scale * found.mean)) is None:
            break
        x, found = at, replace(found, mean=(at - problem.x0) / scale)
    return found


def take_in(problem: LeastSquares, belief: Belief, first: int, process_root: Array | None = None) -> FilterPass:
    """Take in the next rows from `first` on: as many as kernels do at once, or one.

    belief: in units of `start_std` about x0. process_root: by how much unknowns drift before each row, or None.
    """
    fused = problem.filter_pass(first, belief.mean, belief.root) if process_root is None else None
    if fused is not None and fused.stop > first:
        return fused
    x0, scale = problem.x0, problem.start_std
    predicted = predict(belief, process_root)
    update = cubature_update(predicted, lambda states: problem.row(first, x0 + scale * states), 0.0, 1.0)
    innovation = np.array([update.innovation]), np.array([update.innovation_std])
    return FilterPass(first + 1, update.belief.mean, update.belief.root, update.belief.mean[None], *innovation)


def sckf(
    problem: LeastSquares, *, process_std: Array | None = None, progress: Callable[[int, float], None] | None = None
) -> Result:
    """One pass of the filter over the rows, from the prior (flat: `start_std`) to the posterior of f.

    One pass only: a second one would count the data twice. With constraints the pass begins with what equalities say
    (`begun`) and ends within all of them (`settled`); `x` of the trace has what the rows alone led to.

    Args:
        problem: its rows are measurements of zero with unit noise, in whitened units.
        process_std: standard deviation (n,) by which each unknown drifts between rows; default none.
        progress: called with (rows done, norm of the innovation) now and then.

    Returns the mean after the last row; the trace holds means `x` (rows + 1, n), innovations and their stds (rows,).

    """
    if not problem.unknowns:
        return nothing_unknown(problem, "sckf")
    scale = problem.start_std
    process = None if process_std is None else np.diag(process_std / scale)
    belief = begun(problem)
    trace: tuple[list[Array], ...] = ([problem.x0[None]], [np.zeros(0)], [np.zeros(0)])
    k = 0
    while k < problem.rows:
        taken = take_in(problem, belief, k, process)
        belief, k = Belief(taken.mean, taken.root), taken.stop
        done = (problem.x0 + scale * taken.means, taken.innovations, taken.stds)
        for kept, some in zip(trace, done, strict=True):
            kept.append(some)
        if progress is not None:
            progress(k, abs(float(trace[1][-1][-1])))
    belief = settled(problem, belief)
    root = scale[:, None] * belief.root
    states, innovation, innovation_std = (np.concatenate(kept) for kept in trace)
    finite = bool(np.isfinite(belief.mean).all() and np.isfinite(root).all())
    return Result(
        method="sckf",
        problem=problem,
        x=problem.x0 + scale * belief.mean,
        belief=root @ root.T,
        status=Status.ONE_PASS if finite else Status.NOT_FINITE,
        trace={"innovation": innovation, "innovation_std": innovation_std, "x": states},
        steps=problem.rows,
        residual_rows=2 * problem.unknowns * problem.rows,
        jacobian_rows=0,
    )


def linear_update(
    mean: Array, covariance: Array, gradient: Array, innovation: float, noise_std: float
) -> tuple[Array, Array, float]:
    """Take in one scalar measurement linearised at the mean; returns mean, covariance and innovation std.

    Joseph's form, which keeps the covariance symmetric and positive.

    Args:
        mean, covariance: belief (n,), (n, n).
        gradient: of the predicted measurement at the mean (n,).
        innovation: measured minus predicted.
        noise_std: standard deviation of the measurement's error.

    """
    cross = covariance @ gradient
    variance = float(gradient @ cross) + noise_std**2
    gain = cross / variance
    half = covariance - np.outer(gain, cross)  # (I - K g') P, which as a matrix product loses a digit more
    updated = half - np.outer(half @ gradient - noise_std**2 * gain, gain)
    return mean + gain * innovation, (updated + updated.T) / 2, math.sqrt(variance)


def ekf(problem: LeastSquares, *, progress: Callable[[int, float], None] | None = None) -> Result:
    """One pass of the filter over the rows, from the prior (flat: `start_std`) to the posterior of f.

    Constraints as for `sckf`.

    Args:
        problem: its rows are measurements of zero with unit noise, in whitened units.
        progress: called with (rows done, size of the innovation) now and then.

    Returns the mean after the last row; the trace holds means `x` (rows + 1, n), innovations and their stds (rows,).

    """
    if not problem.unknowns:
        return nothing_unknown(problem, "ekf")
    scale = problem.start_std
    first = begun(problem)
    mean, covariance = first.mean, first.root @ first.root.T
    done = problem.extended_pass(mean, covariance)
    if done is None:  # no kernel takes in all rows
        moved, innovations, stds = np.empty((problem.rows, mean.size)), np.empty(problem.rows), np.empty(problem.rows)
        for k in range(problem.rows):
            predicted, gradient = problem.row_jacobian(k, problem.x0 + scale * mean)
            innovations[k] = -predicted
            mean, covariance, stds[k] = linear_update(mean, covariance, scale * gradient, -predicted, 1.0)
            moved[k] = mean
            if progress is not None:
                progress(k + 1, abs(predicted))
        done = ExtendedPass(mean, covariance, moved, innovations, stds)
    elif progress is not None and problem.rows:
        progress(problem.rows, abs(float(done.innovations[-1])))
    finite = bool(np.isfinite(done.mean).all() and np.isfinite(done.covariance).all())
    means = np.vstack([problem.x0, problem.x0 + scale * done.means])
    if finite and problem.constraints is not None:
        values, vectors = np.linalg.eigh(done.covariance)  # which equalities leave without full rank
        last = settled(problem, Belief(done.mean, vectors * np.sqrt(np.maximum(values, 0.0))))
        done = replace(done, mean=last.mean, covariance=last.root @ last.root.T)
    return Result(
        method="ekf",
        problem=problem,
        x=problem.x0 + scale * done.mean,
        belief=scale[:, None] * done.covariance * scale,
        status=Status.ONE_PASS if finite else Status.NOT_FINITE,
        trace={"innovation": done.innovations, "innovation_std": done.stds, "x": means},
        steps=problem.rows,
        residual_rows=problem.rows,
        jacobian_rows=problem.rows,
    )


UNUSUAL = 5.0  # standard deviations above its mean at which a chi-square calls for an explanation


def sckf_lm(
    problem: LeastSquares,
    *,
    max_steps: int = MAX_STEPS,
    tolerance: float = 1e-9,
    loss: Loss | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Result:
    """Minimise f from the filter's estimate; the prior stays where it was, so the data count once.

    The minimum is that of `lm`: the filter gives another start, not more accuracy. Where that start leads to no
    minimum, or to one that is too high for the stated noise and priors, the drawing is tried as well and the lower
    minimum kept. With a loss the filter still takes every row at its full weight, `lm` not. Arguments as for `lm`.
    """
    if not problem.unknowns:
        return nothing_unknown(problem, "sckf-lm")
    part, places = problem.first_part() or (problem, np.arange(problem.unknowns))
    filtered = sckf(part, progress=progress)
    path = np.tile(problem.x0, (len(filtered.trace["x"]), 1))  # unknowns that the filter was spared stay at the nominal
    path[:, places] = filtered.trace["x"]
    start = path[-1] if filtered.converged else None
    tried = [lm(problem, start=start, max_steps=max_steps, tolerance=tolerance, loss=loss, progress=progress)]
    # at the true minimum 2 f is a chi-square with a degree for each row; above it a lower one may stand elsewhere
    likely = problem.rows + UNUSUAL * math.sqrt(2 * problem.rows)
    if start is not None and (not tried[0].converged or 2 * tried[0].cost > likely):
        tried.append(lm(problem, max_steps=max_steps, tolerance=tolerance, loss=loss, progress=progress))
    refined = min(tried, key=lambda found: (not found.converged, found.cost))
    return replace(
        refined,
        method="sckf-lm",
        trace={**refined.trace, "filter_x": path},
        residual_rows=filtered.residual_rows + sum(found.residual_rows for found in tried),
        jacobian_rows=filtered.jacobian_rows + sum(found.jacobian_rows for found in tried),
    )
