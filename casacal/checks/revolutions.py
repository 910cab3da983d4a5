"""Whole turns of a dial's pointer that were miscounted: readings that fit when a turn is added or taken away."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

from casacal.binding.bound_problem import BoundProblem
from casacal.least_squares.result import Result

TURNS_MM = (1.0, 0.5, 2.54, 0.2)
"""What one turn of a pointer shows, by the dials that are sold; several turns are only looked for of the first."""

SHORT_TRAVEL = 2.0
"""Travel (mm) up to which a dial has turns of less than half a millimetre."""

MOST_TURNS = 3
SURE = 4.0
"""Standard deviations within which a reading must then fit."""

SMALL = 1e-4
"""Step of the finite difference, mm."""


def lost_turns(
    bound: BoundProblem, result: Result, rows: Sequence[int], scale: float, i: int = 0
) -> dict[tuple[float, int], list[int]]:
    """Rows that fit with whole turns added to their reading, by what was added (mm) and how many turns that is.

    Args:
        bound: with a dial that has a reading; nothing is found for any other.
        result: a robust fit that these rows hardly pull.
        rows: places of outliers in the samples of one instrument.
        scale: noise of the other rows over what is used.
        i: which instrument.

    """
    probe, samples, own = bound.problem.instruments[i].probe, bound.samples[i], bound.sample_rows(i)
    if probe is None or probe.column is None or own.stop - own.start != len(samples):
        return {}
    reading, sets = samples.columns[probe.column], list(bound.samples)
    sets[i] = replace(samples, columns={**samples.columns, probe.column: reading + SMALL})
    here = bound.residual(result.x)[own]
    slopes = (bound.on(*sets).residual(result.x)[own] - here) / SMALL
    found: dict[tuple[float, int], list[int]] = defaultdict(list)
    for k in rows:
        if abs(slopes[k]) < 1e-9:
            continue
        missing, spread = -float(here[k] / slopes[k]), SURE * scale / abs(float(slopes[k]))
        for turn in TURNS_MM:
            count = round(missing / turn)
            sharp = spread < turn / 8 and (turn >= 0.5 or probe.travel <= SHORT_TRAVEL)
            most = MOST_TURNS if turn == TURNS_MM[0] else 1
            if sharp and 1 <= abs(count) <= most and math.isclose(missing, count * turn, abs_tol=spread):
                found[count * turn, count].append(k)
                break
    return found
