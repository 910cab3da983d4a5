"""Report on an arm that may have changed: figures, sentences with the answer first, JSON's own types."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from casacal.calibration.fresh import Judged
from casacal.data.samples import Samples
from casacal.values import Array, Value, frozen
from casacal.wording import capital, chance, figures, listed, numbered_lines, times, with_spread

INTERVAL = 1.96  # standard deviations of an interval of 95 %
NOTHING, CHANGED, ROWS, UNDECIDED = "nothing", "changed", "rows", "undecided"
"""How it ended: nothing changed that these rows show; one thing did; rows are off; it cannot be told."""


@dataclass(frozen=True, eq=False)
class CauseFound(Value):
    """One thing that may have changed.

    name, kind: such as "joint 4", "joint"; "tool", "base", "place" of what was said to stand, "row" of a row that is
    off. line: of such a row. shift, std: by how much (k,), in `units`, along `labels`, with standard deviations; where
    rows see only some directions of it, what they see. p: chance of as much explained where nothing changed. share:
    part of the evidence. left: chance of what stays unexplained. dial: whether it is a tool with a dial, which shows a
    zero that was set anew as a tool of another length.
    """

    name: str
    kind: str
    line: int
    labels: tuple[str, ...]
    units: tuple[str, ...]
    shift: Array
    std: Array
    p: float
    share: float
    left: float
    dial: bool = False

    def __post_init__(self) -> None:
        frozen((self.shift, self.std))

    @property
    def called(self) -> str:
        """The cause as a sentence calls it."""
        return {
            "joint": f"the zero of {self.name}",
            "tool": f"the position of the tool{' (or the zero of its dial)' if self.dial else ''}",
            "base": "the position of the base",
            "place": f"the position of '{self.name}'",
            "row": f"{self.name} alone, as a faulty row",
        }[self.kind]

    @property
    def amount(self) -> str:
        """Size of the shift with 95 % intervals; empty for a row."""
        parts = []
        for label, unit, shift, std in zip(self.labels, self.units, self.shift, self.std, strict=True):
            said = f"{label} " if len(self.units) > 1 else ""
            if unit == "rad":
                said += " mrad +- ".join(with_spread(1e3 * shift, 1e3 * INTERVAL * std, 2))
                said += f" ({with_spread(math.degrees(shift), math.degrees(INTERVAL * std), 4)[0]} degrees)"
            else:
                said += " mm +- ".join(with_spread(shift, INTERVAL * std, 3))
            parts.append(said)
        return ", ".join(parts)


@dataclass(frozen=True, eq=False)
class Shown(Value):
    """A joint's shift (rad, mm) that these rows would have shown with a chance of 90 %; infinite where none."""

    name: str
    unit: str
    shift: float


@dataclass(frozen=True, eq=False, repr=False)
class Change(Value):
    """Whether an arm has changed since its calibration, by fresh rows.

    judged: the rows, and the calibration. drift: what may have drifted since, standard deviations by name. alarm: rate
    of false alarms that was asked for. p, level: the smallest chance of all tests, and below which it is an alarm, so
    that this rate is met. chi_square, freedom, p_all: of all rows together. ended: "nothing", "changed", "rows" or
    "undecided". causes: the one, or those that cannot be told apart, likeliest first. bad_lines: rows that are off.
    joints: what would have been found of each. unseen: what cannot show here. touches: postures that would tell the
    causes apart, with expected readings; None where none are needed or known. tells: log-odds to expect of them between
    the two causes that are hardest to tell apart.
    """

    judged: Judged
    drift: tuple[tuple[str, float], ...]
    alarm: float
    p: float
    level: float
    chi_square: float
    freedom: int
    p_all: float
    ended: str
    causes: tuple[CauseFound, ...]
    bad_lines: tuple[int, ...]
    joints: tuple[Shown, ...]
    unseen: tuple[str, ...]
    touches: Samples | None
    tells: float

    @property
    def changed(self) -> bool | None:
        """Whether the arm changed; None where these rows cannot say."""
        return {NOTHING: False, CHANGED: True}.get(self.ended)

    def summary(self) -> str:
        """Report of `casacal changed`, one paragraph a line."""
        causes = [
            f"  {capital(cause.called)}: {100 * cause.share:.0f} % of the evidence"
            + (f"; size {cause.amount}" if cause.kind != "row" else "")
            + f"; rest {chance(cause.left)}"
            for cause in (() if self.ended == CHANGED else self.causes)
        ]
        bad = []
        if self.bad_lines:
            fit = "fits" if len(self.bad_lines) == 1 else "fit"
            lines = capital(numbered_lines(self.bad_lines))
            bad = [f"{lines} {fit} neither the other rows nor any change of the arm. Measure {_it(self)} again."]
        unseen = [f"These rows do not show a shift of {listed(self.unseen, 'or')}."] if self.unseen else []
        said = [
            _answer(self),
            *(unseen if self.ended == NOTHING else []),
            *self.judged.own_verdict,
            *self.judged.remarks,
            *self.judged.left_out(
                "of {} repeat other rows to the last digit and are counted once",
                "of {} were used for the calibration and are not counted",
            ),
            *causes,
            *bad,
            _rests_on(self),
            _shown(self),
            *(unseen if self.ended != NOTHING else []),
            *([] if self.ended == NOTHING else [f"Next: {_next(self)}"]),
        ]
        return "\n".join(said)

    def to_dict(self) -> dict[str, Any]:
        """All of it in JSON's own types, as `casacal changed --json` prints it."""
        instead: dict[str, Any] = {
            name: [asdict(each) for each in getattr(self, name)] for name in ("causes", "joints")
        }
        instead |= {"drift": dict(self.drift), "touches": None if self.touches is None else len(self.touches)}
        return self.judged.document({"changed": self.changed}, self, instead)

    def __repr__(self) -> str:
        names = ", ".join(cause.name for cause in self.causes)
        said = {NOTHING: "nothing changed", ROWS: "rows are off"}.get(self.ended, f"{self.ended}: {names}")
        return f"<Change of {self.judged.robot} by {self.judged.rows} fresh rows: {said}, p {self.p:.3g}>"


