"""IPOPT, or another nlpsol, as an independent reference: raw unit normals under constraints, exact Hessian.

First the objective over raw coordinates that the solver asks about, with exact gradient and Hessian; then the solver.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from casacal.errors import CasacalError, ProblemError, UnknownNameError, came
from casacal.fit.least_squares import LeastSquares, Result, Status, nothing_unknown
from casacal.kernels.losses import Loss
from casacal.values import Array

if TYPE_CHECKING:
    from casacal.fit.kernel_rows import RawGraph


class Objective:
    """The objective in scaled raw coordinates y, v = start + scales * y, with exact gradient and Hessian.

    Each coordinate is in units of its own conditional standard deviation at the start: gradients then vanish to
    rounding. All three are found together, once for each y. Of the Hessian only what is not zero is held: faces never
    meet.
    """

    def __init__(
        self, graph: RawGraph, problem: LeastSquares, loss: Loss | None = None, start: Array | None = None
    ) -> None:
        n = graph.start.size
        self._graph, self._problem, self._loss = graph, problem, loss
        self.start = graph.start if start is None else start
        # entries of the upper triangle, column by column, are known by column * n + row
        corners = [np.triu_indices(block.columns.size) for block in graph.blocks]
        meets = [np.sort(b.columns[np.array(ij)], axis=0) for b, ij in zip(graph.blocks, corners, strict=True)]
        others = [np.array([np.arange(n)] * 2), np.array(graph.prior_places), np.array(graph.bend_places)]
        keys = [columns * n + rows for rows, columns in [*meets, *others]]
        known = np.unique(np.concatenate(keys))
        self.columns, self.rows = np.divmod(known, n)
        *of_blocks, diagonal, self._prior, self._bend = (np.searchsorted(known, each) for each in keys)
        self._blocks = list(zip(graph.blocks, corners, of_blocks, strict=True))
        self.evaluations = 0
        cost, gradient, entries = self._evaluate(self.start)
        size = np.abs(entries[diagonal])
        self.scales = 1.0 / np.sqrt(np.where(size > 0, size, 1.0))
        self._at, self._found = np.zeros(n), (cost, self.scales * gradient, self._scaled(entries))

    def raw(self, y: Array) -> Array:
        """Raw coordinates v (n,)."""
        return np.asarray(self.start + self.scales * y)

    def __call__(self, y: Array) -> tuple[float, Array, Array]:
        """Value, gradient (n,) and the entries (pattern's) of the Hessian by y."""
        if not np.array_equal(y, self._at):
            cost, gradient, entries = self._evaluate(self.raw(y))
            self._at = y.copy()
            self._found = cost, self.scales * gradient, self._scaled(entries)
        return self._found

    def lagrangian(self, y: Array, factor: float, multipliers: Array) -> Array:
        """Entries of the Hessian by y of the objective times a factor and the constraints times their multipliers."""
        bent, entries = np.empty(self._bend.size), np.zeros(self.rows.size)
        self._graph.bend((self.raw(y), multipliers), (bent,))
        entries[self._bend] = bent
        return factor * self(y)[2] + self._scaled(entries)

    def _scaled(self, entries: Array) -> Array:
        return self.scales[self.rows] * entries * self.scales[self.columns]

    def _evaluate(self, v: Array) -> tuple[float, Array, Array]:
        self.evaluations += 1
        value, gradient, found = np.empty(1), np.empty(v.size), np.empty(self._prior.size)
        self._graph.prior((v,), (value, gradient, found))
        cost, entries = float(value[0]), np.zeros(self.rows.size)
        entries[self._prior] = found
        for block, corner, places in self._blocks:
            some, slope, bend = block(v, self._loss)
            cost += some
            gradient[block.columns] += slope  # no coordinate stands twice among those of a block
            entries[places] += bend[corner]
        return cost, gradient, entries


def ipopt(
    problem: LeastSquares,
    *,
    max_steps: int = 200,
    tolerance: float = 1e-9,
    loss: Loss | None = None,
    verbose: bool = False,
) -> Result:
    """Minimise f over raw coordinates v (normals as free 3-vectors, rotations as quaternions) with v'v = 1 constraints.

    Shares the model's residual with the other estimators but neither their parametrisation of planes nor their
    derivatives nor their linear algebra. Linear solver: MUMPS, which ships with CasADi's wheel.

    Args:
        problem: must have a `graph`.
        max_steps: IPOPT iterations at most.
        tolerance: IPOPT's `tol`, on the scaled optimality error.
        loss: what replaces r^2 / 2 in f, such as `huber()`; the Hessian is then Gauss-Newton's.
        verbose: let IPOPT print.

    Raises ProblemError when the problem has no symbolic form.

    """
    options = {
        # where rounding keeps the gradient above tol, stop once the objective stands still
        **{"max_iter": max_steps, "tol": tolerance, "constr_viol_tol": 1e-12, "acceptable_tol": 1e-5},
        **{"acceptable_obj_change_tol": 1e-11, "acceptable_iter": 3, "nlp_scaling_method": "none"},
        **{"linear_solver": "mumps", "print_level": 5 if verbose else 0, "sb": "yes"},
    }
    return nlpsol(problem, solver="ipopt", options={"ipopt": options, "show_eval_warnings": verbose}, loss=loss)


def nlpsol(
    problem: LeastSquares, *, solver: str = "ipopt", options: Mapping[str, Any] | None = None, loss: Loss | None = None
) -> Result:
    """The program of `ipopt` by any nlpsol plug-in, such as "fatrop" or "sqpmethod".

    Args:
        problem: must have a `graph`.
        solver: name of the plug-in.
        options: of CasADi's nlpsol for it; by default silent, and for known plug-ins strict.
        loss: as for `ipopt`.

    Raises ProblemError when the problem has no symbolic form, UnknownNameError when there is no such plug-in, and
    CasacalError when it takes no such program.

    """
    check_solver(solver)
    if options is None and solver == "ipopt":
        return ipopt(problem, loss=loss)
    if not problem.unknowns:
        return nothing_unknown(problem, solver)
    if problem.graph is None:
        raise ProblemError("IPOPT needs the symbolic form of a problem and this one has none", "Use lm instead")
    if options is not None and not isinstance(options, Mapping):
        raise CasacalError(f"Got {came(options)} as the options of '{solver}'", "Give a dict of options by name")
    graph: RawGraph = problem.graph
    stages, start = [loss], graph.start
    while (first := stages[0]) is not None and first.after is not None:
        stages.insert(0, first.after)
    for stage in stages:
        objective = Objective(graph, problem, stage, start)
        program, common, kept = _program(graph, objective, exact=solver == "ipopt")
        try:
            made = ca.nlpsol(
                "reference", solver, program, common | dict(_silent(solver, stage) if options is None else options)
            )
            solution = made(x0=np.zeros(start.size), lbg=graph.low, ubg=graph.high)
        except (RuntimeError, NotImplementedError) as error:
            option = re.search(r"cpp:\d+: (.*\boption\b.*)", str(error), re.IGNORECASE)  # which it does not know
            said = next(iter(str(error).rpartition("failed:")[2].strip().splitlines()), "").rstrip(" :.")
            said = said if option is None else option[1]
            fix = "Give it other options, or use ipopt, fatrop or sqpmethod"
            raise CasacalError(f"The solver '{solver}' does not take this program: {said}", fix) from error
        del kept  # CasADi calls these but does not hold them
        start = objective.raw(np.asarray(solution["x"]).ravel())
    stats: dict[str, Any] = made.stats()
    x, multipliers = np.asarray(graph.local(start)).ravel(), np.asarray(solution["lam_g"]).ravel()
    history = stats.get("iterations") or {}
    return Result(
        method=solver,
        problem=problem,
        x=x,
        status=_status(stats, x),
        trace={
            "cost": np.array(history.get("obj", [float(solution["f"])])),
            "dual_infeasibility": np.array(history.get("inf_du", [])),
            "constraint_violation": np.array(history.get("inf_pr", [])),
        },
        steps=int(stats.get("iter_count", 0)),
        residual_rows=problem.rows * objective.evaluations,
        jacobian_rows=problem.rows * objective.evaluations,
        loss=loss,
        dual=None if problem.constraints is None else multipliers[-len(problem.constraints.names) :],
    )


def _silent(solver: str, loss: Loss | None) -> Mapping[str, Any]:
    """Options of plug-ins that would print, or stop early, without them; others are as CasADi has them."""
    known: Mapping[str, Mapping[str, Any]] = {
        # with a loss steps shrink by a factor each, and rounding ends them before 1e-9
        "fatrop": {"fatrop": {"print_level": 0, "max_iter": 200, "tolerance": 1e-9 if loss is None else 1e-5}},
        "sqpmethod": {
            **{"print_header": False, "print_iteration": False, "print_status": False},
            **{"max_iter": 200, "tol_pr": 1e-9, "tol_du": 1e-7, "qpsol": "qrqp"},
            "qpsol_options": {"print_iter": False, "print_header": False, "error_on_fail": False},
        },
        "uno": {"uno": {"logger": "SILENT"}},
    }
    return known.get(solver, {})


def check_solver(name: str) -> None:
    """Raise UnknownNameError, with those that there are, unless CasADi finds an nlpsol plug-in of that name."""
    if not isinstance(name, str):
        raise CasacalError(f"Got {came(name)} as a solver", "Give the name of an nlpsol plug-in, such as 'fatrop'")
    if not ca.has_nlpsol(name):
        known = (each.removeprefix("Nlpsol::") for each in ca.CasadiMeta.plugins().split(";"))
        raise UnknownNameError("nlpsol plug-in", name, sorted(each for each in known if ca.has_nlpsol(each)))


def _program(
    graph: RawGraph, objective: Objective, *, exact: bool
) -> tuple[dict[str, Any], dict[str, Any], list[_Call]]:
    """The nonlinear program in scaled raw coordinates, options, and what must outlive the solver.

    exact: IPOPT takes the functions of gradient and Hessian as options; others derive them from the objective's.
    """
    n = graph.start.size

    def hessian(y: Array, _: Array, lam_f: Array, lam_g: Array) -> list[Any]:
        return [objective.lagrangian(y, float(lam_f[0]), lam_g)]

    point, nothing, one, row = (ca.Sparsity.dense(*shape) for shape in ((n, 1), (0, 1), (1, 1), (1, n)))
    dual = ca.Sparsity.dense(graph.constraints.numel_out(0))
    x = ca.MX.sym("x", n)
    options: dict[str, Any] = {"print_time": False}
    if exact:
        value = _Call("value", [point], [one], lambda y: [objective(y)[0]])
        slope = _Call("slope", [point, nothing], [one, point], lambda y, _: list(objective(y)[:2]))
        curvature = _Call("curvature", [point, nothing, one, dual], [_pattern(objective)], hessian)
        options |= {
            "no_nlp_grad": True,  # it would differentiate the objective once more, for sensitivities that nobody asks
            "grad_f": _named(slope, ["x", "p"], ["f", "grad_f_x"]),
            "hess_lag": _named(curvature, ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"]),
        }
    else:
        upper = _pattern(objective)
        whole = upper + upper.T
        rows, columns = (np.array(index) for index in whole.get_triplet())
        places = np.array(upper.get_nz((np.minimum(rows, columns) + n * np.maximum(rows, columns)).tolist()), dtype=int)
        empty = ca.Sparsity(n, 1)
        curvature = _Call(
            "curvature", [point, one, row], [whole, empty], lambda y, *_: [objective(y)[2][places], np.zeros(0)]
        )
        slope = _Call("slope", [point, one], [row], lambda y, _: [objective(y)[1]], curvature)
        value = _Call("value", [point], [one], lambda y: [objective(y)[0]], slope)
    program = {"x": x, "f": value(x), "g": graph.constraints(objective.start + objective.scales * x)}
    return program, options, [value, slope, curvature]


def _pattern(objective: Objective) -> ca.Sparsity:
    """Sparsity of the Hessian's upper triangle."""
    n = objective.start.size
    starts = np.searchsorted(objective.columns, np.arange(n + 1))
    return ca.Sparsity(n, n, starts.tolist(), objective.rows.tolist())


def _named(call: _Call, inputs: list[str], outputs: list[str]) -> ca.Function:
    """The function with the names by which CasADi's solvers know arguments and results."""
    arguments = [ca.MX.sym(name, call.sparsity_in(i)) for i, name in enumerate(inputs)]
    return ca.Function(f"nlp_{call.name()}", arguments, call.call(arguments), inputs, outputs)


class _Call(ca.Callback):
    """A Python function of flat arrays that CasADi can call; its methods are those that CasADi asks for."""

    def __init__(
        self,
        name: str,
        inputs: list[ca.Sparsity],
        outputs: list[ca.Sparsity],
        function: Callable[..., list[Any]],
        derivative: _Call | None = None,
    ) -> None:
        super().__init__()
        self._inputs, self._outputs, self._function, self._derivative = inputs, outputs, function, derivative
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self._inputs)

    def get_n_out(self) -> int:
        return len(self._outputs)

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return self._inputs[i]

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return self._outputs[i]

    def has_jacobian(self) -> bool:
        return self._derivative is not None

    def get_jacobian(self, name: str, inames: Sequence[str], onames: Sequence[str], opts: Any) -> ca.Function:
        del name, inames, onames, opts
        assert self._derivative is not None
        return self._derivative

    def has_eval_buffer(self) -> bool:
        """Whether `eval_buffer` is to be called; numbers then need not be copied into CasADi's matrices and back."""
        return True

    def eval_buffer(self, arg: Sequence[memoryview], res: Sequence[memoryview]) -> int:
        """Write the results' entries, column by column."""
        arguments = [np.frombuffer(each) if each is not None else np.zeros(0) for each in arg]
        for place, values in zip(res, self._function(*arguments), strict=True):
            if place is not None:
                np.frombuffer(place)[:] = values
        return 0


def _status(stats: Mapping[str, Any], x: Array) -> Status:
    returned = str(stats.get("return_status", ""))
    if not np.isfinite(x).all():
        return Status.NOT_FINITE
    if returned in ("Solved_To_Acceptable_Level", "Search_Direction_Becomes_Too_Small"):
        return Status.PRECISION
    if stats.get("success"):
        return Status.CONVERGED
    return Status.MAX_STEPS if returned.startswith("Maximum_Iterations") else Status.SOLVER
