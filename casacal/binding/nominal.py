"""What the nominal robot says of samples: poses, tips, plungers, and what each row holds beside its joint values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from casacal.array_types import Array
from casacal.discrepancy.effect import Effect, Site, Survey, SurveyedRows
from casacal.errors import ProblemError
from casacal.instruments import Sight
from casacal.kinematics import stacked_poses
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.values import EMPTY

Proposed = Mapping[str, Array]
"""Nominal values that rows have proposed, by the instrument's own key."""


def proposed_by(problem: Problem, i: int, named: Mapping[str, Array]) -> Proposed:
    """Of nominal values by full name those of instrument `i`, where there is one for all of its rows."""
    return {key: named[full] for key, full in problem.full_names[i].items() if full in named}


def row_columns(
    problem: Problem, i: int, samples: Samples, survey: Survey | None, proposed: Proposed = EMPTY
) -> dict[str, Array]:
    """Columns that were read, those known from labels, and those that effects ask for, each (N,)."""
    columns, effects = _instrument_columns(problem, i, samples), problem.models[i].effects
    site = Site(problem.robot, problem.instruments[i])
    if any(effect.columns(site) for effect in effects):
        assert survey is not None
        rows = SurveyedRows(samples, nominal_tips(problem, i, samples, proposed), survey)
        for effect in effects:
            columns |= effect.values(site, rows)
    return columns


def told_sizes(effects: Sequence[Effect], site: Site, survey: Survey | None) -> dict[str, float]:
    """RMS over the fitted rows of the columns that rows tell of effects."""
    if survey is None:
        return {}
    told = (effect.told(site, survey.samples) for effect in effects if effect.further)
    return {name: float(np.sqrt((values**2).mean())) for each in told for name, values in each.items()}


def surveys_of(problem: Problem, samples: Sequence[Samples], named: Mapping[str, Array]) -> tuple[Survey | None, ...]:
    """What the rows of each instrument say of themselves, where effects want to know."""
    if not problem.effects:
        return (None,) * len(samples)
    return tuple(
        Survey.of(some, nominal_tips(problem, i, some, proposed_by(problem, i, named)), problem.instruments[i].groups)
        for i, some in enumerate(samples)
    )


def nominal_sight(problem: Problem, i: int, samples: Samples) -> Sight:
    """What the nominal robot says about all rows of instrument `i`; raises ProblemError when a tip is not finite."""
    model, inputs = problem.models[i], _nominal_inputs(problem, i, samples)
    poses = stacked_poses(model.columns.pose(*inputs))
    if problem.effects and np.isnan(poses).any():  # effects that ask for a tip which rows have yet to propose
        return nominal_sight(problem.without_effects, i, samples)
    plungers = None if model.plunger is None else model.columns.plunger(*inputs)
    return Sight(poses, nominal_tips(problem, i, samples), _instrument_columns(problem, i, samples), plungers)


def nominal_tips(problem: Problem, i: int, samples: Samples, proposed: Proposed = EMPTY) -> Array:
    """Tips (N, 3; mm) of all rows of instrument `i` at the nominal; raises ProblemError when one is not finite.

    Where the tip needs what rows have yet to propose, as the body of a tracked pose, the flange's origins stand for it.
    """
    model, inputs = problem.models[i], _nominal_inputs(problem, i, samples, proposed)
    tips: Array = model.columns.tip(*inputs)
    if np.isnan(tips).all() and any(model.unknowns[key].nominal is None for key in model.constants):
        tips = stacked_poses(model.columns.pose(*inputs))[:, :3, 3]
    if not np.isfinite(tips).all():
        raise ProblemError(
            f"The tip of {type(problem.instruments[i]).__name__} is not finite at the nominal",
            "Check nominal values, and that tip uses no unknown without one",
        )
    return tips


def _nominal_inputs(
    problem: Problem, i: int, samples: Samples, proposed: Proposed = EMPTY
) -> tuple[Array, Array, Array]:
    """(z, c, d) of the nominal robot for all rows."""
    model = problem.models[i]
    constants = [np.zeros(0)]
    for key in model.constants:
        nominal, size = model.unknowns[key].nominal, model.unknowns[key].nominal_size
        constants.append(proposed.get(key, np.full(size, np.nan)) if nominal is None else nominal)
    own = _instrument_columns(problem, i, samples)
    beside = len(model.names) - len(own)  # effects vanish at the nominal, whatever they ask for
    data = np.column_stack([samples.joints, *own.values(), *np.zeros((beside, len(samples)))])
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
            raise ProblemError(
                f"{samples.file}: some rows have the {instrument.known_by} '{unlisted[0]}', which "
                f"{type(instrument).__name__} does not list",
                f"It lists {', '.join(values)}: correct the rows, or add it to the problem",
            )
        columns[name] = np.array([values.get(label, 0.0) for label in labels.names])[labels.codes]
    return columns
