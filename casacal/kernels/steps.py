"""Which of C, MX and NumPy takes an estimator's step, and when.

| step                               | C                      | MX              | NumPy              |
|------------------------------------|------------------------|-----------------|--------------------|
| cubature filter's, eqs (15)-(24)   | c/cubature_filter.c    | block_filter.py | estimators/sckf.py |
| extended filter's                  | c/extended_filter.c    |                 | estimators/ekf.py  |
| damped, eqs (25)-(29) as corrected | c/normal_equations.c   |                 | least_squares/     |

C takes a step where C evaluates the rows: a cubature filter's for each instrument by itself, the others only where it
evaluates the rows of all, for they go over all in one call. Elsewhere MX takes the cubature filter's step, which
evaluates a row at many states, and NumPy the others. NumPy also takes the cubature filter's step where parameters
drift, where a row leaves less of a variance than an exact downdate can keep (`linalg.LEAST_LEFT`), and every step of a
problem that is not bound to a robot's rows. Equations are those of arXiv:2208.02652; tests hold all forms equal.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import casadi as ca

from casacal.kernels.block_filter import BlockCubature
from casacal.kernels.compiler import CompilerError
from casacal.kernels.native_filter import NativeCubature
from casacal.kernels.native_normal import NativePiece, PackedPieces


def cubature_pass(residual: ca.Function, backend: str) -> NativeCubature | BlockCubature:
    """The cubature filter's pass for a residual of (z, c, d) whose rows a back end evaluates: C's, else MX's."""
    if backend == "c":
        with contextlib.suppress(CompilerError):
            return NativeCubature(residual)
    return BlockCubature(residual)


def all_rows_in_c(instruments: Sequence[Sequence[NativePiece] | None]) -> PackedPieces | None:
    """Rows as C's extended and damped steps take them; None where NumPy takes these steps.

    `instruments`: the pieces of each one's rows, None where C does not evaluate them.
    """
    pieces = [piece for some in instruments if some is not None for piece in some]
    return None if None in instruments or not pieces else PackedPieces(pieces)
