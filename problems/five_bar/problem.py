"""DexTAR, a planar five-bar: two cranks turned by motors, two rods that meet in the tip; before a laser tracker."""

import casadi as ca

from casacal import Joint, Parameter, Problem, Robot, TrackedPoint, deg
from casacal.model import passive
from casacal.model.kinematics import translate

HOME = deg(90, 90)  # both cranks straight ahead: the tip is before the motors, and nothing is near a singularity


def along(length, angle):
    """A link of that length at an angle from the x axis (2, mm)."""
    return length * ca.vertcat(ca.cos(angle), ca.sin(angle))


def elbows(p, q):
    """Where the cranks end (2, mm each)."""
    motor = ca.vertcat(p.base / 2, 0)
    return along(p.crank[0], q[0] + p.zero[0]) - motor, along(p.crank[1], q[1] + p.zero[1]) + motor


def pose(p, q):
    """Flange pose from the cranks' angles q (2, rad): where the rods meet; it does not turn."""

    def loop(rods, q):
        left, right = elbows(p, q)
        return left + along(p.rod[0], rods[0]) - right - along(p.rod[1], rods[1])

    rods = passive(loop, q, home=HOME, start=deg(49, 131))  # angles of the rods (rad), which no encoder reads
    tip = elbows(p, q)[0] + along(p.rod[0], rods[0])
    return translate(tip[0], tip[1], 0)


sides = ("_left", "_right")
robot = Robot(
    "DexTAR",
    joints=[Joint("revolute", *deg(50, 130)), Joint("revolute", *deg(50, 130))],
    pose=pose,
    parameters={
        "base": Parameter(118.0, unit="mm", prior_std=0.1),
        "crank": Parameter((90.0, 90.0), unit="mm", prior_std=0.1, labels=sides),
        "rod": Parameter((90.0, 90.0), unit="mm", prior_std=0.1, labels=sides),
        "zero": Parameter((0.0, 0.0), unit="rad", prior_std=5e-3, labels=sides),
    },
)

# The reflector sits over the tip. As the flange does not turn, where on it is nothing that rows could tell.
reflector = Parameter((0.0, 0.0, 20.0), unit="mm", prior_std=1.0, free=False)
problem = Problem(robot, TrackedPoint(noise_std=0.01, tool=reflector))
