"""Any pose as a function of joint values: screw axes, how small errors move it, and poses that come as functions."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from casacal.errors import CasacalError, ProblemError, came, said
from casacal.kernels.block_rows import Batch
from casacal.kernels.program import Program, calls, evaluate, graph_data, may_be_no_number, read_program
from casacal.model.geometry import Direction, Frame, packed_symbols
from casacal.model.joints import Conventions, Joint
from casacal.model.kinematics import Expression, Product, chain, position, rigid, screw, slide
from casacal.model.unknown import PRIOR_STD, Parameter, Unknown
from casacal.user_code import line_of
from casacal.values import Array, FrozenMapping, Names, Rows, Value

Triple = tuple[float, float, float]

RIGID = 1e-4  # largest error of R^T R, and of the last row, of what still counts as a rigid pose: 0.05 mm a metre


@dataclass(frozen=True, kw_only=True)
class Screws:
    """axes: direction (3,) of each joint; points: a point (3, mm) on each; home: flange pose (4x4, mm), all at q = 0.

    pose(q) = e^[S_1 q_1] ... e^[S_n q_n] home, eq (4.14) of Lynch & Park, Modern Robotics (2017). A sliding joint
    has no place, so its point plays no part. Raises ProblemError when the columns differ in length.
    """

    name: str
    axes: tuple[Triple, ...]
    points: tuple[Triple, ...]
    home: tuple[tuple[float, ...], ...]
    joints: tuple[Joint, ...]
    conventions: Conventions | None = None

    def __post_init__(self) -> None:
        count = len(self.joints)
        if not len(self.axes) == len(self.points) == count:
            are = f"{len(self.axes)} axes and {len(self.points)} points for {count} joints"
            raise ProblemError(f"The screws of '{self.name}' are {are}", "Give one of each per joint")
        for what, rows in (("axis", self.axes), ("point", self.points)):
            for i, row in enumerate(rows, 1):
                if len(row) != 3:
                    raise ProblemError(f"The {what} of joint {i} of '{self.name}' is {row}", "Give three numbers")
        if self.conventions is not None:
            self.conventions.check_joints(count, self.name)

    def pose(self, p: Any, q: Expression) -> Expression:
        """Flange pose (4x4, mm) at `p.axis1`, `p.point1`, ..., `p.zero`, `p.home` and joint values q."""
        q = q if self.conventions is None else self.conventions.to_model(q)
        links, turned = [], 0
        for i, joint in enumerate(self.joints):
            axis = getattr(p, f"axis{i + 1}")
            if joint.kind == "prismatic":
                links.append(slide(axis, q[i]))
            else:
                links.append(screw(axis, getattr(p, f"point{i + 1}"), q[i] + p.zero[turned]))
                turned += 1
        return chain(*links, p.home)

    def parameters(self, length_std: float | None, angle_std: float | None) -> dict[str, Unknown]:
        """Unknowns axis1, ... (two tilts), point1, ... (3, mm; turning joints alone), zero (turning joints), home.

        They are more than a minimal set: shifts of a point along its axis are invisible, and a zero offset also turns
        all that follows. Each is what a maker tolerates, so that a prior can be given; the report names the redundant.
        """
        length_std = PRIOR_STD["mm"] if length_std is None else length_std
        angle_std = PRIOR_STD["rad"] if angle_std is None else angle_std
        found: dict[str, Unknown] = {}
        turning = [i for i, joint in enumerate(self.joints, 1) if joint.turns]
        for i, (axis, point) in enumerate(zip(self.axes, self.points, strict=True), 1):
            found[f"axis{i}"] = Direction(axis, prior_std=angle_std)
            if i in turning:
                found[f"point{i}"] = Parameter(point, unit="mm", prior_std=length_std, labels=("_x", "_y", "_z"))
        if turning:
            labels = tuple(str(i) for i in turning)
            found["zero"] = Parameter((0.0,) * len(turning), unit="rad", prior_std=angle_std, labels=labels)
        found["home"] = Frame(self.home, prior_std=(angle_std, length_std))
        return found


OFF, ARMS = 3.0, 8  # standard deviations by which so many other arms differ from the drawn one


@dataclass(frozen=True, eq=False)
class TracedPose(Value):
    """`pose(p, q)` as a graph: the parameters' values, by key, and q give the factors of the 4x4 flange pose (mm).

    Two are equal when their graphs are, instruction by instruction.
    """

    unknowns: Mapping[str, Unknown]
    graph: ca.Function

    @staticmethod
    def of(pose: Callable[[Any, Expression], Expression], parameters: Mapping[str, Unknown], joints: int) -> TracedPose:
        """Trace a pose function; lets pass what the function raises."""
        q = ca.SX.sym("q", joints)
        symbols, values = packed_symbols(parameters)
        built = pose(Names(**values), q)
        factors = [ca.SX(f) for f in built.factors] if isinstance(built, Product) else [ca.SX(built)]
        return TracedPose(FrozenMapping(parameters), ca.Function("pose", [*symbols, q], factors))

    def __call__(self, p: Any, q: Expression) -> Expression:
        """The flange pose, as the function that was traced gives it."""
        values = [unknown.packed(getattr(p, key)) for key, unknown in self.unknowns.items()]
        factors = self.graph.call([*values, q])
        return factors[0] if len(factors) == 1 else Product(factors)

    @property
    def drawn(self) -> dict[str, Any]:
        """Values of the parameters by key, as `pose` takes them, of the arm as drawn."""
        return {
            key: unknown.at(ca.DM(np.asarray(unknown.nominal)), ca.DM.zeros(unknown.size))
            for key, unknown in self.unknowns.items()
        }

    def at_drawn(self, q: Expression) -> Expression:
        """The flange pose of the arm as drawn."""
        return self(Names(**self.drawn), q)

    @property
    def joints(self) -> int:
        """Number of joint values in q."""
        return int(self.graph.size1_in(self.graph.n_in() - 1))

    def closed(self, joints: Array, *, nearby: bool = False) -> Rows:
        """In which postures (N, n) the pose of the arm as drawn is a number (N,), and of arms as priors allow them."""
        if not self._may_be_open:
            return np.ones(len(joints), dtype=bool)
        values = self._arms if nearby else [each[:, :1] for each in self._arms]
        if self._program is None:  # it calls other functions, which know rows alone
            arms = zip(*(each.T for each in values), strict=True)
            found = [np.hstack(Batch(self.graph)(*arm, joints)) for arm in arms]
            return np.asarray(np.isfinite(found).all(axis=(0, 2)))
        given = [*(each[..., None] for each in values), joints.T[:, None]]
        return np.asarray(np.isfinite(evaluate(self._program, self._program.results, given)).all(axis=(0, 1)))

    @cached_property
    def _may_be_open(self) -> bool:
        return may_be_no_number(self.graph)

    @cached_property
    def _program(self) -> Program | None:
        return None if calls(self.graph) else read_program(self.graph, ["lane"] * self.graph.n_in(), ahead=False)

    @cached_property
    def _arms(self) -> list[Array]:
        """Values of each parameter (numbers, 1 + ARMS): of the arm as drawn, and others OFF deviations off."""
        rng, found = np.random.default_rng(0), []
        for each in self.unknowns.values():
            off = OFF * each.start_stds[:, None] * rng.choice((-1.0, 0.0, 1.0), (each.size, 1 + ARMS))
            off[:, 0] = 0.0
            values = (each.packed(each.at(ca.DM(np.asarray(each.nominal)), ca.DM(local))) for local in off.T)
            found.append(np.column_stack([np.array(ca.DM(value)).ravel(order="F") for value in values]))
        return found

    @cached_property
    def levers(self) -> ca.Function:
        """q -> derivative (3, n) of the flange's origin by the joint values, mm, of the arm as drawn."""
        q = ca.SX.sym("q", self.joints)
        return ca.Function("levers", [q], [ca.densify(ca.jacobian(position(self.at_drawn(q)), q))])

    def require_rigid(self, owner: str, middle: Array) -> None:
        """Raise ProblemError where the arm as drawn stretches, bends or mirrors its flange, amid the limits or nearby.

        Where a loop does not close the pose is not a number, and nothing is said of it here.
        """
        for q in (*np.random.default_rng(0).uniform(-1, 1, (3, self.joints)), middle):
            try:
                pose = np.array(ca.DM(self.at_drawn(ca.DM(q))))
            except RuntimeError:  # of a function that is called
                continue
            if not np.isfinite(pose).all():
                continue
            turn = pose[:3, :3]
            bent = np.abs(turn.T @ turn - np.eye(3)).max()
            if bent > RIGID:
                what = f"is no rigid motion (R^T R is off by {bent:.2g})"
            elif np.linalg.det(turn) < 0:
                what = "mirrors (det R = -1)"
            elif np.abs(pose[3] - (0, 0, 0, 1)).max() > RIGID:
                what = f"has the last row {pose[3].round(3).tolist()} in place of 0, 0, 0, 1"
            else:
                continue
            fix = "Look at the signs of its sines and cosines; casacal.model.kinematics has matrices that are right"
            raise ProblemError(f"The pose of '{owner}' {what}, at the joint values {q.round(3).tolist()}", fix)

    @cached_property
    def text(self) -> str:
        """The graph as text."""
        return str(self.graph.serialize())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TracedPose) and list(self.unknowns) == list(other.unknowns) and self.text == other.text

    def __hash__(self) -> int:
        return hash(self.text)


