"""A robot: joints, named kinematic parameters, and the function that gives its flange pose."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

from casacal.errors import ProblemError
from casacal.kinematics import Expression, chain, dh, modified_dh
from casacal.unknowns import Parameter, Unknown

PoseFunction = Callable[[Any, Expression], Expression]


@dataclass(frozen=True)
class Joint:
    """One joint: its kind, its limits and its repeatability, in rad (revolute) or mm (prismatic)."""

    kind: Literal["revolute", "prismatic"] = "revolute"
    lower: float = -math.pi
    upper: float = math.pi
    repeatability_std: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in ("revolute", "prismatic"):
            raise ProblemError(f"A joint is '{self.kind}'", "Joints are 'revolute' or 'prismatic'")
        if not self.lower < self.upper or not math.isfinite(self.upper - self.lower):
            raise ProblemError(
                f"A joint has the limits {self.lower!r} to {self.upper!r}", "Give finite limits, lower below upper"
            )
        if not 0 <= self.repeatability_std < math.inf:
            raise ProblemError(f"A joint has repeatability_std {self.repeatability_std!r}", "Give zero or more")


def joints_of(joints: int | str | Sequence[Joint]) -> tuple[Joint, ...]:
    """Joints from a count (all revolute), a word like "RRPR", or a sequence of `Joint`.

    Limits that are not given are +-pi rad and +-1000 mm.
    """
    if isinstance(joints, int):
        joints = "R" * joints
    if isinstance(joints, str):
        if set(joints) - set("RP"):
            raise ProblemError(f"joints is '{joints}'", "Use R for revolute and P for prismatic, such as 'RRPR'")
        return tuple(Joint() if letter == "R" else Joint("prismatic", -1000.0, 1000.0) for letter in joints)
    return tuple(joints)


@dataclass(frozen=True)
class Robot:
    """A serial arm whose flange pose is a function of named parameters and joint values.

    Args:
        name: what the report calls it.
        joints: a count, a word such as "RRPR", or a sequence of `Joint`.
        pose: `pose(p, q)` builds the 4x4 flange pose (mm) in the base frame from `p.<name>` (the parameters) and
            `q` (n; rad or mm), both CasADi symbols or plain floats.
        parameters: the named kinematic parameters.

    """

    name: str
    joints: int | str | Sequence[Joint]
    pose: PoseFunction
    parameters: Mapping[str, Unknown]

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", joints_of(self.joints))
        object.__setattr__(self, "parameters", MappingProxyType(dict(self.parameters)))
        if not self.axes:
            raise ProblemError(f"Robot '{self.name}' has no joints", "Give at least one")
        for key, unknown in self.parameters.items():
            if not key.isidentifier():
                raise ProblemError(f"A parameter is named '{key}'", "Use a Python identifier, it becomes p.<name>")
            if unknown.per is not None:
                raise ProblemError(f"Robot parameter '{key}' is per '{unknown.per}'", "Only instruments vary by label")

    @property
    def axes(self) -> tuple[Joint, ...]:
        """The joints, as a tuple of `Joint`."""
        return self.joints  # type: ignore[return-value]

    @staticmethod
    def from_dh(
        name: str,
        *,
        alpha: Sequence[float],
        a: Sequence[float],
        d: Sequence[float],
        theta: Sequence[float],
        length_std: float | Sequence[float] | None = None,
        angle_std: float | Sequence[float] | None = None,
        twist_std: float | Sequence[float] | None = None,
        joints: int | str | Sequence[Joint] | None = None,
        convention: Literal["standard", "modified"] = "standard",
    ) -> Robot:
        """Robot from a Denavit-Hartenberg table; row i is joint i, all 4 n entries are parameters.

        Args:
            name: what the report calls it.
            alpha, theta: twists and zero offsets (n,), rad.
            a, d: lengths and offsets (n,), mm.
            length_std: prior standard deviation of a and d, one or one a row, mm; default 0.7 (see `casacal.priors`).
            angle_std: of theta, and of alpha unless `twist_std` is given, rad; default 1e-3.
            twist_std: of alpha, rad.
            joints: as for `Robot`; default all revolute. A prismatic joint adds its value to d, not to theta.
            convention: "standard" (eq (1) of arXiv:2208.02652) or "modified" (Craig's).

        Raises ProblemError when the columns differ in length.

        """
        count = len(alpha)
        axes = joints_of(count if joints is None else joints)
        if not len(a) == len(d) == len(theta) == len(axes) == count:
            raise ProblemError(
                f"The DH table of '{name}' has {len(alpha)} alpha, {len(a)} a, {len(d)} d, {len(theta)} theta "
                f"for {len(axes)} joints",
                "Give one of each a joint",
            )
        if convention not in ("standard", "modified"):
            raise ProblemError(f"The DH convention is '{convention}'", "Use 'standard' or 'modified'")
        link = dh if convention == "standard" else modified_dh
        turns = tuple(axis.kind == "revolute" for axis in axes)

        def pose(p: Any, q: Expression) -> Expression:
            return chain(
                *(
                    link(p.alpha[i], p.a[i], p.d[i] + (0 if turns[i] else q[i]), p.theta[i] + (q[i] if turns[i] else 0))
                    for i in range(count)
                )
            )

        return Robot(
            name,
            axes,
            pose,
            {
                "alpha": Parameter(tuple(alpha), unit="rad", prior_std=angle_std if twist_std is None else twist_std),
                "a": Parameter(tuple(a), unit="mm", prior_std=length_std),
                "d": Parameter(tuple(d), unit="mm", prior_std=length_std),
                "theta": Parameter(tuple(theta), unit="rad", prior_std=angle_std),
            },
        )
