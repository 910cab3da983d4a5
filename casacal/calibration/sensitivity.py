"""How the estimate, and the tip with it, follows every reading and every prior.

The derivative of the estimate by each, by the implicit function theorem. At the minimum the gradient of the objective
is zero, g(x, y) = 0, so that dx/dy = -H^-1 dg/dy, with H the exact Hessian in x (Nocedal and Wright, Numerical
Optimization, 2006, theorem A.2). Weights, effects' sizes and nominal values that the samples propose stay as they
stand.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from casacal.errors import CasacalError
from casacal.fit.bound_problem import BoundProblem
from casacal.fit.least_squares import Result
from casacal.model.instrument import Instrument
from casacal.model.trace import RowModel
from casacal.values import Array, Value, read_only

FLAT = 1e-3  # largest component of the gradient, by prior standard deviations, that counts as zero
MOST_EXACT = 5_000  # whose exact Hessian takes a few seconds


@dataclass(frozen=True, eq=False)
class Sensitivity(Value):
    """Derivatives of the estimate x (n), mm and rad, and what they do to the tip over the workspace.

    names: of the unknowns. readings: line and column of each number (k) of a row beside the joint values, as in the
    file. by_reading: dx/dy (n, k), by the columns' units. by_prior: dx/dx0 (n, n), column j by the prior's mean of
    unknown j. rows: line of each row (N). tip_by_row (N), tip_by_prior (n): how far the tip moves, mm RMS over the
    workspace apart from the base's position, where all of a row, or a prior's mean, errs by one standard deviation.
    """

    names: tuple[str, ...]
    readings: tuple[tuple[int | str, str], ...]
    by_reading: Array
    by_prior: Array
    rows: tuple[int | str, ...]
    tip_by_row: Array
    tip_by_prior: Array

    def __post_init__(self) -> None:
        for name in ("by_reading", "by_prior", "tip_by_row", "tip_by_prior"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def without_tips(self) -> Sensitivity:
        """A copy with NaN in place of every tip error."""
        nothing = {name: np.full_like(getattr(self, name), np.nan) for name in ("tip_by_row", "tip_by_prior")}
        return replace(self, **nothing)

    def most(self, count: int = 5) -> tuple[list[tuple[int | str, float]], list[tuple[str, float]]]:
        """The rows, by line, and the priors, by name, that move the tip most, each with mm RMS; none that move none."""
        pairs = ((self.rows, self.tip_by_row), (self.names, self.tip_by_prior))
        rows, priors = (
            [(names[j], float(tips[j])) for j in np.argsort(-tips, kind="stable")[:count] if tips[j] > 0]
            for names, tips in pairs
        )
        return rows, priors


def sensitivity(fit: BoundProblem, result: Result, tip: Array) -> Sensitivity:
    """Sensitivity at a minimum; tip: derivative (3 M, n) of M tips by the unknowns, mm.

    Raises CasacalError where the estimate is no minimum of the plain objective, or rows are too many.
    """
    if result.loss is not None or not result.converged or not result.kkt < FLAT:
        raise CasacalError("This estimate is no minimum of the plain objective", "Use lm or sckf-lm without a loss")
    if fit.rows > MOST_EXACT:
        what = f"{fit.rows:,} rows with {fit.unknowns:,} unknowns are too many for the sensitivity"
        raise CasacalError(what, f"Take at most {MOST_EXACT:,} rows")
    kinds, starts = fit.symbolic.kinds, fit.measured.starts
    models = [_row_function(*each) for each in zip(fit.problem.models, fit.problem.instruments, strict=True)]
    hessian, found = fit.prior_information.copy(), []
    for kind in kinds:
        inputs, of_row = (result.x[kind.columns], kind.constants), models[kind.instrument][0]
        rows = [[each.full() for each in of_row(*inputs, *row)] for row in zip(kind.data, kind.noise, strict=True)]
        hessian[np.ix_(kind.columns, kind.columns)] += np.sum([row[2] for row in rows], axis=0)
        found.append((np.array([row[0] for row in rows]), np.concatenate([row[1] for row in rows], axis=1)))
    scale, along = fit.start_std[:, None], fit.tangent(result.x)
    basis = None if along is None else np.linalg.qr(along / scale)[0]  # along what constraints leave
    scaled = hessian * np.outer(fit.start_std, fit.start_std)
    values, vectors = np.linalg.eigh(scaled if basis is None else basis.T @ scaled @ basis)
    held = values > len(values) * np.finfo(float).eps * values.max(initial=0.0)  # what nothing holds does not move
    root = scale * (vectors if basis is None else basis @ vectors)[:, held]
    inverse = (root / values[held]) @ root.T
    squares = inverse @ (tip.T @ tip) @ inverse / (len(tip) / 3)  # of the tip by gradients
    readings, by_reading = list[tuple[int, str]](), []
    tips = np.zeros(len(fit.measured))
    for kind, (slopes, changes) in zip(kinds, found, strict=True):
        places = int(starts[kind.instrument]) + kind.samples
        block = squares[np.ix_(kind.columns, kind.columns)]
        tips[places] = np.sqrt(np.maximum(np.einsum("kmi,ij,kmj->k", slopes, block, slopes), 0.0))
        readings += [(int(k), name) for k in places for name in models[kind.instrument][1]]
        by_reading.append(-inverse[:, kind.columns] @ changes)
    in_file = np.argsort([k for k, _ in readings], kind="stable")
    pull, held = fit.prior_information, np.diagonal(fit.prior_information)
    std = np.where(held > 0, 1 / np.sqrt(np.where(held > 0, held, 1.0)), 0.0)  # of each, were the others known
    return Sensitivity(
        fit.names,
        tuple((fit.measured.place(readings[j][0]), readings[j][1]) for j in in_file),
        np.concatenate(by_reading, axis=1)[:, in_file],
        inverse @ pull,
        tuple(fit.measured.place(k) for k in range(len(fit.measured))),
        tips,
        std * np.sqrt(np.maximum(np.diagonal(pull @ squares @ pull), 0.0)),
    )


def _row_function(model: RowModel, instrument: Instrument) -> tuple[ca.Function, list[str]]:
    """(z, c, d, w) -> whitened slopes (m, nz) of a row, its gradient's change by columns (nz, k), its Hessian (nz, nz).

    And these columns: what the instrument reads.
    """
    z, c, d = (ca.SX.sym(name, model.residual.numel_in(i)) for i, name in enumerate("zcd"))
    w = ca.SX.sym("w", model.components)
    e = model.residual(z, c, d) / w
    slopes = ca.jacobian(e, z)
    hessian, gradient = ca.hessian(ca.sumsqr(e) / 2, z)
    first, names = d.numel() - len(model.names), [name for name in model.names if name in instrument.columns]
    columns = [first + model.names.index(name) for name in names]
    outputs = [slopes, ca.jacobian(gradient, d[columns]), hessian]
    return ca.Function("row", [z, c, d, w], [ca.densify(each) for each in outputs]), names
