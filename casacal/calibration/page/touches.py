"""The rows as pictures need them: residuals in file order, and where on its face each one touched."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.calibration.calibration import Calibration
from casacal.instruments import Instrument
from casacal.samples.samples import Measurements, Samples
from casacal.tables.columns import Labels
from casacal.unknowns.geometry import fitted_plane

Rows: TypeAlias = NDArray[np.intp]

LOOKED_AT = 4096  # rows of a face, evenly spread, whose tips and tilts are looked at; a multiple of the kernels' block
COORDINATES = "xyz"
When: TypeAlias = Literal["before", "after"]
TITLES: Mapping[When, str] = {"before": "Before", "after": "After"}


@dataclass(frozen=True)
class Part:
    """Fitted or held-out rows: all unknowns x after, residuals before and after (N, m; mm), noise, weight.

    Of a residual with blocks, those that are in the unit in which the instrument speaks.
    """

    bound: BoundProblem
    instrument: int
    held: bool
    x: Array
    before: Array
    after: Array
    noise: Array
    weight: Array  # under a robust loss (N,), the smallest of a row's residuals; one without

    def residuals(self, when: When) -> Array:
        """Residuals (N, m; mm) of the arm before or after calibration."""
        return self.before if when == "before" else self.after

    @cached_property
    def lines(self) -> NDArray[np.int64]:
        """Line of each row in its file (N,)."""
        return np.asarray(self.samples.lines, dtype=np.int64)

    @property
    def samples(self) -> Samples:
        """The rows as they were read."""
        return self.bound.samples[self.instrument]

    @property
    def labels(self) -> Labels | None:
        """Group label of each row (N,); None for an instrument without groups."""
        return self.samples.labels.get(self.bound.problem.instruments[self.instrument].groups or "")

    def rows_of(self, label: str) -> Rows:
        """Rows of one face."""
        return np.arange(len(self.after)) if self._rows is None else self._rows.get(label, np.zeros(0, dtype=np.intp))

    @cached_property
    def _rows(self) -> dict[str, Rows] | None:
        return None if self.labels is None else self.labels.rows()


@dataclass(frozen=True)
class Places:
    """Where some rows of a face touched."""

    tips: Array  # in the base frame at the estimate, (k, 3), mm
    tilts: Array  # angle between plunger and normal (k,), deg; empty for instruments without a plunger
    uv: Array
    """On the face (k, 2), mm from the middle of the touches: v is up on an upright face, else u along the base's x."""
    residuals: Array  # after, (k,), mm
    held: NDArray[np.bool_]
    upright: bool


