"""Whether each face, or what else has unknowns of its own, is seen by enough rows, and how many it takes in all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casacal.errors import ProblemError
from casacal.instruments import Instrument
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.tables.columns import Labels
from casacal.unknowns import Unknown
from casacal.wording import counted


def instances(
    instrument: Instrument, key: str, unknown: Unknown, samples: Samples
) -> list[tuple[str | None, NDArray[np.intp]]]:
    """Labels of an unknown's instances (None when there is one for all), with the rows of each."""
    if unknown.per is None:
        return [(None, np.arange(len(samples)))]
    labels = samples.labels[unknown.per]
    have = Labels.coded((instrument.instance(key, label) for label in labels.names), labels.codes)
    return list(have.rows().items())


def check_rows(
    problem: Problem,
    i: int,
    key: str,
    unknown: Unknown,
    label: str | None,
    rows: NDArray[np.intp],
    samples: Samples,
    *,
    fits_all: bool,
) -> None:
    """Raise ProblemError where a datum of instrument `i` has no more rows than flat unknowns of its own.

    fits_all: whether the arm is to be fitted to these rows too, so that the sentence says how many that takes.
    """
    components = problem.models[i].components
    flat = int((~np.isfinite(unknown.prior_stds)).sum())
    if key not in problem.instruments[i].datum or len(rows) * components > flat:
        return
    which = f"'{label}'" if label is not None else f"'{key}'"
    raise ProblemError(
        f"{samples.file}: {which} has {counted(len(rows), 'row')} for {counted(flat, 'unknown')} of its own",
        f"Take at least {flat // components + 1} rows there" + (_in_all(problem, i, samples) if fits_all else ""),
    )


def _in_all(problem: Problem, i: int, samples: Samples) -> str:
    """How many rows all faces together need to calibrate, as the end of a sentence."""
    if len(problem.instruments) > 1:
        return ", and many more to learn about the arm"
    instrument = problem.instruments[i]
    own = sum(u.size * len(instances(instrument, key, u, samples)) for key, u in instrument.unknowns.items())
    total = own + sum(unknown.size for unknown in problem.robot.parameters.values())
    least = -(-total // problem.models[i].components)
    for_all = f"at least {least} in all for {counted(total, 'unknown')}"
    return f", and {for_all}, better twice as many; or hold parameters with --fix"
