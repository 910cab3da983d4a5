"""An ABB IRB 120, three points of whose hand a coordinate measuring machine reads, at rest and in every posture."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca

from casacal import Frame, Instrument, Problem, Robot
from casacal.model import Words
from casacal.model.kinematics import transform_point

AT_REST = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))


@dataclass(frozen=True)
class CarriedPoint(Instrument):
    """A point of the hand where it stood at the zero posture (p), and where the posture has carried it (x, y, z)."""

    noise_std: float
    rest: Frame = Frame(AT_REST, prior_std=(0.1, 30.0))

    columns = dict.fromkeys(("px", "py", "pz", "x", "y", "z"), "length")
    words = Words("residual of each coordinate", "mm", "points", "the motion at rest fitted alone", accuracy=True)

    @property
    def unknowns(self) -> Mapping[str, Frame]:
        """A fixed motion of all points: where they were at rest is said in a frame that is nearly the base."""
        return {"rest": self.rest}

    @property
    def datum(self) -> tuple[str, ...]:
        """The same."""
        return ("rest",)

    @property
    def residual_std(self) -> float:
        """Noise of each coordinate, mm."""
        return self.noise_std

    def residual(self, pose: Any, p: Any, row: Any) -> Any:
        """Where the arm as modelled carries the point, less where it was seen (3, mm)."""
        carried = transform_point(pose, transform_point(p.rest, ca.vertcat(row.px, row.py, row.pz)))
        return carried - ca.vertcat(row.x, row.y, row.z)


AXES = (
    ((0, 0, 1), (0, 0, 0)),
    ((0, 1, 0), (0, 0, 290)),
    ((0, 1, 0), (0, 0, 560)),
    ((1, 0, 0), (0, 0, 630)),
    ((0, 1, 0), (302, 0, 630)),
    ((1, 0, 0), (0, 0, 630)),
)
"""Direction and a point (mm) of each axis at the zero posture, where the home is the identity."""
robot = Robot.from_screws(
    "IRB 120",
    axes=[axis for axis, _ in AXES],
    points=[point for _, point in AXES],
    home=AT_REST,
    length_std=30.0,
    angle_std=0.1,
)
problem = Problem(robot, CarriedPoint(noise_std=0.1))
