"""Which unknowns belong to one group of rows alone, such as a face's plane, and which are shared by all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Groups:
    """Which unknowns are shared (s,), and which belong to one group alone: an array (groups, k) for each size k."""

    shared: Index
    own: tuple[Index, ...]

    @cached_property
    def unknowns(self) -> int:
        """How many there are in all."""
        return self.shared.size + sum(each.size for each in self.own)

    @cached_property
    def place(self) -> tuple[Index, Index, Index]:
        """Of each unknown (n,): its size class (-1: shared), its group in it, its position there or in the corner."""
        kind, group, position = (np.full(self.unknowns, -1, dtype=np.intp) for _ in range(3))
        position[self.shared] = np.arange(self.shared.size)
        for c, own in enumerate(self.own):
            kind[own], group[own], position[own] = c, np.arange(len(own))[:, None], np.arange(own.shape[1])
        return kind, group, position

    def among(self, free: Index) -> Groups:
        """The same of some unknowns (m,), in ascending order, renumbered; those of a group stay together."""
        new = np.full(self.unknowns, -1, dtype=np.intp)
        new[free] = np.arange(free.size)
        kept: dict[int, list[Index]] = {}
        for own in self.own:
            for group in new[own]:
                left = group[group >= 0]
                if left.size:
                    kept.setdefault(left.size, []).append(left)
        shared = new[self.shared]
        return Groups(shared[shared >= 0], tuple(np.array(each) for _, each in sorted(kept.items())))


def grouped(columns: Sequence[Index], own: NDArray[np.bool_]) -> Groups:
    """Groups of the unknowns marked as own (n,): those that some rows see together are of one group.

    Args:
        columns: which unknowns each kind of row sees.
        own: what may be taken out; all else is shared.

    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n, mine = own.size, [seen[own[seen]] for seen in columns]
    pairs = [(seen[:-1], seen[1:]) for seen in mine if seen.size > 1]
    nothing = np.zeros(0, dtype=np.intp)
    one, other = (np.concatenate([nothing, *(pair[i] for pair in pairs)]) for i in range(2))
    _, label = connected_components(coo_array((np.ones(len(one)), (one, other)), shape=(n, n)), directed=False)
    members = np.flatnonzero(own)
    members = members[np.argsort(label[members], kind="stable")]
    starts = np.flatnonzero(np.diff(label[members], prepend=-1))
    by_size: dict[int, list[Index]] = {}
    for group in np.split(members, starts[1:]):
        if group.size:
            by_size.setdefault(group.size, []).append(group)
    return Groups(np.flatnonzero(~own), tuple(np.array(each) for _, each in sorted(by_size.items())))
