"""Joints that give under torques that were measured: an arm's own torque sensors say how much."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.discrepancy.columns_of import check_columns_of, read_columns_of
from casacal.discrepancy.effect import Effect, Here, Site, weighted
from casacal.discrepancy.survey import Rows
from casacal.kinematics import Expression
from casacal.unknowns import Parameter


@dataclass(frozen=True, kw_only=True)
class MeasuredGive(Effect):
    """Every joint stands off by its own give times the torque that stands in a column of the samples.

    Away from the rows no torque is known, so that `predict` and `compensate` count it as an error.

    Args:
        columns_of: the column of each joint's torque, in Nm, such as ("torque1_Nm", ...); one for each joint.
        size: of a joint's give, rad/Nm (mm/N of a sliding one).
        doubt: times by which that may be off.

    """

    columns_of: tuple[str, ...]
    size: float = 1e-4
    doubt: float = 10.0

    moves = True
    elastic = True
    most = 100.0
    key = "yield"
    words = "giving under measured torque"

    def __post_init__(self) -> None:
        object.__setattr__(self, "columns_of", tuple(self.columns_of))

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """The give of each joint, rad/Nm."""
        check_columns_of(self.columns_of, len(site.robot.axes), "torques")
        return {self.key: weighted(np.ones(len(self.columns_of)), self.size, "rad")}

    def columns(self, site: Site) -> tuple[str, ...]:
        """The torque about each joint."""
        del site
        return tuple(f"torque_{j + 1}" for j in range(len(self.columns_of)))

    def values(self, site: Site, rows: Rows) -> Mapping[str, Array]:
        """As the samples say; raises ProblemError where they do not."""
        told = read_columns_of(rows.samples, self.columns_of, len(site.robot.axes), "torques", "numbers, in Nm")
        return dict(zip(self.columns(site), told.T, strict=True))

    def joints(self, here: Here) -> Expression:
        """The give times the torque."""
        u = getattr(here.p, self.key)
        return ca.vertcat(*(u[j] * getattr(here.row, name) for j, name in enumerate(self.columns(here))))
