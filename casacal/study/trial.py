"""One trial: every method on the same problem, timed, counted from outside and judged; failures are records too."""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import os
import random
import time
import timeit
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from casacal.errors import said
from casacal.fit.least_squares import DampedStep, ExtendedPass, FilterPass, LeastSquares, Normal, Result, as_result
from casacal.kernels.losses import Loss
from casacal.study.description import TIMINGS, Key, Record, Study, Trial
from casacal.values import Array


class Metered(LeastSquares):
    """Problem that counts residual and Jacobian rows and keeps the best objective so far.

    best: one (residual rows, Jacobian rows, objective) each time an estimator evaluates a lower objective.
    used_graph: whether a symbolic form was taken, beyond which nothing can be counted here.
    """

    def __init__(self, problem: LeastSquares) -> None:
        self.problem = problem
        self.names, self.units, self.x0 = problem.names, problem.units, problem.x0.copy()
        self.prior_std, self.start_std = problem.prior_std.copy(), problem.start_std.copy()
        self.datum, self.known, self.constraints = problem.datum.copy(), problem.known, problem.constraints
        self.residual_rows, self.jacobian_rows, self.used_graph = 0, 0, False
        self.best: list[tuple[int, int, float]] = []

    @property
    def graph(self) -> Any:
        """The symbolic form."""
        self.used_graph = True
        return self.problem.graph

    @property
    def symbolic(self) -> Any:
        """The rows as CasADi expressions, evaluated where nobody can count."""
        self.used_graph = True
        return self.problem.symbolic

    @property
    def rows(self) -> int:
        """Number of scalar residuals."""
        return self.problem.rows

    def residual(self, x: Array) -> Array:
        """Whitened residuals (rows,)."""
        r = self.problem.residual(x)
        self._count(self.rows, 0)
        self._note_cost(float(r @ r) / 2 + self.prior_cost(x))
        return r

    def jacobian(self, x: Array) -> Array:
        """Whitened Jacobian (rows, n)."""
        self._count(0, self.rows)
        return self.problem.jacobian(x)

    def normal(self, x: Array, loss: Loss | None = None) -> Normal:
        """Cost, gradient and information of the data."""
        normal = self.problem.normal(x, loss)
        self._count(self.rows, self.rows)
        if loss is None:
            self._note_cost(normal.cost + self.prior_cost(x))
        return normal

    def damped_step(self, x: Array, normal: Normal, damping: float) -> DampedStep | None:
        """A damped step, which costs no rows."""
        return self.problem.damped_step(x, normal, damping)

    def compact_jacobian(self, x: Array) -> Array:
        """Rows with the J'J of the Jacobian."""
        self._count(0, self.rows)
        return self.problem.compact_jacobian(x)

    def costs(self, states: Array, loss: Loss | None = None) -> Array:
        """Objective at many states (m,)."""
        found = self.problem.costs(states, loss)
        self._count(self.rows * len(states), 0)
        if loss is None:
            self._note_cost(float(np.min(found, initial=math.inf)))
        return found

    def filter_pass(self, first: int, mean: Array, root: Array) -> FilterPass | None:
        """A fused filter, whose rows see 2 n states each."""
        done = self.problem.filter_pass(first, mean, root)
        if done is not None:
            self._count(2 * self.unknowns * (done.stop - first), 0)
        return done

    def extended_pass(self, mean: Array, covariance: Array) -> ExtendedPass | None:
        """A fused extended filter, which sees each row and its gradient once."""
        done = self.problem.extended_pass(mean, covariance)
        if done is not None:
            self._count(self.rows, self.rows)
        return done

    def row(self, k: int, states: Array) -> Array:
        """Whitened residual k at many states (m,)."""
        self._count(len(states), 0)
        return self.problem.row(k, states)

    def row_jacobian(self, k: int, x: Array) -> tuple[float, Array]:
        """Whitened residual k and its gradient."""
        self._count(1, 1)
        return self.problem.row_jacobian(k, x)

    def _count(self, residual_rows: int, jacobian_rows: int) -> None:
        self.residual_rows += residual_rows
        self.jacobian_rows += jacobian_rows

    def _note_cost(self, cost: float) -> None:
        if math.isfinite(cost) and (not self.best or cost < self.best[-1][2]):
            self.best.append((self.residual_rows, self.jacobian_rows, cost))


