"""IPOPT as an independent reference: raw unit normals under constraints, exact Hessian, another solver."""

from __future__ import annotations

from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casacal.errors import ProblemError
from casacal.least_squares import LeastSquares
from casacal.raw_graph import RawBlock, RawGraph
from casacal.result import Result, Status

Array: TypeAlias = NDArray[np.float64]


def ipopt(problem: LeastSquares, *, max_steps: int = 200, tolerance: float = 1e-9, verbose: bool = False) -> Result:
    """Minimise f over raw coordinates v (normals as free 3-vectors, rotations as quaternions) with v'v = 1 constraints.

    Shares the model's residual with the other estimators but neither their parametrisation of planes nor their
    derivatives nor their linear algebra. Linear solver: MUMPS, which ships with CasADi's wheel.

    Args:
        problem: must have a `graph`.
        max_steps: IPOPT iterations at most.
        tolerance: IPOPT's `tol`, on the scaled optimality error.
        verbose: let IPOPT print.

    Raises ProblemError when the problem has no symbolic form.

    """
    if not isinstance(problem.graph, RawGraph):
        raise ProblemError("IPOPT needs the symbolic form of a problem and this one has none", "Use lm instead")
    graph = problem.graph
    program, options, scales = _program(graph, problem, max_steps, tolerance, verbose)
    solver = ca.nlpsol("reference", "ipopt", program, options)
    solution = solver(x0=np.zeros(graph.start.size), lbg=0.0, ubg=0.0)
    stats: dict[str, Any] = solver.stats()
    raw = graph.start + scales * np.asarray(solution["x"]).ravel()
    x = np.asarray(graph.local(raw)).ravel()
    history = stats.get("iterations") or {}
    calls = {name: int(stats.get(f"n_call_nlp_{name}", 0)) for name in ("f", "grad_f", "hess_l")}
    return Result(
        method="ipopt",
        problem=problem,
        x=x,
        status=_status(str(stats["return_status"]), x),
        trace={
            "cost": np.array(history.get("obj", [])),
            "dual_infeasibility": np.array(history.get("inf_du", [])),
            "constraint_violation": np.array(history.get("inf_pr", [])),
        },
        steps=int(stats["iter_count"]),
        residual_rows=problem.rows * (calls["f"] + calls["grad_f"] + calls["hess_l"]),
        jacobian_rows=problem.rows * (calls["grad_f"] + calls["hess_l"]),
    )


def _program(
    graph: RawGraph, problem: LeastSquares, max_steps: int, tolerance: float, verbose: bool
) -> tuple[dict[str, Any], dict[str, Any], Array]:
    """The nonlinear program in scaled raw coordinates y, v = start + scales * y; the solver's options; the scales."""
    objective = _objective(graph, problem)
    # each variable in units of its own conditional standard deviation: gradients then vanish to rounding
    diagonal = np.abs(np.diagonal(np.asarray(objective(graph.start)[2])))
    scales = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    y = ca.MX.sym("y", graph.start.size)
    value, slope, curvature = objective(graph.start + scales * y)

    unscaled = ca.SX.sym("y", graph.start.size)
    g = graph.constraints(graph.start + scales * unscaled)
    multipliers = ca.SX.sym("lam_g", g.numel())
    bend = ca.Function("bend", [unscaled, multipliers], [ca.densify(ca.hessian(ca.dot(multipliers, g), unscaled)[0])])
    constraint = ca.Function("g", [unscaled], [g])

    parameters, lam_f, lam_g = ca.MX.sym("p", 0), ca.MX.sym("lam_f"), ca.MX.sym("lam_g", g.numel())
    hessian = ca.triu(lam_f * (scales[:, None] @ scales[None] * curvature) + bend(y, lam_g))
    options: dict[str, Any] = {
        "print_time": False,
        "show_eval_warnings": verbose,
        # derivatives row by row from small SX graphs: differentiating the mapped whole costs an order more
        "grad_f": ca.Function("nlp_grad_f", [y, parameters], [value, scales * slope], ["x", "p"], ["f", "grad_f_x"]),
        "hess_lag": ca.Function(
            "nlp_hess_l",
            [y, parameters, lam_f, lam_g],
            [hessian],
            ["x", "p", "lam_f", "lam_g"],
            ["triu_hess_gamma_x_x"],
        ),
        "ipopt": {
            "max_iter": max_steps,
            "tol": tolerance,
            "constr_viol_tol": 1e-12,
            # where rounding keeps the gradient above tol, stop once the objective stands still
            "acceptable_tol": 1e-5,
            "acceptable_obj_change_tol": 1e-11,
            "acceptable_iter": 3,
            "nlp_scaling_method": "none",
            "linear_solver": "mumps",
            "print_level": 5 if verbose else 0,
            "sb": "yes",
        },
    }
    return {"x": y, "f": value, "g": constraint(y)}, options, scales


