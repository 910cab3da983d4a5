"""One robot with one instrument to CasADi: pose and residual of a row as graphs, and compiled functions of them.

symbols = problem.symbols
symbols.residual, symbols.z, symbols.c, symbols.q, symbols.columns["reading"]    expressions (SX)
symbols.functions["residual"](z, c, d)                                           compiled, for SX, MX and numbers
symbols.value_functions["pose"](alpha=..., a=..., d=..., theta=..., q=q)         the values p themselves as inputs
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca

from casacal.errors import ProblemError
from casacal.kernels.block_rows import Batch, Columnwise, CurvatureKernel
from casacal.kernels.filter_passes import Cubature
from casacal.kernels.native_rows import VARIABLE, row_kernels
from casacal.kernels.rows import Kernels
from casacal.model.instrument import Instrument
from casacal.model.kinematics import Expression, position
from casacal.model.robot import Robot
from casacal.model.term import Here, Site, Term
from casacal.model.traced_pose import traced
from casacal.model.unknown import Unknown
from casacal.values import FrozenMapping, Names, Value, alike, short


@dataclass(frozen=True)
class RowExpressions:
    """Expressions that `pose`, `tip` and `residual` build from values p, joint values q and a row's columns."""

    pose: Expression  # 4x4, mm; a `Product` where the robot's function returns one
    tip: ca.SX
    residual: ca.SX
    plunger: ca.SX | None


