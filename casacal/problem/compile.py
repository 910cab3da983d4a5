"""From a trace to compiled functions of one row and their slopes, mapped over many."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace

import casadi as ca

from casacal.errors import ProblemError
from casacal.kernels.backend import VARIABLE, row_kernels
from casacal.kernels.block_rows import Batch, Columnwise, CurvatureKernel
from casacal.kernels.filter_passes import Cubature
from casacal.kernels.rows import Kernels
from casacal.kinematics import position
from casacal.problem.term import Term
from casacal.problem.trace import Trace
from casacal.robots.robot import Robot

PER_RAD = 100.0
"""Millimetres of a sliding joint that count as a radian: ten micrometres where a turning one errs by 0.1 mrad."""


def per_radian(robot: Robot) -> list[float]:
    """Unit of motion of each joint: one radian, or `PER_RAD` mm of a sliding one."""
    return [1.0 if turns else PER_RAD for turns in robot.revolute]


@dataclass(frozen=True)
class RowModel:
    """The compiled functions of one robot with one instrument, of (z, c, d) but where another argument is named.

    They know no priors: problems that differ in these alone have one model between them.
    """

    constants: tuple[str, ...]
    """Keys of the unknowns whose nominal is part of c, in order."""
    terms: tuple[Term, ...]
    """Those that mean something to this robot and instrument."""
    linear: int
    """How many of z, the last, are of terms."""
    names: tuple[str, ...]
    """Columns of d beside the joint values, in order."""
    residual: ca.Function
    """e (m)."""
    jacobian: ca.Function
    """e (m), its derivative de/dz, row by row (m * nz)."""
    noise: ca.Function
    """Standard deviation w (m) of e."""
    joint_noise: ca.Function
    """The same (m) where every joint errs on its own, by a radian or what counts as one, and nothing else."""
    tip: ca.Function
    """Tip (3), mm."""
    tip_jacobian: ca.Function
    """Tip (3), its derivative, row by row (3 * nz)."""
    flange_jacobian: ca.Function
    """Flange origin (3), mm, its derivative, row by row (3 * nz)."""
    pose: ca.Function
    """Flange pose (16), column by column."""
    plunger: ca.Function | None
    """Direction of the plunger (3) in the base frame; None for an instrument without one."""
    raw_residual: ca.Function
    """(v, c, d) -> e (m) at raw coordinates v, for the IPOPT reference."""

    @cached_property
    def text(self) -> str:
        """Serialised functions of the row: residual, noise, tip and pose."""
        return "\n".join(function.serialize() for function in (self.residual, self.noise, self.tip, self.pose))

    @property
    def components(self) -> int:
        """Scalar residuals per row, m."""
        return int(self.residual.numel_out(0))

    def rows(self, backend: str | None = None) -> Kernels:
        """Kernels over many rows at one (z, c), on a back end; None takes the environment's, or auto."""
        key = backend or os.environ.get(VARIABLE, "auto")
        if key not in self._rows:
            self._rows[key] = row_kernels(self.jacobian, key)
        return self._rows[key]

    def filter(self, backend: str | None = None) -> Cubature:
        """The cubature filter's pass, on the back end that evaluates rows."""
        name = self.rows(backend).name
        if name not in self._filters:
            self._filters[name] = Cubature(self.residual, name)
        return self._filters[name]

    @cached_property
    def _rows(self) -> dict[str, Kernels]:
        return {}

    @cached_property
    def _filters(self) -> dict[str, Cubature]:
        return {}

    @cached_property
    def columns(self) -> SimpleNamespace:
        """Noise, tip, pose and plunger of many rows at one (z, c), each as a `Columnwise`."""
        return self._each("noise joint_noise tip pose plunger", Columnwise)

    @cached_property
    def curvature(self) -> CurvatureKernel:
        """Cost, gradient and exact Hessian over many rows at one (v, c), for the IPOPT reference."""
        return CurvatureKernel(self.raw_residual, linear=self.linear)

    @cached_property
    def batch(self) -> SimpleNamespace:
        """Functions of rows that differ in z and c too, each as a `Batch`."""
        return self._each("residual jacobian noise tip tip_jacobian flange_jacobian pose plunger", Batch)

    def _each(self, names: str, form: type[Batch] | type[Columnwise]) -> SimpleNamespace:
        functions = {name: getattr(self, name) for name in names.split()}
        return SimpleNamespace(**{name: form(each) for name, each in functions.items() if each is not None})


def compile_rows(traced: Trace) -> RowModel:
    """Compile a trace; raises ProblemError where it depends on anything but joints, columns and unknowns."""
    seen, z, e = traced.seen, traced.z, traced.residual
    inputs, (v, raw_residual), origin = [z, traced.c, traced.d], traced.raw, ca.SX(position(seen.pose))
    slope, origin_slope = ca.jacobian(seen.tip, z), ca.jacobian(origin, z)  # J of eqs (3)-(5) of arXiv:2208.02652
    declared = {**traced.robot.parameters, **traced.instrument.unknowns}
    by_joint = ca.jacobian(e, traced.q) @ ca.diag(ca.DM(per_radian(traced.robot)))

    def made(name: str, *outputs: ca.SX) -> ca.Function:
        return row_function(name, inputs, list(outputs))

    return RowModel(
        constants=tuple(traced.constants),
        terms=traced.acting,
        linear=z.numel() - sum(unknown.size for unknown in declared.values()),
        names=tuple(traced.columns),
        residual=made("residual", e),
        jacobian=made("jacobian", e, traced.jacobian.T),
        noise=made("noise", traced.noise),
        joint_noise=made("joint_noise", ca.sqrt(ca.sum2(by_joint**2))),
        tip=made("tip", seen.tip),
        tip_jacobian=made("tip_jacobian", seen.tip, slope.T),
        flange_jacobian=made("flange_jacobian", origin, origin_slope.T),
        pose=made("pose", traced.pose),
        plunger=None if seen.plunger is None else made("plunger", seen.plunger),
        raw_residual=row_function("raw_residual", [v, *inputs[1:]], [raw_residual]),
    )


def row_function(name: str, inputs: list[ca.SX], outputs: list[ca.SX], names: list[str] | None = None) -> ca.Function:
    """A function of dense outputs; `names` of its inputs. Raises ProblemError when it depends on anything else."""
    dense = [ca.densify(output) for output in ca.cse(outputs)]
    try:
        return ca.Function(name, inputs, dense, names, [name]) if names else ca.Function(name, inputs, dense)
    except RuntimeError as error:
        what = f"The {name} depends on a symbol that is neither a joint, a column nor an unknown"
        raise ProblemError(what, "Use only p, q and row inside pose and residual") from error
