"""A calibration as one wants it at a prompt: figures as attributes, tables as frames, pictures on axes."""

from __future__ import annotations

import html
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from casacal.array_types import Array
from casacal.calibration.as_arm import AsArm
from casacal.calibration.calibration import Calibration
from casacal.calibration.pictures import plot_convergence, plot_residuals, plot_tip_std
from casacal.calibration.result_json import calibration_document, write_calibration
from casacal.calibration.result_parts import parameter_rows
from casacal.calibration.summary import summary
from casacal.calibration.verdict import verdict_of
from casacal.compensation.arm import CalibratedArm
from casacal.files import jsonable, write_text
from casacal.uncertainty.expectation import Box

if TYPE_CHECKING:
    import pandas as pd


class Calibrated(Calibration, AsArm):
    """What `calibrate` returns: a `Calibration`, with names as in SciPy's results, and pictures."""

    @property
    def x(self) -> Array:
        """Estimate (n,) of `fit.names`, deviations from nominal, mm and rad."""
        return self.result.x

    @property
    def cost(self) -> float:
        """The objective at x: half the sum of squares of whitened residuals and of the prior's."""
        return self.result.cost

    @property
    def success(self) -> bool:
        """Whether the method did all it promises and, where it promises the minimum, the reference agrees."""
        return self.passed

    @property
    def message(self) -> str:
        """How the method ended, as a sentence that says what to do next."""
        return self.result.message

    @property
    def nfev(self) -> int:
        """Evaluations of all residuals."""
        return self.result.nfev

    @property
    def njev(self) -> int:
        """Evaluations of the whole Jacobian."""
        return self.result.njev

    @property
    def parameters(self) -> pd.DataFrame:
        """One row per number of the arm and the instrument: unit, nominal, estimate, change, std, known_from, note.

        Angles in rad, lengths in mm. known_from: "data", "prior" or "no", as `identifiable` in result.json.
        """
        import pandas as pd

        denied = verdict_of(self).level == "do not use"
        rows = parameter_rows(self.fit, self.result.x, self.result.std, denied=denied)
        table = pd.DataFrame(rows).set_index("name")
        table.insert(3, "change", table["estimate"] - table["nominal"])
        return table.rename(columns={"identifiable": "known_from"})

    @cached_property
    def arm(self) -> CalibratedArm:
        """The calibrated arm: the problem, and all that result.json holds."""
        return CalibratedArm("this calibration", self.source, jsonable(calibration_document(self)))

    def save(self, folder: str | Path) -> list[Path]:
        """Write report.html, result.json, parameters.csv, pictures and the problem itself into a folder.

        `casacal.load(folder)` reads it back, here or elsewhere.

        Returns:
            The paths of the files that were written.

        """
        return write_calibration(self, Path(folder))

    def report(self, path: str | Path, *, box: Box | None = None) -> Path:
        """Write the report, one page of HTML; `box` is where the arm will work, ranges in mm.

        Returns:
            The path of the page.

        """
        from casacal.calibration.page import report_page

        write_text(path, report_page(self, self.arm.document, box=box))
        return Path(path)

    def summary(self) -> str:
        """What `casacal calibrate --verbose` prints: verdict, residuals, accuracy, parameters, blind spots."""
        return summary(self, self.source.name)

    def plot_residuals(self, ax: Any = None) -> Any:
        """Draw distances from the planes, mm, before and after, on an axes, a new one unless given.

        Returns:
            The axes.

        """
        return self._drawn(plot_residuals, ax, (10.0, 4.0))

    def plot_convergence(self, ax: Any = None) -> Any:
        """Draw the objective step by step; axes as for `plot_residuals`."""
        return self._drawn(plot_convergence, ax, (6.0, 4.0))

    def plot_tip_std(self, ax: Any = None) -> Any:
        """Draw how uncertain the tip is over the workspace; axes as for `plot_residuals`."""
        return self._drawn(plot_tip_std, ax, (6.0, 5.0))

    def __repr__(self) -> str:
        (before, now), level = self.tip_std, verdict_of(self).level
        shown = "" if level == "do not use" else f"expected tip error {before:.3g} to {now:.3g} mm RMS, "
        name = self.fit.problem.robot.name
        return f"<casacal calibration of {name} by {self.method}: {len(self.samples)} samples, {shown}{level}>"

    def _repr_html_(self) -> str:
        table = self.parameters.drop(columns="note").to_html(float_format=lambda value: f"{value:.5g}")
        return f"<p>{html.escape(repr(self).strip('<>'))}. {html.escape(self.message)}</p>{table}"

    def _drawn(self, draw: Any, ax: Any, size: tuple[float, float]) -> Any:
        if ax is None:
            import matplotlib.pyplot as plt

            _, ax = plt.subplots(figsize=size, layout="constrained")
        draw(self, ax)
        return ax
