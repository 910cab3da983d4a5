"""One measurement as somebody made it, and rows of several, checked against what the problem asks for."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.errors import CasacalError, UnknownNameError, came
from casacal.planning.route import FIT, Route
from casacal.samples.layout import LARGEST, Layout
from casacal.samples.samples import Samples
from casacal.values import FrozenMapping, Value, is_real, read_only


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

    @staticmethod
    def of(samples: Samples, k: int, number: int | None = None, purpose: str = FIT, *, kept: bool = False) -> Touch:
        """A row of samples."""
        columns = {name: float(values[k]) for name, values in samples.columns.items()}
        labels = {name: labels[k] for name, labels in samples.labels.items()}
        return Touch(samples.joints[k], columns, labels, number, purpose, kept)


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
    return tuple(Touch.of(plan.samples, k, k + 1, purpose) for k, purpose in enumerate(plan.purposes))


def joints_of(q: Sequence[float] | Array, layout: Layout) -> Array:
    """Joint values (n,), rad and mm; raises CasacalError for others."""
    try:
        values = np.asarray(q, dtype=np.float64)
    except (TypeError, ValueError):
        raise CasacalError(f"Got {came(q)} as joint values", f"Give {len(layout.joints)} numbers") from None
    if values.shape != (len(layout.joints),) or not np.isfinite(values).all():
        raise CasacalError(
            f"Joint values have the shape {values.shape}, or some are not finite",
            f"Give {len(layout.joints)} numbers, rad and mm",
        )
    for i, (value, kind) in enumerate(zip(values, layout.joints, strict=True), 1):
        if abs(value) > LARGEST[kind]:
            raise CasacalError(f"Joint {i} is {value:g}, which no robot can take", "Give rad, and mm where it slides")
    return values


def columns_of(reading: float | Mapping[str, float] | None, layout: Layout) -> dict[str, float]:
    """What the instrument read by column; raises CasacalError where it does not fit."""
    asked = list(layout.columns)
    wanted = ", ".join(asked) or "no reading at all"
    if reading is None or isinstance(reading, Mapping):
        given: Mapping[str, float] = reading or {}
    elif len(asked) != 1:
        raise CasacalError(f"Got one reading, but a touch has {wanted}", "Give them by name")
    else:
        given = {asked[0]: reading}
    for name in given:
        if name not in asked:
            raise UnknownNameError("column of a touch", name, asked)
    for name in asked:
        value = given.get(name)
        if not is_real(value) or not math.isfinite(value):  # type: ignore[arg-type]
            raise CasacalError(f"Got {came(value)} as the {name}", f"Give a number; a touch has {wanted}")
    return {name: float(given[name]) for name in asked}


def labels_of(plane: str | Mapping[str, str] | None, layout: Layout, planned: Touch | None) -> dict[str, str]:
    """Labels by column, where none is given those of the plan; raises CasacalError where they do not fit."""
    asked = list(layout.labels)
    if isinstance(plane, str):
        if len(asked) != 1:
            raise CasacalError(f"Got the label '{plane}', but a touch has {', '.join(asked) or 'none'}", "Give it so")
        given: Mapping[str, str] = {asked[0]: plane.strip()}
    else:
        given = {} if plane is None else plane
    for name in given:
        if name not in asked:
            raise UnknownNameError("label of a touch", name, asked)
    found = {name: given.get(name, "" if planned is None else planned.labels[name]) for name in asked}
    for name, label in found.items():
        if not isinstance(label, str) or not label:
            raise CasacalError(f"The touch has no {name}", "Name it")
    return found
