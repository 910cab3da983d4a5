"""Rows that any residual fits: random postures, and readings at which the residual vanishes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.instruments import Instrument
from casacal.kernels.batch import Batch
from casacal.problem.cell import Cell, Face
from casacal.problem.disturbances import Disturbances
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.simulation.arm_errors import ArmErrors
from casacal.simulation.asked_rows import check_asked, own_noise, row_labels
from casacal.simulation.fitting import Bench, found
from casacal.simulation.joint_errors import drawn_waves, last_moves, rounded, unwaved
from casacal.simulation.places import random_tips, spot, stands
from casacal.simulation.true_arm import Draw, Truth, plane_coordinates
from casacal.tables.labels import Labels
from casacal.unknowns import Frame, Unknown


def fitting_rows(problem: Problem, cell: Disturbances, samples: int, draw: Draw) -> tuple[Samples, Truth, ArmErrors]:
    """Samples of an instrument that is shown no faces, all that is unknown of them, and the arm's errors.

    Raises SimulationError when no posture inside the joint limits fits, or a cell asks for what only faces have.
    """
    check_asked(problem, cell)
    truth_rng, pose_rng, noise_rng, _, gear_rng = draw.streams(5, of_the_arm=(0, 4))
    labels = row_labels(problem, cell, samples)
    bench, truth = _bench(problem, cell, labels, truth_rng, samples, draw)
    instrument, robot = problem.instrument, problem.robot
    gross = noise_rng.random(samples) < cell.outliers
    outlier = gross * noise_rng.choice([-1.0, 1.0], size=samples) * cell.outlier_size * noise_rng.uniform(1, 2, samples)
    own = own_noise(problem) if cell.repeatability is None else cell.repeatability
    target = noise_rng.normal(size=(samples, problem.model.components)) * own + outlier[:, None]
    free = found(bench, target, pose_rng)
    joints, readings = free[:, : len(robot.axes)], free[:, len(robot.axes) :]
    scatter, lag = noise_rng.normal(size=joints.shape) * cell.joint_std, last_moves(joints) * cell.backlash / 2
    arm = ArmErrors(drawn_waves(robot, cell.waves, gear_rng))
    recorded = rounded(unwaved(arm.waves, joints - scatter + lag), cell.encoder_step)
    columns, read = {}, instrument.as_read(dict(zip(instrument.columns, readings.T, strict=True)))
    for name, dimension in instrument.columns.items():
        shown = read[name] + noise_rng.normal(size=samples) * instrument.column_stds.get(name, 0.0)
        columns[name] = rounded(shown, cell.resolution if dimension == "length" else 0.0)
    return Samples(recorded, columns, labels, tuple(range(1, samples + 1)), {}, draw.name, draw.name), truth, arm


def _true(
    problem: Problem, cell: Disturbances, labels: Mapping[str, Labels], rng: np.random.Generator, draw: Draw
) -> tuple[Truth, dict[str, Array]]:
    """Local coordinates of all that is unknown, and the nominals that they are about, by name."""
    instrument, reached = problem.instrument, random_tips(problem)
    local: dict[str, Array] = {}
    nominals: dict[str, Array] = {}
    frames: dict[str, Array] = {}
    for key, unknown in problem.model.unknowns.items():
        seen = [None] if unknown.per is None else labels[unknown.per].names
        named = {_named(instrument, key, label): label or key for label in seen}
        for k, (name, label) in enumerate(named.items()):
            place = stands(cell, label, spot(reached, None if _is_flat(unknown) else k))
            nominals[name] = instrument.stands(key, *place) if unknown.nominal is None else unknown.nominal
            drawn = cell.error_scale * unknown.start_stds * rng.normal(size=unknown.size)
            local[name] = np.asarray(draw.known.get(name, drawn))
            if isinstance(unknown, Frame) and unknown.nominal is None:
                frames[name] = np.array(ca.DM(unknown.at(ca.DM(nominals[name]), ca.DM(local[name]))))
            if isinstance(cell, Cell) and _is_flat(unknown):
                local[name] = plane_coordinates(unknown, nominals[name], *place)
    return Truth(local, frames), nominals


def _named(instrument: Instrument, key: str, label: str | None) -> str:
    """The name of an unknown, or of the one that rows of a label see."""
    return key if label is None else f"{key}.{instrument.instance(key, label)}"


def _bench(
    problem: Problem,
    cell: Disturbances,
    labels: Mapping[str, Labels],
    rng: np.random.Generator,
    samples: int,
    draw: Draw,
) -> tuple[Bench, Truth]:
    """The true arm before its true instrument, and all that is unknown of them."""
    model, instrument, robot = problem.model, problem.instrument, problem.robot
    truth, nominals = _true(problem, cell, labels, rng, draw)
    z, c = [], []
    for key, unknown in model.unknowns.items():
        of_rows: Sequence[str | None] = [None] * samples if unknown.per is None else labels[unknown.per]
        names = [_named(instrument, key, label) for label in of_rows]
        z.append(np.array([truth.local[name] for name in names]).reshape(samples, -1))
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
    return Bench(
        problem,
        evaluate,
        np.hstack(z) if z else np.zeros((samples, 0)),
        np.hstack(c) if c else np.zeros((samples, 0)),
        np.array(known, dtype=np.float64).T.reshape(samples, -1),
        _faces(problem, cell, labels, samples),
    ), truth


def _faces(problem: Problem, cell: Disturbances, labels: Mapping[str, Labels], samples: int) -> tuple[Face, ...]:
    """The face of each row, where an unknown of the instrument is a plane and a cell says how large faces are."""
    planes = [unknown for unknown in problem.instrument.unknowns.values() if _is_flat(unknown)]
    if not isinstance(cell, Cell) or not planes:
        return ()
    column = planes[0].per
    return tuple(
        next((face for face in cell.faces if face.label == label), cell.faces[0])
        for label in (labels[column] if column is not None else ("",) * samples)
    )


def _is_flat(unknown: Unknown) -> bool:
    return unknown.nominal_plane(np.zeros(unknown.nominal_size)) is not None
