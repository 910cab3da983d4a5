"""Picture of the arm's error before and after, with intervals, part by part, on a logarithmic axis."""

from __future__ import annotations

import math

from markupsafe import Markup

from casacal.pages.drawing import Panel, figure, number, picture, tag
from casacal.pages.render import shortened
from casacal.verification.figures import ErrorInterval, Figures

MOST = 16
"""Parts that have a place in the picture."""

EACH, TOP, BOTTOM = 40.0, 26.0, 44.0
"""Height of a part, and of what stands above and below all of them."""

DECADES = 5
"""Powers of ten that the axis spans at most."""

GREY, BLUE, ORANGE, INK = "#8b949f", "#1d5f9e", "#c2560c", "#1b2330"
NAMES = {"all": "", "face": "face ", "region": "tip at "}


def error_picture(found: Figures) -> Markup:
    """Two intervals for each part, what was promised, and the tolerance."""
    parts = found.errors[:MOST]
    low, high = _span(found)
    height = TOP + BOTTOM + EACH * len(parts)
    panel = Panel((low, high), (0.0, 1.0), height, left=24.0, right=24.0, top=TOP, bottom=BOTTOM)
    drawn = [_axis(panel)]
    for k, part in enumerate(parts):
        y = TOP + EACH * k
        label = shortened(f"{NAMES[part.kind]}{part.label} ({part.rows:,})", 52)
        drawn.append(tag("text", label, at={"x": number(panel.left), "y": number(y + 12)}))
        drawn += [_interval(panel, part.before, y + 20, GREY), _interval(panel, part.after, y + 30, BLUE)]
        if part.promised_mm > 0 and math.isfinite(part.promised_mm):
            drawn.append(_upright(panel, part.promised_mm, y + 25, y + 35, INK))
    if found.decision is not None:
        drawn.append(_upright(panel, found.decision.tolerance_mm, TOP, height - BOTTOM, ORANGE))
    says = "; ".join(f"{part.label}: {part.before.mm:.4f} before, {part.after.mm:.4f} after" for part in parts)
    more = "" if len(found.errors) <= MOST else f" {len(found.errors) - MOST} more stand in the table."
    tolerance = "" if found.decision is None else " The orange line is the tolerance."
    return figure(
        "Error of the arm as drawn (grey) and as calibrated (blue), RMS, with intervals of 95 %; one that reaches the "
        f"left edge reaches zero. Dark strokes are what the calibration promised.{tolerance}{more}",
        picture("errors-picture", "Error before and after, with intervals", f"In mm: {says}.", height, *drawn),
    )


def _span(found: Figures) -> tuple[float, float]:
    """Powers of ten between which all lie that can be shown."""
    values = [
        v for part in found.errors for each in (part.before, part.after) for v in (each.mm, each.low_mm, each.high_mm)
    ]
    values += [part.promised_mm for part in found.errors]
    values += [] if found.decision is None else [found.decision.tolerance_mm]
    shown = [value for value in values if 0 < value < math.inf] or [1.0]
    high = math.ceil(math.log10(max(shown)) + 1e-9)
    low = max(math.floor(math.log10(min(shown)) - 1e-9), high - DECADES)
    return float(min(low, high - 1)), float(high)


def _axis(panel: Panel) -> Markup:
    foot, parts = panel.height - panel.bottom, []
    for power in range(round(panel.x[0]), round(panel.x[1]) + 1):
        x = number(float(panel.across(power)))
        parts.append(tag("path", at={"d": f"M{x} {number(panel.top)}V{number(foot)}", "class": "grid"}))
        parts.append(tag("text", f"{10.0**power:g}", at={"x": x, "y": number(foot + 18), "class": "middle"}))
    parts.append(tag("text", "error, mm RMS", at={"x": "200", "y": number(panel.height - 6), "class": "middle title"}))
    parts.append(tag("text", "Before and after, with intervals of 95 %", at={"x": "4", "y": "14", "class": "title"}))
    return tag("g", *parts)


def _place(panel: Panel, value: float) -> float:
    """Picture units of a value; what is beyond the axis stands at its end."""
    power = math.log10(value) if 0 < value < math.inf else (math.inf if value > 0 else -math.inf)
    return float(panel.across(min(max(power, panel.x[0]), panel.x[1])))


def _interval(panel: Panel, error: ErrorInterval, y: float, colour: str) -> Markup:
    a, b = (number(_place(panel, value)) for value in (error.low_mm, error.high_mm))
    at = number(_place(panel, error.mm))
    bar = tag("path", at={"d": f"M{a} {number(y)}H{b}", "stroke": colour, "stroke-width": "2.5", "fill": "none"})
    dot = tag("path", at={"d": f"M{at} {number(y)}h.1", "class": "spot", "stroke": colour})
    return tag("g", bar, dot)


def _upright(panel: Panel, value: float, top: float, foot: float, colour: str) -> Markup:
    x = number(_place(panel, value))
    path = f"M{x} {number(top)}V{number(foot)}"
    return tag("path", at={"d": path, "stroke": colour, "stroke-width": "1.75", "fill": "none"})
