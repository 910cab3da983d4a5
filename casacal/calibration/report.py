"""report.html: one page about a calibration, to open offline, print and file; its sections in order."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from markupsafe import Markup

from casacal.calibration import summary
from casacal.calibration.brief import together
from casacal.calibration.calibration import Calibration
from casacal.calibration.motion import Tried, tip_extremes
from casacal.calibration.report_pictures import LOOKED_AT, MAPS, POSTURES, Touches, pictures_of, workspace_maps
from casacal.calibration.result_json import image_words, parameter_rows, verdict_lines
from casacal.calibration.verdict import WithVerdict, joint_error
from casacal.deployment.result import Level
from casacal.effects.selection import VERY_STRONG
from casacal.errors import CasacalError
from casacal.pages.drawing import Scale, count, figure, fixed, mm, rendered, shortened
from casacal.pages.space import space_fold
from casacal.planning.cell_drawing import CellDrawing
from casacal.planning.clearance import Clearance
from casacal.planning.offers import CalibratedCell
from casacal.planning.scene import scene
from casacal.simulation.cell import Cell
from casacal.uncertainty.tip_error import tip_stds, up_to_base, workspace_joints
from casacal.values import Array, Box
from casacal.wording import METRE, capital, numbered_lines, sized

MOST_FACES = 40  # faces with a line of their own
SHOWN = 10  # rows listed
LARGE = 4.0  # whitened residual beyond which fewer than one in ten thousand good rows lie
MARKED = 240  # touches drawn on the maps, of all faces together
IN_SPACE = 1500  # points of the map in space
LOOKS: Mapping[Level, str] = {"calibrated": "good", "use with care": "care", "do not use": "bad"}
"""How the page paints each level."""
CONTENTS = "<!-- contents -->"
LINES = 60  # line numbers that are named


def measured(touches: Touches, planes: Mapping[str, Any]) -> dict[str, Any]:
    """Rows by face, and where the faces are, of one instrument: its tables and a note."""
    if not touches.has_faces:
        return {"name": touches.name, "tables": _columns(touches), "note": ""}
    faces, instrument = touches.faces[:MOST_FACES], touches.instrument
    beyond = len(touches.faces) - MOST_FACES
    more = f" {count(beyond, 'further one')} are in result.json." if beyond > 0 else ""
    titles = [capital(instrument.words.group), "#Rows", "#Held out"]
    named = {name for label in touches.faces for name in _plane_names(touches.name, label)}
    if instrument.probe is None and not named & set(planes):
        rows = [_face(touches, label, {})[: len(titles)] for label in faces]
        own = _table(touches, "faces", f"Rows of each {instrument.words.group}", titles, rows)
        return {"name": touches.name, "tables": [own, *_columns(touches)], "note": more}
    titles += ["#Dial reading, mm", "#Tilt, deg", "#Touched area, mm", "#Normal", "#Point on it, mm"]
    rows = [_face(touches, label, planes) for label in faces]
    notes = "Tilt is the angle between plunger and face normal. Normal and point are as found, in the base frame."
    if max(len(part.rows_of(label)) for part in touches.parts for label in faces) > LOOKED_AT:
        notes += f" Tilt and area are of up to {LOOKED_AT:,} rows per face, evenly spread."
    own = _table(touches, "faces", "Faces and rows", titles, rows, look="wide")
    return {"name": touches.name, "tables": [own], "note": notes + more}


def worst_rows(each: Sequence[Touches]) -> dict[str, Any]:
    """The rows of all instruments that fit worst, most telling first, and how many are beyond `LARGE`."""
    worst: list[tuple[float, int, list[str]]] = []
    beyond, calibration = 0, each[0].calibration
    words = calibration.fit.problem.words
    for of, part in [(one, part) for one in each for part in one.parts]:
        white = np.abs(part.after / part.noise)
        sizes = white.max(axis=1)
        beyond += int((sizes > LARGE).sum())
        unit = of.instrument.words.unit
        for i in np.argsort(-sizes, kind="stable")[:SHOWN].tolist():
            label = "–" if part.labels is None else shortened(part.labels[i], 40)
            weight = "–" if part.held else fixed(float(part.weight[i]), 2)
            off = fixed(float(part.after[i, int(np.argmax(white[i]))]), signed=True)
            off += "" if unit == words.unit else f" {unit}"
            rows = "held\N{NO-BREAK SPACE}out" if part.held else "fitted"
            cells = [f"{of.name} {part.lines[i]}".strip(), label, rows, off, fixed(float(sizes[i]), 1), weight]
            worst.append((-float(sizes[i]), int(part.lines[i]), cells))
    worst.sort(key=lambda entry: entry[:2])
    titles = ["Line", capital(words.group), "Rows", f"#Residual, {words.unit}"]
    titles += [f"#Times {calibration.noise_words}", *(["#Weight"] if calibration.result.loss is not None else [])]
    rows_shown = [cells[: len(titles)] for _, _, cells in worst[:SHOWN]]
    return {"beyond": beyond, "large": f"{LARGE:g}", "columns": titles, "rows": rows_shown}


def _table(
    touches: Touches, name: str, caption: str, columns: list[str], rows: Sequence[object], *, look: str = ""
) -> dict[str, Any]:
    return {"name": touches.named(name), "caption": caption, "columns": columns, "rows": rows, "look": look}


def _columns(touches: Touches) -> list[dict[str, Any]]:
    """A table with the range of each column that the instrument read."""
    read = {name: touches.samples.columns[name] for name in touches.instrument.columns}
    spans = [[name, fixed(float(values.min()), 3), fixed(float(values.max()), 3)] for name, values in read.items()]
    titles = ["Column", "#Smallest", "#Largest"]
    return [_table(touches, "columns", "What the instrument read (mm, rad)", titles, spans)] if spans else []


def _plane_names(instrument: str, label: str) -> tuple[str, ...]:
    """Names under which the plane of a face may be listed, likeliest first."""
    return (f"{instrument} {label}", instrument, label, "plane") if instrument else (label, "plane")


def _face(touches: Touches, label: str, planes: Mapping[str, Any]) -> list[object]:
    rows = [len(part.rows_of(label)) for part in touches.parts]
    probe = touches.instrument.probe
    column = None if probe is None else probe.column
    readings = [part.samples.columns[column][part.rows_of(label)] for part in touches.parts if column is not None]
    travel = np.concatenate(readings) if readings else np.zeros(0)
    places = touches.places(label)
    area, tilt = "on a line", "–"
    if places is not None:
        wide, high = np.ptp(places.uv, axis=0)
        area = f"{wide:.0f} × {high:.0f}"
        tilt = _range(places.tilts, 1)
    plane = next((planes[name] for name in _plane_names(touches.name, label) if name in planes), None)
    normal, point = ("–", "–") if plane is None else (_triple(plane["normal"], 5), _triple(plane["point_mm"], 2))
    held = rows[1] if len(rows) > 1 else 0
    return [shortened(label, 60), f"{sum(rows):,}", f"{held:,}", _range(travel, 2), tilt, area, normal, point]


def _range(values: Array, digits: int) -> str:
    return f"{fixed(float(values.min()), digits)} to {fixed(float(values.max()), digits)}" if len(values) else "–"


def _triple(values: Any, digits: int) -> str:
    return ", ".join(fixed(float(value), digits) for value in values)


def cell_found(calibration: Calibration) -> tuple[CalibratedCell, Cell] | None:
    """The arm before its faces as they were found, and the cell of these; None where none are touched."""
    bound, x, own = calibration.fit, calibration.used_x, calibration.source.cell
    try:
        found = CalibratedCell.of(bound, x) if np.isfinite(x).all() else None
    except CasacalError:  # an arm that nobody understands
        return None
    return None if found is None else (found, Cell(faces=found.faces, table=-np.inf if own is None else own.table))


def cell_as_found(calibration: Calibration) -> Markup | None:
    """The faces as they were found and touched, with the arm at its first touch; None where none are touched."""
    if (there := cell_found(calibration)) is None:
        return None
    (found, cell), samples = there, calibration.fit.samples[0]
    readings = np.zeros(len(samples)) if found.probe.column is None else samples.columns[found.probe.column]
    tips, _ = found.touch.place(found.touch.local, samples.joints, readings[:, None])
    drawing = CellDrawing.of(Clearance().around(found.problem.robot, cell), samples.joints, tips)
    words = "The arm at its first touch, from the side and from above: faces (yellow) where and as large as they were "
    return None if drawing is None else figure(f"{words}touched, all tips (dots), the table grey.", *drawing.overview())


def in_space(calibration: Calibration, workspace: Workspace) -> Markup | None:
    """The arm at its first touch, the faces as found, and the map of expected errors, in space; None without faces."""
    if (there := cell_found(calibration)) is None:
        return None
    found, cell = there
    scale, rows = Scale.of_sizes(workspace.error), slice(None, None, len(workspace.tips) // IN_SPACE)
    tips, error = np.round(workspace.tips[rows]), workspace.error[rows]
    data = scene(found.problem, cell, Clearance(), calibration.fit.samples[0].take([0]))
    data["map"] = [{"colour": colour, "places": tips[some].tolist()} for colour, some in scale.parts(error)]
    words = "The arm at its first touch, faces as found, and the expected tip error in colours, dark where it is large."
    return space_fold("The workspace in space", words, data)


EARLIER = "that of the earlier result"


def expected_error(each: Sequence[Touches], box: Box | None) -> dict[str, Any]:
    """Rows of the table of figures, the largest correction, and maps of error and correction from two sides."""
    calibration = each[0].calibration
    workspace = Workspace.of(calibration)
    marks = [np.zeros((0, 3))]
    for touches in each:
        few = max(MARKED // (len(each) * len(touches.faces)), 3)
        places = (touches.places(label, few) for label in touches.faces[:MARKED])
        marks += [those.tips for those in places if those is not None]
    moved, worst = tip_extremes(calibration.motion, calibration.workspace)
    (before, now), (alone, missed) = calibration.tip_std, calibration.tip_std_without_prior
    unseen = f", {count(missed, 'direction')} unseen" if missed else ""
    earlier = calibration.earlier is not None
    rows = [
        ["Before: the earlier result" if earlier else "Before: priors alone", mm(before), "–"],
        ["After: samples and priors", mm(now), mm(worst)],
        [f"Samples alone, without priors{unseen}", mm(alone) if alone < METRE else "unbounded", "–"],
    ]
    if box is not None:
        rms, most = calibration.tip_std_in(box)
        ranges = ", ".join(f"{axis} {low:g} to {high:g}" for axis, (low, high) in zip("xyz", box, strict=True))
        rows.append([f"After, inside the box {ranges} mm", mm(rms), mm(most)])
    error = workspace_maps("error", "expected tip error, mm", workspace.error, workspace.tips, np.vstack(marks), box)
    base = EARLIER if earlier else "the nominal one"
    words, values = f"distance of the calibrated tip from {base}, mm", workspace.correction
    correction = workspace_maps("correction", words, values, workspace.tips, np.vstack(marks), box, base)
    what = "change from the earlier result" if earlier else "correction"
    largest = f"The largest {what} in the workspace is {mm(moved)}."
    maps = [(MAPS["error"][0], error), (MAPS["correction"][0], correction)]
    return {"rows": rows, "largest": largest, "maps": maps, "space": in_space(calibration, workspace)}


@dataclass(frozen=True)
class Workspace:
    """Tips (N, 3) of random postures, and at each the expected error and the correction (N,), all mm.

    Both apart from the pose of the base. The error is the standard deviation, its three axes together; the
    correction is how far the calibrated tip lies from the nominal one, or from that of an earlier result.
    """

    tips: Array
    error: Array
    correction: Array

    @staticmethod
    def of(calibration: Calibration) -> Workspace:
        """Sample random postures; the base is aligned over the postures of the summary's figure."""
        motion = calibration.motion
        arm, x = motion.arm, motion.x
        frame_joints, frame_tips, frame_slopes = calibration.workspace
        joints = workspace_joints(arm.problem.robot, poses=POSTURES, seed=1)
        tips, slopes = arm.tips(x, joints), arm.tip_jacobian(x, joints)
        field = up_to_base(slopes, tips, frame_slopes, frame_tips)
        error = np.linalg.norm(tip_stds(motion.covariance, field, motion.off), axis=1)
        moved = (tips - arm.tips(arm.x0, joints)).reshape(-1, 1)
        frame_moved = (frame_tips - arm.tips(arm.x0, frame_joints)).reshape(-1, 1)
        correction = np.linalg.norm(up_to_base(moved, tips, frame_moved, frame_tips).reshape(-1, 3), axis=1)
        return Workspace(tips, error, correction)