def traced(
    call: Any, what: str, owner: str, shape: tuple[int, int] | None, *arguments: Any, optional: bool = False
) -> Any:
    """Expression built by a user's function, of that shape or a column; (0, 1) for an optional None.

    Raises ProblemError, with the line of the user's file where that is known, when it fails or builds another shape.
    """
    try:
        built = call(*arguments)
        if built is None and not optional:
            raise TypeError("it returns nothing")
        if built is None:
            return ca.SX(0, 1)
        value = built if isinstance(built, Product) else ca.SX(built)
        found = value.shape  # a product is multiplied out here, so that factors that do not fit are found
    except (Exception, SystemExit) as error:  # whatever a user's function raises, it is their file that must change
        code = None if str(call.__module__).startswith("casacal.") else getattr(call, "__code__", None)
        place = f"{line_of(Path(code.co_filename), error)}: " if code else ""
        fix = "It must build CasADi expressions from its arguments; see casacal.model.kinematics"
        raise ProblemError(f"{place}{what} of '{owner}' failed with {said(error)}", fix) from error
    if found != shape and (shape is not None or found[1] != 1):
        wanted = "a scalar or a column" if shape is None else f"{shape}"
        raise ProblemError(f"{what} of '{owner}' has the shape {found}", f"It must be {wanted}")
    return value


