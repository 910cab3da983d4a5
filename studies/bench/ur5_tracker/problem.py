"""A Universal Robots UR5 with a reflector on its flange, which a laser tracker follows; joints as commanded."""

from casacal import Problem, Robot, TrackedPoint, deg, tool_point

robot = Robot.from_dh(
    "UR5",
    alpha=deg(90, 0, 0, 90, -90, 0),
    a=(0, -425, -392.25, 0, 0, 0),
    d=(89.159, 0, 0, 109.15, 94.65, 82.3),
    theta=(0, 0, 0, 0, 0, 0),
    length_std=1.0,
    angle_std=1e-3,
    parallel=(2, 3),
)
problem = Problem(robot, TrackedPoint(noise_std=0.1, tool=tool_point(0, 0, 60, prior_std=100.0)))