def report_page(
    calibration: WithVerdict, document: Mapping[str, Any], *, command: str | None = None, box: Box | None = None
) -> str:
    """HTML of the report: one page that needs no other file and no network; a script draws one fold when it is opened.

    document: its result.json, whose numbers the page shows (`calibration_document`). command: the command line that
    reproduces it, as typed, if there was one. box: where the arm will work, mm in the base frame.
    """
    each = tuple(Touches.of(calibration, i) for i in range(len(calibration.fit.samples)))
    problem, verdict, denied = calibration.fit.problem, calibration.verdict, calibration.denied
    parameters, held = summary.parameters_table(calibration)
    costly, harmless = summary.direction_table(calibration)
    known = Markup('<span class="known {}">{}</span>')  # who determined a parameter
    marked = [[*row[:-1], known.format(row[-1].replace(" ", "-"), row[-1])] for row in parameters.rows]
    context = {
        "title": f"Calibration of {problem.robot.name} ({calibration.source.name})",
        "document": document,
        "robot": problem.robot.name,
        "said": problem.words,
        "ground": "the arm as drawn" if calibration.earlier is None else "the arm by the earlier result",
        "assumed": calibration.assumed,
        "noise_of": calibration.noise_words,
        "loss": calibration.result.loss,
        "reference": calibration.reference,
        "command": command,
        "code": lambda value: Markup("<code>{}</code>").format(value),
        "numbered": lambda lines: numbered_lines(lines, LINES),
        **_counts(calibration),
        "unknowns": f"{calibration.fit.unknowns:,}",
        "look": LOOKS[verdict.level],
        "verdict_lines": verdict_lines(calibration, verdict),
        "image": image_words(calibration, verdict),
        "figures": _figures(calibration),
        "measured": [measured(touches, document["planes"]) for touches in each],
        "residuals": summary.residual_table(calibration),
        "left_out": summary.left_out_table(calibration),
        "noise": document["noise"],
        "noise_words": _noise(calibration, document["noise"]),
        "cell": cell_as_found(calibration),
        "pictures": [pictures_of(touches) for touches in each],
        "expected": None if denied else expected_error(each, box),
        "parameters": parameters if denied else replace(parameters, rows=marked),
        "held": held,
        "correlations": None if denied else summary.correlation_table(calibration),
        "cures": None if denied else summary.cure_table(calibration),
        "directions": costly,
        "harmless": harmless,
        "constants": None if denied else summary.constant_table(calibration),
        "effects": summary.effect_table(calibration),
        "tried": _tried(calibration.tried),
        "very_strong": f"{VERY_STRONG:g}",
        "worst": worst_rows(each),
        "lines_aside": calibration.aside_lines,
        "versions": ", ".join(f"{name} {version}" for name, version in document["versions"].items()),
        "seconds": ", ".join(f"{name} {value:.2f} s" for name, value in document["seconds"].items()),
    }
    return _with_contents(rendered("report.html", context))


