"""Kernels as compiled C, normal equations accumulated where the Jacobian is made; or else those on CasADi's machine.

A program is printed as straight lines over lanes, which any compiler vectorises. What is the same for every program
stands in the folder c, as C that compilers and editors read as it is: c/program.h defines an example of what differs.
Here sizes are defined anew, and statements written out where they are named: macros take compilers half as long again.
"""

from __future__ import annotations

import ctypes
import functools
import logging
import math
import os
import re
import threading
from collections.abc import Callable, Iterable, Sequence
from importlib import resources
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from casacal.errors import ProblemError
from casacal.kernels.block_rows import BlockKernels, CalledKernels
from casacal.kernels.libraries import CompilerError, load_library
from casacal.kernels.program import TRIGONOMETRIC, C, Kind, Program, Role, calls, name_of, read_program
from casacal.kernels.rows import Kernels, Lanes, Piece
from casacal.threads import shared_out
from casacal.values import Array, Index

KERNELS = ("rows.c", "normal_equations.c", "extended_filter.c")
FILTER = ("cubature_filter.c",)
Definitions: TypeAlias = dict[str, int | Sequence[str]]  # numbers and statements by the names that C has for them
PROGRAM = "program.h"  # the example, which a source has no need of


def rows_of_normal(unknowns: int) -> int:
    """Rows of the padded normal matrix: the unknowns, the residual, and zeros to a multiple of four."""
    return -(-(unknowns + 1) // 4) * 4


def kernel_source(slopes: Program, parameters: int) -> str:
    """C source of `residual`, `slopes`, `costs` and `normal`, and of the sums, steps and filter that call them.

    slopes: outputs e (m), and its derivative row by row (m * z). parameters: numbers in p. Raises CompilerError for
    operations without a form in C.
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
            number = operation.constant
            if math.isfinite(number):
                return f"({number!r})"
            return "NAN" if math.isnan(number) else "(INFINITY)" if number > 0 else "(-INFINITY)"
        return f"{'d' if self.program.kinds[value] == 'lane' else 'v'}{value}"

    def definitions(self, what: str, out: Sequence[str]) -> Definitions:
        """Definitions in c/program.h for ERRORS or SLOPES: prepare, read, and a lane that ends with `out`."""
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


PAD = 8  # lanes are padded to a multiple of this, so that loops over them need no tail
LARGE = 1 << 20  # bytes of a Jacobian beyond which it is written around the caches, straight to memory
FUNCTIONS = ("residual", "slopes", "costs", "normal", "accumulate", "damped_step", "extended_pass")
"""Functions that the C source of a row model defines."""


class NativeKernels(Kernels):
    """The kernels of a row model in C."""

    name = "c"

    def __init__(self, slopes: Program, parameters: int) -> None:
        super().__init__(slopes, parameters)
        self.rows = rows_of_normal(self.unknowns)
        self.compiled: Any = load_library(kernel_source(slopes, parameters), FUNCTIONS)
        long, pointer = ctypes.c_long, ctypes.c_void_p
        self._residual = self._function("residual", long, long, pointer, pointer, pointer)
        self._slopes = self._function("slopes", long, long, pointer, pointer, pointer, pointer, long)
        self._costs = self._function("costs", long, long, long, pointer, pointer, pointer, pointer)
        self._normal = self._function("normal", long, long, pointer, pointer, pointer, pointer)

    def _packed(self, columns: Array, *, repeat: bool = False) -> Array:
        count, n = columns.shape
        padded = _aligned(count, -(-n // PAD) * PAD)
        padded[:, :n] = columns
        padded[:, n:] = columns[:, -1:] if repeat and n else 0.0
        return padded

    def residual(self, p: Array, lanes: Lanes) -> Array:
        """Plain residuals (m, n)."""
        e = np.empty((self.components, lanes.w.shape[1]))
        self._residual(lanes.n, e.shape[1], _at(p), _at(lanes.d), _at(e))
        return e[:, : lanes.n]

    def slopes(self, p: Array, lanes: Lanes) -> tuple[Array, Array]:
        """Plain residuals (m, n) and slopes (m, z, n)."""
        ld = lanes.w.shape[1]
        e, j = np.empty((self.components, ld)), _aligned(self.components * self.unknowns, ld)
        self._slopes(lanes.n, ld, _at(p), _at(lanes.d), _at(e), _at(j), j.nbytes > LARGE)
        return e[:, : lanes.n], j.reshape(self.components, self.unknowns, ld)[:, :, : lanes.n]

    def costs(self, states: Array, lanes: Lanes) -> Array:
        """Half the weighted sum of squares at each of many p (states, parameters): (states,)."""
        states, cost = np.ascontiguousarray(states), np.zeros(len(states))
        self._costs(lanes.n, lanes.w.shape[1], len(states), _at(states), _at(lanes.d), _at(lanes.w), _at(cost))
        return cost

    def normal(self, p: Array, lanes: Lanes) -> Array:
        """Weighted normal matrix of slopes and, last, residual (z + 1, z + 1)."""
        s = np.empty((self.rows, self.rows))
        self._normal(lanes.n, lanes.w.shape[1], _at(p), _at(lanes.d), _at(lanes.w), _at(s))
        return s[: self.unknowns + 1, : self.unknowns + 1]

    def _function(self, name: str, *types: Any) -> Callable[..., None]:
        function = getattr(self.compiled, name)
        function.argtypes, function.restype = types, None
        return function  # type: ignore[no-any-return]


def _at(array: Array) -> int:
    return array.ctypes.data


def _aligned(rows: int, columns: int) -> Array:
    """An uninitialised array whose numbers begin at a multiple of 64 bytes."""
    raw = np.empty(rows * columns + 8)
    skipped = -(raw.ctypes.data // 8) % 8
    return raw[skipped : skipped + rows * columns].reshape(rows, columns)


class _PackedPiece(ctypes.Structure):
    """`piece` of c/piece.h."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("normal", "slopes")),
        *((name, ctypes.c_long) for name in ("n", "ld", "z", "rows", "constants", "components", "lanes")),
        *((name, ctypes.c_void_p) for name in ("column", "constant", "d", "w")),
    )


