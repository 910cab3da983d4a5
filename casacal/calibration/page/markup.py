"""HTML made of nested calls: what is not markup already is escaped, and every element is closed."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping
from types import MappingProxyType

VOID = ("meta",)
"""Elements that have no end."""

UNSHOWABLE = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff\u200e\u200f\u202a-\u202e\u2066-\u2069\ufdd0-\ufdef\ufffe\uffff]"
)
"""Control characters, halves of characters, and marks that turn the direction of writing and so hide what is there."""

NOTHING: Mapping[str, object] = MappingProxyType({})


class Markup(str):
    """Text that is HTML already; only the functions of this module make it."""

    __slots__ = ()


def text(value: object) -> Markup:
    """Any value as text of the page, escaped; characters that cannot be shown become the replacement character."""
    if isinstance(value, Markup):
        return value
    return Markup(html.escape(UNSHOWABLE.sub("\ufffd", str(value))))


def tag(name: str, *children: object, at: Mapping[str, object] = NOTHING) -> Markup:
    """Element with attributes `at` and children, which are markup or text to be escaped; None is left out."""
    attributes = "".join(f' {key}="{text(value)}"' for key, value in at.items())
    if name in VOID:
        return Markup(f"<{name}{attributes}>")
    return Markup(f"<{name}{attributes}>{together(*children)}</{name}>")


def together(*children: object) -> Markup:
    """Children one after the other; None is left out."""
    return Markup("".join(text(child) for child in children if child is not None))


def paragraph(*children: object, style: str | None = None) -> Markup:
    """Paragraph, of a class where one is named."""
    return tag("p", *children, at=NOTHING if style is None else {"class": style})


def section(name: str, title: str, *children: object) -> Markup:
    """Part of the page, with a heading that names it."""
    heading = tag("h2", title, at={"id": f"{name}-title"})
    return tag("section", heading, *children, at={"id": name, "aria-labelledby": f"{name}-title"})
