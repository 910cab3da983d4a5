"""A robot: joints, named kinematic parameters, the function that gives its flange pose, and joint values."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import casadi as ca
import numpy as np

from casacal.errors import CasacalError, ProblemError, SamplesError, came
from casacal.model.dh_table import DHTable, Stds
from casacal.model.joints import Conventions, Joint, joints_of
from casacal.model.kinematics import Expression
from casacal.model.traced_pose import Screws, TracedPose, joint_count, traced, traced_function, travels
from casacal.model.unknown import Unknown, check_own_kind
from casacal.values import Array, FrozenMapping, Rows, Value, alike, read_only, short

PoseFunction = Callable[[Any, Expression], Expression]
if TYPE_CHECKING:
    from casacal.data.samples import Samples
    from casacal.model.urdf import UrdfChain

Arm: TypeAlias = "DHTable | Screws | UrdfChain"
Joints: TypeAlias = int | str | Sequence[Joint]


@dataclass(frozen=True, eq=False)
class Robot(Value):
    """A serial arm whose flange pose is a function of named parameters and joint values.

    Args:
        name: what the report calls it.
        joints: a count, a word such as "RRPR", or a sequence of `Joint`.
        pose: `pose(p, q)` builds the 4x4 flange pose (mm) in the base frame from `p.<name>` (the parameters) and
            `q` (n; rad or mm), both CasADi symbols or plain floats.
        parameters: the named kinematic parameters.
        arm: the table, screws or URDF that pose and parameters come from, which exports write back; or None.

    """

    name: str
    joints: Joints
    pose: PoseFunction
    parameters: Mapping[str, Unknown]
    arm: Arm | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", joints_of(self.joints))
        object.__setattr__(self, "parameters", FrozenMapping(self.parameters))
        if not self.name.isprintable():
            raise ProblemError(f"A robot is named {self.name!r}", "Use letters that can be printed on one line")
        if not self.axes:
            raise ProblemError(f"Robot '{self.name}' has no joints", "Give at least one")
        for key, unknown in self.parameters.items():
            if not key.isidentifier():
                raise ProblemError(f"A parameter is named '{key}'", "Use a Python identifier, it becomes p.<name>")
            if not isinstance(unknown, Unknown):
                raise ProblemError(f"Robot parameter '{key}' is {came(unknown)}", f"Make it one: {key}=Parameter(...)")
            if unknown.per is not None:
                raise ProblemError(f"Robot parameter '{key}' is per '{unknown.per}'", "Only instruments vary by label")
            if unknown.nominal is None:
                raise ProblemError(f"Robot parameter '{key}' has no nominal value", "Give it the drawing's")
            check_own_kind(unknown, f"robot parameter '{key}'")

    @property
    def axes(self) -> tuple[Joint, ...]:
        """The joints, as a tuple of `Joint`."""
        return self.joints  # type: ignore[return-value]

    @cached_property
    def revolute(self) -> Rows:
        """Which joints turn (n,); the others slide."""
        return np.asarray(read_only(np.array([joint.turns for joint in self.axes], dtype=bool)))

    @cached_property
    def limits(self) -> tuple[Array, Array]:
        """Lower and upper joint limits, each (n,); rad, mm."""
        lower, upper = np.array([(joint.lower, joint.upper) for joint in self.axes]).T.copy()
        return read_only(lower), read_only(upper)

    @cached_property
    def traced(self) -> TracedPose:
        """The pose function as a graph; raises ProblemError when it fails or is no rigid motion."""
        made = TracedPose.of(partial(traced, self.pose, "pose", self.name, (4, 4)), self.parameters, len(self.axes))
        made.require_rigid(self.name, np.mean(self.limits, axis=0))
        return made

    def flange(self, p: Any, q: Expression) -> Expression:
        """The graph of `pose` (4x4, mm); raises ProblemError when it fails or is no rigid motion."""
        _ = self.traced
        return traced(self.pose, "pose", self.name, (4, 4), p, q)

    def with_gear_ratios(self, *ratios: float) -> Robot:
        """The robot with motor turns per joint turn, 0 where unknown; raises ProblemError."""
        if len(ratios) != len(self.axes):
            fix = "Give one for each joint, 0 where it is not known"
            raise ProblemError(f"Got {len(ratios)} gear ratios for {len(self.axes)} joints", fix)
        geared = (replace(joint, gear_ratio=ratio) for joint, ratio in zip(self.axes, ratios, strict=True))
        return replace(self, joints=tuple(geared))

    def in_other_convention(self) -> Robot | None:
        """The arm that its DH table makes when it is read by the other convention; None where it has no table."""
        if not isinstance(self.arm, DHTable):
            return None
        convention: Any = "modified" if self.arm.convention == "standard" else "standard"
        other = replace(self.arm, convention=convention, parallel=(), beta=())
        kept = {key: unknown for key, unknown in self.parameters.items() if key != "beta"}
        return replace(self, pose=other.pose, parameters=kept, arm=other)

    def __eq__(self, other: object) -> bool:
        """Whether both are the same arm: names, joints, parameters, and the graph that the pose function builds."""
        if self is other or not isinstance(other, Robot):
            return self is other
        mine, theirs = ((r.name, r.axes, r.parameters, r.arm) for r in (self, other))
        return alike(mine, theirs) and (self.pose == other.pose or self.traced == other.traced)

    def __hash__(self) -> int:
        return hash((self.name, self.axes))

    def __getstate__(self) -> dict[str, Any]:
        """State for pickling: a pose function that only this process knows goes as its graph."""
        state = super().__getstate__()
        return state if travels(self.pose) else state | {"pose": self.traced}

    def __repr__(self) -> str:
        kinds = "".join("R" if turns else "P" for turns in self.revolute)
        return f"<Robot {self.name}: joints {kinds}, parameters {short(list(self.parameters))}>"

    @staticmethod
    def from_dh(
        name: str,
        *,
        alpha: Sequence[float],
        a: Sequence[float],
        d: Sequence[float],
        theta: Sequence[float],
        length_std: Stds = None,
        angle_std: Stds = None,
        twist_std: Stds = None,
        joints: Joints | None = None,
        convention: Literal["standard", "modified"] = "standard",
        parallel: Sequence[int] = (),
        beta: Sequence[float] = (),
        conventions: Conventions | None = None,
    ) -> Robot:
        """Robot from a Denavit-Hartenberg table; row i is joint i, all 4 n entries are parameters.

        Args:
            alpha, theta: twists and zero offsets (n,), rad.
            a, d: lengths and offsets (n,), mm.
            length_std: prior standard deviation of a and d, one or one per row, mm; default 0.7
                (`casacal.uncertainty.learned_priors` says why).
            angle_std: of theta, and of alpha unless `twist_std` is given, rad; default 1e-3.
            twist_std: of alpha and beta, rad.
            joints: as for `Robot`; default all revolute. A prismatic joint adds its value to d, not to theta.
            convention: "standard" (eq (1) of arXiv:2208.02652) or "modified" (Craig's).
            parallel: rows, from 1, whose axis is nominally parallel to the next one, such as (2, 3) for a UR: there
                Hayati's turn `beta` about y becomes a parameter and d is held, so that lengths stay what they are.
            beta: nominal turn of each of them, rad; default zero.
            conventions: then `pose` takes the controller's joint values, and limits are the controller's too.

        Raises ProblemError when the columns differ in length, or a row is not parallel that is named so.

        """
        table = DHTable(
            name=name,
            alpha=tuple(alpha),
            a=tuple(a),
            d=tuple(d),
            theta=tuple(theta),
            joints=joints_of(len(alpha) if joints is None else joints),
            convention=convention,
            parallel=tuple(parallel),
            beta=tuple(beta),
            conventions=conventions,
        )
        return Robot(name, table.joints, table.pose, table.parameters(length_std, angle_std, twist_std), table)

    @staticmethod
    def from_dh_file(
        path: str | Path, *, length_std: Stds = None, angle_std: Stds = None, twist_std: Stds = None
    ) -> Robot:
        """Robot from a DH table in CSV or TOML, as docs/files.md has them; raises ProblemError that names the place."""
        from casacal.model.dh_file import read_dh_file

        table = replace(read_dh_file(path), path=str(Path(path).resolve()))
        return Robot(table.name, table.joints, table.pose, table.parameters(length_std, angle_std, twist_std), table)

    @staticmethod
    def from_urdf(
        path: str | Path,
        *,
        tip: str | None = None,
        base: str | None = None,
        name: str | None = None,
        length_std: float | None = None,
        angle_std: float | None = None,
        conventions: Conventions | None = None,
    ) -> Robot:
        """Robot from the joints of a URDF between two links; parameters are the origins of the joints that move.

        x, y, z (n, mm) are the origins' places, rx, ry, rz (n, rad, nominally zero) small turns of each joint's frame
        about its own axes. That is more than samples can tell apart; the identifiability report names the redundant
        directions, and the prior holds them. Fixed joints are folded in; limits are the file's, +-pi where continuous.

        Args:
            path: the URDF, xacro already expanded.
            tip: link that is the flange; default the only link that holds no other.
            base: link that is the base frame; default the root.
            name: what the report calls it; default the file's name for the robot.
            length_std: prior standard deviation of x, y, z, mm; default 0.7.
            angle_std: of rx, ry, rz, rad; default 1e-3.
            conventions: what the controller's joint values mean, where they are not the URDF's.

        Raises ProblemError that names the joint or link, and what to do.

        """
        from casacal.model.urdf import UrdfChain

        arm = UrdfChain.read(path, base, tip, conventions)
        return Robot(name or arm.name, arm.joints, arm.pose, arm.parameters(length_std, angle_std), arm)

    @staticmethod
    def from_screws(
        name: str,
        *,
        axes: Sequence[Sequence[float]],
        points: Sequence[Sequence[float]],
        home: Sequence[Sequence[float]],
        length_std: float | None = None,
        angle_std: float | None = None,
        joints: Joints | None = None,
        conventions: Conventions | None = None,
    ) -> Robot:
        """Robot from the axes of its joints at q = 0: a product of exponentials (Lynch & Park, eq (4.14)).

        Args:
            axes: direction (n, 3) of each joint in the base frame.
            points: a point (n, 3) on each axis, mm; a sliding joint's plays no part.
            home: flange pose (4x4, mm).
            length_std: prior standard deviation of points and home, mm; default 0.7.
            angle_std: of the axes' two tilts, zero offsets and home, rad; default 1e-3.
            joints: as for `Robot`; default all revolute.
            conventions: what the controller's joint values mean, where they are not the screws'.

        Unknowns are `axis1`, ... (two tilts each), `point1`, ... (3, mm), `zero` (one per turning joint) and `home`.

        Raises ProblemError when the columns differ in length or an axis has no direction.

        """
        kinds = joints_of(len(axes) if joints is None else joints)
        rows: Any = [tuple(tuple(map(float, np.ravel(row))) for row in column) for column in (axes, points, home)]
        arm = Screws(name=name, axes=rows[0], points=rows[1], home=rows[2], joints=kinds, conventions=conventions)
        return Robot(name, kinds, arm.pose, arm.parameters(length_std, angle_std), arm)

    @staticmethod
    def from_function(
        name: str,
        function: ca.Function,
        *,
        length: Literal["m", "mm"],
        parameters: Mapping[str, Unknown] | None = None,
        joints: Joints | None = None,
        angle_std: float | None = None,
    ) -> Robot:
        """Robot from a `casadi.Function` (SX or MX) of q (n) to the flange pose, as Pinocchio and the like give it.

        Args:
            name: what the report calls it.
            function: of q (rad, or `length` where a joint slides) and then the parameters' numbers, as one vector or
                several, to a 4x4 or 3x4 matrix or a position and a rotation. A 4x4 input before q is the base's pose.
            length: unit of every length that goes in or comes out.
            parameters: a `Parameter` for these numbers, in their order; those in "mm" are converted.
            joints: as for `Robot`; default all revolute.
            angle_std: of `zero`, the offsets of turning joints, where it takes no parameters, rad; default 1e-3.

        Raises ProblemError for other shapes, and for a function that is no graph of elementary operations.

        """
        axes = joints_of(joint_count(function) if joints is None else joints)
        pose, unknowns = traced_function(function, parameters or {}, axes, length, angle_std)
        return Robot(name, axes, pose, unknowns)


AXIS_WEIGHT = 300.0  # millimetres at the tip that weigh as much as one radian of plunger direction


DRAWS = 100  # after which one posture in twenty would have been found


def joint_values(q: Any, robot: Robot) -> Array:
    """Joint values (N, n; rad, mm) of an arm from one row (n,) or several (N, n); raises CasacalError for others."""
    wanted = f"Give {len(robot.axes)} numbers per row, in rad (sliding joints in mm)"
    try:
        values = np.array(q, dtype=np.float64)
    except (TypeError, ValueError):
        raise CasacalError(f"Got {came(q)} as joint values of '{robot.name}'", wanted) from None
    values = values[None] if values.ndim == 1 else values
    if values.ndim != 2 or values.shape[1] != len(robot.axes):
        raise CasacalError(f"Joint values of '{robot.name}' came with the shape {np.shape(q)}", wanted)
    if not np.isfinite(values).all():
        raise CasacalError(f"A joint value of '{robot.name}' is not finite", wanted)
    return values


def random_joints(robot: Robot, count: int, rng: np.random.Generator) -> Array:
    """Joint values (count, n; rad, mm), uniform between the limits where the pose of the arm as drawn is a number.

    Raises ProblemError when it hardly ever is: the loops of a closed chain stay open.
    """
    found = rng.uniform(*robot.limits, size=(count, len(robot.axes)))
    for _ in range(DRAWS):
        if not (missing := np.flatnonzero(~robot.traced.closed(found, nearby=True))).size:
            return found
        found[missing] = rng.uniform(*robot.limits, size=(missing.size, len(robot.axes)))
    what = f"The pose of '{robot.name}' is a number in hardly any posture between its joint limits"
    fix = "Look at home and start of its loops and at what stands under roots and fractions, or narrow the limits"
    raise ProblemError(what, fix)


def refuse_open(robot: Robot, rows: Samples, closed: Rows) -> None:
    """Raise SamplesError that names the rows in which the pose is not a number, where there are any."""
    lines = [rows.lines[row] for row in np.flatnonzero(~closed).tolist()]
    if lines:
        what = f"the pose of '{robot.name}' is not a number at these joint values, as of a loop that does not close"
        fix = "Check them; where they are right, lengths, or home and start of a loop, are not"
        raise SamplesError(rows.file, what, fix, line=lines[0], also=lines[1:])


def inside_limits(robot: Robot, joints: Array, *, slack: float = 0.0) -> Rows:
    """Which postures (N, n; rad, mm) are inside the limits of all joints (N,), or beyond by no more than the slack."""
    lower, upper = robot.limits
    return np.asarray(((joints >= lower - slack) & (joints <= upper + slack)).all(axis=1))


def joint_units(robot: Robot) -> Array:
    """Unit of motion of each joint (n,): one radian, or the mm that count as much."""
    return np.where(robot.revolute, 1.0, AXIS_WEIGHT)
