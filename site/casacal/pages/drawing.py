"""Pictures as inline SVG: a panel with axes, and dots, bars, lines and squares on it."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
from markupsafe import Markup, escape

from casacal.array_types import Array

UNSHOWABLE = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff\u200e\u200f\u202a-\u202e\u2066-\u2069\ufdd0-\ufdef\ufffe\uffff]"
)
"""Control characters, halves of characters, and marks that turn the direction of writing and so hide what is there."""

NOTHING: Mapping[str, object] = MappingProxyType({})


def showable(value: object) -> object:
    """Text in which characters that cannot be shown became the replacement character; markup as it is."""
    return value if isinstance(value, Markup) else UNSHOWABLE.sub("\ufffd", str(value))


def tag(name: str, *children: object, at: Mapping[str, object] = NOTHING) -> Markup:
    """Element with attributes `at` and children, which are markup or text to be escaped; None is left out."""
    attributes = "".join(f' {key}="{escape(showable(value))}"' for key, value in at.items())
    return Markup(f"<{name}{attributes}>{together(*children)}</{name}>\n")  # escaped above


def together(*children: object) -> Markup:
    """Children one after the other; None is left out."""
    return Markup("").join(escape(showable(child)) for child in children if child is not None)


Ticks: TypeAlias = Sequence[tuple[float, str]]

WIDTH = 400.0


@dataclass(frozen=True)
class Panel:
    """A rectangle with two linear axes, which turn values into picture units."""

    x: tuple[float, float]
    y: tuple[float, float]
    height: float = 250.0
    left: float = 54.0
    right: float = 10.0
    top: float = 26.0
    bottom: float = 44.0

    @staticmethod
    def square(x: tuple[float, float], y: tuple[float, float], tallest: float = 330.0) -> Panel:
        """Panel in which a millimetre is as long across as upwards; a narrow one stands in the middle."""
        frame = Panel(x, y)
        room = WIDTH - frame.left - frame.right
        spans = (x[1] - x[0], y[1] - y[0])
        tall = max(min(room * spans[1] / spans[0], tallest), 90.0)
        unit = max(spans[0] / room, spans[1] / tall)
        middle = [(a + b) / 2 for a, b in (x, y)]
        wide, high = room * unit / 2, tall * unit / 2
        return Panel(
            (middle[0] - wide, middle[0] + wide),
            (middle[1] - high, middle[1] + high),
            tall + frame.top + frame.bottom,
        )

    def across(self, values: Array | float) -> Array:
        """Picture units from the left."""
        scale = (WIDTH - self.left - self.right) / (self.x[1] - self.x[0])
        return np.asarray(self.left + (np.asarray(values) - self.x[0]) * scale)

    def down(self, values: Array | float) -> Array:
        """Picture units from the top."""
        scale = (self.height - self.top - self.bottom) / (self.y[1] - self.y[0])
        return np.asarray(self.height - self.bottom - (np.asarray(values) - self.y[0]) * scale)


def number(value: float) -> str:
    """Length in picture units with at most one decimal."""
    shown = f"{float(value):.1f}".removesuffix(".0")
    return "0" if shown == "-0" else shown


def nice_step(span: float, most: int) -> float:
    """Step of 1, 2 or 5 times a power of ten that divides a span into at most so many parts."""
    raw = max(span, 1e-12) / most
    power = 10.0 ** math.floor(math.log10(raw))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * (1 - 1e-9))


def nice_ceiling(value: float) -> float:
    """The next larger of 1, 1.5, 2, 2.5, 3, 4, 5, 6, 8 times a power of ten."""
    if value <= 0 or not math.isfinite(value):
        return 1e-3
    power = 10.0 ** math.floor(math.log10(value))
    factors = (1, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10)
    return next(factor * power for factor in factors if factor * power >= value * (1 - 1e-9))


def ticks(low: float, high: float, most: int = 5) -> list[tuple[float, str]]:
    """Round values from low to high with as many decimals as they need."""
    step = nice_step(high - low, most)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [(k * step, f"{k * step:.{digits}f}".replace("-", "−") if k else "0") for k in range(first, last + 1)]


def axes(panel: Panel, x_title: str, y_title: str, *, x_ticks: Ticks | None = None, upright: bool = False) -> Markup:
    """Frame, ticks and titles, level grid lines and, if asked, upright ones.

    The title of the upright axis stands above it, where it reads without a turned head.
    """
    left, right, low = panel.left, WIDTH - panel.right, panel.height - panel.bottom
    parts = []
    for value, words in ticks(*panel.y):
        y = number(float(panel.down(value)))
        parts.append(tag("path", at={"d": f"M{number(left)} {y}H{number(right)}", "class": "grid"}))
        at = {"x": number(left - 6), "y": number(float(panel.down(value)) + 4.5), "class": "end"}
        parts.append(tag("text", words, at=at))
    for value, words in ticks(*panel.x) if x_ticks is None else x_ticks:
        x = number(float(panel.across(value)))
        if x_ticks is None and upright:
            parts.append(tag("path", at={"d": f"M{x} {number(panel.top)}V{number(low)}", "class": "grid"}))
        if x_ticks is None:
            parts.append(tag("path", at={"d": f"M{x} {number(low)}v5", "class": "axis"}))
        parts.append(tag("text", words, at={"x": x, "y": number(low + 18), "class": "middle"}))
    parts.append(tag("path", at={"d": f"M{number(left)} {number(low)}H{number(right)}", "class": "axis"}))
    middle = number((left + right) / 2)
    parts.append(tag("text", x_title, at={"x": middle, "y": number(panel.height - 6), "class": "middle title"}))
    parts.append(tag("text", y_title, at={"x": "4", "y": "14", "class": "title"}))
    return together(*parts)


def dots(panel: Panel, x: Array, y: Array, look: str, *, colour: str | None = None) -> Markup | None:
    """Points (N,) of one look; None where there are none."""
    if not len(x):
        return None
    places = zip(panel.across(x), panel.down(y), strict=True)
    path = "".join(f"M{number(a)} {number(b)}h.1" for a, b in places)
    return tag("path", at={"d": path, "class": look, **({"stroke": colour} if colour else {})})


def bars(panel: Panel, edges: Array, heights: Array, look: str) -> Markup:
    """Bars (N,) from zero between edges (N + 1,)."""
    base = number(float(panel.down(0.0)))
    path = "".join(
        f"M{number(a)} {base}V{number(y)}H{number(b)}V{base}Z"
        for a, b, y, h in zip(
            panel.across(edges[:-1]), panel.across(edges[1:]), panel.down(heights), heights, strict=True
        )
        if h > 0
    )
    return tag("path", at={"d": path or "M0 0", "class": look})


def steps(panel: Panel, edges: Array, heights: Array, look: str) -> Markup:
    """Outline of bars (N,) between edges (N + 1,)."""
    base = number(float(panel.down(0.0)))
    places = zip(panel.across(edges[1:]), panel.down(heights), strict=True)
    path = f"M{number(float(panel.across(edges[0])))} {base}"
    return tag("path", at={"d": path + "".join(f"V{number(y)}H{number(b)}" for b, y in places), "class": look})


def line(panel: Panel, x: Array, y: Array, look: str) -> Markup:
    """Polygon through points (N,)."""
    path = "L".join(f"{number(a)} {number(b)}" for a, b in zip(panel.across(x), panel.down(y), strict=True))
    return tag("path", at={"d": f"M{path}", "class": look})


def cells(panel: Panel, x: Array, y: Array, size: float, colour: str) -> Markup | None:
    """Squares of one colour with their lower left corners at (x, y); None where there are none."""
    if not len(x):
        return None
    wide = float(panel.across(size) - panel.across(0.0))
    places = zip(panel.across(x), panel.down(y + size), strict=True)
    path = "".join(f"M{number(a)} {number(b)}h{number(wide)}v{number(wide)}h-{number(wide)}z" for a, b in places)
    return tag("path", at={"d": path, "fill": colour, "stroke": colour, "class": "cell"})


def picture(name: str, title: str, description: str, height: float, *parts: Markup | None) -> Markup:
    """SVG with a title and a description that are read aloud in its place."""
    at = {
        "id": name,
        "class": "picture",
        "viewBox": f"0 0 {number(WIDTH)} {number(height)}",
        "role": "img",
        "aria-labelledby": f"{name}-what {name}-says",
    }
    what, says = tag("title", title, at={"id": f"{name}-what"}), tag("desc", description, at={"id": f"{name}-says"})
    return tag("svg", what, says, *parts, at=at)


def figure(caption: object, *pictures: Markup | None, key: Markup | None = None) -> Markup:
    """Key of the colours, pictures side by side where there is room, above one another where not, and their caption."""
    return tag("figure", key, tag("div", *pictures, at={"class": "pictures"}), tag("figcaption", caption))
