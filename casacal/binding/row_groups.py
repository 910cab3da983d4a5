"""The rows of one instrument on their kernels: rows that see the same unknowns are evaluated together, in pieces."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.blocks import Block
from casacal.kernels.native_rows import NativeKernels, NativePiece
from casacal.least_squares.losses import Loss
from casacal.least_squares.objective import FilterPass
from casacal.tables.columns import rows_by_code
from casacal.threads import shared_out

FEW = 8_192
"""Rows below which all stay together: threads would spend more on one another than they save."""
MOST_PIECES = 16
LARGEST_PIECE = 16_384
MANY_LANES = 50_000
"""Candidates times rows from which candidates are shared out."""
PIECES = 1024
"""Pieces whose sums are held at a time."""
STATES = 32
"""Candidates evaluated together, when there are many."""


@dataclass(frozen=True)
class Piece:
    """Rows of one pattern: where they stand, which of x they see, their constants, their data as kernels read it."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    constants: Array
    unknowns: int
    """How many x has."""
    lanes: Any
    square: tuple[NDArray[np.intp], ...]
    """Where the piece's part of an n x n matrix stands."""

    @cached_property
    def whole(self) -> bool:
        """Whether x itself is what the kernels call p."""
        return not self.constants.size and np.array_equal(self.columns, np.arange(self.unknowns))

    def parameters(self, x: Array) -> Array:
        """What the kernels call p, at x (n,) or at many (m, n)."""
        if self.whole:
            return np.ascontiguousarray(x, dtype=np.float64)
        if x.ndim == 1:
            return np.concatenate([x[self.columns], self.constants])
        constants = np.broadcast_to(self.constants, (len(x), self.constants.size))
        return np.concatenate([x[:, self.columns], constants], axis=1)


