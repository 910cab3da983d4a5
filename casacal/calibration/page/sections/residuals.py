"""Residuals before and after, on fitted and held-out rows: figures, histograms, row by row, over each face."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from casacal.calibration.metrics import parts_of
from casacal.calibration.page.markup import Markup, paragraph, section
from casacal.calibration.page.numbers import fixed, shortened
from casacal.calibration.page.sections.face_maps import face_maps
from casacal.calibration.page.sections.histograms import histograms
from casacal.calibration.page.sections.row_plots import row_plots
from casacal.calibration.page.table import NUMBER, WORDS, table
from casacal.calibration.page.touches import TITLES, Touches, by_instrument
from casacal.wording import sized

FIGURES = (("RMSE", "rmse_mm"), ("MAE", "mae_mm"), ("STD", "std_mm"), ("MAX", "max_mm"))


def residuals_section(each: Sequence[Touches], document: Mapping[str, Any]) -> Markup:
    """Figures, histograms, rows and faces; pictures instrument by instrument."""
    said = each[0].calibration.fit.problem.words
    pictures = [
        part
        for touches in each
        for part in (by_instrument(touches), histograms(touches), row_plots(touches), face_maps(touches))
    ]
    what, alone = f"{said.residual[:1].upper()}{said.residual[1:]}", f"{said.before}, the arm as drawn"
    return section(
        "residuals",
        "Residuals before and after",
        paragraph(
            f"{what}. Before: {alone}. Small residuals are necessary but not sufficient: an arm can look perfect where "
            "it touched and be wrong elsewhere."
        ),
        _table(document, parts_of(each[0].calibration.fit)),
        *_left_out(document, said.group),
        _noise(each[0], document["noise"]),
        *pictures,
    )


def _table(document: Mapping[str, Any], units: Mapping[str, str]) -> Markup:
    rows = []
    of_each = document.get("metrics_by_instrument", {"": document["metrics"]})
    for part_name, metrics in of_each.items():
        unit = units.get(part_name, "mm")
        name = part_name if unit == "mm" else f"{part_name} ({unit}, not mm)"
        for when in TITLES:
            for part, words in (("fit", "fitted rows"), ("heldout", "held-out rows")):
                found, title = metrics[when][part], f"{name}: {TITLES[when].lower()}" if name else TITLES[when]
                if found is not None:
                    rows.append([f"{title}, {words}", *(fixed(found[key]) for _, key in FIGURES)])
    columns = [("Rows", WORDS), *((f"{name}, mm", NUMBER) for name, _ in FIGURES)]
    return table("residual-figures", "Residuals, not accuracy", columns, rows)


def _left_out(document: Mapping[str, Any], group: str) -> list[Markup]:
    """Each face as the arm predicts it that the others give; no prediction where the verdict denies it."""
    faces = document["leave_one_face_out"]
    if not faces:
        return []
    predicted = [("Predicted, mm RMS", "predicted_mm", 4), ("Found over predicted", "ratio", 2)]
    shown = [("Found, mm RMS", "actual_mm", 4), *(predicted if document["verdict"]["level"] != "do not use" else [])]
    columns = [(group.capitalize(), WORDS), ("Rows", NUMBER), *((title, NUMBER) for title, _, _ in shown)]
    columns += [("Chance of so much", NUMBER)]
    rows = [
        [
            shortened(face["face"], 60),
            f"{face['rows']:,}",
            *(fixed(face[key], digits) for _, key, digits in shown),
            f"{face['p']:.2g}",
        ]
        for face in faces
    ]
    return [
        paragraph(
            f"Each {group} in turn was left out, the arm fitted to the others, and its residuals compared with what "
            f"this arm expects of them; only where that {group} is was fitted to it. A ratio well over one with a "
            "small chance means that something is missing from the model."
        ),
        table("left-out", f"Each {group} predicted by the others", columns, rows),
    ]


def _noise(touches: Touches, noise: Mapping[str, Any]) -> Markup:
    ratio, low, high = (fixed(noise[key], 2) for key in ("ratio", "low", "high"))
    said = f"Found over stated noise: {ratio} (95 % {low} to {high}); 1 where the noise was stated well."
    faces = [face for face in noise["by_face"].values() if "unit" not in face]
    if not touches.calibration.noise.scale or not faces:
        return paragraph(f"{said} Every figure uses the noise as stated.")
    stated, used = ([face[key] for face in faces] for key in ("stated_mm", "used_mm"))
    joints = noise["joints_rad"]
    more = f" It grows with what a touch sees of the joints: they repeat to {sized(joints, 'rad')}." if joints else ""
    return paragraph(f"{said} Every figure uses the noise as found: {_span(used)} mm, stated {_span(stated)} mm.{more}")


def _span(values: list[float]) -> str:
    low, high = fixed(min(values), 4), fixed(max(values), 4)
    return low if low == high else f"{low} to {high}"
