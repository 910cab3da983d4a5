"""Where the links of an arm are, and how they fall as its joints give: found from the flange pose alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.kinematics import Expression, chain, screw, slide, transform_point
from casacal.robots.joint_space import random_joints
from casacal.robots.joints import Conventions
from casacal.robots.robot import Robot
from casacal.robots.traced_pose import TracedPose

PROOFS = 4  # postures at which the screws must give the pose
ALIKE = 1e-6  # how far (mm, or of one) they may be from it


@dataclass(frozen=True, eq=False)
class Links:
    """The screws of an arm as drawn, at joint values of zero in its model, and one place on each link.

    turns: which joints turn (n,). axes: directions (n, 3). points: on each axis (n, 3, mm). places: on each link, which
    the joint before it carries (n, 3, mm). conventions: what the controller's joint values mean to the model.
    """

    turns: tuple[bool, ...]
    axes: Array
    points: Array
    places: Array
    conventions: Conventions | None = None

    @staticmethod
    def of(robot: Robot) -> Links:
        """Of any arm whose joints carry one another in order; raises ProblemError for others.

        A link's place is on the axis of the joint after it, where that is nearest to the place before; the last one's
        is the flange.
        """
        plain, conventions = robot.traced, getattr(robot.arm, "conventions", None)
        if conventions is not None and robot.arm is not None:
            bare = replace(robot.arm, conventions=None)
            plain = TracedPose.of(bare.pose, robot.parameters, len(robot.axes))
        turns, q = tuple(bool(each) for each in robot.revolute), ca.SX.sym("q", len(robot.axes))
        pose = ca.Function("pose", [q], [ca.SX(plain(SimpleNamespace(**plain.drawn), q))])
        home, twists = _twists(pose, len(turns))
        axes, points = np.zeros((2, len(turns), 3))
        for j, (turning, moving) in enumerate(twists):
            axes[j] = turning if turns[j] else moving
            points[j] = np.cross(turning, moving) if turns[j] else 0.0
        found = Links(turns, axes, points, _places(turns, axes, points, home[:3, 3]), conventions)
        found._prove(robot, pose, home)
        return found

    def carried(self, q: Expression) -> list[Expression]:
        """The place of each link (3, mm) in the base frame, at joint values q of the model (n; rad, mm)."""
        return [
            transform_point(motion, ca.DM(place)) for motion, place in zip(self.motions(q), self.places, strict=True)
        ]

    def motions(self, q: Expression) -> list[Expression]:
        """How each link has moved (4x4, mm) from where it is at zero, at joint values q of the model (n; rad, mm)."""
        found, steps = [], list[Expression]()
        for j, turns in enumerate(self.turns):
            axis = ca.DM(self.axes[j])
            steps.append(screw(axis, ca.DM(self.points[j]), q[j]) if turns else slide(axis, q[j]))
            found.append(chain(*steps))
        return found

    def levers(self, down: Array) -> ca.Function:
        """q of the controller (n; rad, mm) -> (n, n): by how much link j comes down as joint i of the model moves.

        Rows are links, columns joints; in metres, or millimetres of a sliding joint over 1000.
        """
        q, m = ca.SX.sym("q", len(self.turns)), ca.SX.sym("m", len(self.turns))
        depths = ca.vertcat(*(ca.dot(ca.DM(down), place) for place in self.carried(m))) / 1000
        by_model = ca.Function("levers", [m], [ca.densify(ca.jacobian(depths, m))])
        return ca.Function("levers", [q], [by_model(q if self.conventions is None else self.conventions.to_model(q))])

    def to_controller(self, off: Expression) -> Expression:
        """Small motions of the controller's joints (n,) that are these of the model's."""
        return off if self.conventions is None else ca.mtimes(ca.DM(np.linalg.inv(self.conventions.matrix)), off)

    def _prove(self, robot: Robot, pose: ca.Function, home: Array) -> None:
        """Raise ProblemError unless the screws give the arm's pose wherever it stands."""
        q = ca.SX.sym("q", len(self.turns))
        last = replace(self, places=np.tile(home[:3, 3], (len(self.turns), 1)))
        flange = ca.Function("flange", [q], [ca.vertcat(*last.carried(q)[-1:])])
        for joints in random_joints(robot, PROOFS, np.random.default_rng(0)):
            there = joints if self.conventions is None else self.conventions.to_model(joints)
            if np.abs(np.array(flange(there))[:, 0] - np.array(pose(there))[:3, 3]).max() > ALIKE:
                fix = "Leave out LinkSag; GravitySag asks nothing of the order"
                raise ProblemError(f"The joints of '{robot.name}' do not carry one another in order", fix)


def _twists(pose: ca.Function, joints: int) -> tuple[Array, list[tuple[Array, Array]]]:
    """The pose at zero joint values (4, 4), and each joint's angular and linear velocity in the base frame there."""
    q = ca.SX.sym("q", joints)
    both = ca.Function("both", [q], [pose(q), ca.jacobian(ca.vec(pose(q)), q)])
    home, slopes = (np.array(each) for each in both(ca.DM.zeros(joints)))
    rates = [slopes[:, j].reshape(4, 4, order="F") @ np.linalg.inv(home) for j in range(joints)]
    return home, [(np.array([rate[2, 1], rate[0, 2], rate[1, 0]]), rate[:3, 3]) for rate in rates]


def _places(turns: tuple[bool, ...], axes: Array, points: Array, flange: Array) -> Array:
    """A place on each link: along the chain of axes, then the flange."""
    places, here = np.zeros((len(turns), 3)), np.zeros(3)
    for j in range(len(turns) - 1):
        if turns[j + 1]:
            here = points[j + 1] + axes[j + 1] * float(axes[j + 1] @ (here - points[j + 1]))
        places[j] = here
    places[-1] = flange
    return places
