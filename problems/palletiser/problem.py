"""uArm Swift Pro, a small palletiser: a parallelogram brings the forearm's motor to the shoulder."""

import math

import casadi as ca

from casacal import Frame, Joint, KnownPoint, Parameter, Problem, Robot, chain, deg, tool_point
from casacal.model import passive
from casacal.model.kinematics import rotate_z, translate

HOME = deg(65, 35)
COLUMN, WRIST = (106.6, 56.55)  # mm: height of the shoulder, and from the forearm's end to the axis of the flange


def up(length, angle):
    """A link of that length and elevation in the arm's plane: outwards and up (2, mm)."""
    return length * ca.vertcat(ca.cos(angle), ca.sin(angle))


def pose(p, q):
    """Flange pose from q (4, rad): turn, elevation of the upper arm, depression of the crank, turn of the flange.

    From the shoulder, a crank behind the forearm's motor, a rod beside the upper arm and the lever behind the elbow
    carry the motor's angle to the forearm. A second pair of parallelograms keeps the flange level; it counts as exact.
    """

    def loop(u, q):
        crank, elbow = up(-p.crank, -(q[1] + p.zero[1])), up(p.upper, q[0] + p.zero[0])
        return crank + up(p.rod, u[0]) - elbow - up(-p.lever, -u[1])

    _, forearm = ca.vertsplit(passive(loop, q[1:3], home=HOME, start=HOME))  # elevation of the rod, depression
    wrist = up(p.upper, q[1] + p.zero[0]) + up(p.forearm, -forearm)
    return chain(
        rotate_z(q[0]),
        translate(p.shoulder + wrist[0] + WRIST, 0, COLUMN + wrist[1]),
        rotate_z(q[3]),
    )


robot = Robot(
    "uArm Swift Pro",
    joints=[Joint("revolute", *deg(*limits)) for limits in ((-80, 80), (40, 85), (5, 70), (-80, 80))],
    pose=pose,
    parameters={
        "shoulder": Parameter(13.2, unit="mm", prior_std=0.2),  # before the axis of the column
        "upper": Parameter(142.07, unit="mm", prior_std=0.2),
        "forearm": Parameter(158.81, unit="mm", prior_std=0.2),
        "crank": Parameter(45.0, unit="mm", prior_std=0.1),  # crank and lever are not published
        "rod": Parameter(142.07, unit="mm", prior_std=0.1),
        "lever": Parameter(45.0, unit="mm", prior_std=0.1),
        "zero": Parameter((0.0, 0.0), unit="rad", prior_std=5e-3, labels=("_upper", "_crank")),
    },
)

# A stepped plate on the table before the arm: row C lies 50 mm higher than A and B. Rows tell where it is.
HEIGHTS = {"A": 0.0, "B": 0.0, "C": 50.0}
holes = {f"{row}{k + 1}": (35.0 * i, 45.0 * k, HEIGHTS[row]) for i, row in enumerate(HEIGHTS) for k in range(3)}
plate = Frame(translate(-230, 45, -75).full().tolist(), prior_std=math.inf)
problem = Problem(
    robot, KnownPoint(noise_std=0.03, tool=tool_point(20, 0, -60, prior_std=1.0), points=holes, station=plate)
)
