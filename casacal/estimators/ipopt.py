"""IPOPT as an independent reference: raw unit normals under constraints, exact Hessian, another solver."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.estimators.ipopt_objective import Objective, RawForm
from casacal.estimators.nominal import nothing_unknown
from casacal.least_squares.objective import LeastSquares
from casacal.least_squares.result import Result, Status


def ipopt(problem: LeastSquares, *, max_steps: int = 200, tolerance: float = 1e-9, verbose: bool = False) -> Result:
    """Minimise f over raw coordinates v (normals as free 3-vectors, rotations as quaternions) with v'v = 1 constraints.

    Shares the model's residual with the other estimators but neither their parametrisation of planes nor their
    derivatives nor their linear algebra. Linear solver: MUMPS, which ships with CasADi's wheel.

    Args:
        problem: must have a `graph`.
        max_steps: IPOPT iterations at most.
        tolerance: IPOPT's `tol`, on the scaled optimality error.
        verbose: let IPOPT print.

    Returns:
        The minimum in local coordinates, as from the other estimators: x (n,), deviations from nominal in the units of
        `problem.units`.

    Raises ProblemError when the problem has no symbolic form.

    """
    if not problem.unknowns:
        return nothing_unknown(problem, "ipopt")
    if problem.graph is None:
        raise ProblemError("IPOPT needs the symbolic form of a problem and this one has none", "Use lm instead")
    graph: RawForm = problem.graph
    objective = Objective(graph, problem)
    program, options, kept = _program(graph, objective, max_steps, tolerance, verbose)
    solver = ca.nlpsol("reference", "ipopt", program, options)
    solution = solver(x0=np.zeros(graph.start.size), lbg=0.0, ubg=0.0)
    del kept  # CasADi calls these but does not hold them
    stats: dict[str, Any] = solver.stats()
    x = np.asarray(graph.local(objective.raw(np.asarray(solution["x"]).ravel()))).ravel()
    history = stats.get("iterations") or {}
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
        residual_rows=problem.rows * objective.evaluations,
        jacobian_rows=problem.rows * objective.evaluations,
    )


def _program(
    graph: RawForm, objective: Objective, max_steps: int, tolerance: float, verbose: bool
) -> tuple[dict[str, Any], dict[str, Any], list[Call]]:
    """The nonlinear program in scaled raw coordinates, the solver's options, and what must outlive the solver."""
    n = graph.start.size

    def hessian(y: Array, _: Array, lam_f: Array, lam_g: Array) -> list[Any]:
        return [objective.lagrangian(y, float(lam_f[0]), lam_g)]

    point, nothing, one = ca.Sparsity.dense(n), ca.Sparsity.dense(0), ca.Sparsity.dense(1)
    dual = ca.Sparsity.dense(graph.constraints.numel_out(0))
    value = Call("value", [point], [one], lambda y: [objective(y)[0]])
    slope = Call("slope", [point, nothing], [one, point], lambda y, _: list(objective(y)[:2]))
    curvature = Call("curvature", [point, nothing, one, dual], [_pattern(objective)], hessian)
    x = ca.MX.sym("x", n)
    options: dict[str, Any] = {
        "print_time": False,
        "show_eval_warnings": verbose,
        "no_nlp_grad": True,  # it would differentiate the objective once more, for sensitivities that nobody asks
        "grad_f": _named(slope, ["x", "p"], ["f", "grad_f_x"]),
        "hess_lag": _named(curvature, ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"]),
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
    program = {"x": x, "f": value(x), "g": graph.constraints(objective.start + objective.scales * x)}
    return program, options, [value, slope, curvature]


def _pattern(objective: Objective) -> ca.Sparsity:
    """Where the Hessian's upper triangle is not zero."""
    n = objective.start.size
    starts = np.searchsorted(objective.columns, np.arange(n + 1))
    return ca.Sparsity(n, n, starts.tolist(), objective.rows.tolist())


def _named(call: Call, inputs: list[str], outputs: list[str]) -> ca.Function:
    """The function with the names by which CasADi's solvers know arguments and results."""
    arguments = [ca.MX.sym(name, call.sparsity_in(i)) for i, name in enumerate(inputs)]
    return ca.Function(f"nlp_{call.name()}", arguments, call.call(arguments), inputs, outputs)


class Call(ca.Callback):
    """A Python function of flat arrays that CasADi can call."""

    def __init__(
        self, name: str, inputs: list[ca.Sparsity], outputs: list[ca.Sparsity], function: Callable[..., list[Any]]
    ) -> None:
        super().__init__()
        self._inputs, self._outputs, self._function = inputs, outputs, function
        self.construct(name, {})

    def get_n_in(self) -> int:
        """Number of arguments; CasADi asks for this and the following."""
        return len(self._inputs)

    def get_n_out(self) -> int:
        """Number of results."""
        return len(self._outputs)

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Shape of an argument."""
        return self._inputs[i]

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Shape of a result."""
        return self._outputs[i]

    def has_eval_buffer(self) -> bool:
        """Whether `eval_buffer` is to be called; numbers then need not be copied into CasADi's matrices and back."""
        return True

    def eval_buffer(self, arg: Sequence[memoryview], res: Sequence[memoryview]) -> int:
        """Write the results' entries, column by column."""
        given = [np.frombuffer(each) if each is not None else np.zeros(0) for each in arg]
        for place, values in zip(res, self._function(*given), strict=True):
            if place is not None:
                np.frombuffer(place)[:] = values
        return 0


def _status(returned: str, x: Array) -> Status:
    if not np.isfinite(x).all():
        return Status.NOT_FINITE
    if returned == "Solve_Succeeded":
        return Status.CONVERGED
    if returned in ("Solved_To_Acceptable_Level", "Search_Direction_Becomes_Too_Small"):
        return Status.PRECISION
    return Status.MAX_STEPS if returned == "Maximum_Iterations_Exceeded" else Status.SOLVER