def _with_contents(page: str) -> str:
    """A page with links to its sections where its template has a mark for them."""
    titles = re.findall(r'<h2 id="([\w-]+)-title">(.*?)</h2>', page)  # as escaped as they stand there
    items = "".join(f'<li><a href="#{name}">{title}</a></li>' for name, title in titles)
    return page.replace(CONTENTS, f'<nav aria-label="Contents"><ul class="contents">{items}</ul></nav>', 1)


def _counts(calibration: Calibration) -> dict[str, Any]:
    """How many rows were fitted, held out, set aside and left out, and what was held out together."""
    kept = 0 if calibration.heldout is None else len(calibration.heldout.measured)
    aside, copies = len(calibration.aside_lines), calibration.copies
    excluded = [f"{aside:,} set aside"] if aside else []
    excluded += [f"{copies:,} {'copy' if copies == 1 else 'copies'} left out"] if copies else []
    counts = [f"{len(calibration.fit.measured):,} fitted", f"{kept:,} held out", *excluded]
    return {"counts": counts, "aside": excluded, "together": together(calibration) if kept else ""}


def _figures(calibration: WithVerdict) -> list[tuple[str, str, str]]:
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
    if not calibration.denied:
        words = f"RMS over the workspace, apart from the pose of the base; before {mm(drawn)}"
        expected = ("Expected tip error", mm(now), words)
    unit = calibration.fit.problem.words.unit
    residual = f"RMS of the {where}; before {fixed(was['rmse_mm'])} {unit}"
    agreement, checked = "not run", "nothing checked"
    if reference is not None:
        checked, agreement = "on", f"{reference.solver.upper()} {'agrees' if reference.agrees else 'differs'}"
    minimum = f"{checked} the minimum; rank {found.rank} of {count(found.unknowns, 'unknown')}"
    return [
        expected,
        ("Residual: not accuracy", f"{fixed(left['rmse_mm'])} {unit}", residual),
        ("Known from samples", f"{known} of {len(free)}", "parameters; the others depend on the prior"),
        ("Second solver", agreement, minimum),
    ]


