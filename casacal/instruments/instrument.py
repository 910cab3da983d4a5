"""A way of measuring: the columns it reads, its own unknowns, and a signed smooth residual."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.instruments.description import UNIT_MISTAKES, Dimension, Probe, ResidualBlock, Sight, Suspect, Words
from casacal.kinematics import Expression, position
from casacal.unknowns import Unknown
from casacal.user_code import Portable


class Instrument(Portable, ABC):
    """A way of measuring: the columns it reads, its own unknowns, and a signed smooth residual.

    A subclass gives `residual`, mostly `columns`, `unknowns` and its noise (`residual_std` or `column_stds`), and
    overrides what differs from the defaults below. A subclass that is a frozen dataclass can have its unknowns held or
    given other priors by `Problem.fix` and `Problem.with_prior`.
    """

    @abstractmethod
    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Signed, smooth residual: a scalar or a column of scalars.

        Args:
            pose: 4x4 flange pose, mm.
            p: values of the robot's parameters and of this instrument's unknowns, by name.
            row: values of `columns`, by name.

        Returns:
            A scalar or a column (m, 1) of scalars, in the unit of its noise: mm for the instruments that are built in.

        """

    @property
    def columns(self) -> Mapping[str, Dimension]:
        """Columns it reads from a row, beside the joints: name to dimension."""
        return {}

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
        """Keys of the unknowns that only say where the touched or watching thing stands; the control M0 fits these.

        By default the unknowns whose prior is flat: nobody knew beforehand where such a thing stands.
        """
        return tuple(key for key, u in self.unknowns.items() if u.size and not np.isfinite(u.prior_stds).any())

    @property
    def column_stds(self) -> Mapping[str, float]:
        """Standard deviation of the error of each column, in mm, rad or the user's unit."""
        return {}

    @property
    def residual_std(self) -> float:
        """Standard deviation of what the residual sees beside errors of columns and joints, in its unit."""
        return 0.0

    @property
    def blocks(self) -> tuple[ResidualBlock, ...]:
        """Parts of the residual that differ in unit or noise, in order; none where `residual_std` says it all."""
        return ()

    @property
    def begins_at(self) -> Mapping[str, float]:
        """Readings from which simulated ones are looked for, where zero is none."""
        return {}

    def as_read(self, columns: Mapping[str, Array]) -> Mapping[str, Array]:
        """Simulated readings (N,) by name as a device would say them: of those that mean the same, one."""
        return columns

    def stands(self, key: str, near: Array, normal: Array) -> Array:
        """Nominal of an unknown that was declared without one where it is simulated, near a place (3, mm)."""
        return self.unknowns[key].placed(near, normal)

    def tip(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Where the instrument touches or is watched (3, mm); the flange's origin unless overridden."""
        del p, row
        return position(pose)

    def plunger_direction(self, pose: Expression, p: Any) -> Expression | None:
        """Direction (3) of a plunger in the base frame, out of the tool; None for an instrument without one."""
        del pose, p
        return None

    def propose(self, key: str, sight: Sight) -> Array:
        """Nominal of an unknown that was declared without one, from what the nominal robot says.

        Raises ProblemError when this instrument cannot propose it.
        """
        del sight
        raise ProblemError(
            f"Unknown '{key}' of {type(self).__name__} has no nominal value",
            "Give it one, or override `propose`, which finds it from the samples",
        )

    @property
    def known_columns(self) -> Mapping[str, Mapping[str, float]]:
        """Columns that follow from the row's `known_by` label instead of being read: name to label to value, else 0."""
        return {}

    @property
    def known_by(self) -> str:
        """The label column that `known_columns` follow from."""
        return "plane"

    @property
    def knows_every_label(self) -> bool:
        """Whether a label that `known_columns` do not list is a mistake; by default it stands for zero."""
        return False

    def instance(self, key: str, label: str) -> str:
        """Which instance of an unknown a label shares; its own unless overridden."""
        del key
        return label

    @property
    def groups(self) -> str | None:
        """The label column by which rows are drawn and listed; by default the first that its unknowns differ by."""
        return next((unknown.per for unknown in self.unknowns.values() if unknown.per is not None), None)

    @property
    def words(self) -> Words:
        """How reports call what it measures."""
        return Words(before=f"{' and '.join(self.datum)} fitted alone" if self.datum else "nothing fitted")

    @property
    def probe(self) -> Probe | None:
        """What touches flat faces; None for an instrument that measures otherwise."""
        return None

    @property
    def suspects(self) -> tuple[Suspect, ...]:
        """Mistakes in its columns that `check` undoes one by one to see whether all fits then: units, by default."""
        lengths = tuple(name for name, dimension in self.columns.items() if dimension == "length")
        if not lengths:
            return ()
        fix = "Correct the unit in the column's name"
        return tuple(
            Suspect("unit of the readings", f"the readings seem to be {words}", fix, lengths, factor)
            for factor, words in UNIT_MISTAKES.items()
        )

    def with_faces_by_label(self) -> Instrument | None:
        """The same with a face of its own for each label, for `cures` that add one; None where that means nothing."""
        return None

    def with_step(self, label: str, on: str, height: float) -> Instrument | None:
        """The same with a face at a known height (mm) on another one; None where that means nothing."""
        del label, on, height
        return None
