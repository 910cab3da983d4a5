"""From a robot and an instrument to compiled functions of one row, mapped over many.

One symbolic expression a row holds forward kinematics, plane and residual; its analytic Jacobian, the noise of the
row and the raw form for the IPOPT reference come from the same graph. Coordinates of a row model:

    z  local coordinates of the robot's parameters and the instrument's unknowns, in that order
    c  numbers that fix those nominal values which differ by label or are proposed by the data
    d  the row itself: joint values, then the instrument's columns, then those known from labels
"""

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
from casacal.kernels.backend import VARIABLE, RowKernels
from casacal.kernels.batch import Batch
from casacal.kernels.block_filter import BlockCubature
from casacal.kernels.columnwise import Columnwise
from casacal.kernels.curvature import CurvatureKernel
from casacal.kernels.native_filter import NativeCubature
from casacal.kernels.steps import cubature_pass
from casacal.kinematics import Product, position
from casacal.robots.robot import Robot
from casacal.unknowns import Unknown


@dataclass(frozen=True)
class RowModel:
    """The compiled functions of one robot with one instrument."""

    unknowns: Mapping[str, Unknown]
    constants: tuple[str, ...]
    """Keys of the unknowns whose nominal is part of c, in order."""
    residual: ca.Function
    """(z, c, d) -> residual e (m)."""
    jacobian: ca.Function
    """(z, c, d) -> residual e (m), its derivative de/dz, row by row (m * nz)."""
    noise: ca.Function
    """(z, c, d) -> standard deviation w (m) of e."""
    tip: ca.Function
    """(z, c, d) -> tip (3), mm."""
    tip_jacobian: ca.Function
    """(z, c, d) -> tip (3), its derivative, row by row (3 * nz)."""
    flange_jacobian: ca.Function
    """(z, c, d) -> flange origin (3), mm, its derivative, row by row (3 * nz)."""
    pose: ca.Function
    """(z, c, d) -> flange pose (16), column by column."""
    plunger: ca.Function | None
    """(z, c, d) -> direction of the plunger (3) in the base frame; None for an instrument without one."""
    raw_residual: ca.Function
    """(v, c, d) -> residual e (m) at raw coordinates v, for the IPOPT reference."""

    def same_as(self, other: RowModel) -> bool:
        """Whether another model computes the same, operation by operation."""
        return self.text == other.text

    @cached_property
    def text(self) -> str:
        """What it computes, as text."""
        return "\n".join(function.serialize() for function in (self.residual, self.noise, self.tip, self.pose))

    @property
    def components(self) -> int:
        """Scalar residuals a row, m."""
        return int(self.residual.numel_out(0))

    def rows(self, backend: str | None = None) -> RowKernels:
        """Kernels over many rows at one (z, c), on a back end; None takes the environment's, or auto."""
        key = backend or os.environ.get(VARIABLE, "auto")
        if key not in self._rows:
            self._rows[key] = RowKernels(self.jacobian, ("once", "once", "lane"), key)
        return self._rows[key]

    def filter(self, backend: str | None = None) -> NativeCubature | BlockCubature:
        """The cubature filter's pass, on the back end that evaluates rows."""
        name = self.rows(backend).kernels.name
        if name not in self._filters:
            self._filters[name] = cubature_pass(self.residual, name)
        return self._filters[name]

    @cached_property
    def _filters(self) -> dict[str, NativeCubature | BlockCubature]:
        return {}

    @cached_property
    def _rows(self) -> dict[str, RowKernels]:
        return {}

    @cached_property
    def columns(self) -> SimpleNamespace:
        """Noise, tip, pose and plunger of many rows at one (z, c), each as a `Columnwise`."""
        names = ("noise", "tip", "pose") + (("plunger",) if self.plunger is not None else ())
        return SimpleNamespace(**{name: Columnwise(getattr(self, name)) for name in names})

    @cached_property
    def curvature(self) -> CurvatureKernel:
        """Cost, gradient and exact Hessian over many rows at one (v, c), for the IPOPT reference."""
        return CurvatureKernel(self.raw_residual)

    @cached_property
    def batch(self) -> SimpleNamespace:
        """The same functions, each as a `Batch`."""
        names = ["residual", "jacobian", "noise", "tip", "tip_jacobian", "flange_jacobian", "pose"]
        names += ["plunger"] if self.plunger is not None else []
        return SimpleNamespace(**{name: Batch(getattr(self, name)) for name in names})


