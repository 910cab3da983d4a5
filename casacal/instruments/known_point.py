"""A tool's tip at points of a plate whose places on it are known: holes, dowels, engraved crosses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from casacal.errors import ProblemError
from casacal.instruments.instrument import Words
from casacal.instruments.point_in_frame import AXES, PointInFrame
from casacal.values import FrozenMapping, is_real


@dataclass(frozen=True, kw_only=True)
class KnownPoint(PointInFrame):
    """A tip brought to points of a plate, which the column "point" names; three residuals per row.

    Args:
        noise_std: how well the tip is brought to a point, each coordinate, mm.
        points: where each point stands on the plate (3, mm), by its label; three that do not lie on one line at least.
        tool: the tip in the flange frame, mm.
        station: transform from the robot's base to the plate's frame; proposed from the data when not given. Its
            inverse is the plate as a work object.

    Raises ProblemError for points that do not fix where the plate is.

    """

    points: Mapping[str, Sequence[float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        given = self.points.items() if isinstance(self.points, Mapping) else [("", self.points)]
        for label, point in given:
            if not isinstance(point, (tuple, list, np.ndarray)) or len(point) != 3 or not all(map(_is_finite, point)):
                raise ProblemError(
                    f"Point '{label}' of the plate is {point!r}", "Give x, y and z of each point in mm, by its label"
                )
        triples = {str(label): tuple(float(value) for value in point) for label, point in given}
        object.__setattr__(self, "points", FrozenMapping(triples))
        known = np.array(list(triples.values())).reshape(-1, 3)
        if len(known) < 3 or np.linalg.matrix_rank(known - known.mean(axis=0), tol=1e-6) < 2:
            raise ProblemError(
                f"The plate has {len(known)} points, and they do not say how it lies",
                "Give three or more that do not lie on one line",
            )

    @property
    def known_columns(self) -> Mapping[str, Mapping[str, float]]:
        """Coordinates of the row's point on the plate, mm."""
        return {axis: {label: point[i] for label, point in self.points.items()} for i, axis in enumerate(AXES)}

    @property
    def known_by(self) -> str:
        """The point."""
        return "point"

    @property
    def knows_every_label(self) -> bool:
        """True: a point that is not listed stands nowhere."""
        return True

    @property
    def groups(self) -> str:
        """The point."""
        return "point"

    @property
    def words(self) -> Words:
        """Coordinates of points."""
        return Words("residual of each coordinate", "mm", "points", "plate fitted alone", group="point", accuracy=True)


def _is_finite(value: object) -> bool:
    return is_real(value) and bool(np.isfinite(value))  # type: ignore[call-overload]
