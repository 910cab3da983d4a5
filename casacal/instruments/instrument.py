"""What every instrument provides."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.kinematics import Expression, position
from casacal.unknowns import Unknown

Dimension = Literal["length", "angle", "number"]


@dataclass(frozen=True)
class Sight:
    """What the nominal robot says about the rows that share one instance of an unknown."""

    poses: Array
    """Nominal flange poses, (N, 4, 4), mm."""
    tips: Array
    """Nominal tips, (N, 3), mm."""
    columns: Mapping[str, Array]
    """The rows' own columns and those known from labels, each (N,), in mm, rad or the user's unit."""


class Instrument(ABC):
    """A way of measuring: the columns it reads, its own unknowns, and a signed smooth residual.

    A subclass gives `residual` and overrides what differs from the defaults below.
    """

    @property
    def columns(self) -> Mapping[str, Dimension]:
        """Columns it reads from a row, beside the joints: name to dimension."""
        return {}

    @property
    def known_columns(self) -> Mapping[str, Mapping[str, float]]:
        """Columns that follow from the row's `known_by` label instead of being read: name to label to value, else 0."""
        return {}

    @property
    def known_by(self) -> str:
        """The label column that `known_columns` follow from."""
        return "plane"

    def instance(self, key: str, label: str) -> str:
        """Which instance of an unknown a label shares; its own unless overridden."""
        del key
        return label

    @property
    def refused_columns(self) -> Mapping[str, str]:
        """Columns that contradict the declaration: name to the sentence that says why."""
        return {}

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        """Its own unknowns: planes, tool, zero."""
        return {}

    @property
    def datum(self) -> tuple[str, ...]:
        """Keys of the unknowns that only say where the touched or watching thing stands; the control M0 fits these."""
        return ()

    @property
    def column_stds(self) -> Mapping[str, float]:
        """Standard deviation of the error of each column, in mm, rad or the user's unit."""
        return {}

    @property
    def residual_std(self) -> float:
        """Standard deviation of what the residual sees beside errors of columns and joints, in its unit."""
        return 0.0

    @abstractmethod
    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Signed, smooth residual: a scalar or a column of scalars.

        Args:
            pose: 4x4 flange pose, mm.
            p: values of the robot's parameters and of this instrument's unknowns, by name.
            row: values of `columns`, by name.

        """

    def tip(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Where the instrument touches or is watched (3, mm); the flange itself unless overridden."""
        del p, row
        return position(pose)

    def propose(self, key: str, sight: Sight) -> Array:
        """Nominal of an unknown that was declared without one, from what the nominal robot says.

        Raises ProblemError when this instrument cannot propose it.
        """
        del sight
        raise ProblemError(f"Unknown '{key}' has no nominal value", "Declare one: this instrument cannot propose it")
