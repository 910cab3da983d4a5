"""result.json and its parts: what other tools read of a calibration or of a simulated truth."""

from __future__ import annotations

import csv
import io
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from casacal.binding.bound_problem import BoundProblem, bind
from casacal.calibration.calibration import Calibration, Reference
from casacal.calibration.provenance import head_of, seen_from
from casacal.calibration.verdict import verdict_of
from casacal.calibration.warnings import warnings
from casacal.errors import CasacalError
from casacal.file_sets import side_by_side, together
from casacal.files import write_json, write_text
from casacal.least_squares.result import Result, Status
from casacal.problem.problem_file import ProblemFile
from casacal.samples.write import write_samples
from casacal.simulation.simulate import Simulation
from casacal.uncertainty.expectation import Box
from casacal.uncertainty.identifiability import correlated_pairs, verdict
from casacal.version import __version__

FILES = ("report.html", "result.json", "parameters.csv", "residuals.png", "convergence.png")
"""What a calibration writes, most read first."""
PLACED = (*(name for name in FILES if name != "result.json"), "result.json")
"""The same in the order of their placing: where result.json stands, all stand."""
NOTES = {
    "data": "determined by the samples",
    "prior": "partly determined by the samples, partly by the prior",
    "no": "not determined: the prior's value and spread stand",
    "held": "held at nominal",
}


def calibration_document(
    calibration: Calibration, source: ProblemFile | None = None, *, folder: Path | None = None
) -> dict[str, Any]:
    """The whole of result.json for a calibration; paths are relative to the folder that it will stand in, if any."""
    result, fit = calibration.result, calibration.fit
    prior_tip, tip = calibration.tip_std
    without = calibration.tip_std_without_prior
    return {
        **head_of(source or calibration.source, result, calibration.seed, fit.backend, folder),
        "verdict": asdict(verdict_of(calibration)),
        "data": {
            "file": seen_from(folder, calibration.samples.file),
            "sha256": calibration.samples.sha256,
            "samples": len(calibration.samples),
            "heldout": 0 if calibration.heldout is None else len(calibration.heldout.block.samples),
        },
        "cost": result.cost,
        "parameters": parameter_rows(fit, result),
        **_geometry(fit, result),
        "metrics": calibration.metrics,
        "tip": {
            "expected_rms_mm": tip,
            "prior_rms_mm": prior_tip,
            "without_prior_rms_mm": without[0],
            "unseen": without[1],
        },
        "noise": dict(zip(("ratio", "low", "high"), calibration.noise, strict=True)),
        "identifiability": _identifiability(calibration),
        "correlations": [
            {"names": [one, two], "value": value} for one, two, value in correlated_pairs(result.covariance, fit.names)
        ],
        "covariance": result.covariance,
        "warnings": warnings(calibration),
        "down_weighted_lines": calibration.down_weighted,
        "reference": _reference(calibration.reference),
        **_tail(result, calibration.seconds),
    }


def truth_document(
    bound: BoundProblem, truth: Result, source: ProblemFile, seed: int, *, folder: Path | None = None
) -> dict[str, Any]:
    """The truth behind simulated samples, in the shape of result.json."""
    samples = bound.block.samples
    rows = [{**row, "std": 0.0, "note": "true value of the simulated arm"} for row in parameter_rows(bound, truth)]
    return {
        **head_of(source, truth, seed, bound.backend, folder),
        "data": {
            "file": seen_from(folder, samples.file),
            "sha256": samples.sha256,
            "samples": len(samples),
            "heldout": 0,
        },
        "cost": truth.cost,
        "parameters": rows,
        **_geometry(bound, truth),
        "metrics": None,
        "identifiability": None,
        "covariance": truth.covariance,
        "reference": None,
        **_tail(truth, {"build": 0.0, "solve": 0.0, "total": 0.0}),
    }


def parameter_rows(bound: BoundProblem, result: Result) -> list[dict[str, Any]]:
    """One entry per number of a parameter: name, unit, nominal, estimate, std, identifiable, note."""
    rows = []
    for name, unit, nominal, j in bound.parameters():
        if j is None:
            row = {"estimate": nominal, "std": 0.0, "identifiable": "no", "note": NOTES["held"]}
        else:
            std = float(np.sqrt(result.covariance[j, j]))
            word = verdict(std, float(bound.prior_std[j]))
            row = {"estimate": nominal + float(result.x[j]), "std": std, "identifiable": word, "note": NOTES[word]}
        rows.append({"name": name, "unit": unit, "nominal": nominal, **row})
    return rows


