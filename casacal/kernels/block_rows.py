"""CasADi's machine over many rows: any function of them, and kernels without a compiler, on columns of some hundred."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from casacal.errors import ProblemError
from casacal.kernels.losses import Loss
from casacal.kernels.program import Program, calls, read_program
from casacal.kernels.rows import Kernels, Lanes, lane_data
from casacal.threads import shared_out
from casacal.values import Array

BLOCK = 256  # rows that a map evaluates in one call; larger ones cost memory and time to build


class Buffered:
    """A CasADi function called on memory that NumPy owns, by any number of threads.

    Work memory belongs to a buffer, not to a function, and CasADi lets go of Python's lock while it evaluates. Each
    thread has a buffer of its own, therefore; the function is one for all.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        self._own = threading.local()

    def __call__(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> None:
        """Evaluate: arrays of float64 in C order, the outputs' overwritten; shapes are as CasADi's, transposed."""
        self.bound(inputs, outputs)()

    def bound(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> Callable[[], None]:
        """Evaluator bound to fixed buffers of this thread, for as long as this object lives."""
        if not hasattr(self._own, "buffer"):
            self._own.buffer, self._own.evaluate = self._function.buffer()
        buffer: Any = self._own.buffer  # CasADi's stubs do not know that it takes a memoryview
        evaluate: Callable[[], None] = self._own.evaluate
        for i, array in enumerate(inputs):
            buffer.set_arg(i, _flat(array))
        for i, array in enumerate(outputs):
            buffer.set_res(i, _flat(array))
        self._own.arrays = (inputs, outputs)

        def evaluated() -> None:
            try:
                evaluate()
            except RuntimeError as error:  # elementary operations never fail
                why = " ".join(str(error).split()).rpartition(": ")[2].partition(". ")[0]
                what = f"A function that the model calls, such as a rootfinder, failed: {why[:200]}"
                fix = "Narrow the joint limits to where it has a value, or let it give one that is not a number"
                raise ProblemError(what, fix) from error

        return evaluated

    def feed(self, i: int, array: Array) -> None:
        """Read argument i from other memory from now on."""
        self._own.buffer.set_arg(i, _flat(array))
        self._own.fed = array


def _flat(array: Array) -> memoryview:
    """An array's own memory; a copy would be gone before CasADi reads it."""
    if not array.flags.c_contiguous:
        raise ValueError("an array must lie in memory row by row")
    return array.reshape(-1).data


def replayed(program: Program, values: Sequence[int], p: ca.MX, d: ca.MX, *, is_prepared: bool = False) -> list[ca.MX]:
    """Some values, a column each, with the operations of a program on columns of samples.

    p: all parameters or, prepared, the values of `program.once`. Operations are shared within one call alone.
    """
    known: dict[int, ca.MX] = dict(zip(program.lanes, ca.horzsplit(d), strict=True)) if program.lanes else {}
    parameters = ca.vertsplit(p) if p.numel() else []
    if is_prepared:
        known |= dict(zip(program.once, parameters, strict=True))
    for value in program.needed(values):
        operation = program.operations[value]
        if value in known or program.kinds[value] == "lane" or (is_prepared and program.kinds[value] == "once"):
            continue
        if operation.op == ca.OP_CONST:
            known[value] = ca.MX(operation.constant)
        elif operation.op == ca.OP_INPUT:
            known[value] = parameters[program.position(value)]
        elif len(operation.args) == 1:
            known[value] = ca.MX.unary(operation.op, known[operation.args[0]])
        else:
            one, other = (known[arg] for arg in operation.args)
            known[value] = ca.MX.binary(operation.op, one, other)
    ones = ca.MX.ones(d.shape[0], 1)
    return [known[v] if known[v].shape == ones.shape else known[v] * ones for v in values]


def mapped(function: ca.Function, p: ca.MX, d: ca.MX) -> list[ca.MX]:
    """All outputs of a function, a column each, at its first arguments p and rows of its last one (width, k)."""
    last = function.n_in() - 1
    starts = np.cumsum([0, *(function.numel_in(i) for i in range(last))]).tolist()
    over = function.map("mapped", "serial", d.shape[0], list(range(last)), [])
    found = over.call([*ca.vertsplit(p, starts), d.T])
    rows = (ca.reshape(each, each.numel() // d.shape[0], d.shape[0]) for each in found)
    return [column for each in rows for column in ca.horzsplit(each.T)]


class Batch:
    """A CasADi function of dense columns, evaluated for many rows at once.

    Threads may share it: each has arguments, results and CasADi's work memory of its own.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self._own = threading.local()

    def __call__(self, *inputs: Array) -> list[Array]:
        """Evaluate: inputs (N, k), or (k,) for all rows alike; outputs (N, size)."""
        count = max((len(values) for values in inputs if values.ndim == 2), default=1)
        sizes = [self.function.numel_out(i) for i in range(self.function.n_out())]
        outputs = [np.empty((count, size)) for size in sizes]
        for first in range(0, count, BLOCK):
            last = min(first + BLOCK, count)
            arguments, results, evaluate, *_ = self._width(last - first)
            for argument, values in zip(arguments, inputs, strict=True):
                argument[...] = values[first:last] if values.ndim == 2 else values
            evaluate()
            for output, result in zip(outputs, results, strict=True):
                output[first:last] = result
        return outputs

    def _width(self, width: int) -> tuple[Any, ...]:
        """Arguments, results and the call that fills them, of this thread."""
        if not hasattr(self._own, "widths"):
            self._own.widths = {}
        widths: dict[int, tuple[Any, ...]] = self._own.widths
        if width not in widths:
            function = self.function
            # one row of these arrays is one column of the mapped function
            arguments = [np.zeros((width, function.numel_in(i))) for i in range(function.n_in())]
            results = [np.zeros((width, function.numel_out(i))) for i in range(function.n_out())]
            mapped = Buffered(function.map(width) if width > 1 else function)  # kept, as its buffer needs it
            widths[width] = (arguments, results, mapped.bound(arguments, results), mapped)
        return widths[width]


WIDTHS = {64: 64, 512: 128}  # samples up to which blocks have another width than the widest: for a face, for few rows
WIDEST = 512
FEW = 4096  # rows below which a plain map is sooner done than columns are built
TOGETHER = 16  # blocks of second derivatives that one thread sums up at a time


def blocked(columns: Array, *, repeat: bool = False) -> Array:
    """Blocks (blocks, k, width) of columns (k, n), filled up by zeros, or by the last row again."""
    count, n = columns.shape
    width = next((width for most, width in WIDTHS.items() if n <= most), WIDEST)
    padded = np.pad(columns, ((0, 0), (0, -n % width)), mode="edge" if repeat else "constant")
    return np.ascontiguousarray(padded.reshape(count, padded.shape[1] // width, width).transpose(1, 0, 2))


def product(one: ca.MX, other: ca.MX) -> ca.MX:
    """Matrix product by the BLAS that CasADi was built with, several times faster than its own, where there is one."""
    try:
        return ca.mtimes(one, other, "classic")
    except RuntimeError:
        return ca.mtimes(one, other)


class BlockKernels(Kernels):
    """The kernels of a row model on CasADi's virtual machine."""

    name = "blocks"

    def __init__(self, slopes: Program, parameters: int) -> None:
        super().__init__(slopes, parameters)
        self._residual = slopes.only(0)
        self._functions: dict[tuple[str, int], Buffered] = {}

    def _packed(self, columns: Array, *, repeat: bool = False) -> Array:
        return blocked(columns, repeat=repeat)

    def residual(self, p: Array, lanes: Lanes) -> Array:
        """Plain residuals (m, n)."""
        function, o = self._kept("residual", lanes.d.shape[2]), self._prepared("residual", p)
        e = np.empty((len(lanes.d), self.components, lanes.d.shape[2]))
        for d, out in zip(lanes.d, e, strict=True):
            function((o, d), (out,))
        return np.asarray(e.transpose(1, 0, 2).reshape(self.components, -1)[:, : lanes.n])

    def slopes(self, p: Array, lanes: Lanes) -> tuple[Array, Array]:
        """Plain residuals (m, n) and slopes (m, z, n)."""
        function, blocks, width = self._kept("slopes", lanes.d.shape[2]), len(lanes.d), lanes.d.shape[2]
        m, z = self.components, self.unknowns
        some, values = np.empty((m * (z + 1), width)), np.empty((m * (z + 1), blocks * width))
        evaluate = function.bound((self._prepared("slopes", p), lanes.d[0]), tuple(some))
        for k, d in enumerate(lanes.d):
            function.feed(1, d)
            evaluate()
            values[:, k * width : (k + 1) * width] = some
        return values[:m, : lanes.n], values[m:].reshape(m, z, values.shape[1])[:, :, : lanes.n]

    def costs(self, states: Array, lanes: Lanes) -> Array:
        """Half the weighted sum of squares at each of many p (states, parameters): (states,)."""
        function, out, cost = self._kept("cost", lanes.d.shape[2]), np.empty(1), np.zeros(len(states))
        states = np.ascontiguousarray(states)
        for k, p in enumerate(states):
            o = self._prepared("residual", p)
            for d, w in zip(lanes.d, lanes.w, strict=True):
                function((o, d, w), (out,))
                cost[k] += out[0]
        return cost

    def normal(self, p: Array, lanes: Lanes) -> Array:
        """Weighted normal matrix of slopes and, last, residual (z + 1, z + 1)."""
        function, o = self._kept("normal", lanes.d.shape[2]), self._prepared("slopes", p)
        out, s = np.empty((2, self.unknowns + 1, self.unknowns + 1))
        s[...] = 0.0
        for d, w in zip(lanes.d, lanes.w, strict=True):
            function((o, d, w), (out,))
            s += out
        return s

    def _prepared(self, name: str, p: Array) -> Array:
        """Values that depend on parameters alone, computed once for all blocks."""
        program = self._residual if name == "residual" else self._program
        o = np.empty(len(program.once))
        if o.size:
            self._kept(f"prepared {name}", 0)((p,), (o,))
        return o

    def _kept(self, name: str, width: int) -> Buffered:
        if (name, width) not in self._functions:  # threads that come at once may build it twice, alike
            self._functions[name, width] = Buffered(self._built(name, width))
        return self._functions[name, width]

    def _columns(self, residual: bool, width: int) -> tuple[ca.MX, ca.MX, list[ca.MX]]:
        """Prepared values, lanes, and a column for each result, or for each residual alone."""
        program = self._residual if residual else self._program
        o, d = ca.MX.sym("o", len(program.once)), ca.MX.sym("d", width, len(program.lanes))
        return o, d, replayed(program, program.results, o, d, is_prepared=True)

    def _built(self, name: str, width: int) -> ca.Function:
        if name.startswith("prepared"):  # p -> the values of parameters alone
            program = self._residual if name.endswith("residual") else self._program
            p = ca.MX.sym("p", self._parameters)
            prepared = replayed(program, program.once, p, ca.MX(1, len(program.lanes)))
            return ca.Function("prepared", [p], [ca.vertcat(*prepared)])
        o, d, columns = self._columns(name in ("residual", "cost"), width)
        w = ca.MX.sym("w", width, self.components)
        e, j = columns[: self.components], columns[self.components :]
        if name == "residual":
            return ca.Function(name, [o, d], [ca.horzcat(*e)])
        if name == "cost":
            return ca.Function(name, [o, d, w], [ca.sumsqr(w * ca.horzcat(*e)) / 2])
        if name == "slopes":  # column by column, so that nothing is put together only to be taken apart
            return ca.Function(name, [o, d], columns)
        total = ca.MX.zeros(self.unknowns + 1, self.unknowns + 1)
        for m in range(self.components):
            weighted = ca.horzcat(*j[m * self.unknowns : (m + 1) * self.unknowns], e[m]) * w[:, m]
            total += product(weighted.T, weighted)
        return ca.Function(name, [o, d, w], [total])


class CalledKernels(BlockKernels):
    """The same for a graph that calls other functions: rows are mapped, as there are no operations to replay."""

    def __init__(self, slopes: ca.Function) -> None:
        inputs = [ca.SX.sym("i", slopes.sparsity_in(i)) for i in range(slopes.n_in())]
        self._slopes, self._alone = slopes, ca.Function("residual", inputs, slopes.call(inputs)[:1])
        self._parameters = sum(slopes.numel_in(i) for i in range(slopes.n_in() - 1))
        self.components = slopes.numel_out(0)
        self.unknowns = sum(slopes.numel_out(i) for i in range(1, slopes.n_out())) // self.components
        self._functions: dict[tuple[str, int], Buffered] = {}

    def lanes(self, data: Array, noise: Array) -> Lanes:
        """Rows of data (n, columns) with standard deviations (n, m), the data as they are."""
        return Lanes(len(data), blocked(data.T, repeat=True), blocked(1.0 / noise.T))

    def _prepared(self, name: str, p: Array) -> Array:
        del name
        return np.ascontiguousarray(p, dtype=np.float64)

    def _columns(self, residual: bool, width: int) -> tuple[ca.MX, ca.MX, list[ca.MX]]:
        function = self._alone if residual else self._slopes
        o, d = ca.MX.sym("o", self._parameters), ca.MX.sym("d", width, function.numel_in(function.n_in() - 1))
        return o, d, mapped(function, o, d)


class CurvatureKernel:
    """|We|^2 / 2, its gradient and its Hessian by v, for a residual (v, c, d) -> e (m) and rows of d and weights W.

    The Hessian is J'WWJ, one matrix product a block, and sum w^2 e d2e/dv2, of which only the upper triangle's entries
    that are not zero are evaluated. Of the last `linear` of v, small unknowns about zero, second derivatives are left
    out, and the others' are taken where these are zero: steps need no more. With a loss the cost is its sum, W takes
    the root of its weights, so that the gradient is exact, and the Hessian is J'WWJ alone: in the exact one, rows
    beyond the threshold count nothing or less, and solvers lose their way.
    """

    def __init__(self, residual: ca.Function, *, linear: int = 0) -> None:
        v, c, d = (ca.SX.sym(name, residual.numel_in(i)) for i, name in enumerate("vcd"))
        e = residual(v, c, d)
        slopes = ca.jacobian(e, v)
        curving = v.numel() - linear
        curved = residual(ca.vertcat(v[:curving], ca.SX.zeros(linear)), c, d)
        bends = [ca.triu(ca.hessian(curved[m], v[:curving])[0]) * e[m] for m in range(e.numel())]
        pattern = ca.Sparsity(curving, curving)
        for bend in bends:
            pattern = pattern + bend.sparsity()
        self.unknowns, self.components, self._constants = v.numel(), e.numel(), c.numel()
        self._rows, self._columns = (np.array(index, dtype=np.intp) for index in pattern.get_triplet())
        bent = [ca.project(bend, pattern).nz[:] for bend in bends]
        outputs = [ca.densify(each) for each in ca.cse([e, slopes.T, ca.vertcat(*bent, ca.SX(0, 1))])]
        self._function = ca.Function("curved", [v, c, d], outputs)
        self._program = None if calls(self._function) else read_program(self._function, ("once", "once", "lane"))
        self._built: dict[int, Buffered] = {}

    def lanes(self, data: Array, noise: Array) -> Lanes:
        """Rows of data (n, columns) with standard deviations (n, m) of their residuals, packed once for all calls."""
        d = data.T if self._program is None else lane_data(self._program, data)
        return Lanes(len(data), blocked(d, repeat=True), blocked(1.0 / noise.T))

    def __call__(
        self, v: Array, constants: Array, lanes: Lanes, *, loss: Loss | None = None, threads: int = 1
    ) -> tuple[float, Array, Array]:
        """Cost, gradient (z,) and Hessian (z, z) at v (z,), with the rows' common constants c.

        Threads change no digit: blocks are summed up in groups, and the groups in order.
        """
        z, p = self.unknowns, np.concatenate([v, constants])
        groups = [slice(k, k + TOGETHER) for k in range(0, len(lanes.d), TOGETHER)]
        parts = shared_out(lambda some: self._sums(p, lanes.d[some], lanes.w[some], loss), groups, threads)
        s, bent, cost = (np.sum(each, axis=0) for each in zip(*parts, strict=True))
        bend = np.zeros((z, z))
        bend[self._rows, self._columns] = bent
        return float(s[-1, -1] / 2 if loss is None else cost), s[:-1, -1], s[:-1, :-1] + bend + np.triu(bend, 1).T

    def _sums(self, p: Array, d: Array, w: Array, loss: Loss | None) -> tuple[Array, Array, float]:
        """Normal matrix of slopes and residual, entries of the bend, and what a loss costs, of some blocks."""
        width = d.shape[2]
        if width not in self._built:  # threads that come at once may build it twice, alike
            self._built[width] = Buffered(self._block(width))
        evaluate = self._built[width]
        s, bent = np.zeros((self.unknowns + 1, self.unknowns + 1)), np.zeros(self._rows.size)
        weighted, others = np.empty((self.components, self.unknowns + 1, width)), np.empty_like(bent)
        cost = 0.0
        for one, weights in zip(d, w, strict=True):
            evaluate((p, one, weights), (weighted, others))
            if loss is None:
                bent += others
            else:
                r = weighted[:, -1:]
                cost += float(loss.cost(r).sum())
                weighted *= np.sqrt(loss.weight(r))
            for each in weighted:  # NumPy's product is many times faster than CasADi's
                s += each @ each.T
        return s, bent, cost

    def _block(self, width: int) -> ca.Function:
        """(p, d, w) -> weighted slopes and residual by component, entries of the bend; of one block."""
        z, count = self.unknowns, self._rows.size
        p, w, program = ca.MX.sym("p", z + self._constants), ca.MX.sym("w", width, self.components), self._program
        d = ca.MX.sym("d", width, self._function.numel_in(2) if program is None else len(program.lanes))
        found = mapped(self._function, p, d) if program is None else replayed(program, program.results, p, d)
        columns = ca.horzcat(*found)
        e, j, bent = ca.horzsplit(columns, [0, self.components, self.components * (z + 1), columns.shape[1]])
        weighted, bend = [], ca.MX.zeros(count, 1)
        for m in range(self.components):
            weighted.append(ca.horzcat(j[:, m * z : (m + 1) * z], e[:, m]) * w[:, m])
            bend += product(bent[:, m * count : (m + 1) * count].T, w[:, m] ** 2)
        return ca.Function("block", [p, d, w], [ca.horzcat(*weighted), bend])


class Columnwise:
    """A function (z, c, d) -> values, at one z and c for rows of d."""

    def __init__(self, function: ca.Function) -> None:
        self._batch = Batch(function)

    @cached_property
    def _kernels(self) -> BlockKernels:
        """Built when many rows come for the first time, which takes longer than few rows do."""
        function = self._batch.function
        if calls(function):
            return CalledKernels(function)
        program = read_program(function, ("once", "once", "lane"), ahead=False)
        return BlockKernels(program, function.numel_in(0) + function.numel_in(1))

    def __call__(self, z: Array, c: Array, data: Array) -> Array:
        """Values (N, outputs) at z and c for data (N, columns)."""
        if len(data) < FEW:
            return self._batch(z, c, data)[0]
        lanes = self._kernels.lanes(data, np.ones((len(data), self._kernels.components)))
        return self._kernels.residual(np.concatenate([z, c]), lanes).T
