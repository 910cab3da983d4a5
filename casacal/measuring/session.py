"""A session at the machine, as a frozen value: touches made, and what may be answered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from casacal.array_types import Array
from casacal.errors import CasacalError, refuse_unknown
from casacal.measuring.examine import Alarm, Suspected, refuse_along
from casacal.measuring.standing import Standing
from casacal.measuring.touch import Touch, columns_of, joints_of, labels_of
from casacal.planning.route import FIT


class Session(Standing):
    """Touches of one instrument, taken in one by one by a square-root cubature Kalman filter.

    Args:
        problem: a robot with one instrument, taken without effects; its priors are trusted, its noise until the touches
            speak against it.
        plan: what is to be touched, in which order, and about where faces stand; None where nobody planned.
        tolerance: RMS tip error (mm) at which enough has been measured, or None.
        box, targets: where the tip is wanted, as for `plan`; by default over the workspace.
        cell: where faces are and how far the tool may tilt, for touches beyond the plan; by default as `plan` has it.
        clearance: what the arm must keep clear of in touches beyond the plan.
        best_first: whether the touch of the plan is next that lowers the tip error most, not the next on the way.
        touches, state, skipped: of a session that goes on; see `resumed`.

    Every step gives another session. An `alarm` stands until `undo`, `keep` or `correct` answers it.

    Raises CasacalError for a problem of several instruments and for a tolerance that is none.

    """

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
        touch = Touch(
            joints_of(q, layout),
            columns_of(reading, layout),
            labels_of(plane, layout, planned),
            number,
            FIT if planned is None else planned.purpose,
        )
        for column, known in () if self.plan is None else self.plan.samples.labels.items():
            refuse_unknown(f"{column} of the plan", [touch.labels[column]], known.names)
        if self.known is not None and self.known.knows(touch):
            refuse_along(self.known, touch)
        return self._after((*self.touches, touch), new=True)

    def undo(self, touch: int | None = None) -> Session:
        """Take a touch back, as if it had never been made: the one in doubt, else the last, or by number from 0."""
        if not self.touches:
            raise CasacalError("There is no touch to take back", "Take one first")
        last = len(self) - 1 if self.alarm is None else self.alarm.touch
        k = last if touch is None else touch
        if not 0 <= k < len(self):
            raise CasacalError(f"There is no touch {k}", f"Give 0 to {len(self) - 1}")
        return self._after((*self.touches[:k], *self.touches[k + 1 :]))

    def keep(self) -> Session:
        """Say that the touch in doubt is right as it is."""
        k = self._asked().touch
        return self._after(self._with(k, replace(self.touches[k], kept=True)))

    def correct(self, suspect: Suspected | None = None) -> Session:
        """Put right what was typed wrong: as the likeliest explanation has it, or another one of the alarm's."""
        alarm = self._asked()
        chosen = alarm.suspects[0] if suspect is None else suspect
        if chosen.slip is None:
            what = f"Nothing that could be corrected explains touch {self.shown(chosen.touch)}"
            raise CasacalError(what, "Take it back, or keep it as it is")
        return self._after(self._with(chosen.touch, chosen.slip.touch))

    def skip(self, number: int) -> Session:
        """Leave a touch of the plan out."""
        self.planned(number)
        return replace(self, skipped=self.skipped | {number})

    def resumed(self, touches: Sequence[Touch]) -> Session:
        """The session after touches that were made earlier, such as those of a file; the last is judged as new."""
        made = tuple(touches)
        return self._after(made[:-1])._after(made, new=True) if made else self._after(made)

    def _after(self, touches: tuple[Touch, ...], *, new: bool = False) -> Session:
        """The session with these touches; `new` says that the last one has just come."""
        state = self._setting.state(touches, lambda k: self._slips(touches, k), self.state.known, new=new)
        after = replace(self, touches=touches, state=state)
        same = ("_setting", "_all_planned", "_could", *(("field",) if after.names == self.names else ()))
        after.__dict__.update({name: self.__dict__[name] for name in same if name in self.__dict__})
        return after

    def _with(self, k: int, touch: Touch) -> tuple[Touch, ...]:
        return (*self.touches[:k], touch, *self.touches[k + 1 :])

    def _asked(self) -> Alarm:
        if self.alarm is None:
            raise CasacalError("No touch is in doubt", "Answer when there is an alarm")
        return self.alarm
