"""A point fixed to the flange: the tip of a spike, the centre of a ball, a reflector, the end of a wire."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.instruments.instrument import Instrument
from casacal.kinematics import Expression, transform_point
from casacal.unknowns import Parameter
from casacal.values import is_real


def tool_point(
    x: float = 0.0, y: float = 0.0, z: float = 0.0, *, prior_std: float = math.inf, free: bool = True
) -> Parameter:
    """Tool point (3, mm) in the flange frame, with components tool_x, tool_y, tool_z; its prior is flat by default."""
    return Parameter((x, y, z), unit="mm", prior_std=prior_std, free=free, labels=("_x", "_y", "_z"))


@dataclass(frozen=True, kw_only=True)
class ToolTip(Instrument):
    """What instruments share that see one point of the flange; each says what it sees of it.

    Args:
        noise_std: standard deviation of each residual, mm.
        tool: the point in the flange frame, mm.

    Raises ProblemError for a noise that is not positive.

    """

    noise_std: float
    tool: Parameter = tool_point()

    def __post_init__(self) -> None:
        if not is_real(self.noise_std) or not 0 < self.noise_std < math.inf:
            raise ProblemError(
                f"noise_std of {type(self).__name__} is {self.noise_std!r}", "Give a positive number of mm"
            )

    @property
    def residual_std(self) -> float:
        """Noise of each residual, mm."""
        return self.noise_std

    def tip(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Return the point in the base frame (3, mm)."""
        del row
        return transform_point(pose, p.tool)


def proposed_point(per: str) -> Parameter:
    """A point (3, mm) in the base frame for each value of a label column, which the rows propose; its prior is flat."""
    return Parameter(None, unit="mm", labels=("_x", "_y", "_z"), per=per)


def centre_of(points: Array, distances: Array, *, zero: bool = False) -> Array:
    """Point (3, mm) from which points (N, 3) lie at distances (N,), or at these but for one number if `zero`.

    |p|^2 - 2 p'c + |c|^2 = d^2 is linear in c and |c|^2; a common zero adds 2 d. Where the points leave a direction
    open, as on a plane, c lies in their midst along it.
    """
    middle = points.mean(axis=0)
    p = points - middle
    columns = [-2 * p, np.ones((len(p), 1))] + ([2 * distances[:, None]] if zero else [])
    solved, *_ = np.linalg.lstsq(np.hstack(columns), distances**2 - (p**2).sum(axis=1), rcond=1e-9)
    return np.asarray(middle + solved[:3])
