"""Tables of a calibration, for the summary and the report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casacal.calibration.calibration import NOT_NEEDED, Calibration, parts_of
from casacal.calibration.result_json import parameter_rows
from casacal.pages.drawing import fixed, shortened, shown_unit
from casacal.pages.drawing import mm as in_mm
from casacal.uncertainty.identifiability import NullDirection, WeakDirection, correlated_pairs
from casacal.wording import capital, sized

LONGEST = 60  # characters of a face's name


@dataclass(frozen=True)
class PrintedTable:
    """Rows of text under titles; a title that begins with # heads a column of numbers."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    def text(self) -> str:
        """Lines in columns as wide as they must be, in characters that every terminal has."""
        titles = [title.removeprefix("#") for title in self.columns]
        wide = [max(map(len, column)) for column in zip(titles, *self.rows, strict=True)]
        numbers = [title.startswith("#") for title in self.columns]
        return "\n".join(
            "  ".join(
                f"{cell:>{width}}" if number else f"{cell:<{width}}"
                for cell, width, number in zip(row, wide, numbers, strict=True)
            ).rstrip()
            for row in (titles, *self.rows)
        ).replace("–", "-")


def residual_table(calibration: Calibration) -> PrintedTable:
    """RMSE, MAE, STD and MAX before and after, of fitted and held-out rows, of each of several instruments."""
    words, units = calibration.fit.problem.words, parts_of(calibration.fit)
    rows = []
    for name, metrics in (calibration.metrics_by_instrument or {"": calibration.metrics}).items():
        other = "" if not name or units[name] == words.unit else f" ({units[name]}, not {words.unit})"
        for when, parts in metrics.items():
            for part, of_rows in (("fit", "fitted rows"), ("heldout", "held-out rows")):
                if (found := parts[part]) is not None:
                    label = f"{name}{other}: {when}" if name else capital(when)
                    figures = (fixed(found[key]) for key in ("rmse_mm", "mae_mm", "std_mm", "max_mm"))
                    rows.append([f"{label}, {of_rows}", *figures])
    figures_of = [f"#{figure}, {words.unit}" for figure in ("RMSE", "MAE", "STD", "MAX")]
    return PrintedTable([capital(words.residual), *figures_of], rows)


def left_out_table(calibration: Calibration) -> PrintedTable:
    """Each face left out: found and predicted residuals, mm RMS; no prediction where it is denied."""
    faces = calibration.left_out
    has_predictions = any(math.isfinite(face.predicted_mm) for face in faces)
    predicted = ["#Predicted, mm RMS", "#Found over predicted"] if has_predictions else []
    rows = [
        [
            shortened(face.face, LONGEST),
            f"{face.rows:,}",
            fixed(face.actual_mm),
            *([fixed(face.predicted_mm), fixed(face.ratio, 2)] if has_predictions else []),
            f"{face.p:.2g}",
        ]
        for face in faces
    ]
    group = capital(calibration.fit.problem.words.group)
    return PrintedTable([group, "#Rows", "#Found, mm RMS", *predicted, "#p"], rows)


def parameters_table(calibration: Calibration) -> tuple[PrintedTable, list[str]]:
    """Every free parameter, nominal and calibrated, angles in degrees; and the names of those that are held."""
    priors = dict(zip(calibration.fit.names, calibration.fit.prior_std.tolist(), strict=True))
    held, rows = [], []
    for row in parameter_rows(calibration):
        if row["known_from"] == "held":
            held.append(row["name"])
            continue
        unit, factor = shown_unit(row["unit"])
        nominal, estimate, std = (factor * row[key] for key in ("nominal", "estimate", "std"))
        prior = priors.get(row["name"], math.inf)
        share = f"{100 * row['std'] / prior:.0f} %" if math.isfinite(prior) and math.isfinite(std) else "no prior"
        spread = ["–", "–"] if math.isnan(std) else [fixed(std), share]
        change = fixed(estimate - nominal, signed=True)
        rows.append([row["name"], unit, fixed(nominal), fixed(estimate), change, *spread, row["known_from"]])
    titles = ("Parameter", "Unit", "#Nominal", "#Calibrated", "#Change", "#Std. dev.", "#Of prior", "Known from")
    return PrintedTable(titles, rows), held


def correlation_table(calibration: Calibration) -> PrintedTable:
    """Pairs of the arm's own unknowns: planes are always correlated with each other and with the base."""
    arm = np.flatnonzero(~calibration.seen.datum)
    names = [calibration.seen.names[j] for j in arm]
    pairs = correlated_pairs(calibration.covariance[np.ix_(arm, arm)], names)
    rows = [[one, two, fixed(value, 3, signed=True)] for one, two, value in pairs]
    return PrintedTable(["Parameter", "With", "#Correlation"], rows)


def cure_table(calibration: Calibration) -> PrintedTable:
    """Next steps, best first, with the expected tip error after each."""
    cures = [
        [cure.words, in_mm(cure.expected_rms_mm), "yes" if cure.recommended else "no"] for cure in calibration.cures
    ]
    rows = [*cures, ["As it is", in_mm(calibration.tip_std[1]), "–"]] if cures else []
    return PrintedTable(["Next step", "#Tip error, RMS", "Recommended"], rows)


def direction_table(calibration: Calibration) -> tuple[PrintedTable, list[str]]:
    """Null and weak directions with what lowers each, the costly ones first; and those that move no tip, by name."""
    found = calibration.identifiability
    every: tuple[NullDirection | WeakDirection, ...] = (*found.null, *found.weak)
    costly, harmless = [], []
    for each, advice in sorted(zip(every, calibration.advice, strict=True), key=lambda pair: -pair[0].tip_mm):
        kind = each.kind if isinstance(each, NullDirection) else "weak"
        if advice == NOT_NEEDED:
            harmless.append(f"{each.words} ({kind})")
        else:
            costly.append(
                [each.words, kind, f"{each.tip_mm:.2g}" if math.isfinite(each.tip_mm) else "–", capital(advice)]
            )
    return PrintedTable(["What changes unseen", "Kind", "#At the tip, mm", "Cure"], costly), sorted(harmless)


def effect_table(calibration: Calibration) -> PrintedTable:
    """A line for each effect beside the geometry, the likeliest first, and for errors of the dial that rows show."""
    corrected = set(calibration.corrected)
    rows = [
        [
            capital(each.words),
            "yes" if each.shown else "no",
            f"{each.gain:.1f}",
            sized(each.size, each.unit),
            sized(each.expected_size, each.unit),
            "yes" if each.key in corrected else "no",
        ]
        for each in calibration.effect_sizes
    ]
    dial = [error for error in calibration.dial_errors if error.shown]
    rows = [[capital(error.words), "yes", "–", error.shown_size, "–", "no"] for error in dial] + rows
    titles = ("Effect", "Shown by the samples", "#Gain", "#Most likely size", "#Usual size", "Corrected")
    return PrintedTable(titles, rows)


def constant_table(calibration: Calibration) -> PrintedTable:
    """A line for each constant that the instruments take for exact, by what of the expected tip error it causes."""
    rows = [
        [
            capital(each.words),
            sized(each.std, each.unit),
            f"{each.tip_mm:.2g}",
            f"{each.left_mm:.2g}",
            capital(each.cure),
        ]
        for each in calibration.leverages
    ]
    titles = (
        "Taken for exact",
        "#Standard deviation",
        "#That moves the tip by, mm",
        "#Left in the tip error, mm",
        "Told by",
    )
    return PrintedTable(titles, rows)
