"""A calibration as one wants it at a prompt: figures as attributes, tables as frames, pictures on axes; files of it."""

from __future__ import annotations

import html
import math
from dataclasses import fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from casacal.calibration.as_arm import AsArm, parameter_table
from casacal.calibration.calibration import Calibration
from casacal.calibration.motion import Motion, Sensitivity
from casacal.calibration.result_json import calibration_document, found_part, parameter_rows
from casacal.calibration.verdict import WithVerdict
from casacal.effects.selection import DialError, LeftOut
from casacal.effects.trusted import Leverage
from casacal.errors import CasacalError
from casacal.files import MADE, jsonable, place_whole, together, write_json, write_text
from casacal.planning.cures import Cure
from casacal.public import __version__
from casacal.uncertainty.identifiability import Identifiability
from casacal.uncertainty.tip_error import tip_stds, without_rigid
from casacal.values import Array, Box
from casacal.wording import figures

if TYPE_CHECKING:
    import pandas as pd

    from casacal.deployment.arm import CalibratedArm

FILES = "report.html", "result.json", "parameters.csv", "residuals.png", "convergence.png"  # most read first
FILTER_POINTS = 60  # rows at which a filter's objective is drawn
FLOOR = 1e-9  # added so that the lowest value itself can stand on a logarithmic axis; below rounding
NAMED = 24  # faces named under a picture; of more, some are
LINED = 200  # faces with a line between them
LONGEST = 24  # characters of a label in a picture
BEFORE, AFTER, HELD = "#b8b8b8", "#1f6fb2", "#d1622b"


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
        """Tip error to expect, mm RMS over the workspace, apart from the pose of the base: from priors, and now."""
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
        from casacal.deployment.arm import CalibratedArm

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
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        from casacal.calibration.report import report_page

        folder = Path(folder)
        document = calibration_document(self, folder=folder)
        # result.json is placed last: where it stands, all stand
        with together(folder, sorted(FILES, key=lambda name: name == "result.json")) as place:
            write_text(place / "report.html", report_page(self, document, command=command, box=box))
            write_json(place / "result.json", document)
            table = self.parameters.reset_index()
            for name, digits in {"nominal": 12, "estimate": 12, "change": 6, "std": 6}.items():
                table[name] = ["" if math.isnan(value) else f"{value:.{digits}g}" for value in table[name]]
            said = "" if self.verdict.level == "calibrated" else f". {self.verdict.words}"
            csv = table.to_csv(index=False, lineterminator="\n")
            write_text(place / "parameters.csv", f"# {MADE}{said}\n{csv}")
            for name, size, draw in (
                ("residuals", (10.0, 4.0), self.plot_residuals),
                ("convergence", (6.0, 4.0), self.plot_convergence),
            ):
                picture = Figure(figsize=size, layout="constrained")
                FigureCanvasAgg(picture)
                draw(picture.subplots())
                # no date in the file: the same input gives the same bytes
                write = partial(picture.savefig, dpi=150, metadata={"Software": f"casacal {__version__}"})
                place_whole(place / f"{name}.png", write)
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
        from casacal.calibration.summary import summary

        return summary(self, self.source.name)

    def plot_residuals(self, ax: Any = None) -> Any:
        """Draw distances of the tips from their planes, mm, before and after, row by row; on a new axes by default.

        Returns:
            The axes.

        """
        axes = _axes(ax, (10.0, 4.0))
        offset, ticks, ends = 0, [], []
        parts = [("", self.fit, (self.before.x, self.used_x), AFTER)]
        if self.heldout is not None:
            parts.append((" (held out)", self.heldout, self.heldout_x, HELD))
        for suffix, bound, pair, colour in parts:
            before, after = (bound.plain_residual(x) for x in pair)
            order, places = [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
            for label, rows in bound.faces.rows().items():
                own = bound.residuals_of(rows)
                order.append(own)
                places.append(offset + np.arange(own.size))
                short = label if len(label) <= LONGEST else f"{label[: LONGEST - 1]}…"  # leaves room for the picture
                ticks.append((offset + own.size / 2, short.replace("$", r"\$") + suffix))  # $ would begin a formula
                offset += own.size + 4
                ends.append(offset - 2.5)
            here, rows = np.concatenate(places), np.concatenate(order)
            axes.plot(here, before[rows], "o", ms=3, mfc="none", mec=BEFORE, zorder=1)
            axes.plot(here, after[rows], "o", ms=3, color=colour, zorder=2)
        if len(ends) <= LINED:
            axes.vlines(ends, 0, 1, colors="0.9", linewidth=0.8, zorder=0, transform=axes.get_xaxis_transform())
        axes.axhline(0, color="0.5", lw=0.8, zorder=0)
        ticks = [ticks[k] for k in np.unique(np.linspace(0, len(ticks) - 1, NAMED).astype(int))]
        axes.set_xticks(*map(list, zip(*ticks, strict=True)), rotation=20, ha="right", fontsize=8)
        said = self.fit.problem.words
        axes.set_ylabel(f"{said.residual}, {said.unit}")
        axes.plot([], [], "o", ms=4, mfc="none", mec=BEFORE, label=f"before: {said.before}")
        axes.plot([], [], "o", ms=4, color=AFTER, label="after, fitted rows")
        if self.heldout is not None:
            axes.plot([], [], "o", ms=4, color=HELD, label="after, held-out rows")
        axes.legend(fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=3)
        axes.set_title("Residuals, which are not accuracy", fontsize=10, loc="right")
        return axes

    def plot_convergence(self, ax: Any = None) -> Any:
        """Draw the objective above its lowest value, step by step; a filter's pass over the rows stands before step 0.

        ax, what is returned: as for `plot_residuals`.
        """
        axes = _axes(ax, (6.0, 4.0))
        trace, problem = self.result.trace, self.fit
        curves: list[tuple[Any, Any, str, str]] = []
        if (path := trace.get("filter_x", trace.get("x"))) is not None:
            rows = np.unique(np.linspace(0, len(path) - 1, FILTER_POINTS).astype(int))
            costs = np.array([problem.cost(path[row]) for row in rows])
            curves.append((rows / max(len(path) - 1, 1) - 1, costs, "-", "filter, one pass over the rows"))
        if "cost" in trace:
            curves.append((np.arange(trace["cost"].size), trace["cost"], "o-", self.method))
        if not curves:
            axes.set_title("Nothing was estimated, so nothing converged", fontsize=10)
            axes.set_axis_off()
            return axes
        lowest = min(float(costs.min()) for _, costs, _, _ in curves)
        for (places, costs, style, label), colour in zip(curves, (HELD, AFTER)[-len(curves) :], strict=True):
            axes.plot(places, costs - lowest + FLOOR, style, ms=4, color=colour, label=label)
        axes.set_yscale("log")
        axes.set_xlabel("step")
        axes.set_ylabel("objective above its lowest value")
        axes.legend(fontsize=8, frameon=False)
        axes.set_title(f"Convergence of {self.method}", fontsize=10)
        return axes

    def plot_tip_std(self, ax: Any = None) -> Any:
        """Draw how uncertain the tip is (mm, all axes, apart from the pose of the base) over radius and height.

        ax, what is returned: as for `plot_residuals`. Raises CasacalError where the verdict is not to use this result.
        """
        if self.denied:
            what = f"{self.verdict.words.removesuffix('.')}; so nothing is known of how uncertain the tip is"
            raise CasacalError(what, "Mend what the verdict names, and calibrate again")
        axes = _axes(ax, (6.0, 5.0))
        _, tips, slopes = self.workspace
        spread = np.linalg.norm(tip_stds(self.motion.covariance, without_rigid(slopes, tips), self.motion.off), axis=1)
        radius = np.hypot(tips[:, 0], tips[:, 1])
        order = np.argsort(spread)  # the worst on top
        shown = axes.scatter(radius[order], tips[order, 2], c=spread[order], s=18, cmap="viridis")
        axes.figure.colorbar(shown, ax=axes, label="standard deviation of the tip, mm")
        axes.set_xlabel("distance from the first axis, mm")
        axes.set_ylabel("height, mm")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_title("How uncertain the tip is, apart from the pose of the base", fontsize=10)
        return axes

    def __repr__(self) -> str:
        (before, now), level = self.tip_std, self.verdict.level
        shown = "" if self.denied else f"expected tip error {figures(before)} to {figures(now)} mm RMS, "
        name = self.fit.problem.robot.name
        return f"<casacal calibration of {name} by {self.method}: {len(self.samples)} samples, {shown}{level}>"

    def _repr_html_(self) -> str:
        table = self.parameters.to_html(float_format=lambda value: f"{value:.5g}")
        return f"<p>{html.escape(repr(self).strip('<>'))}. {html.escape(self.message)}</p>{table}"


def _axes(ax: Any, size: tuple[float, float]) -> Any:
    """The axes to draw on: a new one where none is given."""
    if ax is None:
        import matplotlib.pyplot as plt

        _, ax = plt.subplots(figsize=size, layout="constrained")
    return ax
