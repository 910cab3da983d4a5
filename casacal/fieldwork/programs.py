"""A plan as a controller's program: above each touch, down slowly, wait for the reading, and back.

RAPID (ABB), KRL (KUKA) and URScript (Universal Robots); moves are of the joints, with the values of the plan.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.compensation.programs import KRL, RAPID, URSCRIPT, Language, in_comments, printable
from casacal.errors import UnknownNameError
from casacal.fieldwork.approaches import Approaches
from casacal.planning.route import Route
from casacal.problem.problem import Problem
from casacal.values import FrozenMapping


@dataclass(frozen=True)
class Program:
    """A program in a controller's language: decimals of joint values, and lines around and of its moves and waits."""

    language: Language
    ending: str
    decimals: int
    head: tuple[str, ...]
    fast: tuple[str, ...]
    slow: tuple[str, ...]
    wait: tuple[str, ...]
    end: tuple[str, ...]


LONGEST_LABEL = 40  # letters of a label that fit on a pendant: RAPID holds 80 in a string
PROGRAMS: Mapping[str, Program] = FrozenMapping(
    {
        "rapid": Program(
            RAPID,
            ".mod",
            4,
            ("MODULE casacal_plan", "  PROC touch_the_plan()"),
            ("    MoveAbsJ {}\\NoEOffs, v50, fine, tool0;",),
            ("    MoveAbsJ {}\\NoEOffs, v5, fine, tool0;",),
            ('    TPWrite "{}";', "    Stop;"),
            ("  ENDPROC", "ENDMODULE"),
        ),
        "krl": Program(
            KRL,
            ".src",
            4,
            ("DEF casacal_plan()", "  BAS(#INITMOV, 0)"),
            ("  BAS(#VEL_PTP, 10)", "  PTP {}"),
            ("  BAS(#VEL_PTP, 1)", "  PTP {}"),
            ("  ; {}", "  HALT"),
            ("END",),
        ),
        "urscript": Program(
            URSCRIPT,
            ".script",
            7,
            ("def casacal_plan():",),
            ("  movej({}, a=0.4, v=0.2)",),
            ("  movej({}, a=0.1, v=0.02)",),
            ('  popup("{}", blocking=True)',),
            ("end",),
        ),
    }
)
"""By the name that people ask for."""


def program_text(problem: Problem, route: Route, ways: Approaches, language: str, name: str) -> str:
    """A plan as a program: comments, then for each touch a move above it, the touch, a wait, and back.

    name: of the problem. Where no clear way leads to a touch, the program stops before it. Raises CasacalError for a
    robot whose joints the language does not hold, UnknownNameError for a language that there is not.
    """
    if language not in PROGRAMS:
        raise UnknownNameError("language of programs", language, PROGRAMS)
    form = PROGRAMS[language]
    form.language.refuse_others(problem.robot, "move", "Use the plan's CSV")
    notes = (line for note in _notes(name) for line in in_comments(note))
    lines = [form.head[0], *(f"  {form.language.comment} {line}" for line in notes), *form.head[1:]]

    def add(part: tuple[str, ...], words: str) -> None:
        lines.extend(line.format(words) for line in part)

    def written(joints: Array) -> str:
        return form.language.written(joints, form.decimals)

    labels = list(route.samples.labels.values())
    for k, purpose in enumerate(route.purposes):
        where = printable(" ".join(label[k] for label in labels)).replace('"', "'")
        if not ways.clear[k]:
            add(form.wait, f"no clear way to touch {k + 1} was found: jog the arm above it, then go on")
        for place in (ways.via[k], ways.above[k]):
            if np.isfinite(place).all():
                add(form.fast, written(place))
        add(form.slow, written(route.samples.joints[k]))
        add(form.wait, f"touch {k + 1} {where[:LONGEST_LABEL]} ({purpose})")
        add(form.slow, written(ways.above[k]))
    return "\n".join([*lines, *form.end]) + "\n"


def _notes(name: str) -> list[str]:
    return [
        f"planned by casacal for {printable(name)}; joint values are those that the problem's robot.pose takes",
        "paths were checked for the tip and the faces as drawn, and for what plan was told to avoid. Nothing else of "
        "the cell is known. Try the program slowly, with a hand on the stop and the dial withdrawn",
        "at each stop take the reading with casacal measure, or write it down; then let the program go on",
    ]
