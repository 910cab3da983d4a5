"""Places of an arm's links, and their levers under gravity about the joints, from the flange pose alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from casacal.errors import ProblemError
from casacal.model.joints import Conventions
from casacal.model.kinematics import Expression, chain, screw, slide, transform_point
from casacal.model.robot import Robot, random_joints
from casacal.model.traced_pose import TracedPose
from casacal.values import Array

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
        """Links of an arm whose joints carry one another in order; raises ProblemError for others.

        A link's place is on the next joint's axis, where that is nearest to the place before; the last is the flange.
        """
        plain, conventions = robot.traced, getattr(robot.arm, "conventions", None)
        if conventions is not None and robot.arm is not None:
            plain = TracedPose.of(replace(robot.arm, conventions=None).pose, robot.parameters, len(robot.axes))
        turns, q = tuple(bool(each) for each in robot.revolute), ca.SX.sym("q", len(robot.axes))
        pose = ca.Function("pose", [q], [ca.SX(plain.at_drawn(q))])
        both = ca.Function("both", [q], [pose(q), ca.jacobian(ca.vec(pose(q)), q)])
        home, slopes = (np.array(each) for each in both(ca.DM.zeros(len(turns))))
        axes, points, places = np.zeros((3, len(turns), 3))
        for j, turning in enumerate(turns):
            rate = slopes[:, j].reshape(4, 4, order="F") @ np.linalg.inv(home)  # velocities in the base frame
            spin, moving = np.array([rate[2, 1], rate[0, 2], rate[1, 0]]), rate[:3, 3]
            axes[j] = spin if turning else moving
            points[j] = np.cross(spin, moving) if turning else 0.0
        here = np.zeros(3)
        for j in range(len(turns) - 1):  # along the chain of axes
            if turns[j + 1]:
                here = foot(axes[j + 1], points[j + 1], here)
            places[j] = here
        places[-1] = home[:3, 3]
        found = Links(turns, axes, points, places, conventions)
        last = replace(found, places=np.tile(home[:3, 3], (len(turns), 1)))
        flange = ca.Function("flange", [q], [ca.vertcat(*last.carried(q)[-1:])])
        for joints in random_joints(robot, PROOFS, np.random.default_rng(0)):
            there = joints if conventions is None else conventions.to_model(joints)
            if not np.abs(np.array(flange(there))[:, 0] - np.array(pose(there))[:3, 3]).max() <= ALIKE:  # or none
                fix = "Leave out LinkSag; GravitySag asks nothing of the order"
                raise ProblemError(f"The joints of '{robot.name}' do not carry one another in order", fix)
        return found

    def carried(self, q: Expression) -> list[Expression]:
        """The place of each link (3, mm) in the base frame, at joint values q of the model (n; rad, mm)."""
        found, steps = [], list[Expression]()
        for j, turns in enumerate(self.turns):
            axis = ca.DM(self.axes[j])
            steps.append(screw(axis, ca.DM(self.points[j]), q[j]) if turns else slide(axis, q[j]))
            found.append(transform_point(chain(*steps), ca.DM(self.places[j])))
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
        """Small motions (n,) of the controller's joints that equal small motions of the model's."""
        return off if self.conventions is None else ca.mtimes(ca.DM(np.linalg.inv(self.conventions.matrix)), off)


def foot(axis: Array, point: Array, place: Array) -> Array:
    """Foot of the perpendicular from a place (3) to an axis through a point (3)."""
    return np.asarray(point + axis * float(axis @ (place - point)))
