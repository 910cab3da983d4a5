"""A bound problem as CasADi expressions: residuals of all rows and the objective, for one's own programs and solvers.

    bound = bind(problem, samples)
    opti = casadi.Opti()
    x = opti.variable(bound.unknowns)
    opti.minimize(bound.symbolic.objective(x))

A function of one row is mapped over pieces of at most 256, and an expression holds a call of each piece: 10,000 rows
take about as long to build as 100. With 33 unknowns they take 7 ms for the residuals, 15 ms for the normal equations
and 1 to 2 seconds for the exact Hessian, within 100 MB; 120 rows 20 ms for that. The library's own `lm` and `ipopt` are
several times faster on the plain objective: what is here is for what they do not do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from casacal.errors import ProblemError, came
from casacal.fit.least_squares import LeastSquares
from casacal.fit.slots import Block, Slot
from casacal.kernels.filter_passes import Cubature
from casacal.model.kinematics import Expression
from casacal.model.trace import RowModel
from casacal.values import Array, Index, read_only

PIECE = 256  # rows mapped together: what derivatives hold at a time


@dataclass(frozen=True, eq=False)
class RowKind:
    """Rows of one instrument that see the same unknowns, such as the touches of one face."""

    model: RowModel
    instrument: int  # whose rows they are, from 0
    unknowns: tuple[str, ...]  # names of what they see, in the order of the symbols: "alpha", ..., "plane.floor"
    columns: Index  # positions of z in x (nz,)
    constants: Array  # c (nc,)
    samples: Index  # which samples of the instrument they are (N,)
    first: int  # position of the instrument's first residual among all
    data: Array  # d of each row (N, nd): rad, mm
    noise: Array  # standard deviation w of each residual (N, m)
    at: int  # position of their data in p: c, then d and w row by row

    @property
    def places(self) -> tuple[Index, Index, Index]:
        """Positions in p of c (nc,), d (N, nd) and w (N, m)."""
        c, d, w = len(self.constants), self.data.size, self.noise.size
        every = self.at + np.arange(c + d + w)
        return every[:c], every[c : c + d].reshape(self.data.shape), every[c + d :].reshape(self.noise.shape)

    @property
    def residuals(self) -> Index:
        """Positions of their residuals among all (N * m,)."""
        m = self.model.components
        return (self.first + self.samples[:, None] * m + np.arange(m)).ravel()


class SymbolicProblem:
    """The rows of a `BoundProblem` as CasADi expressions of x (n,), mm and rad; what `BoundProblem.symbolic` gives.

    x may be SX, MX (such as `opti.variable(n)`), DM or an array, and the outcome is of the same kind. Methods raise
    ProblemError for an x of another size.
    """

    def __init__(self, problem: LeastSquares, slots: Sequence[Slot], blocks: Sequence[Block]) -> None:
        self.names, self.units = problem.names, problem.units  # name and unit of each unknown
        self.x0, self.prior_std, self.start_std = problem.x0, problem.prior_std, problem.start_std
        """Mean and standard deviation of the prior (n,; infinite: flat), and a good scale of each unknown (n,)."""
        self._prior_rows, self._slots, found, first, at = problem.prior_rows, tuple(slots), list[RowKind](), 0, 0
        for i, block in enumerate(blocks):
            for k, some in enumerate(block.slots):
                rows, names = block.by_pattern[k], tuple(slot.name for slot in some)
                constants, columns, noise = block.constants[k], block.columns[k], block.noise[rows]
                data = block.rows(rows)
                found.append(RowKind(block.model, i, names, columns, constants, rows, first, data, noise, at))
                at += constants.size + data.size + noise.size
            first += block.noise.size
        self.kinds, self._rows = tuple(found), first  # the rows, kind by kind
        self.data = read_only(np.concatenate([np.r_[k.constants, k.data.ravel(), k.noise.ravel()] for k in found]))
        """What the samples put into the rows, as one column p: constants, joint values and columns, noise."""
        self._pieces: dict[Any, ca.Function] = {}

    def __repr__(self) -> str:
        kinds = ", ".join(f"{len(kind.samples)} of instrument {kind.instrument + 1}" for kind in self.kinds)
        return f"<SymbolicProblem: {len(self.names)} unknowns, {self._rows} residuals of {kinds}>"

    def index(self, name: str) -> int:
        """Position of an unknown in x by its name, such as "a3"; raises ProblemError where there is none."""
        if name not in self.names:
            raise ProblemError(f"There is no unknown '{name}'", f"There are: {', '.join(self.names)}")
        return self.names.index(name)

    def data_index(self, name: str, instrument: int = 0) -> Index:
        """Positions in p of a column of the samples, row by row (N,), of their "joints" (N, n) or "noise" (N, m).

        Raises ProblemError where the instrument has no such column.
        """
        kinds = [kind for kind in self.kinds if kind.instrument == instrument]
        columns = kinds[0].model.names if kinds else ()
        if not kinds or name not in ("joints", "noise", *columns):
            known = ", ".join(("joints", "noise", *columns))
            raise ProblemError(f"There is no '{name}' of instrument {instrument + 1}", f"Known: {known}")
        joints = kinds[0].data.shape[1] - len(columns)
        found = dict[int, Index]()
        for kind in kinds:
            _, d, w = kind.places
            chosen = w if name == "noise" else d[:, :joints] if name == "joints" else d[:, joints + columns.index(name)]
            found.update(zip(kind.samples.tolist(), chosen, strict=True))
        return np.array([found[k] for k in sorted(found)])

    def values(self, x: Any) -> dict[str, Expression]:
        """Value of every unknown at x, by name: a number, a vector, a 4x4 frame or a plane.

        A plane has `normal`, `point` and `distance(point)`. Names are those of `RowKind.unknowns`.
        """
        x = self._checked(x)
        return {s.name: s.unknown.at(ca.DM(s.nominal), x[s.first : s.first + s.unknown.size]) for s in self._slots}

    def residual(self, x: Any, p: Any = None) -> Expression:
        """Whitened residuals (rows,) of all rows, in the order of `BoundProblem.residual`.

        p: other data in the place of `data` (np,), such as `opti.parameter(rows.data.size)`; of what length each is,
        `data_index` says.
        """
        return self.residual_function(self._checked(x)) if p is None else self.residual_of_data(*self._checked(x, p))

    def prior(self, x: Any) -> Expression:
        """The prior's part of the objective: 1/2 |W (x - x0)|^2, W the whitened rows of the prior."""
        return ca.sumsqr(ca.mtimes(ca.sparsify(ca.DM(self._prior_rows)), self._checked(x) - ca.DM(self.x0))) / 2

    def objective(self, x: Any, p: Any = None) -> Expression:
        """The objective f that all estimators minimise: half the sum of squares of `residual`, plus `prior`.

        p: as for `residual`.
        """
        cost = self.cost_function(self._checked(x)) if p is None else self.cost_of_data(*self._checked(x, p))
        return cost + self.prior(x)

    @cached_property
    def residual_function(self) -> ca.Function:
        """x -> whitened residuals (rows)."""
        x = self._x
        return ca.Function("residual", [x], [self._in_order(x)], ["x"], ["residual"])

    @cached_property
    def residual_of_data(self) -> ca.Function:
        """(x, p) -> whitened residuals (rows), with the data as parameters."""
        x, p = self._x, self._p
        return ca.Function("residual_of_data", [x, p], [self._in_order(x, p)], ["x", "p"], ["residual"])

    @cached_property
    def cost_function(self) -> ca.Function:
        """x -> half the sum of squares of the whitened residuals, without the prior."""
        x = self._x
        parts = [part for kind in self.kinds for part in self._mapped(kind, x, self._cost)]
        return ca.Function("cost", [x], [sum(parts, ca.MX(0))], ["x"], ["cost"])

    @cached_property
    def cost_of_data(self) -> ca.Function:
        """(x, p) -> half the sum of squares of the whitened residuals, with the data as parameters."""
        x, p = self._x, self._p
        parts = [part for kind in self.kinds for part in self._mapped(kind, x, self._cost, p)]
        return ca.Function("cost_of_data", [x, p], [sum(parts, ca.MX(0))], ["x", "p"], ["cost"])

    @cached_property
    def normal(self) -> ca.Function:
        """x -> cost, gradient J'r (n), information J'J (n x n) of the data alone, as `BoundProblem.normal`.

        With the prior's, the information is the Hessian of Gauss-Newton: as the option `hess_lag` of `casadi.nlpsol`
        it keeps solvers such as sqpmethod on course where the exact one is not positive (studies/own_nlp.py).
        """
        x, n = self._x, len(self.names)
        cost, gradient, information = ca.MX(0), ca.MX(n, 1), ca.MX(n, n)
        for kind in self.kinds:
            z = len(kind.columns)
            total = sum(self._mapped(kind, x, self._sums), ca.MX(z + 1, z + 1))
            into = ca.DM(np.eye(n)[:, kind.columns])
            cost += total[z, z] / 2
            gradient += ca.mtimes(into, total[:z, z])
            information += ca.mtimes(ca.mtimes(into, total[:z, :z]), into.T)
        outputs = [cost, ca.densify(gradient), ca.densify(information)]
        return ca.Function("normal", [x], outputs, ["x"], ["cost", "gradient", "information"])

    @cached_property
    def damped_step(self) -> ca.Function:
        """(x, mu) -> the x that a damped Gauss-Newton step on the whole objective leads to, eqs (25)-(29) as corrected.

        Damped in the prior's metric, as `LeastSquares.damped_step`.
        """
        x, mu, scale = self._x, ca.MX.sym("mu"), ca.DM(self.start_std)
        _, gradient, squares = self.normal(x)
        rows = ca.sparsify(ca.DM(self._prior_rows))
        prior = ca.mtimes(rows.T, rows)
        whole = squares + prior
        matrix = ca.densify(ca.mtimes(scale, scale.T) * whole + mu * ca.DM.eye(len(self.names)))
        slope = scale * (gradient + ca.mtimes(prior, x - ca.DM(self.x0)))
        step = ca.solve(matrix, -slope, "ldl")
        return ca.Function("damped_step", [x, mu], [x + scale * step], ["x", "mu"], ["x_next"])

    def cubature_step(self, kind: RowKind) -> ca.Function:
        """One step of the square-root cubature Kalman filter for a row of a kind, eqs (15)-(24) as corrected.

        (mean (n), root (n x n), d (nd), w (m)) -> mean, root: a belief over (x - x0) / start_std, at first 0 and
        `prior_root` of the bound problem: the identity where no priors belong together. The residuals of the row are
        taken in one by one. A row that leaves less than 1e-10 of a variance gives what is not a number: there the NumPy
        filter triangularises in full. Raises ProblemError for what is no kind of row.
        """
        if not isinstance(kind, RowKind):
            raise ProblemError(f"Got {came(kind)} as the kind of row", "Give one of `kinds`")
        n, model, kept = len(self.names), kind.model, Cubature(kind.model.residual, "blocks")
        mean, root = ca.MX.sym("mean", n), ca.MX.sym("root", n, n)
        d, w = ca.MX.sym("d", model.residual.numel_in(2)), ca.MX.sym("w", model.components)
        columns, once = kind.columns.tolist(), ca.vertcat(ca.DM(kind.constants), d)
        base, unit = ca.DM(self.x0[kind.columns]), ca.DM(self.start_std[kind.columns])
        new_mean, new_root = mean, root
        for component in range(model.components):
            centre = ca.repmat(base + unit * new_mean[columns], 1, n)
            spread = ca.repmat(math.sqrt(n) * unit, 1, n) * new_root[columns, :]
            points = ca.horzcat(centre + spread, centre - spread).T
            new_mean, new_root, _ = kept.step(n, component)(points, once, 1 / w[component], new_mean, new_root)
        names, made = ["mean", "root", "d", "w"], ["mean_next", "root_next"]
        return ca.Function("cubature_step", [mean, root, d, w], [new_mean, new_root], names, made)

    @property
    def _x(self) -> ca.MX:
        return ca.MX.sym("x", len(self.names))

    @property
    def _p(self) -> ca.MX:
        return ca.MX.sym("p", self.data.size)

    def _checked(self, *given: Any) -> Any:
        """x, or x and p, as columns; ProblemError for another size."""
        found = []
        sizes = ("x", len(self.names), "unknowns"), ("p", self.data.size, "data")
        for (name, size, what), each in zip(sizes, given, strict=False):
            column = each if isinstance(each, (ca.SX, ca.MX, ca.DM)) else ca.DM(np.asarray(each, dtype=np.float64))
            if column.shape != (size, 1):
                raise ProblemError(f"{name} has the shape {column.shape}", f"It must be a column of {size} {what}")
            found.append(column)
        return found[0] if len(found) == 1 else found

    def _in_order(self, x: ca.MX, p: ca.MX | None = None) -> ca.MX:
        """Whitened residuals of all rows, as `BoundProblem.residual` has them."""
        order = np.argsort(np.concatenate([kind.residuals for kind in self.kinds]))
        parts = [ca.vec(part) for kind in self.kinds for part in self._mapped(kind, x, self._residuals, p)]
        return ca.vertcat(*parts)[order.tolist()]

    def _mapped(self, kind: RowKind, x: ca.MX, build: Any, p: ca.MX | None = None) -> list[ca.MX]:
        """Result of `build` for each piece of the rows of a kind, at x and p; pieces of one size share a function."""
        z, made = x[kind.columns.tolist()], list[ca.MX]()
        row: Any = ca.DM(kind.constants), ca.DM(kind.data.T), ca.DM(kind.noise.T)
        if p is not None:
            row = [ca.reshape(p[k.ravel().tolist()], each.shape) for k, each in zip(kind.places, row, strict=True)]
        c, d, w = row
        for first in range(0, len(kind.samples), PIECE):
            last = min(first + PIECE, len(kind.samples))
            inputs: list[Any] = [z, c, *(each[:, first:last] for each in (d, w))]
            key = (build, kind.instrument, inputs[2].shape[1])
            if key not in self._pieces:
                symbols = [ca.MX.sym(name, *each.shape) for name, each in zip("zcdw", inputs, strict=True)]
                options = {"never_inline": True}  # a piece's derivatives are then made once, and not all held at once
                self._pieces[key] = ca.Function("rows", symbols, [build(kind.model, *symbols)], options)
            made += self._pieces[key].call(inputs)
        return made

    @staticmethod
    def _residuals(model: RowModel, z: ca.MX, c: ca.MX, d: ca.MX, w: ca.MX) -> ca.MX:
        """Whitened residuals (m x rows)."""
        return model.residual.map("mapped", "serial", d.shape[1], [0, 1], [])(z, c, d) / w

    @staticmethod
    def _cost(model: RowModel, *row: ca.MX) -> ca.MX:
        return ca.sumsqr(SymbolicProblem._residuals(model, *row)) / 2

    @staticmethod
    def _sums(model: RowModel, z: ca.MX, c: ca.MX, d: ca.MX, w: ca.MX) -> ca.MX:
        """[J r]' [J r] of whitened rows (nz + 1 x nz + 1)."""
        e, slopes = model.jacobian.map("mapped", "serial", d.shape[1], [0, 1], [])(z, c, d)
        rows = ca.vertcat(slopes, ca.vec(e).T) / ca.repmat(ca.vec(w).T, z.numel() + 1, 1)
        return ca.mtimes(rows, rows.T)  # plain, so that C code of it needs no BLAS
