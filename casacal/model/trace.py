"""The trace of a problem: pose and residual of one row as CasADi graphs, and compiled functions of them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca

from casacal.errors import ProblemError
from casacal.kernels.backend import VARIABLE, row_kernels
from casacal.kernels.block_rows import Batch, Columnwise, CurvatureKernel
from casacal.kernels.filter_passes import Cubature
from casacal.kernels.rows import Kernels
from casacal.model.instrument import Instrument
from casacal.model.kinematics import Expression, position
from casacal.model.robot import Robot
from casacal.model.term import Here, Site, Term
from casacal.model.traced_pose import traced
from casacal.model.unknown import Unknown
from casacal.values import FrozenMapping, Names, Value


@dataclass(frozen=True)
class RowExpressions:
    """Expressions that `pose`, `tip` and `residual` build from values p, joint values q and a row's columns."""

    pose: Expression
    """4x4, mm; a `Product` where the robot's function returns one."""
    tip: ca.SX
    residual: ca.SX
    plunger: ca.SX | None


@dataclass(frozen=True, eq=False, repr=False)
class Trace(Value):
    """Symbols of one robot with one instrument, and the expressions that its functions build of them."""

    robot: Robot
    instrument: Instrument
    terms: tuple[Term, ...] = ()

    @cached_property
    def site(self) -> Site:
        """Robot and instrument, as terms take them."""
        return Site(self.robot, self.instrument)

    @cached_property
    def of_terms(self) -> tuple[tuple[Term, Mapping[str, Unknown]], ...]:
        """Terms that have unknowns for this robot and instrument, each with these by key."""
        every = ((term, FrozenMapping(term.unknowns(self.site))) for term in self.terms)
        return tuple((term, unknowns) for term, unknowns in every if unknowns)

    @property
    def acting(self) -> tuple[Term, ...]:
        """Terms that have unknowns for this robot and instrument."""
        return tuple(term for term, _ in self.of_terms)

    @cached_property
    def unknowns(self) -> Mapping[str, Unknown]:
        """Unknowns by key: the robot's, then the instrument's, then those of the terms."""
        found: dict[str, Unknown] = {**self.robot.parameters, **self.instrument.unknowns}
        for _, unknowns in self.of_terms:
            found |= unknowns
        return FrozenMapping(found)

    @cached_property
    def nominals(self) -> Mapping[str, Any]:
        """Numbers where the nominal of an unknown is known and the same for all rows, else symbols of c."""
        return {
            key: ca.SX.sym(f"{key}_nominal", unknown.nominal_size)
            if unknown.nominal is None or unknown.per is not None
            else ca.DM(unknown.nominal)
            for key, unknown in self.unknowns.items()
        }

    @cached_property
    def local(self) -> Mapping[str, ca.SX]:
        """z, unknown by unknown."""
        return {key: ca.SX.sym(key, unknown.size) for key, unknown in self.unknowns.items()}

    @property
    def z(self) -> ca.SX:
        """Unknowns (nz): deviations from nominal of the robot's parameters, then of the instrument's unknowns."""
        return ca.vertcat(*self.local.values())

    @property
    def c(self) -> ca.SX:
        """Constants (nc): numbers that fix the nominal values which differ by label or are proposed by the data."""
        return ca.vertcat(*(self.nominals[key] for key in self.constants), ca.SX(0, 1))

    @cached_property
    def constants(self) -> Mapping[str, int]:
        """Keys of the unknowns whose nominal is part of c, in order, and how many numbers each takes."""
        varying = (key for key, value in self.nominals.items() if isinstance(value, ca.SX))
        return FrozenMapping({key: self.unknowns[key].nominal_size for key in varying})

    @cached_property
    def q(self) -> ca.SX:
        """Joint values (n): rad, mm."""
        return ca.SX.sym("q", len(self.robot.axes))

    @cached_property
    def columns(self) -> Mapping[str, ca.SX]:
        """The row's columns by name: those that are read, those known from labels, those that terms ask for."""
        of_terms = (name for term in self.acting for name in term.columns(self.site))
        names = dict.fromkeys((*self.instrument.columns, *self.instrument.known_columns, *of_terms))
        return FrozenMapping({name: ca.SX.sym(name) for name in names})

    @property
    def d(self) -> ca.SX:
        """The row (nd): q, then the columns."""
        return ca.vertcat(self.q, *self.columns.values())

    @cached_property
    def p(self) -> Names:
        """Values by name at z and c, as `pose` and `residual` take them: numbers, vectors, 4x4 frames, planes."""
        return Names(**{k: u.at(self.nominals[k], self.local[k]) for k, u in self.unknowns.items()})

    @cached_property
    def seen(self) -> RowExpressions:
        """The traced graphs; raises ProblemError when `pose`, `tip` or `residual` fails or has the wrong shape."""
        return self.at(vars(self.p))

    def at(self, values: Mapping[str, Any]) -> RowExpressions:
        """The graphs rebuilt for other parameter values p."""
        robot, instrument, columns, q = self.robot, self.instrument, self.columns, self.q
        p, row, kind = Names(**values), Names(**columns), type(instrument).__name__
        pose = robot.flange(p, q)
        here = Here(robot, instrument, p, q, pose, row)
        if self.acting:
            pose, row = _with_terms(here, self.acting)
        residual = traced(instrument.residual, "residual", kind, None, pose, p, row)
        here = replace(here, pose=pose)
        for term in self.acting:
            found = traced(term.residual, "residual", term.words, None, here, optional=True)
            residual += _in_its_unit(instrument, residual, found, term.words)
        read = list(instrument.columns)
        if read and not any(ca.depends_on(ca.SX(residual), columns[name]) for name in read):
            what = f"The residual of {kind} does not depend on what it reads, its column '{read[0]}'"
            raise ProblemError(what, f"Use {', '.join(f'row.{name}' for name in read)}, or declare no columns")
        tip = traced(instrument.tip, "tip", kind, (3, 1), pose, p, row)
        plunger = traced(instrument.plunger_direction, "plunger_direction", kind, (3, 1), pose, p, optional=True)
        return RowExpressions(pose, tip, residual, ca.SX(plunger) if plunger.numel() else None)

    @property
    def pose(self) -> ca.SX:
        """Flange pose (4x4), mm: eqs (1) and (2) of arXiv:2208.02652."""
        return ca.SX(self.seen.pose)

    @property
    def tip(self) -> ca.SX:
        """Where the instrument touches or is watched (3), mm, base frame."""
        return self.seen.tip

    @property
    def residual(self) -> ca.SX:
        """Residual e (m): for a plane its signed distance from the tip, mm, eq (6) with a unit normal."""
        return self.seen.residual

    @cached_property
    def jacobian(self) -> ca.SX:
        """de/dz (m x nz), by differentiation of the graph: the identification Jacobian, eqs (7)-(9)."""
        return ca.jacobian(self.residual, self.z)

    @cached_property
    def raw(self) -> tuple[ca.SX, ca.SX]:
        """Raw coordinates v, which only the IPOPT reference uses, and the residual (m) at them."""
        raw = {key: ca.SX.sym(key, unknown.raw_size) for key, unknown in self.unknowns.items()}
        free = {key: unknown for key, unknown in self.unknowns.items() if unknown.size}
        values = {key: unknown.raw_value(self.nominals[key], raw[key]) for key, unknown in free.items()}
        return ca.vertcat(*raw.values()), self.at(vars(self.p) | values).residual

    @cached_property
    def noise(self) -> ca.SX:
        """Standard deviation w (m) of e: errors of joints and columns carried by its slope, beside its own."""
        variance = ca.SX(ca.vertcat(*self._own_variances()))
        for name, std in self.instrument.column_stds.items():
            variance += (ca.jacobian(self.residual, self.columns[name]) * std) ** 2
        for j, joint in enumerate(self.robot.axes):
            if joint.repeatability_std > 0:
                variance += (ca.jacobian(self.residual, self.q[j]) * joint.repeatability_std) ** 2
        return ca.SX(ca.sqrt(variance))

    def _own_variances(self) -> list[ca.SX]:
        """Variance of each component by itself; raises ProblemError where blocks are not those of the residual."""
        instrument, components, columns = self.instrument, self.residual.numel(), self.columns
        if not instrument.blocks:
            return [ca.SX(instrument.residual_std**2)] * components
        name, total = type(instrument).__name__, sum(block.size for block in instrument.blocks)
        if total != components:
            fix = "Give each component a block"
            raise ProblemError(f"The blocks of {name} hold {total} residuals, and it has {components}", fix)
        found = []
        for block in instrument.blocks:
            if isinstance(block.std, str) and block.std not in columns:
                said = f"declared to be in the column '{block.std}', which it does not read"
                fix = f"Its columns: {', '.join(columns) or 'none'}"
                raise ProblemError(f"The noise of '{block.name}' of {name} is {said}", fix)
            std = columns[block.std] if isinstance(block.std, str) else ca.SX(block.std)
            found += [std**2] * block.size
        return found

    @cached_property
    def free(self) -> tuple[Mapping[str, ca.SX], RowExpressions]:
        """A symbol for the whole value of each unknown, by key, and what is built of them: p itself is an input."""
        packed = {key: ca.SX(unknown.packed(getattr(self.p, key))) for key, unknown in self.unknowns.items()}
        symbols = {key: ca.SX.sym(key, *matrix.shape) for key, matrix in packed.items()}
        return symbols, self.at({key: self.unknowns[key].unpacked(symbol) for key, symbol in symbols.items()})


