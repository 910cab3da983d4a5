"""Findings on samples, suspected faults, and the misfit that is left when one is undone."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from casacal.data.samples import Measurements, Samples
from casacal.errors import CasacalError
from casacal.fit.bound_problem import BoundProblem, bind
from casacal.fit.least_squares import Result
from casacal.fit.lm import lm
from casacal.kernels.losses import huber
from casacal.model.problem import Problem
from casacal.values import Array
from casacal.wording import numbered_lines

Severity = Literal["error", "warning", "remark"]
SUSPICIOUS = 2.0  # misfit, in stated standard deviations, above which something systematic is looked for
EXPLAINED = 50.0  # misfit that noise and effects leave at most; what leaves more explains nothing
ALIKE = 1.5  # within this factor a fault and its absence cannot be told apart
KEPT = 0.9  # part of the rows, the best of them, that a misfit is made of
OF_NORMAL = 0.62297  # mean square of that part of a standard normal distribution
STEPS = 25  # steps of a quick robust fit
FIRST_STEPS = 6  # steps of a first look, which tells what is promising: with the cause undone, a fit needs few


@dataclass(frozen=True)
class Finding:
    """Something about samples: how bad, about what, why, and what to do; `lines` where it is about rows.

    `instrument` names whose samples these are where a problem has several instruments.

    An error would make the result wrong; a warning makes it worse than it looks; a remark is good to know.
    """

    severity: Severity
    about: str
    cause: str
    fix: str
    lines: tuple[int, ...] = ()
    instrument: str = ""

    def __str__(self) -> str:
        where = f" ({numbered_lines(self.lines)})" if self.lines else ""
        of = f"{self.instrument}: " if self.instrument else ""
        return f"{self.severity}: {of}{self.about}{where}: {self.cause}. {self.fix}."


@dataclass(frozen=True)
class Undone:
    """Problem and samples as they would be without a fault.

    `found` says its size where that was fitted; `start` (n,) is where such a fit ended, for further ones. `offer` is
    how `calibrate` tries it, where nothing else explains the rows.
    """

    problem: Problem
    samples: Samples
    found: str = ""
    start: Array | None = None
    offer: str = ""


Undo: TypeAlias = Callable[[Problem, Samples], Undone]


@dataclass(frozen=True)
class Fault:
    """A suspected fault: its name, what was done wrong, what to do, and what undoes it.

    `freedom` counts what is fitted to undo it: of two that explain samples alike, the one of less freedom is believed.
    What is `common` is also looked for beside another fault.
    """

    about: str
    cause: str
    fix: str
    undo: Undo
    freedom: int = 0
    common: bool = True


def quick_fit(
    problem: Problem,
    samples: Samples | Measurements,
    *,
    steps: int = STEPS,
    start: Array | None = None,
    backend: str | None = None,
) -> tuple[BoundProblem, Result] | None:
    """A robust fit in few steps; None where it cannot be bound or the figures overflow."""
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            bound = bind(problem, *Measurements.of(samples).sets, backend=backend)
            result = lm(bound, start=start, loss=huber(), max_steps=steps)
    except CasacalError:
        return None
    return (bound, result) if math.isfinite(result.cost) else None


def misfit(
    problem: Problem, samples: Samples | Measurements, *, first: bool = False, start: Array | None = None
) -> float:
    """Size of residuals and of the parameters' moves after a quick robust fit; one where all is well.

    Root mean square of the whitened residuals, the largest tenth left out (single rows are no systematic fault, a face
    of many is), plus the prior's cost per row: a fit that explains touches by bending the arm far beyond its prior is
    no fit. Infinite if it fails.
    """
    fitted = quick_fit(problem, samples, steps=FIRST_STEPS if first else STEPS, start=start)
    return math.inf if fitted is None else size_of(*fitted)


def size_of(bound: BoundProblem, result: Result) -> float:
    """The size of a quick robust fit, as `misfit` has it."""
    square = kept_square(bound.residual(result.x))
    size = math.sqrt(square / OF_NORMAL + 2 * bound.prior_cost(result.x) / bound.rows)
    return size if math.isfinite(size) else math.inf


def kept_square(residual: Array) -> float:
    """Mean square of residuals, the largest tenth left out."""
    return float(np.sort(np.ravel(residual) ** 2)[: math.ceil(KEPT * residual.size)].mean())


def freed_of_unknowns(bound: BoundProblem, result: Result, residual: Array, slopes: Array) -> tuple[Array, Array]:
    """Slopes (rows + n, k) of residuals (rows, k) as weighted, without what unknowns can follow, priors included."""
    root = np.sqrt(result.weights)
    whole = np.concatenate([root * residual, bound.prior_rows @ (result.x - bound.x0)])
    unknowns = np.vstack([root[:, None] * bound.jacobian(result.x), bound.prior_rows])
    left = np.vstack([root[:, None] * slopes, np.zeros((len(bound.prior_rows), slopes.shape[1]))])
    return whole, np.asarray(left - unknowns @ np.linalg.lstsq(unknowns, left, rcond=None)[0])
