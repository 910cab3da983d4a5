"""Which of C, CasADi's blocks and NumPy evaluates rows and takes an estimator's step, and when."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
from collections.abc import Sequence
from typing import Any, Protocol

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.kernels.block_rows import BlockKernels
from casacal.kernels.compiler import CompilerError
from casacal.kernels.filter_passes import BlockCubature, NativeCubature
from casacal.kernels.lanes import lane_data
from casacal.kernels.native_rows import NativeKernels, NativePiece, PackedPieces
from casacal.kernels.program import Program, Role
from casacal.kernels.reading import read_program

BACKENDS = ("auto", "c", "blocks")
VARIABLE = "CASACAL_BACKEND"

MOST_PROGRAMS = 32
"""Programs that a process keeps, the last used ones."""


class Kernels(Protocol):
    """What estimators need of a row model; lanes are rows in the form a back end reads."""

    name: str
    components: int

    def lanes(self, d: Array, w: Array) -> Any:
        """Data (columns, n) and weights (m, n) as the kernels read them."""

    def reweighted(self, lanes: Any, w: Array) -> Any:
        """The same rows with other weights (m, n)."""

    def residual(self, p: Array, lanes: Any) -> Array:
        """Plain residuals (m, n)."""

    def slopes(self, p: Array, lanes: Any) -> tuple[Array, Array]:
        """Plain residuals (m, n) and slopes (m, z, n)."""

    def costs(self, states: Array, lanes: Any) -> Array:
        """Half the weighted sum of squares at each of many p (states, parameters): (states,)."""

    def normal(self, p: Array, lanes: Any) -> Array:
        """Weighted normal matrix of slopes and, last, residual (z + 1, z + 1)."""


class RowKernels:
    """Kernels of a residual with its slopes, and the data they read lane by lane.

    Args:
        slopes: SX function to e (m) and its derivative row by row (m * z).
        roles: "lane" for arguments that differ from row to row, "once" for the others, which form p.
        backend: a name of `BACKENDS`, or None for the environment's, or auto.

    Raises ProblemError for a back end that does not exist, or that was asked for and cannot serve, and for a graph with
    operations that are not elementary.

    """

    def __init__(self, slopes: ca.Function, roles: Sequence[Role], backend: str | None = None) -> None:
        asked = backend if backend is not None else os.environ.get(VARIABLE, "auto")
        if asked not in BACKENDS:
            raise ProblemError(f"There is no back end '{asked}'", f"Known: {', '.join(BACKENDS)}")
        self._program, self._roles = _read(slopes.serialize(), tuple(roles)), roles
        once = [slopes.numel_in(i) for i, role in enumerate(roles) if role == "once"]
        self.kernels: Kernels = _chosen(asked, self._program, sum(once))

    def lanes(self, arguments: Sequence[Array], noise: Array) -> Any:
        """Rows in the form the kernels read: arguments of role "lane", each (n, size), and noise (n, m)."""
        waiting = iter(arguments)
        given = [next(waiting).T if role == "lane" else np.zeros(0) for role in self._roles]
        return self.kernels.lanes(lane_data(self._program, given, len(noise)), 1.0 / noise.T)


def _chosen(asked: str, slopes: Program, parameters: int) -> Kernels:
    if asked != "blocks":
        try:
            return NativeKernels(slopes, parameters)
        except CompilerError as error:
            if asked == "c":
                raise ProblemError(f"The back end c cannot be used: {error}", "Use blocks, or auto") from error
            _notice(str(error))
    return BlockKernels(slopes, parameters)


@functools.lru_cache(maxsize=MOST_PROGRAMS)
def _read(slopes: str, roles: tuple[Role, ...]) -> Program:
    """The program of a graph, which is much longer in the reading than in the comparing."""
    return read_program(ca.Function.deserialize(slopes), roles)


@functools.cache
def _notice(reason: str) -> None:
    """One line, once per process: kernels are slower, not different."""
    logging.getLogger("casacal").warning("casacal: no C kernels (%s); using blocks, which are slower", reason)


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
