"""A real Yaskawa Motoman MA1400 on a rotating base, touching six plates with a ball; no dial."""

from casacal import DialOnPlane, Problem, Robot, deg, tool_point

robot = Robot.from_dh(
    "Motoman MA1400",
    alpha=deg(15, -90, 180, -90, 90, 90, 0),
    a=(0, 150, 614, 200, 0, 30, 0),
    d=(-263, 1415.9, 0, 0, -640, 0, 200),
    theta=deg(-90, 0, -90, 0, 0, -90, 0),
    length_std=0.1,
    angle_std=0.5e-3,
    twist_std=0.1e-3,
)
problem = Problem(
    robot,
    DialOnPlane(
        reading=False,
        noise_std=0.45,
        tool=tool_point(0, 0, 354, prior_std=10.0),
    ),
)
