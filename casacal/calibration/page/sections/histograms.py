"""Histograms of the residuals: held-out rows against fitted ones, and against the noise."""

from __future__ import annotations

import numpy as np

from casacal.array_types import Array
from casacal.calibration.page.drawing import Panel, axes, bars, figure, line, nice_ceiling, picture, steps
from casacal.calibration.page.markup import Markup
from casacal.calibration.page.touches import TITLES, Touches, When, spread, thinned

BINS = (15, 41)
"""Fewest and most bars, odd, so that one stands about zero."""
REACH = 4.5
"""Robust standard deviations to which the axis goes."""
LOOKED_AT = 1500
"""Rows whose noise is looked at."""


def histograms(touches: Touches) -> Markup:
    """Before and after, each on a scale of its own."""
    held = (
        " The orange outline is held-out rows, which the fit did not see; it should look like the bars."
        if len(touches.parts) > 1
        else ""
    )
    caption = (
        "Histogram of the residuals, before (left or above) and after, each on its own scale; values beyond the axis "
        f"stand in the outermost bars.{held} The dark line is what the {touches.calibration.noise_words} predicts; "
        "fitted rows lie a little inside it."
    )
    return figure(caption, *(_histogram(touches, when) for when in TITLES))


def _histogram(touches: Touches, when: When) -> Markup:
    """Shares of fitted rows as bars, of held-out rows as an outline; after, what the noise predicts."""
    found = [part.residuals(when).ravel() for part in touches.parts]
    everything = np.concatenate(found)
    half = nice_ceiling(min(float(np.abs(everything).max()), REACH * spread(everything)))
    count = 2 * round(min(max(len(everything) ** (1 / 3), BINS[0] / 2), BINS[1] / 2) - 0.5) + 1
    edges = np.linspace(-half, half, count + 1)
    shares = [100 * np.histogram(np.clip(values, -half, half), edges)[0] / len(values) for values in found]
    curve = _expected(touches, edges) if when == "after" else np.zeros(0)
    top = 1.08 * max(float(np.concatenate([*shares, curve]).max()), 1.0)
    panel = Panel((-half, half), (0.0, top))
    beyond = int((np.abs(everything) > half).sum())
    return picture(
        touches.named(f"histogram-{when}"),
        f"{TITLES[when]}: share of rows by residual",
        f"Histogram of {len(everything):,} residuals from {-half:g} to {half:g} mm, {beyond:,} of them beyond; "
        f"median size {np.median(np.abs(everything)):.4f} mm.",
        panel.height,
        axes(panel, "residual, mm", f"{TITLES[when]}: % of rows"),
        bars(panel, edges, shares[0], f"bar {when}"),
        steps(panel, edges, shares[1], "outline held") if len(shares) > 1 else None,
        line(panel, (edges[:-1] + edges[1:]) / 2, curve, "expected") if len(curve) else None,
    )


def _expected(touches: Touches, edges: Array) -> Array:
    """Shares (bins,) that the noise of the rows, as used, predicts, percent."""
    from scipy.stats import norm

    stds = np.concatenate([thinned(np.sort(part.noise.ravel()), LOOKED_AT) for part in touches.parts])
    return np.asarray(100 * np.diff(norm.cdf(edges[:, None] / stds).mean(axis=1)))
