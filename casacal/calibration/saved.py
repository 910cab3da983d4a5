"""A result that was saved, read back without its samples."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from casacal.calibration.as_arm import AsArm, parameter_table
from casacal.deployment.arm import CalibratedArm
from casacal.deployment.result_file import read_result
from casacal.errors import CasacalError, came
from casacal.model.problem import Problem
from casacal.values import Value
from casacal.wording import figures

if TYPE_CHECKING:
    import pandas as pd


def arm_from(source: Any, what: str) -> CalibratedArm:
    """The arm of a calibration, fresh, read back or by the path of its result.json; raises CasacalError for others."""
    if isinstance(source, (str, Path)):
        return read_result(source)
    found = source.arm if isinstance(source, AsArm) else source
    if not isinstance(found, CalibratedArm):
        raise CasacalError(f"Got {came(source)} as {what}", "Give a calibration, or the path of its result.json")
    return found


@dataclass(frozen=True, eq=False, repr=False)
class SavedCalibration(Value, AsArm):
    """A calibration read back from result.json or a truth, without its samples; returned by `load`."""

    found: CalibratedArm

    @property
    def arm(self) -> CalibratedArm:
        """The problem and the estimate."""
        return self.found

    def to_dict(self) -> dict[str, Any]:
        """All that result.json holds, in JSON's own types."""
        return dict(self.found.document)

    @property
    def success(self) -> bool:
        """Whether the method did all it promises, as the result says, and its verdict is not "do not use"."""
        return self.found.denial is None and self.found.found.converged

    @property
    def message(self) -> str:
        """The verdict, unless it is simply "calibrated", and how the method ended."""
        verdict, ended = self.found.found.verdict, self.found.found.status
        return ended if verdict is None or verdict.level == "calibrated" else f"{verdict.words} {ended}"

    @property
    def cost(self) -> float:
        """The objective at the estimate; NaN where the file does not say."""
        return self.found.found.cost

    @property
    def tip_std(self) -> tuple[float, float]:
        """Tip error to expect, mm RMS, from priors and now, as `Calibrated.tip_std`; NaN where the file says none."""
        return self.found.found.tip.prior_mm, self.found.found.tip.expected_mm

    @property
    def metrics(self) -> Any:
        """Residuals before and after, on fitted and held-out rows, as in result.json; None for a truth."""
        return self.found.document.get("metrics")

    @property
    def parameters(self) -> pd.DataFrame:
        """One row per number of the arm and the instrument, as `Calibrated.parameters`."""
        return parameter_table(asdict(row) for row in self.found.found.parameters)

    def __repr__(self) -> str:
        expected = "" if math.isnan(self.tip_std[1]) else f", expected tip error {figures(self.tip_std[1])} mm RMS"
        who, denied = (
            f"{self.found.source.problem.robot.name} by {self.found.found.method}",
            self.found.denial is not None,
        )
        said = f"{expected}{', do not use' if denied else ''}"
        return f"<casacal calibration of {who}, read from {self.found.file}{said}>"


def load(path: str | Path, *, problem: Problem | None = None) -> SavedCalibration:
    """Read back what `save`, `casacal calibrate --out` or `casacal simulate` wrote.

    Args:
        path: the folder, its result.json, or a truth.json.
        problem: what it answers; by default what the result itself holds, and no code is run. A result from before
            results held their arm runs the problem.py that it names, where that is what it was.

    Returns:
        The arm as it was found, which predicts, compensates and is exported; the samples are not part of it.

    Raises CasacalError when it is not a result, is damaged, or its arm has changed since.

    """
    if not isinstance(path, (str, Path)):
        raise CasacalError(f"Got {came(path)} as the path of a result", "Give a path")
    return SavedCalibration(read_result(path, problem=problem))
