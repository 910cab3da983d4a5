"""A calibration as one wants it at a prompt: figures as attributes, tables as frames, pictures on axes."""

from __future__ import annotations

import csv
import html
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from casacal.calibration.calibration import Calibration
from casacal.calibration.motion import Motion
from casacal.calibration.pictures import plot_convergence, plot_residuals, plot_tip_std, save_plots
from casacal.calibration.result_json import calibration_document, found_part, parameter_rows
from casacal.calibration.saved import AsArm, parameter_table
from casacal.calibration.sensitivity import Sensitivity
from casacal.calibration.summary import summary
from casacal.calibration.verdict import WithVerdict
from casacal.deployment.arm import CalibratedArm
from casacal.deployment.result import Verdict
from casacal.effects.selection import DialError, LeftOut
from casacal.effects.trusted import Leverage
from casacal.errors import CasacalError
from casacal.files import MADE, jsonable, together, write_json, write_text
from casacal.planning.cures import Cure
from casacal.uncertainty.identifiability import Identifiability
from casacal.uncertainty.tip_error import Box
from casacal.values import Array
from casacal.wording import figures

if TYPE_CHECKING:
    import pandas as pd


FILES = ("report.html", "result.json", "parameters.csv", "residuals.png", "convergence.png")
"""Files that a calibration writes, most read first; result.json is placed last: where it stands, all stand."""