def travels(function: Callable[..., Any]) -> bool:
    """Whether a function can be found by its name wherever its package is installed."""
    module = getattr(function, "__module__", None) or type(function).__module__
    if module == "__main__" or module not in sys.modules:
        return False
    try:
        return pickle.loads(pickle.dumps(function)) is not None
    except Exception:  # closures, lambdas, and whatever a user's object raises
        return False


LENGTHS = {"mm": 1.0, "m": 1e-3}  # units of length of such a function, and how many of them a millimetre is
WANTED = "a 4x4 or 3x4 matrix, or a position (3) and a rotation (3x3)"
NEARLY = 1e-6  # largest entry of R'R - 1 of a rotation: URDFs hold six digits of pi


def joint_count(function: Any) -> int:
    """Number of joints that a function of q, or of a base's pose (4x4) and q, takes; raises ProblemError."""
    if not isinstance(function, ca.Function):
        raise ProblemError(f"Got {came(function)} as the function of a robot", "Give a casadi.Function of q")
    first = _first(function)
    if first >= function.n_in() or 1 not in function.size_in(first) or not function.numel_in(first):
        raise ProblemError(f"{_said(function)} takes no joint values", "Let its first input be q, a column")
    return int(function.numel_in(first))


def traced_function(
    function: ca.Function, parameters: Mapping[str, Unknown], joints: Sequence[Joint], length: str, std: float | None
) -> tuple[TracedPose, Mapping[str, Unknown]]:
    """The flange pose of p and q as a graph, and the parameters; raises ProblemError."""
    if length not in LENGTHS:
        raise ProblemError(f"The length of a function is in {length!r}", 'Give "m" or "mm"')
    per_mm, first, count = LENGTHS[length], _first(function), joint_count(function)
    if len(joints) != count:
        what = f"{_said(function)} takes {count} joint values, and {len(joints)} joints came"
        raise ProblemError(what, "Give as many")
    known = {key: each for key, each in parameters.items() if isinstance(each, Parameter)}
    for key, other in parameters.items():
        if key not in known:
            raise ProblemError(f"Parameter '{key}' of a function is {came(other)}", "Give numbers: Parameter(...)")
    sizes = [function.numel_in(i) for i in range(first + 1, function.n_in())]
    numbers = sum(each.nominal_size for each in known.values())
    if numbers != sum(sizes):
        what = f"{_said(function)} takes {sum(sizes)} numbers besides q, and the parameters are {numbers}"
        raise ProblemError(what, "Give one for each, in the order of its inputs")
    turns = np.array([joint.turns for joint in joints])
    scale, turning = ca.DM(np.where(turns, 1.0, per_mm)), np.flatnonzero(turns).tolist()
    unknowns: dict[str, Unknown] = {**known}
    if not known and turning:
        labels = tuple(str(j + 1) for j in turning)
        unknowns["zero"] = Parameter((0.0,) * len(turning), unit="rad", prior_std=std, labels=labels)

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
    values = [np.zeros(each.nominal_size) if each.nominal is None else each.nominal for each in unknowns.values()]
    found = np.array(traced.graph(*values, np.linspace(0.1, 0.2, count)), dtype=np.float64)
    turn = found[:3, :3]
    if not np.isfinite(found).all() or np.abs(turn.T @ turn - np.eye(3)).max() > NEARLY or np.linalg.det(turn) < 0:
        fix = "Let the first three columns of its matrix be a rotation, and let it be finite"
        raise ProblemError(f"{_said(function)} gives no rigid pose at the nominal values", fix)
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
            row = ca.SX(found[0])[3, :3]  # where it does not begin with 0, 0, 0, it is a column, of a transposed pose
            symbols = ca.symvar(row)
            (value,) = ca.Function("row", symbols, [row]).call([ca.DM(0.1)] * len(symbols))
            if np.abs(np.array(value)).max() > NEARLY:
                what = f"{_said(function)} gives a matrix whose last row is not 0, 0, 0, 1"
                raise ProblemError(what, "Let it give the pose of the flange in the base frame, not a transposed one")
        turn, place = found[0][:3, :3], found[0][:3, 3]
    elif shapes in ([(3, 1), (3, 3)], [(1, 3), (3, 3)], [(3, 3), (3, 1)], [(3, 3), (1, 3)]):
        turn, place = sorted(found, key=lambda each: -int(each.numel()))
    else:
        gives = " and ".join(f"{rows}x{columns}" for rows, columns in shapes) or "nothing"
        raise ProblemError(f"{_said(function)} gives {gives}", f"Let it give the flange's pose: {WANTED}")
    return ca.densify(rigid(turn, ca.vec(place) / per_mm))