def _with_terms(here: Here, terms: Sequence[Term]) -> tuple[Expression, Names]:
    """Flange pose and row as they truly are, where joints, flange and readings err."""
    off = [traced(term.joints, "joints", term.words, None, here, optional=True) for term in terms]
    moved = [each for each in off if each.numel() == len(here.robot.axes)]
    if moved:
        q = here.q + sum(moved, ca.SX.zeros(len(here.robot.axes)))
        here = replace(here, pose=here.robot.flange(here.p, q))
    read = dict(vars(here.row))
    for term in terms:
        if (changed := term.pose(here)) is not None:
            here = replace(here, pose=changed)
        for name, error in term.reading(here).items():
            read[name] = read[name] + error
    return here.pose, Names(**read)


def _in_its_unit(instrument: Instrument, residual: Expression, found: ca.SX, words: str) -> Any:
    """A term's addition to the residual components that have its unit; zero for the others."""
    units = [block.unit for block in instrument.blocks for _ in range(block.size)]
    places = [k for k, unit in enumerate(units) if unit == instrument.words.unit]
    if len(units) != residual.numel():
        places = list(range(residual.numel()))
    if found.numel() > 1 and found.numel() != len(places):
        what = f"residual of '{words}' has {found.numel()} components"
        raise ProblemError(what, f"It must have one, or the {len(places)} of the instrument's residual")
    added = ca.SX.zeros(residual.numel())
    if found.numel() and places:
        added[places] = found  # one for all is spread over them
    return added


