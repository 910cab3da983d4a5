"""Test a calibration by fresh rows; its result as a value, in words and as a page."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

from casacal.calibration.saved import AsArm
from casacal.compensation.arm import CalibratedArm
from casacal.errors import CasacalError
from casacal.problem.problem import Problem
from casacal.problem.problem_file import ProblemFile
from casacal.samples.samples import Samples
from casacal.verification.decision import RISK
from casacal.verification.judged import judged
from casacal.verification.opened import opened
from casacal.verification.verification import Verification

LEAST_RISK = 1e-4
"""Risk below which nobody knows the noise well enough."""


def verify(
    result: AsArm | CalibratedArm | str | Path,
    samples: Samples | Any,
    *,
    problem: Problem | ProblemFile | str | Path | None = None,
    instrument: str | None = None,
    standing: Collection[str] = (),
    tolerance: float | None = None,
    risk: float = RISK,
) -> Verification:
    """Judge a calibration by rows that it has not seen; the arm is not fitted again.

    Only what the rows alone know is fitted to them: where the faces or the tracker stand, and the tool of another
    instrument. What is left is compared with its predicted covariance: of what the calibration may err by, from the
    posterior in result.json, and of the noise as the calibration used it. The sum of squares is chi-square with rows
    less fitted unknowns degrees of freedom (F where the calibration itself found the noise), and the promise is kept
    unless it is larger than 95 % of those of a good arm. Rows that were pasted again count once, and
    rows that the arm was calibrated from do not count.

    Args:
        result: a calibration, what `load` or `read_result` returns, or the path of a result.json or its folder.
        samples: fresh rows: `Samples`, a file, a pandas DataFrame, or arrays by column.
        problem: the same arm with the instrument of these rows, where it is not that of the calibration: a `Problem`,
            what `load_problem` returns, or a path.
        instrument: which of the calibration's instruments took these rows, where there are several; by default the one
            whose columns they have.
        standing: labels of faces ("floor") or unknowns ("plane", "tool") that stand where the calibration found them,
            and so are not fitted again.
        tolerance: largest RMS error, mm, that the arm may have in what this instrument sees: accepted, rejected or left
            undecided by JCGM 106:2012.
        risk: chance of a wrong decision of an arm whose error is the tolerance, below one half.

    Returns:
        What was found; residuals in mm.

    Raises CasacalError for what is no result, another arm, or a tolerance or risk that is none; UnknownNameError for
    something else standing; SamplesError for rows that do not fit, are too few, or half of which are those of the
    calibration.

    """
    if tolerance is not None and (
        isinstance(tolerance, bool) or not (isinstance(tolerance, (int, float)) and 0 < tolerance < math.inf)
    ):
        raise CasacalError(f"The tolerance is {tolerance!r}", "Give a positive number of mm")
    if isinstance(risk, bool) or not (isinstance(risk, (int, float)) and LEAST_RISK <= risk < 0.5):
        fix = f"Give a chance from {LEAST_RISK:g} to below 0.5, such as 0.05 for 5 %"
        raise CasacalError(f"The risk is {risk!r}", fix)
    given = opened(result, samples, problem=problem, instrument=instrument, standing=standing)
    unit = given.source.problem.instrument.words.unit
    if tolerance is not None and unit != "mm":
        raise CasacalError(f"The tolerance is in mm, but the residuals are in {unit}", "Leave it out")
    fresh = given.fresh(standing)
    found = judged(given.arm, fresh, tuple(standing), None if tolerance is None else float(tolerance), float(risk))
    return replace(found, copied_lines=given.copied, fitted_lines=given.fitted)
