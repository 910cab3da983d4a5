"""From a trace to compiled functions of one row and their slopes, mapped over many."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import casadi as ca

from casacal.errors import ProblemError
from casacal.instruments import Instrument
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
    """What counts as a radian of each joint: one, or `PER_RAD` mm of a sliding one."""
    return [1.0 if turns else PER_RAD for turns in robot.revolute]


def position_jacobian(point: ca.SX, z: ca.SX) -> ca.SX:
    """dP/dz (3, nz) of a point P (3, mm), the tip's or the flange's: the J of eqs (3)-(5) of arXiv:2208.02652."""
    return ca.jacobian(point, z)


def residual_noise(traced: Trace) -> ca.SX:
    """Standard deviation (m) of the residual: errors of joints and columns, carried by its slope, beside its own."""
    residual, instrument = traced.residual, traced.instrument
    variance: ca.SX = ca.vertcat(*_own_variances(instrument, residual.numel(), traced.columns))
    for name, std in instrument.column_stds.items():
        variance += (ca.jacobian(residual, traced.columns[name]) * std) ** 2
    for j, joint in enumerate(traced.robot.axes):
        if joint.repeatability_std > 0:
            variance += (ca.jacobian(residual, traced.q[j]) * joint.repeatability_std) ** 2
    return ca.SX(ca.sqrt(variance))


def _own_variances(instrument: Instrument, components: int, columns: Mapping[str, ca.SX]) -> list[Any]:
    """Variance of each component of a residual by itself, as the instrument declares it: a number or from a column.

    Raises ProblemError where its blocks are not those of its residual.
    """
    if not instrument.blocks:
        return [ca.SX(instrument.residual_std**2)] * components
    name, total = type(instrument).__name__, sum(block.size for block in instrument.blocks)
    if total != components:
        fix = "Give each component a block"
        raise ProblemError(f"The blocks of {name} hold {total} residuals, and it has {components}", fix)
    found: list[Any] = []
    for block in instrument.blocks:
        if isinstance(block.std, str) and block.std not in columns:
            raise ProblemError(
                f"The noise of '{block.name}' of {name} is declared to be in the column '{block.std}', which it does "
                "not read",
                f"Its columns: {', '.join(columns) or 'none'}",
            )
        std = columns[block.std] if isinstance(block.std, str) else ca.SX(block.std)
        found += [std**2] * block.size
    return found


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
        """What it computes, operation by operation."""
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
    def _filters(self) -> dict[str, Cubature]:
        return {}

    @cached_property
    def _rows(self) -> dict[str, Kernels]:
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
    """Compile what was traced of one robot with one instrument.

    Raises ProblemError when `pose` or `residual` depends on something else than joints, columns and unknowns.
    """
    seen, z, e = traced.seen, traced.z, traced.residual
    inputs, (v, raw_residual), origin = [z, traced.c, traced.d], traced.raw, ca.SX(position(seen.pose))
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
        noise=made("noise", residual_noise(traced)),
        joint_noise=made("joint_noise", ca.sqrt(ca.sum2(by_joint**2))),
        tip=made("tip", seen.tip),
        tip_jacobian=made("tip_jacobian", seen.tip, position_jacobian(seen.tip, z).T),
        flange_jacobian=made("flange_jacobian", origin, position_jacobian(origin, z).T),
        pose=made("pose", traced.pose),
        plunger=None if seen.plunger is None else made("plunger", seen.plunger),
        raw_residual=row_function("raw_residual", [v, *inputs[1:]], [raw_residual]),
    )


def row_function(name: str, inputs: list[ca.SX], outputs: list[ca.SX], names: list[str] | None = None) -> ca.Function:
    """A function of dense outputs, common subexpressions once; `names` of its inputs, the output's is its own.

    Raises ProblemError when an output depends on anything but the inputs.
    """
    dense = [ca.densify(output) for output in ca.cse(outputs)]
    try:
        return ca.Function(name, inputs, dense, names, [name]) if names else ca.Function(name, inputs, dense)
    except RuntimeError as error:
        raise ProblemError(
            f"The {name} depends on a symbol that is neither a joint, a column nor an unknown",
            "Use only p, q and row inside pose and residual",
        ) from error
