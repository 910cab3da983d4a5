"""Groups of unknowns taken out of a Jacobian by orthogonal projection, which loses no digit as a difference would.

With A_f = U S V' the columns of a group's own unknowns and A_s those of the shared ones, the rows (I - U U') A_s tell
what the group's rows say of the shared unknowns when its own are free.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from casacal.array_types import Array, Index
from casacal.least_squares.arrow import Arrow
from casacal.least_squares.linalg import revealed_solution, svd

TOGETHER = 4096  # rows stacked before a triangle takes their place


@dataclass(frozen=True, eq=False)
class GroupRows:
    """Rows (m,) of one group: its own unknowns (k,), the shared ones (s,), and columns (m, k), (m, s) of both."""

    rows: Index
    members: Index
    among: Index
    own: Array
    shared: Array

    def scaled(self, scale: Array) -> GroupRows:
        """The same by unknowns in other units (n,)."""
        return replace(self, own=self.own * scale[self.members], shared=self.shared * scale[self.among])

    def renumbered(self, new: Index) -> GroupRows:
        """The same in other unknowns, those at -1 left out (n,)."""
        own, shared = new[self.members] >= 0, new[self.among] >= 0
        left = self.own[:, own], self.shared[:, shared]
        return GroupRows(self.rows, new[self.members[own]], new[self.among[shared]], *left)

    def held(self, information: Array) -> GroupRows:
        """The same with rows of what holds the own unknowns besides, of this information (k,)."""
        if not information.any():
            return self
        own = np.vstack([self.own, np.diag(np.sqrt(information))])
        nothing = np.zeros((len(own) - len(self.own), self.among.size))
        return replace(self, own=own, shared=np.vstack([self.shared, nothing]))


@dataclass(frozen=True, eq=False)
class TakenOut:
    """A group taken out: rows (m, s) left of the shared unknowns, G = A_f+ A_s (k, s), and (A_f' A_f)+ (k, k)."""

    rows: Array
    along: Array
    inverse: Array


def taken_out(rows: GroupRows) -> TakenOut:
    """Take a group's own unknowns out; directions of them that its rows do not see stay where they are."""
    if not rows.members.size:
        return TakenOut(rows.shared, np.zeros((0, rows.shared.shape[1])), np.zeros((0, 0)))
    left, values, right = svd(rows.own)
    seen = values > rows.members.size * np.finfo(float).eps * values.max(initial=0.0)
    left, values, right = left[:, seen], values[seen], right[seen]
    within = left.T @ rows.shared
    return TakenOut(
        rows.shared - left @ within, right.T @ (within / values[:, None]), (right.T / values**2) @ right
    )  # fmt: skip


def triangle(parts: Iterable[Array], columns: int) -> Array:
    """R (k, columns) with the A'A of all parts (m, columns), few of which are held at a time."""
    kept: list[Array] = [np.zeros((0, columns))]
    held = 0
    for part in parts:
        kept.append(part)
        held += len(part)
        if held > TOGETHER:
            kept, held = [np.asarray(np.linalg.qr(np.vstack(kept), mode="r"))], columns
    return np.asarray(np.linalg.qr(np.vstack(kept), mode="r"))


def revealed_step(
    parts: Iterable[GroupRows], information: Arrow, prior: Array, gradient: Array, damping: float
) -> tuple[Array, float, float] | None:
    """What `revealed_solution` finds, by taking groups out; None where not all is finite.

    parts: the Jacobian A, group by group. information: A'A and the prior's (n,), undamped. Returns s (n,), its squared
    length and the fall that it predicts.
    """
    shared, found, gone, rows = information.groups.shared, np.zeros(gradient.size), [], []
    reduced = gradient[shared].copy()
    for part in parts:
        if not (np.isfinite(part.own).all() and np.isfinite(part.shared).all()):
            return None
        out = taken_out(part.held(prior[part.members] + damping))
        reduced -= out.along.T @ gradient[part.members]
        rows.append(out.rows)
        gone.append((part.members, out.along, out.inverse))
    stacked = np.vstack([triangle(rows, shared.size), np.diag(np.sqrt(prior[shared]))])
    solved = revealed_solution(stacked, reduced, damping)
    if solved is None:
        return None
    found[shared] = solved[0]
    for members, along, inverse in gone:
        found[members] = -inverse @ gradient[members] - along @ solved[0]
    squared = float(found @ (information @ found))
    return found, squared, -float(gradient @ found) - squared / 2
