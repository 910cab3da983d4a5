"""A KUKA LBR iiwa 14 whose ball rests in two sockets 50 mm apart, at three places."""

from pathlib import Path

from casacal import Problem, Sockets, load_problem, tool_point

robot = load_problem(Path(__file__).parents[3] / "problems" / "kuka_iiwa14").problem.robot
ball = tool_point(0, 0, 40, prior_std=5.0)
problem = Problem(robot, Sockets(noise_std=0.1, along={"0": 0, "1": 50}, tool=ball))
