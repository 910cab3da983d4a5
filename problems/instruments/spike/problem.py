"""A UR5 whose tool is brought to the tip of a spike, at three places, from many sides."""

from pathlib import Path

from casacal import FixedPoint, Problem, load_problem, tool_point

arm = load_problem(Path(__file__).parents[2] / "ur5").problem.robot
problem = Problem(arm, FixedPoint(noise_std=0.05, tool=tool_point(0, 0, 100, prior_std=1.0)))
