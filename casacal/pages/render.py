"""Pages from templates: what is not markup already is escaped, and nothing that is missing is passed over."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined

from casacal.pages.markup import showable
from casacal.pages.numbers import count, fixed, mm, shortened
from casacal.wording import capital, sized


def rendered(template: str, context: Mapping[str, object]) -> str:
    """A page, or a part of one, that needs no other file, no network and no script.

    Args:
        template: a file of casacal/pages/templates.
        context: what the template names.

    """
    return _templates().get_template(template).render(context)


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