class PackedPieces:
    """Pieces on C in memory that stays as long as this object: `address(k)` of piece k, and the library for them."""

    def __init__(self, pieces: Sequence[Piece]) -> None:
        self.pieces = tuple(pieces)
        self._kept: list[object] = []
        self._structs = (_PackedPiece * len(pieces))(*(self._packed(piece) for piece in pieces))

    def address(self, k: int) -> int:
        """Address of piece k and of those after it."""
        return ctypes.addressof(self._structs[k])

    def _packed(self, piece: Piece) -> _PackedPiece:
        columns = np.ascontiguousarray(piece.columns, dtype=ctypes.c_long)
        constants = np.ascontiguousarray(piece.constants)
        self._kept += [columns, constants]
        kernels, lanes = piece.kernels, piece.lanes
        assert isinstance(kernels, NativeKernels)
        self.compiled = kernels.compiled  # any piece's library takes all pieces
        run, own = kernels.compiled, (columns.size, kernels.rows, constants.size, kernels.components)
        entries = (ctypes.cast(each, ctypes.c_void_p).value for each in (run.normal, run.slopes))
        sizes = (lanes.n, lanes.w.shape[1], *own, len(lanes.d))
        return _PackedPiece(*entries, *sizes, *(each.ctypes.data for each in (columns, constants, lanes.d, lanes.w)))

    def extended_pass(
        self, place: Index, x0: Array, scale: Array, mean: Array, covariance: Array
    ) -> tuple[Array, Array, Array]:
        """Let the extended filter take in all rows, changing mean (n,) and covariance (n, n) of (x - x0) / scale.

        place: piece, lane in it and component of each row (rows, 3). A row is evaluated with as many lanes as C pads
        to. Returns means (rows, n) after each row, innovations and their standard deviations (rows,).
        """
        n, rows = x0.size, len(place)
        run, long, pointer = self.compiled.extended_pass, ctypes.c_long, ctypes.c_void_p
        run.argtypes, run.restype = [long, long, *[pointer] * 10], None
        means, innovations, stds = np.empty((rows, n)), np.empty(rows), np.empty(rows)
        needed = (
            piece.size + PAD * (len(piece.lanes.d) + piece.kernels.components * (piece.kernels.unknowns + 1))
            for piece in self.pieces
        )
        read = (np.ascontiguousarray(place, dtype=ctypes.c_long), *map(np.ascontiguousarray, (x0, scale)))
        made = (mean, covariance, means, innovations, stds, np.empty(max(needed) + 4 * n))
        run(rows, n, self.address(0), *(each.ctypes.data for each in (*read, *made)))
        return means, innovations, stds


