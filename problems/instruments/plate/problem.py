"""A UR5 whose tip is brought to the holes of a plate that was measured."""

from pathlib import Path

from casacal import KnownPoint, Problem, load_problem, tool_point

arm = load_problem(Path(__file__).parents[2] / "ur5").problem.robot
holes = {f"{row}{column}": (150.0 * i, 100.0 * j, 0.0) for i, row in enumerate("ABC") for j, column in enumerate("123")}
problem = Problem(arm, KnownPoint(noise_std=0.05, tool=tool_point(0, 0, 100, prior_std=1.0), points=holes))
