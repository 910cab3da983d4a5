"""What every page has about its contents: a head with the style sheet, and a line per block."""

from __future__ import annotations

from casacal.calibration.page.markup import Markup, tag
from casacal.calibration.page.style import STYLE


def whole_page(title: str, main: Markup) -> str:
    """A page that needs no other file, no network and no script."""
    head = tag(
        "head",
        tag("meta", at={"charset": "utf-8"}),
        tag("meta", at={"name": "viewport", "content": "width=device-width, initial-scale=1"}),
        tag("meta", at={"name": "color-scheme", "content": "light"}),
        tag("title", title),
        tag("style", Markup(STYLE)),
    )
    page = tag("html", head, tag("body", main), at={"lang": "en"})
    # one line per block, so that two reports can be compared line by line
    for block in ("section", "table", "tr", "figure", "svg", "path", "p", "li", "div", "head", "style"):
        page = Markup(page.replace(f"</{block}>", f"</{block}>\n"))
    return f"<!DOCTYPE html>\n{page}\n"
