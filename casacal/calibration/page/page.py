"""The report of a calibration: what its template shows, section by section."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from casacal.calibration.calibration import NOT_NEEDED, Calibration
from casacal.calibration.corrections import VERY_STRONG
from casacal.calibration.doubts import size_words
from casacal.calibration.metrics import parts_of
from casacal.calibration.page.expected import expected_error
from casacal.calibration.page.measured import measured, worst_rows
from casacal.calibration.page.residual_pictures import face_maps, histograms, row_plots
from casacal.calibration.page.touches import TITLES, Touches
from casacal.calibration.verdict import Level
from casacal.pages.render import count, fixed, left_out_rows, mm, rendered, shortened, shown_unit
from casacal.uncertainty.expectation import Box
from casacal.uncertainty.identifiability import KNOWN_FROM, correlated_pairs
from casacal.wording import capital, numbered_lines, sized

LOOKS: Mapping[Level, str] = {"calibrated": "good", "use with care": "care", "do not use": "bad"}
"""How the page paints each level."""

LINES = 60
"""Line numbers that are named."""


def report_page(
    calibration: Calibration, document: Mapping[str, Any], *, command: str | None = None, box: Box | None = None
) -> str:
    """HTML of the report: one page that needs no other file, no network and no script.

    Args:
        calibration: whose rows and workspace are drawn.
        document: its result.json, whose numbers the page shows; see
            `casacal.calibration.result_json.calibration_document`.
        command: the command line that reproduces it, as typed; None when there was none.
        box: where the arm will work, mm in the base frame, or None.

    """
    each, problem, data = Touches.of_each(calibration), calibration.fit.problem, document["data"]
    denied = document["verdict"]["level"] == "do not use"
    aside = left_out_rows(data)
    context = {
        "title": f"Calibration of {problem.robot.name} ({document['problem']['name']})",
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
        "counts": [f"{data['fitted']:,} fitted", f"{data['heldout']:,} held out", *aside],
        "unknowns": f"{calibration.fit.unknowns:,}",
        "look": LOOKS[document["verdict"]["level"]],
        "figures": _figures(calibration, document),
        "aside": aside,
        "together": "" if data["heldout_by"] == "rows" or not data["heldout"] else f" by {data['heldout_by']}",
        "measured": [measured(touches, document) for touches in each],
        "residuals": list(_residuals(document, parts_of(calibration.fit))),
        "left_out": _left_out(document, problem.words.group, denied),
        "noise": document["noise"],
        "noise_words": _noise(calibration, document["noise"]),
        "pictures": [
            {"name": t.name, "histograms": histograms(t), "rows": row_plots(t), "faces": face_maps(t)} for t in each
        ],
        "expected": None if denied else expected_error(each, document, box),
        "parameters": _parameters(calibration, document["parameters"]),
        "correlations": [] if denied else _correlations(calibration),
        "cures": _cures(document) if document["cures"] else [],
        **_directions(document["identifiability"]),
        "effects": _effects(calibration, denied),
        "tried": _tried(document["discrepancy"]),
        "very_strong": f"{VERY_STRONG:g}",
        "worst": worst_rows(each),
        "lines_aside": calibration.aside_lines,
        "versions": ", ".join(f"{name} {version}" for name, version in document["versions"].items()),
        "seconds": ", ".join(f"{name} {value:.2f} s" for name, value in document["seconds"].items()),
    }
    return rendered("report.html", context)


def _figures(calibration: Calibration, document: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """What stands in the boxes under the verdict: title, value, words."""
    before, after, tip = document["metrics"]["before"], document["metrics"]["after"], document["tip"]
    part, where = ("fit", "fitted rows") if after["heldout"] is None else ("heldout", "held-out rows")
    free = [row for row in document["parameters"] if row["note"] != "held at nominal"]
    known = sum(row["identifiable"] == "data" for row in free)
    found, reference = document["identifiability"], calibration.reference
    expected = ("Expected tip error", "not stated", "the result must not be used")
    if document["verdict"]["level"] != "do not use":
        words = f"RMS over the workspace, apart from the position of the base; before {mm(tip['prior_rms_mm'])}"
        expected = ("Expected tip error", mm(tip["expected_rms_mm"]), words)
    residual = f"RMS of the {where}; before {mm(before[part]['rmse_mm'], 4)}"
    agreement, checked = "not run", "nothing checked"
    if reference is not None:
        checked, agreement = "on", f"{reference.solver.upper()} {'agrees' if reference.agrees else 'differs'}"
    minimum = f"{checked} the minimum; rank {found['rank']} of {count(found['unknowns'], 'unknown')}"
    return [
        expected,
        ("Residual: not accuracy", mm(after[part]["rmse_mm"], 4), residual),
        ("Known from samples", f"{known} of {len(free)}", "parameters; the others depend on the prior"),
        ("Second solver", agreement, minimum),
    ]


def _residuals(document: Mapping[str, Any], units: Mapping[str, str]) -> Iterator[list[str]]:
    """Rows of the table of residuals, instrument by instrument."""
    for part_name, metrics in document.get("metrics_by_instrument", {"": document["metrics"]}).items():
        unit = units.get(part_name, "mm")
        name = part_name if unit == "mm" else f"{part_name} ({unit}, not mm)"
        for when, title in TITLES.items():
            for part, words in (("fit", "fitted rows"), ("heldout", "held-out rows")):
                if (found := metrics[when][part]) is not None:
                    figures = [fixed(found[key]) for key in ("rmse_mm", "mae_mm", "std_mm", "max_mm")]
                    yield [f"{f'{name}: {title.lower()}' if name else title}, {words}", *figures]


def _left_out(document: Mapping[str, Any], group: str, denied: bool) -> dict[str, Any]:
    """Each face as the arm predicts it that the others give; no prediction where the verdict denies it."""
    predicted = [] if denied else [("#Predicted, mm RMS", "predicted_mm", 4), ("#Found over predicted", "ratio", 2)]
    shown = [("#Found, mm RMS", "actual_mm", 4), *predicted]
    rows = [
        [
            shortened(face["face"], 60),
            f"{face['rows']:,}",
            *(fixed(face[key], digits) for _, key, digits in shown),
            f"{face['p']:.2g}",
        ]
        for face in document["leave_one_face_out"]
    ]
    return {"columns": [capital(group), "#Rows", *(title for title, _, _ in shown), "#p"], "rows": rows}


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


def _parameters(calibration: Calibration, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Rows of the table of parameters, and the names of those that are held."""
    priors = {name: float(calibration.fit.prior_std[j]) for j, name in enumerate(calibration.fit.names)}
    held = [row["name"] for row in rows if row["note"] == "held at nominal"]
    free = [_parameter(row, priors.get(row["name"], math.inf)) for row in rows if row["note"] != "held at nominal"]
    return {"free": free, "held": held}


