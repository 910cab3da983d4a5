"""What changes over a session, in the order of its lines."""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping

from casacal.array_types import Array
from casacal.discrepancy.effect import Effect, Site
from casacal.discrepancy.survey import Rows


class OverTime(Effect, ABC):
    """An effect that wants to know when a row was measured."""

    def columns(self, site: Site) -> tuple[str, ...]:
        """When a row was measured, 0 to 1."""
        del site
        return ("when",)

    def values(self, site: Site, rows: Rows) -> Mapping[str, Array]:
        """By the number of its line."""
        del site
        return {"when": rows.survey.when(rows.samples)}
