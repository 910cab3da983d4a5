"""Has the arm changed since it was calibrated? Fresh rows, the earlier posterior, what explains them; the report."""

from __future__ import annotations

import math
import shlex
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from casacal.calibration.as_arm import AsArm
from casacal.calibration.fresh import Judged, Opened, opened, with_memory
from casacal.changes.explain import SURE, UNEXPLAINED, Explanation, Look, contenders, explanations, telling
from casacal.data.samples import Layout, Samples
from casacal.deployment.arm import CalibratedArm
from casacal.errors import CasacalError, SamplesError, came
from casacal.files import MADE, write_text
from casacal.model.problem import Problem
from casacal.model.problem_file import ProblemFile
from casacal.planning.route import FIT, postures_text
from casacal.values import Array, Index, Value, as_given, frozen, is_real
from casacal.wording import capital, chance, figures, listed, numbered_lines, times, with_spread

MOST = 1500  # rows that are looked at: each is compared with every cause as one that is off
FEWEST = 3  # rows that may be off, of few; of many one in twenty
INTERVAL = 1.96  # standard deviations of an interval of 95 %
NOTHING, CHANGED, ROWS, UNDECIDED = "nothing", "changed", "rows", "undecided"
"""How it ended: nothing changed that these rows show; one thing did; rows are off; it cannot be told."""


def changed(
    result: AsArm | CalibratedArm | str | Path,
    samples: Samples | Any,
    *,
    problem: Problem | ProblemFile | str | Path | None = None,
    instrument: str | None = None,
    standing: Collection[str] = (),
    drift: Mapping[str, float] | None = None,
    alarm: float = 0.01,
    touches: int = 0,
    seed: int = 0,
) -> Change:
    """Look whether an arm has changed since it was calibrated, what, and by how much.

    The residuals of fresh rows are compared with what the calibration promises, as in `verify`. Beside it each joint's
    zero, the tool, the base and whatever was said to stand may have changed: generalised likelihood ratios, the
    smallest chance of which is judged so that an arm that has not changed is called changed at the rate that was asked
    for. A row that is off explains a misfit as well, and is named in place of the arm where it does so better.

    Args:
        result: a calibration, what `load` or `read_result` returns, or the path of a result.json or its folder.
        samples: fresh rows: `Samples`, a file, a pandas DataFrame, or arrays by column.
        problem, instrument, standing: as for `verify`. Where the base stands shows only against what stands.
        drift: standard deviations (mm, rad) by which unknowns may have drifted since, by name or key.
        alarm: rate of false alarms, 0.001 to 0.5.
        touches: how many touches to propose where causes cannot be told apart; none by default.
        seed: of everything that is drawn.

    Returns:
        What was found; shifts in rad and mm.

    Raises CasacalError, UnknownNameError and SamplesError as `verify` does, and for numbers that mean nothing.

    """
    case = opened(result, samples, problem=problem, instrument=instrument, standing=standing)
    if not isinstance(drift, (Mapping, type(None))):
        raise CasacalError(f"Got {came(drift)} as what may have drifted", 'Give sizes by name: {"theta": 2e-5}')
    return looked(case, standing, drift or {}, alarm=alarm, touches=touches, seed=seed)[0]


def looked(
    case: Opened, standing: Collection[str], drift: Mapping[str, float], *, alarm: float, touches: int, seed: int
) -> tuple[Change, Look]:
    """`changed` for rows already opened; also returns the last look, without rows that are off."""
    if not (is_real(alarm) and 0.001 <= alarm <= 0.5):
        raise CasacalError(f"Got {as_given(alarm)} as the false alarm rate", "Give 0.001 to 0.5")
    for what, value, most in (("touches", touches, 100), ("seed", seed, 2**63)):
        if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or not 0 <= value <= most:
            raise CasacalError(f"Got {as_given(value)} as the {what}", f"Give a whole number from 0 to {most}")
    if len(case.rows) > MOST:
        fix = f"Give up to {MOST:,} of them"
        raise SamplesError(case.rows.file, f"{len(case.rows):,} rows are too many to look at one by one", fix)
    fresh = with_memory(case.fresh(standing), case.arm).loosened(drift)
    first = Look.at(fresh, case.noise_freedom, float(alarm), int(seed))
    look, best, places = _without_bad(first, len(case.rows), float(alarm), int(seed))
    bad = sorted(set(range(len(case.rows))) - set(places.tolist()))
    proposed, tells = None, 0.0
    if not look.alarm:
        ended = ROWS if bad else NOTHING
    elif len(best) == 1 and best[0].cause and best[0].share >= SURE and best[0].left >= UNEXPLAINED:
        ended = CHANGED  # surer than all others together, and nothing is left that is hardly chance
    else:
        ended = UNDECIDED
        proposed, tells = telling(case.source.problem, look, best, int(touches), int(seed))
    whitened = first.tests.fresh
    joints = [k for k, cause in enumerate(look.causes) if cause.kind == "joint"]
    found_from = {k: look.found_from(k) for k in joints}
    shown = [math.isfinite(found_from.get(k, 0.0)) and freedom > 0 for k, freedom in enumerate(look.tests.freedoms)]
    change = Change(
        case.judged(fresh, tuple(standing)),
        drift=tuple(sorted(drift.items())),
        alarm=float(alarm),
        p=first.smallest,
        level=first.level,
        chi_square=whitened.chi_square,
        freedom=whitened.freedom,
        p_all=first.tests.p[2],
        ended=ended,
        causes=tuple(_cause(each, look, case.rows, places) for each in best),
        bad_lines=tuple(int(case.rows.lines[k]) for k in bad),
        joints=tuple(Shown(look.causes[k].name, look.causes[k].units[0], found_from[k]) for k in joints),
        unseen=tuple(cause.name for cause, shows in zip(look.causes, shown, strict=True) if not shows),
        touches=proposed,
        tells=tells,
    )
    return change, look