def _identifiability(calibration: Calibration) -> dict[str, Any]:
    found, cures = calibration.identifiability, iter(calibration.advice)
    return {
        "unknowns": found.unknowns,
        "rank": found.rank,
        "condition": found.condition,
        "singular_values": found.singular_values,
        "null": [
            {"kind": d.kind, "words": d.words, "tip_mm": d.tip_mm, "structural": d.structural, "cure": next(cures)}
            for d in found.null
        ],
        "weak": [
            {"words": d.words, "singular_value": d.singular_value, "tip_mm": d.tip_mm, "cure": next(cures)}
            for d in found.weak
        ],
    }


def _reference(reference: Reference | None) -> dict[str, Any] | None:
    if reference is None:
        return None
    return {
        "solver": reference.solver,
        "cost": reference.cost,
        "relative_gap": reference.relative_gap,
        "kkt": reference.result.kkt,
        "iterations": reference.result.steps,
    }


def _geometry(bound: BoundProblem, result: Result) -> dict[str, Any]:
    """Planes, directions and frames at the estimate, and x itself."""
    found: dict[str, dict[str, Any]] = {"planes": {}, "directions": {}, "frames": {}}
    for slot in bound.slots:
        kind, shown = slot.unknown.shown(slot.nominal, result.x[slot.first : slot.first + slot.unknown.size])
        if kind in found:
            name = slot.name if kind != "planes" else slot.key if slot.label is None else slot.label
            found[kind][name] = shown
    unknowns = [{"name": n, "unit": u, "value": v} for n, u, v in zip(bound.names, bound.units, result.x, strict=True)]
    return {**found, "unknowns": unknowns}


def _tail(result: Result, seconds: Mapping[str, float]) -> dict[str, Any]:
    return {
        "evaluations": {"residual_rows": result.residual_rows, "jacobian_rows": result.jacobian_rows},
        "seconds": dict(seconds),
        "versions": {
            "casacal": __version__,
            "casadi": metadata.version("casadi"),
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
    }


def write_calibration(
    calibration: Calibration,
    folder: Path,
    *,
    command: str | None = None,
    box: Box | None = None,
) -> list[Path]:
    """Write report.html, result.json, parameters.csv and pictures into a folder.

    Args:
        calibration: what was found.
        folder: made where it does not exist.
        command: the command line that reproduces it, for the report; None when there was none.
        box: where the arm will work, mm in the base frame, for the report.

    Returns their paths.

    """
    from casacal.calibration.page import report_page
    from casacal.calibration.pictures import save_plots

    document = calibration_document(calibration, folder=folder)
    with together(folder, PLACED) as place:
        write_text(place / "report.html", report_page(calibration, document, command=command, box=box))
        write_json(place / "result.json", document)
        write_text(place / "parameters.csv", _table(parameter_rows(calibration.fit, calibration.result)))
        save_plots(calibration, place)
        made = [name for name in FILES if (place / name).exists()]
    return [folder / name for name in made]


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Parameters as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("name", "unit", "nominal", "estimate", "change", "std", "identifiable", "note"))
    for row in rows:
        change = row["estimate"] - row["nominal"]
        numbers = (f"{row['nominal']:.12g}", f"{row['estimate']:.12g}", f"{change:.6g}", f"{row['std']:.6g}")
        writer.writerow((row["name"], row["unit"], *numbers, row["identifiable"], row["note"]))
    return text.getvalue()


def write_simulation(simulation: Simulation, source: ProblemFile, path: Path) -> list[Path]:
    """Write simulated samples, and the truth as x.truth.json beside x.csv, both or neither; returns both paths."""
    samples, truth_path = simulation.samples, path.with_suffix(".truth.json")
    if path.exists() and not path.is_file():
        raise CasacalError(f"'{path}' is no file, and the truth goes beside it", "Name a file, such as x.csv")
    comments = [f"simulated by casacal {__version__} for {source.name}, seed {simulation.seed}: not a measurement"]
    with side_by_side([path, truth_path]) as (rows, answer):
        write_samples(rows, source.problem.layout(), samples, comments)
        written = replace(source.problem.read(rows), file=str(path))
        document = _truth_of(simulation, source, bind(source.problem, written), path.parent)
        document["data"]["file"] = path.name
        write_json(answer, document)
    return [path, truth_path]


def _truth_of(simulation: Simulation, source: ProblemFile, bound: BoundProblem, folder: Path) -> dict[str, Any]:
    truth = Result(
        method="truth",
        problem=bound,
        x=simulation.truth(bound),
        belief=np.zeros((bound.unknowns, bound.unknowns)),
        status=Status.TRUTH,
        trace={},
        steps=0,
        residual_rows=0,
        jacobian_rows=0,
    )
    return truth_document(bound, truth, source, simulation.seed, folder=folder)
