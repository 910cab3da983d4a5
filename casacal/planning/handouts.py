"""Handouts of a plan: approaches from touch to touch, a controller's program, a sheet to write on.

A program goes above each touch, down slowly, waits for the reading, and goes back, clear of the faces all along, in
RAPID (ABB), KRL (KUKA) or URScript (Universal Robots); moves are of the joints, with the values of the plan. The sheet
has ten touches a page, each with a picture of the posture in its cell and what to expect.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from casacal.data.samples import WRITTEN
from casacal.deployment.programs import KRL, RAPID, URSCRIPT, Language, in_comments, printable
from casacal.errors import CasacalError, refuse_unknown
from casacal.fit.nominal import nominal_tips
from casacal.model.problem import Problem
from casacal.model.robot import inside_limits
from casacal.pages.drawing import rendered
from casacal.planning.candidates import cell_of
from casacal.planning.cell_drawing import drawings
from casacal.planning.clearance import Around, Clearance, drawn_touch
from casacal.planning.route import Route, joints_shown
from casacal.simulation.cell import Cell, Disturbances
from casacal.simulation.touches import TouchingArm
from casacal.values import Array, FrozenMapping, Index, Rows, Value
from casacal.wording import sentence

RETREAT = 20.0  # how far the tip stands back before and after a touch, mm
HIGHER = (1.0, 2.0, 4.0, 8.0)
"""Times of that by which it is tried to stand back where the way between two touches is not clear."""

MOST_PLACES = 40  # places through which a way is tried
ON_THE_WAY = 60  # postures looked at between two touches
FREE = 2.0  # how near the tip may come to a face between touches, mm
ARRIVED = 0.05  # by how much a place above may be missed, mm


@dataclass(frozen=True, eq=False)
class Approaches(Value):
    """Joint values (N, n; rad, mm) above each touch, and whether the way from the touch before it is clear (N,).

    retreat: how far above (N,), mm. via: joint values (N, n) through which the way leads, NaN where it is straight.
    Of a touch from which the arm cannot draw back all are NaN, and it is not clear; the way leads past it.
    """

    above: Array
    retreat: Array
    via: Array
    clear: Rows


def approaches(
    problem: Problem,
    route: Route,
    cell: Disturbances | None = None,
    *,
    retreat: float = RETREAT,
    clearance: Clearance | None = None,
) -> Approaches:
    """Postures before and after each touch of a plan, the plunger drawn back along itself.

    Where the straight way of the joints from one to the next would come near a face, both stand back further, up to
    eight times as far; then it leads through a place high above another touch. What is not clear then is said.

    Raises CasacalError for an instrument without a plunger, and where the arm can draw back from no touch.
    """
    probe = problem.instrument.probe
    if probe is None:
        what = f"{type(problem.instrument).__name__} has no plunger that could be drawn back"
        raise CasacalError(what, "Use the plan's CSV")
    still, samples = cell_of(problem, cell), route.samples
    arm, readings, tips, axes = drawn_touch(problem, probe, samples)
    every = [_above(arm, samples.joints, readings, tips, axes, retreat * times) for times in HIGHER]
    back = np.isfinite(every[0]).all(axis=1)
    if not back.any():
        what = f"From no touch can the arm draw back by {retreat:g} mm inside its joint limits"
        raise CasacalError(what, "Give a smaller --retreat")
    levels = [level[back] for level in every]
    chosen, clear, via = np.zeros(int(back.sum()), dtype=int), np.ones(int(back.sum()), dtype=bool), levels[0] * np.nan
    if isinstance(still, Cell):
        is_clear = partial(_is_clear, arm, still, (clearance or Clearance()).around(problem.robot, still))
        labels = [""] * len(samples) if probe.label is None else samples.labels[probe.label]
        faces = [still.face(labels[k]).label for k in np.flatnonzero(back).tolist()]
        chosen, clear, via = _StraightWays(is_clear, levels, samples.joints[back], readings[back], faces).found()
    above = np.array([levels[level][k] for k, level in enumerate(chosen)])
    of_all = np.full((2, *every[0].shape), np.nan)
    retreats, free = np.full(len(route), np.nan), np.zeros(len(route), dtype=np.bool_)
    of_all[:, back], free[back] = (above, via), clear
    retreats[back] = retreat * np.array(HIGHER)[chosen]
    return Approaches(of_all[0], retreats, of_all[1], free)


@dataclass(frozen=True)
class _StraightWays:
    """Ways from touch to touch by places above them, which are looked at as they are needed.

    clear: whether the straight way of the joints between two postures is, as `_is_clear` with its options. levels:
    joint values (M, n) above the touches, one array a height, the lowest first. touches, readings, faces: joint values
    (M, n), readings (M,; mm) and labels of the faces of the touches themselves.
    """

    clear: Callable[..., bool]
    levels: list[Array]
    touches: Array
    readings: Array
    faces: Sequence[str]

    def found(self) -> tuple[Index, Rows, Array]:
        """The level of each touch (M,), which ways to touches are clear (M,), and what they lead through (M, n)."""
        chosen, clear = np.zeros(len(self.touches), dtype=int), np.zeros(len(self.touches), dtype=bool)
        down = cache(self._down)
        for k in range(1, len(clear)):
            clear[k] = self._raised(down, chosen, k)
        above = np.array([self.levels[level][k] for k, level in enumerate(chosen)])
        legs = [down(k, level) for k, level in enumerate(chosen.tolist())]
        clear[0] = legs[0]
        for k in (np.flatnonzero(clear[1:]) + 1).tolist():  # an end may have been raised since its way was looked at
            clear[k] = self.clear(above[k - 1], above[k])
        via, places = np.full_like(above, np.nan), self.levels[-1][np.isfinite(self.levels[-1]).all(axis=1)]
        for k in (k for k in np.flatnonzero(~clear).tolist() if k and legs[k]):
            start, end = above[k - 1], above[k]
            lengths = np.abs(places - start).max(axis=1) + np.abs(places - end).max(axis=1)
            for place in places[np.argsort(lengths)[:MOST_PLACES]]:  # the shortest way first
                if self.clear(start, place) and self.clear(place, end):
                    via[k], clear[k] = place, True
                    break
        return chosen, clear, via

    def _down(self, k: int, level: int) -> bool:
        """Whether the way from a level down to touch k, and back, is clear."""
        start = self.levels[level][k]
        there = bool(np.isfinite(start).all())
        return there and self.clear(start, self.touches[k], reading=self.readings[k], touched=self.faces[k])

    def _raised(self, down: Callable[[int, int], bool], chosen: Index, k: int) -> bool:
        """Raise both ends of the way to touch k until it is clear, and their ways down are; whether they are."""
        for level in range(len(self.levels)):
            ends = [max(int(chosen[k - 1]), level), max(int(chosen[k]), level)]
            start, end = self.levels[ends[0]][k - 1], self.levels[ends[1]][k]
            if not (np.isfinite(start).all() and np.isfinite(end).all()):
                return False
            if down(k - 1, ends[0]) and down(k, ends[1]) and self.clear(start, end):
                chosen[k - 1], chosen[k] = ends
                return True
        return False


def _is_clear(
    arm: TouchingArm, cell: Cell, around: Around, start: Array, end: Array, *, reading: float = 0.0, touched: str = ""
) -> bool:
    """Whether the straight way of the joints between two postures keeps off faces, table and all else that is said.

    reading: of the dial on the way, mm. touched: label of the face where it ends, which the tip alone comes near.
    """
    path = _way(arm, start, end, ON_THE_WAY, reading)[1]
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    joints, tips = _way(arm, start, end, max(ON_THE_WAY, math.ceil(length / FREE)), reading)
    for face in cell.faces:
        if face.label == touched:
            continue
        local = (tips - face.centre) @ face.axes.T
        over = (np.abs(local[:, 1:]) <= np.asarray(face.size) / 2 + FREE).all(axis=1)
        height = local[over, 0]
        if (height < FREE).any() and not (height < -FREE).all():  # wholly behind it, it is another side's matter
            return False
    return bool(around.clear(joints, tips).all())


def _way(arm: TouchingArm, start: Array, end: Array, count: int, reading: float) -> tuple[Array, Array]:
    """Joint values (count, n) on the straight way of the joints between two postures, and tips (count, 3)."""
    part = np.linspace(0, 1, count)[:, None]
    joints = start * (1 - part) + end * part
    return joints, arm.place(arm.local, joints, np.full((count, 1), reading))[0]


def _above(arm: TouchingArm, joints: Array, readings: Array, tips: Array, axes: Array, retreat: float) -> Array:
    """Joint values (N, n) with the tip drawn back along the plunger; NaN where limits or reach forbid it."""
    targets = tips - retreat * axes
    found = arm.reach(targets, axes, readings, joints)
    reached, _ = arm.place(arm.local, found, readings[:, None])
    good = (np.linalg.norm(reached - targets, axis=1) < ARRIVED) & inside_limits(arm.robot, found)
    return np.where(good[:, None], found, np.nan)


@dataclass(frozen=True)
class RobotProgram:
    """A program in a controller's language: decimals of joint values, and lines around and of its moves and waits."""

    language: Language
    ending: str
    decimals: int
    head: tuple[str, str]
    fast: str
    slow: str
    wait: str
    end: str