class NativeNormal:
    """Sums over pieces of rows at one x, and damped steps about x0 in units of `scale` under a prior's information.

    Threads may share the pieces; sums do not depend on how many.
    """

    def __init__(self, packed: PackedPieces, x0: Array, scale: Array, prior: Array, threads: int) -> None:
        pieces = packed.pieces
        n, self._threads, self._count = x0.size, threads, len(pieces)
        about = [np.array(each, order="C", copy=True) for each in (x0, scale, prior)]
        each = max(piece.size + rows_of_normal(piece.kernels.unknowns) ** 2 for piece in pieces)
        # numbers go in and come out through memory that stays, as finding an array's address takes as long as a step
        self._lock = threading.Lock()
        self._x, self._normal, self._out = np.empty(n), np.empty(n * n + n), np.empty(n + 2)
        self._sums, work = np.empty((len(pieces), n * n + n + 1)), np.empty((len(pieces), max(each, 2 * n * (n + 1))))
        self._kept = (packed, about, work)
        library, long, pointer = packed.compiled, ctypes.c_long, ctypes.c_void_p
        accumulate, step = library.accumulate, library.damped_step
        accumulate.argtypes, accumulate.restype = [long, pointer, long, *[pointer] * 3], None
        step.argtypes, step.restype = [long, *[pointer] * 6, ctypes.c_double, *[pointer] * 2], long
        x, sums, normal = self._x.ctypes.data, self._sums.ctypes.data, self._normal.ctypes.data
        shares = [(k, 1) for k in range(len(pieces))] if threads > 1 else [(0, len(pieces))]
        self._shares = [
            (count, packed.address(k), n, x, sums + k * self._sums.strides[0], work[k].ctypes.data)
            for k, count in shares
        ]
        self._accumulate, self._step = accumulate, step
        self._before = (n, normal, normal + 8 * n * n, x, *(row.ctypes.data for row in about))
        self._after = (self._out.ctypes.data, work.ctypes.data)

    def sums(self, x: Array) -> tuple[float, Array, Array]:
        """Half the whitened sum of squares at x (n,), its gradient (n,), and J'J (n, n)."""
        n = x.size
        with self._lock:
            self._x[:] = x
            shared_out(lambda share: self._accumulate(*share), self._shares, self._threads)
            total = self._sums[0].copy() if self._count == 1 else self._sums.sum(axis=0)
        return float(total[-1]), total[n * n : -1], total[: n * n].reshape(n, n)

    def step(self, x: Array, gradient: Array, information: Array, damping: float) -> tuple[Array, float, float] | None:
        """End of a damped step from x (n,), its squared length and predicted fall of the cost; None without a step."""
        n = x.size
        with self._lock:
            self._x[:] = x
            self._normal[: n * n] = information.ravel()
            self._normal[n * n :] = gradient
            if not self._step(*self._before, damping, *self._after):
                return None
            out = self._out.copy()
        return out[:n], float(out[n]), float(out[n + 1])


BACKENDS = ("auto", "c", "blocks")
VARIABLE = "CASACAL_BACKEND"

MOST_PROGRAMS = 32  # programs that a process keeps, the last used ones


def row_kernels(slopes: ca.Function, backend: str | None = None) -> Kernels:
    """Kernels of a residual with its slopes, which read the function's last argument row by row.

    Args:
        slopes: SX function to e (m) and its derivative row by row (m * z); all arguments but the last form p.
        backend: a name of `BACKENDS`, or None for the environment's, or auto.

    A graph that calls other functions is evaluated by CasADi, with the derivatives that it has of them.

    Raises ProblemError for a back end that does not exist or cannot serve, and operations that are not elementary.

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