class Calibrated(WithVerdict, AsArm):
    """Result of `calibrate`: a `Calibration` behind its verdict, with names as in SciPy's results, and pictures.

    Where its verdict is not to use it, figures of accuracy are NaN, `cures` is empty and `success` is False. `result`
    is the estimator's own, and no verdict governs it; `unjudged` has the figures all the same.
    """

    @cached_property
    def unjudged(self) -> WithVerdict:
        """The calibration with every figure, whatever the verdict; the verdict itself is computed from it."""
        return WithVerdict(**{field.name: getattr(self, field.name) for field in fields(Calibration)})

    @property
    def passed(self) -> bool:
        """Whether the method converged, the reference agrees where there must be a minimum, and nothing denies it."""
        return self.unjudged.passed and not self.denied

    # The gate: figures of accuracy are given here, or denied. What is written and shown reads them here, too.

    @property
    def tip_std(self) -> tuple[float, float]:
        """Tip error to expect, mm RMS over the workspace, apart from the position of the base: from priors, and now."""
        return (math.nan, math.nan) if self.denied else self.unjudged.tip_std

    @property
    def flange_std(self) -> tuple[float, float]:
        """Expected error (prior, posterior) of the flange's origin, mm RMS; NaN where the verdict denies it."""
        return (math.nan, math.nan) if self.denied else self.unjudged.flange_std

    @property
    def tip_std_without_prior(self) -> tuple[float, int]:
        """Tip error from the samples without priors, mm RMS (NaN where denied), and how many directions they miss."""
        alone, missed = self.unjudged.tip_std_without_prior
        return math.nan if self.denied else alone, missed

    @property
    def tip_from_minimum(self) -> float:
        """Distance of the tip from its place at the minimum, mm RMS over the workspace."""
        return math.nan if self.denied else self.unjudged.tip_from_minimum

    @property
    def std(self) -> Array:
        """Standard deviations (n,) of `fit.names`, mm and rad."""
        return np.full_like(self.result.std, math.nan) if self.denied else self.result.std

    @property
    def covariance(self) -> Array:
        """Covariance (s, s) of the unknowns of `seen`, mm and rad."""
        known = self.unjudged.covariance
        return np.full_like(known, math.nan) if self.denied else known

    @property
    def motion(self) -> Motion:
        """All that moves the tip, and its covariance."""
        found = self.unjudged.motion
        return replace(found, covariance=np.full_like(found.covariance, math.nan)) if self.denied else found

    @property
    def cures(self) -> tuple[Cure, ...]:
        """Next steps, best first, with the tip error after each; empty where the verdict denies the result."""
        return () if self.denied else self.unjudged.cures

    @property
    def identifiability(self) -> Identifiability:
        """Rank, null and weak directions as drawn; what they do to the tip is NaN where the verdict denies figures."""
        found = self.unjudged.identifiability
        return found.without_tips() if self.denied else found

    @property
    def dial_errors(self) -> tuple[DialError, ...]:
        """Whether rows show an undeclared error of the dial; at the tip it is NaN where the verdict denies figures."""
        found = self.unjudged.dial_errors
        return tuple(replace(each, tip_mm=math.nan) for each in found) if self.denied else found

    @property
    def leverages(self) -> tuple[Leverage, ...]:
        """What trusted constants are worth at the tip; NaN where the verdict denies figures."""
        found = self.unjudged.leverages
        return tuple(replace(each, tip_mm=math.nan, left_mm=math.nan) for each in found) if self.denied else found

    @property
    def left_out(self) -> tuple[LeftOut, ...]:
        """Each fitted face as the others predict it; the prediction is NaN where the verdict denies figures."""
        found = self.unjudged.left_out
        return tuple(replace(each, predicted_mm=math.nan) for each in found) if self.denied else found

    @property
    def sensitivity(self) -> Sensitivity:
        """How the estimate follows readings and priors; what they do to the tip is NaN where figures are denied."""
        found = self.unjudged.sensitivity
        return found.without_tips() if self.denied else found

    @property
    def x(self) -> Array:
        """Estimate (n,) of `fit.names`, deviations from nominal, mm and rad; `predict` uses `used_x`."""
        return self.result.x

    @property
    def cost(self) -> float:
        """The objective at x: half the sum of squares of whitened residuals and of the prior's."""
        return self.result.cost

    @property
    def success(self) -> bool:
        """Whether the method did all it promises, the reference agrees, and the verdict is not "do not use"."""
        return self.passed

    @property
    def message(self) -> str:
        """The verdict, unless it is simply "calibrated", and how the method ended: sentences that say what to do."""
        said = self.verdict
        return self.result.message if said.level == "calibrated" else f"{said.words} {self.result.message}"

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
        """One row per number of the arm and the instrument: unit, nominal, estimate, change, std, known_from.

        Angles in rad, lengths in mm. known_from: "samples", "samples and prior", "prior alone" or "held".
        """
        return parameter_table(parameter_rows(self))

    @cached_property
    def arm(self) -> CalibratedArm:
        """The calibrated arm: the problem, and what was found of it."""
        return CalibratedArm("this calibration", self.source, jsonable(found_part(self)))

    def to_dict(self) -> dict[str, Any]:
        """All that result.json holds, in JSON's own types."""
        return dict(jsonable(calibration_document(self)))

    def save(self, folder: str | Path, *, command: str | None = None, box: Box | None = None) -> list[Path]:
        """Write report.html, result.json, parameters.csv, pictures and the problem itself into a folder.

        `casacal.load(folder)` reads it back, here or elsewhere. For the report: `command`, the command line that
        reproduces it, and `box`, where the arm will work, ranges in mm.

        Returns:
            The paths of the files that were written.

        """
        from casacal.calibration.report import report_page

        folder = Path(folder)
        document = calibration_document(self, folder=folder)
        with together(folder, [*(name for name in FILES if name != "result.json"), "result.json"]) as place:
            write_text(place / "report.html", report_page(self, document, command=command, box=box))
            write_json(place / "result.json", document)
            write_text(place / "parameters.csv", _parameters_csv(document["parameters"], self.verdict))
            save_plots(self, place)
            made = [name for name in FILES if (place / name).exists()]
        return [folder / name for name in made]

    def report(self, path: str | Path, *, box: Box | None = None) -> Path:
        """Write the report, one page of HTML; `box` is where the arm will work, ranges in mm.

        Returns:
            The path of the page.

        """
        from casacal.calibration.report import report_page

        write_text(path, report_page(self, calibration_document(self), box=box))
        return Path(path)

    def summary(self) -> str:
        """Text of `casacal calibrate --verbose`: verdict, residuals, accuracy, parameters, unobserved directions."""
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
        """Draw how uncertain the tip is over the workspace; axes as for `plot_residuals`.

        Raises CasacalError where the verdict is not to use this result.
        """
        if self.denied:
            what = f"{self.verdict.words.removesuffix('.')}; so nothing is known of how uncertain the tip is"
            raise CasacalError(what, "Mend what the verdict names, and calibrate again")
        return self._drawn(plot_tip_std, ax, (6.0, 5.0))

    def __repr__(self) -> str:
        (before, now), level = self.tip_std, self.verdict.level
        shown = "" if self.denied else f"expected tip error {figures(before)} to {figures(now)} mm RMS, "
        name = self.fit.problem.robot.name
        return f"<casacal calibration of {name} by {self.method}: {len(self.samples)} samples, {shown}{level}>"

    def _repr_html_(self) -> str:
        table = self.parameters.to_html(float_format=lambda value: f"{value:.5g}")
        return f"<p>{html.escape(repr(self).strip('<>'))}. {html.escape(self.message)}</p>{table}"

    def _drawn(self, draw: Any, ax: Any, size: tuple[float, float]) -> Any:
        if ax is None:
            import matplotlib.pyplot as plt

            _, ax = plt.subplots(figsize=size, layout="constrained")
        draw(self, ax)
        return ax


def _parameters_csv(rows: Sequence[Mapping[str, Any]], verdict: Verdict) -> str:
    """Parameters as CSV, below who wrote it and a verdict that is not simply calibrated."""
    text = io.StringIO()
    said = "" if verdict.level == "calibrated" else f". {verdict.words}"
    text.write(f"# {MADE}{said}\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("name", "unit", "nominal", "estimate", "change", "std", "known_from"))
    for row in rows:
        change = row["estimate"] - row["nominal"]
        numbers = (
            f"{row['nominal']:.12g}",
            f"{row['estimate']:.12g}",
            f"{change:.6g}",
            "" if math.isnan(row["std"]) else f"{row['std']:.6g}",
        )
        writer.writerow((row["name"], row["unit"], *numbers, row["known_from"]))
    return text.getvalue()
