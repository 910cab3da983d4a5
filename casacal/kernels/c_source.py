"""A program printed as C: straight lines over lanes, which any compiler vectorises; reductions inside the kernel."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import casadi as ca

from casacal.kernels.c_filter import EXTENDED, FILTER
from casacal.kernels.c_normal import NORMAL_EQUATIONS
from casacal.kernels.c_templates import ERRORS, HEAD, KERNELS, PREPARE
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
    """C source of `residual`, `slopes`, `costs` and `normal`, and of the sums, steps and filter that call them.

    Args:
        slopes: outputs e (m), and its derivative row by row (m * z).
        parameters: numbers in p: the arguments of role "once", one after the other.

    """
    components, unknowns = len(slopes.outputs[0]), len(slopes.outputs[1]) // len(slopes.outputs[0])
    rows, e, s = rows_of_normal(unknowns), _Printer(slopes.only(0)), _Printer(slopes)
    out = [f"const double w{m} = w[{m} * distance + i];" for m in range(components)]
    for m in range(components):
        values = [*slopes.outputs[1][m * unknowns : (m + 1) * unknowns], slopes.outputs[0][m]]
        out += [f"a[{m * rows + r} * PART + i] = w{m} * {s.name(value)};" for r, value in enumerate(values)]
    kernels = KERNELS.substitute(
        prepared=s.prepared(),
        lane=s.lane(),
        out=_lines(out),
        parameters=parameters,
        components=components,
        unknowns=unknowns,
        rows=rows,
        errors_values=max(len(e.once), 1),
        slopes_values=max(len(s.once), 1),
    )
    own = (e.prepare("errors"), s.prepare("slopes"), e.errors(), kernels)
    return "".join((HEAD, *own, NORMAL_EQUATIONS, EXTENDED))


def filter_source(residual: Program, unknowns: int, once: int) -> str:
    """C source of `cubature_pass` for a residual whose lanes are the elements of its first argument, read as they are.

    Args:
        residual: outputs e (m); its lanes are the z that many states give.
        unknowns: z.
        once: numbers in p.

    """
    printer = _Printer(residual)
    printer.place = {value: residual.operations[value].element[1] for value in residual.lanes}
    run = FILTER.substitute(z=unknowns, m=len(residual.outputs[0]), once=once, values=max(len(printer.once), 1))
    return HEAD + printer.prepare("errors") + printer.errors() + run


class _Printer:
    """Prints the operations of one program: those on parameters alone in a loop over states, the others over lanes."""

    def __init__(self, program: Program) -> None:
        self.program, self.needed = program, program.needed(program.results)
        self.place = {value: k for k, value in enumerate(program.lanes)}
        self.once = program.once
        """Values of parameters alone that lanes read."""

    def name(self, value: int) -> str:
        operation = self.program.operations[value]
        if operation.op == ca.OP_CONST:
            return _constant(operation.constant)
        return f"{'d' if self.program.kinds[value] == 'lane' else 'v'}{value}"

    def prepare(self, name: str) -> str:
        out = _lines(f"o[{k} * states + s] = {self.name(v)};" for k, v in enumerate(self.once))
        wanted = [v for v in self.program.needed(self.once) if self.program.kinds[v] == "once"]
        return PREPARE.substitute(name=name, once=self._printed(wanted), out=out)

    def errors(self) -> str:
        outputs = self.program.outputs[0]
        out = _lines(f"e[{m} * distance + i] = {self.name(value)};" for m, value in enumerate(outputs))
        return ERRORS.substitute(prepared=self.prepared(), lane=self.lane(), out=out)

    def prepared(self) -> str:
        return _lines(f"const double v{v} = o[{k} * stride];" for k, v in enumerate(self.once))

    def lane(self) -> str:
        used = set(self.needed)
        loads = [f"const double d{v} = d[{k} * ld + i];" for v, k in self.place.items() if v in used]
        return _lines(loads) + "\n" + self._printed([v for v in self.needed if self.program.kinds[v] == "mixed"])

    def _printed(self, values: Sequence[int]) -> str:
        return _lines(f"const double v{v} = {self._expression(v)};" for v in values)

    def _expression(self, value: int) -> str:
        operation = self.program.operations[value]
        if operation.op == ca.OP_INPUT:
            return f"p[{self.program.position(value)} * states + s]"
        called = "lane_" if operation.op in TRIGONOMETRIC else ""
        return called + C[operation.op].format(*(self.name(arg) for arg in operation.args))


def _constant(value: float) -> str:
    """A number as C writes it, exactly."""
    if math.isfinite(value):
        return f"({value!r})"
    return "NAN" if math.isnan(value) else "(INFINITY)" if value > 0 else "(-INFINITY)"


def _lines(lines: Iterable[str]) -> str:
    return "\n".join(f"        {line}" for line in lines)
