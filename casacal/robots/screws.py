"""Product of exponentials: the axes of all joints in the base frame, and the flange's pose, at zero joint values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from casacal.errors import ProblemError
from casacal.kinematics import Expression, chain, screw, slide
from casacal.robots.conventions import Conventions
from casacal.robots.joints import Joint
from casacal.unknowns import Direction, Frame, Parameter, Unknown
from casacal.unknowns.unknown import PRIOR_STD

Triple = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Screws:
    """axes: direction (3,) of each joint; points: a point (3, mm) on each; home: flange pose (4x4, mm), all at q = 0.

    pose(q) = e^[S_1 q_1] ... e^[S_n q_n] home, eq (4.14) of Lynch & Park, Modern Robotics (2017). A sliding joint
    has no place, so its point plays no part. Raises ProblemError when the columns differ in length.
    """

    name: str
    axes: tuple[Triple, ...]
    points: tuple[Triple, ...]
    home: tuple[tuple[float, ...], ...]
    joints: tuple[Joint, ...]
    conventions: Conventions | None = None

    def __post_init__(self) -> None:
        count = len(self.joints)
        if not len(self.axes) == len(self.points) == count:
            raise ProblemError(
                f"The screws of '{self.name}' are {len(self.axes)} axes and {len(self.points)} points for {count} "
                "joints",
                "Give one of each per joint",
            )
        for what, rows in (("axis", self.axes), ("point", self.points)):
            for i, row in enumerate(rows, 1):
                if len(row) != 3:
                    raise ProblemError(f"The {what} of joint {i} of '{self.name}' is {row}", "Give three numbers")
        if self.conventions is not None:
            self.conventions.check_joints(count, self.name)

    def pose(self, p: Any, q: Expression) -> Expression:
        """Flange pose (4x4, mm) at `p.axis1`, `p.point1`, ..., `p.zero`, `p.home` and joint values q."""
        q = q if self.conventions is None else self.conventions.to_model(q)
        links, turned = [], 0
        for i, joint in enumerate(self.joints):
            axis = getattr(p, f"axis{i + 1}")
            if joint.kind == "prismatic":
                links.append(slide(axis, q[i]))
            else:
                links.append(screw(axis, getattr(p, f"point{i + 1}"), q[i] + p.zero[turned]))
                turned += 1
        return chain(*links, p.home)

    def parameters(self, length_std: float | None, angle_std: float | None) -> dict[str, Unknown]:
        """Unknowns axis1, ... (two tilts), point1, ... (3, mm; turning joints alone), zero (turning joints), home.

        They are more than a minimal set: shifts of a point along its axis are invisible, and a zero offset also turns
        all that follows. Each is what a maker tolerates, so that a prior can be given; the report names the redundant.
        """
        length_std = PRIOR_STD["mm"] if length_std is None else length_std
        angle_std = PRIOR_STD["rad"] if angle_std is None else angle_std
        found: dict[str, Unknown] = {}
        turning = [i for i, joint in enumerate(self.joints, 1) if joint.turns]
        for i, (axis, point) in enumerate(zip(self.axes, self.points, strict=True), 1):
            found[f"axis{i}"] = Direction(axis, prior_std=angle_std)
            if i in turning:
                found[f"point{i}"] = Parameter(point, unit="mm", prior_std=length_std, labels=("_x", "_y", "_z"))
        if turning:
            labels = tuple(str(i) for i in turning)
            found["zero"] = Parameter((0.0,) * len(turning), unit="rad", prior_std=angle_std, labels=labels)
        found["home"] = Frame(self.home, prior_std=(angle_std, length_std))
        return found


def triples(rows: Sequence[Sequence[float]]) -> tuple[Triple, ...]:
    """Rows of numbers as tuples of floats, whatever their length: `Screws` says which is wrong."""
    return tuple(tuple(float(value) for value in np.ravel(row)) for row in rows)  # type: ignore[misc]
