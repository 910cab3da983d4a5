"""What `changed` returns: figures as attributes, in words, in JSON's own types, and the touches as a file."""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import Any

from casacal.changes.figures import Figures
from casacal.changes.words import told
from casacal.files import jsonable


class Change(Figures):
    """Whether an arm has changed since its calibration, what, and by how much."""

    def summary(self) -> str:
        """What `casacal changed` prints: a paragraph each line."""
        return "\n".join(told(self))

    def to_dict(self) -> dict[str, Any]:
        """All of it in JSON's own types, as `casacal changed --json` prints it."""
        level, words = self.verdict
        found = {field.name: getattr(self, field.name) for field in fields(self)}
        found["verdict"] = {"level": level, "words": words} if level else None
        found["causes"] = [asdict(each) for each in self.causes]
        found["joints"] = [asdict(each) for each in self.joints]
        found["drift"] = dict(self.drift)
        found["touches"] = None if self.touches is None else len(self.touches)
        return dict(jsonable({"changed": self.changed, **found}))

    def __repr__(self) -> str:
        names = ", ".join(cause.name for cause in self.causes)
        said = {"nothing": "nothing changed", "rows": "rows are off"}.get(self.ended, f"{self.ended}: {names}")
        return f"<Change of {self.robot} by {self.rows} fresh rows: {said}, p {self.p:.3g}>"