@dataclass(frozen=True)
class Task:
    """Some methods in one trial of a setting, and the key of each."""

    setting: str
    trial: int
    methods: tuple[str, ...]
    fingerprints: tuple[str, ...]

    @property
    def keys(self) -> list[Key]:
        """Key of each record that the task makes."""
        return [(fingerprint, self.trial) for fingerprint in self.fingerprints]

    def without(self, done: Iterable[Key]) -> Task:
        """The task without the methods that are recorded already."""
        recorded, pairs = set(done), zip(self.methods, self.fingerprints, strict=True)
        kept = [(method, key) for method, key in pairs if (key, self.trial) not in recorded]
        return replace(self, methods=tuple(m for m, _ in kept), fingerprints=tuple(key for _, key in kept))


@contextlib.contextmanager
def undone(seed: int) -> Iterator[None]:
    """Restore afterwards: folder, environment, error handling of NumPy, warnings, and the common random numbers.

    These begin at a seed, so that a method which draws from them does the same whatever ran before. Overflow is silent.
    """
    folder, environment = _folder(), dict(os.environ)
    drawn = random.getstate(), np.random.get_state()  # noqa: NPY002  the common one is what is meant
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            yield
    finally:
        random.setstate(drawn[0])
        np.random.set_state(drawn[1])  # noqa: NPY002
        if os.environ != environment:
            os.environ.clear()
            os.environ.update(environment)
        if folder is not None and _folder() != folder:
            with contextlib.suppress(OSError):
                os.chdir(folder)


def _folder() -> str | None:
    """The working folder; None where it was removed."""
    try:
        return os.getcwd()
    except OSError:
        return None


POINTS = 24  # points that a record keeps of the way to the estimate
CANDIDATES = 64  # states evaluated at once while warming up: what population methods ask for


def heads(study: str, task: Task) -> list[Record]:
    """Provenance in the records of a task."""
    shared = {"study": study, "setting": task.setting, "trial": task.trial}
    return [
        {**shared, "method": method, "fingerprint": key}
        for method, key in zip(task.methods, task.fingerprints, strict=True)
    ]


def trial_records(study: Study, task: Task) -> Iterator[Record | None]:
    """Records of some methods in one trial of a setting, as they are made; None once the trial itself is.

    A method that changed the problem all share is a failure, and those after it get the problem made anew.
    """
    waiting = heads(study.name, task)
    while waiting:
        try:
            made = study.settings[task.setting].trial(study.trial_seed(task.trial))
            rows = warm_up(made.problem)
            before = _state(made.problem)
        except _caught() as error:  # a cell out of reach fails every method, and the study goes on
            yield from ({**head, **failed(said(error))} for head in waiting)
            return
        yield None
        intact = True
        while waiting and intact:
            head = waiting.pop(0)
            record = _measured(study, made, head["method"], task.trial, rows)
            intact = _unchanged(made.problem, before)
            yield {**head, **(record if intact else failed("Changed: the method changed the problem that all share"))}


def perform(study: Study, task: Task) -> list[Record]:
    """Records of a task."""
    return [record for record in trial_records(study, task) if record is not None]


def _caught() -> tuple[type[BaseException], ...]:
    """Exceptions that count as a method's own failure: all of them, in a worker without keyboard."""
    if multiprocessing.parent_process() is not None:
        return (BaseException,)
    return (Exception, SystemExit)


def _state(problem: LeastSquares) -> list[Array]:
    """State of a problem as methods see it, for comparison."""
    with np.errstate(all="ignore"):
        return [problem.x0.copy(), problem.prior_std.copy(), problem.start_std.copy(), problem.residual(problem.x0)]


def _unchanged(problem: LeastSquares, before: list[Array]) -> bool:
    try:
        pairs = zip(_state(problem), before, strict=True)
        return all(np.array_equal(one, other, equal_nan=True) for one, other in pairs)
    except _caught():
        return False


