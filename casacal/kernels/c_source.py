"""A program printed as C: straight lines over lanes, which any compiler vectorises; reductions inside the kernel."""

from __future__ import annotations

from string import Template

import casadi as ca

from casacal.kernels.operations import C
from casacal.kernels.program import Program

HEAD = """
#include <math.h>
#if defined(__AVX512F__)
#define WIDE 8
#else
#define WIDE 4
#endif
#define PART 128
typedef double wide __attribute__((vector_size(8 * WIDE)));

/* Upper triangle of A A' for rows of PART numbers, added to S (rows x rows): two by four rows at a time. */
static void gram(long rows, const double *restrict a, double *restrict s)
{
    for (long i = 0; i < rows; i += 2)
        for (long j = i & ~3L; j < rows; j += 4) {
            wide sum[2][4] = {{{0}}};
            for (long k = 0; k < PART; k += WIDE) {
                wide x[2], y[4];
                for (int m = 0; m < 2; m++) x[m] = *(const wide *)(a + (i + m) * PART + k);
                for (int m = 0; m < 4; m++) y[m] = *(const wide *)(a + (j + m) * PART + k);
                for (int m = 0; m < 2; m++)
                    for (int n = 0; n < 4; n++) sum[m][n] += x[m] * y[n];
            }
            for (int m = 0; m < 2; m++)
                for (int n = 0; n < 4; n++) {
                    double total = 0.0;
                    for (int k = 0; k < WIDE; k++) total += sum[m][n][k];
                    s[(i + m) * rows + j + n] += total;
                }
        }
}
"""

KERNELS = Template("""
/* Residuals e[m][lane]. */
void residual(long n, long ld, const double *restrict p, const double *restrict d, double *restrict e)
{
$residual_once
#pragma omp simd
    for (long i = 0; i < n; i++) {
$residual_lane
$residual_out
    }
}

/* Residuals e[m][lane] and slopes j[m * z][lane]. */
void slopes(long n, long ld, const double *restrict p, const double *restrict d, double *restrict e,
            double *restrict j)
{
$slopes_once
#pragma omp simd
    for (long i = 0; i < n; i++) {
$slopes_lane
$slopes_out
    }
}

/* Half the sum of squares of w e at each of `states` parameter vectors, added to cost[state]. */
void costs(long n, long ld, long states, const double *restrict p, const double *restrict d, const double *restrict w,
           double *restrict cost)
{
    for (long s = 0; s < states; s++, p += $parameters) {
$residual_once
        double total = 0.0;
#pragma omp simd reduction(+ : total)
        for (long i = 0; i < n; i++) {
$residual_lane
$cost_sum
        }
        cost[s] += 0.5 * total;
    }
}

/* Weighted normal matrix of slopes and, last, residual, added to s[$rows][$rows]. */
void normal(long n, long ld, const double *restrict p, const double *restrict d, const double *restrict w,
            double *restrict s)
{
    double a[$rows * PART] __attribute__((aligned(64)));
$slopes_once
    for (long first = 0; first < n; first += PART) {
        const long lanes = n - first < PART ? n - first : PART;
$normal_parts
    }
    for (long i = 1; i < $rows; i++)
        for (long k = 0; k < i; k++) s[i * $rows + k] = s[k * $rows + i];
}
""")

PART_OF_NORMAL = Template("""
#pragma omp simd
        for (long k = 0; k < lanes; k++) {
            const long i = first + k;
$lane
            const double weight = w[$component * ld + i];
$out
        }
        for (long r = 0; r < $rows; r++)
            for (long k = lanes; k < PART; k++) a[r * PART + k] = 0.0;
        gram($rows, a, s);
""")


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
    return HEAD + KERNELS.substitute(
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


class _Printer:
    """Prints the operations of one program."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.place = {value: k for k, value in enumerate(program.lanes)}

    def name(self, value: int) -> str:
        operation = self.program.operations[value]
        if operation.op == ca.OP_CONST:
            return f"({operation.constant!r})"
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
        return C[operation.op].format(*(self.name(arg) for arg in operation.args))


def _lines(lines: object) -> str:
    return "\n".join(f"        {line}" for line in lines)  # type: ignore[attr-defined]