def _parameter(row: Mapping[str, Any], prior: float) -> list[object]:
    unit, factor = shown_unit(row["unit"])
    nominal, estimate, std = (factor * row[key] for key in ("nominal", "estimate", "std"))
    shown = [row["name"], unit, fixed(nominal), fixed(estimate), fixed(estimate - nominal, signed=True)]
    known = KNOWN_FROM[row["identifiable"]]
    if math.isnan(std):  # the verdict denies it
        return [*shown, "–", "–", known]
    share = f"{100 * row['std'] / prior:.0f} %" if math.isfinite(prior) and math.isfinite(std) else "no prior"
    mark = Markup('<span class="known {}">{}</span>').format(row["identifiable"], known)
    return [*shown, fixed(std), share, mark]


def _correlations(calibration: Calibration) -> list[list[str]]:
    """Pairs of the arm's own unknowns: planes are always correlated with each other and with the base."""
    arm = np.flatnonzero(~calibration.seen.datum)
    names = [calibration.seen.names[j] for j in arm]
    pairs = correlated_pairs(calibration.covariance[np.ix_(arm, arm)], names)
    return [[one, two, fixed(value, 3, signed=True)] for one, two, value in pairs]


def _cures(document: Mapping[str, Any]) -> list[list[str]]:
    rows = [
        [each["words"], mm(each["expected_rms_mm"]), "yes" if each["recommended"] else "no"]
        for each in document["cures"]
    ]
    return [*rows, ["As it is", mm(document["tip"]["expected_rms_mm"]), "–"]]


def _directions(found: Mapping[str, Any]) -> dict[str, Any]:
    """Null and weak directions, the costly ones first; those that move no tip apart."""
    every = [*found["null"], *({"kind": "weak", **each} for each in found["weak"])]
    every.sort(key=lambda each: -each["tip_mm"])
    costly = [
        [
            each["words"],
            each["kind"],
            "–" if math.isnan(each["tip_mm"]) else f"{each['tip_mm']:.2g}",
            capital(each["cure"]),
        ]
        for each in every
        if each["cure"] != NOT_NEEDED
    ]
    return {"costly": costly, "harmless": [each for each in every if each["cure"] == NOT_NEEDED]}


def _effects(calibration: Calibration, denied: bool) -> list[list[str]]:
    """A line for each effect beside the geometry, the likeliest first."""
    rows = []
    for test in calibration.score_tests:
        size, at_tip = size_words(calibration.unjudged, test)
        rows.append(
            [
                capital(test.words),
                test.shown,
                f"{test.p_holm:.2g}",
                size,
                test.shown_expected,
                "–" if denied or at_tip == "-" else at_tip,
            ]
        )
    return rows


def _tried(part: Mapping[str, Any] | None) -> dict[str, Any]:
    """Which effects could be corrected, and which are."""
    tried = [] if part is None else part["tried"]
    splits = list(dict.fromkeys(name for each in tried for name in each["unseen"]))
    yes = {None: "–", True: "yes", False: "no"}
    rows = [
        [
            capital(each["words"]),
            yes[each["corrected"]],
            f"{each['evidence']:.1f}",
            *(f"{each['unseen'][name]:.1f}" if name in each["unseen"] else "–" for name in splits),
            yes[each["helps"]],
        ]
        for each in tried
    ]
    gains = [f"#Gain, {name} left out" for name in splits]
    return {"columns": ["Effect", "Corrected", "#Gain, all rows", *gains, "Tip error smaller"], "rows": rows}
