"""A true instrument before a true arm, wherever it stands: what its rows leave, and how that changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from casacal.array_types import Array, Index
from casacal.instruments import Instrument
from casacal.kernels.block_rows import Batch
from casacal.problem.problem import Problem
from casacal.simulation.cell import Cell, Disturbances, Face
from casacal.simulation.touches import Draw, label_names, plane_coordinates, random_tips, spot, stands
from casacal.tables.columns import Labels
from casacal.unknowns import Frame, Unknown


@dataclass(frozen=True)
class Bench:
    """A true instrument on a true arm: residuals of rows, and how they change with joints and readings."""

    problem: Problem
    evaluate: Batch
    z: Array
    """True local coordinates by row (N, nz)."""
    c: Array
    """Nominals that differ by label by row (N, nc)."""
    known: Array
    """Columns known from labels by row (N, k)."""
    faces: tuple[Face, ...]
    """The face of each row (N,); none where nothing flat is touched."""
    local: Mapping[str, Array]
    """True local coordinates by name, about where simulation puts the nominal."""
    frames: Mapping[str, Array]
    """Transforms (4, 4; mm) by name of the frames that rows propose, which stand elsewhere for whoever fits."""

    @property
    def read(self) -> int:
        """How many columns are read."""
        return len(self.problem.instrument.columns)

    def residual(self, free: Array, rows: Index) -> tuple[Array, Array]:
        """Residuals (k, m) of some rows at joints and readings (k, n), and their slopes (k, m, n)."""
        data = np.hstack([free, self.known[rows]])
        e, slopes = self.evaluate(self.z[rows], self.c[rows], data)
        return e, slopes.reshape(len(rows), data.shape[1], e.shape[1]).transpose(0, 2, 1)[:, :, : free.shape[1]]

    def beyond(self, free: Array, rows: Index) -> Array:
        """How far (k,; mm) the tips of some rows lie outside their faces."""
        if not self.faces:
            return np.zeros(len(rows))
        (tips,) = self.problem.model.batch.tip(self.z[rows], self.c[rows], np.hstack([free, self.known[rows]]))
        axes, centres, sizes = (
            np.array([getattr(self.faces[k], name) for k in rows]) for name in ("axes", "centre", "size")
        )
        along = np.abs(np.einsum("kx,kax->ka", tips - centres, axes[:, 1:]))
        return np.asarray(np.linalg.norm(np.maximum(along - sizes / 2, 0.0), axis=1))


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
    for key, unknown in problem.symbols.unknowns.items():
        of_rows: Sequence[str | None] = [None] * samples if unknown.per is None else labels[unknown.per]
        seen: Sequence[str | None] = [None]
        if unknown.per is not None:  # a label stands for the same thing in whatever order rows name them
            seen = tuple(dict.fromkeys((*label_names(problem, cell, unknown.per), *labels[unknown.per].names)))
        named = {_named(instrument, key, label): label or key for label in seen}
        for k, (name, label) in enumerate(named.items()):
            place = stands(cell, label, spot(reached, None if _is_flat(unknown) else k))
            stands_at = instrument.stands(key, *place) if unknown.nominal is None else unknown.nominal
            nominals[name] = draw.nominals.get(name, stands_at)
            drawn = cell.error_scale * unknown.start_stds * rng.normal(size=unknown.size)
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
    return Bench(
        problem,
        evaluate,
        np.hstack(z),
        np.hstack(c),
        np.array(known, dtype=np.float64).T.reshape(samples, -1),
        _faces(problem, cell, labels, samples),
        local,
        frames,
    )


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