LONGEST_LABEL = 40  # letters of a label that fit on a pendant: RAPID holds 80 in a string
PROGRAMS: Mapping[str, RobotProgram] = FrozenMapping(
    {
        "rapid": RobotProgram(
            RAPID,
            ".mod",
            4,
            ("MODULE casacal_plan\n", "  PROC touch_the_plan()\n"),
            "    MoveAbsJ {}\\NoEOffs, v50, fine, tool0;\n",
            "    MoveAbsJ {}\\NoEOffs, v5, fine, tool0;\n",
            '    TPWrite "{}";\n    Stop;\n',
            "  ENDPROC\nENDMODULE\n",
        ),
        "krl": RobotProgram(
            KRL,
            ".src",
            4,
            ("DEF casacal_plan()\n", "  BAS(#INITMOV, 0)\n"),
            "  BAS(#VEL_PTP, 10)\n  PTP {}\n",
            "  BAS(#VEL_PTP, 1)\n  PTP {}\n",
            "  ; {}\n  HALT\n",
            "END\n",
        ),
        "urscript": RobotProgram(
            URSCRIPT,
            ".script",
            7,
            ("def casacal_plan():\n", ""),
            "  movej({}, a=0.4, v=0.2)\n",
            "  movej({}, a=0.1, v=0.02)\n",
            '  popup("{}", blocking=True)\n',
            "end\n",
        ),
    }
)
"""Languages by name."""


