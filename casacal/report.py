"""A calibration as text that a person reads at a glance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import casacal
from casacal.calibration import AGREEMENT, Calibration
from casacal.documents import parameter_rows

SHOWN_DIRECTIONS = 6
NOISE_BAND = (0.9, 1.1)
"""Found over stated noise: an interval outside this band is worth a warning."""

VERDICTS = {"data": "samples", "prior": "samples and prior", "no": "prior alone"}


def summary(calibration: Calibration, name: str) -> str:
    """Before and after, parameters with standard deviation and verdict, blind spots, reference; plain text."""
    parts = [
        _opening(calibration, name),
        _residuals(calibration),
        _accuracy(calibration),
        parameter_table(calibration),
        _blind_spots(calibration),
        _reference(calibration),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def parameter_table(calibration: Calibration) -> str:
    """Nominal, change, estimate and standard deviation of each free parameter, with what determined it.

    Angles are shown in degrees, lengths in mm.
    """
    lines = [f"{'parameter':<12}{'unit':<5}{'nominal':>13}{'estimate':>13}{'change':>11}{'std':>10}  known from"]
    held = []
    for row in parameter_rows(calibration.fit, calibration.result):
        if row["note"] == "held at nominal":
            held.append(row["name"])
            continue
        unit, factor = ("deg", 180 / math.pi) if row["unit"] == "rad" else (row["unit"], 1.0)
        nominal, estimate, std = (factor * row[key] for key in ("nominal", "estimate", "std"))
        lines.append(
            f"{row['name']:<12}{unit:<5}{nominal:>13.4f}{estimate:>13.4f}{estimate - nominal:>+11.4f}{std:>10.4f}"
            f"  {VERDICTS[row['identifiable']]}"
        )
    if held:
        lines.append(f"held at nominal: {', '.join(held)}")
    return "\n".join(lines)


def _opening(calibration: Calibration, name: str) -> str:
    fit, held = calibration.fit, calibration.heldout
    planes = sum(slot.key == "plane" for slot in fit.slots)
    rows = f"{fit.rows} fitted" + (f", {held.rows} held out" if held is not None else ", none held out")
    return (
        f"casacal {casacal.__version__} · {fit.problem.robot.name} ({name}) · {calibration.method}\n"
        f"{calibration.result.message}\n"
        f"{len(calibration.samples)} samples of {calibration.samples.file}: {rows}; "
        f"{planes} plane{'s' if planes != 1 else ''}, {fit.unknowns} unknowns"
    )


def _residuals(calibration: Calibration) -> str:
    lines = [f"{'distance from the planes, mm':<32}{'RMSE':>9}{'MAE':>9}{'STD':>9}{'MAX':>9}"]
    words = {"before": "before (planes fitted alone)", "after": "after"}
    for when, parts in calibration.metrics.items():
        for part, figures in parts.items():
            if figures is not None:
                label = f"  {words[when] if part == 'fit' else when + ', held out'}"
                lines.append(f"{label:<32}" + _figures(figures))
    return "\n".join(lines)


def _figures(figures: Mapping[str, Any]) -> str:
    return "".join(f"{figures[key]:>9.4f}" for key in ("rmse_mm", "mae_mm", "std_mm", "max_mm"))


def _accuracy(calibration: Calibration) -> str:
    before, after = calibration.tip_std
    lines = [
        "The distances above are not accuracy: a fit can look perfect on its planes while the arm is wrong elsewhere.",
        f"Expected tip error over the workspace, up to the base frame: {_mm(after)} RMS (before: {_mm(before)}),",
        "if the stated noise and priors are right and nothing else bends the arm.",
    ]
    ratio, low, high = calibration.noise
    if low > NOISE_BAND[1] or high < NOISE_BAND[0]:
        lines.append(
            f"Warning: residuals are {ratio:.2f} times what the stated noise explains (95 % {low:.2f} to {high:.2f}); "
            + ("the model lacks something or the noise is larger" if ratio > 1 else "the stated noise is too large")
            + ", and the standard deviations below are off by about as much."
        )
    return "\n".join(lines)


def _blind_spots(calibration: Calibration) -> str:
    found = calibration.identifiability
    lines = [
        f"What these samples can tell: rank {found.rank} of {found.unknowns} unknowns "
        f"(condition {found.condition:.1e}); {len(found.null)} null and {len(found.weak)} weak directions"
    ]
    said = [f"  {direction.kind + ':':<11}{direction.words}" for direction in found.null]
    said += [f"  {'weak:':<11}{direction.words}" for direction in found.weak]
    lines += said[:SHOWN_DIRECTIONS]
    if len(said) > SHOWN_DIRECTIONS:
        lines.append(f"  ... and {len(said) - SHOWN_DIRECTIONS} more, all in result.json")
    return "\n".join(lines)


def _reference(calibration: Calibration) -> str:
    reference = calibration.reference
    if reference is None:
        return "Reference: not run."
    verdict = "agrees" if reference.agrees else "DIFFERS"
    words = (
        f"Reference: {reference.solver} {verdict}; cost {calibration.result.cost:.10g}, its cost {reference.cost:.10g} "
        f"(relative gap {reference.relative_gap:.1e}, agreement within {AGREEMENT:.0e}), KKT residual "
        f"{reference.result.kkt:.1e}, {reference.result.steps} iterations."
    )
    return words if reference.result.converged else f"{words}\n{reference.solver}: {reference.result.message}"


def _mm(value: float) -> str:
    return f"{value:.3f} mm" if math.isfinite(value) else "unbounded"
