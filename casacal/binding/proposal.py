"""Where things stand that have no nominal value, and no formula of their instrument: where residuals are least.

The robot stays as drawn. From places and directions at random, the unknowns are fitted to the rows of their instrument,
and the best of these fits is where `calibrate` begins.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from scipy.optimize import least_squares

from casacal.array_types import Array, Index
from casacal.binding.nominal import nominal_sight
from casacal.errors import ProblemError
from casacal.problem.compile import RowModel
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.unknowns import Unknown

STARTS = 30  # places and directions from which they are sought
ROWS = 200  # rows of each that suffice for a beginning
STEPS = 100  # of each fit


@dataclass(frozen=True)
class Place:
    """One instance of an instrument's unknown, with its rows (k,), and its nominal; None where that is sought."""

    name: str
    key: str
    unknown: Unknown
    rows: Index
    nominal: Array | None


@dataclass(frozen=True)
class _Rows:
    """Rows of an instrument on a robot as drawn, by local coordinates u of what is sought, about nominals c (N, nc)."""

    model: RowModel
    data: Array
    parts: Mapping[str, tuple[Index, Index, Index]]
    """Of each that is sought its rows (k, 1), and its positions in z and u."""

    def residual(self, u: Array, c: Array) -> Array:
        """Residuals of all rows (N m,)."""
        return np.asarray(self.model.batch.residual(self._z(u), c, self.data)[0].ravel())

    def slopes(self, u: Array, c: Array) -> Array:
        """Their derivative (N m, u)."""
        e, by_z = self.model.batch.jacobian(self._z(u), c, self.data)
        by_z, found = by_z.reshape(*e.shape, -1), np.zeros((*e.shape, u.size))
        for rows, z_at, u_at in self.parts.values():
            found[rows, :, u_at] = by_z[rows, :, z_at]
        return found.reshape(-1, u.size)

    def _z(self, u: Array) -> Array:
        z = np.zeros((len(self.data), self.model.residual.numel_in(0)))
        for rows, z_at, u_at in self.parts.values():
            z[rows, z_at] = u[u_at]
        return z


def sought(problem: Problem, i: int, samples: Samples, places: Sequence[Place]) -> dict[str, Array]:
    """Nominals, by name, of what has none among all unknowns of instrument `i`.

    Raises ProblemError where residuals are not finite wherever these stand.
    """
    wanted = [place for place in places if place.nominal is None]
    taken = np.unique(np.concatenate([place.rows[:: -(-len(place.rows) // ROWS) or 1] for place in wanted]))
    sight, model = nominal_sight(problem, i, samples.take(taken)), problem.models[i]
    read = np.column_stack([samples.joints[taken], *sight.columns.values()])
    c, data = (np.zeros((len(taken), model.residual.numel_in(k))) for k in (1, 2))
    data[:, : read.shape[1]] = read  # what effects ask for beside stays zero, as they are
    z_at = _columns({key: unknown.size for key, unknown in model.unknowns.items()})
    c_at = _columns({key: model.unknowns[key].nominal_size for key in model.constants})
    u_at = _columns({place.name: place.unknown.size for place in wanted})
    seen = {place.name: np.flatnonzero(np.isin(taken, place.rows))[:, None] for place in places}
    for place in places:
        if place.nominal is not None and place.key in c_at:
            c[seen[place.name], c_at[place.key]] = place.nominal
    rows = _Rows(model, data, {each.name: (seen[each.name], z_at[each.key], u_at[each.name]) for each in wanted})
    rng, extent = np.random.default_rng(0), float(np.ptp(sight.tips, axis=0).max())
    best, least = dict[str, Array](), np.inf
    for _ in range(STARTS):
        begin, nominals = [np.zeros(0)], {}
        for place in wanted:
            towards = rng.normal(size=3)
            near = sight.tips[rng.integers(len(taken))] + extent * rng.normal(size=3)
            nominals[place.name] = place.unknown.placed(near, towards / np.linalg.norm(towards))
            c[seen[place.name], c_at[place.key]] = nominals[place.name]
            begin.append(rng.normal(size=place.unknown.size) * (np.array(place.unknown.units) == "rad"))
        if not np.isfinite(rows.residual(np.concatenate(begin), c)).all():
            continue
        fit = least_squares(rows.residual, np.concatenate(begin), rows.slopes, x_scale="jac", max_nfev=STEPS, args=(c,))
        if fit.cost < least:
            least = float(fit.cost)
            best = {p.name: p.unknown.recentred(nominals[p.name], fit.x[u_at[p.name]]) for p in wanted}
    if not best:
        what = f"'{wanted[0].key}' of {type(problem.instruments[i]).__name__} has no nominal value"
        fix = "Give it one, or override `propose`, which finds it from the samples"
        raise ProblemError(f"{what}, and residuals are not finite wherever it stands", fix)
    return best


def _columns(sizes: Mapping[str, int]) -> dict[str, Index]:
    """Positions of each of some things that stand one after the other, by name."""
    ends = accumulate(sizes.values())
    return {name: np.arange(end - sizes[name], end) for name, end in zip(sizes, ends, strict=True)}
