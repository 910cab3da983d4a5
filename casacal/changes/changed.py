"""Has the arm changed since it was calibrated? Fresh rows, the earlier posterior, and what explains them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.calibration.as_arm import AsArm
from casacal.calibration.fresh import Opened, opened, with_memory
from casacal.changes.change import CHANGED, NOTHING, ROWS, UNDECIDED, CauseFound, Change, Shown
from casacal.changes.explain import SURE, UNEXPLAINED, Explanation, Look, contenders, explanations, telling
from casacal.data.samples import Samples
from casacal.deployment.arm import CalibratedArm
from casacal.errors import CasacalError, SamplesError
from casacal.model.problem import Problem
from casacal.model.problem_file import ProblemFile
from casacal.values import as_given, is_real

MOST = 1500  # rows that are looked at: each is compared with every cause as one that is off
FEWEST = 3  # rows that may be off, of few; of many one in twenty


def changed(
    result: AsArm | CalibratedArm | str | Path,
    samples: Samples | Any,
    *,
    problem: Problem | ProblemFile | str | Path | None = None,
    instrument: str | None = None,
    standing: Collection[str] = (),
    drift: Mapping[str, float] | None = None,
    alarm: float = 0.01,
    touches: int = 0,
    seed: int = 0,
) -> Change:
    """Look whether an arm has changed since it was calibrated, what, and by how much.

    The residuals of fresh rows are compared with what the calibration promises, as in `verify`. Beside it each joint's
    zero, the tool, the base and whatever was said to stand may have changed: generalised likelihood ratios, the
    smallest chance of which is judged so that an arm that has not changed is called changed at the rate that was asked
    for. A row that is off explains a misfit as well, and is named in place of the arm where it does so better.

    Args:
        result: a calibration, what `load` or `read_result` returns, or the path of a result.json or its folder.
        samples: fresh rows: `Samples`, a file, a pandas DataFrame, or arrays by column.
        problem, instrument, standing: as for `verify`. Where the base stands shows only against what stands.
        drift: standard deviations (mm, rad) by which unknowns may have drifted since, by name or key.
        alarm: rate of false alarms, 0.001 to 0.5.
        touches: how many touches to propose where causes cannot be told apart; none by default.
        seed: of everything that is drawn.

    Returns:
        What was found; shifts in rad and mm.

    Raises CasacalError, UnknownNameError and SamplesError as `verify` does, and for numbers that mean nothing.

    """
    case = opened(result, samples, problem=problem, instrument=instrument, standing=standing)
    return looked(case, standing, drift or {}, alarm=alarm, touches=touches, seed=seed)[0]


def looked(
    case: Opened, standing: Collection[str], drift: Mapping[str, float], *, alarm: float, touches: int, seed: int
) -> tuple[Change, Look]:
    """`changed` for rows already opened; also returns the last look, without rows that are off."""
    if not (is_real(alarm) and 0.001 <= alarm <= 0.5):
        raise CasacalError(f"Got {as_given(alarm)} as the false alarm rate", "Give 0.001 to 0.5")
    for what, value, most in (("touches", touches, 100), ("seed", seed, 2**63)):
        if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or not 0 <= value <= most:
            raise CasacalError(f"Got {as_given(value)} as the {what}", f"Give a whole number from 0 to {most}")
    if len(case.rows) > MOST:
        fix = f"Give up to {MOST:,} of them"
        raise SamplesError(case.rows.file, f"{len(case.rows):,} rows are too many to look at one by one", fix)
    fresh = with_memory(case.fresh(standing), case.arm).loosened(drift)
    first = Look.at(fresh, case.noise_freedom, float(alarm), int(seed))
    look, best, places = _without_bad(first, len(case.rows), float(alarm), int(seed))
    bad = sorted(set(range(len(case.rows))) - set(places.tolist()))
    proposed, tells = None, 0.0
    if not look.alarm:
        ended = ROWS if bad else NOTHING
    elif len(best) == 1 and best[0].cause and best[0].share >= SURE and best[0].left >= UNEXPLAINED:
        ended = CHANGED  # surer than all others together, and nothing is left that is hardly chance
    else:
        ended = UNDECIDED
        proposed, tells = telling(case.source.problem, look, best, int(touches), int(seed))
    whitened = first.tests.fresh
    joints = [k for k, cause in enumerate(look.causes) if cause.kind == "joint"]
    found_from = {k: look.found_from(k) for k in joints}
    shown = [math.isfinite(found_from[k]) if k in found_from else look.observable(k) for k in range(len(look.causes))]
    change = Change(
        case.judged(fresh, tuple(standing)),
        drift=tuple(sorted(drift.items())),
        alarm=float(alarm),
        p=first.smallest,
        level=first.level,
        chi_square=whitened.chi_square,
        freedom=whitened.freedom,
        p_all=first.tests.p[2],
        ended=ended,
        causes=tuple(_cause(each, look, case.rows, places) for each in best),
        bad_lines=tuple(int(case.rows.lines[k]) for k in bad),
        joints=tuple(Shown(look.causes[k].name, look.causes[k].units[0], found_from[k]) for k in joints),
        unseen=tuple(cause.name for cause, shows in zip(look.causes, shown, strict=True) if not shows),
        touches=proposed,
        tells=tells,
    )
    return change, look


def _without_bad(look: Look, count: int, alarm: float, seed: int) -> tuple[Look, list[Explanation], NDArray[np.intp]]:
    """Leave out single faulty rows; return the last look, its explanations and the indices of the rows that remain."""
    places, most = np.arange(count), max(FEWEST, count // 20)
    while look.alarm:
        best = contenders(explanations(look))
        if len(best) != 1 or best[0].cause is not None or count - len(places) == most:
            return look, best, places
        look = look.without(best[0].row, alarm, seed)
        places = np.delete(places, best[0].row)
    return look, [], places


def _cause(found: Explanation, look: Look, rows: Samples, places: NDArray[np.intp]) -> CauseFound:
    cause, fitted, figures = found.cause, found.fitted, (found.p, found.share, found.left)
    if cause is None or fitted is None:
        line, none = int(rows.lines[int(places[found.row])]), np.zeros(0)
        return CauseFound(f"line {line}", "row", line, (), (), none, none, *figures)
    probe = look.fresh.bound.problem.instrument.probe
    dial = cause.kind == "tool" and probe is not None and probe.column is not None
    return CauseFound(cause.name, cause.kind, 0, cause.labels, cause.units, fitted.shift, fitted.std, *figures, dial)
