"""The arm's error on the page of a verification: boxes, table, picture; and the section's place in another report."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from casacal.deployment.arm import CalibratedArm
from casacal.errors import CasacalError
from casacal.pages.drawing import Panel, figure, fixed, mm, number, picture, shortened, tag
from casacal.verification.arm_error import Decision, ErrorInterval, PartError

LONGEST = 60  # characters of a label in a table
BEFORE = '<section id="measured"'  # where the section is put
STANDING = re.compile(r'<section id="verified".*?</section>\n*', re.DOTALL)

REPORT = "report.html"
NAMES = {"all": "", "face": "face ", "region": "tip at "}


def with_section(path: Path, arm: CalibratedArm, section: str) -> str:
    """The text of a calibration's report with the section of a verification.

    arm: the result that the report is of. Raises CasacalError where there is no such report, or it is of
    another calibration.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        fix = "Write a separate page: --report FILE"
        raise CasacalError(f"There is no report '{path}' to write into", fix) from None
    marks = [arm.source.sha256, arm.found.data.sha256]
    if "<title>Calibration of" not in text or text.count(BEFORE) != 1 or not all(mark in text for mark in marks):
        raise CasacalError(f"'{path}' is not the report of this result", "Write a separate page: --report FILE")
    return STANDING.sub("", text).replace(BEFORE, f"{section.strip()}\n{BEFORE}")


def error_rows(errors: Sequence[PartError]) -> list[list[str]]:
    """Rows of a table: the error of each part as drawn and as calibrated, with intervals, and what was promised."""
    rows = []
    for part in errors:
        each = [cell for error in (part.before, part.after) for cell in (fixed(error.mm), _between(error))]
        label = shortened(NAMES[part.kind] + part.label, LONGEST)
        rows.append([label, f"{part.rows:,}", *each, fixed(part.promised_mm)])
    return rows


def boxes(part: PartError | None, decision: Decision | None) -> list[tuple[str, str, str]]:
    """The figures that stand first: title, value and what explains it; none where the rows say nothing of the arm."""
    if part is None:
        return []
    shown = [
        ("Error as drawn", mm(part.before.mm, 4), f"{_between(part.before)} mm"),
        ("Error as calibrated", mm(part.after.mm, 4), f"{_between(part.after)} mm"),
        ("Promised", mm(part.promised_mm, 4), "what the calibration expects, RMS"),
    ]
    if decision is not None:
        limit = "noise hides it"
        if not math.isnan(decision.accept_below_mm):
            limit = f"accepted up to {mm(decision.accept_below_mm, 4)}"
        shown.append(("Tolerance", f"{decision.tolerance_mm:g} mm", f"{decision.verdict}; {limit}"))
    return shown


def _between(error: ErrorInterval) -> str:
    return f"{fixed(error.low_mm)} to {fixed(error.high_mm)}"


MOST = 16  # parts that have a place in the picture
EACH, TOP, BOTTOM = 40.0, 26.0, 44.0  # height of a part, and of what stands above and below all of them
DECADES = 5  # powers of ten that the axis spans at most
GREY, BLUE, ORANGE, INK = "#8b949f", "#1d5f9e", "#c2560c", "#1b2330"


def errors_picture(errors: Sequence[PartError], decision: Decision | None) -> Markup:
    """Error before and after: two intervals for each part, what was promised, and the tolerance, logarithmically."""
    parts = errors[:MOST]
    height = TOP + BOTTOM + EACH * len(parts)
    each = [error for part in errors for error in (part.before, part.after)]
    values = [value for error in each for value in (error.mm, error.low_mm, error.high_mm)]
    values += [part.promised_mm for part in errors]
    values += [] if decision is None else [decision.tolerance_mm]
    shown = [value for value in values if 0 < value < math.inf] or [1.0]
    high = math.ceil(math.log10(max(shown)) + 1e-9)
    low = min(max(math.floor(math.log10(min(shown)) - 1e-9), high - DECADES), high - 1)
    panel = Panel((float(low), float(high)), (0.0, 1.0), height, left=24.0, right=24.0, top=TOP, bottom=BOTTOM)
    axis, foot = [], height - BOTTOM
    for power in range(low, high + 1):
        x = number(float(panel.across(power)))
        axis.append(tag("path", at={"d": f"M{x} {number(TOP)}V{number(foot)}", "class": "grid"}))
        axis.append(tag("text", f"{10.0**power:g}", at={"x": x, "y": number(foot + 18), "class": "middle"}))
    axis.append(tag("text", "error, mm RMS", at={"x": "200", "y": number(height - 6), "class": "middle title"}))
    axis.append(tag("text", "Before and after, with intervals of 95 %", at={"x": "4", "y": "14", "class": "title"}))
    drawn = [tag("g", *axis)]
    for k, part in enumerate(parts):
        y = TOP + EACH * k
        label = shortened(f"{NAMES[part.kind]}{part.label} ({part.rows:,})", 52)
        drawn.append(tag("text", label, at={"x": number(panel.left), "y": number(y + 12)}))
        drawn += [_interval(panel, part.before, y + 20, GREY), _interval(panel, part.after, y + 30, BLUE)]
        if part.promised_mm > 0 and math.isfinite(part.promised_mm):
            drawn.append(_upright(panel, part.promised_mm, y + 25, y + 35, INK))
    if decision is not None:
        drawn.append(_upright(panel, decision.tolerance_mm, TOP, foot, ORANGE))
    says = "; ".join(f"{part.label}: {part.before.mm:.4f} before, {part.after.mm:.4f} after" for part in parts)
    more = "" if len(errors) <= MOST else f" {len(errors) - MOST} more stand in the table."
    tolerance = "" if decision is None else " The orange line is the tolerance."
    return figure(
        "Error of the arm as drawn (grey) and as calibrated (blue), RMS, with intervals of 95 %; one that reaches the "
        f"left edge reaches zero. Dark strokes are what the calibration promised.{tolerance}{more}",
        picture("errors-picture", "Error before and after, with intervals", f"In mm: {says}.", height, *drawn),
    )


def _place(panel: Panel, value: float) -> str:
    """Picture units of a value; what is beyond the axis stands at its end."""
    power = math.log10(value) if 0 < value < math.inf else (math.inf if value > 0 else -math.inf)
    return number(float(panel.across(min(max(power, panel.x[0]), panel.x[1]))))


def _interval(panel: Panel, error: ErrorInterval, y: float, colour: str) -> Markup:
    a, b, at = (_place(panel, value) for value in (error.low_mm, error.high_mm, error.mm))
    bar = tag("path", at={"d": f"M{a} {number(y)}H{b}", "stroke": colour, "stroke-width": "2.5", "fill": "none"})
    dot = tag("path", at={"d": f"M{at} {number(y)}h.1", "class": "spot", "stroke": colour})
    return tag("g", bar, dot)


def _upright(panel: Panel, value: float, top: float, foot: float, colour: str) -> Markup:
    path = f"M{_place(panel, value)} {number(top)}V{number(foot)}"
    return tag("path", at={"d": path, "stroke": colour, "stroke-width": "1.75", "fill": "none"})
