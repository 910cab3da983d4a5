"""The report of a calibration: what its template shows, section by section."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from markupsafe import Markup

from casacal.calibration import tables
from casacal.calibration.calibration import Calibration
from casacal.calibration.motion import Tried
from casacal.calibration.page.expected import expected_error
from casacal.calibration.page.measured import measured, worst_rows
from casacal.calibration.page.residual_pictures import face_maps, histograms, row_plots
from casacal.calibration.page.touches import Touches
from casacal.calibration.result_parts import closing as closing_part
from casacal.calibration.result_parts import geometry, noise_part, parameter_rows
from casacal.calibration.told import verdict_lines
from casacal.calibration.verdict import verdict_of
from casacal.compensation.result import Level
from casacal.pages.drawing import count, fixed, mm, rendered
from casacal.uncertainty.discrepancy import VERY_STRONG
from casacal.uncertainty.expectation import Box
from casacal.wording import capital, numbered_lines, sized

LOOKS: Mapping[Level, str] = {"calibrated": "good", "use with care": "care", "do not use": "bad"}
"""How the page paints each level."""

LINES = 60  # line numbers that are named


def report_page(
    calibration: Calibration, document: Mapping[str, Any], *, command: str | None = None, box: Box | None = None
) -> str:
    """HTML of the report: one page that needs no other file, no network and no script.

    document: its result.json, whose numbers the page shows (`calibration_document`). command: the command line that
    reproduces it, as typed, if there was one. box: where the arm will work, mm in the base frame.
    """
    each = tuple(Touches.of(calibration, i) for i in range(len(calibration.fit.samples)))
    problem, denied = calibration.fit.problem, verdict_of(calibration).level == "do not use"
    noise, closing = noise_part(calibration.unjudged), closing_part(calibration.result, calibration.seconds)
    planes = geometry(calibration.fit, calibration.used_x)["planes"]
    parameters, held = tables.parameters(calibration)
    costly, harmless = tables.directions(calibration)
    context = {
        "title": f"Calibration of {problem.robot.name} ({calibration.source.name})",
        "document": document,
        "robot": problem.robot.name,
        "said": problem.words,
        "assumed": calibration.assumed,
        "noise_of": calibration.noise_words,
        "loss": calibration.result.loss,
        "reference": calibration.reference,
        "command": command,
        "code": lambda value: Markup("<code>{}</code>").format(value),
        "numbered": lambda lines: numbered_lines(lines, LINES),
        **_counts(calibration),
        "unknowns": f"{calibration.fit.unknowns:,}",
        **_verdict(calibration),
        "figures": _figures(calibration),
        "measured": [measured(touches, planes) for touches in each],
        "residuals": tables.residuals(calibration),
        "left_out": tables.left_out(calibration),
        "noise": noise,
        "noise_words": _noise(calibration, noise),
        "pictures": [
            {"name": t.name, "histograms": histograms(t), "rows": row_plots(t), "faces": face_maps(t)} for t in each
        ],
        "expected": None if denied else expected_error(each, box),
        "parameters": parameters if denied else replace(parameters, rows=[_marked(row) for row in parameters.rows]),
        "held": held,
        "correlations": None if denied else tables.correlations(calibration),
        "cures": None if denied else tables.next_steps(calibration),
        "directions": costly,
        "harmless": harmless,
        "effects": tables.effects(calibration),
        "tried": _tried(calibration.tried),
        "very_strong": f"{VERY_STRONG:g}",
        "worst": worst_rows(each),
        "lines_aside": calibration.aside_lines,
        "versions": ", ".join(f"{name} {version}" for name, version in closing["versions"].items()),
        "seconds": ", ".join(f"{name} {value:.2f} s" for name, value in closing["seconds"].items()),
    }
    return rendered("report.html", context)


def _counts(calibration: Calibration) -> dict[str, Any]:
    """How many rows were fitted, held out, set aside and left out, and what was held out together."""
    kept = 0 if calibration.heldout is None else len(calibration.heldout.measured)
    aside, copies = len(calibration.aside_lines), calibration.copies
    besides = [f"{aside:,} set aside"] if aside else []
    besides += [f"{copies:,} {'copy' if copies == 1 else 'copies'} left out"] if copies else []
    counts = [f"{len(calibration.fit.measured):,} fitted", f"{kept:,} held out", *besides]
    together = "" if calibration.heldout_by == "rows" or not kept else f" by {calibration.heldout_by}"
    return {"counts": counts, "aside": besides, "together": together}


def _verdict(calibration: Calibration) -> dict[str, Any]:
    """The verdict in words, after that of the arm with columns that tell effects, and its colour."""
    verdict = verdict_of(calibration)
    return {"look": LOOKS[verdict.level], "verdict_lines": verdict_lines(calibration, verdict)}


def _figures(calibration: Calibration) -> list[tuple[str, str, str]]:
    """The boxes under the verdict: title, value and explanation of each."""
    before, after, (drawn, now) = calibration.metrics["before"], calibration.metrics["after"], calibration.tip_std
    was, left, where = before["fit"], after["fit"], "fitted rows"
    if after["heldout"] is not None:
        was, left, where = before["heldout"], after["heldout"], "held-out rows"
    assert was is not None
    assert left is not None
    free = [row for row in parameter_rows(calibration) if row["known_from"] != "held"]
    known = sum(row["known_from"] == "samples" for row in free)
    found, reference = calibration.identifiability, calibration.reference
    expected = ("Expected tip error", "not stated", "the result must not be used")
    if verdict_of(calibration).level != "do not use":
        words = f"RMS over the workspace, apart from the position of the base; before {mm(drawn)}"
        expected = ("Expected tip error", mm(now), words)
    residual = f"RMS of the {where}; before {mm(was['rmse_mm'], 4)}"
    agreement, checked = "not run", "nothing checked"
    if reference is not None:
        checked, agreement = "on", f"{reference.solver.upper()} {'agrees' if reference.agrees else 'differs'}"
    minimum = f"{checked} the minimum; rank {found.rank} of {count(found.unknowns, 'unknown')}"
    return [
        expected,
        ("Residual: not accuracy", mm(left["rmse_mm"], 4), residual),
        ("Known from samples", f"{known} of {len(free)}", "parameters; the others depend on the prior"),
        ("Second solver", agreement, minimum),
    ]


def _marked(row: Sequence[str]) -> list[str]:
    """A parameter's row with the mark of who determined it."""
    return [*row[:-1], Markup('<span class="known {}">{}</span>').format(row[-1].replace(" ", "-"), row[-1])]