def _without_bad(look: Look, count: int, alarm: float, seed: int) -> tuple[Look, list[Explanation], Index]:
    """Leave out single faulty rows; return the last look, its explanations and the indices of the rows that remain."""
    places, most = np.arange(count), max(FEWEST, count // 20)
    while look.alarm:
        best = contenders(explanations(look))
        if len(best) != 1 or best[0].cause is not None or count - len(places) == most:
            return look, best, places
        look = look.without(best[0].row, alarm, seed)
        places = np.delete(places, best[0].row)
    return look, [], places


CARRIED = ("tool", "body")  # keys of what an instrument calls the thing on the flange


def _cause(found: Explanation, look: Look, rows: Samples, places: Index) -> CauseFound:
    cause, fitted, figures = found.cause, found.fitted, (found.p, found.share, found.left)
    if cause is None or fitted is None:
        line, none = int(rows.lines[int(places[found.row])]), np.zeros(0)
        return CauseFound(f"line {line}", "row", line, (), (), none, none, *figures)
    probe = look.fresh.bound.problem.instrument.probe
    dial = cause.kind == "tool" and probe is not None and probe.column is not None
    own = look.fresh.bound.problem.instrument.unknowns
    carried = next((key for key in CARRIED if key in own), CARRIED[0])
    held = cause.kind == "tool" and not (carried in own and own[carried].size)  # also where it has none
    said = (cause.name, cause.kind, 0, cause.labels, cause.units, fitted.shift, fitted.std)
    return CauseFound(*said, *figures, dial, held, carried)


def write_touches(path: str | Path, found: Change, layout: Layout, name: str) -> None:
    """Write the touches of a `Change` in the form of a plan, whole or not at all; nothing where it has none."""
    if found.touches is None:
        return
    notes = [
        f"touches that would settle what changed for {name}, {MADE}: not a measurement",
        f"between {' and '.join(cause.name for cause in found.causes)}",
        "bring the arm to each posture, then along the plunger until the instrument reads; write down the joint values "
        "that the controller shows and the reading that there is, not the expected one; give them with the other rows",
    ]
    write_text(path, postures_text(found.touches, [FIT] * len(found.touches), layout, notes))


@dataclass(frozen=True, eq=False)
class CauseFound(Value):
    """One thing that may have changed.

    name, kind: such as "joint 4", "joint"; "tool", "base", "place" of what was said to stand, "row" of a row that is
    off. line: of such a row. shift, std: by how much (k,), in `units`, along `labels`, with standard deviations; where
    rows see only some directions of it, what they see. p: chance of as much explained where nothing changed. share:
    part of the evidence. left: chance of what stays unexplained. dial: whether it is a tool with a dial, which shows a
    zero that was set anew as a tool of another length. held: whether the problem holds that tool where it is. carried:
    what it calls the tool.
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
    held: bool = False
    carried: str = "tool"

    def __post_init__(self) -> None:
        frozen((self.shift, self.std))

    @property
    def called(self) -> str:
        """The cause as a sentence calls it."""
        dial = " (or the zero of its dial)" if self.dial else ""
        places = {"tool": f"the tool{dial}", "base": "the base", "place": f"'{self.name}'"}
        others = {"joint": f"the zero of {self.name}", "row": f"{self.name} alone, as a faulty row"}
        return others[self.kind] if self.kind in others else f"the position of {places[self.kind]}"

    @property
    def amount(self) -> str:
        """Size of the shift with 95 % intervals; empty for a row."""
        parts = []
        for label, unit, shift, std in zip(self.labels, self.units, self.shift, self.std, strict=True):
            said = " mm +- ".join(with_spread(shift, INTERVAL * std, 3))
            if unit == "rad":
                degrees, _ = with_spread(math.degrees(shift), math.degrees(INTERVAL * std), 4)
                said = f"{' mrad +- '.join(with_spread(1e3 * shift, 1e3 * INTERVAL * std, 2))} ({degrees} degrees)"
            parts.append(f"{label} {said}" if len(self.units) > 1 else said)
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
        causes = []
        for cause in () if self.ended == CHANGED else self.causes:
            size = f"; size {cause.amount}" if cause.kind != "row" else ""
            said = f"{100 * cause.share:.0f} % of the evidence{size}; rest {chance(cause.left)}"
            causes.append(f"  {capital(cause.called)}: {said}")
        bad = []
        if self.bad_lines:
            fit, it = ("fits", "it") if len(self.bad_lines) == 1 else ("fit", "them")
            lines = f"{capital(numbered_lines(self.bad_lines))} {fit} neither the other rows nor any change of the arm"
            bad = [f"{lines}. Measure {it} again."]
        unseen = [f"These rows do not show a shift of {listed(self.unseen, 'or')}."] if self.unseen else []
        drift = ", ".join(f"{name} {std:g}" for name, std in self.drift)
        smallest = chance(self.p).removeprefix("p ").removeprefix("= ")
        paragraphs = [
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
            f"Smallest p of all tests {smallest}; alarm below {self.level:.2g}. All residuals: "
            f"chi-square {self.chi_square:.1f} with {self.freedom} degrees of freedom, {chance(self.p_all)}. "
            f"{capital(self.judged.fitted_words())}{f'; drift {drift}' if drift else ''}.",
            _shown(self),
            *(unseen if self.ended != NOTHING else []),
            *([] if self.ended == NOTHING else [f"Next: {_next(self)}"]),
        ]
        return "\n".join(paragraphs)

    def to_dict(self) -> dict[str, Any]:
        """All of it in JSON's own types, as `casacal changed --json` prints it."""
        instead: dict[str, Any] = {"causes": [*map(asdict, self.causes)], "joints": [*map(asdict, self.joints)]}
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
        lines, it = numbered_lines(found.bad_lines), "it" if len(found.bad_lines) == 1 else "them"
        return f"Look at {lines} first: without {it}, {found.judged.said} show no change. {rate}"
    if found.ended == CHANGED:
        (cause,) = found.causes
        return f"Changed: {cause.called}, by {cause.amount}; {found.judged.said}, {chance(found.p)}. {rate}"
    start = f"Undecided: {found.judged.said} do not agree with the calibration ({chance(found.p)})"
    if not found.causes:
        return f"{start}, and no known cause explains them. {rate}"
    if len(found.causes) == 1:
        (cause,) = found.causes
        said = f"{start}. {capital(cause.called)} explains them best, but not fully ({chance(cause.left)} for the "
        return f"{said}rest): more than one thing changed, or something else did. {rate}"
    return f"{start}. They cannot distinguish between {listed([cause.called for cause in found.causes])}. {rate}"


def _shown(found: Change) -> str:
    scales = {"rad": (1e3, "mrad"), "mm": (1.0, "mm")}
    shown = [(each.name, each.shift, *scales[each.unit]) for each in found.joints if math.isfinite(each.shift)]
    if not shown:
        return "These rows would not show a shift of any joint."
    parts = ", ".join(f"{name} {figures(factor * shift, 2)} {unit}" for name, shift, factor, unit in shown)
    return f"Smallest shift of an encoder zero that these rows show with 90 % probability: {parts}."


def _next(found: Change) -> str:
    if found.ended == CHANGED:
        (cause,) = found.causes
        moved = cause.name.split(".")
        standing = [name for name in found.judged.standing if cause.kind != "base" and name not in moved]
        words = ["casacal calibrate PROBLEM", found.judged.typed, "--prior-from", shlex.quote(found.judged.result)]
        if cause.kind == "tool":
            words += ["--free" if cause.held else "--loosen", cause.carried]
        elif cause.kind == "joint":
            words += ["--loosen", cause.name.replace(" ", "")]
        words += ["--standing", ",".join(standing)] if standing else []
        said = "find out what was done to the arm. Then take the old result as the prior of these rows "
        return f"{said}({' '.join(words)}) or calibrate again, and verify with fresh rows."
    if found.ended == ROWS:
        return f"measure {numbered_lines(found.bad_lines)} again, and run this command again."
    if rows := [cause.name for cause in found.causes if cause.kind == "row"]:
        return f"measure {listed(rows)} again. If the reading stays, something has changed, or it was a false alarm."
    if len(found.causes) < 2:
        said = f"casacal check PROBLEM {found.judged.typed} looks for mistakes in these rows"
        return f"{said}. If there are none, calibrate again with old and new rows."
    if found.touches is None:
        return "--touches FILE plans touches that would settle it. Pass them together with these rows."
    if found.tells < 1.0:
        return "no touch of these faces would settle it. Find out what was done to the arm."
    odds = f"{times(math.exp(min(found.tells, 14.0)))} to 1"
    return f"{len(found.touches)} planned touches would settle it, at odds of about {odds}. Pass them with these rows."
