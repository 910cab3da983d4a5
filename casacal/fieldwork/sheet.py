"""A sheet to print and write on: twenty touches a page, each with a picture of the posture and what to expect."""

from __future__ import annotations

import numpy as np

from casacal.array_types import Array
from casacal.binding.nominal import nominal_tips
from casacal.calibration.page.markup import Markup, tag, together
from casacal.errors import ProblemError
from casacal.planning.clearance import nodes_of
from casacal.planning.route import Route
from casacal.planning.written import PLANNED_DECIMALS
from casacal.problem.problem import Problem
from casacal.samples.layout import Layout
from casacal.samples.write import WRITTEN

PER_PAGE = 20
"""Touches on a page."""

WIDE, HIGH = 64.0, 46.0
"""Size of a picture, in its own units."""

STYLE = """
body { font: 10pt/1.25 system-ui, "Segoe UI", "Liberation Sans", Arial, sans-serif; color: #1b2330; margin: 1.2cm; }
h1 { font-size: 13pt; margin: 0 0 0.3rem; } p { margin: 0 0 0.5rem; max-width: 48rem; }
table { border-collapse: collapse; width: 100%; break-after: page; }
table:last-of-type { break-after: auto; }
th, td { border: 0.5pt solid #8a93a0; padding: 1pt 4pt; text-align: left; vertical-align: middle; }
th { font-weight: 600; background: #f5f7f9; } td.number { text-align: right; font-variant-numeric: tabular-nums; }
td.write { min-width: 2.4cm; } tr { break-inside: avoid; } svg { width: 2.1cm; height: 1.05cm; display: block; }
.check td { background: #f5f7f9; }
"""


def sheet_page(problem: Problem, route: Route, name: str) -> str:
    """HTML of the sheet: one file that needs no other, to be printed from any browser.

    name: of the problem.
    """
    layout, pictures = problem.layout(), _pictures(problem, route)
    pages = [
        _table(route, layout, pictures, range(first, min(first + PER_PAGE, len(route))))
        for first in range(0, len(route), PER_PAGE)
    ]
    words = (
        "Bring the arm to each posture; where the instrument is at its end, go along the plunger until it reads about "
        "what is expected, for readings that differ tell the size of the arm. Write down the reading that there is, "
        "and the joint values where the controller shows others than planned. Touches to check with are shaded: keep "
        "their readings apart, for casacal verify. Pictures: from the side, and from above."
    )
    head = tag(
        "head",
        tag("meta", at={"charset": "utf-8"}),
        tag("title", f"Measuring sheet of {problem.robot.name}"),
        tag("style", Markup(STYLE)),
    )
    lines = tag("p", "Date:", Markup("&emsp;" * 8), "By:", Markup("&emsp;" * 10), "Instrument:")
    body = tag("body", tag("h1", f"Touches of {problem.robot.name} ({name})"), tag("p", words), lines, *pages)
    page = tag("html", head, body, at={"lang": "en"})
    for block in ("tr", "table", "p", "h1", "head", "style", "svg"):
        page = Markup(page.replace(f"</{block}>", f"</{block}>\n"))
    return f"<!DOCTYPE html>\n{page}\n"


def _table(route: Route, layout: Layout, pictures: list[Markup] | None, rows: range) -> Markup:
    joints = [f"q{i}{WRITTEN[kind][0].replace('_', ' ')}" for i, kind in enumerate(layout.joints, 1)]
    expected = [f"{name}, expected{WRITTEN[kind][0].replace('_', ' ')}" for name, kind in layout.columns.items()]
    read = [f"{name}{WRITTEN[kind][0].replace('_', ' ')}" for name, kind in layout.columns.items()] or ["touched"]
    titles = ["", *(["posture"] if pictures else []), *layout.labels, *joints, *expected, *read]
    header = tag("tr", *(tag("th", title) for title in titles))
    return tag("table", tag("thead", header), tag("tbody", *(_row(route, layout, pictures, k) for k in rows)))


def _row(route: Route, layout: Layout, pictures: list[Markup] | None, k: int) -> Markup:
    samples, purpose = route.samples, route.purposes[k]
    again = " again" if purpose == "again" else ""
    cells = [tag("td", f"{k + 1}{again}")]
    if pictures is not None:
        cells.append(tag("td", pictures[k]))
    cells += [tag("td", samples.labels[name][k]) for name in layout.labels]
    for value, kind in zip(samples.joints[k], layout.joints, strict=True):
        cells.append(tag("td", f"{value * WRITTEN[kind][1]:.{PLANNED_DECIMALS}f}", at={"class": "number"}))
    for name, kind in layout.columns.items():
        cells.append(tag("td", f"{samples.columns[name][k] * WRITTEN[kind][1]:.2f}", at={"class": "number"}))
    cells += [tag("td", "", at={"class": "write"})] * max(len(layout.columns), 1)
    return tag("tr", *cells, at={"class": purpose})


def _pictures(problem: Problem, route: Route) -> list[Markup] | None:
    """Each posture from the side and from above; None for an arm whose joints do not carry one another in order."""
    try:
        nodes = nodes_of(problem.robot, route.samples.joints)
    except ProblemError:
        return None
    arms = np.concatenate([nodes, nominal_tips(problem, 0, route.samples)[:, None]], axis=1)
    side = np.stack([np.hypot(arms[..., 0], arms[..., 1]), arms[..., 2]], axis=-1)
    top = arms[..., :2]
    return [_picture([(side[k], side), (top[k], top)]) for k in range(len(arms))]


def _picture(views: list[tuple[Array, Array]]) -> Markup:
    """Views side by side, each of one arm in the frame of all."""
    parts = []
    for place, (arm, all_of_them) in enumerate(views):
        low, high = all_of_them.reshape(-1, 2).min(axis=0), all_of_them.reshape(-1, 2).max(axis=0)
        unit = max(float((high - low).max()), 1e-9) / (HIGH - 6)
        x = place * WIDE + 3 + (arm[:, 0] - low[0]) / unit
        y = HIGH - 3 - (arm[:, 1] - low[1]) / unit
        line = "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True))
        parts.append(tag("path", at={"d": line, "fill": "none", "stroke": "#1d5f9e", "stroke-width": "2"}))
        parts.append(tag("circle", at={"cx": f"{x[-1]:.1f}", "cy": f"{y[-1]:.1f}", "r": "2.4", "fill": "#c2560c"}))
    box = f"0 0 {2 * WIDE:g} {HIGH:g}"
    return tag("svg", together(*parts), at={"viewBox": box, "role": "img", "aria-label": "posture"})
