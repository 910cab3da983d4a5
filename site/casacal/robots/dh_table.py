"""A Denavit-Hartenberg table: nominal numbers, where axes are parallel, and what the controller's joints mean."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from casacal.errors import ProblemError
from casacal.kinematics import Expression, chain, dh, hayati, modified_dh, rotate_x, rotate_y, rotate_z, translate
from casacal.robots.joints import Conventions, Joint
from casacal.unknowns import Parameter, Unknown
from casacal.unknowns.unknown import spread

Stds = float | Sequence[float] | None
NEARLY = math.radians(5.0)
"""Largest angle between axes that count as parallel: below it, the foot of their common normal moves far too easily."""


@dataclass(frozen=True, kw_only=True)
class DHTable:
    """Row i is joint i: alpha, theta (n,) in rad, a, d (n,) in mm.

    parallel: rows, counted from 1, whose joint axis is parallel to the next one. There Hayati's turn `beta` (one a
    parallel row, rad) about y stands between the two axes, and d of the row is held at its nominal value. With the
    modified convention, whose row i + 1 holds the twist between axes i and i + 1, the turn stands in that row:
    RotX(alpha) TransX(a) RotY(beta) RotZ(theta) TransZ(d), which is the same product of elementary motions.
    conventions: what the controller's joint values mean, or None where it means what the table means.

    Raises ProblemError when columns differ in length, or rows that are not parallel are declared so.
    """

    name: str
    alpha: tuple[float, ...]
    a: tuple[float, ...]
    d: tuple[float, ...]
    theta: tuple[float, ...]
    joints: tuple[Joint, ...]
    convention: Literal["standard", "modified"] = "standard"
    parallel: tuple[int, ...] = ()
    beta: tuple[float, ...] = ()
    conventions: Conventions | None = None
    path: str = field(default="", compare=False)  # file that it was read from, if any; it says nothing of the arm

    def __post_init__(self) -> None:
        count = len(self.alpha)
        if not len(self.a) == len(self.d) == len(self.theta) == len(self.joints) == count:
            raise ProblemError(
                f"The DH table of '{self.name}' has {len(self.alpha)} alpha, {len(self.a)} a, {len(self.d)} d, "
                f"{len(self.theta)} theta for {len(self.joints)} joints",
                "Give one of each per joint",
            )
        if self.convention not in ("standard", "modified"):
            raise ProblemError(f"The DH convention is '{self.convention}'", "Use 'standard' or 'modified'")
        if not self.beta:
            object.__setattr__(self, "beta", (0.0,) * len(self.parallel))
        self._check_parallel()
        if self.conventions is not None:
            self.conventions.check_joints(count, self.name)

    def _check_parallel(self) -> None:
        count = len(self.alpha)
        rows = self.parallel
        if len(set(rows)) < len(rows) or any(row not in range(1, count) for row in rows) or sorted(rows) != list(rows):
            fix = f"Name rows of 1 to {count - 1} in order, each whose axis is parallel to the next one"
            raise ProblemError(f"The parallel rows of '{self.name}' are {list(rows)}", fix)
        if len(self.beta) != len(rows):
            what = f"The DH table of '{self.name}' has {len(self.beta)} beta for {len(rows)} parallel rows"
            raise ProblemError(what, "Give one beta for each row named in parallel")
        for row in rows:
            if abs(math.sin(self.twist(row))) > math.sin(NEARLY):
                raise ProblemError(
                    f"Row {row} of '{self.name}' is declared parallel, but its axis and the next one make "
                    f"{math.degrees(self.twist(row)):g} degrees",
                    "Name only rows whose axis is parallel to the next one; rows are counted from 1",
                )

    def twist(self, row: int) -> float:
        """Nominal angle, rad, between the axis of a row (from 1) and the next one."""
        return self.alpha[row - 1 if self.convention == "standard" else row]

    def parallel_axes(self) -> tuple[int, ...]:
        """Rows, from 1, whose axis is nominally parallel to the next one, declared or not."""
        return tuple(row for row in range(1, len(self.alpha)) if abs(math.sin(self.twist(row))) <= math.sin(NEARLY))

    def pose(self, p: Any, q: Expression) -> Expression:
        """Flange pose (4x4, mm) at `p.alpha`, `p.a`, `p.d`, `p.theta` (and `p.beta`) and joint values q."""
        q = q if self.conventions is None else self.conventions.to_model(q)
        links = []
        for i, joint in enumerate(self.joints):
            turns = joint.turns
            d, theta = p.d[i] + (0 if turns else q[i]), p.theta[i] + (q[i] if turns else 0)
            between = i + 1 if self.convention == "standard" else i  # the row whose twist stands in this link
            if between not in self.parallel:
                links.append((dh if self.convention == "standard" else modified_dh)(p.alpha[i], p.a[i], d, theta))
                continue
            beta = p.beta[self.parallel.index(between)]
            if self.convention == "standard":
                links.append(chain(translate(0, 0, d), hayati(p.alpha[i], beta, p.a[i], theta)))
            else:
                tilt = chain(rotate_x(p.alpha[i]), translate(p.a[i], 0, 0), rotate_y(beta))
                links.append(chain(tilt, rotate_z(theta), translate(0, 0, d)))
        return chain(*links)

    def parameters(self, length_std: Stds, angle_std: Stds, twist_std: Stds) -> dict[str, Unknown]:
        """The unknowns alpha, a, d, theta, and beta where axes are parallel; see `Robot.from_dh`."""
        twist_std = angle_std if twist_std is None else twist_std
        found: dict[str, Unknown] = {
            "alpha": Parameter(self.alpha, unit="rad", prior_std=twist_std),
            "a": Parameter(self.a, unit="mm", prior_std=length_std),
            "d": Parameter(self.d, unit="mm", prior_std=length_std),
            "theta": Parameter(self.theta, unit="rad", prior_std=angle_std),
        }
        if not self.parallel:
            return found
        free = tuple(row not in self.parallel for row in range(1, len(self.d) + 1))
        found["d"] = Parameter(self.d, unit="mm", prior_std=length_std, free=free)
        shift = 1 if self.convention == "standard" else 0  # where the twist beside each beta stands
        beside = None
        if twist_std is not None:
            stds = spread(twist_std, len(self.alpha), "twist_std")
            beside = tuple(float(stds[row - shift]) for row in self.parallel)
        labels = tuple(str(int(row)) for row in self.parallel)
        found["beta"] = Parameter(self.beta, unit="rad", prior_std=beside, labels=labels)
        return found

    def in_other_convention(self) -> DHTable:
        """The same numbers read by the other convention, which makes another arm of them."""
        other: Any = "modified" if self.convention == "standard" else "standard"
        return replace(self, convention=other, parallel=(), beta=())

    def at(self, p: Any) -> DHTable:
        """Copy with the numbers of `p`, such as those of a calibration."""
        keys = ("alpha", "a", "d", "theta", *(("beta",) if self.parallel else ()))
        columns = {key: tuple(float(v) for v in np.asarray(getattr(p, key), dtype=np.float64).ravel()) for key in keys}
        return replace(self, **columns)  # type: ignore[arg-type]
