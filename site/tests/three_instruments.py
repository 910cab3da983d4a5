"""One arm before a dial, a tracker and a spike; dial and spike are touched by one tip."""

from pathlib import Path

from casacal import DialOnPlane, FixedPoint, Problem, TrackedPoint, load_problem, tool_point

ROOT = Path(__file__).parent.parent
_source = load_problem(ROOT / "problems" / "hsr_jr680")
_tip = tool_point(0, 0, 100, prior_std=0.5)
INSTRUMENTS = {
    "dial": DialOnPlane(noise_std=0.01, tool=_tip),
    "tracker": TrackedPoint(noise_std=0.03, tool=tool_point(30, 0, 80, prior_std=1.0)),
    "spike": FixedPoint(noise_std=0.03, tool=_tip),
}
COUNTS = {"dial": 90, "tracker": 30, "spike": 24}
CELL = _source.cell
problem = Problem(_source.problem.robot, INSTRUMENTS, shared={"tool": ("dial", "spike")})
