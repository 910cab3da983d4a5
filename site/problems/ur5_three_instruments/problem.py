"""A UR5 that a dial on faces, a laser tracker and a spike measure; one tip touches faces and spike."""

from dataclasses import replace
from pathlib import Path

from casacal import DialOnPlane, FixedPoint, Problem, TrackedPoint, load_problem, tool_point

ur5 = load_problem(Path(__file__).parent.parent / "ur5")
tip = tool_point(0, 0, 100, prior_std=0.5)
problem = Problem(
    ur5.problem.robot,
    {
        "dial": DialOnPlane(noise_std=0.01, tool=tip),
        "tracker": TrackedPoint(noise_std=0.03, tool=tool_point(40, 0, 60, prior_std=1.0)),
        "spike": FixedPoint(noise_std=0.05, tool=tip),
    },
    shared={"tool": ("dial", "spike")},
)
cell = replace(ur5.cell, faces=ur5.cell.faces[:3])  # without the gauge block
