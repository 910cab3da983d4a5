"""From touches to what they tell and which of them is in doubt: one pure step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from casacal.array_types import Array
from casacal.measuring.examine import Alarm, examined, judged_alone
from casacal.measuring.known import Known, Places, innovations_at, known_before, known_from, usable
from casacal.measuring.slips import Slip
from casacal.measuring.touch import Touch, rows_of
from casacal.planning.route import CHECK
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.values import Value


@dataclass(frozen=True, eq=False)
class State(Value):
    """What touches tell.

    known: by all of them but one in doubt and those kept for checking; None before any. alarm: what is in doubt.
    off, std: by how much the touch that has just come was off, and the standard deviation of that (m,), mm; None where
    nothing could be said. waiting: touches of faces of which nobody knows yet where they stand.
    """

    known: Known | None = None
    alarm: Alarm | None = None
    off: Array | None = None
    std: Array | None = None
    waiting: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Setting(Value):
    """What does not change from touch to touch: the problem, planned rows, and where faces are planned."""

    problem: Problem
    planned: Samples | None
    places: Places


def state_of(
    setting: Setting,
    touches: Sequence[Touch],
    slips: Callable[[int], list[Slip]],
    before: Known | None,
    *,
    new: bool,
) -> State:
    """What touches tell; `slips` says what may be wrong with one, `before` what was known, `new` that the last came."""
    fit = [k for k, touch in enumerate(touches) if touch.purpose != CHECK]
    used = [fit[k] for k in usable(setting.problem, [touches[k] for k in fit], setting.places)]
    waiting, last = tuple(k for k in fit if k not in set(used)), len(touches) - 1
    if not used:
        return State(waiting=waiting)

    def known_by(rows: Sequence[int]) -> Known | None:
        chosen = [touches[k] for k in rows]
        return known_from(setting.problem, chosen, setting.places, setting.planned, before) if chosen else None

    known, off, std = known_by(used), None, None
    assert known is not None
    if new and touches[last].purpose == CHECK:
        alarm = judged_alone(known, touches[last], lambda: slips(last), last)
        off, std = (each[0] for each in innovations_at(known, [touches[last]]))
    else:
        others = _others(setting, touches, used, before) if new and last in used else None
        if others is not None:
            off, std = (each[0] for each in innovations_at(others, [touches[last]]))
        found = examined(known, [touches[k] for k in used], lambda k: slips(used[k]), others=others)
        alarm = None if found is None else _numbered(found, used)
    if alarm is not None and alarm.touch in used:
        known = known_by([k for k in used if k != alarm.touch])
    return State(known, alarm, off, std, waiting)


def _others(setting: Setting, touches: Sequence[Touch], used: Sequence[int], before: Known | None) -> Known | None:
    """What all touches but the last tell of its face too; None where they tell nothing of it."""
    if len(used) == 1:
        return known_before(setting.problem, rows_of([touches[used[0]]]), setting.places, setting.planned)
    rest = [touches[k] for k in used[:-1]]
    rest = [rest[k] for k in usable(setting.problem, rest, setting.places)]
    others = known_from(setting.problem, rest, setting.places, setting.planned, before) if rest else None
    return others if others is not None and others.knows(touches[used[-1]]) else None


def _numbered(alarm: Alarm, used: Sequence[int]) -> Alarm:
    """The alarm with touches counted among all."""
    suspects = tuple(replace(each, touch=used[each.touch]) for each in alarm.suspects)
    return replace(alarm, raised_by=used[alarm.raised_by], suspects=suspects)
