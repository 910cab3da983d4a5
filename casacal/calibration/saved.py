"""A calibration that was saved, read back: its figures, and the arm it found."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from casacal.calibration.as_arm import AsArm
from casacal.compensation.arm import CalibratedArm, denial
from casacal.compensation.result_file import read_result
from casacal.errors import CasacalError, came
from casacal.problem.problem import Problem
from casacal.values import Value

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = ("name", "unit", "nominal", "estimate", "std", "identifiable", "note")
"""Of a parameter in result.json."""


@dataclass(frozen=True, eq=False, repr=False)
class SavedCalibration(Value, AsArm):
    """What `load` returns: the arm of a result.json or a truth, without the samples it came from."""

    found: CalibratedArm

    @property
    def arm(self) -> CalibratedArm:
        """The problem and the estimate."""
        return self.found

    @property
    def success(self) -> bool:
        """Whether the method did all it promises, as the result says, and its verdict is not "do not use"."""
        return bool(self.found.document.get("converged", False)) and denial(self.found) is None

    @property
    def message(self) -> str:
        """How the method ended."""
        return str(self.found.document.get("status", ""))

    @property
    def cost(self) -> float:
        """The objective at the estimate; NaN where the file does not say."""
        cost = self.found.document.get("cost")
        return math.nan if cost is None else float(cost)

    @property
    def metrics(self) -> Any:
        """Residuals before and after, on fitted and held-out rows, as in result.json; None for a truth."""
        return self.found.document.get("metrics")

    @property
    def parameters(self) -> pd.DataFrame:
        """One row per number of the arm and the instrument, as `Calibrated.parameters`."""
        import pandas as pd

        table = pd.DataFrame(list(self.found.document["parameters"]), columns=list(COLUMNS)).set_index("name")
        table.insert(3, "change", table["estimate"] - table["nominal"])
        return table.rename(columns={"identifiable": "known_from"})

    def __repr__(self) -> str:
        document = self.found.document
        tip = (document.get("tip") or {}).get("expected_rms_mm")
        expected = "" if tip is None else f", expected tip error {tip:.3g} mm RMS"
        return (
            f"<casacal calibration of {self.found.source.problem.robot.name} by {document.get('method')}, read from "
            f"{self.found.file}{expected}>"
        )


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
