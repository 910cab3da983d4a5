"""A program printed as C: straight lines over lanes, which any compiler vectorises; reductions inside the kernel."""

from __future__ import annotations

import math
from collections.abc import Iterable
from string import Template

import casadi as ca

from casacal.kernels.c_templates import FILTER, HEAD, KERNELS, ONLY_RESIDUAL, PART_OF_NORMAL
from casacal.kernels.operations import C
from casacal.kernels.program import TRIGONOMETRIC, Program


def can_print(program: Program) -> bool:
    """Whether every operation has a form in C."""
    needed = (program.operations[value].op for value in program.needed(program.results))
    return all(op in (ca.OP_CONST, ca.OP_INPUT) or op in C for op in needed)


def rows_of_normal(unknowns: int) -> int:
    """Rows of the padded normal matrix: the unknowns, the residual, and zeros to a multiple of four."""
    return -(-(unknowns + 1) // 4) * 4


def kernel_source(slopes: Program, parameters: int) -> str:
    """C source of `residual`, `slopes`, `costs` and `normal`.

    Args:
        slopes: outputs e (m), and its derivative row by row (m * z).
        parameters: numbers in p: the arguments of role "once", one after the other.

    """
    residual = slopes.only(0)
    components, unknowns = len(residual.outputs[0]), len(slopes.outputs[1]) // len(slopes.outputs[0])
    rows = rows_of_normal(unknowns)
    e, s = _Printer(residual), _Printer(slopes)
    parts = []
    for m in range(components):
        row = slopes.outputs[1][m * unknowns : (m + 1) * unknowns]
        values = [*row, slopes.outputs[0][m]]
        out = [f"a[{r} * PART + k] = weight * {s.name(value)};" for r, value in enumerate(values)]
        out += [f"a[{r} * PART + k] = 0.0;" for r in range(len(values), rows)]
        lane = s.lane(values)
        parts.append(PART_OF_NORMAL.substitute(lane=lane, component=m, out=_lines(out), rows=rows))
    outputs = residual.outputs[0]
    return HEAD + Template(ONLY_RESIDUAL.template + KERNELS.template).substitute(
        residual_once=e.once(e.program.results),
        residual_lane=e.lane(e.program.results),
        residual_out=_lines(f"e[{m} * ld + i] = {e.name(value)};" for m, value in enumerate(outputs)),
        cost_sum=_lines(f"{{ const double r = w[{m} * ld + i] * {e.name(v)}; total += r * r; }}"
                        for m, v in enumerate(outputs)),
        slopes_once=s.once(s.program.results),
        slopes_lane=s.lane(s.program.results),
        slopes_out=_lines([*(f"e[{m} * ld + i] = {s.name(value)};" for m, value in enumerate(slopes.outputs[0])),
                           *(f"j[{k} * ld + i] = {s.name(value)};" for k, value in enumerate(slopes.outputs[1]))]),
        parameters=parameters,
        rows=rows,
        normal_parts="".join(parts),
    )  # fmt: skip


def filter_source(residual: Program, unknowns: int, once: int) -> str:
    """C source of `cubature_pass` for a residual whose lanes are the elements of its first argument, read as they are.

    Args:
        residual: outputs e (m); its lanes are the z that many states give.
        unknowns: z.
        once: numbers in p.

    """
    printer = _Printer(residual)
    printer.place = {value: residual.operations[value].element[1] for value in residual.lanes}
    outputs = residual.outputs[0]
    body = ONLY_RESIDUAL.substitute(
        residual_once=printer.once(residual.results),
        residual_lane=printer.lane(residual.results),
        residual_out=_lines(f"e[{m} * ld + i] = {printer.name(value)};" for m, value in enumerate(outputs)),
    )
    return HEAD + body + FILTER.substitute(z=unknowns, m=len(outputs), once=once)


class _Printer:
    """Prints the operations of one program."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.place = {value: k for k, value in enumerate(program.lanes)}

    def name(self, value: int) -> str:
        operation = self.program.operations[value]
        if operation.op == ca.OP_CONST:
            return _constant(operation.constant)
        return f"{'d' if self.program.kinds[value] == 'lane' else 'v'}{value}"

    def once(self, roots: list[int]) -> str:
        return self._printed(roots, "once")

    def lane(self, roots: list[int]) -> str:
        needed = set(self.program.needed(roots))
        loads = [f"const double d{v} = d[{k} * ld + i];" for v, k in self.place.items() if v in needed]
        return _lines(loads) + "\n" + self._printed(roots, "mixed")

    def _printed(self, roots: list[int], kind: str) -> str:
        chosen = [v for v in self.program.needed(roots) if self.program.kinds[v] == kind]
        return _lines(f"const double v{v} = {self._expression(v)};" for v in chosen)

    def _expression(self, value: int) -> str:
        operation = self.program.operations[value]
        if operation.op == ca.OP_INPUT:
            return f"p[{self.program.position(value)}]"
        if operation.op in TRIGONOMETRIC and self.program.kinds[value] == "mixed":
            return f"lane_{C[operation.op].format(self.name(operation.args[0]))}"
        return C[operation.op].format(*(self.name(arg) for arg in operation.args))


def _constant(value: float) -> str:
    """A number as C writes it, exactly."""
    if math.isfinite(value):
        return f"({value!r})"
    return "NAN" if math.isnan(value) else "(INFINITY)" if value > 0 else "(-INFINITY)"


def _lines(lines: Iterable[str]) -> str:
    return "\n".join(f"        {line}" for line in lines)
