"""Residuals, slopes, normal equations and steps over all rows: what estimators ask of a bound problem."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np

from casacal.array_types import Array, Index
from casacal.binding.all_rows import AllRows
from casacal.binding.blocks import Block
from casacal.binding.kernel_rows import FEW, KernelRows
from casacal.binding.slots import Slot
from casacal.kernels.filter_passes import FilterRows
from casacal.kernels.native_rows import NativeKernels, NativeNormal, PackedPieces
from casacal.least_squares.arrow import Arrow, Groups, grouped
from casacal.least_squares.elimination import GroupRows
from casacal.least_squares.losses import Loss
from casacal.least_squares.objective import DampedStep, ExtendedPass, FilterPass, LeastSquares, Normal

COMPACT = 50_000  # rows beyond which no whole Jacobian is held
MOST_SUMS = 4_000_000  # numbers that the sums of all pieces may take: beyond, each piece sums what it sees alone
MANY = 300  # unknowns from which those of one label alone are taken out, one label after the other


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
        return self.jacobian(x) if self.rows <= COMPACT else self._rows.triangle(x)

    @cached_property
    def groups(self) -> Groups | None:
        """Which unknowns belong to one label alone, where these are many: they are taken out label by label."""
        return _groups([columns for block in self.blocks for columns in block.columns], self.slots)

    @cached_property
    def _packed(self) -> PackedPieces | None:
        """All rows for C; None where C does not evaluate all."""
        pieces = self._rows.pieces
        in_c = all(isinstance(piece.kernels, NativeKernels) for piece in pieces)
        return PackedPieces(pieces) if pieces and in_c else None

    @cached_property
    def _native(self) -> NativeNormal | None:
        """Sums in C; None where some rows are not evaluated in C, or pieces and unknowns are many."""
        if self.groups is not None or self._packed is None:
            return None
        if len(self._packed.pieces) * self.unknowns**2 > MOST_SUMS:
            return None
        threads = self._threads if self.rows >= FEW else 1
        return NativeNormal(self._packed, self.x0, self.start_std, self.prior_information, threads)

    def normal(self, x: Array, loss: Loss | None = None) -> Normal:
        """Cost, gradient and information of the data, accumulated in the kernels; rows weighted by a loss."""
        if loss is None and self._native is not None:
            return Normal(*self._native.sums(x))
        information = np.zeros((x.size, x.size)) if self.groups is None else Arrow.zero(self.groups)
        cost, gradient = 0.0, np.zeros(x.size)
        for piece, some, s in self._rows.sums(x, loss):
            cost += some
            gradient[piece.columns] += s[:-1, -1]
            if isinstance(information, Arrow):
                information.add(piece.columns, s[:-1, :-1])
            else:
                information[piece.columns[:, None], piece.columns] += s[:-1, :-1]
        return Normal(cost, gradient, information)

    def group_rows(self, x: Array, loss: Loss | None = None) -> Iterator[GroupRows]:
        """The whitened Jacobian, rows that see shared unknowns alone first, then group by group; weighted by a loss."""
        groups = self.groups
        assert groups is not None
        kind, group, _ = groups.place
        kept: dict[tuple[int, int], list[GroupRows]] = {}
        for piece, e, slopes in self._rows.slopes(x):
            noise = self._rows.noise[piece.numbers]
            weight = 1.0 if loss is None else np.sqrt(loss.weight(e / noise))
            whitened = (slopes * (weight / noise)[..., None]).reshape(-1, piece.columns.size)
            mine = np.flatnonzero(kind[piece.columns] >= 0)
            part = _of_group(groups, piece.columns, mine, piece.numbers.ravel(), whitened)
            if mine.size:
                first = piece.columns[mine[0]]
                kept.setdefault((int(kind[first]), int(group[first])), []).append(part)
            else:
                yield part
        for parts in kept.values():
            rows = np.concatenate([part.rows for part in parts])
            own, shared = np.vstack([part.own for part in parts]), np.vstack([part.shared for part in parts])
            yield GroupRows(rows, parts[0].members, parts[0].among, own, shared)

    def damped_step(self, x: Array, normal: Normal, damping: float) -> DampedStep | None:
        """A damped Gauss-Newton step; in C where rows are evaluated in C."""
        if self._native is None or isinstance(normal.information, Arrow):
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


def _of_group(groups: Groups, columns: Index, mine: Index, numbers: Index, slopes: Array) -> GroupRows:
    """Rows with slopes (m, z) by some unknowns (z,), of which those at `mine` are one group's own."""
    kind, group, position = groups.place
    theirs = np.setdiff1d(np.arange(columns.size), mine)
    shared = np.zeros((len(slopes), groups.shared.size))
    shared[:, position[columns[theirs]]] = slopes[:, theirs]
    members = groups.own[kind[columns[mine[0]]]][group[columns[mine[0]]]] if mine.size else mine
    own = np.zeros((len(slopes), members.size))
    own[:, position[columns[mine]]] = slopes[:, mine]
    return GroupRows(numbers, members, groups.shared, own, shared)


def _groups(columns: Sequence[Index], slots: Sequence[Slot]) -> Groups | None:
    """Unknowns of one label alone, by the label column that has most of them; None where all are few.

    Those of effects beside the geometry do not count: they are left out where the geometry alone has many.
    """
    if sum(slot.unknown.size for slot in slots if not slot.beside) <= MANY:
        return None
    by_column: dict[str, list[int]] = {}
    for slot in slots:
        if slot.label is not None and slot.unknown.per is not None:
            by_column.setdefault(slot.unknown.per, []).extend(slot.columns)
    if not by_column:
        return None
    own = np.zeros(sum(slot.unknown.size for slot in slots), dtype=bool)
    own[max(by_column.values(), key=len)] = True
    return grouped(columns, own)
