"""A Universal Robots UR10 whose flange a laser tracker's probe follows; its position alone."""

from casacal import Problem, Robot, TrackedPoint, deg, tool_point

robot = Robot.from_dh(
    "UR10",
    alpha=deg(90, 0, 0, 90, -90, 0),
    a=(0, -612, -572.3, 0, 0, 0),
    d=(127.3, 0, 0, 163.941, 115.7, 92.2),
    theta=deg(0, 0, 0, 0, 0, 0),
    length_std=1.0,
    angle_std=1e-3,
    parallel=(2, 3),
)
problem = Problem(robot, TrackedPoint(noise_std=0.1, tool=tool_point(0, 0, 109, prior_std=20.0)))
