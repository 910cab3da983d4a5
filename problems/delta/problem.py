"""A Delta robot as large as ABB's FlexPicker IRB 340, whose platform holds one end of a ball bar."""

import casadi as ca

from casacal import Distance, Joint, Parameter, Problem, Robot, deg
from casacal.model import passive
from casacal.model.kinematics import translate

ATTACHED = 76.0 / 3**0.5  # mm from the middle of the platform to its joints; rows see only base less platform
HEIGHT = 1500.0  # mm of the motors over the belt, where the base frame lies
HOME, MIDDLE = deg(10, 10, 10), (0.0, 0.0, -1160.0)


def loop(p):
    """Closure errors of the three legs: what the way from knee to platform is longer than the rods (3, mm)."""

    def errors(place, q):
        found = []
        for i in range(3):
            out = ca.vertcat(ca.cos(p.azimuth[i]), ca.sin(p.azimuth[i]), 0)
            angle = q[i] + p.offset[i]
            knee = p.base[i] * out + p.arm[i] * (ca.cos(angle) * out - ca.sin(angle) * ca.vertcat(0, 0, 1))
            found.append(ca.norm_2(place + ATTACHED * out - knee) - p.rod[i])
        return ca.vertcat(*found)

    return errors


def pose(p, q):
    """Flange pose from the motors' angles q (3, rad), positive downwards; pairs of rods keep it from turning.

    The joints between are ball joints. Instead of their angles it is the platform's place that closes the loops.
    """
    place = passive(loop(p), q, home=HOME, start=MIDDLE)
    return translate(place[0], place[1], HEIGHT + place[2])


legs = ("_1", "_2", "_3")
robot = Robot(
    "Delta",
    joints=[Joint("revolute", *deg(-40, 70))] * 3,
    pose=pose,
    parameters={
        "base": Parameter((567.0 / 12**0.5,) * 3, unit="mm", prior_std=0.3, labels=legs),
        "azimuth": Parameter(deg(-90, 30, 150), unit="rad", prior_std=1e-3, labels=legs),
        "arm": Parameter((524.0,) * 3, unit="mm", prior_std=0.3, labels=legs),
        "rod": Parameter((1244.0,) * 3, unit="mm", prior_std=0.3, labels=legs),
        "offset": Parameter((0.0,) * 3, unit="rad", prior_std=2e-3, labels=legs),
    },
)

# The platform does not turn: where on it the ball sits would only move all anchors. The bar was set on a gauge.
ball = Parameter((0.0, 0.0, -50.0), unit="mm", prior_std=1.0, free=False)
zero = Parameter(0.0, unit="mm", prior_std=0.005)
problem = Problem(robot, Distance(noise_std=0.01, tool=ball, zero=zero))
