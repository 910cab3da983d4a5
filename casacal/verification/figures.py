"""What a verification found, in figures: whether fresh rows lie as the calibration promised."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from casacal.files import jsonable
from casacal.values import Value
from casacal.verification.decision import Decision
from casacal.wording import counted

LEVEL = 0.05
"""Chance at which rows that are as promised are said not to be: at most one verification in twenty of a good arm.

Two tests share it, of all residuals and of what they say of the arm alone.
"""


@dataclass(frozen=True, eq=False, repr=False)
class Judged(Value):
    """Fresh rows and the calibration that they are held against.

    robot, result, verdict: which calibration, and what it said of itself (level and words; empty for a truth).
    samples, sha256, rows: which rows, and how many. own: unknowns that these rows alone know, fitted to them.
    standing: what was said to stand where it was calibrated. copied_lines, fitted_lines: rows that were left out:
    copies of others among them, and those that the arm was calibrated from. remarks: sentences on rows in
    postures that were fitted, and on columns that tell effects and are far from what they were in the fitted rows.
    """

    robot: str
    result: str
    verdict: tuple[str, str]
    samples: str
    sha256: str
    rows: int
    own: tuple[str, ...]
    standing: tuple[str, ...]
    copied_lines: tuple[int, ...] = field(default=(), kw_only=True)
    fitted_lines: tuple[int, ...] = field(default=(), kw_only=True)
    remarks: tuple[str, ...] = field(default=(), kw_only=True)

    @property
    def said(self) -> str:
        """The rows in a sentence."""
        return f"{counted(self.rows, 'fresh row')} of {self.samples}"

    @property
    def own_verdict(self) -> list[str]:
        """What the result says of itself, where that is not the best; a sentence, or none."""
        level, words = self.verdict
        return [] if level in ("", "calibrated") else [f"The result's own verdict: {words}"]

    def left_out(self, copied: str, fitted: str) -> list[str]:
        """Rows that do not count, a sentence for each reason: `copied`, `fitted`, with {} for the rows' file."""
        found = ((self.copied_lines, copied), (self.fitted_lines, fitted))
        return [f"{counted(len(lines))} {why.format(self.samples)}." for lines, why in found if lines]

    def fitted_words(self, names: str = "") -> str:
        """What was fitted to these rows and what was taken to stand, as clauses; `names` of what was fitted."""
        own = f"{counted(len(self.own), 'unknown')} fitted to these rows{names}"
        still = f"; assumed not to have moved: {', '.join(self.standing)}" if self.standing else ""
        return (own if self.own else "nothing fitted to these rows") + still

    def document(self, first: Mapping[str, Any], instead: Mapping[str, Any]) -> dict[str, Any]:
        """All figures in JSON's own types, after what comes first, some of them in another form."""
        level, words = self.verdict
        found = {each.name: getattr(self, each.name) for each in fields(self)}
        last = {name: found.pop(name) for name in ("copied_lines", "fitted_lines", "remarks")}
        found |= {"verdict": {"level": level, "words": words} if level else None, **instead}
        return dict(jsonable({**first, **found, **last}))


@dataclass(frozen=True)
class FaceVerification:
    """One face: rows, residuals (mm RMS) as drawn, as calibrated and as predicted, chi-square over freedom, chance."""

    label: str
    rows: int
    before_mm: float
    after_mm: float
    predicted_mm: float
    chi_square: float
    freedom: int
    p: float


@dataclass(frozen=True)
class ErrorInterval:
    """An RMS error, mm, and between what it lies with a chance of 95 %."""

    mm: float
    low_mm: float
    high_mm: float


@dataclass(frozen=True)
class PartError:
    """The arm's error in what its instrument sees, in some of the rows.

    kind: "all", "face" or "region". label: which one. rows: how many. before, after: of the arm as drawn and as
    calibrated, the instrument's own noise taken off. promised_mm: what the calibration expects of it, RMS.
    """

    kind: str
    label: str
    rows: int
    before: ErrorInterval
    after: ErrorInterval
    promised_mm: float


@dataclass(frozen=True, eq=False, repr=False)
class Figures(Judged):
    """Fresh rows against a calibration that has not seen them.

    A row's residual is its distance from the face, mm, or the length of its error where a row has several residuals.

    before_mm, after_mm, predicted_mm: residuals, RMS, with the arm as drawn, as calibrated, and as it was predicted.
    chi_square, freedom, p: of all residuals against their predicted covariance, and the chance of so much or more.
    seen, arm_chi_square, arm_p: the same in those directions of the arm alone that these rows know better than the
    prior, as many as `seen` of its `unknowns`: where an arm that changed since shows.
    faces: each face by itself. gross_lines, kept_without_gross: rows that the others do not expect where they are, and
    whether the promise is kept without them.
    quantile_mm: within which 95 % of the residuals lie, noise and all.
    errors: the arm's error, RMS over postures of this kind, noise taken off: of all rows, each face, each region; none
    where the rows say nothing of it. decision: whether it is within the tolerance that was asked for, or None.
    noise_mm, noise_most_mm: the instrument's own noise, RMS of a row: what was taken off, and the most that it may be.
    noise_stated_mm: as the problem states it.
    promised_tip_mm, hidden_tip_mm: tip error that the calibration expects, RMS over the workspace apart from where the
    base stands and how another instrument is mounted, and the part of it that rows like these would leave; infinite
    where nothing bounds it.
    accuracy: whether residuals are errors of the tip itself. things: what was measured, as in "planes". sees: what the
    residual is, as in "distance from the planes". unit: of it all.
    """

    before_mm: float
    after_mm: float
    predicted_mm: float
    chi_square: float
    freedom: int
    p: float
    seen: int
    unknowns: int
    arm_chi_square: float
    arm_p: float
    faces: tuple[FaceVerification, ...]
    gross_lines: tuple[int, ...]
    kept_without_gross: bool
    quantile_mm: float
    errors: tuple[PartError, ...]
    decision: Decision | None
    noise_mm: float
    noise_most_mm: float
    noise_stated_mm: float
    promised_tip_mm: float
    hidden_tip_mm: float
    accuracy: bool
    things: str
    sees: str
    unit: str

    @property
    def kept(self) -> bool:
        """Whether the promise was kept: the residuals are no larger than chance explains, at a level of 5 %."""
        return min(self.p, self.arm_p) >= LEVEL / 2

    @property
    def overall(self) -> PartError | None:
        """The arm's error in all rows; None where they say nothing of it."""
        return next((part for part in self.errors if part.kind == "all"), None)

    @property
    def denied(self) -> bool:
        """Whether the calibration's own verdict is not to use it."""
        return self.verdict[0] == "do not use"

    @property
    def passed(self) -> bool:
        """Whether the promise was kept, and the arm accepted where there is a tolerance, if it may be used at all."""
        return self.kept and (self.decision is None or (self.decision.verdict == "accept" and not self.denied))
