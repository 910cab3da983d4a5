"""Poses, tips and plungers of the nominal robot at samples, and nominal values of unknowns that declare none.

An unknown without a nominal value, for which its instrument has no formula, is fitted: the robot stays as drawn, and
from random places and directions residuals of the instrument's rows are minimised. `calibrate` begins at the best fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import numpy as np

from casacal.data.samples import Samples
from casacal.errors import ProblemError
from casacal.model.instrument import Sight
from casacal.model.kinematics import stacked_poses
from casacal.model.problem import Problem
from casacal.model.term import Survey, SurveyedRows
from casacal.model.trace import RowModel
from casacal.model.unknown import Unknown
from casacal.values import EMPTY, Array, Index

Proposed = Mapping[str, Array]  # nominal values that rows have proposed, by the instrument's own key


def proposed_by(problem: Problem, i: int, named: Mapping[str, Array]) -> Proposed:
    """Nominal values of instrument `i` among those by full name, where one serves all of its rows."""
    return {key: named[full] for key, full in problem.full_names[i].items() if full in named}


def row_columns(
    problem: Problem, i: int, samples: Samples, survey: Survey | None, proposed: Proposed = EMPTY
) -> dict[str, Array]:
    """Columns that were read, those known from labels, and those that terms ask for, each (N,)."""
    columns, terms = _instrument_columns(problem, i, samples), problem.models[i].terms
    site = problem.symbols_of(i).site
    if any(term.columns(site) for term in terms):
        assert survey is not None
        rows = SurveyedRows(samples, nominal_tips(problem, i, samples, proposed), survey)
        for term in terms:
            columns |= term.values(site, rows)
    return columns


def surveys_of(problem: Problem, samples: Sequence[Samples], named: Mapping[str, Array]) -> tuple[Survey | None, ...]:
    """Survey of each instrument's rows for the terms that ask for one."""
    found = list[Survey | None]()
    for i, (some, instrument) in enumerate(zip(samples, problem.instruments, strict=True)):
        asked = any(term.columns(problem.symbols_of(i).site) for term in problem.terms)
        tips = nominal_tips(problem, i, some, proposed_by(problem, i, named)) if asked else None
        found.append(None if tips is None else Survey.of(some, tips, instrument))
    return tuple(found)


def nominal_sight(problem: Problem, i: int, samples: Samples) -> Sight:
    """Nominal poses and tips of all rows of instrument `i`; raises ProblemError when a tip is not finite."""
    model, inputs = problem.models[i], _nominal_inputs(problem, i, samples)
    poses = stacked_poses(model.columnwise("pose")(*inputs))
    if problem.terms and np.isnan(poses).any():  # terms that ask for a tip which rows have yet to propose
        return nominal_sight(problem.without_terms, i, samples)
    plungers = None if model.plunger is None else model.columnwise("plunger")(*inputs)
    return Sight(poses, _tips_at(problem, i, inputs), _instrument_columns(problem, i, samples), plungers)


def nominal_tips(problem: Problem, i: int, samples: Samples, proposed: Proposed = EMPTY) -> Array:
    """Tips (N, 3; mm) of all rows of instrument `i` at the nominal; raises ProblemError when one is not finite.

    Where the tip needs what rows have yet to propose, as the body of a tracked pose, the flange's origins stand for it.
    """
    return _tips_at(problem, i, _nominal_inputs(problem, i, samples, proposed))


def _tips_at(problem: Problem, i: int, inputs: tuple[Array, Array, Array]) -> Array:
    """Tips (N, 3; mm) at (z, c, d) of the nominal robot."""
    model = problem.models[i]
    tips: Array = model.columnwise("tip")(*inputs)
    unknowns = problem.symbols_of(i).unknowns
    if np.isnan(tips).all() and any(unknowns[key].nominal is None for key in model.constants):
        tips = stacked_poses(model.columnwise("pose")(*inputs))[:, :3, 3]
    if not np.isfinite(tips).all():
        what = f"The tip of {type(problem.instruments[i]).__name__} is not finite at the nominal"
        raise ProblemError(what, "Check nominal values, and that tip uses no unknown without one")
    return tips


