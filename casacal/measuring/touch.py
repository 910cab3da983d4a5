"""One measurement as somebody made it, and rows of several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.planning.route import FIT, Route
from casacal.samples.samples import Samples
from casacal.values import FrozenMapping, Value, read_only


@dataclass(frozen=True, eq=False)
class Touch(Value):
    """One measurement: joints (n,; rad, mm), what was read by column, labels by column.

    number: of the plan's touch that it answers, or None. purpose: "fit", "again" or "check", as in a plan.
    kept: whether somebody looked at it again and said that it is right.
    """

    joints: Array
    columns: Mapping[str, float]
    labels: Mapping[str, str]
    number: int | None = None
    purpose: str = FIT
    kept: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", read_only(np.array(self.joints, dtype=np.float64)))
        object.__setattr__(self, "columns", FrozenMapping({k: float(v) for k, v in self.columns.items()}))
        object.__setattr__(self, "labels", FrozenMapping(self.labels))


def rows_of(touches: Sequence[Touch]) -> Samples:
    """The touches as rows, in their order; one or more."""
    first = touches[0]
    return Samples(
        np.array([touch.joints for touch in touches]),
        {name: np.array([touch.columns[name] for touch in touches]) for name in first.columns},
        {name: [touch.labels[name] for touch in touches] for name in first.labels},  # type: ignore[misc]
        tuple(range(1, len(touches) + 1)),
        {},
        "the session",
        "",
    )


def planned_touches(plan: Route) -> tuple[Touch, ...]:
    """The touches of a plan, numbered from 1, with the readings to expect."""
    samples = plan.samples
    return tuple(
        Touch(
            samples.joints[k],
            {name: float(values[k]) for name, values in samples.columns.items()},
            {name: labels[k] for name, labels in samples.labels.items()},
            k + 1,
            plan.purposes[k],
        )
        for k in range(len(plan))
    )
