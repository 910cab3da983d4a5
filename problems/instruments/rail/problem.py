"""A UR5 on a rail of three metres, before a laser tracker."""

from pathlib import Path

from casacal import Problem, TrackedPoint, load_problem, tool_point
from casacal.model import carried, rail

arm = load_problem(Path(__file__).parents[2] / "ur5").problem.robot
tracker = TrackedPoint(noise_std=0.05, tool=tool_point(40, 0, 60, prior_std=1.0))
problem = Problem(carried(arm, by=rail(0, 3000)), tracker)
