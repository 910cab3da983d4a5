"""The public face of the symbols: what a robot and an instrument are to CasADi, as expressions with names and shapes.

symbols = problem.symbols
symbols.residual, symbols.z, symbols.c, symbols.q, symbols.columns["reading"]    expressions (SX)
symbols.functions["residual"](z, c, d)                                           compiled, for SX, MX and numbers
symbols.value_functions["pose"](alpha=..., a=..., d=..., theta=..., q=q)         the values p themselves as inputs
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca

from casacal.errors import ProblemError
from casacal.model.term import Term
from casacal.model.trace import RowModel, Trace, row_function
from casacal.values import FrozenMapping, alike, short


class Symbols(Trace):
    """One robot with one instrument as CasADi expressions: lengths in mm, angles in rad; what `Problem.symbols` gives.

    Expressions are SX and belong together: those of another `Symbols` do not mix with them. Raises ProblemError when
    `pose`, `tip` or `residual` fails, has the wrong shape or depends on something else.
    """

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


@dataclass(frozen=True)
class Compiled:
    """Compiled forms of one robot and its instruments, shared by problems that differ in terms and priors alone."""

    _found: list[tuple[tuple[Term, ...], tuple[RowModel, ...]]] = field(default_factory=list)

    def models(self, terms: tuple[Term, ...], symbols: Sequence[Symbols]) -> tuple[RowModel, ...]:
        """One for each instrument, with these very terms; what was not compiled yet is, of its symbols."""
        for known, models in self._found:
            if len(known) == len(terms) and all(one is other for one, other in zip(known, terms, strict=True)):
                return models
        self._found.append((terms, tuple(each.model for each in symbols)))
        return self._found[-1][1]


def _shape(expression: Any) -> str:
    rows, columns = ca.SX(expression).shape
    return str(rows) if columns == 1 else f"{rows}x{columns}"


def _parts(traced: Trace) -> list[tuple[str, dict[str, ca.SX], dict[str, ca.SX], str]]:
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


def _head(traced: Trace, signatures: str) -> str:
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
