"""Normal equations over the rows of all instruments: in C, as one matrix, or as an arrow where labels are many."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.row_groups import FEW, Piece, RowGroups
from casacal.binding.slots import Slot
from casacal.kernels.backend import all_rows_in_c
from casacal.kernels.native_rows import NativeNormal, PackedPieces
from casacal.least_squares.arrow import Arrow, Groups, grouped
from casacal.least_squares.elimination import GroupRows
from casacal.least_squares.losses import Loss
from casacal.least_squares.objective import Normal

MOST_SUMS = 4_000_000
"""Numbers that the sums of all pieces may take: beyond, each piece sums what it sees alone."""

COMPACT = 50_000
"""Rows beyond which no whole Jacobian is held."""

MANY = 300
"""Unknowns from which those of one label alone are taken out, one label after the other."""


class Sums:
    """Sums over rows at one x (n,); the whole Jacobian is never held."""

    def __init__(
        self, rows: Sequence[RowGroups], slots: Sequence[Slot], about: tuple[Array, Array, Array], threads: int
    ) -> None:
        self._rows, self._about, self._threads = rows, about, threads
        self.count = sum(each.block.noise.size for each in rows)
        self.groups = _groups([columns for each in rows for columns in each.block.columns], slots)

    @cached_property
    def packed(self) -> PackedPieces | None:
        """All rows for C; None where C does not evaluate all."""
        return all_rows_in_c([each.native_pieces for each in self._rows])

    @cached_property
    def native(self) -> NativeNormal | None:
        """Sums in C; None where some rows are not evaluated in C, or pieces and unknowns are many."""
        n = self._about[0].size
        if self.groups is not None or self.packed is None or len(self.packed.pieces) * n**2 > MOST_SUMS:
            return None
        return NativeNormal(self.packed, *self._about, self._threads if self.count >= FEW else 1)

    def normal(self, x: Array, loss: Loss | None = None) -> Normal:
        """Cost, gradient (n,) and information (n, n) of the data; rows weighted by a loss."""
        if loss is None and self.native is not None:
            return Normal(*self.native.sums(x))
        information = np.zeros((x.size, x.size)) if self.groups is None else Arrow.zero(self.groups)
        cost, gradient = 0.0, np.zeros(x.size)
        for rows in self._rows:
            for piece, some, s in rows.sums(x, loss):
                cost += some
                gradient[piece.columns] += s[:-1, -1]
                if isinstance(information, Arrow):
                    information.add(piece.columns, s[:-1, :-1])
                else:
                    information[piece.square] += s[:-1, :-1]
        return Normal(cost, gradient, information)

    def triangles(self, x: Array) -> Array:
        """R (k, n) with the J'J of the whitened Jacobian."""
        return np.asarray(
            np.linalg.qr(np.vstack([part for rows in self._rows for part in rows.triangles(x)]), mode="r")
        )

    def group_rows(self, x: Array, loss: Loss | None = None) -> Iterator[GroupRows]:
        """Whitened Jacobian, rows that see shared unknowns alone first, then group by group; weighted by a loss."""
        groups = self.groups
        assert groups is not None
        kind, group, _ = groups.place
        kept: dict[tuple[int, int], list[GroupRows]] = {}
        for piece, numbers, slopes in self._whitened(x, loss):
            mine = np.flatnonzero(kind[piece.columns] >= 0)
            part = _of_group(groups, piece.columns, mine, numbers, slopes)
            if mine.size:
                first = piece.columns[mine[0]]
                kept.setdefault((int(kind[first]), int(group[first])), []).append(part)
            else:
                yield part
        for parts in kept.values():
            rows = np.concatenate([part.rows for part in parts])
            own, shared = np.vstack([part.own for part in parts]), np.vstack([part.shared for part in parts])
            yield GroupRows(rows, parts[0].members, parts[0].among, own, shared)

    def _whitened(self, x: Array, loss: Loss | None) -> Iterator[tuple[Piece, NDArray[np.intp], Array]]:
        """Piece by piece, numbers of its residuals (m,) and their whitened slopes (m, z), weighted by a loss."""
        before = 0
        for rows in self._rows:
            components = rows.block.noise.shape[1]
            for piece, e, slopes in rows.slopes(x):
                noise = rows.block.noise[piece.rows]
                weight = 1.0 if loss is None else np.sqrt(loss.weight(e / noise))
                numbers = before + components * piece.rows[:, None] + np.arange(components)
                yield piece, numbers.ravel(), (slopes * (weight / noise)[..., None]).reshape(-1, piece.columns.size)
            before += rows.block.noise.size


def _of_group(
    groups: Groups, columns: NDArray[np.intp], mine: NDArray[np.intp], numbers: NDArray[np.intp], slopes: Array
) -> GroupRows:
    """Rows with slopes (m, z) by some unknowns (z,), of which those at `mine` are one group's own."""
    kind, group, position = groups.place
    theirs = np.setdiff1d(np.arange(columns.size), mine)
    shared = np.zeros((len(slopes), groups.shared.size))
    shared[:, position[columns[theirs]]] = slopes[:, theirs]
    members = groups.own[kind[columns[mine[0]]]][group[columns[mine[0]]]] if mine.size else mine
    own = np.zeros((len(slopes), members.size))
    own[:, position[columns[mine]]] = slopes[:, mine]
    return GroupRows(numbers, members, groups.shared, own, shared)


def _groups(columns: Sequence[NDArray[np.intp]], slots: Sequence[Slot]) -> Groups | None:
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
