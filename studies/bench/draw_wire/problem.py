"""An ABB IRB 120 whose flange pulls a draw wire out of its encoder."""

from casacal import Distance, Problem, Robot, deg, tool_point

robot = Robot.from_dh(
    "IRB 120",
    alpha=deg(-90, 0, -90, 90, -90, 0),
    a=(0, 270, 70, 0, 0, 0),
    d=(290, 0, 0, 302, 0, 72),
    theta=deg(0, -90, 0, 0, 0, 180),
    length_std=1.0,
    angle_std=2e-3,
    parallel=(2,),
)
problem = Problem(robot, Distance(noise_std=0.35, tool=tool_point(0, 0, 0, prior_std=20.0)))