def program_text(problem: Problem, route: Route, ways: Approaches, language: str, name: str) -> str:
    """A plan as a program: comments, then for each touch a move above it, the touch, a wait, and back.

    name: of the problem. The program stops before a touch without a clear way, and leaves out one from which the arm
    cannot draw back. Raises CasacalError for a robot whose joints the language does not hold, UnknownNameError.
    """
    refuse_unknown("language of programs", [language], PROGRAMS)
    form = PROGRAMS[language]
    spoken, comment = form.language, form.language.comment
    spoken.refuse_others(problem.robot, "move", "Use the plan's CSV")
    withdrawn = " and the dial withdrawn" if problem.instrument.words.approach else ""
    notes = (
        f"planned by casacal for {printable(name)}; joint values are those that the problem's robot.pose takes",
        "paths were checked for the tip and the faces as drawn, and for what plan was told to avoid. Nothing else of "
        f"the cell is known. Try the program slowly, with a hand on the stop{withdrawn}",
        "at each stop take the reading with casacal measure, or write it down; then let the program go on",
    )
    comments = [f"  {comment} {line}\n" for note in notes for line in in_comments(note)]
    # the arm may stand anywhere when the program begins
    first = form.wait.format("jog the arm to near the first touch, then let the program go on")
    parts = [form.head[0], *comments, form.head[1], first]
    for k, purpose in enumerate(route.purposes):
        where = printable(" ".join(label[k] for label in route.samples.labels.values())).replace('"', "'")
        if np.isnan(ways.retreat[k]):
            parts.append(f"  {comment} touch {k + 1} is left out: the arm cannot draw back from it\n")
            continue
        if not ways.clear[k]:
            parts.append(form.wait.format(f"no clear way to touch {k + 1} was found: jog the arm above it, then go on"))
        on_the_way = (place for place in (ways.via[k], ways.above[k]) if np.isfinite(place).all())
        parts += [form.fast.format(spoken.written(place, form.decimals)) for place in on_the_way]
        touch, above = (spoken.written(q, form.decimals) for q in (route.samples.joints[k], ways.above[k]))
        said = form.wait.format(f"touch {k + 1} {where[:LONGEST_LABEL]} ({purpose})")
        parts += [form.slow.format(touch), said, form.slow.format(above)]
    return "".join([*parts, form.end])


def sheet_page(
    problem: Problem,
    route: Route,
    name: str,
    notes: Sequence[str] = (),
    cell: Disturbances | None = None,
    clearance: Clearance | None = None,
) -> str:
    """HTML of the sheet, in one file, of the problem called `name`.

    notes: sentences on the cell, above the touches. cell, clearance: as of the plan; what is drawn around the arm.
    """
    layout, samples = problem.layout(), route.samples
    around = (clearance or Clearance()).around(problem.robot, cell)
    overview, pictures = drawings(around, samples.joints, nominal_tips(problem, 0, samples))
    joints = [f"q{i}{_unit(kind)}" for i, kind in enumerate(layout.joints, 1)]
    expected = [f"{column}, expected{_unit(kind)}" for column, kind in layout.columns.items()]
    read = [f"{column}{_unit(kind)}" for column, kind in layout.columns.items()] or ["touched"]
    rows = []
    for k, purpose in enumerate(route.purposes):
        numbers = joints_shown(samples.joints[k], layout)
        numbers += [f"{samples.columns[column][k] * WRITTEN[kind][1]:.2f}" for column, kind in layout.columns.items()]
        words: list[str] = [] if pictures is None else [pictures[k]]
        words += [samples.labels[label][k] for label in layout.labels]
        number = f"{k + 1}{' again' if purpose == 'again' else ''}"
        rows.append({"purpose": purpose, "number": number, "words": words, "numbers": numbers})
    titles = ["", *([] if pictures is None else ["posture"]), *layout.labels, *joints, *expected, *read]
    approach = problem.instrument.words.approach
    said = {"robot": problem.robot.name, "name": name, "approach": sentence(approach) if approach else ""}
    context = {**said, "overview": overview, "notes": notes, "titles": titles, "rows": rows, "blanks": len(read)}
    return rendered("sheet.html", context)


def _unit(kind: str) -> str:
    return WRITTEN[kind][0].replace("_", " ")