@dataclass(frozen=True, eq=False, repr=False)
class Symbols(Value):
    """One robot with one instrument as CasADi expressions: lengths in mm, angles in rad; what `Problem.symbols` gives.

    Expressions are SX and belong together: those of another `Symbols` do not mix with them. Raises ProblemError when
    `pose`, `tip` or `residual` fails, has the wrong shape or depends on something else.
    """

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
        for term, unknowns in self.of_terms:
            if twice := sorted(found.keys() & unknowns.keys()):
                what = f"'{twice[0]}' is an unknown of '{term.words}', and one of '{self.robot.name}' or its instrument"
                raise ProblemError(what, "Call that one something else, or leave that term out (--discrepancy none)")
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
        own = dict.fromkeys((*self.instrument.columns, *self.instrument.known_columns))
        of_terms = [(term, name) for term in self.acting for name in term.columns(self.site)]
        for term, name in of_terms:
            if name in own:
                what = f"'{name}' is a column of the instrument, and what '{term.words}' calls one of its own"
                raise ProblemError(what, "Call that column something else, or leave that term out (--discrepancy none)")
        names = own | dict.fromkeys(name for _, name in of_terms)
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
        units = [block.unit for block in instrument.blocks for _ in range(block.size)]
        places = [k for k, unit in enumerate(units) if unit == instrument.words.unit]
        if len(units) != residual.numel():
            places = list(range(residual.numel()))
        for term in self.acting:  # each adds to the components that have its unit, one for all or one for each
            found = traced(term.residual, "residual", term.words, None, here, optional=True)
            if found.numel() > 1 and found.numel() != len(places):
                what = f"residual of '{term.words}' has {found.numel()} components"
                raise ProblemError(what, f"It must have one, or the {len(places)} of the instrument's residual")
            added = ca.SX.zeros(residual.numel())
            if found.numel() and places:
                added[places] = found
            residual += added
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
        """Standard deviation w (m) of e: errors of joints and columns carried by its slope, beside its own.

        Raises ProblemError where the instrument's blocks are not those of the residual.
        """
        instrument, components, columns, own = self.instrument, self.residual.numel(), self.columns, list[ca.SX]()
        name, total = type(instrument).__name__, sum(block.size for block in instrument.blocks)
        if instrument.blocks and total != components:
            fix = "Give each component a block"
            raise ProblemError(f"The blocks of {name} hold {total} residuals, and it has {components}", fix)
        for block in instrument.blocks:
            if isinstance(block.std, str) and block.std not in columns:
                said = f"declared to be in the column '{block.std}', which it does not read"
                fix = f"Its columns: {', '.join(columns) or 'none'}"
                raise ProblemError(f"The noise of '{block.name}' of {name} is {said}", fix)
            std = columns[block.std] if isinstance(block.std, str) else ca.SX(block.std)
            own += [std**2] * block.size
        variance = ca.SX(ca.vertcat(*(own or [ca.SX(instrument.residual_std**2)] * components)))
        for column, error in instrument.column_stds.items():
            variance += (ca.jacobian(self.residual, columns[column]) * error) ** 2
        for j, joint in enumerate(self.robot.axes):
            if joint.repeatability_std > 0:
                variance += (ca.jacobian(self.residual, self.q[j]) * joint.repeatability_std) ** 2
        return ca.SX(ca.sqrt(variance))

    @cached_property
    def free(self) -> tuple[Mapping[str, ca.SX], RowExpressions]:
        """A symbol for the whole value of each unknown, by key, and what is built of them: p itself is an input."""
        packed = {key: ca.SX(unknown.packed(getattr(self.p, key))) for key, unknown in self.unknowns.items()}
        symbols = {key: ca.SX.sym(key, *matrix.shape) for key, matrix in packed.items()}
        return symbols, self.at({key: self.unknowns[key].unpacked(symbol) for key, symbol in symbols.items()})

    @cached_property
    def model(self) -> RowModel:
        """The functions that estimators evaluate."""
        return RowModel(self)

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each of z, without labels."""
        return tuple(name for key, unknown in self.unknowns.items() for name in unknown.names(key))

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each of z."""
        return tuple(unit for unknown in self.unknowns.values() for unit in unknown.units)

    @cached_property
    def functions(self) -> Mapping[str, ca.Function]:
        """Compiled functions of one row, (z, c, d) -> residual, jacobian, noise, tip, pose: each by its name."""
        outputs = {name: getattr(self, name) for name in ("residual", "jacobian", "noise", "tip", "pose")}
        inputs = [self.z, self.c, self.d]
        return FrozenMapping({k: row_function(k, inputs, [e], ["z", "c", "d"]) for k, e in outputs.items()})

    @cached_property
    def value_functions(self) -> Mapping[str, ca.Function]:
        """Functions with the values free: "pose", "tip" and "residual" of values, q and columns, all inputs by name.

        A value enters as `p` holds it: a number, a vector or a 4x4 frame; a plane as its normal (3), a point (3, mm)
        and an offset (mm) along it. `pose` takes the robot's parameters and q; `tip` also what it depends on of the
        instrument and the columns; `residual` everything. Raises ProblemError for a name that CasADi does not take.
        """
        free, built = self.free
        for name in (*free, *self.columns):
            if name == "q" or not ca.Function.check_name(name):
                fix = "Rename it: letters, digits and single _, and not q, null, jac or hess"
                raise ProblemError(f"'{name}' cannot name an input of a CasADi function", fix)
        robot = {key: free[key] for key in self.robot.parameters}
        row = {"q": self.q, **self.columns}
        rest = {k: symbol for k, symbol in {**free, **row}.items() if k not in robot and k != "q"}
        touching = {k: symbol for k, symbol in rest.items() if ca.depends_on(built.tip, symbol)}
        others = {k: symbol for k, symbol in free.items() if k not in robot}
        last = {k: touching.pop(k) for k in list(touching) if k in row}
        inputs = {
            "pose": (ca.SX(built.pose), {**robot, "q": self.q}),
            "tip": (built.tip, {**robot, **touching, "q": self.q, **last}),
            "residual": (built.residual, {**robot, **others, **row}),
        }
        return FrozenMapping({k: row_function(k, [*i.values()], [e], [*i]) for k, (e, i) in inputs.items()})

    def c_code(self, *, prefix: str | None = None) -> str:
        """Self-contained C99 with the parameters free: values, pose, tip, residual, Jacobian; see its head comment.

        `prefix` begins the names of the functions; by default the robot's name. Raises ProblemError where it is no C
        name.
        """
        prefix = re.sub(r"\W+", "_", self.robot.name, flags=re.ASCII).strip("_").lower() if prefix is None else prefix
        if not re.fullmatch(r"[A-Za-z]([A-Za-z0-9]|_(?!_))*", prefix):
            what = f"'{prefix}' cannot begin the name of a C function"
            raise ProblemError(what, "Give a prefix of letters, digits and single _")
        generator, wrappers, signatures = ca.CodeGenerator(f"{prefix}_code", {"with_header": False}), "", ""
        for name, inputs, outputs, words in _parts(self):
            made = {key: ca.densify(ca.vec(matrix)) for key, matrix in outputs.items()}
            raw = f"{prefix}_{name}_raw"
            function = row_function(raw, [*inputs.values()], [*made.values()])
            generator.add(function)
            arguments = [f"const double {key}[{max(symbol.numel(), 1)}]" for key, symbol in inputs.items()]
            arguments += [f"double {key}[{matrix.numel()}]" for key, matrix in made.items()]
            signature = f"void {prefix}_{name}({', '.join(arguments)})"
            wrappers += (
                f"\n{signature} {{\n"
                f"  const double* arg[{max(function.sz_arg(), 1)}] = {{{', '.join(inputs)}}};\n"
                f"  double* res[{max(function.sz_res(), 1)}] = {{{', '.join(outputs)}}};\n"
                f"  {raw}(arg, res, 0, 0, 0);\n}}\n"
            )
            signatures += f" * {signature};\n *     {words}\n"
        return _head(self, signatures) + str(generator.dump()) + wrappers

    def __eq__(self, other: object) -> bool:
        """Whether both are about the same arm and instrument, to the last operation of the residual."""
        if self is other or not isinstance(other, Symbols):
            return self is other
        one, two = self.instrument, other.instrument
        if self.robot != other.robot or not alike(self.terms, other.terms):
            return False
        if one == two:
            return True
        # perhaps of a class that was read twice from its file
        declared = type(one).__qualname__ == type(two).__qualname__ and alike(vars(one), vars(two))
        return declared and self.model.text == other.model.text

    def __hash__(self) -> int:
        return hash((self.robot, type(self.instrument).__qualname__))

    def __repr__(self) -> str:
        shapes = {key: _shape(unknown.packed(getattr(self.p, key))) for key, unknown in self.unknowns.items()}
        rows: list[tuple[str, Any, str]] = [
            ("z", len(self.names), short(self.names)),
            ("c", self.c.numel(), ", ".join(f"{key} {size}" for key, size in self.constants.items())),
            ("q", self.q.numel(), " ".join("rad" if joint.turns else "mm" for joint in self.robot.axes)),
            ("columns", len(self.columns), ", ".join(self.columns)),
            ("p", len(shapes), ", ".join(f"{key} {shape}" for key, shape in shapes.items())),
            ("pose", _shape(self.pose), "mm"),
            ("tip", _shape(self.tip), "mm"),
            ("residual", _shape(self.residual), self.instrument.words.unit),
            ("jacobian", f"{self.residual.numel()}x{len(self.names)}", "of the residual by z"),
            ("noise", _shape(self.residual), self.instrument.words.unit),
        ]
        head = f"Symbols of {self.robot.name}, measured by {type(self.instrument).__name__}"
        return "\n".join([head, *(f"  {name:<9}{shape!s:>5}  {what}".rstrip() for name, shape, what in rows)])


