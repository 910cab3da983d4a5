"""A UR5 with a camera on its flange that sees a board and reads its pose; turns as rotation vectors."""

from pathlib import Path

from casacal import Problem, TrackedPose, load_problem

arm = load_problem(Path(__file__).parents[2] / "ur5").problem.robot
problem = Problem(arm, TrackedPose(position_std=0.1, angle_std=3e-4, orientation="rotation vector"))
