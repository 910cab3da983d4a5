"""A URDF file as plain data: the joints from a base link to a tip link, in metres and radians as the file has them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from casacal.errors import ProblemError

MOVING = ("revolute", "continuous", "prismatic")
Triple = tuple[float, float, float]
ZERO: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class UrdfJoint:
    """One <joint> with the line it begins in; `limits` and `mimics` are None where the file has none."""

    name: str
    kind: str
    line: int
    parent: str = ""
    child: str = ""
    xyz: Triple = ZERO
    rpy: Triple = ZERO
    axis: Triple = (1.0, 0.0, 0.0)
    limits: tuple[float, float] | None = None
    mimics: str | None = None


@dataclass(frozen=True)
class UrdfFile:
    """All links and joints of a URDF."""

    file: str
    name: str
    links: tuple[str, ...]
    joints: tuple[UrdfJoint, ...]

    def chain(self, base: str | None, tip: str | None) -> tuple[UrdfJoint, ...]:
        """Joints from a base link (default: the root) to a tip link (default: the only one without child).

        Raises ProblemError for links that do not exist, several roots or tips, and loops.
        """
        if tip is None:
            parents = {joint.parent for joint in self.joints}
            tip = self._only([link for link in self.links if link not in parents], "tip")
        if base is None:
            children = {joint.child for joint in self.joints}
            base = self._only([link for link in self.links if link not in children], "base")
        for link in (base, tip):
            if link not in self.links:
                fix = f"Name one of {', '.join(self.links)}"
                raise ProblemError(f"{self.file}: there is no link named '{link}'", fix)
        found = self.between(base, tip)
        if found is None:
            raise ProblemError(f"{self.file}: link '{tip}' does not hang on link '{base}'", "Name a base above the tip")
        return found

    def above(self, link: str) -> list[UrdfJoint]:
        """The joints above a link, the nearest first; where they form a loop, no more than there are and one."""
        parents, found = {joint.child: joint for joint in self.joints}, list[UrdfJoint]()
        while link in parents and len(found) <= len(self.joints):
            found.append(parents[link])
            link = parents[link].parent
        return found

    def between(self, base: str, link: str) -> tuple[UrdfJoint, ...] | None:
        """Joints from a base link to one that hangs on it; None for one that does not."""
        way = self.above(link)
        links = [link, *(joint.parent for joint in way)]
        return tuple(reversed(way[: links.index(base)])) if base in links else None

    def _only(self, links: list[str], what: str) -> str:
        if len(links) != 1:
            several = ", ".join(f"'{link}'" for link in links) or "none"
            raise ProblemError(
                f"{self.file}: there are {len(links)} links that could be the {what}: {several}",
                f"Name one with {what}= (--{what} on the command line)"
                if links
                else "The joints form a loop; mend the file",
            )
        return links[0]


def check_joint(file: str, joint: UrdfJoint) -> None:
    """Raise ProblemError unless a joint of the chain can be calibrated and its numbers can be metres and radians."""
    where = f"{file}, line {joint.line}: joint '{joint.name}'"
    if joint.mimics is not None:
        raise ProblemError(
            f"{where} mimics '{joint.mimics}'",
            "Choose base and tip so that none does, or write a DH table with its coupling",
        )
    if joint.kind not in (*MOVING, "fixed"):
        fix = "Between base and tip there may be revolute, continuous, prismatic and fixed joints"
        raise ProblemError(f"{where} is of type '{joint.kind}'", fix)
    if max(abs(v) for v in joint.xyz) > 20:
        raise ProblemError(f"{where} lies {max(map(abs, joint.xyz)):g} from its parent", "A URDF is in metres, not mm")
    if max(abs(v) for v in joint.rpy) > 2 * math.pi + 1e-6:
        raise ProblemError(f"{where} has rpy {_said(joint.rpy)}", "A URDF has radians, not degrees")
    if joint.kind == "fixed":
        return
    if math.hypot(*joint.axis) < 1e-9:
        raise ProblemError(f"{where} has the axis {_said(joint.axis)}", "Give a direction, such as 0 0 1")
    if joint.kind == "continuous":
        return
    if joint.limits is None:
        raise ProblemError(f"{where} is {joint.kind} and has no limits", "Add <limit lower= upper=>")
    lower, upper = joint.limits
    if not lower < upper:
        raise ProblemError(f"{where} has the limits {lower:g} to {upper:g}", "Give lower below upper")
    largest = max(abs(lower), abs(upper))
    if largest > (4 * math.pi + 1e-6 if joint.kind == "revolute" else 20):
        unit = "radians, not degrees" if joint.kind == "revolute" else "metres, not mm"
        raise ProblemError(f"{where} has the limits {lower:g} to {upper:g}", f"A URDF has {unit}")


def _said(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values)


def numbers_in(text: str, count: int) -> list[float]:
    """So many finite numbers between blanks; none where the text is anything else."""
    try:
        values = [float(part) for part in text.split()]
    except ValueError:
        return []
    return values if len(values) == count and all(map(math.isfinite, values)) and "_" not in text else []
