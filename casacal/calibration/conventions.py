"""Joints counted otherwise than the problem says, as their makers count them.

Signs of all joints, quarter turns of those in the middle, joint 3 measured against joint 2: some 50,000 patterns, whose
tips all come of a few matrix products. Each is judged by what the tips leave of a shape: points of a tracker are an
affine image of them, touches of a face lie on a plane, those of a sphere and the ends of a wire on a quadric. The best
few are then fitted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from casacal.calibration.finding import Fault, Undone
from casacal.data.samples import Samples
from casacal.errors import CasacalError
from casacal.fit.nominal import nominal_sight
from casacal.model.axes import Axes, axes_of
from casacal.model.joints import Conventions
from casacal.model.problem import Problem
from casacal.model.problem_text import conventions_line
from casacal.model.robot import Robot, inside_limits
from casacal.values import Array, Index

MOST_JOINTS = 7
QUARTERED = range(1, 5)  # joints, from 0, whose zero makers put a quarter turn elsewhere; the first only turns the base
MOST_ROWS, MOST_GROUPS = 24, 3  # rows of a label, and labels, by which patterns are judged
SPARE = 3  # rows of a label beyond those that its shape takes up
BETTER, NEAR = 0.25, 3.0  # part of what the plain pattern leaves, and times the least, that a pattern may leave
FITTED = 8  # patterns that are fitted, the simplest first
BEYOND_LIMITS = 20  # changes that a pattern must spare to be believed though joints leave their limits
CONVENTIONS = "joint conventions"


def patterns(problem: Problem, samples: Samples) -> Iterator[Fault]:
    """Conventions of two changes or more under which the tips lie about as well as under any, the likeliest first.

    Those that keep the joints within their limits come first, then the simplest. Nothing where the tips lie nearly as
    well as it is, nor for an arm that is not one turn or slide per joint.
    """
    count = len(problem.robot.axes)
    if count > MOST_JOINTS:
        return
    try:
        axes, sight = axes_of(problem.robot), nominal_sight(problem, 0, samples)
    except CasacalError:
        return
    plain = np.tile((1, 0, 0), (count, 1))
    if count > 2:
        plain[2, 2] = axes.mixing[2, 1]
    if not np.array_equal(axes.mixing, np.eye(count) + np.diag(plain[1:, 2], -1)):  # the arm couples other joints
        return
    settings = settings_of(axes.turns)
    places = np.indices([len(some) for some in settings]).reshape(count, -1)
    changes = sum((some != own).sum(axis=1)[at] for some, own, at in zip(settings, plain, places, strict=True))
    local = np.einsum("nij,ni->nj", sight.poses[:, :3, :3], sight.tips - sight.poses[:, :3, 3])
    points, q = local @ axes.turn.T + axes.place, samples.joints
    left = _left(problem, samples, sight.columns, lambda rows: tips_of(axes, settings, q[rows], points[rows]))
    near = np.flatnonzero((left <= NEAR * left.min()) & (left <= BETTER * left[changes == 0]) & (changes > 1))
    found = []
    for at in near[np.lexsort((left[near], changes[near]))][: FITTED * FITTED].tolist():
        pattern = np.array([some[place] for some, place in zip(settings, places[:, at], strict=True)])
        found.append(_fault(problem, samples, axes.mixing, pattern, plain))
    yield from sorted(found, key=lambda fault: fault.freedom)[:FITTED]


def settings_of(turns: Sequence[bool]) -> list[Index]:
    """Every setting (k, 3) that is tried of each joint: sign, quarter turns, how it is measured against the last."""
    found = []
    for k, turning in enumerate(turns):
        quarters = (0, 1, 2, -1) if turning and k in QUARTERED and k < len(turns) - 1 else (0,)
        factors = (0, 1, -1) if k == 2 and turning and turns[1] else (0,)
        found.append(np.array([(sign, quarter, f) for f in factors for quarter in quarters for sign in (1, -1)]))
    return found


def tips_of(axes: Axes, settings: Sequence[Index], q: Array, points: Array) -> Array:
    """Tips (N, 3, P; mm) of every pattern at joint values (N, n) of points (N, 3) on the arm at its zero.

    The setting of the last joint runs fastest, that of the first slowest.
    """
    middle = (len(settings) + 1) // 2
    right = _carried(axes, settings, range(middle, len(settings)), q, points[None])
    frame = np.broadcast_to(np.vstack([np.zeros(3), np.eye(3)])[:, None], (4, len(q), 3))
    left = _carried(axes, settings, range(middle), q, frame).reshape(-1, 4, len(q), 3)
    turn = (left[:, 1:] - left[:, :1]).transpose(2, 3, 0, 1)  # (N, 3, left, 3)
    tips = turn.reshape(len(q), -1, 3) @ right.transpose(1, 2, 0)
    tips = tips.reshape(len(q), 3, len(left), len(right)) + left[:, 0].transpose(1, 2, 0)[..., None]
    return np.asarray(tips.reshape(len(q), 3, -1))


def _carried(axes: Axes, settings: Sequence[Index], joints: range, q: Array, points: Array) -> Array:
    """Points (H, N, 3) moved by some joints under all of their settings (H', N, 3)."""
    for k in reversed(joints):
        sign, quarter, factor = settings[k].T[:, :, None]
        motion = sign * (q[:, k] + factor * q[:, k - 1]) + quarter * (math.pi / 2)
        points = axes.carry(k, motion[:, None], points[None]).reshape(-1, *points.shape[1:])
    return points


def _left(problem: Problem, samples: Samples, columns: Mapping[str, Array], tips_of: Callable[[Index], Array]) -> Array:
    """RMS distance (P,; mm, infinite without enough rows of a label) of all tips from what the readings allow.

    tips_of: tips (N, 3, P) of some rows.
    """
    instrument, few = problem.instrument, problem.models[0].components < 3
    quadric = few and instrument.probe is None
    datum = [unknown for key, unknown in instrument.unknowns.items() if key in instrument.datum]
    faces = samples.faces(next((unknown.per for unknown in datum if unknown.per), None))
    lengths = [values for name, values in columns.items() if instrument.columns.get(name, "length") == "length"]
    squares, free = np.array(0.0), 0
    for rows in sorted(faces.rows().values(), key=len, reverse=True)[:MOST_GROUPS]:
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, MOST_ROWS).astype(np.intp))]
        known = [] if instrument.probe is not None else [values[rows] for values in lengths]
        shape = np.column_stack([np.ones(len(rows)), *known, *(values**2 for values in known if quadric)])
        beside = np.linalg.qr(shape / np.abs(shape).max(axis=0).clip(1e-300), mode="complete")[0][:, shape.shape[1] :]
        spare = beside.shape[1] - (3 + quadric if few else 0)
        if spare < SPARE:
            continue
        tips = tips_of(rows)
        if quadric:
            far = (tips**2).sum(axis=1, keepdims=True)
            tips = np.concatenate([tips, far / (2 * math.sqrt(float(far.mean())))], axis=1)
        off = np.tensordot(beside.T, tips, 1)
        if few:  # the combination of coordinates that varies least
            scatter = np.einsum("mip,mjp->pij", off, off)
            narrow = np.linalg.inv(scatter + 1e-9 * np.eye(scatter.shape[1]))
            squares = squares + 1 / np.trace(narrow, axis1=1, axis2=2)
        else:
            squares = squares + (off**2).sum(axis=(0, 1))
        free += spare
    return np.sqrt(squares / free) if free else np.array([math.inf])