def warm_up(problem: LeastSquares) -> dict[str, float]:
    """Use every function of a problem once, and return what a row of residuals and of Jacobian costs, in seconds."""
    x, many = problem.x0, np.tile(problem.x0, (CANDIDATES, 1))
    problem.normal(x)
    problem.costs(many)
    problem.costs(many[:1])
    problem.row(0, np.tile(x, (2 * problem.unknowns, 1)))
    problem.row_jacobian(0, x)
    per = {"residual_row": problem.residual, "jacobian_row": problem.jacobian}
    return {name: min(timeit.repeat(partial(call, x), number=1)) / problem.rows for name, call in per.items()}


def _measured(study: Study, made: Trial, method: str, trial: int, rows: dict[str, float]) -> Record:
    metered, run = Metered(made.problem), study.method(method)
    seed = study.method_seed(trial, method)
    began, began_cpu = time.perf_counter(), time.process_time()
    try:
        with undone(seed):
            outcome = run(metered, seed)
        spent = {"solve": time.perf_counter() - began, "cpu": time.process_time() - began_cpu, **rows}
        with np.errstate(all="ignore"):  # what overflows is found below, and said in a sentence
            result = as_result(outcome, made.problem, method)
            figures = dict(made.judge(result))
            detail: Record = {}
            if trial < study.details:  # curves need some trials; what a parameter table looks like shows in one
                detail = {"detail": dict(made.detail(result))} if trial == 0 else {}
                detail["trace"] = _trace(made.problem, metered, result)
    except _caught() as error:  # failures are rows with their message
        spent = {"solve": time.perf_counter() - began, "cpu": time.process_time() - began_cpu, **rows}
        return {**failed(said(error)), TIMINGS: spent}
    counts = (metered.residual_rows, metered.jacobian_rows)
    if metered.used_graph:  # its evaluations happen inside the solver, which counts them itself
        counts = (result.residual_rows, result.jacobian_rows)
    return {
        "status": result.status.name,
        "converged": result.converged,
        "error": None,
        "figures": {name: float(value) for name, value in figures.items()},
        "counts": {"steps": int(result.steps), "residual_rows": counts[0], "jacobian_rows": counts[1]},
        **detail,
        TIMINGS: spent,
    }


def failed(message: str) -> Record:
    """Record of a method that failed, with its message."""
    return {"status": "FAILED", "converged": False, "error": message, "figures": {}, "counts": {}, TIMINGS: {}}


def _trace(problem: LeastSquares, metered: Metered, result: Result) -> list[list[float]]:
    """The objective on the way: rows of residuals, rows of Jacobian, objective.

    Best so far as the harness saw it; for a filter, the objective over all rows at its estimate so far; for a solver
    on the symbolic form, what it says itself, evenly over its evaluations.
    """
    if metered.used_graph:
        costs = np.asarray(result.trace.get("cost", np.zeros(0)))
        parts = np.arange(1, costs.size + 1) / max(costs.size, 1)
        at, steep = result.residual_rows, result.jacobian_rows
        return _thinned([[p * at, p * steep, c] for p, c in zip(parts, costs, strict=True)])
    path = result.trace.get("filter_x", result.trace.get("x"))
    best = [list(map(float, point)) for point in metered.best]
    best += [[float(metered.residual_rows), float(metered.jacobian_rows), best[-1][2]]] if best else []
    if path is None:
        return _thinned(best)
    # rows of the filter alone: before the first whole evaluation, if one followed
    spent = (metered.residual_rows, metered.jacobian_rows)
    rows = spent if not metered.best else tuple(max(count - problem.rows, 0) for count in metered.best[0][:2])
    chosen = np.unique(np.linspace(0, len(path) - 1, POINTS).astype(int))
    parts = chosen / max(len(path) - 1, 1)
    passed = [[p * rows[0], p * rows[1], problem.cost(path[k])] for k, p in zip(chosen, parts, strict=True)]
    return passed + _thinned(best)


def _thinned(points: list[list[float]]) -> list[list[float]]:
    if len(points) <= POINTS:
        return points
    chosen = np.unique(np.geomspace(1, len(points), POINTS).astype(int) - 1)
    return [points[k] for k in chosen]
