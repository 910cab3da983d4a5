"""A UR5 whose ball touches three datum spheres of known size all around."""

from pathlib import Path

from casacal import Parameter, Problem, SphereTouch, load_problem, tool_point

arm = load_problem(Path(__file__).parents[2] / "ur5").problem.robot
radii = Parameter(30.0, unit="mm", prior_std=0.002)  # 25 mm of the spheres and 5 mm of the ball, as certified
problem = Problem(arm, SphereTouch(noise_std=0.02, tool=tool_point(0, 0, 100, prior_std=1.0), radii=radii))
