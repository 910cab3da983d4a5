"""A Franka Emika Panda, a point of whose hand is read in an external frame."""

from casacal import Problem, Robot, TrackedPoint, deg, tool_point

robot = Robot.from_dh(
    "Panda",
    convention="modified",
    alpha=deg(0, -90, 90, 90, -90, 90, 90),
    a=(0, 0, 0, 82.5, -82.5, 0, 88),
    d=(333, 0, 316, 0, 384, 0, 107),
    theta=(0.0,) * 7,
    length_std=1.0,
    angle_std=5e-3,
)
problem = Problem(robot, TrackedPoint(noise_std=0.2, tool=tool_point(0, 0, 100, prior_std=30.0)))
