"""Tables of the rows: what was measured on each face, and the rows that fit worst."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from casacal.array_types import Array
from casacal.calibration.page.touches import LOOKED_AT, Part, Touches
from casacal.pages.drawing import count, fixed, shortened
from casacal.wording import capital

MOST_FACES = 40  # faces with a line of their own
SHOWN = 10  # rows listed
LARGE = 4.0  # whitened residual beyond which fewer than one in ten thousand good rows lie


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
    worst: list[tuple[float, int, list[object]]] = []
    beyond, calibration = 0, each[0].calibration
    for name, part in ((of.name, part) for of in each for part in of.parts):
        white = np.abs(part.after / part.noise).max(axis=1)
        beyond += int((white > LARGE).sum())
        for i in np.argsort(-white, kind="stable")[:SHOWN].tolist():
            line, *cells = _row(part, i, float(white[i]))
            worst.append((-float(white[i]), int(part.lines[i]), [f"{name} {line}".strip(), *cells]))
    worst.sort(key=lambda entry: entry[:2])
    titles = ["Line", capital(calibration.fit.problem.words.group), "Rows", "#Residual, mm"]
    titles += [f"#Times {calibration.noise_words}", *(["#Weight"] if calibration.result.loss is not None else [])]
    rows = [cells[: len(titles)] for _, _, cells in worst[:SHOWN]]
    return {"beyond": beyond, "large": f"{LARGE:g}", "columns": titles, "rows": rows}


def _table(
    touches: Touches, name: str, caption: str, columns: list[str], rows: Sequence[object], *, look: str = ""
) -> dict[str, Any]:
    return {"name": touches.named(name), "caption": caption, "columns": columns, "rows": rows, "look": look}


def _columns(touches: Touches) -> list[dict[str, Any]]:
    """A table with the range of each column that the instrument read."""
    spans = [
        [name, fixed(float(values.min()), 3), fixed(float(values.max()), 3)]
        for name, values in ((name, touches.samples.columns[name]) for name in touches.instrument.columns)
    ]
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


def _row(part: Part, i: int, white: float) -> list[str]:
    component = int(np.argmax(np.abs(part.after[i] / part.noise[i])))
    labels = part.labels
    return [
        str(part.lines[i]),
        "–" if labels is None else shortened(labels[i], 40),
        "held\N{NO-BREAK SPACE}out" if part.held else "fitted",
        fixed(float(part.after[i, component]), signed=True),
        fixed(white, 1),
        "–" if part.held else fixed(float(part.weight[i]), 2),
    ]
