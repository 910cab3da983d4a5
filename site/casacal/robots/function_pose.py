"""A pose that comes as a `casadi.Function`, as libraries of rigid-body kinematics give it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, Self

import casadi as ca
import numpy as np

from casacal.errors import CasacalError, ProblemError, came
from casacal.graphs import graph_data
from casacal.kinematics import Expression, rigid
from casacal.robots.joints import Joint, joints_of
from casacal.robots.traced_pose import TracedPose
from casacal.unknowns import Parameter, Unknown

LENGTHS = {"mm": 1.0, "m": 1e-3}
"""Units of length of such a function, and how many of them a millimetre is."""
WANTED = "a 4x4 or 3x4 matrix, or a position (3) and a rotation (3x3)"
NEARLY = 1e-6  # largest entry of R'R - 1 of a rotation: URDFs hold six digits of pi


class FromFunction:
    """What makes a robot of a function."""

    @classmethod
    def from_function(
        cls,
        name: str,
        function: ca.Function,
        *,
        length: Literal["m", "mm"],
        parameters: Mapping[str, Unknown] | None = None,
        joints: int | str | Sequence[Joint] | None = None,
        angle_std: float | None = None,
    ) -> Self:
        """Robot from a `casadi.Function` (SX or MX) of q (n) to the flange pose, as Pinocchio and the like give it.

        Args:
            name: what the report calls it.
            function: of q (rad, or `length` where a joint slides) and then the parameters' numbers, as one vector or
                several, to a 4x4 or 3x4 matrix or a position and a rotation. A 4x4 input before q is the base's pose.
            length: unit of every length that goes in or comes out.
            parameters: a `Parameter` for these numbers, in their order; those in "mm" are converted.
            joints: as for `Robot`; default all revolute.
            angle_std: of `zero` where the function takes no parameters, rad; default 1e-3.

        Returns:
            The robot with these parameters or, without any, `zero`: offsets of the joints that turn.

        Raises ProblemError for other shapes, and for a function that is no graph of elementary operations.

        """
        axes = joints_of(_count(function) if joints is None else joints)
        pose, unknowns = _traced(function, parameters or {}, axes, length, angle_std)
        return cls(name, axes, pose, unknowns)  # type: ignore[call-arg]  # of a robot


def _count(function: Any) -> int:
    """Number of joints that a function of q, or of a base's pose (4x4) and q, takes; raises ProblemError."""
    if not isinstance(function, ca.Function):
        raise ProblemError(f"Got {came(function)} as the function of a robot", "Give a casadi.Function of q")
    first = _first(function)
    if first >= function.n_in() or 1 not in function.size_in(first) or not function.numel_in(first):
        raise ProblemError(f"{_said(function)} takes no joint values", "Let its first input be q, a column")
    return int(function.numel_in(first))


def _offsets(joints: Sequence[Joint], std: float | None) -> dict[str, Unknown]:
    """The zero offsets (rad) of the joints that turn: what is unknown of a function that has no parameters."""
    turning = tuple(str(i) for i, joint in enumerate(joints, 1) if joint.turns)
    return {"zero": Parameter((0.0,) * len(turning), unit="rad", prior_std=std, labels=turning)} if turning else {}