def _noise(calibration: Calibration, noise: Mapping[str, Any]) -> str:
    faces = [face for face in noise["by_face"].values() if "unit" not in face]
    if not calibration.noise.scale or not faces:
        return "Every figure uses the noise as stated."
    each = ([face[key] for face in faces] for key in ("used_mm", "stated_mm"))
    used, stated = (" to ".join(dict.fromkeys((fixed(min(sizes)), fixed(max(sizes))))) for sizes in each)
    rad, loose = noise["joints_rad"], noise["loose_joint"]
    what = f"joint {loose} alone that does not repeat, by" if loose else "a joint repeatability of"
    size = joint_error(calibration.fit.problem.robot, loose, rad) if loose else sized(rad, "rad")
    more = f" The pattern fits {what} {size}." if rad else ""
    return f"Every figure uses the noise as found: {used} mm, stated {stated} mm.{more}"


def _tried(tried: Sequence[Tried]) -> dict[str, Any]:
    """Table of the effects that could be corrected, and of those that are."""
    splits = list(dict.fromkeys(name for each in tried for name in each.unseen))
    yes = {None: "–", True: "yes", False: "no"}
    rows = []
    for each in tried:
        corrected = "by columns of the rows" if each.told else yes[each.corrected]
        unseen = (f"{each.unseen[name]:.1f}" if name in each.unseen else "–" for name in splits)
        rows.append([capital(each.words), corrected, f"{each.evidence:.1f}", *unseen, yes[each.helps]])
    gains = [f"#Gain, {name} left out" for name in splits]
    return {"columns": ["Effect", "Corrected", "#Gain, all rows", *gains, "Tip error smaller"], "rows": rows}
