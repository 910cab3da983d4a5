"""A sheet to print and write on: twenty touches a page, each with a picture of the posture and what to expect."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from casacal.array_types import Array
from casacal.binding.nominal import nominal_tips
from casacal.errors import ProblemError
from casacal.pages.drawing import tag, together
from casacal.pages.render import rendered
from casacal.planning.clearance import nodes_of
from casacal.planning.route import Route
from casacal.planning.written import PLANNED_DECIMALS
from casacal.problem.problem import Problem
from casacal.samples.samples import WRITTEN

WIDE, HIGH = 64.0, 46.0
"""Size of a picture, in its own units."""


def sheet_page(problem: Problem, route: Route, name: str) -> str:
    """HTML of the sheet: one file that needs no other, to be printed from any browser.

    name: of the problem.
    """
    layout, samples, pictures = problem.layout(), route.samples, _pictures(problem, route)
    joints = [f"q{i}{_unit(kind)}" for i, kind in enumerate(layout.joints, 1)]
    expected = [f"{column}, expected{_unit(kind)}" for column, kind in layout.columns.items()]
    read = [f"{column}{_unit(kind)}" for column, kind in layout.columns.items()] or ["touched"]
    rows = []
    for k, purpose in enumerate(route.purposes):
        picture = [] if pictures is None else [pictures[k]]
        numbers = [
            f"{value * WRITTEN[kind][1]:.{PLANNED_DECIMALS}f}"
            for value, kind in zip(samples.joints[k], layout.joints, strict=True)
        ]
        numbers += [f"{samples.columns[column][k] * WRITTEN[kind][1]:.2f}" for column, kind in layout.columns.items()]
        rows.append(
            {
                "purpose": purpose,
                "number": f"{k + 1}{' again' if purpose == 'again' else ''}",
                "words": [*picture, *(samples.labels[label][k] for label in layout.labels)],
                "numbers": numbers,
            }
        )
    titles = ["", *([] if pictures is None else ["posture"]), *layout.labels, *joints, *expected, *read]
    context = {"robot": problem.robot.name, "name": name, "titles": titles, "rows": rows, "blanks": len(read)}
    return rendered("sheet.html", context)


def _unit(kind: str) -> str:
    return WRITTEN[kind][0].replace("_", " ")


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