def _answer(found: Change) -> str:
    rate = f"False alarm rate {100 * found.alarm:g} %."
    if found.ended == NOTHING:
        return f"No change found: {found.judged.said} agree with the calibration of {found.judged.robot}. {rate}"
    if found.ended == ROWS:
        lines = numbered_lines(found.bad_lines)
        return f"Look at {lines} first: without {_it(found)}, {found.judged.said} show no change. {rate}"
    if found.ended == CHANGED:
        (cause,) = found.causes
        return f"Changed: {cause.called}, by {cause.amount}; {found.judged.said}, {chance(found.p)}. {rate}"
    start = f"Undecided: {found.judged.said} do not agree with the calibration ({chance(found.p)})"
    if not found.causes:
        return f"{start}, and no known cause explains them. {rate}"
    if len(found.causes) == 1:
        (cause,) = found.causes
        return (
            f"{start}. {capital(cause.called)} explains them best, but not fully ({chance(cause.left)} for the "
            f"rest): more than one thing changed, or something else did. {rate}"
        )
    return f"{start}. They cannot distinguish between {listed([cause.called for cause in found.causes])}. {rate}"


def _rests_on(found: Change) -> str:
    drift = ", ".join(f"{name} {std:g}" for name, std in found.drift)
    return (
        f"Smallest p of all tests {chance(found.p).split()[-1]}; alarm below {found.level:.2g}. All residuals: "
        f"chi-square {found.chi_square:.1f} with {found.freedom} degrees of freedom, {chance(found.p_all)}. "
        f"{capital(found.judged.fitted_words())}{f'; drift {drift}' if drift else ''}."
    )


def _shown(found: Change) -> str:
    parts = []
    for joint in found.joints:
        if math.isfinite(joint.shift):
            size = f"{figures(1e3 * joint.shift, 2)} mrad" if joint.unit == "rad" else f"{figures(joint.shift, 2)} mm"
            parts.append(f"{joint.name} {size}")
    if not parts:
        return "These rows would not show a shift of any joint."
    return f"Smallest shift of an encoder zero that these rows show with 90 % probability: {', '.join(parts)}."


def _next(found: Change) -> str:
    if found.ended == CHANGED:
        (cause,) = found.causes
        standing = [
            name for name in found.judged.standing if cause.kind != "base" and name not in cause.name.split(".")
        ]
        words = ["casacal calibrate PROBLEM", found.judged.samples, "--prior-from", found.judged.result]
        words += ["--loosen", cause.name.replace(" ", "")] if cause.kind in ("joint", "tool") else []
        words += ["--standing", ",".join(standing)] if standing else []
        return (
            "find out what was done to the arm. Then take the old result as the prior of these rows "
            f"({' '.join(words)}) or calibrate again, and verify with fresh rows."
        )
    if found.ended == ROWS:
        return f"measure {numbered_lines(found.bad_lines)} again, and run this command again."
    if rows := [cause.name for cause in found.causes if cause.kind == "row"]:
        return f"measure {listed(rows)} again. If the reading stays, something has changed, or it was a false alarm."
    if len(found.causes) < 2:
        return (
            f"casacal check PROBLEM {found.judged.samples} looks for mistakes in these rows. If there are none, "
            "calibrate again with old and new rows."
        )
    if found.touches is None:
        return "--touches FILE plans touches that would settle it. Pass them together with these rows."
    if found.tells < 1.0:
        return "no touch of these faces would settle it. Find out what was done to the arm."
    odds = f"{times(math.exp(min(found.tells, 14.0)))} to 1"
    return f"{len(found.touches)} planned touches would settle it, at odds of about {odds}. Pass them with these rows."


def _it(found: Change) -> str:
    return "it" if len(found.bad_lines) == 1 else "them"
