"""Pages from templates, in which everything is escaped, and numbers as they show them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined

from casacal.pages.drawing import showable
from casacal.wording import capital, sized


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
    made.filters |= {"fixed": fixed, "mm": mm, "count": count, "shortened": shortened}
    made.filters |= {"capital": capital, "sized": sized}
    return made