PER_RAD = 100.0
"""Millimetres of a sliding joint that count as a radian: ten micrometres where a turning one errs by 0.1 mrad."""


def per_radian(robot: Robot) -> list[float]:
    """Unit of motion of each joint: one radian, or `PER_RAD` mm of a sliding one."""
    return [1.0 if turns else PER_RAD for turns in robot.revolute]


class RowModel:
    """The compiled functions of one robot with one instrument, of (z, c, d) but where another argument is named.

    They know no priors: problems that differ in these alone have one model between them. Raises ProblemError where the
    trace depends on anything but joints, columns and unknowns. What only some uses need is made when asked for.
    """

    def __init__(self, traced: Trace) -> None:
        self._trace = traced
        self.constants: tuple[str, ...] = tuple(traced.constants)
        """Keys of the unknowns whose nominal is part of c, in order."""
        self.terms: tuple[Term, ...] = traced.acting
        """Terms that have unknowns for this robot and instrument."""
        declared = {**traced.robot.parameters, **traced.instrument.unknowns}
        self.linear = traced.z.numel() - sum(unknown.size for unknown in declared.values())
        """Number of unknowns of terms, which are the last in z."""
        self.names: tuple[str, ...] = tuple(traced.columns)
        """Columns of d beside the joint values, in order."""
        self.residual = self._made("residual", traced.residual)
        """e (m)."""
        self.jacobian = self._made("jacobian", traced.residual, traced.jacobian.T)
        """e (m), its derivative de/dz, row by row (m * nz)."""
        self.noise = self._made("noise", traced.noise)
        """Standard deviation w (m) of e."""
        self.tip = self._made("tip", traced.tip)
        """Tip (3), mm."""
        self.pose = self._made("pose", traced.pose)
        """Flange pose (16), column by column."""
        self.arm = traced.robot.traced
        """The pose of the arm as a graph, the same for all priors."""
        plunger = traced.seen.plunger
        self.plunger = None if plunger is None else self._made("plunger", plunger)
        """Direction of the plunger (3) in the base frame; None for an instrument without one."""
        self._rows: dict[str, Kernels] = {}
        self._filters: dict[str, Cubature] = {}
        self._columnwise: dict[str, Columnwise] = {}
        self._batches: dict[str, Batch] = {}

    def _made(self, name: str, *outputs: ca.SX) -> ca.Function:
        return row_function(name, [self._trace.z, self._trace.c, self._trace.d], list(outputs))

    @cached_property
    def joint_slopes(self) -> ca.Function:
        """Derivative of e by each joint, row by row (m * joints), per 1 rad or its equivalent in mm."""
        traced = self._trace
        by_joint = ca.jacobian(traced.residual, traced.q) @ ca.diag(ca.DM(per_radian(traced.robot)))
        return self._made("joint_slopes", ca.vec(by_joint.T))

    @cached_property
    def tip_jacobian(self) -> ca.Function:
        """Tip (3), its derivative, row by row (3 * nz): J of eqs (3)-(5) of arXiv:2208.02652."""
        return self._made("tip_jacobian", self._trace.tip, ca.jacobian(self._trace.tip, self._trace.z).T)

    @cached_property
    def flange_jacobian(self) -> ca.Function:
        """Flange origin (3), mm, its derivative, row by row (3 * nz)."""
        origin = ca.SX(position(self._trace.seen.pose))
        return self._made("flange_jacobian", origin, ca.jacobian(origin, self._trace.z).T)

    @cached_property
    def raw_residual(self) -> ca.Function:
        """(v, c, d) -> e (m) at raw coordinates v, for the IPOPT reference."""
        v, residual = self._trace.raw
        return row_function("raw_residual", [v, self._trace.c, self._trace.d], [residual])

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
    def curvature(self) -> CurvatureKernel:
        """Cost, gradient and exact Hessian over many rows at one (v, c), for the IPOPT reference."""
        return CurvatureKernel(self.raw_residual, linear=self.linear)

    def columnwise(self, name: str) -> Columnwise:
        """A function by its name, over many rows at one (z, c)."""
        if name not in self._columnwise:
            self._columnwise[name] = Columnwise(getattr(self, name))
        return self._columnwise[name]

    def batch(self, name: str) -> Batch:
        """A function by its name, over rows that differ in z and c too."""
        if name not in self._batches:
            self._batches[name] = Batch(getattr(self, name))
        return self._batches[name]


def row_function(name: str, inputs: list[ca.SX], outputs: list[ca.SX], names: list[str] | None = None) -> ca.Function:
    """A function of dense outputs; `names` of its inputs. Raises ProblemError when it depends on anything else."""
    dense = [ca.densify(output) for output in ca.cse(outputs)]
    try:
        return ca.Function(name, inputs, dense, names, [name]) if names else ca.Function(name, inputs, dense)
    except RuntimeError as error:
        what = f"The {name} depends on a symbol that is neither a joint, a column nor an unknown"
        raise ProblemError(what, "Use only p, q and row inside pose and residual") from error
