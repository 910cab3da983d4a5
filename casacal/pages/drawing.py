"""Pages from templates, and pictures as inline SVG: panels with axes, dots, bars, lines, and maps of small squares."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from casacal.values import Array, Index
from casacal.wording import capital, sized

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
        left, right = (sum(x) / 2 + side * room * unit / 2 for side in (-1, 1))
        low, high = (sum(y) / 2 + side * tall * unit / 2 for side in (-1, 1))
        return Panel((left, right), (low, high), tall + frame.top + frame.bottom)

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
    return f"{float(value):z.1f}".removesuffix(".0")


def nice_ceiling(value: float) -> float:
    """The next larger of 1, 1.5, 2, 2.5, 3, 4, 5, 6, 8 times a power of ten."""
    if value <= 0 or not math.isfinite(value):
        return 1e-3
    power = 10.0 ** math.floor(math.log10(value))
    factors = (1, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10)
    return next(factor * power for factor in factors if factor * power >= value * (1 - 1e-9))


def ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Values from low to high in steps of 1, 2 or 5 times a power of ten, with as many decimals as they need."""
    raw = max(high - low, 1e-12) / 5  # into at most so many parts
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * (1 - 1e-9))
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [(k * step, f"{k * step:.{digits}f}".replace("-", "−") if k else "0") for k in range(first, last + 1)]


def axes(panel: Panel, x_title: str, y_title: str, *, x_ticks: Ticks | None = None, upright: bool = False) -> Markup:
    """Frame, ticks and titles, the upright axis' above it; level grid lines and, if asked, upright ones."""
    left, right, low = panel.left, WIDTH - panel.right, panel.height - panel.bottom
    parts = []

    def path(d: str, look: str) -> None:
        parts.append(tag("path", at={"d": d, "class": look}))

    def text(words: str, x: float, y: float, look: str) -> None:
        parts.append(tag("text", words, at={"x": number(x), "y": number(y), "class": look}))

    for value, words in ticks(*panel.y):
        y = float(panel.down(value))
        path(f"M{number(left)} {number(y)}H{number(right)}", "grid")
        text(words, left - 6, y + 4.5, "end")
    for value, words in ticks(*panel.x) if x_ticks is None else x_ticks:
        x = float(panel.across(value))
        if x_ticks is None and upright:
            path(f"M{number(x)} {number(panel.top)}V{number(low)}", "grid")
        if x_ticks is None:
            path(f"M{number(x)} {number(low)}v5", "axis")
        if len(words) > 3 and x > right - 4:  # a long number at the edge would leave the picture
            text(words, WIDTH - 1, low + 18, "end")
        else:
            text(words, x, low + 18, "middle")
    path(f"M{number(left)} {number(low)}H{number(right)}", "axis")
    text(x_title, (left + right) / 2, panel.height - 6, "middle title")
    text(y_title, 4.0, 14.0, "title")
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
    base, some = number(float(panel.down(0.0))), heights > 0
    places = zip(panel.across(edges[:-1][some]), panel.across(edges[1:][some]), panel.down(heights[some]), strict=True)
    path = "".join(f"M{number(a)} {base}V{number(y)}H{number(b)}V{base}Z" for a, b, y in places)
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


@dataclass(frozen=True)
class Squares:
    """Lower left corners (k,) of squares that hold a point, their side, and the mean of the values in each (k,)."""

    x: Array
    y: Array
    side: float
    values: Array


def in_squares(points: Array, values: Array, most: int) -> Squares:
    """Means of values (N,) over squares that points (N, 2) fall into, `most` of them along the longer side."""
    low = points.min(axis=0)
    side = max(float(np.ptp(points, axis=0).max()) / most, 1e-9) * (1 + 1e-9)
    place = np.floor((points - low) / side).astype(np.int64)
    distinct, which = np.unique(place, axis=0, return_inverse=True)
    which = which.ravel()
    mean = np.bincount(which, weights=values) / np.bincount(which)
    return Squares(low[0] + side * distinct[:, 0], low[1] + side * distinct[:, 1], side, mean)


SIZES = ("#dce8f2", "#b9d2e6", "#8cb6d6", "#5b95c2", "#3573a8", "#1d4f86", "#0d2d57")
"""From small to large: light to dark."""
SIGNS = ("#0b4a8f", "#4b88c4", "#a3c3e2", "#d4d4d4", "#f2bd8c", "#dc7f2e", "#9c4a05")
"""From below to above: blue, grey, orange."""
UNBOUNDED = "#5a0f3c"