def _nominal_inputs(
    problem: Problem, i: int, samples: Samples, proposed: Proposed = EMPTY
) -> tuple[Array, Array, Array]:
    """(z, c, d) of the nominal robot for all rows."""
    model, unknowns = problem.models[i], problem.symbols_of(i).unknowns
    constants = [np.zeros(0)]
    for key in model.constants:
        nominal, size = unknowns[key].nominal, unknowns[key].nominal_size
        constants.append(proposed.get(key, np.full(size, np.nan)) if nominal is None else nominal)
    own = _instrument_columns(problem, i, samples)
    of_terms = len(model.names) - len(own)  # terms vanish at the nominal, whatever they ask for
    data = np.column_stack([samples.joints, *own.values(), *np.zeros((of_terms, len(samples)))])
    return np.zeros(model.residual.numel_in(0)), np.concatenate(constants), data


def _instrument_columns(problem: Problem, i: int, samples: Samples) -> dict[str, Array]:
    """Columns that were read, then those known from labels, each (N,)."""
    instrument = problem.instruments[i]
    columns = {name: samples.columns[name] for name in instrument.columns}
    for name, values in instrument.known_columns.items():
        labels = samples.labels[instrument.known_by]
        if instrument.knows_every_label and labels.names == (instrument.known_by,):  # what rows without it are given
            fix = f"Add it: which of {', '.join(values)} each row is of"
            raise ProblemError(f"{samples.file} has no column '{instrument.known_by}'", fix)
        if instrument.knows_every_label and (unlisted := sorted(set(labels.names) - set(values))):
            what = f"{samples.file}: some rows have the {instrument.known_by} '{unlisted[0]}'"
            fix = f"It lists {', '.join(values)}: correct the rows, or add it to the problem"
            raise ProblemError(f"{what}, which {type(instrument).__name__} does not list", fix)
        columns[name] = np.array([values.get(label, 0.0) for label in labels.names])[labels.codes]
    return columns


STARTS = 30  # places and directions from which they are sought
ALIKE, ENOUGH = 1e-3, 6  # part of the least cost within which fits end alike, and how many of these are enough
ROWS = 200  # rows of each that suffice for a beginning
STEPS = 40  # steps of each fit
SMALLEST = 100.0  # extent of the tips, mm, below which it says nothing of how far away things stand
FAR = 10.0  # extents of the workspace, or rad, to which what rows hardly see is held
UNSEEN = 1e-9  # pull on directions that rows do not see at all, in units of the residual


@dataclass(frozen=True)
class Place:
    """One instance of an instrument's unknown, with its rows (k,), and its nominal; None where that is sought."""

    name: str
    key: str
    unknown: Unknown
    rows: Index
    nominal: Array | None


@dataclass(frozen=True)
class _SoughtRows:
    """Rows of an instrument on a robot as drawn, by local coordinates u of what is sought, about nominals c (N, nc)."""

    model: RowModel
    data: Array
    parts: Mapping[str, tuple[Index, Index, Index]]  # rows (k, 1) of each unknown that is sought, positions in z and u

    def fitted(self, begin: Array, c: Array, pull: Array) -> Any:
        """Least squares from `begin` (u,), with a pull towards zero; None where something is not finite on the way."""
        from scipy.optimize import least_squares  # takes its time, and few instruments have no formula of their own

        try:
            return least_squares(self._residual, begin, self._slopes, x_scale="jac", max_nfev=STEPS, args=(c, pull))
        except (ValueError, np.linalg.LinAlgError):
            return None

    def _residual(self, u: Array, c: Array, pull: Array) -> Array:
        return np.append(self.model.batch("residual")(self._z(u), c, self.data)[0].ravel(), pull * u)

    def _slopes(self, u: Array, c: Array, pull: Array) -> Array:
        e, by_z = self.model.batch("jacobian")(self._z(u), c, self.data)
        by_z, found = by_z.reshape(*e.shape, -1), np.zeros((*e.shape, u.size))
        for rows, z_at, u_at in self.parts.values():
            found[rows, :, u_at] = by_z[rows, :, z_at]
        return np.vstack([found.reshape(-1, u.size), np.diag(pull)])

    def _z(self, u: Array) -> Array:
        z = np.zeros((len(self.data), self.model.residual.numel_in(0)))
        for rows, z_at, u_at in self.parts.values():
            z[rows, z_at] = u[u_at]
        return z


