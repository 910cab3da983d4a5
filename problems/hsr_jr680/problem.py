"""The paper's robot, an HSR-JR680, with a dial indicator on flat faces (arXiv:2208.02652)."""

from casacal import Cell, DialOnPlane, Joint, Problem, Robot, corner, deg
from casacal.model.kinematics import rotate_x, rotation, transform_point

LIMITS = [(-160, 160), (-85, 85), (-80, 80), (-180, 180), (-115, 115), (-180, 180)]  # plausible; degrees, not printed


class DialOnLastOffset(DialOnPlane):
    """The paper's dial: d6 + sign * reading, which acts along joint 6, before the twist alpha6 of the same row."""

    def tip(self, pose, p, row):
        """Tip of the plunger (3, mm)."""
        joint_axis = rotation(rotate_x(-p.alpha[5])) @ p.plunger
        return transform_point(pose, p.tool + self.reach(p, row) * joint_axis)


robot = Robot.from_dh(
    "HSR-JR680",
    alpha=deg(-90, 0, 90, -90, 90, 0),
    a=(249.85003, 900.32123, -206.14449, 0, 0, 0),  # a3 as corrected: the paper prints it in metres (E1)
    d=(653.5, 0, 0, 1030.37534, 0, 200.6),
    theta=deg(0, -90, 180, 0, 90, 0),
    length_std=0.7,
    angle_std=1e-3,
    joints=[Joint("revolute", *deg(*limits)) for limits in LIMITS],
)
problem = Problem(robot, DialOnLastOffset(noise_std=0.01, sign=+1))
cell = Cell(faces=corner((1350.0, 0.0, 700.0), size=600.0))
