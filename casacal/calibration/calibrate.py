"""The main job: fit, hold out, compare with before, and cross-check with the reference."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

from casacal.binding.bound_problem import BoundProblem, bind
from casacal.calibration.calibrated import Calibrated
from casacal.calibration.calibration import Reference
from casacal.errors import CasacalError, SamplesError, UnknownNameError
from casacal.estimators import annealing, ekf, evolution, ipopt, lm, plane_only, sckf, sckf_lm, swarm
from casacal.least_squares.losses import Loss
from casacal.least_squares.result import Result
from casacal.problem.problem import Problem
from casacal.samples.holdout import split
from casacal.samples.samples import Samples

Progress: TypeAlias = Callable[[int, float], None]

METHODS: Mapping[str, Callable[..., Result]] = {
    "lm": lm,
    "sckf": sckf,
    "sckf-lm": sckf_lm,
    "ekf": ekf,
    "annealing": annealing,
    "swarm": swarm,
    "evolution": evolution,
    "ipopt": ipopt,
    "plane-only": plane_only,
}
"""The names the command line knows."""

RANDOM = ("annealing", "swarm", "evolution")
"""Methods that draw random numbers."""


def calibrate(
    problem: Problem,
    samples: Samples,
    *,
    method: str | None = None,
    holdout: float = 0.0,
    seed: int = 0,
    reference: bool = True,
    loss: Loss | None = None,
    backend: str | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Calibrated:
    """Fit the unknowns of a problem with one instrument to its samples.

    Args:
        problem: robot and instrument.
        samples: rows of that instrument.
        method: a name of `METHODS`; by default "sckf-lm", and "lm" with a loss.
        holdout: part of each plane's rows (0 to below 1) that is not fitted but judged.
        seed: of the choice of those rows, and of methods that draw random numbers.
        reference: whether an independent solver checks the minimum; it knows no robust loss.
        loss: a robust loss, for the method "lm" alone.
        backend, threads: what evaluates the rows, as for `bind`.
        progress: called with (step, cost) now and then.

    Raises UnknownNameError for the method, SamplesError when too few rows remain, ProblemError as `bind` does.

    """
    method = method or ("sckf-lm" if loss is None else "lm")
    if method not in METHODS:
        raise UnknownNameError("method", method, METHODS)
    if loss is not None and method != "lm":
        raise CasacalError(f"The method '{method}' knows no robust loss", "Use lm, or leave the method out")
    _ = problem.instrument  # refuses a problem with several
    began = time.perf_counter()
    fitted, held = split(samples, holdout, seed)
    fit = bind(problem, samples.take(fitted) if held.size else samples, backend=backend, threads=threads)
    heldout = fit.on(samples.take(held)) if held.size else None
    if fit.rows < fit.unknowns:
        raise SamplesError(
            samples.file,
            f"{fit.rows} rows are fitted for {fit.unknowns} unknowns",
            "Take more samples, hold fewer out, or hold parameters with --fix",
        )
    built = time.perf_counter()
    # controls and the reference have nothing to report on the way
    options: dict[str, Any] = {"progress": progress} if method not in ("ipopt", "plane-only") else {}
    if method in RANDOM:
        options["seed"] = seed
    if loss is not None:
        options["loss"] = loss
    result = METHODS[method](fit, **options)
    solved = time.perf_counter()
    before = plane_only(fit)
    checked = _check(fit, method, result) if reference and loss is None else None
    seconds = {"build": built - began, "solve": solved - built, "total": time.perf_counter() - began}
    return Calibrated(method, seed, samples, fit, heldout, result, before, checked, seconds)


def _check(fit: BoundProblem, method: str, result: Result) -> Reference:
    """Solve again by other means: IPOPT, or, when that is the method, LM."""
    solver = "lm" if method == "ipopt" else "ipopt"
    other = METHODS[solver](fit)
    own = other.trace["cost"]
    cost = float(own[-1]) if own.size else other.cost
    return Reference(solver, other, cost, (result.cost - cost) / max(cost, 1e-300))