def _fault(problem: Problem, samples: Samples, mixing: Array, pattern: Index, plain: Index) -> Fault:
    """A pattern (n, 3) as a fault, of more freedom where joints would leave their limits."""
    robot, inverse = problem.robot, np.linalg.inv(mixing)
    (sign, quarter, factor), changed = pattern.T.tolist(), np.flatnonzero((pattern != plain).any(axis=1)).tolist()
    coupling = ((3, 2, float(factor[2])),) if any(factor) else ()
    meant = Conventions(tuple(sign), tuple(turn * math.pi / 2 for turn in quarter), coupling)

    def undo(problem: Problem, samples: Samples) -> Undone:
        return Undone(problem, replace(samples, joints=meant.to_model(samples.joints) @ inverse.T))

    freedom = int((pattern != plain).sum())
    if not inside_limits(robot, undo(problem, samples).samples.joints).all():
        freedom += BEYOND_LIMITS
    counted = []  # how joints are counted: "q3 as q2 - q3"
    for k in changed:
        terms = [(sign[k] * factor[k], f"q{k}"), (sign[k], f"q{k + 1}"), (quarter[k], f"{90 * abs(quarter[k])}")]
        plus, minus = " + ".join(name for value, name in terms if value > 0), [n for value, n in terms if value < 0]
        counted.append(f"q{k + 1} as {' - '.join([plus, *minus]) if plus else '-' + ' - '.join(minus)}")
    cause = f"the controller seems to count joints otherwise: {', '.join(counted)}"
    fix = f"Compare four poses of the pendant (casacal doctor), and write into the problem{in_problem(robot, meant)}"
    return Fault(CONVENTIONS, cause, fix, undo, freedom, common=False)


def in_problem(robot: Robot, meant: Conventions) -> str:
    """The line of a problem with conventions (of the arm's axes) beside those that it has; empty where it has none."""
    if robot.arm is None:
        return ""
    own = robot.arm.conventions or Conventions.plain(len(meant.signs))
    signs = tuple(a * b for a, b in zip(own.signs, meant.signs, strict=True))
    offsets = tuple(a + s * b for s, a, b in zip(own.signs, own.offsets, meant.offsets, strict=True))
    return f", with the limits: {conventions_line(Conventions(signs, offsets, meant.coupling), robot.axes)}"
