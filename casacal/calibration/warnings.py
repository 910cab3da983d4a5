"""Warnings that a summary must not be without: what a good-looking fit may hide."""

from __future__ import annotations

import math

import numpy as np

from casacal.calibration.calibration import Calibration
from casacal.uncertainty.workspace import tip_stds, without_rigid

FAR = 3.0
"""Prior standard deviations beyond which a parameter has moved too far for its prior."""
NOISE_BAND = (0.9, 1.1)
"""Found over stated noise: an interval outside this band is worth a warning."""
SHOWN = 6


def warnings(calibration: Calibration) -> list[str]:
    """Sentences, most telling first; empty when there is nothing to warn of."""
    return [
        sentence
        for sentence in (
            _far_parameters(calibration),
            _tip_beyond_what_was_seen(calibration),
            _noise(calibration),
            _ignored_rows(calibration),
        )
        if sentence
    ]


def tip_extremes(calibration: Calibration) -> tuple[float, float]:
    """Largest move of the tip from nominal, and its largest predicted standard deviation, over the workspace, mm.

    Both up to the base frame; lengths of the three axes together.
    """
    fit = calibration.fit
    joints, tips, slopes = calibration.workspace
    moved = without_rigid((tips - fit.tips(fit.x0, joints)).ravel(), tips).reshape(-1, 3)
    stds = tip_stds(calibration.result.covariance, without_rigid(slopes, tips))
    return float(np.linalg.norm(moved, axis=1).max()), float(np.linalg.norm(stds, axis=1).max())


def _far_parameters(calibration: Calibration) -> str:
    fit, x = calibration.fit, calibration.result.x
    moves = np.abs(x - fit.x0) / fit.prior_std
    far = [j for j in np.argsort(-moves) if moves[j] > FAR]
    if not far:
        return ""
    named = ", ".join(f"{fit.names[j]} ({moves[j]:.1f})" for j in far[:SHOWN])
    more = f" and {len(far) - SHOWN} more" if len(far) > SHOWN else ""
    return (
        f"parameters moved by more than {FAR:g} prior standard deviations: {named}{more}. Either the prior is too "
        "tight or the samples pull them where they do not belong; run casacal check."
    )


def _tip_beyond_what_was_seen(calibration: Calibration) -> str:
    before = calibration.metrics["before"]
    seen = before["heldout"] or before["fit"]
    assert seen is not None
    moved, std = tip_extremes(calibration)
    limit = seen["rmse_mm"]
    if moved <= limit and std <= limit:
        return ""
    things = calibration.fit.problem.instrument.words.things
    where = things if before["heldout"] is None else f"held-out {things}"
    spread = f"{std:.2f} mm" if math.isfinite(std) else "without bound"
    return (
        f"the nominal arm misses the {where} by {limit:.2f} mm RMS, yet somewhere in the workspace the "
        f"calibrated tip lies {moved:.2f} mm from the nominal one, with a standard deviation of up to {spread}. "
        "The samples cannot vouch for that; verify there before you rely on it."
    )


def _noise(calibration: Calibration) -> str:
    ratio, low, high = calibration.noise
    if low <= NOISE_BAND[1] and high >= NOISE_BAND[0]:
        return ""
    reason = "the model lacks something or the noise is larger" if ratio > 1 else "the stated noise is too large"
    return (
        f"residuals are {ratio:.2f} times what the stated noise explains (95 % {low:.2f} to {high:.2f}): {reason}, and "
        "standard deviations are off by about as much."
    )


def _ignored_rows(calibration: Calibration) -> str:
    lines = calibration.down_weighted
    if not lines:
        return ""
    named = ", ".join(str(line) for line in lines[: 2 * SHOWN])
    more = f" and {len(lines) - 2 * SHOWN} more" if len(lines) > 2 * SHOWN else ""
    return f"the robust loss gave less than half of their weight to {len(lines)} rows: lines {named}{more}."
