"""Steps of the estimators as CasADi functions (MX), for one's own loops, solvers and C code."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.kernels.filter_passes import Cubature
from casacal.problem.compile import RowModel


def damped_step(normal: ca.Function, x0: Array, information: Array, scale: Array) -> ca.Function:
    """(x, mu) -> x + S s with (S H S + mu I) s = -S g: H, g of the whole objective, S = diag(scale).

    normal: x -> cost, gradient (n), information (n x n) of the data. information: of the prior (n,).
    """
    x, mu = ca.MX.sym("x", x0.size), ca.MX.sym("mu")
    _, gradient, squares = normal(x)
    whole = squares + ca.DM(np.diag(information))
    matrix = ca.densify(ca.DM(np.outer(scale, scale)) * whole + mu * ca.DM.eye(x0.size))
    slope = ca.DM(scale) * (gradient + ca.DM(information) * (x - ca.DM(x0)))
    step = ca.solve(matrix, -slope, "ldl")
    return ca.Function("damped_step", [x, mu], [x + ca.DM(scale) * step], ["x", "mu"], ["x_next"])


def cubature_step(model: RowModel, columns: NDArray[np.intp], constants: Array, x0: Array, scale: Array) -> ca.Function:
    """(mean (n), root (n x n), d, w (m)) -> mean, root after all residuals of one row, over (x - x0) / scale.

    The step itself is the one that `casacal.kernels.filter_passes` takes.
    """
    n, m, kept = x0.size, model.components, Cubature(model.residual, "blocks")
    mean, root = ca.MX.sym("mean", n), ca.MX.sym("root", n, n)
    d, w = ca.MX.sym("d", model.residual.numel_in(2)), ca.MX.sym("w", m)
    seen, base, unit = columns.tolist(), ca.DM(x0[columns]), ca.DM(scale[columns])
    new_mean, new_root = mean, root
    for component in range(m):
        centre = ca.repmat(base + unit * new_mean[seen], 1, n)
        spread = ca.repmat(math.sqrt(n) * unit, 1, n) * new_root[seen, :]
        points = ca.horzcat(centre + spread, centre - spread).T
        once = ca.vertcat(ca.DM(constants), d)
        new_mean, new_root, _ = kept.step(n, component)(points, once, 1 / w[component], new_mean, new_root)
    names = ["mean", "root", "d", "w"]
    return ca.Function("cubature_step", [mean, root, d, w], [new_mean, new_root], names, ["mean_next", "root_next"])
