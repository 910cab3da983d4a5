"""Who takes turns in the speed study: a dict of names and calls for each task on a case; and the taking of turns."""

import time
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import least_squares

from casacal import ekf, ipopt, lm, sckf
from casacal.fit import BoundProblem
from casacal.kernels.block_rows import Batch
from studies.speed_case import CANDIDATES, ByHand, Case, kernels

try:  # another library's filter, where it is installed
    from filterpy.kalman import CubatureKalmanFilter
except ImportError:
    CubatureKalmanFilter = None
try:  # Ceres, where the extra `bench` is installed
    import pyceres
except ImportError:
    pyceres = None

Contenders = dict[str, Callable[[], object]]

LIMIT, PAST, PRINTED, BLOCKS, MAP = "C by hand", "C by hand, past the caches", "c", "blocks", "CasADi map"
LIMIT_TWO = "C by hand, two threads"
TWO, SCIPY, CERES = "c, two threads", "SciPy lm, same kernels", "Ceres (pyceres), same kernels"
FILTERPY, CROSS_CHECK, MX_HESSIAN = "filterpy, same h", "casacal", "CasADi's MX map and Hessian"
NOISE = 1 / 0.05
TURN, LEAST = 0.002, 21
"""Seconds; turns."""
FEW = 10_000
"""Rows beyond which the slow contenders stay away."""


def medians(contenders: Contenders, seconds: float) -> dict[str, float]:
    """Median time (s) of a call of each, all taking turns until the time is up, `LEAST` turns at least.

    A turn is as many calls as fill `TURN`, as in a loop that calls again and again; what comes first is not timed.
    """
    calls = {}
    for name, call in contenders.items():
        call()
        began = time.perf_counter()
        call()
        calls[name] = max(1, round(TURN / (time.perf_counter() - began)))
    times: dict[str, list[float]] = {name: [] for name in contenders}
    ends = time.perf_counter() + seconds
    while time.perf_counter() < ends or min(map(len, times.values())) < LEAST:
        for name, call in contenders.items():
            began = time.perf_counter()
            for _ in range(calls[name]):
                call()
            times[name].append((time.perf_counter() - began) / calls[name])
    return {name: float(np.median(values)) for name, values in times.items()}


def both(made: Case) -> list[tuple[str, BoundProblem]]:
    """The case on the back ends that work here."""
    return [(name, bound) for name, bound in ((PRINTED, made.c), (BLOCKS, made.blocks)) if bound is not None]


def slopes(made: Case) -> Contenders:
    """Residual and Jacobian of all rows."""
    found: Contenders = {LIMIT: ByHand(made).slopes(), PAST: ByHand(made).slopes(past=True)}
    for name, bound in both(made):
        kernel, p, lanes = kernels(bound)
        found[name] = lambda kernel=kernel, p=p, lanes=lanes: kernel.slopes(p, lanes)
    if made.blocks.rows > 100_000:
        return found
    (block,) = made.blocks.blocks
    batch, z = Batch(block.model.jacobian), made.blocks.x0[block.columns[0]]
    return {**found, MAP: lambda: batch(z, block.constants[0], block.data)}


def normal(made: Case) -> Contenders:
    """Normal equations, accumulated."""
    found: Contenders = {LIMIT: ByHand(made).normal}
    for name, bound in both(made):
        kernel, p, lanes = kernels(bound)
        found[name] = lambda kernel=kernel, p=p, lanes=lanes: kernel.normal(p, lanes)
    two, x = made.two, made.two.x0
    return {**found, LIMIT_TWO: ByHand(made).normal_by_two(), TWO: lambda: two.normal(x)}


