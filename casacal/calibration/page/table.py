"""Tables with a caption and headings for rows and columns; they scroll sideways where the page is narrow."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypeAlias

from casacal.calibration.page.markup import Markup, tag

WORDS, NUMBER = "words", "number"
Look: TypeAlias = Literal["", "stacked", "wide", "small"]


def table(
    name: str,
    caption: object,
    columns: Sequence[tuple[object, str]],
    rows: Sequence[Sequence[object]],
    *,
    look: Look = "",
) -> Markup:
    """Table whose first column names the row.

    Args:
        name: id of the element.
        caption: what it shows.
        columns: heading and kind (`WORDS` or `NUMBER`) of each column.
        rows: cells, markup or text.
        look: "stacked" rows become blocks of lines on a phone, for tables with sentences; "wide" ones say that they
            scroll there; "small" ones do not spread over the page.

    """
    head = tag("tr", *(tag("th", title, at={"scope": "col", "class": kind}) for title, kind in columns))
    body = []
    for row in rows:
        cells = [tag("th", row[0], at={"scope": "row", "class": columns[0][1]})]
        for (title, kind), cell in zip(columns[1:], row[1:], strict=True):
            cells.append(tag("td", cell, at={"class": kind, **({"data-label": title} if look == "stacked" else {})}))
        body.append(tag("tr", *cells))
    whole = tag(
        "table",
        tag("caption", caption),
        tag("thead", head),
        tag("tbody", *body),
        at={"id": name, **({"class": look} if look else {})},
    )
    return tag("div", whole, at={"class": "scroll", "tabindex": "0", "role": "region", "aria-label": f"Table {name}"})


def facts(name: str, pairs: Sequence[tuple[str, object]]) -> Markup:
    """Short facts, one per line: what it is, and its value."""
    lines = [tag("div", tag("dt", key), tag("dd", value)) for key, value in pairs]
    return tag("dl", *lines, at={"id": name, "class": "facts"})