@dataclass(frozen=True)
class Touches:
    """All rows of one instrument of a calibration, fitted and held out; its name is empty for an only one."""

    calibration: Calibration
    parts: tuple[Part, ...]
    number: int = 0
    name: str = ""

    @staticmethod
    def of(calibration: Calibration, number: int = 0) -> Touches:
        """Residuals of the rows of an instrument, before and after."""
        parts, names = [_part(calibration, calibration.fit, number, held=False)], calibration.fit.problem.names
        if calibration.heldout is not None and len(calibration.heldout.samples[number]):
            parts.append(_part(calibration, calibration.heldout, number, held=True))
        return Touches(calibration, tuple(parts), number, names[number] if len(names) > 1 else "")

    @property
    def instrument(self) -> Instrument:
        """The instrument that measured the rows."""
        return self.calibration.fit.problem.instruments[self.number]

    @property
    def samples(self) -> Samples:
        """All of its rows as they were given."""
        return Measurements.of(self.calibration.samples).sets[self.number]

    def named(self, words: str) -> str:
        """A name for a picture or a table, or a title, that belongs to this instrument among several."""
        return f"{words}-{self.name}" if self.name else words

    @property
    def has_faces(self) -> bool:
        """Whether rows carry the label of a face."""
        return self.instrument.groups in self.samples.labels

    @cached_property
    def faces(self) -> tuple[str, ...]:
        """Labels of the faces in file order; one for all rows where there are none."""
        column = self.instrument.groups
        return self.samples.labels[column].names if column is not None and self.has_faces else ("all rows",)

    @property
    def series(self) -> tuple[str, ...]:
        """Series drawn side by side: one per face, or one per coordinate where a row has several residuals."""
        count = self.parts[0].after.shape[1]
        return self.faces if count == 1 else tuple(COORDINATES[:count]) if count <= 3 else tuple(map(str, range(count)))

    def of_series(self, part: Part, k: int) -> tuple[Rows, int]:
        """Rows of one series in file order, and which of their residuals."""
        if part.after.shape[1] > 1:
            rows, component = np.arange(len(part.after)), k
        else:
            rows, component = part.rows_of(self.faces[k]), 0
        return rows[np.argsort(part.lines[rows], kind="stable")], component

    def places(self, label: str, most: int = LOOKED_AT) -> Places | None:
        """Where a face was touched; None where its touches lie on a line, so that they have no u and v."""
        chosen = [thinned(part.rows_of(label), most) for part in self.parts]
        seen = [_seen(part, rows) for part, rows in zip(self.parts, chosen, strict=True)]
        tips, plungers = (np.vstack(each) for each in zip(*seen, strict=True))
        plane = fitted_plane(tips)
        if not plane.flat:
            return None
        normal, middle = plane.normal, plane.centre
        upright = bool(abs(normal[2]) < 0.7)
        tilts = np.degrees(np.arccos(np.clip(np.abs(plungers @ normal), 0, 1))) if plungers.any() else np.zeros(0)
        return Places(
            tips=tips,
            tilts=tilts,
            uv=(tips - middle) @ _across_face(normal, plungers, upright).T,
            residuals=np.concatenate([p.after[rows, 0] for p, rows in zip(self.parts, chosen, strict=True)]),
            held=np.concatenate([np.full(len(rows), p.held) for p, rows in zip(self.parts, chosen, strict=True)]),
            upright=upright,
        )


def spread(values: Array) -> float:
    """Robust standard deviation about zero of values (N,): 1.4826 times the median size."""
    return 1.4826 * float(np.median(np.abs(values)))


def thinned(rows: Rows, most: int) -> Rows:
    """At most so many of the rows, evenly spread, the first and the last among them."""
    if len(rows) <= most:
        return rows
    return rows[np.unique(np.linspace(0, len(rows) - 1, most).astype(np.intp))]


def _part(calibration: Calibration, bound: BoundProblem, number: int, *, held: bool) -> Part:
    count, own = len(bound.samples[number]), bound.sample_rows(number)
    pair = calibration.heldout_x if held else (calibration.before.x, calibration.used_x)
    drawn = bound.leading[own].reshape(count, -1)[0] if count else slice(None)  # pictures have one unit
    before, after = (bound.plain_residual(x)[own].reshape(count, -1)[:, drawn] for x in pair)
    weight = np.ones(count) if held else calibration.result.weights[own].reshape(count, -1).min(axis=1)
    return Part(bound, number, held, pair[1], before, after, bound.blocks[number].noise[:, drawn], weight)


def _seen(part: Part, rows: Rows) -> tuple[Array, Array]:
    """Tips (k, 3; mm) of some rows, and directions of the plunger (k, 3), zero where there is none."""
    block = part.bound.blocks[part.instrument]
    pattern = block.pattern[rows]
    inputs = part.x[block.columns[pattern]], block.constants[pattern], block.rows(rows)
    (tips,) = block.model.batch.tip(*inputs)
    if block.model.plunger is None:
        return tips, np.zeros_like(tips)
    (plungers,) = block.model.batch.plunger(*inputs)
    return tips, plungers


def _across_face(normal: Array, plungers: Array, upright: bool) -> Array:
    """Directions u and v (2, 3) on a face, as it looks from where the tool stands."""
    if plungers.any() and float((plungers @ normal).mean()) > 0:
        normal = -normal
    if upright:
        v = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
        v /= np.linalg.norm(v)
        return np.array([np.cross(v, normal), v])
    u = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    u /= np.linalg.norm(u)
    return np.array([u, np.cross(normal, u)])
