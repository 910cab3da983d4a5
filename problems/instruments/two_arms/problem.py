"""Two UR5 on one base; balls of 20 mm on both touch each other, and the second arm is known."""

from pathlib import Path

from casacal import Parameter, Problem, SelfContact, load_problem, tool_point
from casacal.model import facing

arm = load_problem(Path(__file__).parents[2] / "ur5").problem.robot
balls = SelfContact(
    noise_std=0.02,
    tool=tool_point(0, 0, 120, prior_std=0.5),
    other=tool_point(0, 0, 100, prior_std=0.5),
    apart=Parameter(40.0, unit="mm", prior_std=0.01),
)
known = [f"other_{key}" for key in arm.parameters]
problem = Problem(facing(arm, arm), balls).fix(*known)
