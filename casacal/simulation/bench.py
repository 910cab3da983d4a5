"""A true instrument in front of a true arm: residuals of its rows, and their slopes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from casacal.data.columns import Labels
from casacal.data.samples import Samples
from casacal.errors import SimulationError
from casacal.kernels.block_rows import Batch
from casacal.model.geometry import Frame
from casacal.model.instrument import Instrument
from casacal.model.kinematics import stacked_poses
from casacal.model.problem import Problem
from casacal.model.robot import inside_limits, random_joints
from casacal.model.unknown import Unknown
from casacal.simulation.cell import Cell, Disturbances, Face, rectangles
from casacal.simulation.touches import Draw, drawn_together, label_names, plane_coordinates
from casacal.values import Array, Index, Rows


@dataclass(frozen=True)
class Bench:
    """A true instrument on a true arm: residuals of rows, and how they change with joints and readings.

    z, c: true local coordinates (N, nz) and nominals that differ by label (N, nc), by row. known: columns known from
    labels (N, k). faces: the face of each row (N,); none where nothing flat is touched. local: true local coordinates
    by name, about where simulation puts the nominal. frames: transforms (4, 4; mm) by name of the frames that rows
    propose, which stand elsewhere for whoever fits.
    """

    problem: Problem
    evaluate: Batch
    z: Array
    c: Array
    known: Array
    faces: tuple[Face, ...]
    local: Mapping[str, Array]
    frames: Mapping[str, Array]

    @property
    def read(self) -> int:
        """Number of columns that are read."""
        return len(self.problem.instrument.columns)

    def before_reading(self, joints: Array) -> Array:
        """Joints (N, n), and beside them the readings where their search begins."""
        instrument = self.problem.instrument
        readings = [instrument.begins_at.get(name, 0.0) for name in instrument.columns]
        return np.hstack([joints, np.tile(readings, (len(joints), 1))])

    def residual(self, free: Array, rows: Index) -> tuple[Array, Array]:
        """Residuals (k, m) of some rows at joints and readings (k, n), and their slopes (k, m, n)."""
        data = np.hstack([free, self.known[rows]])
        e, slopes = self.evaluate(self.z[rows], self.c[rows], data)
        return e, slopes.reshape(len(rows), data.shape[1], e.shape[1]).transpose(0, 2, 1)[:, :, : free.shape[1]]

    def beyond(self, free: Array, rows: Index) -> Array:
        """Distances (k,; mm) by which the tips of some rows lie outside their faces."""
        if not self.faces:
            return np.zeros(len(rows))
        (tips,) = self.problem.model.batch("tip")(self.z[rows], self.c[rows], np.hstack([free, self.known[rows]]))
        axes, centres, half = rectangles([self.faces[k] for k in rows])
        along = np.abs(np.einsum("kx,kax->ka", tips - centres, axes[:, 1:]))
        return np.asarray(np.linalg.norm(np.maximum(along - half, 0.0), axis=1))


def _named(instrument: Instrument, key: str, label: str | None) -> str:
    """The name of an unknown, or of the one that rows of a label see."""
    return key if label is None else f"{key}.{instrument.instance(key, label)}"


def bench_of(
    problem: Problem,
    cell: Disturbances,
    labels: Mapping[str, Labels],
    rng: np.random.Generator,
    samples: int,
    draw: Draw,
) -> Bench:
    """The true arm before its true instrument, and all that is unknown of them."""
    model, instrument, robot, reached = problem.model, problem.instrument, problem.robot, random_tips(problem)
    local, nominals, frames = dict[str, Array](), dict[str, Array](), dict[str, Array]()
    z, c = [np.zeros((samples, 0))], [np.zeros((samples, 0))]
    arm = drawn_together(problem, robot.parameters, cell.error_scale, rng)
    for key, unknown in problem.symbols.unknowns.items():
        of_rows: Sequence[str | None] = [None] * samples if unknown.per is None else labels[unknown.per]
        instances: Sequence[str | None] = [None]
        if unknown.per is not None:  # a label stands for the same thing in whatever order rows name them
            instances = tuple(dict.fromkeys((*label_names(problem, cell, unknown.per), *labels[unknown.per].names)))
        named = {_named(instrument, key, label): label or key for label in instances}
        for k, (name, label) in enumerate(named.items()):
            place = stands(cell, label, spot(reached, None if _is_flat(unknown) else k))
            stands_at = instrument.stands(key, *place) if unknown.nominal is None else unknown.nominal
            nominals[name] = draw.nominals.get(name, stands_at)
            drawn = arm[key] if key in arm else cell.error_scale * unknown.start_stds * rng.normal(size=unknown.size)
            local[name] = np.asarray(draw.known.get(name, drawn))
            if isinstance(unknown, Frame) and unknown.nominal is None:
                frames[name] = np.array(ca.DM(unknown.at(ca.DM(nominals[name]), ca.DM(local[name]))))
            if isinstance(cell, Cell) and _is_flat(unknown):
                local[name] = plane_coordinates(unknown, nominals[name], *place)
        names = [_named(instrument, key, label) for label in of_rows]
        z.append(np.array([local[name] for name in names]).reshape(samples, -1))
        if key in model.constants:
            c.append(np.array([nominals[name] for name in names]).reshape(samples, -1))
    known = []
    for values in instrument.known_columns.values():
        known.append([values.get(label, 0.0) for label in labels[instrument.known_by]])
    symbols = [ca.SX.sym(name, model.residual.numel_in(i)) for i, name in enumerate(("z", "c", "d"))]
    e = model.residual(*symbols)
    evaluate = Batch(ca.Function("bench", symbols, [e, ca.densify(ca.jacobian(e, symbols[2]))]))
    free = len(robot.axes) + len(instrument.columns)
    assert model.residual.numel_in(2) == free + len(known)
    read = np.array(known, dtype=np.float64).T.reshape(samples, -1)
    faces = _faces(problem, cell, labels, samples)
    return Bench(problem, evaluate, np.hstack(z), np.hstack(c), read, faces, local, frames)


def _faces(problem: Problem, cell: Disturbances, labels: Mapping[str, Labels], samples: int) -> tuple[Face, ...]:
    """The face of each row, where an unknown of the instrument is a plane and a cell says how large faces are."""
    plane = next((unknown for unknown in problem.instrument.unknowns.values() if _is_flat(unknown)), None)
    if not isinstance(cell, Cell) or plane is None:
        return ()
    return tuple(map(cell.face, ("",) * samples if plane.per is None else labels[plane.per]))


def _is_flat(unknown: Unknown) -> bool:
    return unknown.nominal_plane(np.zeros(unknown.nominal_size)) is not None


CANDIDATES = 80  # random postures for each row; the one that fits best is where its search begins
ROUNDS, STEPS = 30, 40  # times that rows are tried afresh, and Gauss-Newton steps of each
FITS = 1e-9  # residual, in units of the largest of its noise or a thousandth of a unit, below which a row fits
SLOW = 1e-3  # cost of a reading in a step, where a radian costs one: readings move before joints do


def exact_rows(bench: Bench, labels: Mapping[str, Labels], rng: np.random.Generator, *, rounds: int) -> Samples:
    """Rows without any error in random postures: those of the labelled ones that a few rounds of tries find."""
    count, model, instrument = len(bench.z), bench.problem.model, bench.problem.instrument
    free, met = found_rows(bench, np.zeros((count, model.components)), rng, rounds)
    which = np.flatnonzero(met)
    joints, read = np.split(free[which], [len(bench.problem.robot.axes)], axis=1)
    columns = dict(instrument.as_read(dict(zip(instrument.columns, read.T, strict=True))))
    known = {name: each.take(which) for name, each in labels.items()}
    return Samples(joints, columns, known, tuple(range(1, len(which) + 1)), {}, "", "")


def found_rows(
    bench: Bench, target: Array, rng: np.random.Generator, rounds: int = ROUNDS, *, limited: bool = True
) -> tuple[Array, Rows]:
    """Joints and readings (N, n) at which the residuals (N, m) are met, joints inside their limits, and where.

    limited: whether readings keep to their limits, too.
    """
    count = len(target)
    free = np.full((count, len(bench.problem.robot.axes) + bench.read), np.nan)
    waiting = np.arange(count)
    for _ in range(rounds):
        start = _starts(bench, target, waiting, rng)
        found, met = _met(bench, start, target[waiting], waiting)
        met &= _inside(bench, found, limited) & (bench.beyond(found, waiting) < 1e-6)
        free[waiting[met]] = found[met]
        waiting = waiting[~met]
        if not waiting.size:
            break
    return free, ~np.isnan(free).any(axis=1)


def _inside(bench: Bench, free: Array, limited: bool = True) -> Rows:
    """Which joints and readings (N, n) are inside their limits."""
    instrument, n = bench.problem.instrument, len(bench.problem.robot.axes)
    ends = [instrument.reading_limits.get(name, (-np.inf, np.inf)) for name in instrument.columns]
    least, most = np.array(ends).reshape(-1, 2).T
    readings, reached = free[:, n:], inside_limits(bench.problem.robot, free[:, :n])
    return reached & ((readings >= least) & (readings <= most)).all(axis=1) if limited else reached


def read_there(bench: Bench, standing: Array, target: Array) -> tuple[Array, Rows]:
    """Joints and readings (N, n) at which the residuals (N, m) are met by an arm that stands there, and where they are.

    Joints stay where readings can follow them; where there are none, the arm moves on until it meets the residual.
    """
    start, rows = bench.before_reading(standing), np.arange(len(target))
    found, met = _met(bench, start, target, rows, held=bench.read >= target.shape[1])
    return found, met & _inside(bench, found)


def _starts(bench: Bench, target: Array, rows: Index, rng: np.random.Generator) -> Array:
    """For each row the random posture, readings at zero, that comes nearest."""
    free = bench.before_reading(random_joints(bench.problem.robot, len(rows) * CANDIDATES, rng))
    if bench.read:  # readings follow from any posture
        return free[::CANDIDATES]
    e, _ = bench.residual(free, np.repeat(rows, CANDIDATES))
    miss = ((e - np.repeat(target[rows], CANDIDATES, axis=0)) ** 2).sum(axis=1)
    miss = (miss + bench.beyond(free, np.repeat(rows, CANDIDATES)) ** 2).reshape(len(rows), CANDIDATES)
    # one of the nearest few, so that touches do not crowd where the random postures do
    order = np.argsort(miss, axis=1)[:, : CANDIDATES // 8]
    pick = order[np.arange(len(rows)), rng.integers(order.shape[1], size=len(rows))]
    return np.asarray(free.reshape(len(rows), CANDIDATES, -1)[np.arange(len(rows)), pick])


def _met(bench: Bench, start: Array, target: Array, rows: Index, *, held: bool = False) -> tuple[Array, Rows]:
    """End points of minimum-norm Gauss-Newton steps from the starts, and which rows arrive; joints may be held."""
    free = start.copy()
    n = len(bench.problem.robot.axes)
    unit = np.where(bench.problem.robot.revolute, 1.0, 1.0 / SLOW)
    ease = np.concatenate([unit * (not held), np.full(bench.read, 1.0 / SLOW)])
    size = max(float(np.abs(target).max(initial=0.0)), 1e-3)
    e, slopes = bench.residual(free, rows)
    part = np.ones(len(free))  # fraction of each row's step; one that leads away from the target is tried shorter
    for _ in range(STEPS):
        miss = e - target
        if (np.abs(miss) <= FITS * size).all():
            break
        eased = slopes * ease
        gram = eased @ eased.transpose(0, 2, 1)
        eye = np.eye(gram.shape[1])
        gram += 1e-12 * np.einsum("kii->k", gram)[:, None, None] * eye + 1e-300 * eye
        step = -(eased.transpose(0, 2, 1) @ np.linalg.solve(gram, miss[..., None]))[..., 0] * ease
        largest = np.abs(step[:, :n] / unit).max(axis=1, initial=0.0)
        there = free + step * (part * np.minimum(1.0, 0.5 / np.maximum(largest, 1e-300)))[:, None]
        e_there, slopes_there = bench.residual(there, rows)
        nearer = ((e_there - target) ** 2).sum(axis=1) <= (miss**2).sum(axis=1)
        free[nearer], e[nearer], slopes[nearer] = there[nearer], e_there[nearer], slopes_there[nearer]
        part = np.where(nearer, np.minimum(2 * part, 1.0), part / 4)
    return free, np.asarray((np.abs(e - target) <= 1e3 * FITS * size).all(axis=1) & np.isfinite(free).all(axis=1))


def random_tips(problem: Problem) -> Array:
    """Tips (400, 3; mm) of the nominal arm in random postures; the flange where the tip needs what is not declared."""
    model, robot = problem.model, problem.robot
    joints = random_joints(robot, 400, np.random.default_rng(0))
    data = np.hstack([joints, np.zeros((len(joints), model.pose.numel_in(2) - joints.shape[1]))])
    z, c = (np.zeros(model.pose.numel_in(i)) for i in (0, 1))
    (pose,) = model.batch("pose")(z, c, data)
    return stacked_poses(pose)[:, :3, 3]


def spot(reached: Array, k: int | None) -> Array:
    """Place (3, mm) of the k-th thing among tips (N, 3) in random postures; in their midst where that is None.

    Arms come to it from many sides: it stands neither next to the base nor at arm's length.
    """
    reached = reached[np.isfinite(reached).all(axis=1)]
    if not len(reached):
        what = "The tip has a place in none of 400 random postures"
        raise SimulationError(what, "See that the pose is a number there: whether its loops close, and depend on u")
    midst = np.median(reached, axis=0)
    if k is None:
        return np.asarray(midst)
    away = np.linalg.norm(reached - midst, axis=1)
    low, high = np.quantile(away, [0.4, 0.6])
    between = reached[(away >= low) & (away <= high)]
    return np.asarray(between[k % len(between)])


def stands(cell: Disturbances, label: str, place: Array) -> tuple[Array, Array]:
    """Place of a thing for which none is stated: on the face of that name, or somewhere in the workspace."""
    if isinstance(cell, Cell):
        face = cell.face(label)
        return np.asarray(face.centre), face.axes[0]
    return place, np.array([0.0, 0.0, 1.0])
