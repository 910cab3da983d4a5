"""Fresh rows and the result that they are to be judged by, from any form in which people have them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from casacal.calibration.as_arm import AsArm
from casacal.calibration.given import samples_of
from casacal.compensation.arm import CalibratedArm
from casacal.compensation.seen_by import seen_by
from casacal.errors import CasacalError, SamplesError
from casacal.problem.problem import Problem
from casacal.problem.problem_file import ProblemFile
from casacal.samples.samples import Samples
from casacal.verification.fresh import Fresh, fresh_rows
from casacal.verification.judged import _noise_freedom
from casacal.verification.verify import _arm, _fresh_among, _with_instrument, measured_by


@dataclass(frozen=True, eq=False)
class Opened:
    """A result as the instrument of some rows sees it, those rows that count, and lines of those that do not."""

    arm: CalibratedArm
    source: ProblemFile
    rows: Samples
    copied: tuple[int, ...]
    fitted: tuple[int, ...]
    other: bool
    """Whether another instrument than the calibration's took the rows."""

    def fresh(self, standing: Collection[str]) -> Fresh:
        """Rows bound to the arm; raises CasacalError as `fresh_rows`, SamplesError for what is not finite."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            fresh = fresh_rows(self.arm, self.source.problem, self.rows, other=self.other, standing=standing)
            if not np.isfinite(fresh.bound.residual(fresh.x)).all() or not np.isfinite(fresh.jacobian).all():
                raise SamplesError(
                    self.rows.file, "the residuals of some rows are not finite", "Check their values with check"
                )
        return fresh

    @property
    def noise_freedom(self) -> float:
        """Degrees of freedom of the noise where the calibration found it itself, infinite where it was stated."""
        return _noise_freedom(self.arm.document)


def opened(
    result: AsArm | CalibratedArm | str | Path,
    samples: Samples | Any,
    *,
    problem: Problem | ProblemFile | str | Path | None,
    instrument: str | None,
    standing: Collection[str],
) -> Opened:
    """Read what is judged and by what; raises CasacalError as `verify` does."""
    if isinstance(standing, str):
        raise CasacalError(f"'{standing}' came as a list of what stands", f"Give ['{standing}']")
    arm = _arm(result)
    arm = seen_by(arm, instrument if problem is not None else measured_by(arm, samples, instrument))
    source = arm.source if problem is None else ProblemFile.of(_with_instrument(arm, problem))
    rows = samples_of(samples, source, 0)
    rows, copied, fitted = _fresh_among(arm, rows, source.problem)
    return Opened(arm, source, rows, copied, fitted, problem is not None)
