"""Elements of SVG made of nested calls; HTML comes from templates. What is not markup already is escaped."""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType

from markupsafe import Markup, escape

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
