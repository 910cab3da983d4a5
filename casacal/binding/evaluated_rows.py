"""Residuals, slopes, normal equations and steps over all rows: what estimators ask of a bound problem."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from casacal.array_types import Array
from casacal.binding.all_rows import AllRows
from casacal.binding.blocks import Block
from casacal.binding.kernel_rows import FEW, KernelRows
from casacal.binding.slots import Slot
from casacal.kernels.filter_passes import FilterRows
from casacal.kernels.native_rows import NativeKernels, NativeNormal, PackedPieces
from casacal.least_squares.losses import Loss
from casacal.least_squares.objective import DampedStep, ExtendedPass, FilterPass, LeastSquares, Normal

COMPACT, HELD = 50_000, 10_000_000  # rows, and numbers of a whole Jacobian, beyond which none is held
MOST_SUMS = 4_000_000  # numbers that the sums of all pieces may take: beyond, each piece sums what it sees alone


class EvaluatedRows(AllRows, LeastSquares):
    """All rows on their kernels; no whole Jacobian is held unless it is asked for."""

    slots: tuple[Slot, ...]
    _rows: KernelRows
    _threads: int
    _asked: str | None

    @property
    def rows(self) -> int:
        """Scalar residuals of all instruments."""
        return int(self.starts[-1])

    @property
    def backend(self) -> str:
        """What evaluates the rows: "c" or "blocks"."""
        return self._rows.backend

    def plain_residual(self, x: Array) -> Array:
        """Residuals (rows,) in their own unit, mm for a plane, before whitening."""
        return self._rows.residual(x)

    def residual(self, x: Array) -> Array:
        """Whitened residuals (rows,) at x (n,)."""
        return self._rows.residual(x) / self._rows.noise

    def jacobian(self, x: Array) -> Array:
        """Whitened Jacobian (rows, n) at x (n,)."""
        whole = np.zeros((self.rows, self.unknowns))
        for piece, _, slopes in self._rows.slopes(x):
            whole[piece.numbers[..., None], piece.columns] = slopes / self._rows.noise[piece.numbers][..., None]
        return whole

    def compact_jacobian(self, x: Array) -> Array:
        """Rows (k, n) with the J'J of the whitened Jacobian: itself, or the triangle R of many rows."""
        few = self.rows <= COMPACT and self.rows * self.unknowns <= HELD
        return self.jacobian(x) if few else self._rows.triangle(x)

    @cached_property
    def _packed(self) -> PackedPieces | None:
        """All rows for C; None where C does not evaluate all."""
        pieces = self._rows.pieces
        in_c = all(isinstance(piece.kernels, NativeKernels) for piece in pieces)
        return PackedPieces(pieces) if pieces and in_c else None

    @cached_property
    def _native(self) -> NativeNormal | None:
        """Sums in C; None where some rows are not evaluated in C, or pieces and unknowns are many."""
        if self._packed is None or len(self._packed.pieces) * self.unknowns**2 > MOST_SUMS:
            return None
        threads = self._threads if self.rows >= FEW else 1
        return NativeNormal(self._packed, self.x0, self.start_std, self.prior_information, threads)

    def normal(self, x: Array, loss: Loss | None = None) -> Normal:
        """Cost, gradient and information of the data, accumulated in the kernels; rows weighted by a loss."""
        if loss is None and self._native is not None:
            return Normal(*self._native.sums(x))
        cost, gradient, information = 0.0, np.zeros(x.size), np.zeros((x.size, x.size))
        for piece, some, s in self._rows.sums(x, loss):
            cost += some
            gradient[piece.columns] += s[:-1, -1]
            information[piece.columns[:, None], piece.columns] += s[:-1, :-1]
        return Normal(cost, gradient, information)

    def damped_step(self, x: Array, normal: Normal, damping: float) -> DampedStep | None:
        """A damped Gauss-Newton step; in C where rows are evaluated in C."""
        if self._native is None:
            return super().damped_step(x, normal, damping)
        found = self._native.step(x, normal.gradient, normal.information, damping)
        return None if found is None else DampedStep(*found)

    def costs(self, states: Array, loss: Loss | None = None) -> Array:
        """Objective at many states (m, n): (m,); with a loss where one is given."""
        away = states - self.x0
        away *= away
        total = away @ (self.prior_information / 2)
        total += self._rows.costs(states, loss)
        return np.asarray(total)

    def extended_pass(self, mean: Array, covariance: Array) -> ExtendedPass | None:
        """Let an extended filter take in all rows, in C where there is a compiler."""
        if self._packed is None:
            return None
        mean, covariance = mean.copy(), np.ascontiguousarray(covariance.copy())
        trace = self._packed.extended_pass(self._rows.places, self.x0, self.start_std, mean, covariance)
        return ExtendedPass(mean, covariance, *trace)

    def row(self, k: int, states: Array) -> Array:
        """Whitened residual k at many states (m, n): (m,)."""
        block, sample, component = self._locate(k)
        pattern = block.pattern[sample]
        (e,) = block.model.batch.residual(
            states[:, block.columns[pattern]], block.constants[pattern], block.data[sample]
        )
        return np.asarray(e[:, component] / block.noise[sample, component])

    def row_jacobian(self, k: int, x: Array) -> tuple[float, Array]:
        """Whitened residual k and its gradient (n,) at x (n,)."""
        block, sample, component = self._locate(k)
        pattern, noise = block.pattern[sample], block.noise[sample, component]
        columns = block.columns[pattern]
        e, slopes = block.model.batch.jacobian(x[columns][None], block.constants[pattern], block.data[sample])
        gradient = np.zeros(self.unknowns)
        gradient[columns] = slopes.reshape(-1, columns.size)[component] / noise
        return float(e[0, component] / noise), gradient

    def filter_pass(self, first: int, mean: Array, root: Array) -> FilterPass:
        """Let a cubature filter take in the rows of one instrument from `first` on, in C where there is a compiler."""
        i = self._instrument(first)
        block, before = self.blocks[i], int(self.starts[i])
        once = np.hstack([block.constants[block.pattern], block.data])
        rows = FilterRows(block.pattern, block.columns, self.x0, self.start_std, once, 1 / block.noise)
        mean, root = mean.copy(), np.ascontiguousarray(root.copy())
        stop, *trace = block.model.filter(self._asked)(first - before, rows, mean, root)
        return FilterPass(before + stop, mean, root, *(each[first - before : stop] for each in trace))

    def _instrument(self, k: int) -> int:
        return int(np.searchsorted(self.starts, k, side="right")) - 1

    def _locate(self, k: int) -> tuple[Block, int, int]:
        """The block of residual k, its sample there, and its component."""
        i = self._instrument(k)
        block = self.blocks[i]
        return block, *divmod(k - int(self.starts[i]), block.noise.shape[1])
