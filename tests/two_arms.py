"""Two UR5 on one base, a ball on each; one of them is known."""

from instruments_on_ur5 import ROBOT

from casacal import Parameter, Problem, SelfContact, tool_point
from casacal.model import facing

balls = SelfContact(
    noise_std=0.02,
    tool=tool_point(0, 0, 120, prior_std=0.5),
    other=tool_point(5, 0, 100, prior_std=0.5),
    apart=Parameter(40.0, unit="mm", prior_std=0.01),
)
problem = Problem(facing(ROBOT, ROBOT), balls).fix("other_alpha", "other_a", "other_d", "other_theta", "other_beta")
