"""A plan as a controller's program: above each touch, down slowly, wait for the reading, and back.

RAPID (ABB), KRL (KUKA) and URScript (Universal Robots); moves are of the joints, with the values of the plan.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.compensation.programs import in_comments, printable
from casacal.errors import CasacalError, UnknownNameError
from casacal.fieldwork.approaches import Approaches
from casacal.planning.route import Route
from casacal.problem.problem import Problem
from casacal.values import FrozenMapping


@dataclass(frozen=True)
class Language:
    """What a controller reads: how joint values are written, and the lines of a fast move, a slow one and a wait."""

    name: str
    ending: str
    comment: str
    degrees: bool
    decimals: int
    head: tuple[str, ...]
    fast: tuple[str, ...]
    slow: tuple[str, ...]
    wait: tuple[str, ...]
    end: tuple[str, ...]


LONGEST_LABEL = 40
"""Letters of a label that fit on a pendant: RAPID holds 80 in a string."""

JOINTS6 = "[[{},{},{},{},{},{}],[9E9,9E9,9E9,9E9,9E9,9E9]]"
LANGUAGES: Mapping[str, Language] = FrozenMapping(
    {
        "rapid": Language(
            "RAPID",
            ".mod",
            "!",
            True,
            4,
            ("MODULE casacal_plan", "  PROC touch_the_plan()"),
            (f"    MoveAbsJ {JOINTS6}\\NoEOffs, v50, fine, tool0;",),
            (f"    MoveAbsJ {JOINTS6}\\NoEOffs, v5, fine, tool0;",),
            ('    TPWrite "{words}";', "    Stop;"),
            ("  ENDPROC", "ENDMODULE"),
        ),
        "krl": Language(
            "KRL",
            ".src",
            ";",
            True,
            4,
            ("DEF casacal_plan()", "  BAS(#INITMOV, 0)"),
            ("  BAS(#VEL_PTP, 10)", "  PTP {{A1 {}, A2 {}, A3 {}, A4 {}, A5 {}, A6 {}}}"),
            ("  BAS(#VEL_PTP, 1)", "  PTP {{A1 {}, A2 {}, A3 {}, A4 {}, A5 {}, A6 {}}}"),
            ("  ; {words}", "  HALT"),
            ("END",),
        ),
        "urscript": Language(
            "URScript",
            ".script",
            "#",
            False,
            7,
            ("def casacal_plan():",),
            ("  movej([{}, {}, {}, {}, {}, {}], a=0.4, v=0.2)",),
            ("  movej([{}, {}, {}, {}, {}, {}], a=0.1, v=0.02)",),
            ('  popup("{words}", blocking=True)',),
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
    if language not in LANGUAGES:
        raise UnknownNameError("language of programs", language, LANGUAGES)
    form = LANGUAGES[language]
    kinds = "".join(joint.kind[0].upper() for joint in problem.robot.axes)
    if kinds != "RRRRRR":
        raise CasacalError(
            f"'{problem.robot.name}' has {len(kinds)} joints ({kinds}), and a move in {form.name} has six that turn",
            "Use the plan's CSV",
        )
    lines = [form.head[0], *(f"  {form.comment} {line}" for note in _notes(name) for line in in_comments(note))]
    lines += form.head[1:]
    labels = list(route.samples.labels.values())
    for k, purpose in enumerate(route.purposes):
        where = printable(" ".join(label[k] for label in labels)).replace('"', "'")
        words = f"touch {k + 1} {where[:LONGEST_LABEL]} ({purpose})"
        if not ways.clear[k]:
            halt = f"no clear way to touch {k + 1} was found: jog the arm above it, then go on"
            lines += [line.format(words=halt) for line in form.wait]
        above, there = _written(ways.above[k], form), _written(route.samples.joints[k], form)
        for place in (ways.via[k], ways.above[k]):
            if np.isfinite(place).all():
                lines += [line.format(*_written(place, form)) for line in form.fast]
        lines += [line.format(*there) for line in form.slow]
        lines += [line.format(words=words) for line in form.wait]
        lines += [line.format(*above) for line in form.slow]
    return "\n".join([*lines, *form.end]) + "\n"


def _written(joints: Array, form: Language) -> list[str]:
    factor = 180 / math.pi if form.degrees else 1.0
    return [f"{value * factor:.{form.decimals}f}" for value in joints]


def _notes(name: str) -> list[str]:
    return [
        f"planned by casacal for {printable(name)}; joint values are those that the problem's robot.pose takes",
        "paths were checked for the tip and the faces as drawn, and for what plan was told to avoid. Nothing else of "
        "the cell is known. Try the program slowly, with a hand on the stop and the dial withdrawn",
        "at each stop take the reading with casacal measure, or write it down; then let the program go on",
    ]
