"""The functions of one row as plain C99 in which the parameters are inputs, for controllers and estimators in C."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

import casadi as ca

from casacal.errors import ProblemError
from casacal.problem.compile import residual_noise, row_function
from casacal.problem.trace import Trace


class Part(NamedTuple):
    """A function of the file: name, inputs and outputs by name, and what it gives."""

    name: str
    inputs: dict[str, ca.SX]
    outputs: dict[str, ca.SX]
    words: str


def c_text(traced: Trace, *, prefix: str | None = None) -> str:
    """Self-contained C99 of the functions of one row, the parameters' values or deviations among their inputs.

    Raises ProblemError for a prefix that is no C name.
    """
    prefix = re.sub(r"\W+", "_", traced.robot.name, flags=re.ASCII).strip("_").lower() if prefix is None else prefix
    if not re.fullmatch(r"[A-Za-z]([A-Za-z0-9]|_(?!_))*", prefix):
        raise ProblemError(
            f"'{prefix}' cannot begin the name of a C function", "Give a prefix of letters, digits and single _"
        )
    generator, wrappers, told = ca.CodeGenerator(f"{prefix}_code", {"with_header": False}), "", ""
    for part in _parts(traced):
        made = {name: ca.densify(ca.vec(matrix)) for name, matrix in part.outputs.items()}
        raw = f"{prefix}_{part.name}_raw"
        function = row_function(raw, [*part.inputs.values()], [*made.values()])
        generator.add(function)
        given = [f"const double {key}[{max(symbol.numel(), 1)}]" for key, symbol in part.inputs.items()]
        given += [f"double {key}[{matrix.numel()}]" for key, matrix in made.items()]
        signature = f"void {prefix}_{part.name}({', '.join(given)})"
        wrappers += (
            f"\n{signature} {{\n"
            f"  const double* arg[{max(function.sz_arg(), 1)}] = {{{', '.join(part.inputs)}}};\n"
            f"  double* res[{max(function.sz_res(), 1)}] = {{{', '.join(part.outputs)}}};\n"
            f"  {raw}(arg, res, 0, 0, 0);\n}}\n"
        )
        told += f" * {signature};\n *     {part.words}\n"
    return _head(traced, told) + str(generator.dump()) + wrappers


def _parts(traced: Trace) -> list[Part]:
    """Functions of values p; and of deviations z with constants c, as estimators use them."""
    symbols, built = traced.free
    q, zc, row = (
        {"q": traced.q},
        {"z": traced.z, "c": traced.c},
        {"row": ca.vertcat(*traced.columns.values(), ca.SX(0, 1))},
    )
    p = {"p": ca.vertcat(*(ca.vec(symbol) for symbol in symbols.values()))}
    at = ca.vertcat(*(ca.vec(ca.SX(u.packed(getattr(traced.p, key)))) for key, u in traced.unknowns.items()))
    slopes = {"residual": traced.residual, "jacobian": traced.jacobian.T}
    return [
        Part("values", zc, {"p": at}, "the values p at deviations z from nominal"),
        Part("pose", p | q, {"pose": ca.SX(built.pose).T}, "flange pose, 4 x 4, row by row"),
        Part("tip", p | q | row, {"tip": built.tip}, "where the instrument touches or is watched, mm, base frame"),
        Part("residual", p | q | row, {"residual": built.residual}, "the residual e of one row"),
        Part("jacobian", zc | q | row, slopes, "e and its derivative by z, row by row"),
        Part("noise", zc | q | row, {"noise": residual_noise(traced)}, "standard deviation of e"),
    ]


def _head(traced: Trace, told: str) -> str:
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
    return "/*\n" + "".join(f" * {line}".rstrip() + "\n" for line in lines) + told + " */\n"


def _counted(sizes: Mapping[str, int]) -> str:
    return ", ".join(f"{key} {size}" for key, size in sizes.items())