def sought(problem: Problem, i: int, samples: Samples, places: Sequence[Place]) -> dict[str, Array]:
    """Fitted nominals, by name, of the unknowns of instrument `i` that have none.

    Raises ProblemError where no row depends on one, and where no start gives finite residuals.
    """
    wanted = [place for place in places if place.nominal is None]
    taken = np.unique(np.concatenate([place.rows[:: -(-len(place.rows) // ROWS) or 1] for place in wanted]))
    sight, model = nominal_sight(problem, i, samples.take(taken)), problem.models[i]
    unknowns = problem.symbols_of(i).unknowns
    read = np.column_stack([samples.joints[taken], *sight.columns.values()])
    c, data = (np.zeros((len(taken), model.residual.numel_in(k))) for k in (1, 2))
    data[:, : read.shape[1]] = read  # what terms ask for beside stays zero, as they are
    z_at = _columns({key: unknown.size for key, unknown in unknowns.items()})
    c_at = _columns({key: unknowns[key].nominal_size for key in model.constants})
    u_at = _columns({place.name: place.unknown.size for place in wanted})
    r_at = {place.name: np.flatnonzero(np.isin(taken, place.rows))[:, None] for place in places}
    for place in places:
        if place.nominal is not None and place.key in c_at:
            c[r_at[place.name], c_at[place.key]] = place.nominal
    rows = _SoughtRows(model, data, {each.name: (r_at[each.name], z_at[each.key], u_at[each.name]) for each in wanted})
    starts = {place.name: (r_at[place.name], c_at[place.key]) for place in wanted}
    found, nominals, c = _best_of_many(rows, wanted, sight.tips, c, starts)
    if found is None:
        what = f"'{wanted[0].key}' of {type(problem.instruments[i]).__name__} has no nominal value"
        fix = "Give it one, or override `propose`, which finds it from the samples"
        raise ProblemError(f"{what}, and residuals are not finite wherever it stands", fix)
    of_rows, name = found.jac[: -found.x.size], type(problem.instruments[i]).__name__
    for place in wanted:
        if place.unknown.size and not of_rows[:, u_at[place.name]].any():
            what = f"No row depends on '{place.name}' of {name}, which has no nominal value"
            raise ProblemError(what, "Give it one, or leave it out")
    # directions that rows hardly see would be moved far by errors of the drawn arm
    units = np.array([unit for place in wanted for unit in place.unknown.units])
    reach = np.where(units == "mm", FAR * _extent(sight.tips), np.where(units == "rad", FAR, np.inf))
    missed = float(np.sqrt(np.mean(found.fun[: -found.x.size] ** 2)))
    held = rows.fitted(found.x, c, np.maximum(missed / reach, UNSEEN))
    u = found.x if held is None else held.x
    return {place.name: place.unknown.recentred(nominals[place.name], u[u_at[place.name]]) for place in wanted}


def _best_of_many(
    rows: _SoughtRows, wanted: Sequence[Place], tips: Array, c: Array, parts: Mapping[str, tuple[Index, Index]]
) -> tuple[Any, dict[str, Array], Array]:
    """The best fit from random places and directions, None where none is finite; nominals and c that it began from."""
    rng, best, kept, alike = np.random.default_rng(0), None, (dict[str, Array](), c), 0
    size = sum(place.unknown.size for place in wanted)
    for _ in range(STARTS):
        begin, nominals, c = [np.zeros(0)], {}, c.copy()
        for place in wanted:
            towards = rng.normal(size=3)
            near = tips[rng.integers(len(tips))] + _extent(tips) * rng.normal(size=3)
            nominals[place.name] = place.unknown.placed(near, towards / np.linalg.norm(towards))
            c[parts[place.name]] = nominals[place.name]
            begin.append(rng.normal(size=place.unknown.size) * (np.array(place.unknown.units) == "rad"))
        fit = rows.fitted(np.concatenate(begin), c, np.full(size, UNSEEN))
        if fit is None:
            continue
        if best is None or fit.cost < (1 - ALIKE) * best.cost:
            alike = 0
        alike += best is None or fit.cost < (1 + ALIKE) * best.cost
        if best is None or fit.cost < best.cost:
            best, kept = fit, (nominals, c)
        if alike >= ENOUGH:
            break
    return best, *kept


def _extent(tips: Array) -> float:
    """Extent of the tips (N, 3; mm), at least `SMALLEST`."""
    return max(float(np.ptp(tips, axis=0).max()), SMALLEST)


def _columns(sizes: Mapping[str, int]) -> dict[str, Index]:
    """Positions of each of some things that stand one after the other, by name."""
    ends = accumulate(sizes.values())
    return {name: np.arange(end - sizes[name], end) for name, end in zip(sizes, ends, strict=True)}
