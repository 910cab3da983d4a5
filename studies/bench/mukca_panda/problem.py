"""A Franka Emika Panda whose ball rests in two sockets 50 mm apart, at eight places."""

from casacal import Problem, Robot, Sockets, deg, tool_point

robot = Robot.from_dh(
    "Panda",
    convention="modified",
    alpha=deg(0, -90, 90, 90, -90, 90, 90),
    a=(0, 0, 0, 82.5, -82.5, 0, 88),
    d=(333, 0, 316, 0, 384, 0, 107),
    theta=(0.0,) * 7,
    length_std=3.5,
    angle_std=5e-3,
)
ball = tool_point(0, 0, 133.5, prior_std=5.0)
problem = Problem(robot, Sockets(noise_std=0.1, along={"0": 0, "1": 50}, tool=ball))
