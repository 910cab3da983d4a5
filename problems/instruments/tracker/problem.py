"""A UR5 whose reflector a laser tracker reads, from one station in the morning and from others later."""

from pathlib import Path

from casacal import Frame, Problem, TrackedPoint, load_problem, tool_point

arm = load_problem(Path(__file__).parents[2] / "ur5").problem.robot
reflector = tool_point(40, 0, 60, prior_std=1.0)
problem = Problem(arm, TrackedPoint(noise_std=0.03, tool=reflector, station=Frame(per="session")))
