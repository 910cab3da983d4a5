"""A UR5 at one end of a telescoping ball bar, whose other end stands at three places."""

from pathlib import Path

from casacal import Distance, Parameter, Problem, load_problem, tool_point

arm = load_problem(Path(__file__).parents[2] / "ur5").problem.robot
zero = Parameter(0.0, unit="mm", prior_std=0.005)  # the bar was set on a gauge
problem = Problem(arm, Distance(noise_std=0.01, tool=tool_point(0, 0, 100, prior_std=1.0), zero=zero))
