"""What a session says to its operator, in sentences."""

from __future__ import annotations

import math

import numpy as np

from casacal.measuring.examine import Suspected
from casacal.measuring.session import Session
from casacal.measuring.touch import Touch
from casacal.planning.written import PLANNED_DECIMALS
from casacal.samples.layout import Layout
from casacal.samples.samples import WRITTEN
from casacal.wording import counted

HELP_WORDS = (
    "Bring the arm to the posture. If the dial is at the end of its travel, move along the plunger until it reads "
    "about what is expected: readings that differ determine the size of the arm. If the controller shows the joint "
    "values as planned, type the reading alone; otherwise type all joint values (degrees, mm) and the reading. Add "
    "the label if it was another face. u: take the last touch back, or the one in doubt (u 7: touch 7). k: it is "
    "right. "
    "c: put it right as the first explanation has it (c 2: the second). s: leave this touch out. q: end; what was "
    "measured is written already."
)


def posture(touch: Touch, layout: Layout) -> str:
    """Where to go: face, joint values, what to expect."""
    joints = " ".join(
        f"{value * WRITTEN[kind][1]:.{PLANNED_DECIMALS}f}"
        for value, kind in zip(touch.joints, layout.joints, strict=True)
    )
    where = ", ".join(touch.labels[name] for name in layout.labels)
    number = "one more" if touch.number is None else f"touch {touch.number}"
    expected = ", ".join(
        f"{name} about {touch.columns[name] * WRITTEN[kind][1]:.2f}{WRITTEN[kind][0].replace('_', ' ')}"
        for name, kind in layout.columns.items()
    )
    purpose = {"again": "once more", "check": "to check with"}.get(touch.purpose, "")
    return "; ".join(part for part in (f"{number} {where}".strip(), purpose, f"joints {joints}", expected) if part)


def told(session: Session) -> str:
    """What the last touch said, and where the session stands."""
    state, last = session.state, session.touches[-1]
    said = [f"touch {_name(session, len(session) - 1)} made, {len(session)} in all"]
    if state.off is not None and state.std is not None:
        off, std = float(np.linalg.norm(state.off)), float(np.linalg.norm(state.std))
        sign = "-" if len(state.off) == 1 and state.off[0] < 0 else ""
        said.append(f"off by {sign}{off:.3g} mm; {std:.3g} expected")
    elif len(session) - 1 in session.waiting:
        said.append(f"face {', '.join(last.labels.values())} is not yet known well enough to judge it")
    if session.tip_error is not None and session.tip_error_below is not None:
        said.append(f"tip error {session.tip_error:.3g} mm expected, below {session.tip_error_below:.3g}")
    if session.noise > 1:
        said.append(f"touches scatter {session.noise:.2g} times the stated noise; figures allow for it")
    return "; ".join(said)


def doubt(session: Session) -> list[str]:
    """What is in doubt, and what would explain it: a sentence each."""
    alarm = session.alarm
    if alarm is None:
        return []
    size = abs(alarm.off) / alarm.std if alarm.std > 0 else math.inf
    said = [f"warning: touch {_name(session, alarm.raised_by)} is off by {alarm.off:.3g} mm, {size:.2g} times what was"]
    said[0] += " to be expected. What would explain it, the likeliest first:"
    said += [f"  {k}. {_explained(session, each)}" for k, each in enumerate(alarm.suspects, 1)]
    fixable = "c corrects it as in 1; " if alarm.suspects and alarm.suspects[0].slip is not None else ""
    said.append(
        f"u takes touch {_name(session, alarm.touch)} back, so that it is made again; {fixable}k keeps it as it is"
    )
    return said


def _explained(session: Session, each: Suspected) -> str:
    cause = "no known cause explains it" if each.slip is None else each.slip.words
    return f"touch {_name(session, each.touch)}: {cause} ({_percent(each.chance)})"


def _percent(chance: float) -> str:
    return "over 99 %" if chance > 0.99 else f"{100 * chance:.0f} %" if chance >= 0.01 else "below 1 %"


def _name(session: Session, k: int) -> str:
    return str(session.shown(k))


def ended(session: Session) -> list[str]:
    """What to say at the end."""
    said, below = [], session.tip_error_below
    if below is not None:
        met = ""
        if session.tolerance is not None:
            met = f", {'within' if session.done else 'not within'} the tolerance of {session.tolerance:g} mm"
        said.append(
            f"{counted(len(session), 'touch')}: tip error {session.tip_error:.3g} mm expected, below "
            f"{below:.3g} mm{met}, apart from the position of the base, if the priors and the form of the arm's model "
            f"are "
            "right. casacal calibrate judges that"
        )
    if few := session.too_few:
        said.append(
            f"warning: {', '.join(few)} {'has' if len(few) == 1 else 'have'} too few touches; casacal calibrate asks "
            f"for more there, or leaves them out"
        )
    if session.alarm is not None:
        said.append(
            f"warning: touch {_name(session, session.alarm.touch)} is still in doubt; continue the session to settle it"
        )
    if (checked := session.checked()) is not None:
        off, std = (float(np.sqrt((each**2).sum(axis=1).mean())) for each in checked)
        said.append(
            f"{counted(len(checked[0]), 'touch')} kept to verify: off by {off:.3g} mm RMS, {std:.3g} to be expected"
        )
    return said
