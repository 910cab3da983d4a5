"""All the doctor's checks in order: the rows, the set-up, systematic faults, single rows, the noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casacal.binding.bound_problem import BoundProblem, bind
from casacal.checks.faults import ALIKE, SUSPICIOUS, flips, misfit, name_fault, sign_before_fit
from casacal.checks.finding import Finding, times
from casacal.checks.labels import odd_labels
from casacal.checks.outliers import exchanged_labels, gross_rows, studentised_outliers
from casacal.checks.rows import outside, repeated, rounded
from casacal.checks.setup import setup_findings
from casacal.errors import CasacalError
from casacal.estimators import lm
from casacal.least_squares.losses import huber
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.uncertainty.figures import noise_interval
from casacal.uncertainty.prior_scatter import prior_scatter

MOST_ROWS = 600
"""Rows used to look for systematic faults; more add time, not insight."""

OF_A_FACE = 12
"""Rows of a face, where faces are many, that tell of systematic faults."""

SPREAD = 20_000
"""Rows that tell of the set-up and of what the prior explains; more add memory, not insight."""

MOST_STRAYS = 0.3
"""Beyond this fraction of the rows, it is not single rows that are wrong."""

ORDER = {"error": 0, "warning": 1, "remark": 2}


def check(problem: Problem, samples: Samples) -> tuple[Finding, ...]:
    """What is wrong, weak or worth knowing about samples of a problem with one instrument; worst first.

    Before any fit: repeats, ranges, rounding, set-up, labels, dial sign. With a quick robust fit: systematic faults,
    each found by undoing it, then outliers and noise. Deterministic.
    """
    findings = [*repeated(samples), *outside(problem, samples), *odd_labels(problem, samples)]
    try:
        bound = bind(problem, samples)
    except CasacalError as error:
        return (Finding("error", "cannot be bound", error.what, error.fix), *_in_order(findings))
    some = bound if len(samples) <= SPREAD else bound.on(_spread(samples, SPREAD))
    findings += [*rounded(bound), *setup_findings(some), *sign_before_fit(some)]
    bad, stray = _strays(problem, samples, prior_scatter(some).rms)
    good = samples.take(np.flatnonzero(~bad)) if bad.any() else samples
    few = _few_of_each_face(problem, good)
    base = misfit(problem, few)
    fault = name_fault(problem, few, base) if base > SUSPICIOUS else None
    if fault is not None:  # it also explains single rows that lie off
        findings += [fault] if all(fault.about != finding.about for finding in findings) else []
    elif base > SUSPICIOUS:
        findings += [*stray, _unexplained(base, findings + stray)]
    else:
        findings += [*stray, *_untold(problem, few, base), *_single_rows(bind(problem, good))]
    return _in_order(findings)


def _in_order(findings: list[Finding]) -> tuple[Finding, ...]:
    return tuple(sorted(findings, key=lambda finding: ORDER[finding.severity]))


def _spread(samples: Samples, count: int) -> Samples:
    """So many rows, evenly over all; all where there are fewer."""
    return samples.take(np.unique(np.linspace(0, len(samples) - 1, count).astype(int)))


def _few_of_each_face(problem: Problem, samples: Samples) -> Samples:
    """About `MOST_ROWS` rows, evenly over their faces, or of some faces where these are many."""
    if len(samples) <= MOST_ROWS:
        return samples
    faces = samples.faces(problem.instrument.groups)
    rows = [some for some in faces.rows().values() if some.size]
    chosen = np.unique(np.linspace(0, len(rows) - 1, MOST_ROWS // OF_A_FACE).astype(int)).tolist()
    most = MOST_ROWS // len(chosen)
    kept = [some[np.unique(np.linspace(0, some.size - 1, most).astype(int))] for some in (rows[k] for k in chosen)]
    return samples.take(np.sort(np.concatenate(kept)))


def _strays(problem: Problem, samples: Samples, scatter: float) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Rows (N,) far off their plane before any fit, with what that means; none where most rows are off."""
    none = np.zeros(len(samples), dtype=bool)
    if problem.instrument.probe is None:
        return none, []
    bad, planes = gross_rows(problem, samples, scatter)
    if not bad.any() or bad.mean() > MOST_STRAYS:
        return none, []
    return bad, exchanged_labels(problem, samples, bad, planes, scatter)


def _unexplained(base: float, findings: list[Finding]) -> Finding:
    known = [finding.about for finding in findings if finding.severity == "error"]
    cause = f"the residuals of a robust fit are {times(base)} times what the stated noise explains"
    if known:
        return Finding(
            "remark", "misfit", f"{cause}, which {', '.join(known)} would account for", "Correct those first"
        )
    return Finding(
        "error",
        "misfit",
        f"{cause}, and no single sign, unit, swap or flip accounts for it",
        "Check the robot's nominal values and the instrument's noise; compliance, backlash or a warped face can also "
        "be the cause",
    )


def _untold(problem: Problem, samples: Samples, base: float) -> list[Finding]:
    """Remarks on flips that these samples would not notice."""
    unseen = [fault.about for fault in flips(problem) if misfit(problem, fault.undo(samples)) <= ALIKE * base]
    return [
        Finding(
            "remark",
            f"{about}?",
            "these samples would look the same if it were, so they cannot tell",
            "Check it by hand",
        )
        for about in unseen
    ]


def _single_rows(bound: BoundProblem) -> list[Finding]:
    result = lm(bound, loss=huber())
    outliers = studentised_outliers(bound, result)
    if outliers:
        return outliers
    plain = lm(bound, start=result.x)
    ratio, low, high = noise_interval(plain)
    if low <= 1.1 and high >= 0.9:
        return []
    return [
        Finding(
            "warning",
            "noise",
            f"the residuals are {ratio:.2f} times what the stated noise explains (95 % {low:.2f} to {high:.2f})",
            "Correct noise_std in the problem"
            if ratio < 1
            else "Raise noise_std, or find the effect that the model does not describe",
        )
    ]
