"""result.json and its parts: what other tools read of a calibration or of a simulated truth."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from casacal.calibration import result_parts as parts
from casacal.calibration.calibration import Calibration
from casacal.calibration.verdict import WithVerdict, warnings
from casacal.data.repeats import listing
from casacal.data.samples import Measurements
from casacal.deployment.result import Verdict
from casacal.deployment.result_file import sealed
from casacal.files import MADE, together, write_json, write_text
from casacal.fit.bound_problem import BoundProblem
from casacal.model.problem_file import ProblemFile
from casacal.uncertainty.identifiability import correlated_pairs
from casacal.values import Box

if TYPE_CHECKING:
    from casacal.calibration.earlier import EarlierResult

FILES = ("report.html", "result.json", "parameters.csv", "residuals.png", "convergence.png")
"""Files that a calibration writes, most read first."""
PLACED = (*(name for name in FILES if name != "result.json"), "result.json")
"""These files in the order of placing: result.json last, so that where it stands all stand."""


def calibration_document(
    calibration: WithVerdict, source: ProblemFile | None = None, *, folder: Path | None = None
) -> dict[str, Any]:
    """The whole of result.json for a calibration; paths are relative to the folder that it will stand in, if any."""
    pairs = correlated_pairs(calibration.covariance, calibration.seen.names)
    return sealed(
        {
            **found_part(calibration, source, folder=folder),
            "metrics": calibration.metrics,
            **({"metrics_by_instrument": by} if (by := calibration.metrics_by_instrument) else {}),
            "leave_one_face_out": [{**asdict(face), "ratio": face.ratio} for face in calibration.left_out],
            "identifiability": parts.identifiability_part(calibration),
            "cures": [
                parts.picked(cure, "words", "touches", "expected_rms_mm", "recommended") for cure in calibration.cures
            ],
            "dial_errors": [
                {**parts.picked(error, "key", "words", "chance", "size", "unit"), "shown": error.shown}
                for error in calibration.dial_errors
            ],
            "trusted_constants": [asdict(each) for each in calibration.leverages],
            "correlations": [{"names": [one, two], "value": value} for one, two, value in pairs],
            "warnings": warnings(calibration.unjudged),
            "prior_moves": asdict(calibration.prior_moves),
            "set_aside": [asdict(finding) for finding in calibration.aside],
            "down_weighted_lines": calibration.down_weighted,
            **parts.constraints_part(calibration),
            "reference": parts.reference_part(calibration.reference),
        }
    )


def found_part(
    calibration: WithVerdict, source: ProblemFile | None = None, *, folder: Path | None = None
) -> dict[str, Any]:
    """The part of result.json that other tools rely on; the rest is for people and takes longer to compute."""
    result, fit, verdict, denied = calibration.result, calibration.fit, calibration.verdict, calibration.denied
    return {
        **parts.head_of(source or calibration.source, result, calibration.seed, fit.backend, folder),
        "verdict": asdict(verdict),
        "data": {
            "file": parts.relative_to(folder, calibration.samples.file),
            "sha256": calibration.samples.sha256,
            "samples": len(calibration.samples),
            "heldout": 0 if calibration.heldout is None else len(calibration.heldout.measured),
            "heldout_by": calibration.heldout_by,
            "fitted": len(fit.measured),
            **_fitted_rows(fit, Measurements.of(calibration.samples), folder, calibration.earlier),
            "set_aside": len(calibration.aside_lines),
            "copies": calibration.copies,
        },
        **parts.earlier_part(calibration, folder),
        "cost": result.cost,
        "mirror_image": None if denied or (image := calibration.mirror_image) is None else asdict(image),
        "parameters": parts.parameter_rows(calibration),
        **parts.geometry(fit, calibration.unjudged.used_x),
        "tip": None if denied else _tip(calibration),
        "noise": parts.noise_part(calibration.unjudged),
        "discrepancy": parts.discrepancy_part(calibration),
        **parts.spreads(None if denied else calibration.covariance, calibration.seen.names, fit),
        **parts.closing(result, calibration.seconds),
    }


def _tip(calibration: Calibration) -> dict[str, Any]:
    """The tip error to expect: after, before, and from the samples alone; and that of the flange's origin."""
    (before, now), (alone, unseen) = calibration.tip_std, calibration.tip_std_without_prior
    drawn, flange = calibration.flange_std
    tip = {"expected_rms_mm": now, "prior_rms_mm": before, "without_prior_rms_mm": alone, "unseen": unseen}
    return {**tip, "flange_expected_rms_mm": flange, "flange_prior_rms_mm": drawn}


def _fitted_rows(
    fit: BoundProblem, measured: Measurements, folder: Path | None, earlier: EarlierResult | None
) -> dict[str, Any]:
    """The rows that were fitted, to know them again; of several instruments by name, each with its file.

    With those of an earlier result: they tell the same arm, and are not fresh for this one either.
    """
    if len(measured.sets) == 1:
        listed = listing(fit.samples[0], fit.problem.layout())
        before = None if earlier is None else earlier.fitted_rows
        if before is not None and before["columns"] == listed["columns"]:
            values = [*before["values"], *listed["values"]]
            listed = {**listed, "rows": before["rows"] + listed["rows"], "values": values}
        return {"fitted_rows": listed}
    sets = {
        name: {
            "file": parts.relative_to(folder, some.file),
            "sha256": some.sha256,
            "samples": len(some),
            "fitted": len(fit.samples[i]),
            "fitted_rows": listing(fit.samples[i], fit.problem.layout(i)),
        }
        for i, (name, some) in enumerate(zip(measured.names, measured.sets, strict=True))
    }
    return {"instruments": sets}


def write_calibration(
    calibration: WithVerdict, folder: Path, *, command: str | None = None, box: Box | None = None
) -> list[Path]:
    """Write report.html, result.json, parameters.csv and pictures into a folder.

    folder: made where it does not exist. command: the command line that reproduces it, for the report, if there was
    one. box: where the arm will work, mm in the base frame, for the report. Returns their paths.
    """
    from casacal.calibration.pictures import save_plots
    from casacal.calibration.report import report_page

    document = calibration_document(calibration, folder=folder)
    with together(folder, PLACED) as place:
        write_text(place / "report.html", report_page(calibration, document, command=command, box=box))
        write_json(place / "result.json", document)
        write_text(place / "parameters.csv", _parameters_csv(document["parameters"], calibration.verdict))
        save_plots(calibration, place)
        made = [name for name in FILES if (place / name).exists()]
    return [folder / name for name in made]


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
