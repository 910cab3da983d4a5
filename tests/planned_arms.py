"""Five arms as their makers' tables have them, and their forward kinematics by hand, apart from casacal's."""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Arm:
    """A DH table: rows of alpha (degrees), a, d (mm), theta (degrees), lower, upper; `slides`: which joints slide."""

    name: str
    convention: str
    rows: tuple
    tool: tuple = (0.0, 0.0, 120.0)
    slides: tuple = ()

    def csv(self):
        """The table as `casacal new --dh` reads it."""
        lines = [f"# name: {self.name}", f"# convention: {self.convention}"]
        lines.append("joint,alpha_deg,a_mm,d_mm,theta_deg,kind,lower_deg,upper_deg,lower_mm,upper_mm")
        for k, (*row, low, high) in enumerate(self.rows, 1):
            ends = ("prismatic", "", "", low, high) if k in self.slides else ("revolute", low, high, "", "")
            lines.append(",".join(map(str, (k, *row, *ends))))
        return "\n".join(lines) + "\n"

    def origins(self, joints):
        """Origins of all joint frames, the tip last (n + 1, 3; mm), at joint values in degrees and mm."""
        here, found = np.eye(4), []
        for k, ((alpha, a, d, theta, *_), q) in enumerate(zip(self.rows, joints, strict=True), 1):
            turn, slide = (np.radians(theta), d + q) if k in self.slides else (np.radians(theta + q), d)
            c, s, ca, sa = np.cos(turn), np.sin(turn), np.cos(np.radians(alpha)), np.sin(np.radians(alpha))
            if self.convention == "modified":
                step = [[c, -s, 0, a], [s * ca, c * ca, -sa, -sa * slide], [s * sa, c * sa, ca, ca * slide]]
            else:
                step = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, slide]]
            here = here @ np.array([*step, [0, 0, 0, 1]])
            found.append(here[:3, 3])
        return np.array([*found, (here @ [*self.tool, 1.0])[:3]])

    def moved_tool(self, joints, reading):
        """The tip (3, mm) where a plunger along the flange's z is pushed in by a reading, mm."""
        x, y, z = self.tool
        return replace(self, tool=(x, y, z - reading)).origins(joints)[-1]


def _turn(degrees, rows):
    return tuple((*row, -degrees, degrees) for row in rows)


def _ur(name, d1, a2, a3, d4, d5, d6):
    rows = ((90, 0, d1, 0), (0, a2, 0, 0), (0, a3, 0, 0), (90, 0, d4, 0), (-90, 0, d5, 0), (0, 0, d6, 0))
    return Arm(name, "standard", _turn(360, rows))


ARMS = (
    _ur("UR5", 89.159, -425.0, -392.25, 109.15, 94.65, 82.3),
    _ur("UR10e", 180.7, -612.7, -571.55, 174.15, 119.85, 116.55),
    Arm(
        "IRB 120",
        "standard",
        (
            (-90, 0, 290, 0, -165, 165),
            (0, 270, 0, -90, -110, 110),
            (-90, 70, 0, 0, -110, 70),
            (90, 0, 302, 0, -160, 160),
            (-90, 0, 0, 0, -120, 120),
            (0, 0, 72, 180, -400, 400),
        ),
    ),
    Arm(
        "LBR iiwa 14",
        "modified",
        tuple(
            (alpha, 0, d, 0, -limit, limit)
            for alpha, d, limit in zip(
                (0, -90, 90, 90, -90, -90, 90),
                (360, 0, 420, 0, 400, 0, 126),
                (170, 120, 170, 120, 170, 120, 175),
                strict=True,
            )
        ),
    ),
    Arm(
        "SCARA",
        "standard",
        (
            (0, 325, 387, 0, -105, 105),
            (180, 275, 0, 0, -150, 150),
            (0, 0, 0, 0, 0, 210),
            (0, 0, 0, 0, -360, 360),
        ),
        (20.0, 0.0, 60.0),
        (3,),
    ),
)
