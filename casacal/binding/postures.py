"""Where a bound arm is at joint values that no sample visited: tips, their slopes by the unknowns, flange poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.blocks import Block
from casacal.kinematics import stacked_poses


class Postures:
    """An arm with its instruments, at any joint values."""

    blocks: tuple[Block, ...]
    """The rows of each instrument."""

    def tips(self, x: Array, joints: Array, instrument: int = 0) -> Array:
        """Tips (N, 3; mm) at joint values (N, n; rad, mm) and reading zero."""
        return np.asarray(self.blocks[instrument].posture("tip", x, joints)[0])

    def tip_jacobian(self, x: Array, joints: Array, instrument: int = 0, by: NDArray[np.intp] | None = None) -> Array:
        """Derivative (3 N, n) of those tips by x, or by some (s,) of its unknowns, in units of mm per unit of x."""
        block = self.blocks[instrument]
        _, slopes = block.posture("tip_jacobian", x, joints)
        by = np.arange(x.size) if by is None else by
        _, inside, seen = np.intersect1d(by, block.columns[0], return_indices=True)
        jacobian = np.zeros((3 * len(joints), by.size))
        jacobian[:, inside] = slopes.reshape(len(jacobian), -1)[:, seen]
        return jacobian

    def poses(self, x: Array, joints: Array, instrument: int = 0) -> Array:
        """Flange poses (N, 4, 4; mm) at joint values (N, n; rad, mm)."""
        return stacked_poses(self.blocks[instrument].posture("pose", x, joints)[0])