def compile_rows(robot: Robot, instrument: Instrument) -> RowModel:
    """Trace and compile one robot with one instrument.

    Raises ProblemError when `pose` or `residual` fails, has the wrong shape or depends on something else.
    """
    unknowns: dict[str, Unknown] = {**robot.parameters, **instrument.unknowns}
    q = ca.SX.sym("q", len(robot.axes))
    row = {name: ca.SX.sym(name) for name in (*instrument.columns, *instrument.known_columns)}
    d = ca.vertcat(q, *row.values())
    nominals = {key: _nominal(key, unknown) for key, unknown in unknowns.items()}
    constants = tuple(key for key, value in nominals.items() if isinstance(value, ca.SX))
    c = ca.vertcat(*(nominals[key] for key in constants)) if constants else ca.SX(0, 1)

    local = {key: ca.SX.sym(key, unknown.size) for key, unknown in unknowns.items()}
    raw = {key: ca.SX.sym(key, unknown.raw_size) for key, unknown in unknowns.items()}
    p = SimpleNamespace(**{key: unknown.at(nominals[key], local[key]) for key, unknown in unknowns.items()})
    p_raw = SimpleNamespace(**{key: u.raw_value(nominals[key], raw[key]) for key, u in unknowns.items()})
    z, v = ca.vertcat(*local.values()), ca.vertcat(*raw.values())

    namespace = SimpleNamespace(**row)
    pose = _traced(robot.pose, "pose", robot.name, (4, 4), p, q)
    residual = _traced(instrument.residual, "residual", type(instrument).__name__, None, pose, p, namespace)
    tip = _traced(instrument.tip, "tip", type(instrument).__name__, (3, 1), pose, p, namespace)
    plunger = instrument.plunger_direction(pose, p)
    raw_pose = _traced(robot.pose, "pose", robot.name, (4, 4), p_raw, q)
    raw_residual = _traced(instrument.residual, "residual", robot.name, residual.shape, raw_pose, p_raw, namespace)
    # what the paper derives by hand to first order, the errors of links and tip in eqs (3)-(5) and of the distance from
    # the plane in (7)-(9) of arXiv:2208.02652, automatic differentiation of the symbolic graph replaces: exact for any
    # convention and instrument, and without errata E6-E8
    slopes, origin = ca.jacobian(residual, z), ca.SX(position(pose))
    return RowModel(
        unknowns=unknowns,
        constants=constants,
        residual=_function("residual", [z, c, d], [residual]),
        jacobian=_function("jacobian", [z, c, d], [residual, slopes.T]),
        noise=_function("noise", [z, c, d], [_noise(robot, instrument, residual, q, row)]),
        tip=_function("tip", [z, c, d], [tip]),
        tip_jacobian=_function("tip_jacobian", [z, c, d], [tip, ca.jacobian(tip, z).T]),
        flange_jacobian=_function("flange_jacobian", [z, c, d], [origin, ca.jacobian(origin, z).T]),
        pose=_function("pose", [z, c, d], [ca.SX(pose)]),
        plunger=None if plunger is None else _function("plunger", [z, c, d], [ca.SX(plunger)]),
        raw_residual=_function("raw_residual", [v, c, d], [raw_residual]),
    )


def _nominal(key: str, unknown: Unknown) -> Any:
    """Numbers where the nominal is known and the same for all rows, else symbols."""
    if unknown.nominal is None or unknown.per is not None:
        return ca.SX.sym(f"{key}_nominal", unknown.nominal_size)
    return ca.DM(unknown.nominal)


def _noise(robot: Robot, instrument: Instrument, residual: ca.SX, q: ca.SX, row: Mapping[str, ca.SX]) -> ca.SX:
    """Standard deviation of the residual: errors of joints and columns, carried by its slope, beside its own."""
    variance = ca.SX(instrument.residual_std**2) * ca.SX.ones(residual.shape)
    for name, std in instrument.column_stds.items():
        variance += (ca.jacobian(residual, row[name]) * std) ** 2
    for j, joint in enumerate(robot.axes):
        if joint.repeatability_std > 0:
            variance += (ca.jacobian(residual, q[j]) * joint.repeatability_std) ** 2
    return ca.sqrt(variance)


def _traced(call: Any, what: str, owner: str, shape: tuple[int, int] | None, *arguments: Any) -> Any:
    try:
        built = call(*arguments)
        value = built if isinstance(built, Product) else ca.SX(built)
        found = value.shape  # a product is multiplied out here, so that factors that do not fit are found
    except Exception as error:  # whatever a user's function raises, it is their problem file that must change
        raise ProblemError(
            f"{what} of '{owner}' failed with {type(error).__name__}: {' '.join(str(error).split())}",
            "It must build CasADi expressions from its arguments; see casacal.kinematics",
        ) from error
    if shape is not None and found != shape:
        raise ProblemError(f"{what} of '{owner}' has the shape {found}", f"It must be {shape}")
    if found[1] != 1 and shape is None:
        raise ProblemError(f"{what} of '{owner}' has the shape {found}", "It must be a scalar or a column")
    return value


def _function(name: str, inputs: list[ca.SX], outputs: list[ca.SX]) -> ca.Function:
    try:
        return ca.Function(name, inputs, [ca.densify(output) for output in ca.cse(outputs)])
    except RuntimeError as error:
        raise ProblemError(
            f"The {name} depends on a symbol that is neither a joint, a column nor an unknown",
            "Use only p, q and row inside pose and residual",
        ) from error
