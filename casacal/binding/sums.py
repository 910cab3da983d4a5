"""Normal equations over all rows: in C, as one matrix, or as an arrow where labels are many."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.kernel_rows import FEW, KernelRows
from casacal.binding.slots import Slot
from casacal.kernels.native_rows import NativeKernels, NativeNormal, PackedPieces
from casacal.least_squares.arrow import Arrow, Groups, grouped
from casacal.least_squares.elimination import GroupRows
from casacal.least_squares.losses import Loss
from casacal.least_squares.objective import Normal

MOST_SUMS = 4_000_000
"""Numbers that the sums of all pieces may take: beyond, each piece sums what it sees alone."""

MANY = 300
"""Unknowns from which those of one label alone are taken out, one label after the other."""


class Sums:
    """Sums over rows at one x (n,), about x0, scale and the prior's information; no whole Jacobian is ever held."""

    def __init__(
        self, rows: KernelRows, slots: Sequence[Slot], about: tuple[Array, Array, Array], threads: int
    ) -> None:
        self._rows, self._about = rows, about
        self._threads = threads if rows.starts[-1] >= FEW else 1
        self.groups = _groups([columns for block in rows.blocks for columns in block.columns], slots)

    @cached_property
    def packed(self) -> PackedPieces | None:
        """All rows for C; None where C does not evaluate all."""
        pieces = self._rows.pieces
        in_c = all(isinstance(piece.kernels, NativeKernels) for piece in pieces)
        return PackedPieces(pieces) if pieces and in_c else None

    @cached_property
    def native(self) -> NativeNormal | None:
        """Sums in C; None where some rows are not evaluated in C, or pieces and unknowns are many."""
        n = self._about[0].size
        if self.groups is not None or self.packed is None or len(self.packed.pieces) * n**2 > MOST_SUMS:
            return None
        return NativeNormal(self.packed, *self._about, self._threads)

    def normal(self, x: Array, loss: Loss | None = None) -> Normal:
        """Cost, gradient (n,) and information (n, n) of the data; rows weighted by a loss."""
        if loss is None and self.native is not None:
            return Normal(*self.native.sums(x))
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
        """Whitened Jacobian, rows that see shared unknowns alone first, then group by group; weighted by a loss."""
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
