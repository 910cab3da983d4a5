"""A program printed as C: straight lines over lanes, which any compiler vectorises, in the loops of the folder c.

What is the same for every program stands in that folder, as C that compilers and editors read as it is: c/program.h
defines an example of what differs. Here the sizes are defined anew, and statements written out where they are named,
for a compiler takes half as long again over macros of hundreds of lines.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Iterable, Sequence
from importlib import resources
from typing import TypeAlias

import casadi as ca

from casacal.kernels.algebra import TRIGONOMETRIC, Kind
from casacal.kernels.compiler import CompilerError
from casacal.kernels.program import C, Program, name_of

KERNELS = ("rows.c", "normal_equations.c", "extended_filter.c")
FILTER = ("cubature_filter.c",)
Definitions: TypeAlias = dict[str, int | Sequence[str]]
"""Numbers and statements by the names that C has for them."""
PROGRAM = "program.h"  # the example, which a source has no need of


def rows_of_normal(unknowns: int) -> int:
    """Rows of the padded normal matrix: the unknowns, the residual, and zeros to a multiple of four."""
    return -(-(unknowns + 1) // 4) * 4


def kernel_source(slopes: Program, parameters: int) -> str:
    """C source of `residual`, `slopes`, `costs` and `normal`, and of the sums, steps and filter that call them.

    slopes: outputs e (m), and its derivative row by row (m * z). parameters: numbers in p. Raises CompilerError for an
    operation that has no form in C.
    """
    components, unknowns = len(slopes.outputs[0]), len(slopes.outputs[1]) // len(slopes.outputs[0])
    rows, printed = rows_of_normal(unknowns), _Printer(slopes)
    out = [f"const double w{m} = w[{m} * distance + i];" for m in range(components)]
    for m in range(components):
        values = [*slopes.outputs[1][m * unknowns : (m + 1) * unknowns], slopes.outputs[0][m]]
        out += [f"a[{m * rows + r} * PART + i] = w{m} * {printed.name(value)};" for r, value in enumerate(values)]
    sizes: Definitions = {"PARAMETERS": parameters, "COMPONENTS": components, "UNKNOWNS": unknowns, "ROWS": rows}
    return composed(KERNELS, sizes | _errors(_Printer(slopes.only(0))) | printed.definitions("SLOPES", out))


def filter_source(residual: Program, unknowns: int, once: int) -> str:
    """C source of `cubature_pass` for a residual whose lanes are the elements of its first argument, read as they are.

    residual: outputs e (m); its lanes are the z that many states give. unknowns: z. once: numbers in p. Raises
    CompilerError as `kernel_source` does.
    """
    printed = _Printer(residual)
    printed.place = {value: residual.operations[value].element[1] for value in residual.lanes}
    sizes: Definitions = {"PARAMETERS": once, "COMPONENTS": len(residual.outputs[0]), "UNKNOWNS": unknowns}
    return composed(FILTER, sizes | _errors(printed))


def composed(names: Iterable[str], definitions: Definitions) -> str:
    """Files of the folder c as one source, each header where it is first included, with what c/program.h is to define.

    Numbers are defined; statements are written out where a line of C is their name.
    """
    done: set[str] = set()
    sizes = "".join(f"#define {name} {size}\n" for name, size in definitions.items() if isinstance(size, int))

    def written(line: re.Match[str]) -> str:
        statements = definitions.get(line[2])
        return "".join(f"{line[1]}{each}\n" for each in statements) if isinstance(statements, Sequence) else line[0]

    def text(name: str) -> str:
        if name in done:
            return ""
        done.add(name)
        if name == PROGRAM:
            return sizes
        return INCLUDE.sub(lambda found: text(found[1]), NAME.sub(written, c_file(name)))

    return "".join(text(name) for name in names)


INCLUDE = re.compile(r'^#include "(.+)"\n', re.MULTILINE)
NAME = re.compile(r"^( *)([A-Z_]+)\n", re.MULTILINE)


@functools.cache
def c_file(name: str) -> str:
    """A file of the folder c."""
    return (resources.files("casacal.kernels") / "c" / name).read_text(encoding="utf-8")


def _errors(printed: _Printer) -> Definitions:
    outputs = printed.program.outputs[0]
    out = [f"e[{m} * distance + i] = {printed.name(value)};" for m, value in enumerate(outputs)]
    return printed.definitions("ERRORS", out)


class _Printer:
    """Prints the operations of one program: those on parameters alone in a loop over states, the others over lanes."""

    def __init__(self, program: Program) -> None:
        self.program, self.needed = program, program.needed(program.results)
        self.place = {value: k for k, value in enumerate(program.lanes)}

    def name(self, value: int) -> str:
        operation = self.program.operations[value]
        if operation.op == ca.OP_CONST:
            return _constant(operation.constant)
        return f"{'d' if self.program.kinds[value] == 'lane' else 'v'}{value}"

    def definitions(self, what: str, out: Sequence[str]) -> Definitions:
        """What c/program.h defines for ERRORS or SLOPES: preparing, reading, and a lane that ends with `out`."""
        once, used = self.program.once, set(self.needed)
        prepared = [f"o[{k} * states + s] = {self.name(v)};" for k, v in enumerate(once)]
        read = [f"const double v{v} = o[{k} * stride];" for k, v in enumerate(once)]
        lane = [f"const double d{v} = d[{k} * ld + i];" for v, k in self.place.items() if v in used]
        return {
            f"{what}_PREPARED": max(len(once), 1),
            f"PREPARE_{what}": [*self._printed(self.program.needed(once), "once"), *prepared],
            f"READ_{what}": read,
            f"LANE_OF_{what}": [*lane, *self._printed(self.needed, "mixed"), *out],
        }

    def _printed(self, values: Sequence[int], kind: Kind) -> list[str]:
        wanted = (v for v in values if self.program.kinds[v] == kind)
        return [f"const double v{v} = {self._expression(v)};" for v in wanted]

    def _expression(self, value: int) -> str:
        operation = self.program.operations[value]
        if operation.op == ca.OP_INPUT:
            return f"p[{self.program.position(value)} * states + s]"
        if operation.op not in C:
            raise CompilerError(f"the operation '{name_of(operation.op)}' has no form in C")
        called = "lane_" if operation.op in TRIGONOMETRIC else ""
        return called + C[operation.op].format(*(self.name(arg) for arg in operation.args))


def _constant(value: float) -> str:
    """A number as C writes it, exactly."""
    if math.isfinite(value):
        return f"({value!r})"
    return "NAN" if math.isnan(value) else "(INFINITY)" if value > 0 else "(-INFINITY)"
