"""A KUKA LBR iiwa 7 with torque sensors in its joints, whose flange something watches."""

from casacal import Problem, Robot, TrackedPose, deg
from casacal.effects import TorqueCompliance, kit

robot = Robot.from_dh(
    "LBR iiwa 7",
    alpha=deg(-90, 90, -90, 90, -90, 90, 0),
    a=(0.0,) * 7,
    d=(340, 0, 400, 0, 400, 0, 126),
    theta=deg(0, 0, 180, 0, 180, 0, 0),
    length_std=1.0,
    angle_std=1e-3,
)
give = TorqueCompliance(columns_of=tuple(f"torque{j}_Nm" for j in range(1, 8)), size=1e-4)
problem = Problem(robot, TrackedPose(position_std=0.1, angle_std=2e-4), terms=(*kit(), give))