class RowGroups:
    """Residuals, slopes and their sums over all rows of a block.

    How rows fall into pieces depends on their number alone, and pieces are summed in order: results are the same
    whatever the number of threads.
    """

    def __init__(self, block: Block, unknowns: int, backend: str | None, threads: int) -> None:
        self.block, self._unknowns, self._asked, self._rows = block, unknowns, backend, block.model.rows(backend)
        self._packed: RowGroups | None = None
        self._shared_by = threads
        self._threads = threads if len(block.noise) >= FEW else 1

    @property
    def backend(self) -> str:
        """Name of the back end in use."""
        return self._rows.kernels.name

    def with_noise(self, block: Block) -> RowGroups:
        """The same rows with other noise; their data are packed once for all."""
        if block is self.block:
            return self
        other = RowGroups(block, self._unknowns, self._asked, self._shared_by)
        other._packed = self._packed or self
        return other

    @cached_property
    def pieces(self) -> tuple[Piece, ...]:
        """Rows by pattern, packed for the kernels when first used."""
        block, found = self.block, []
        if self._packed is not None:
            again, pieces = self._rows.kernels.reweighted, self._packed.pieces
            return tuple(replace(p, lanes=again(p.lanes, 1.0 / block.noise[p.rows].T)) for p in pieces)
        of_each = rows_by_code(block.pattern, len(block.columns))
        for columns, constants, rows in zip(block.columns, block.constants, of_each, strict=True):
            square = np.ix_(columns, columns)
            for some in _parts(rows) if rows.size else ():
                lanes = self._rows.lanes([block.rows(some)], block.noise[some])
                found.append(Piece(some, columns, constants, self._unknowns, lanes, square))
        return tuple(found)

    @property
    def native_pieces(self) -> tuple[NativePiece, ...] | None:
        """The pieces as compiled sums take them; None where rows are not evaluated in C."""
        kernels = self._rows.kernels
        if not isinstance(kernels, NativeKernels):
            return None
        return tuple(NativePiece(kernels, piece.columns, piece.constants, piece.lanes) for piece in self.pieces)

    def residual(self, x: Array) -> Array:
        """Plain residuals (N, m)."""
        e = np.empty(self.block.noise.shape)

        def fill(piece: Piece) -> None:
            e[piece.rows] = self._rows.kernels.residual(piece.parameters(x), piece.lanes).T

        shared_out(fill, self.pieces, self._threads)
        return e

    def slopes(self, x: Array) -> Iterator[tuple[Piece, Array, Array]]:
        """Piece by piece, plain residuals (n, m) and slopes (n, m, z)."""
        for piece in self.pieces:
            e, j = self._rows.kernels.slopes(piece.parameters(x), piece.lanes)
            yield piece, e.T, j.transpose(2, 0, 1)

    def triangles(self, x: Array) -> list[Array]:
        """R (k, n) of the whitened Jacobian of each piece."""

        def triangle(piece: Piece) -> Array:
            _, slopes = self._rows.kernels.slopes(piece.parameters(x), piece.lanes)
            whitened = slopes / self.block.noise[piece.rows].T[:, None]
            whole = np.zeros((self._unknowns, len(piece.rows) * len(slopes)))
            whole[piece.columns] = whitened.transpose(1, 0, 2).reshape(len(piece.columns), -1)
            return np.asarray(np.linalg.qr(whole.T, mode="r"))

        return shared_out(triangle, self.pieces, self._threads)

    def costs(self, states: Array) -> Array:
        """Half the whitened sum of squares at many x (m, n): (m,)."""

        def total(some: Array) -> Array:
            found = [self._rows.kernels.costs(piece.parameters(some), piece.lanes) for piece in self.pieces]
            return found[0] if len(found) == 1 else np.sum(found, axis=0)

        if len(states) * len(self.block.noise) < MANY_LANES:
            return total(states)
        few = [states[k : k + STATES] for k in range(0, len(states), STATES)]
        return np.concatenate(shared_out(total, few, self._shared_by))

    def sums(self, x: Array, loss: Loss | None = None) -> Iterator[tuple[Piece, float, Array]]:
        """Piece by piece, half the whitened sum of squares, and (J r)'(J r) (z + 1, z + 1); with a loss, weighted."""
        kernels = self._rows.kernels

        def part(piece: Piece) -> tuple[float, Array]:
            p, lanes, cost = piece.parameters(x), piece.lanes, 0.0
            if loss is not None:  # a weight on r^2 is its root on r
                noise = self.block.noise[piece.rows].T
                r = kernels.residual(p, lanes) / noise
                lanes = kernels.reweighted(lanes, np.sqrt(loss.weight(r)) / noise)
                cost = float(loss.cost(r).sum())
            s = kernels.normal(p, lanes)
            return (cost if loss is not None else float(s[-1, -1]) / 2), s

        for k in range(0, len(self.pieces), PIECES):
            some = self.pieces[k : k + PIECES]
            for piece, (cost, s) in zip(some, shared_out(part, some, self._threads), strict=True):
                yield piece, cost, s

    def row(self, k: int, states: Array) -> Array:
        """Whitened residual k at many states (m, n): (m,)."""
        block, (sample, component) = self.block, divmod(k, self.block.noise.shape[1])
        pattern = block.pattern[sample]
        (e,) = block.model.batch.residual(
            states[:, block.columns[pattern]], block.constants[pattern], block.data[sample]
        )
        return np.asarray(e[:, component] / block.noise[sample, component])

    def row_jacobian(self, k: int, x: Array) -> tuple[float, Array]:
        """Whitened residual k and its gradient (n,) at x (n,)."""
        block, (sample, component) = self.block, divmod(k, self.block.noise.shape[1])
        pattern, noise = block.pattern[sample], block.noise[sample, component]
        columns = block.columns[pattern]
        e, slopes = block.model.batch.jacobian(x[columns][None], block.constants[pattern], block.data[sample])
        gradient = np.zeros(self._unknowns)
        gradient[columns] = slopes.reshape(-1, columns.size)[component] / noise
        return float(e[0, component] / noise), gradient

    def filter_pass(self, first: int, x0: Array, scale: Array, mean: Array, root: Array) -> FilterPass:
        """Let a cubature filter take in the block's residuals from `first` on."""
        block, run = self.block, self.block.model.filter(self._asked)
        once = np.hstack([block.constants[block.pattern], block.data])
        mean, root = mean.copy(), np.ascontiguousarray(root.copy())
        stop, *trace = run(first, block.pattern, block.columns, x0, scale, once, 1 / block.noise, mean, root)
        return FilterPass(stop, mean, root, *(each[first:stop] for each in trace))


def places(groups: Sequence[RowGroups]) -> NDArray[np.intp]:
    """Piece, lane in it and component of each row (rows, 3), the pieces of all blocks counted through."""
    found, first = [], 0
    for each in groups:
        place = np.empty((*each.block.noise.shape, 3), dtype=np.intp)
        place[..., 2] = np.arange(place.shape[1])
        for k, piece in enumerate(each.pieces, first):
            place[piece.rows, :, 0], place[piece.rows, :, 1] = k, np.arange(len(piece.rows))[:, None]
        first += len(each.pieces)
        found.append(place.reshape(-1, 3))
    return np.concatenate(found)


def _parts(rows: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Rows in pieces: one of few, else as many as threads may want, none too large to be packed at once."""
    if len(rows) < FEW:
        return [rows] if len(rows) else []
    count = max(min(2 * len(rows) // FEW, MOST_PIECES), -(-len(rows) // LARGEST_PIECE))
    return np.array_split(rows, count)
