"""A UR5 whose ball is put into two sockets of a bar 200 mm apart, which stands at three places."""

from pathlib import Path

from casacal import Problem, Sockets, load_problem, tool_point

arm = load_problem(Path(__file__).parents[2] / "ur5").problem.robot
bar = Sockets(noise_std=0.03, along={"near": 0, "far": 200}, tool=tool_point(0, 0, 100, prior_std=1.0))
problem = Problem(arm, bar)
