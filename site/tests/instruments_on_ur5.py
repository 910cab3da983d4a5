"""The same arm before every instrument that is built in, and what each reads written down a second time in NumPy."""

from pathlib import Path

import numpy as np

from casacal import (
    Distance,
    FixedPoint,
    KnownPoint,
    Parameter,
    Problem,
    Sockets,
    SphereTouch,
    TrackedPoint,
    TrackedPose,
    load_problem,
    tool_point,
)

ROOT = Path(__file__).parent.parent
ROBOT = load_problem(ROOT / "problems" / "ur5").problem.robot
TOOL = (10.0, -20.0, 120.0)
PLATE = {f"hole {i}": (100.0 * (i % 3), 80.0 * (i // 3), 5.0 * i) for i in range(6)}
BAR = {"near": 0.0, "far": 50.0}
RADII = 30.0

_tool = tool_point(*TOOL, prior_std=1.0)
INSTRUMENTS = {
    "FixedPoint": FixedPoint(noise_std=0.05, tool=_tool),
    "Sockets": Sockets(noise_std=0.05, tool=_tool, along=BAR),
    "Distance": Distance(noise_std=0.05, tool=_tool),
    "SphereTouch": SphereTouch(noise_std=0.02, tool=_tool, radii=Parameter(RADII, prior_std=0.002)),
    "KnownPoint": KnownPoint(noise_std=0.05, tool=_tool, points=PLATE),
    "TrackedPoint": TrackedPoint(noise_std=0.05, tool=_tool),
    "TrackedPose": TrackedPose(position_std=0.05, angle_std=2e-4),
}
PROBLEMS = {name: Problem(ROBOT, instrument) for name, instrument in INSTRUMENTS.items()}

TABLE = (
    np.radians([90, 0, 0, 90, -90, 0]),
    [0, -425, -392.25, 0, 0, 0],
    [89.159, 0, 0, 109.15, 94.65, 82.3],
)
"""alpha, a and d of the maker, in rad and mm."""


def flanges(joints):
    """Flange poses (N, 4, 4; mm) of the drawn arm at joint values (N, 6; rad), by hand."""
    found = []
    for q in joints:
        pose = np.eye(4)
        for turn, alpha, a, d in zip(q, *TABLE, strict=True):
            ct, st, ca, sa = np.cos(turn), np.sin(turn), np.cos(alpha), np.sin(alpha)
            pose = pose @ np.array(
                [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1]]
            )
        found.append(pose)
    return np.array(found)


def tips(joints):
    """Tips (N, 3; mm) of the drawn arm."""
    return flanges(joints)[:, :3] @ np.array([*TOOL, 1.0])
