"""A verification as a value: figures as attributes, in words, or in JSON's own types."""

from __future__ import annotations

import math
from dataclasses import asdict, fields
from typing import Any

from casacal.files import jsonable
from casacal.verification.decision import Decision
from casacal.verification.figures import Figures
from casacal.verification.words import told


class Verification(Figures):
    """What `verify` returns: whether the promise was kept, with every figure behind it."""

    def summary(self) -> str:
        """What `casacal verify` prints: a paragraph each line."""
        return "\n".join(told(self))

    def to_dict(self) -> dict[str, Any]:
        """All of it in JSON's own types, as `casacal verify --json` prints it."""
        level, words = self.verdict
        found = {field.name: getattr(self, field.name) for field in fields(self)}
        found["verdict"] = {"level": level, "words": words} if level else None
        found["faces"], found["errors"] = ([asdict(part) for part in parts] for parts in (self.faces, self.errors))
        found["decision"] = None if self.decision is None else _decided(self.decision)
        if self.denied or not self.kept:  # no figure of accuracy beside a verdict that denies it
            found["promised_tip_mm"] = found["hidden_tip_mm"] = math.nan
        judged = {"kept": self.kept, "passed": self.passed}
        return dict(jsonable({**judged, **found}))

    def page(self) -> str:
        """HTML of a page that needs no other file, no network and no script: what `casacal verify --report` writes."""
        from casacal.verification.page import verification_page  # pages are not what most ask for

        return verification_page(self)

    def __repr__(self) -> str:
        said = "kept" if self.kept else "not kept"
        p = min(self.p, self.arm_p)
        return f"<Verification of {self.robot} by {self.rows} fresh rows: promise {said}, p {p:.3g}>"


def _decided(decision: Decision) -> dict[str, Any]:
    return {
        **asdict(decision),
        "guard_mm": decision.guard_mm,
        "guard_of_rejection_mm": decision.guard_of_rejection_mm,
        "rule": "JCGM 106:2012, guarded acceptance and guarded rejection",
    }
