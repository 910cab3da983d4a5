"""Denavit-Hartenberg tables: nominal numbers, parallel axes, and what the controller's joints mean."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from casacal.errors import ProblemError
from casacal.model.joints import Conventions, Joint
from casacal.model.kinematics import Expression, chain, dh, hayati, modified_dh, rotate_x, rotate_y, rotate_z, translate
from casacal.model.unknown import Parameter, Unknown, spread

Stds = float | Sequence[float] | None
NEARLY = math.radians(5.0)  # angle below which axes count as parallel: the foot of their normal moves far too easily


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
    limited: bool = field(default=True, compare=False)  # whether a file that it was read from states joint limits
    note: str = field(default="", compare=False)  # what was done to the numbers of the file, in a sentence

    def __post_init__(self) -> None:
        count = len(self.alpha)
        sizes = {key: len(getattr(self, key)) for key in ("alpha", "a", "d", "theta")}
        if {*sizes.values()} != {len(self.joints)}:
            has = ", ".join(f"{size} {key}" for key, size in sizes.items())
            what = f"The DH table of '{self.name}' has {has} for {len(self.joints)} joints"
            raise ProblemError(what, "Give one of each per joint")
        if self.convention not in ("standard", "modified"):
            raise ProblemError(f"The DH convention is '{self.convention}'", "Use 'standard' or 'modified'")
        if not self.beta:
            object.__setattr__(self, "beta", (0.0,) * len(self.parallel))
        if self.conventions is not None:
            self.conventions.check_joints(count, self.name)
        rows = self.parallel
        if len(set(rows)) < len(rows) or any(row not in range(1, count) for row in rows) or sorted(rows) != list(rows):
            fix = f"Name rows of 1 to {count - 1} in order, each whose axis is parallel to the next one"
            raise ProblemError(f"The parallel rows of '{self.name}' are {list(rows)}", fix)
        if len(self.beta) != len(rows):
            what = f"The DH table of '{self.name}' has {len(self.beta)} beta for {len(rows)} parallel rows"
            raise ProblemError(what, "Give one beta for each row named in parallel")
        for row in rows:
            if row not in self.parallel_axes():
                make = f"its axis and the next one make {math.degrees(self.twist(row)):g} degrees"
                fix = "Name only rows whose axis is parallel to the next one; rows are counted from 1"
                raise ProblemError(f"Row {row} of '{self.name}' is declared parallel, but {make}", fix)

    def twist(self, row: int) -> float:
        """Nominal angle, rad, between the axis of a row (from 1) and the next one."""
        return self.alpha[row - 1 if self.convention == "standard" else row]

    def parallel_axes(self) -> tuple[int, ...]:
        """Rows, from 1, whose axis is nominally parallel to the next one, declared or not."""
        return tuple(row for row in range(1, len(self.alpha)) if abs(math.sin(self.twist(row))) <= math.sin(NEARLY))

    def with_feet_near(self) -> DHTable:
        """The same arm with Hayati's turn at all nearly parallel axes of a standard table, and d of these rows zero.

        Their common normals may stand hundreds of metres away. Each next axis is met where it pierces the plane across
        its own; what is left, a turn and a shift along that next axis, goes into theta and d of the next row.
        """
        alpha, a, d, theta = (list(each) for each in (self.alpha, self.a, self.d, self.theta))
        beta: list[float] = []
        for row in (rows := self.parallel_axes()):
            i = row - 1
            link = np.array(ca.DM(dh(alpha[i], a[i], d[i], theta[i])))
            foot = link[:3, 3] - link[:3, 2] * (link[2, 3] / link[2, 2])
            theta[i], a[i], d[i] = math.atan2(foot[1], foot[0]), math.hypot(foot[0], foot[1]), 0.0
            if abs(theta[i]) > math.pi / 2:  # a is negative, as in the maker's drawing
                theta[i], a[i] = math.remainder(theta[i] + math.pi, 2 * math.pi), -a[i]
            c, s = math.cos(theta[i]), math.sin(theta[i])
            x, y, z = c * link[0, 2] + s * link[1, 2], c * link[1, 2] - s * link[0, 2], link[2, 2]
            alpha[i], turned = math.atan2(-y, z), math.asin(x)
            beta.append(turned)
            rest = np.linalg.solve(np.array(ca.DM(hayati(alpha[i], turned, a[i], theta[i]))), link)
            theta[i + 1] = math.remainder(theta[i + 1] + math.atan2(rest[1, 0], rest[0, 0]), 2 * math.pi)
            d[i + 1] += float(rest[2, 3])
        columns = {"alpha": alpha, "a": a, "d": d, "theta": theta, "beta": beta}
        return replace(self, parallel=rows, **{key: tuple(map(float, each)) for key, each in columns.items()})  # type: ignore[arg-type]

    def pose(self, p: Any, q: Expression) -> Expression:
        """Flange pose (4x4, mm) at `p.alpha`, `p.a`, `p.d`, `p.theta` (and `p.beta`) and joint values q."""
        q = q if self.conventions is None else self.conventions.to_model(q)
        links, standard = [], self.convention == "standard"
        for i, joint in enumerate(self.joints):
            d, theta = p.d[i] + (0 if joint.turns else q[i]), p.theta[i] + (q[i] if joint.turns else 0)
            between = i + 1 if standard else i  # the row whose twist stands in this link
            if between not in self.parallel:
                links.append((dh if standard else modified_dh)(p.alpha[i], p.a[i], d, theta))
                continue
            beta = p.beta[self.parallel.index(between)]
            if standard:
                links.append(chain(translate(0, 0, d), hayati(p.alpha[i], beta, p.a[i], theta)))
            else:
                tilt = chain(rotate_x(p.alpha[i]), translate(p.a[i], 0, 0), rotate_y(beta))
                links.append(chain(tilt, rotate_z(theta), translate(0, 0, d)))
        return chain(*links)

    def parameters(self, length_std: Stds, angle_std: Stds, twist_std: Stds) -> dict[str, Unknown]:
        """The unknowns alpha, a, d, theta, and beta where axes are parallel; see `Robot.from_dh`."""
        twist_std = angle_std if twist_std is None else twist_std
        free = tuple(row not in self.parallel for row in range(1, len(self.d) + 1)) if self.parallel else True
        found: dict[str, Unknown] = {
            "alpha": Parameter(self.alpha, unit="rad", prior_std=twist_std),
            "a": Parameter(self.a, unit="mm", prior_std=length_std),
            "d": Parameter(self.d, unit="mm", prior_std=length_std, free=free),
            "theta": Parameter(self.theta, unit="rad", prior_std=angle_std),
        }
        if self.parallel:
            shift = 1 if self.convention == "standard" else 0  # where the twist beside each beta stands
            stds = None if twist_std is None else spread(twist_std, len(self.alpha), "twist_std")
            beta_std = None if stds is None else [float(stds[row - shift]) for row in self.parallel]
            labels = tuple(str(int(row)) for row in self.parallel)
            found["beta"] = Parameter(self.beta, unit="rad", prior_std=beta_std, labels=labels)
        return found

    def at(self, p: Any) -> DHTable:
        """Copy with the numbers of `p`, such as those of a calibration."""
        keys = ("alpha", "a", "d", "theta", *(("beta",) if self.parallel else ()))
        columns = {key: tuple(float(v) for v in np.asarray(getattr(p, key), dtype=np.float64).ravel()) for key in keys}
        return replace(self, **columns)  # type: ignore[arg-type]


def plain(value: float) -> str:
    """A number to twelve digits, without trailing zeros; zero, never -0, for what is rounding alone."""
    return f"{value:.12g}" if abs(value) > 1e-12 else "0"


def degrees(value: float) -> str:
    """An angle in rad, in degrees to twelve digits."""
    return plain(math.degrees(value))
