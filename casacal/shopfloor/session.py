"""A session at the machine, as a frozen value: touches made, what they tell, and what may be answered."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.special import bdtrc

from casacal.errors import CasacalError, SimulationError, came, refuse_unknown
from casacal.fit.filters import Belief
from casacal.model.instrument import readings_within
from casacal.model.problem import Problem
from casacal.model.robot import AXIS_WEIGHT, inside_limits
from casacal.planning.candidates import refuse_several
from casacal.planning.choice import wanted_field, wanted_joints
from casacal.planning.clearance import Clearance
from casacal.planning.route import CHECK, FIT, Route
from casacal.shopfloor.known import (
    Alarm,
    Known,
    Pool,
    SessionSetting,
    SessionState,
    Suspected,
    chance_of,
    counts,
    covered,
    error_below,
    innovations_at,
    known_before,
    per_reading,
    refuse_along,
    spectrum,
)
from casacal.shopfloor.touch import Slip, Touch, columns_of, joints_of, labels_of, rows_of, slips_of
from casacal.simulation.cell import Disturbances
from casacal.values import Array, Box, Value, as_given, is_real

MISTYPED = 0.05  # part of all touches that people mistype at most
DEVIATIONS = 3.0  # standard deviations by which a reading may be another than is expected
BROUGHT = 0.1  # mm by which a posture further along the plunger may miss its place
TOO_MANY = 1e-3  # chance of so many answers to doubts below which it was not mistyping


@dataclass(frozen=True, eq=False, repr=False)
class Session(Value):
    """Touches of one instrument, taken in one by one: after each, one fit of all of them.

    Args:
        problem: a robot with one instrument, taken without effects; its priors are trusted, its noise until the touches
            speak against it.
        plan: what is to be touched, in which order, and about where faces stand; None where nobody planned.
        tolerance: RMS tip error (mm) at which enough has been measured, or None.
        box, targets: where the tip is wanted, as for `plan`; by default over the workspace.
        cell: where faces are and how far the tool may tilt, for touches beyond the plan; by default as `plan` has it.
        clearance: what the arm must keep clear of in touches beyond the plan.
        best_first: whether the touch of the plan is next that lowers the tip error most, not the next on the way.
        touches, state, skipped, declined: of a session that goes on; see `resumed`.

    Every step gives another session. An `alarm` stands until `undo`, `keep` or `correct` answers it.

    Raises CasacalError for a problem of several instruments and for a tolerance that is none.

    """

    problem: Problem
    plan: Route | None = None
    tolerance: float | None = None
    box: Box | None = None
    targets: Array | None = None
    cell: Disturbances | None = None
    clearance: Clearance | None = None
    best_first: bool = False
    touches: tuple[Touch, ...] = ()
    state: SessionState = field(default_factory=SessionState)
    skipped: frozenset[int] = frozenset()
    declined: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        refuse_several(self.problem, "A session uses one instrument", "Give", self.box, self.targets)
        if self.plan is not None and not isinstance(self.plan, Route):
            raise CasacalError(f"Got {came(self.plan)} as the plan", "Give what plan() or read_route() returns")
        if self.tolerance is not None and not (is_real(self.tolerance) and 0 < self.tolerance < math.inf):
            raise CasacalError(f"Got {as_given(self.tolerance)} as the tolerance", "Give a positive number of mm")
        object.__setattr__(self, "problem", self.problem.without_terms)  # some need columns that nobody types in

    def __len__(self) -> int:
        return len(self.touches)

    def __repr__(self) -> str:
        said = "" if self.alarm is None else f", touch {self.alarm.touch + 1} in doubt"
        error = self.tip_error
        return f"<Session of {len(self)} touches{said}: tip error {'unknown' if error is None else f'{error:.3g} mm'}>"

    def take(
        self,
        q: Sequence[float] | Array,
        reading: float | Mapping[str, float] | None = None,
        plane: str | Mapping[str, str] | None = None,
        *,
        number: int | None = None,
    ) -> Session:
        """Take in one more touch.

        Args:
            q: joint values (n,), rad and mm.
            reading: what the instrument read, mm; by column where it has several.
            plane: the label of the face; by column where there are several; by default that of the plan's touch.
            number: which touch of the plan this answers, from 1.

        Raises CasacalError for what is no touch of this problem, and while an alarm waits for an answer.

        """
        if self.alarm is not None:
            fix = "Answer first, by undo(), keep() or correct(suspect)"
            raise CasacalError(f"Touch {self.shown(self.alarm.touch)} is in doubt", fix)
        planned, layout = self.planned(number), self.problem.layout()
        joints, columns, labels = joints_of(q, layout), columns_of(reading, layout), labels_of(plane, layout, planned)
        touch = Touch(joints, columns, labels, number, FIT if planned is None else planned.purpose)
        for column, known in () if self.plan is None else self.plan.samples.labels.items():
            refuse_unknown(f"{column} of the plan", [touch.labels[column]], known.names)
        if self.known is not None and self.known.knows(touch):
            refuse_along(self.known, touch)
        return self._after((*self.touches, touch), new=True)

    def undo(self, touch: int | None = None) -> Session:
        """Take a touch back, as if it had never been made: the one in doubt, else the last, or by number from 0."""
        if not self.touches:
            raise CasacalError("There is no touch to take back", "Take one first")
        k = touch
        if k is None:
            k = len(self) - 1 if self.alarm is None else self.alarm.touch
        if not 0 <= k < len(self):
            raise CasacalError(f"There is no touch {k}", f"Give 0 to {len(self) - 1}")
        in_doubt = self.alarm is not None and self.alarm.raised_by == len(self) - 1 != k
        return self._after((*self.touches[:k], *self.touches[k + 1 :]), new=in_doubt)

    def keep(self) -> Session:
        """Say that the touch in doubt is right as it is."""
        k = self._open_alarm().touch
        return self._put(k, replace(self.touches[k], kept=True))

    def correct(self, suspect: Suspected | None = None) -> Session:
        """Put right what was typed wrong: as the likeliest explanation has it, or another one of the alarm's."""
        alarm = self._open_alarm()
        chosen = alarm.suspects[0] if suspect is None else suspect
        if chosen.slip is None:
            what = f"Nothing that could be corrected explains touch {self.shown(chosen.touch)}"
            raise CasacalError(what, "Take it back, or keep it as it is")
        return self._put(chosen.touch, replace(chosen.slip.touch, corrected=True))

    def skip(self, number: int | None) -> Session:
        """Leave a touch of the plan out, or ask for it again; None asks for another touch beyond the plan."""
        if number is None:
            return replace(self, declined=self.declined | {self._further()})
        self.planned(number)
        return replace(self, skipped=self.skipped ^ {number})

    def _further(self) -> int:
        """The touch beyond the plan that tells most of those that nobody declined; SimulationError where all were."""
        known, field, all_of_them = self.state.known, self.field, self._setting.further
        there = np.zeros(0) if known is None else np.flatnonzero(covered(known.bound, all_of_them))
        left = np.setdiff1d(there, list(self.declined)).astype(int)
        if known is None or field is None or not left.size:
            raise SimulationError("No further touch can be proposed", "Enter joint values and reading of your own")
        return int(left[Pool.of(known, all_of_them.take(left)).most_telling(known.covariance, field)])

    def resumed(self, touches: Sequence[Touch]) -> Session:
        """The session after touches that were made earlier, such as those of a file; the last is judged as new."""
        made = tuple(touches)
        return self._after(made[:-1])._after(made, new=True) if made else self._after(made)

    def next(self) -> Touch | None:
        """The next touch of the plan, with the readings to expect; after the last one the best that could be made.

        Where the best is to come first, it is the one of the plan that lowers the tip error most. None where enough has
        been touched, and where all that was planned is and no tolerance asks for more. Raises SimulationError where no
        further touch is found.
        """
        if self.done:
            return None
        done = {touch.number for touch in self.touches} | self.skipped
        left = [touch for touch in self._all_planned if touch.number not in done]
        known = self.state.known
        if left:
            # those to fit by what they tell, then the others in order
            candidates = [touch for touch in left if touch.purpose == FIT and known is not None and known.knows(touch)]
            if not self.best_first or known is None or self.field is None or not candidates:
                return left[0]
            return candidates[Pool.of(known, rows_of(candidates)).most_telling(known.covariance, self.field)]
        if self.tolerance is None or known is None or self.field is None:
            return None
        return Touch.of(self._setting.further, self._further())

    def expected(self, touch: Touch) -> tuple[float, float] | None:
        """Reading along the plunger to expect at a touch, and its standard deviation, mm; None where none is known.

        By the touches so far: the reading of a plan is that of the arm as drawn, over faces where they were planned.
        """
        known = self.known
        slope = None if known is None else per_reading(known, touch)
        probe = self.problem.instrument.probe
        if known is None or slope is None or probe is None or probe.column is None:
            return None
        off, std = (float(each[0, 0]) for each in innovations_at(known, [touch]))
        return touch.columns[probe.column] - off / slope, std / abs(slope)

    def brought(self, touch: Touch) -> Touch | None:
        """The touch from further along its plunger, where by the touches so far it reads as planned, or safely inside.

        None where they do not tell, and where the arm does not get there with the plunger in the same direction.
        """
        found, probe = self.expected(touch), self.problem.instrument.probe
        if found is None or probe is None or probe.column is None:
            return None
        (reading, std), (low, high) = found, readings_within(probe.travel)
        spread = min(DEVIATIONS * std, (high - low) / 2)
        wanted = min(max(touch.columns[probe.column], low + spread), high - spread)
        arm, planned = self._setting.arm, touch.joints[None]
        tip, plunger = arm.place(arm.local, planned, np.array([[reading]]))  # where it meets the face as it stands
        joints = arm.reach(tip, plunger, np.array([wanted]), planned)
        tip_there, plunger_there = arm.place(arm.local, joints, np.array([[wanted]]))
        miss = max(np.abs(tip_there - tip).max(), AXIS_WEIGHT * np.abs(plunger_there - plunger).max())
        if miss > BROUGHT or not inside_limits(self.problem.robot, joints).all():
            return None
        return replace(touch, joints=joints[0], columns={**touch.columns, probe.column: wanted})

    def needed(self) -> int | None:
        """How many more well-chosen touches the tolerance takes; None where there is none, or 200 are not enough."""
        known = self.state.known
        if self.tolerance is None or known is None or self.field is None:
            return None
        return Pool.of(known, self._setting.further).needed(known, self.field, self.tolerance)

    def shown(self, k: int) -> int:
        """The number by which people know a touch: the plan's, and beyond it the numbers that follow."""
        beyond = len(self._all_planned) + sum(touch.number is None for touch in self.touches[: k + 1])
        number = self.touches[k].number
        return beyond if number is None else number

    def planned(self, number: int | None) -> Touch | None:
        """A touch of the plan by its number; raises CasacalError for one that there is not."""
        if number is None:
            return None
        if not 1 <= number <= len(self._all_planned):
            there = "there is no plan" if self.plan is None else f"the plan has 1 to {len(self.plan)}"
            raise CasacalError(f"Touch {number} of the plan was named, and {there}", "Leave the number out")
        return self._all_planned[number - 1]

    @property
    def alarm(self) -> Alarm | None:
        """Which touch does not agree with the others, and what would explain it; None where all agree."""
        return self.state.alarm

    @cached_property
    def known(self) -> Known | None:
        """Knowledge from the touches, or from the plan before any; None where there is neither."""
        setting = self._setting
        if self.state.known is not None or setting.planned is None:
            return self.state.known
        return known_before(self.problem, setting.planned, setting.places)

    @property
    def too_few(self) -> tuple[str, ...]:
        """Names of the unknowns, such as faces, with too few touches to place them."""
        fit = [touch for touch in self.touches if touch.purpose != CHECK]
        return tuple(name for name, enough in counts(self.problem, rows_of(fit)).items() if not enough) if fit else ()

    @property
    def waiting(self) -> tuple[int, ...]:
        """Touches, counted from 0, of faces of which nobody knows where they stand until there are more of them."""
        return self.state.waiting

    @property
    def belief(self) -> Belief | None:
        """Mean (n,) and root (n, k) of the covariance, mm and rad, named by `names`; None at first."""
        known = self.state.known
        return None if known is None else Belief(known.x, known.bound.start_std[:, None] * known.belief.root)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns of the belief."""
        return () if self.state.known is None else self.state.known.bound.names

    @property
    def noise(self) -> float:
        """Noise that the touches show over what was stated; one where they do not speak against it."""
        return 1.0 if self.state.known is None else self.state.known.factor

    @property
    def corrected(self) -> tuple[int, ...]:
        """Touches, counted from 0, that a suggestion changed."""
        return tuple(k for k, touch in enumerate(self.touches) if touch.corrected)

    @property
    def distrusted(self) -> bool:
        """Whether more touches were corrected than people mistype: a suggestion fits, be it true or not.

        Those that are kept speak for themselves, by a larger `noise`.
        """
        count = len(self.corrected)
        return count > 1 and float(bdtrc(count - 1, len(self), MISTYPED)) < TOO_MANY

    @property
    def tip_error(self) -> float | None:
        """Tip error to expect where it is wanted, mm RMS, apart from the pose of the base.

        None before any touch, and where so many were corrected that they no longer tell what is true: `distrusted`.
        """
        return None if self.weights is None or self.distrusted else math.sqrt(float(self.weights.sum()))

    @property
    def tip_error_below(self) -> float | None:
        """Below which the tip error is 19 times of 20, mm RMS, if priors and model are right; None as `tip_error`."""
        return None if self.weights is None or self.distrusted else error_below(self.weights)

    @property
    def done(self) -> bool:
        """Whether the tolerance is met: 19 times of 20 the tip error is below it, and nothing is in doubt."""
        below = self.tip_error_below
        return self.tolerance is not None and below is not None and self.alarm is None and below <= self.tolerance

    def checked(self) -> tuple[Array, Array] | None:
        """By how much touches kept for checking are off, and its standard deviation (touches, m), mm, or None."""
        known, kept = self.state.known, self._kept
        return None if known is None or not kept else innovations_at(known, kept)

    def checked_chance(self) -> float:
        """Chance that they are together so far off if all is well; one where there are none."""
        known, kept = self.state.known, self._kept
        return 1.0 if known is None or not kept else chance_of(known, kept)

    @property
    def _kept(self) -> list[Touch]:
        """Touches kept for checking of which something is known."""
        known, of_check = self.state.known, (touch for touch in self.touches if touch.purpose == CHECK)
        return [touch for touch in of_check if known is not None and known.knows(touch)]

    @cached_property
    def field(self) -> Array | None:
        """Moves (3 M, n) of the tip where it is wanted, per unit of the belief."""
        if (known := self.state.known) is None:
            return None
        return wanted_field(known.bound, known.bound.x0, wanted_joints(known.bound, self.box, self.targets))

    @cached_property
    def weights(self) -> Array | None:
        """Weights of the squared tip error as a sum of squares of unit normals, mm^2."""
        known = self.state.known
        return None if known is None or self.field is None else spectrum(known.belief.root, self.field)

    def _after(self, touches: tuple[Touch, ...], *, new: bool = False) -> Session:
        """The session with these touches; `new` says that the last one has just come."""
        every = (*touches, *self._all_planned)

        def slips(k: int) -> list[Slip]:
            labels = {name: tuple(dict.fromkeys(each.labels[name] for each in every)) for name in touches[k].labels}
            return slips_of(self.problem, touches[k], self.planned(touches[k].number), labels)

        state = self._setting.state(touches, slips, self.state.known, new=new)
        return replace(self, touches=touches, state=state)

    def _put(self, k: int, touch: Touch) -> Session:
        return self._after((*self.touches[:k], touch, *self.touches[k + 1 :]))

    def _open_alarm(self) -> Alarm:
        if self.alarm is None:
            raise CasacalError("No touch is in doubt", "Answer when there is an alarm")
        return self.alarm

    @cached_property
    def _setting(self) -> SessionSetting:
        if self.state.setting is not None:
            return self.state.setting
        planned = None if self.plan is None else self.plan.samples
        return SessionSetting.of(self.problem, planned, self.cell, self.clearance)

    @cached_property
    def _all_planned(self) -> tuple[Touch, ...]:
        if self.plan is None:
            return ()
        samples = self.plan.samples
        return tuple(Touch.of(samples, k, k + 1, purpose) for k, purpose in enumerate(self.plan.purposes))