def _shape(expression: Any) -> str:
    rows, columns = ca.SX(expression).shape
    return str(rows) if columns == 1 else f"{rows}x{columns}"


def _parts(traced: Symbols) -> list[tuple[str, dict[str, ca.SX], dict[str, ca.SX], str]]:
    """Functions of values p, and of deviations z with constants c: name, inputs, outputs, and what each gives."""
    symbols, built = traced.free
    q, zc = {"q": traced.q}, {"z": traced.z, "c": traced.c}
    row = {"row": ca.vertcat(*traced.columns.values(), ca.SX(0, 1))}
    p = {"p": ca.vertcat(*(ca.vec(symbol) for symbol in symbols.values()))}
    at = ca.vertcat(*(ca.vec(ca.SX(u.packed(getattr(traced.p, key)))) for key, u in traced.unknowns.items()))
    slopes = {"residual": traced.residual, "jacobian": traced.jacobian.T}
    return [
        ("values", zc, {"p": at}, "the values p at deviations z from nominal"),
        ("pose", p | q, {"pose": ca.SX(built.pose).T}, "flange pose, 4 x 4, row by row"),
        ("tip", p | q | row, {"tip": built.tip}, "where the instrument touches or is watched, mm, base frame"),
        ("residual", p | q | row, {"residual": built.residual}, "the residual e of one row"),
        ("jacobian", zc | q | row, slopes, "e and its derivative by z, row by row"),
        ("noise", zc | q | row, {"noise": traced.noise}, "standard deviation of e"),
    ]


