"""Pictures of report.html: residuals by row and face, and touches over the workspace."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, TypeAlias

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from casacal.calibration.calibration import Calibration
from casacal.data.columns import Labels
from casacal.data.samples import Measurements, Samples
from casacal.fit.bound_problem import BoundProblem
from casacal.model.geometry import fitted_plane
from casacal.model.instrument import Instrument
from casacal.pages.drawing import (
    Panel,
    Scale,
    Squares,
    axes,
    bars,
    cells,
    dots,
    figure,
    in_squares,
    line,
    mm,
    nice_ceiling,
    picture,
    shortened,
    steps,
)
from casacal.values import Array, Box, Index, Rows

BINS = (15, 41)  # fewest and most bars, odd, so that one stands about zero
BARS_REACH = 4.5  # robust standard deviations to which the axis goes
NOISE_OF = 1500  # rows whose noise is looked at
DRAWN = 1500  # points of one picture at most, but for the largest of each series
LARGEST = 10  # rows of each series that thinning must not hide
REACH = 8.0  # robust standard deviations beyond which a residual stands at the edge, not to flatten all others
NAMED = 6  # series with their names under the axis
MOST_SERIES = 200  # series that are drawn; of more, some are, evenly spread
LINED = 30  # series with lines between them
MOST_POINTS = 150  # touches of a face beyond which means over small squares are drawn in place of points
FACE_SQUARES = 14  # squares along the longer side of a face
MOST_MAPS = 12
LOOKED_AT = 4096  # rows of a face, evenly spread, whose tips and tilts are looked at; a multiple of the kernels' block
COORDINATES = "xyz"
SQUARES = 24  # squares along the longer side of a view
POSTURES = 8192  # random postures within the joint limits that a map is made of; a multiple of the kernels' block
MAPS = {  # title and caption of each map of the workspace
    "error": (
        "Expected tip error",
        f"Expected tip error after calibration, from {POSTURES:,} random postures within the joint limits; black dots "
        "are where it touched. Each square is the RMS over the postures that lead there. Verify where it is dark "
        "before you rely on it.",
    ),
    "correction": (
        "Correction",
        "How far the calibrated tip lies from {base}, apart from the pose of the base: what the calibration changes.",
    ),
}
TITLES: Mapping[When, str] = {"before": "Before", "after": "After"}


def pictures_of(touches: Touches) -> dict[str, Any]:
    """All pictures of the rows of an instrument."""
    maps = face_maps(touches)
    return {"name": touches.name, "histograms": histograms(touches), "rows": row_plots(touches), "faces": maps}


def histograms(touches: Touches) -> Markup:
    """Histograms of the residuals before and after, each on its own scale."""
    outline = " The orange outline is held-out rows, which the fit did not see; it should look like the bars."
    held = outline if len(touches.parts) > 1 else ""
    caption = (
        "Histogram of the residuals, before (left or above) and after, each on its own scale; values beyond the axis "
        f"stand in the outermost bars.{held} The dark line is what the {touches.calibration.noise_words} predicts; "
        "fitted rows lie a little inside it."
    )
    return figure(caption, *(_histogram(touches, when) for when in TITLES))


def _histogram(touches: Touches, when: When) -> Markup:
    """Shares of fitted rows as bars, of held-out rows as an outline; after, what the noise predicts."""
    found, unit = [part.residuals(when).ravel() for part in touches.parts], touches.instrument.words.unit
    everything = np.concatenate(found)
    half = nice_ceiling(min(float(np.abs(everything).max()), BARS_REACH * spread(everything)))
    count = 2 * round(min(max(len(everything) ** (1 / 3), BINS[0] / 2), BINS[1] / 2) - 0.5) + 1
    edges = np.linspace(-half, half, count + 1)
    shares = [100 * np.histogram(np.clip(values, -half, half), edges)[0] / len(values) for values in found]
    curve = np.zeros(0)
    if when == "after":  # shares that the noise of the rows, as used, predicts, percent
        from scipy.stats import norm

        stds = np.concatenate([thinned(np.sort(part.noise.ravel()), NOISE_OF) for part in touches.parts])
        curve = 100 * np.diff(norm.cdf(edges[:, None] / stds).mean(axis=1))
    panel = Panel((-half, half), (0.0, 1.08 * max(float(np.concatenate([*shares, curve]).max()), 1.0)))
    beyond = int((np.abs(everything) > half).sum())
    return picture(
        touches.named(f"histogram-{when}"),
        f"{TITLES[when]}: share of rows by residual",
        f"Histogram of {len(everything):,} residuals from {-half:g} to {half:g} {unit}, {beyond:,} of them beyond; "
        f"median size {np.median(np.abs(everything)):.4f} {unit}.",
        panel.height,
        axes(panel, f"residual, {unit}", f"{TITLES[when]}: % of rows"),
        bars(panel, edges, shares[0], f"bar {when}"),
        steps(panel, edges, shares[1], "outline held") if len(shares) > 1 else None,
        line(panel, (edges[:-1] + edges[1:]) / 2, curve, "expected") if len(curve) else None,
    )


def row_plots(touches: Touches) -> Markup:
    """Residuals by row before and after, each on its own scale."""
    total = sum(part.after.size for part in touches.parts)
    some = f" Some of {total:,} points are drawn: evenly spread ones and the largest." if total > DRAWN else ""
    if len(touches.series) > MOST_SERIES:
        some = f" Of {len(touches.series):,} series {MOST_SERIES} are drawn."
    held = " Blue and grey dots are fitted rows, orange squares held-out ones." if len(touches.parts) > 1 else ""
    group = touches.instrument.words.group
    kind = group if touches.has_faces and len(touches.series) > 1 else "series"
    caption = (
        f"Residual of each row in file order, {kind} by {kind}, before and after on scales of their own: a slope is "
        f"drift, a lone point an outlier. Large black dots at the edge lie beyond it.{held}{some}"
    )
    return figure(caption, *(_by_row(touches, when) for when in TITLES))


def _by_row(touches: Touches, when: When) -> Markup:
    count, unit = len(touches.series), touches.instrument.words.unit
    everything = np.concatenate([part.residuals(when).ravel() for part in touches.parts])
    largest = float(np.abs(everything).max())
    top = nice_ceiling(min(largest, REACH * spread(everything)))
    panel = Panel((0.0, float(count)), (-top, top))
    drawn, beyond = [], []
    most = max(DRAWN // (count * len(touches.parts)), 2)
    series = np.unique(np.linspace(0, count - 1, MOST_SERIES).astype(int)).tolist()
    for part in touches.parts:
        values, across, up = part.residuals(when), [np.zeros(0)], [np.zeros(0)]
        several = values.shape[1] > 1  # a series is then one of a row's residuals
        for k in series:  # one unit along the axis for each
            rows = np.arange(len(values)) if several else part.rows_of(touches.faces[k])
            rows = rows[np.argsort(part.lines[rows], kind="stable")]
            if len(rows):
                own = values[rows, k if several else 0]
                largest_of_it = np.argsort(-np.abs(own), kind="stable")[:LARGEST]
                kept = np.union1d(thinned(np.arange(len(rows)), most), largest_of_it)
                across.append(k + 0.06 + 0.88 * (kept + 0.5) / len(rows))
                up.append(own[kept])
        x, y = np.concatenate(across), np.concatenate(up)
        inside = np.abs(y) <= top
        drawn.append(dots(panel, x[inside], y[inside], "dot held" if part.held else f"dot {when}"))
        beyond.append(dots(panel, x[~inside], top * np.sign(y[~inside]), "dot beyond"))
    order = "rows in file order" if touches.has_faces else "rows in file order, coordinate by coordinate"
    between = range(1, count) if count <= LINED else ()
    named = touches.series if count <= NAMED else ()
    names = [(k + 0.5, shortened(name, max(3, 48 // count))) for k, name in enumerate(named)]
    return picture(
        touches.named(f"rows-{when}"),
        f"{TITLES[when]}: residual of each row",
        f"Residuals row by row in file order for {count} series; the largest is {largest:.4f} {unit}.",
        panel.height,
        axes(panel, order, f"{TITLES[when]}: residual, {unit}", x_ticks=names),
        *(line(panel, np.array([k, k], float), np.array([-top, top]), "grid") for k in between),
        line(panel, np.array([0.0, count]), np.zeros(2), "zero"),
        *drawn,
        *beyond,
    )


def face_maps(touches: Touches) -> Markup | None:
    """One map per face, all on one scale; None where rows touch no face."""
    if not touches.has_faces or touches.instrument.probe is None:
        return None
    maps = []
    for label in touches.faces[:MOST_MAPS]:
        if (p := touches.places(label)) is not None:
            means = in_squares(p.uv, p.residuals, FACE_SQUARES) if len(p.uv) > MOST_POINTS else None
            maps.append((label, p, means))
    if not maps:
        return None
    scale = Scale.of_signs(np.concatenate([p.residuals if m is None else m.values for _, p, m in maps]))
    pictures = [_map(touches.named(f"face-{k}"), *each, scale) for k, each in enumerate(maps)]
    some, pointed = any(means for *_, means in maps), any(means is None for *_, means in maps)
    words = ["Residual after the fit over each face; u and v are seen from the tool."]
    if pointed and len(touches.parts) > 1:
        words.append("Square points are held-out rows.")
    if some:
        words.append("Where touches are many, each square is their mean.")
    words += ["Patches of one colour: a face that is not flat or moved, or an effect that the model does not describe."]
    if len(touches.faces) > len(maps):
        words.append(f"{len(touches.faces) - len(maps)} more are not drawn.")
    key = scale.key(touches.named("face-key"), "residual after, mm")
    return figure(" ".join(words), *pictures, key=key)


def _map(name: str, label: str, places: Places, means: Squares | None, scale: Scale) -> Markup:
    low, high = places.uv.min(axis=0), places.uv.max(axis=0)
    edge = 0.08 * float((high - low).max())
    panel = Panel.square((low[0] - edge, high[0] + edge), (low[1] - edge, high[1] + edge), tallest=250.0)
    size = np.abs(places.residuals)
    drawn: list[Markup | None] = []
    for colour, rows in scale.parts(places.residuals if means is None else means.values):
        if means is not None:
            drawn.append(cells(panel, means.x[rows], means.y[rows], means.side, colour))
            continue
        for held, look in ((False, "spot"), (True, "spot square")):
            here = rows[places.held[rows] == held]
            drawn.append(dots(panel, places.uv[here, 0], places.uv[here, 1], look, colour=colour))
    across, up = ("(level)", " (up)") if places.upright else ("(along the base's x)", "")
    frame = axes(panel, f"u, mm {across}", f"{shortened(label, 28)}: v, mm{up}", upright=True)
    said = f"{len(size):,} touches; the largest residual is {size.max():.4f} mm."
    return picture(name, f"Residual over face {label}", said, panel.height, frame, *drawn)


def workspace_maps(
    name: str, words: str, values: Array, tips: Array, marks: Array, box: Box | None, base: str = ""
) -> Markup:
    """Values (N,) at tips from the side and from the top, where the box is drawn; `base`: what corrections are from."""
    scale, title = Scale.of_sizes(values), MAPS[name][0]
    framed = " The black frame is the box that was asked for." if box is not None else ""
    caption = MAPS[name][1].format(base=base) + framed

    def view(side: str, points: Array, touched: Array, across: str, up: str, *drawn: Box) -> Markup:
        squares = in_squares(points, values**2, SQUARES)
        x, y = ((float(at.min()), float(at.max()) + squares.side) for at in (squares.x, squares.y))
        panel, coloured = Panel.square(x, y), scale.parts(np.sqrt(squares.values))
        parts = [cells(panel, squares.x[rows], squares.y[rows], squares.side, colour) for colour, rows in coloured]
        frames = [
            line(panel, np.array([x0, x1, x1, x0, x0]), np.array([y0, y0, y1, y1, y0]), "box")
            for (x0, x1), (y0, y1), _ in drawn
        ]
        return picture(
            f"{name}-{side}",
            f"{title}, {side} view",
            f"Root mean square by square of {squares.side:.0f} mm; from {mm(values.min())} to {mm(values.max())}.",
            panel.height,
            axes(panel, across, f"{side} view: {up}", upright=True),
            *parts,
            *(dots(panel, touched[:, 0], touched[:, 1], look) for look in ("touch-halo", "touch")),
            *frames,
        )

    of_tips, of_marks = (np.column_stack([np.hypot(*each[:, :2].T), each[:, 2]]) for each in (tips, marks))
    return figure(
        caption,
        view("side", of_tips, of_marks, "distance from the base's axis, mm", "height, mm"),
        view("top", tips[:, :2], marks[:, :2], "x, mm", "y, mm", *([] if box is None else [box])),
        key=scale.key(f"{name}-key", words, unbounded=not bool(np.isfinite(values).all())),
    )


When: TypeAlias = Literal["before", "after"]


@dataclass(frozen=True)
class Part:
    """Fitted or held-out rows: all unknowns x after, residuals before and after (N, m; mm), noise, weight.

    Of a residual with blocks, those that are in the unit in which the instrument speaks.
    """

    bound: BoundProblem
    instrument: int
    held: bool
    x: Array
    before: Array
    after: Array
    noise: Array
    weight: Array  # under a robust loss (N,), the smallest of a row's residuals; one without

    def residuals(self, when: When) -> Array:
        """Residuals (N, m; mm) of the arm before or after calibration."""
        return self.before if when == "before" else self.after

    @cached_property
    def lines(self) -> NDArray[np.int64]:
        """Line of each row in its file (N,)."""
        return np.asarray(self.samples.lines, dtype=np.int64)

    @property
    def samples(self) -> Samples:
        """The rows as they were read."""
        return self.bound.samples[self.instrument]

    @property
    def labels(self) -> Labels | None:
        """Group label of each row (N,); None for an instrument without groups."""
        return self.samples.labels.get(self.bound.problem.instruments[self.instrument].groups or "")

    def rows_of(self, label: str) -> Index:
        """Rows of one face."""
        return np.arange(len(self.after)) if self._rows is None else self._rows.get(label, np.zeros(0, dtype=np.intp))

    @cached_property
    def _rows(self) -> dict[str, Index] | None:
        return None if self.labels is None else self.labels.rows()


@dataclass(frozen=True)
class Places:
    """Where some rows of a face touched."""

    tips: Array  # in the base frame at the estimate, (k, 3), mm
    tilts: Array  # angle between plunger and normal (k,), deg; empty for instruments without a plunger
    uv: Array  # on the face (k, 2), mm from the middle: v is up on an upright face, else u along the base's x
    residuals: Array  # after, (k,), mm
    held: Rows
    upright: bool


@dataclass(frozen=True)
class Touches:
    """All rows of one instrument of a calibration, fitted and held out; its name is empty for an only one."""

    calibration: Calibration
    parts: tuple[Part, ...]
    number: int = 0
    name: str = ""

    @staticmethod
    def of(calibration: Calibration, number: int = 0) -> Touches:
        """Residuals of the rows of an instrument, before and after."""
        parts, names, found = [], calibration.fit.problem.names, calibration.result
        pairs = (calibration.before.x, calibration.used_x), calibration.heldout_x
        for bound, pair in zip((calibration.fit, calibration.heldout), pairs, strict=True):
            held = bound is not calibration.fit
            if bound is None or (held and not len(bound.samples[number])):
                continue
            count, own = len(bound.samples[number]), bound.sample_rows(number)
            drawn = bound.leading[own].reshape(count, -1)[0] if count else slice(None)  # pictures have one unit
            before, after = (bound.plain_residual(x)[own].reshape(count, -1)[:, drawn] for x in pair)
            weight = np.ones(count) if held else found.weights[own].reshape(count, -1).min(axis=1)
            noise = bound.blocks[number].noise[:, drawn]
            parts.append(Part(bound, number, held, pair[1], before, after, noise, weight))
        return Touches(calibration, tuple(parts), number, names[number] if len(names) > 1 else "")

    @property
    def instrument(self) -> Instrument:
        """The instrument that measured the rows."""
        return self.calibration.fit.problem.instruments[self.number]

    @property
    def samples(self) -> Samples:
        """All of its rows as they were given."""
        return Measurements.of(self.calibration.samples).sets[self.number]

    def named(self, words: str) -> str:
        """A name for a picture or a table, or a title, that belongs to this instrument among several."""
        return f"{words}-{self.name}" if self.name else words

    @property
    def has_faces(self) -> bool:
        """Whether rows carry the label of a face."""
        return self.instrument.groups in self.samples.labels

    @cached_property
    def faces(self) -> tuple[str, ...]:
        """Labels of the faces in file order; one for all rows where there are none."""
        column = self.instrument.groups
        return self.samples.labels[column].names if column is not None and self.has_faces else ("all rows",)

    @property
    def series(self) -> tuple[str, ...]:
        """Series drawn side by side: one per face, or one per coordinate where a row has several residuals."""
        count = self.parts[0].after.shape[1]
        return self.faces if count == 1 else tuple(COORDINATES[:count]) if count <= 3 else tuple(map(str, range(count)))

    def places(self, label: str, most: int = LOOKED_AT) -> Places | None:
        """Where a face was touched; None where its touches lie on a line, so that they have no u and v."""
        chosen = [thinned(part.rows_of(label), most) for part in self.parts]
        touched = [*map(_tips_and_plungers, self.parts, chosen)]
        tips, plungers = (np.vstack(each) for each in zip(*touched, strict=True))
        plane = fitted_plane(tips)
        if not plane.flat:
            return None
        normal, upright = plane.normal, bool(abs(plane.normal[2]) < 0.7)
        # across the face (2, 3), as it looks from where the tool stands: u level and v up, or u along the base's x
        outward = -normal if plungers.any() and float((plungers @ normal).mean()) > 0 else normal
        axis = np.array([0.0, 0.0, 1.0] if upright else [1.0, 0.0, 0.0])
        along = axis - (outward @ axis) * outward
        along /= np.linalg.norm(along)
        across = np.array([np.cross(along, outward), along] if upright else [along, np.cross(outward, along)])
        tilts = np.degrees(np.arccos(np.clip(np.abs(plungers @ normal), 0, 1))) if plungers.any() else np.zeros(0)
        pairs = [*zip(self.parts, chosen, strict=True)]
        residuals = np.concatenate([part.after[rows, 0] for part, rows in pairs])
        held = np.concatenate([np.full(len(rows), part.held) for part, rows in pairs])
        return Places(tips, tilts, (tips - plane.centre) @ across.T, residuals, held, upright)


def spread(values: Array) -> float:
    """Robust standard deviation about zero of values (N,): 1.4826 times the median size."""
    return 1.4826 * float(np.median(np.abs(values)))


def thinned(rows: Index, most: int) -> Index:
    """At most `most` of the rows, evenly spread, with the first and the last."""
    if len(rows) <= most:
        return rows
    return rows[np.unique(np.linspace(0, len(rows) - 1, most).astype(np.intp))]


def _tips_and_plungers(part: Part, rows: Index) -> tuple[Array, Array]:
    """Tips (k, 3; mm) of some rows, and directions of the plunger (k, 3), zero where there is none."""
    block = part.bound.blocks[part.instrument]
    pattern = block.pattern[rows]
    inputs = part.x[block.columns[pattern]], block.constants[pattern], block.rows(rows)
    (tips,) = block.model.batch("tip")(*inputs)
    if block.model.plunger is None:
        return tips, np.zeros_like(tips)
    (plungers,) = block.model.batch("plunger")(*inputs)
    return tips, plungers
