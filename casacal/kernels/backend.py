"""Which of C and CasADi's blocks evaluates rows."""

from __future__ import annotations

import functools
import logging
import os

import casadi as ca

from casacal.errors import ProblemError
from casacal.kernels.block_rows import BlockKernels, CalledKernels
from casacal.kernels.libraries import CompilerError
from casacal.kernels.native_rows import NativeKernels
from casacal.kernels.program import Program, Role, calls, read_program
from casacal.kernels.rows import Kernels

BACKENDS = ("auto", "c", "blocks")
VARIABLE = "CASACAL_BACKEND"

MOST_PROGRAMS = 32  # programs that a process keeps, the last used ones


def row_kernels(slopes: ca.Function, backend: str | None = None) -> Kernels:
    """Kernels of a residual with its slopes, which read the function's last argument row by row.

    Args:
        slopes: SX function to e (m) and its derivative row by row (m * z); all arguments but the last form p.
        backend: a name of `BACKENDS`, or None for the environment's, or auto.

    A graph that calls other functions is evaluated by CasADi, with the derivatives that it has of them.

    Raises ProblemError for a back end that does not exist, or that was asked for and cannot serve, and for a graph with
    operations that are not elementary.

    """
    requested = backend if backend is not None else os.environ.get(VARIABLE, "auto")
    if requested not in BACKENDS:
        raise ProblemError(f"There is no back end '{requested}'", f"Known: {', '.join(BACKENDS)}")
    if calls(slopes):
        reason = "the model calls a rootfinder, a table or a Callback, which CasADi evaluates and differentiates itself"
        if requested == "c":
            raise ProblemError(f"The back end c cannot be used: {reason}", "Use blocks, or auto")
        _notice(reason)
        return CalledKernels(slopes)
    program = _read(slopes.serialize())
    parameters = sum(slopes.numel_in(i) for i in range(slopes.n_in() - 1))
    if requested != "blocks":
        try:
            return NativeKernels(program, parameters)
        except CompilerError as error:
            if requested == "c":
                raise ProblemError(f"The back end c cannot be used: {error}", "Use blocks, or auto") from error
            _notice(str(error))
    return BlockKernels(program, parameters)


@functools.lru_cache(maxsize=MOST_PROGRAMS)
def _read(slopes: str) -> Program:
    """The program of a graph, which is much longer in the reading than in the comparing."""
    function = ca.Function.deserialize(slopes)
    roles: list[Role] = ["once"] * (function.n_in() - 1)
    return read_program(function, [*roles, "lane"])


@functools.cache
def _notice(reason: str) -> None:
    """One line, once per process: kernels are slower, not different."""
    logging.getLogger("casacal").warning("casacal: no C kernels (%s); using blocks, which are slower", reason)
