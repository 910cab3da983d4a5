"""What was measured: rows, held out, dial travel, tilt and place of each face."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from casacal.calibration.page.markup import Markup, paragraph, section
from casacal.calibration.page.numbers import count, fixed, left_out_rows, shortened
from casacal.calibration.page.table import NUMBER, WORDS, table
from casacal.calibration.page.touches import LOOKED_AT, Touches, by_instrument

MOST_FACES = 40
"""Faces with a line of their own."""


def measured_section(each: Sequence[Touches], document: Mapping[str, Any]) -> Markup:
    """Rows by face, and where the faces stand; instrument by instrument."""
    data = document["data"]
    aside = left_out_rows(data)
    opening = (
        f"{count(data['samples'], 'row')}, of which {data['fitted']:,} were fitted and "
        f"{data['heldout']:,} held out{_together(data)} to judge the fit"
        f"{'; ' * bool(aside)}{' and '.join(aside)}{', and not counted below' * bool(aside)}."
    )
    found = [part for touches in each for part in (by_instrument(touches), *_of_instrument(touches, document))]
    return section("measured", "What was measured", paragraph(opening), *found)


def _of_instrument(touches: Touches, document: Mapping[str, Any]) -> list[Markup | None]:
    if not touches.has_faces:
        return [*_no_faces(touches)]
    faces, instrument = touches.faces, touches.instrument
    columns = [(instrument.words.group.capitalize(), WORDS), ("Rows", NUMBER), ("Held out", NUMBER)]
    more = f" {count(len(faces) - MOST_FACES, 'further one')} are in result.json." if len(faces) > MOST_FACES else ""
    planes = {name for label in faces for name in plane_names(touches.name, label)} & set(document["planes"])
    if instrument.probe is None and not planes:
        plain = [_face(touches, label, {})[: len(columns)] for label in faces[:MOST_FACES]]
        shown = table(touches.named("faces"), f"Rows of each {instrument.words.group}", columns, plain)
        return [shown, paragraph(more), *_no_faces(touches)]
    columns += [("Dial reading, mm", NUMBER), ("Tilt, deg", NUMBER), ("Touched area, mm", NUMBER)]
    columns += [("Normal", NUMBER), ("Point on it, mm", NUMBER)]
    rows = [_face(touches, label, document["planes"]) for label in faces[:MOST_FACES]]
    some = max(len(part.rows_of(label)) for part in touches.parts for label in faces[:MOST_FACES]) > LOOKED_AT
    notes = "Tilt is the angle between plunger and face normal. Normal and point are as found, in the base frame."
    if some:
        notes += f" Tilt and area are of up to {LOOKED_AT:,} rows per face, evenly spread."
    shown = table(touches.named("faces"), "Faces and rows", columns, rows, look="wide")
    return [shown, paragraph(notes + more, style="note")]


def plane_names(instrument: str, label: str) -> tuple[str, ...]:
    """What the plane of a face may be called among all, the likeliest first."""
    return (f"{instrument} {label}", instrument, label, "plane") if instrument else (label, "plane")


def _together(data: Mapping[str, Any]) -> str:
    return "" if data["heldout_by"] == "rows" or not data["heldout"] else f" by {data['heldout_by']}"


def _no_faces(touches: Touches) -> list[Markup]:
    spans = []
    for name in touches.instrument.columns:
        values = touches.samples.columns[name]
        spans.append([name, fixed(float(values.min()), 3), fixed(float(values.max()), 3)])
    if not spans:
        return []
    columns = [("Column", WORDS), ("Smallest", NUMBER), ("Largest", NUMBER)]
    return [table(touches.named("columns"), "What the instrument read (mm, rad)", columns, spans)]


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
        if len(places.tilts):
            tilt = _range(places.tilts, 1)
    plane = next((planes[name] for name in plane_names(touches.name, label) if name in planes), None)
    normal, point = ("–", "–") if plane is None else (_triple(plane["normal"], 5), _triple(plane["point_mm"], 2))
    held = rows[1] if len(rows) > 1 else 0
    shown = shortened(label, 60)
    return [shown, f"{sum(rows):,}", f"{held:,}", _range(travel, 2), tilt, area, normal, point]


def _range(values: np.ndarray[Any, np.dtype[np.float64]], digits: int) -> str:
    if not len(values):
        return "–"
    return f"{fixed(float(values.min()), digits)} to {fixed(float(values.max()), digits)}"


def _triple(values: Any, digits: int) -> str:
    return ", ".join(fixed(float(value), digits) for value in values)