def _head(traced: Symbols, signatures: str) -> str:
    symbols, _ = traced.free
    values = _counted({key: symbol.numel() for key, symbol in symbols.items()})
    free = _counted({key: unknown.size for key, unknown in traced.unknowns.items() if unknown.size})
    constants = _counted(traced.constants) or "none"
    about = [
        f"{traced.robot.name}, measured by {type(traced.instrument).__name__}, with its parameters free.",
        "Lengths in mm, angles in rad. C99; needs math.h alone.",
        "",
        f"q    {traced.q.numel()} joint values, as the controller shows them",
        f"row  columns: {', '.join(traced.columns) or 'none'}",
        f"p    values: {values}",
        "     a frame is 4 x 4, column by column; a plane its normal, a point and an offset along the normal",
        f"z    deviations from nominal: {free}",
        f"c    constants: {constants}",
        "",
    ]
    lines = (line.replace("*/", "* /").replace("\n", " ") for line in about)  # which cannot end the comment
    return "/*\n" + "".join(f" * {line}".rstrip() + "\n" for line in lines) + signatures + " */\n"


def _counted(sizes: Mapping[str, int]) -> str:
    return ", ".join(f"{key} {size}" for key, size in sizes.items())


def _with_terms(here: Here, terms: Sequence[Term]) -> tuple[Expression, Names]:
    """Flange pose and row as they truly are, where joints, flange and readings err."""
    off = [traced(term.joints, "joints", term.words, None, here, optional=True) for term in terms]
    for term, each in zip(terms, off, strict=True):
        if each.numel() not in (0, len(here.robot.axes)):
            what = f"joints of '{term.words}' has {each.numel()} numbers, and the arm {len(here.robot.axes)} joints"
            raise ProblemError(what, "Give one for each joint")
    moved = [each for each in off if each.numel()]
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


PER_RAD = 100.0  # mm of a sliding joint that count as a radian: ten micrometres where a turning one errs by 0.1 mrad


def per_radian(robot: Robot) -> list[float]:
    """Unit of motion of each joint: one radian, or `PER_RAD` mm of a sliding one."""
    return [1.0 if turns else PER_RAD for turns in robot.revolute]


class RowModel:
    """The compiled functions of one robot with one instrument, of (z, c, d) but where another argument is named.

    They know no priors: problems that differ in these alone have one model between them. Raises ProblemError where the
    trace depends on anything but joints, columns and unknowns. What only some uses need is made when asked for.
    """

    def __init__(self, traced: Symbols) -> None:
        self._trace = traced
        self.constants: tuple[str, ...] = tuple(traced.constants)  # keys of unknowns whose nominal is in c, in order
        self.terms: tuple[Term, ...] = traced.acting  # terms that have unknowns for this robot and instrument
        declared = {**traced.robot.parameters, **traced.instrument.unknowns}
        self.linear = traced.z.numel() - sum(unknown.size for unknown in declared.values())  # of terms, the last in z
        self.names: tuple[str, ...] = tuple(traced.columns)  # columns of d beside the joint values, in order
        self.residual = self._made("residual", traced.residual)  # e (m)
        self.jacobian = self._made("jacobian", traced.residual, traced.jacobian.T)  # e (m), de/dz row by row (m * nz)
        self.noise = self._made("noise", traced.noise)  # standard deviation w (m) of e
        self.tip = self._made("tip", traced.tip)  # tip (3), mm
        self.pose = self._made("pose", traced.pose)  # flange pose (16), column by column
        self.arm = traced.robot.traced  # the pose of the arm as a graph, the same for all priors
        plunger = traced.seen.plunger
        self.plunger = None if plunger is None else self._made("plunger", plunger)  # its direction (3), base frame
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