def _noise(calibration: Calibration, noise: Mapping[str, Any]) -> str:
    faces = [face for face in noise["by_face"].values() if "unit" not in face]
    if not calibration.noise.scale or not faces:
        return "Every figure uses the noise as stated."
    used, stated = (
        " to ".join(dict.fromkeys(fixed(edge([face[key] for face in faces])) for edge in (min, max)))
        for key in ("used_mm", "stated_mm")
    )
    joints = noise["joints_rad"]
    more = f" The pattern fits a joint repeatability of {sized(joints, 'rad')}." if joints else ""
    return f"Every figure uses the noise as found: {used} mm, stated {stated} mm.{more}"


def _tried(tried: Sequence[Tried]) -> dict[str, Any]:
    """Which effects could be corrected, and which are."""
    splits = list(dict.fromkeys(name for each in tried for name in each.unseen))
    yes = {None: "–", True: "yes", False: "no"}
    rows = [
        [
            capital(each.words),
            "by columns of the rows" if each.told else yes[each.corrected],
            f"{each.evidence:.1f}",
            *(f"{each.unseen[name]:.1f}" if name in each.unseen else "–" for name in splits),
            yes[each.helps],
        ]
        for each in tried
    ]
    gains = [f"#Gain, {name} left out" for name in splits]
    return {"columns": ["Effect", "Corrected", "#Gain, all rows", *gains, "Tip error smaller"], "rows": rows}