def _objective(graph: RawGraph, problem: LeastSquares) -> ca.Function:
    """Function v -> cost, gradient, Hessian of the objective in raw coordinates."""
    v = ca.MX.sym("v", graph.start.size)
    terms = [_prior(graph, problem)(v)] + [_data(block, v) for block in graph.blocks]
    return ca.Function("objective", [v], [sum((term[i] for term in terms[1:]), terms[0][i]) for i in range(3)])


def _data(block: RawBlock, v: ca.MX) -> list[ca.MX]:
    """Cost, gradient and Hessian of one block of rows, in the whole raw vector v."""
    count, components = block.noise.shape
    here = ca.SX.sym("v", block.columns.size)
    c, d = ca.SX.sym("c", block.constants.shape[1]), ca.SX.sym("d", block.data.shape[1])
    noise, held = ca.SX.sym("w", components), ca.SX.sym("held", components)
    e = block.residual(here, c, d) / noise
    slopes = ca.jacobian(e, here).T
    # Hessian of e'e/2: slopes slopes', left to one matrix product, plus e times the curvature of e (upper triangle)
    bend = ca.substitute(ca.triu(ca.jacobian(slopes @ held, here)), held, e)
    row = ca.Function("row", [here, c, d, noise], ca.cse([ca.densify(e), ca.densify(slopes), bend]))
    total = row.map(count, [True, False, False, False], [False, False, True]) if count > 1 else row
    data = (ca.DM(values.T) for values in (block.constants, block.data, block.noise))
    residuals, gradients, bends = total(v[block.columns.tolist()], *data)
    flat = ca.reshape(gradients, block.columns.size, count * components)
    place = ca.DM.triplet(
        block.columns.tolist(),
        list(range(block.columns.size)),
        ca.DM.ones(block.columns.size),
        v.numel(),
        block.columns.size,
    )
    hessian = ca.triu2symm(bends) + flat @ flat.T
    return [ca.sumsqr(residuals) / 2, place @ (flat @ ca.vec(residuals)), place @ hessian @ place.T]


def _prior(graph: RawGraph, problem: LeastSquares) -> ca.Function:
    """Function v -> cost, gradient, Hessian of the prior."""
    v = ca.SX.sym("v", graph.start.size)
    cost = ca.dot(ca.DM(problem.prior_information), (graph.local(v) - problem.x0) ** 2) / 2
    hessian, gradient = ca.hessian(cost, v)
    return ca.Function("prior", [v], [ca.densify(term) for term in ca.cse([cost, gradient, hessian])])


def _status(returned: str, x: Array) -> Status:
    if not np.isfinite(x).all():
        return Status.NOT_FINITE
    if returned == "Solve_Succeeded":
        return Status.CONVERGED
    if returned in ("Solved_To_Acceptable_Level", "Search_Direction_Becomes_Too_Small"):
        return Status.PRECISION
    return Status.MAX_STEPS if returned == "Maximum_Iterations_Exceeded" else Status.SOLVER