def _traced(
    function: ca.Function, parameters: Mapping[str, Unknown], joints: Sequence[Joint], length: str, std: float | None
) -> tuple[TracedPose, Mapping[str, Unknown]]:
    """The flange pose of p and q as a graph, and the parameters; raises ProblemError."""
    if length not in LENGTHS:
        raise ProblemError(f"The length of a function is in {length!r}", 'Give "m" or "mm"')
    per_mm, first, count = LENGTHS[length], _first(function), _count(function)
    if len(joints) != count:
        raise ProblemError(
            f"{_said(function)} takes {count} joint values, and {len(joints)} joints came", "Give as many"
        )
    known = {key: each for key, each in parameters.items() if isinstance(each, Parameter)}
    for key, other in parameters.items():
        if key not in known:
            raise ProblemError(f"Parameter '{key}' of a function is {came(other)}", "Give numbers: Parameter(...)")
    sizes = [function.numel_in(i) for i in range(first + 1, function.n_in())]
    given = sum(each.nominal_size for each in known.values())
    if given != sum(sizes):
        what = f"{_said(function)} takes {sum(sizes)} numbers besides q, and the parameters are {given}"
        raise ProblemError(what, "Give one for each, in the order of its inputs")
    unknowns = known or _offsets(joints, std)
    turns = np.array([joint.turns for joint in joints])
    scale, turning = ca.DM(np.where(turns, 1.0, per_mm)), np.flatnonzero(turns).tolist()

    def pose(p: Any, q: Expression) -> Expression:
        numbers = [getattr(p, key) * (per_mm if each.unit == "mm" else 1.0) for key, each in known.items()]
        shifted = q * scale
        if not known and turning:
            shifted[turning] += p.zero
        parts = ca.vertsplit(ca.vertcat(*numbers), np.cumsum([0, *sizes]).tolist()) if sizes else []
        shaped = [ca.reshape(part, *function.size_in(first + 1 + i)) for i, part in enumerate(parts)]
        found = function.call([ca.DM.eye(4)] * first + [ca.reshape(shifted, *function.size_in(first)), *shaped])
        return _pose(function, found, per_mm)

    try:
        traced = TracedPose.of(pose, unknowns, count)
        graph_data(traced.graph)  # what saves, compiles and exports it needs as much
    except ProblemError:
        raise
    except (CasacalError, RuntimeError, NotImplementedError):
        what = f"{_said(function)} cannot be written out in elementary operations (SX), which every command needs"
        raise ProblemError(what, "Give one without callbacks, solvers, tables and external code") from None
    _check_rigid(function, traced, count)
    return traced, unknowns


def _first(function: ca.Function) -> int:
    """Which input is q: the second where the first is the pose of the base, as adam-robotics has it."""
    return int(function.n_in() > 1 and function.size_in(0) == (4, 4))


def _said(function: ca.Function) -> str:
    return f"The function '{function.name()}'"


def _pose(function: ca.Function, found: Sequence[Expression], per_mm: float) -> Expression:
    """Flange pose (4x4, mm) of what a function gives."""
    shapes = [tuple(each.shape) for each in found]
    if shapes in ([(4, 4)], [(3, 4)]):
        if shapes == [(4, 4)]:
            _check_last_row(function, ca.SX(found[0])[3, :3])
        turn, place = found[0][:3, :3], found[0][:3, 3]
    elif shapes in ([(3, 1), (3, 3)], [(1, 3), (3, 3)], [(3, 3), (3, 1)], [(3, 3), (1, 3)]):
        turn, place = sorted(found, key=lambda each: -int(each.numel()))
    else:
        gives = " and ".join(f"{rows}x{columns}" for rows, columns in shapes) or "nothing"
        raise ProblemError(f"{_said(function)} gives {gives}", f"Let it give the flange's pose: {WANTED}")
    return ca.densify(rigid(turn, ca.vec(place) / per_mm))


def _check_last_row(function: ca.Function, row: ca.SX) -> None:
    """Raise ProblemError where the last row of a pose does not begin with 0, 0, 0, as that of a transposed one."""
    symbols = ca.symvar(row)
    (value,) = ca.Function("row", symbols, [row]).call([ca.DM(0.1)] * len(symbols))
    if np.abs(np.array(value)).max() > NEARLY:
        what = f"{_said(function)} gives a matrix whose last row is not 0, 0, 0, 1"
        raise ProblemError(what, "Let it give the pose of the flange in the base frame, not a transposed one")


def _check_rigid(function: ca.Function, traced: TracedPose, count: int) -> None:
    """Raise ProblemError where a nominal pose holds no rotation."""
    values = [
        np.zeros(each.nominal_size) if each.nominal is None else each.nominal for each in traced.unknowns.values()
    ]
    joints = np.linspace(0.1, 0.2, count)
    pose = np.array(traced.graph(*values, joints), dtype=np.float64)
    turn = pose[:3, :3]
    if not np.isfinite(pose).all() or np.abs(turn.T @ turn - np.eye(3)).max() > NEARLY or np.linalg.det(turn) < 0:
        fix = "Let the first three columns of its matrix be a rotation, and let it be finite"
        raise ProblemError(f"{_said(function)} gives no rigid pose at the nominal values", fix)
