"""An arm in its cell as a picture, from the side and from above: base, table, faces, boxes, links as thick as said."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from markupsafe import Markup

from casacal.model.capsules import Solid, radii_of
from casacal.pages.drawing import number, shortened, tag, together
from casacal.planning.clearance import Around
from casacal.values import Array

HIGH, EDGE = 200.0, 6.0  # units of a picture: its height, its margin
WIDEST = 300.0  # of one view
ARM, WRIST, TIP, FACE, BOX, GROUND = "#7fa6c9", "#4f81ad", "#c2560c", "#d9a441", "#b05c5c", "#8a93a0"
DOTS = 400  # tips that an overview shows
NAMED = 18  # letters of a face's name


@dataclass(frozen=True, eq=False)
class CellDrawing:
    """Pictures of postures in one cell, all to one scale.

    arms: places along the arm (N, k, 3; mm), the base first and the tip last. towards: the horizontal direction (2,)
    to the right of the view from the side.
    """

    around: Around
    arms: Array
    towards: Array

    @staticmethod
    def of(around: Around, joints: Array, tips: Array) -> CellDrawing | None:
        """Of postures (N, n; rad, mm) with tips (N, 3; mm); None for an arm of which the tip alone is known."""
        if around.skeleton.place is None:
            return None
        ahead = tips[:, :2].mean(axis=0)
        far = float(np.linalg.norm(ahead))
        arms = np.concatenate([around.skeleton.place(joints), tips[:, None]], axis=1)
        return CellDrawing(around, arms, ahead / far if far > 1.0 else np.array([1.0, 0.0]))

    @property
    def cell(self) -> Markup:
        """What stands still, to be used by every posture of a page: to stand in it once, before them."""
        views = [tag("g", *self._still(top), at={"id": f"cell-{top}"}) for top in (0, 1)]
        return tag("svg", tag("defs", *views), at={"width": "0", "height": "0", "aria-hidden": "true"})

    def posture(self, k: int) -> Markup:
        """The k-th posture from both sides; `cell` stands before it on the page."""
        still = [tag("use", at={"href": f"#cell-{top}"}) for top in (0, 1)]
        return together(*(self._view(top, {"aria-label": "posture"}, still[top], *self._arm(k, top)) for top in (0, 1)))

    def overview(self) -> tuple[Markup, Markup]:
        """The first posture, tips (some of many), and the names of the faces, from both sides."""
        views, count = [], len(self.arms)
        some = np.unique(np.linspace(0, count - 1, min(count, DOTS)).astype(np.intp))
        for top, words in enumerate(("the cell from the side", "the cell from above")):
            across, down = self._seen(self.arms[some, -1], top)
            dots = "".join(f"M{number(a)} {number(b)}h.1" for a, b in zip(across, down, strict=True))
            at = {"d": dots, "stroke": TIP, "stroke-width": "2.5", "stroke-linecap": "round"}
            title = tag("title", words, at={"id": f"overview-{top}"})
            parts = (title, *self._still(top), *self._arm(0, top), tag("path", at=at), *self._names(top))
            views.append(self._view(top, {"aria-labelledby": f"overview-{top}"}, *parts))
        return views[0], views[1]

    def _view(self, top: int, words: Mapping[str, str], *parts: Markup) -> Markup:
        box = f"0 0 {number(self._sizes[top])} {number(HIGH)}"
        return tag("svg", *parts, at={"viewBox": box, "role": "img", "class": "arm", **words})

    def _flat(self, places: Array, top: int) -> Array:
        """Places (..., 3) as seen: across and up (..., 2), mm."""
        return places[..., :2] if top else np.stack([places[..., :2] @ self.towards, places[..., 2]], axis=-1)

    @cached_property
    def _frames(self) -> tuple[Array, Array]:
        """Lowest and highest place of each view (2, 2), mm."""
        everything = [self.arms.reshape(-1, 3), *(_corners(solid).reshape(-1, 3) for solid in self._faces)]
        seen = [self._flat(np.vstack(everything), top) for top in (0, 1)]
        room = max(self.around.radius, 0.03 * float(np.ptp(seen[0], axis=0).max()))
        return np.array([each.min(axis=0) - room for each in seen]), np.array(
            [each.max(axis=0) + room for each in seen]
        )

    @property
    def _faces(self) -> list[Solid]:
        return [solid for solid in self.around.solids if solid.touched]

    @cached_property
    def _scale(self) -> float:
        """Units of the picture for a millimetre."""
        spans = self._frames[1] - self._frames[0]
        return float(min((HIGH - 2 * EDGE) / spans[:, 1].max(), (WIDEST - 2 * EDGE) / spans[:, 0].max()))

    @cached_property
    def _sizes(self) -> Array:
        """Widths of the views."""
        return (self._frames[1] - self._frames[0])[:, 0] * self._scale + 2 * EDGE

    def _seen(self, places: Array, top: int) -> tuple[Array, Array]:
        """Units from the left and from the top of places (..., 3)."""
        flat = (self._flat(places, top) - self._frames[0][top]) * self._scale
        flat = flat.clip(-10 * WIDEST, 10 * WIDEST)  # a box may have no end
        return EDGE + flat[..., 0], HIGH - EDGE - flat[..., 1]

    def _path(self, places: Array, top: int, colour: str, width: float, look: Mapping[str, str]) -> Markup:
        across, down = self._seen(places, top)
        line = "L".join(f"{number(a)} {number(b)}" for a, b in zip(across, down, strict=True))
        return tag(
            "path", at={"d": f"M{line}", "fill": "none", "stroke": colour, "stroke-width": number(width), **look}
        )

    def _still(self, top: int) -> list[Markup]:
        parts, width = [], self._sizes[top]
        if not top and self.around.table > -np.inf:
            _, down = self._seen(np.array([0.0, 0.0, self.around.table]), top)
            ground = {"x": "0", "y": number(float(down)), "width": number(width), "height": number(HIGH - float(down))}
            parts.append(tag("rect", at={**ground, "fill": GROUND, "fill-opacity": "0.35"}))
        for solid in self.around.solids:
            colour = FACE if solid.touched else BOX
            for side in _corners(solid)[: 1 if solid.touched else 6]:
                around = np.vstack([side, side[:1]])
                parts.append(self._path(around, top, colour, 2.0, {"fill": colour, "fill-opacity": "0.4"}))
        thick = 2 * self._radii[0] * self._scale
        (across,), (down,) = self._seen(self.arms[0, :1], top)
        foot = {"x": number(across - 0.7 * thick), "y": number(down - (0.7 if top else 0.4) * thick)}
        sides = {"width": number(1.4 * thick), "height": number((1.4 if top else 0.4) * thick), "fill": GROUND}
        return [*parts, tag("rect", at={**foot, **sides}), self._path(self.arms[0, :2], top, GROUND, thick, {})]

    @property
    def _radii(self) -> Array:
        """Radii of the rods, mm, thick enough to be seen."""
        return radii_of(max(self.around.radius, 2.0 / self._scale), self.arms.shape[1] - 1)

    def _arm(self, k: int, top: int) -> list[Markup]:
        places, radii = self.arms[k], self._radii
        wrist = int(np.argmax(radii < radii[0]))
        shapes = ((places[1 : wrist + 1], ARM, radii[0]), (places[wrist:], WRIST, radii[-1]))
        round_ends = {"stroke-linecap": "round", "stroke-linejoin": "round"}
        drawn = [self._path(part, top, colour, 2 * radius * self._scale, round_ends) for part, colour, radius in shapes]
        (across,), (down,) = self._seen(places[-1:], top)
        dot = {"d": f"M{number(across)} {number(down)}h.1", "stroke": TIP, "stroke-width": "7", **round_ends}
        return [*drawn, tag("path", at=dot)]

    def _names(self, top: int) -> list[Markup]:
        names = []
        for solid in self._faces:
            across, down = self._seen(solid.origin, top)
            at = {"x": number(float(across)), "y": number(float(down)), "font-size": "10", "text-anchor": "middle"}
            names.append(tag("text", shortened(solid.name.removeprefix("face ").strip("'"), NAMED), at=at))
        return names


def _corners(solid: Solid) -> Array:
    """Corners of the sides of a box (6, 4, 3; mm), that of a face which is touched first."""
    sides = []
    for axis, end in product(range(3), (1, 0)):
        others = [k for k in range(3) if k != axis]
        side = np.empty((4, 3))
        side[:, axis] = (solid.low, solid.high)[end][axis]
        for k, other in enumerate(others):
            side[:, other] = np.where([(0, 1, 1, 0), (0, 0, 1, 1)][k], solid.high[other], solid.low[other])
        sides.append(side @ solid.axes + solid.origin)
    return np.array(sides)


def drawings(around: Around, joints: Array, tips: Array) -> tuple[Markup | None, Sequence[Markup] | None]:
    """The overview and each posture (N), for a page; None for an arm of which the tip alone is known."""
    drawing = CellDrawing.of(around, joints, tips)
    if drawing is None:
        return None, None
    return together(*drawing.overview(), drawing.cell), [drawing.posture(k) for k in range(len(joints))]