def fits(made: Case) -> Contenders:
    """Whole fits from the drawing."""
    found: Contenders = {LIMIT: ByHand(made, evaluations=lm(made.best).residual_rows // made.blocks.rows).lm}
    for name, bound in both(made):
        found[name] = lambda bound=bound: lm(bound)
        if name == PRINTED:  # what is compared stands side by side, for a shared machine changes its pace
            found[TWO] = lambda: lm(made.two)
    if made.blocks.rows > 10 * FEW:
        return found
    best = made.best
    scale, pull = best.start_std, np.sqrt(np.diagonal(best.prior_information)) * best.start_std

    def residual(y: np.ndarray) -> np.ndarray:
        return np.concatenate([best.residual(scale * y), pull * y])

    def jacobian(y: np.ndarray) -> np.ndarray:
        return np.vstack([best.jacobian(scale * y) * scale, np.diag(pull)])

    found[SCIPY] = lambda: least_squares(residual, np.zeros(27), jacobian, method="lm")
    if best.rows <= FEW:
        found["SciPy lm, 2-point"] = lambda: least_squares(residual, np.zeros(27), method="lm")
    return found if pyceres is None else {**found, CERES: by_ceres(best)}


def by_ceres(bound: BoundProblem) -> Callable[[], np.ndarray]:
    """A fit by Ceres: one residual block of all rows and the prior, dense Cholesky, one thread, tight tolerances."""
    kernel, p, lanes = kernels(bound)
    scale, pull, rows = bound.start_std, np.sqrt(np.diagonal(bound.prior_information)) * bound.start_std, bound.rows
    weighted = scale * NOISE

    class Touches(pyceres.CostFunction):
        """All rows, then the prior."""

        def __init__(self) -> None:
            super().__init__()
            self.set_num_residuals(rows + 27)
            self.set_parameter_block_sizes([27])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
            y = parameters[0]
            here = np.concatenate([scale * y, p[27:]])
            if jacobians is None or jacobians[0] is None:
                residuals[:rows] = kernel.residual(here, lanes)[0] * NOISE
            else:
                e, j = kernel.slopes(here, lanes)
                residuals[:rows] = e[0] * NOISE
                whole = jacobians[0].reshape(rows + 27, 27)
                np.multiply(j[0].T, weighted, out=whole[:rows])
                whole[rows:] = np.diag(pull)
            residuals[rows:] = pull * y
            return True

    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_NORMAL_CHOLESKY
    options.logging_type = pyceres.LoggingType.SILENT
    options.function_tolerance, options.gradient_tolerance, options.parameter_tolerance = 1e-12, 1e-12, 1e-10
    options.num_threads = 1

    def solve() -> np.ndarray:
        y, problem, summary = np.zeros(27), pyceres.Problem(), pyceres.SolverSummary()
        problem.add_residual_block(Touches(), None, [y])
        pyceres.solve(options, problem, summary)
        return scale * y

    return solve


def filters(made: Case) -> Contenders:
    """One pass of the cubature filter over the rows; casacal's extended filter beside it."""
    found: Contenders = {LIMIT: ByHand(made).filter}
    for name, bound in both(made):
        found[name] = lambda bound=bound: sckf(bound)
        found[f"extended filter, {name}"] = lambda bound=bound: ekf(bound)
    bound, scale = made.best, made.best.start_std

    def predicted(y: np.ndarray, k: int) -> np.ndarray:
        return bound.row(k, (scale * y.ravel())[None])

    def theirs() -> None:
        other = CubatureKalmanFilter(27, 1, 1.0, hx=predicted, fx=lambda x, _: x)
        other.x, other.P, other.R, other.Q = np.zeros((27, 1)), np.eye(27), np.eye(1), np.zeros((27, 27))
        for k in range(bound.rows):
            other.predict()
            other.update(np.zeros((1, 1)), hx_args=(k,))

    return found if CubatureKalmanFilter is None else {**found, FILTERPY: theirs}


def candidates(made: Case) -> Contenders:
    """Objective of a hundred candidates."""
    found: Contenders = {LIMIT: ByHand(made).costs}
    for name, bound in both(made):
        states = np.tile(bound.x0, (CANDIDATES, 1))
        found[name] = lambda bound=bound, states=states: bound.costs(states)
    return found


def checks(made: Case) -> Contenders:
    """The cross-check by IPOPT, everything but importing included, on derivatives of two makings."""
    bound = made.blocks
    (block,), (rows,) = bound.graph.blocks, bound.blocks
    residual, start, n = rows.model.raw_residual, bound.graph.start, bound.rows

    def by_casadi() -> object:
        v, w = ca.MX.sym("v", start.size), ca.DM(1 / rows.noise.T)
        mapped = residual.map(n)(v[block.columns.tolist()], ca.DM(block.constants), ca.DM(rows.rows(slice(None)).T))
        prior = ca.dot(ca.DM(np.diagonal(bound.prior_information)), (bound.graph.local(v) - bound.x0) ** 2)
        program = {"x": v, "f": (ca.sumsqr(w * mapped) + prior) / 2, "g": bound.graph.constraints(v)}
        quiet = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.linear_solver": "mumps"}
        return ca.nlpsol("plain", "ipopt", program, quiet)(x0=start, lbg=0, ubg=0)

    return {MX_HESSIAN: by_casadi, CROSS_CHECK: lambda: ipopt(bound)}


BY_ROWS = {"Residual and Jacobian": slopes, "Normal equations": normal, "LM from the drawing": fits}
AT_120 = {
    "One pass of the cubature filter, and of the extended one": filters,
    f"{CANDIDATES} candidates": candidates,
    "Cross-check by IPOPT": checks,
}