@dataclass(frozen=True)
class Scale:
    """Colours of the steps between edges, of which there is one fewer; the outer steps are open."""

    edges: tuple[float, ...]
    colours: tuple[str, ...]

    @staticmethod
    def of_sizes(values: Array) -> Scale:
        """Steps of a round number from zero to what nearly all values (N,) stay below."""
        step = nice_ceiling(_top(values) / len(SIZES))
        return Scale(tuple(step * k for k in range(1, len(SIZES))), SIZES)

    @staticmethod
    def of_signs(values: Array) -> Scale:
        """Steps of a round number below and above zero, the outer ones for a few in a hundred values (N,)."""
        middle = len(SIGNS) // 2
        step = nice_ceiling(_top(np.abs(values)) / (middle + 0.5))
        return Scale(tuple(step * k for k in range(-middle, middle + 1) if k), SIGNS)

    def parts(self, values: Array) -> Iterator[tuple[str, Index]]:
        """Each colour with the positions of the values (N,) that take it; unbounded ones come last."""
        finite = np.isfinite(values)
        step = np.searchsorted(np.array(self.edges), np.where(finite, values, 0.0), side="right")
        for k, colour in enumerate(self.colours):
            yield colour, np.flatnonzero(finite & (step == k))
        yield UNBOUNDED, np.flatnonzero(~finite)

    def key(self, name: str, words: str, *, unbounded: bool = False) -> Markup:
        """Picture of the steps with the numbers between them."""
        wide = (320.0 if unbounded else 364.0) / len(self.colours)
        parts = []
        for k, colour in enumerate(self.colours):
            box = {"x": number(20 + k * wide), "y": "22", "width": number(wide), "height": "12", "fill": colour}
            parts.append(tag("rect", at=box))
        for k, words_here in enumerate(rounded(self.edges), 1):
            parts.append(tag("text", words_here, at={"x": number(20 + k * wide), "y": "50", "class": "middle minor"}))
        parts.append(tag("text", words, at={"x": "20", "y": "14", "class": "title"}))
        if unbounded:
            parts.append(tag("rect", at={"x": "352", "y": "22", "width": "30", "height": "12", "fill": UNBOUNDED}))
            parts.append(tag("text", "unbounded", at={"x": "367", "y": "50", "class": "middle minor"}))
        says = f"{len(self.colours)} steps of colour, divided at {', '.join(rounded(self.edges))} mm."
        return tag("div", picture(name, words, says, 56.0, *parts), at={"class": "key"})


def rounded(edges: Sequence[float]) -> list[str]:
    """Edges with as many digits as the round step between them needs."""
    step = min(abs(edge) for edge in edges)
    digits = next(d for d in range(20) if math.isclose(round(step, d), step, rel_tol=1e-6))
    return [f"{edge:.{digits}f}".replace("-", "−") for edge in edges]


def _top(sizes: Array) -> float:
    """Round number that the sizes stay below, but for the largest few in a hundred."""
    finite = sizes[np.isfinite(sizes)]
    return nice_ceiling(float(np.quantile(finite, 0.98))) if len(finite) else 1.0


def fixed(value: float | None, digits: int = 4, *, signed: bool = False) -> str:
    """Number with so many decimals; what is not finite is unbounded."""
    if value is None or not math.isfinite(value):
        return "unbounded"
    shown = f"{value:+.{digits}f}" if signed else f"{value:.{digits}f}"
    return shown.replace("-", "", 1) if float(shown) == 0 and shown.startswith("-") else shown


def mm(value: float | None, digits: int = 3) -> str:
    """Length with its unit."""
    shown = fixed(value, digits)
    return shown if shown == "unbounded" else f"{shown} mm"


def shown_unit(unit: str) -> tuple[str, float]:
    """Unit a person reads in place of the one inside, and the factor to it: degrees for radians."""
    return ("deg", 180 / math.pi) if unit == "rad" else (unit, 1.0)


def count(number: int, word: str) -> str:
    """Number with its noun: 1 row, 2 rows, 1,000 rows."""
    return f"{number:,} {word}{'' if number == 1 else 's'}"


def shortened(words: str, longest: int) -> str:
    """Words that take no more than so many characters."""
    return words if len(words) <= longest else words[: max(longest - 1, 1)] + "…"


def rendered(template: str, context: Mapping[str, object]) -> str:
    """A page from templates/, or a part of one, that needs no other file, no network and no script."""
    return _templates().get_template(template).render(context)


def plain_text(template: str, context: Mapping[str, object]) -> str:
    """A text from templates/ with what it is given as it stands."""
    return _templates().overlay(autoescape=False, finalize=None).get_template(template).render(context)


@cache
def _templates() -> Environment:
    made = Environment(
        loader=PackageLoader("casacal.pages"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=showable,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    filters = (fixed, mm, count, shortened, capital, sized)
    made.filters |= {each.__name__: each for each in filters}
    return made
