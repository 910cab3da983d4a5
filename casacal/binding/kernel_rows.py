"""The rows of all instruments on their kernels: rows that see the same unknowns are evaluated together, in pieces."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from casacal.array_types import Array, Index
from casacal.binding.blocks import Block
from casacal.kernels.rows import Piece
from casacal.least_squares.losses import Loss
from casacal.threads import shared_out

FEW = 8_192  # rows below which all stay together: threads would spend more on one another than they save
MOST_PIECES = 16
LARGEST_PIECE = 16_384
MANY_LANES = 50_000  # candidates times rows from which candidates are shared out
PIECES = 1024  # pieces whose sums are held at a time
STATES = 32  # candidates evaluated together, when there are many


class KernelRows:
    """Residuals, slopes and their sums over all rows.

    How rows fall into pieces depends on their number alone, and pieces are summed in order: results are the same
    whatever the number of threads.
    """

    def __init__(
        self,
        blocks: Sequence[Block],
        unknowns: int,
        backend: str | None,
        threads: int,
        packed: KernelRows | None = None,
    ) -> None:
        self.blocks, self._unknowns, self._asked, self._shared_by = tuple(blocks), unknowns, backend, threads
        self._packed = packed
        """The same rows with other noise, whose data are packed already."""
        self._kernels = [block.model.rows(backend) for block in blocks]
        self._threads = threads if sum(len(block.noise) for block in blocks) >= FEW else 1
        self._starts = np.cumsum([0, *(block.noise.size for block in blocks)])

    @property
    def backend(self) -> str:
        """Name of the back end in use."""
        return self._kernels[0].name

    def with_noise(self, blocks: Sequence[Block]) -> KernelRows:
        """The same rows with other noise; their data are packed once for all."""
        return KernelRows(blocks, self._unknowns, self._asked, self._shared_by, self._packed or self)

    @cached_property
    def noise(self) -> Array:
        """Standard deviation of each residual (rows,)."""
        each = [block.noise.ravel() for block in self.blocks]
        return each[0] if len(each) == 1 else np.concatenate(each)

    @cached_property
    def pieces(self) -> tuple[Piece, ...]:
        """Rows by instrument and pattern, packed for the kernels when first used."""
        if self._packed is not None:
            return tuple(
                replace(piece, lanes=piece.kernels.reweighted(piece.lanes, 1.0 / self.noise[piece.numbers].T))
                for piece in self._packed.pieces
            )
        found = []
        for block, kernels, first in zip(self.blocks, self._kernels, self._starts, strict=False):
            components = np.arange(block.noise.shape[1])
            for columns, constants, seen in zip(block.columns, block.constants, block.by_pattern, strict=True):
                for rows in _parts(seen):
                    lanes = kernels.lanes(block.rows(rows), block.noise[rows])
                    numbers = rows[:, None]  # of a million rows no copy is held that need not be
                    if first or components.size > 1:
                        numbers = first + numbers * components.size + components
                    found.append(Piece(kernels, lanes, numbers, columns, constants))
        return tuple(found)

    @property
    def places(self) -> Index:
        """Piece, lane in it and component of each row (rows, 3)."""
        found = np.empty((int(self._starts[-1]), 3), dtype=np.intp)
        for k, piece in enumerate(self.pieces):
            lanes, components = np.indices(piece.numbers.shape)
            found[piece.numbers] = np.stack([np.full_like(lanes, k), lanes, components], axis=-1)
        return found

    def residual(self, x: Array) -> Array:
        """Plain residuals (rows,)."""
        e = np.empty(int(self._starts[-1]))

        def fill(piece: Piece) -> None:
            e[piece.numbers] = piece.kernels.residual(piece.parameters(x), piece.lanes).T

        shared_out(fill, self.pieces, self._threads)
        return e

    def slopes(self, x: Array) -> Iterator[tuple[Piece, Array, Array]]:
        """Piece by piece, plain residuals (n, m) and slopes (n, m, z)."""
        for piece in self.pieces:
            e, j = piece.kernels.slopes(piece.parameters(x), piece.lanes)
            yield piece, e.T, j.transpose(2, 0, 1)

    def triangle(self, x: Array) -> Array:
        """R (k, n) with the J'J of the whitened Jacobian; few pieces are held at a time."""

        def of_piece(piece: Piece) -> Array:
            _, slopes = piece.kernels.slopes(piece.parameters(x), piece.lanes)
            whitened = slopes / self.noise[piece.numbers].T[:, None]
            own = np.linalg.qr(whitened.transpose(1, 0, 2).reshape(piece.columns.size, -1).T, mode="r")
            whole = np.zeros((len(own), self._unknowns))
            whole[:, piece.columns] = own
            return whole

        return np.asarray(np.linalg.qr(np.vstack(shared_out(of_piece, self.pieces, self._threads)), mode="r"))

    def costs(self, states: Array, loss: Loss | None = None) -> Array:
        """Half the whitened sum of squares, or the sum of a loss, at many x (m, n): (m,)."""

        def of_piece(piece: Piece, some: Array) -> Array:
            p, noise = np.ascontiguousarray(piece.parameters(some)), self.noise[piece.numbers].T
            if loss is None:
                return piece.kernels.costs(p, piece.lanes)
            return np.array([loss.cost(piece.kernels.residual(each, piece.lanes) / noise).sum() for each in p])

        def total(some: Array) -> Array:
            found = [of_piece(piece, some) for piece in self.pieces]
            return found[0] if len(found) == 1 else np.sum(found, axis=0)

        if len(states) * sum(len(block.noise) for block in self.blocks) < MANY_LANES:
            return total(states)
        few = [states[k : k + STATES] for k in range(0, len(states), STATES)]
        return np.concatenate(shared_out(total, few, self._shared_by))

    def sums(self, x: Array, loss: Loss | None = None) -> Iterator[tuple[Piece, float, Array]]:
        """Piece by piece, half the whitened sum of squares, and (J r)'(J r) (z + 1, z + 1); with a loss, weighted."""

        def part(piece: Piece) -> tuple[float, Array]:
            kernels, p, lanes = piece.kernels, piece.parameters(x), piece.lanes
            if loss is None:
                s = kernels.normal(p, lanes)
                return float(s[-1, -1]) / 2, s
            noise = self.noise[piece.numbers].T
            r = kernels.residual(p, lanes) / noise
            weighted = kernels.reweighted(lanes, np.sqrt(loss.weight(r)) / noise)  # a weight on r^2 is its root on r
            return float(loss.cost(r).sum()), kernels.normal(p, weighted)

        for k in range(0, len(self.pieces), PIECES):
            some = self.pieces[k : k + PIECES]
            for piece, (cost, s) in zip(some, shared_out(part, some, self._threads), strict=True):
                yield piece, cost, s


def _parts(rows: Index) -> list[Index]:
    """Rows in pieces: one of few, else as many as threads may want, none too large to be packed at once."""
    if len(rows) < FEW:
        return [rows] if len(rows) else []
    count = max(min(2 * len(rows) // FEW, MOST_PIECES), -(-len(rows) // LARGEST_PIECE))
    return np.array_split(rows, count)
