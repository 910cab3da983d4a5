"""A session with somebody who mistypes: are slips named at once, is what is right left alone, is the tolerance kept?

`casacal measure` at one end of a pseudo-terminal, an operator at the other, before an arm that nobody knows. Of every
hundred touches five are typed wrong: a sign, a digit, the face, a turn of the pointer. Where a touch is doubted the
operator looks at his notes, takes back what he finds wrong, and keeps the rest. It ends when the tolerance is met.

    casacal study studies/mistyping.py [--quick] [--trials N] [--workers N] [--out DIR]
"""

import dataclasses
import math
import os
import pty
import re
import select
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from casacal import bind, lm, load_problem, plan
from casacal.fit import BoundProblem, Result
from casacal.planning import Route
from casacal.planning.plan import write_plan
from casacal.study import Method, Run, Study
from casacal.study.statistics import Interval, success_rate
from studies.reporting import PROBLEMS, figure, palette, percent, save, script, table
from studies.true_cell import World

SESSIONS, WRONG, TOLERANCE, GROSS = 300, 0.05, 1.4, 5.0
"""Sessions; part of touches that are typed wrong; mm; standard deviations of what was to be expected."""

KINDS = ("sign", "digit", "face", "revolution")
PATIENCE, MOST_TURNS = 120.0, 1000
"""Seconds without a word."""


@cache
def route_of(name: str) -> tuple[Any, Route]:
    """A problem and the plan by which it is measured."""
    source = load_problem(PROBLEMS / name)
    return source, plan(source.problem, source.cell, touches=70, pool=1000, check=0.1, seed=1)


@dataclass
class Operator:
    """Somebody at the terminal, his slips, and what became of them."""

    world: World
    rng: np.random.Generator
    open: dict[int, tuple[str, bool, int]] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    tried: set[int] = field(default_factory=set)
    std: float = math.inf
    """Of what was to be expected of the touch before, mm."""

    def line(self, number: int) -> str:
        """What he types for a touch of the plan."""
        joints, reading, face = self.world.touch(number)
        degrees = np.degrees(joints)
        self.counts["touches"] += 1
        if number in self.tried or self.rng.random() >= WRONG:
            self.tried.add(number)
            return _typed(degrees, reading)
        self.tried.add(number)
        kind = str(self.rng.choice(KINDS))
        right = _typed(degrees, reading)
        label = ""
        if kind == "face":
            faces = self.world.route.samples.labels["plane"].names
            label = str(self.rng.choice([name for name in faces if name != face]))
        elif kind == "revolution":
            reading += float(self.rng.choice([-1.0, -1.0, -1.0, 1.0]))
        elif self.rng.random() < 0.5:
            reading = self._slipped(kind, reading)
        else:
            k = int(self.rng.integers(len(degrees)))
            degrees[k] = self._slipped(kind, float(degrees[k]))
        wrong = f"{_typed(degrees, reading)} {label}".strip()
        if wrong == right:
            return right
        self.counts["slips"] += 1
        self.open[number] = (kind, False, self.counts["touches"])
        self._wrong = (np.radians(degrees), reading, label or face)
        return wrong

    def judged(self, number: int, std: float) -> None:
        """Note how large a slip was beside what could be expected there."""
        self.std = std
        if number in self.open:
            kind, _, when = self.open[number]
            gross = abs(self.world.off(*self._wrong)) > GROSS * std
            self.open[number] = (kind, gross, when)
            self.counts["gross"] += gross
            self.counts[f"gross {kind}"] += gross

    def answer(self, suspects: list[tuple[int, int]]) -> str:
        """What he answers when touches are doubted: pairs of place in the session and number in the plan."""
        found = next((pair for pair in suspects if pair[1] in self.open), None)
        if found is None:
            self.counts["doubted beside a slip" if self.open else "doubted wrongly"] += 1
            return "k"
        self._named(found[1], first=found == suspects[0])
        return f"u {found[0]}"

    def refused(self, number: int) -> None:
        """A reading that no such dial shows is not taken: he looks, and types it again."""
        if number in self.open:
            self.judged(number, self.std)
            self._named(number, first=True)

    def _named(self, number: int, *, first: bool) -> None:
        kind, gross, when = self.open.pop(number)
        now = self.counts["touches"] - when <= 1
        for name, is_so in (("named", True), ("named at once", now), ("gross named", gross),
                            ("gross at once", gross and now), (f"gross {kind} at once", gross and now),
                            ("gross first", gross and now and first)):  # fmt: skip
            self.counts[name] += is_so

    def _slipped(self, kind: str, value: float) -> float:
        if kind == "sign":
            return -value
        text = f"{abs(value):.3f}"
        k = int(self.rng.choice([k for k, letter in enumerate(text) if letter.isdigit()]))
        other = str(self.rng.choice([digit for digit in "0123456789" if digit != text[k]]))
        return math.copysign(float(text[:k] + other + text[k + 1 :]), value)


def _typed(degrees: Any, reading: float) -> str:
    return " ".join([*(f"{value:.4f}" for value in degrees), f"{reading:.3f}"])


class Terminal:
    """`casacal measure` at the other end."""

    def __init__(self, *arguments: str) -> None:
        self.end, theirs = pty.openpty()
        environment = {**os.environ, "TERM": "dumb", "COLUMNS": "120", "PYTHONPATH": os.pathsep.join(sys.path)}
        command = [sys.executable, "-m", "casacal", "measure", *arguments]
        self.process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment)
        os.close(theirs)

    def heard(self) -> tuple[str, bool]:
        """What is said until it is one's turn, in one line, and whether it is the end."""
        text = ""
        while not text.endswith("\n> "):
            if not select.select([self.end], [], [], PATIENCE)[0]:
                raise TimeoutError(text)
            try:
                data = os.read(self.end, 65536).decode().replace("\r\n", "\n")
            except OSError:
                return " ".join(text.split()), True
            if not data:
                return " ".join(text.split()), True
            text += data
        return " ".join(text.split()), False

    def type(self, line: str) -> None:
        """Type a line."""
        os.write(self.end, f"{line}\n".encode())

    def close(self) -> int:
        """The exit code."""
        os.close(self.end)
        return self.process.wait(PATIENCE)


def expected(said: str) -> float | None:
    """Standard deviation (mm) of what was expected of the last touch, where the session told it."""
    if told := re.search(r"\(standard deviation ([\d.e+-]+) mm\)", said):
        return float(told[1])
    doubted = re.search(r"is off by ([\d.e+-]+) mm, ([\d.e+-]+) times what was to be expected", said)
    return float(doubted[1]) / float(doubted[2]) if doubted else None


def held(world: World, problem: str, rng: np.random.Generator, folder: Path) -> Operator:
    """A session from beginning to end."""
    source, route = route_of(problem)
    write_plan(folder / "plan.csv", route, source.problem, source.name)
    operator = Operator(world, rng)
    usual = ("--plan", str(folder / "plan.csv"), "--out", str(folder / "samples.csv"))
    terminal = Terminal(str(PROBLEMS / problem), *usual, "--tolerance", f"{TOLERANCE:g}")
    number, over, turns = 0, False, 0
    while not over:
        said, over = terminal.heard()
        turns += 1
        if turns > MOST_TURNS:
            terminal.process.kill()
            raise RuntimeError(f"casacal measure goes on asking after {MOST_TURNS} answers, at last: {said[-300:]}")
        if number and "outside the dial's range" in said:
            operator.refused(number)
        elif number and (std := expected(said)) is not None:
            operator.judged(number, std)
        if over:
            operator.counts["met"] = "within the tolerance" in said and "not within" not in said
            break
        if "Waiting for an answer" in said:
            part, number = said[said.rindex("warning:") :], 0
            pairs = re.findall(r"\d\. touch (\d+)(?: \(number (\d+) of the plan\))?:", part)
            terminal.type(operator.answer([(int(place), int(plan_number or place)) for place, plan_number in pairs]))
        elif (asked := re.findall(r"touch (\d+) \w+; (?:\w| )*;? ?joints", said)) and "one more" not in said:
            number = int(asked[-1])
            terminal.type(operator.line(number))
        else:
            number = 0
            terminal.type("q")
    terminal.close()
    if not math.isfinite(operator.std):  # else no slip would count as gross, and nobody would know why
        raise RuntimeError("casacal measure never said what was to be expected of a touch in words that are known here")
    return operator


@dataclass(frozen=True)
class Trial:
    """The samples of a session, and what its operator counted."""

    problem: BoundProblem
    world: World
    counts: dict[str, int]

    def judge(self, result: Result) -> dict[str, float]:
        """Counts, and the true tip error of a plain fit to the file, mm."""
        places = {name: k for k, name in enumerate(self.problem.names)}
        x = np.array([result.x[places[name]] if name in places else 0.0 for name in self.world.bound.names])
        return {**{name: float(self.counts[name]) for name in COUNTED}, "true": self.world.tip_error(x)}


COUNTED = ("touches", "slips", "named", "named at once", "gross", "gross named", "gross at once", "gross first",
           "doubted wrongly", "doubted beside a slip", "met", *(f"gross {kind}{end}" for kind in KINDS
                                                               for end in ("", " at once")))  # fmt: skip


@dataclass(frozen=True)
class Mistyped:
    """Sessions of one robot."""

    problem: str

    def trial(self, seed: int) -> Trial:
        """Another arm, other faces, other slips."""
        source, route = route_of(self.problem)
        world = World(source.problem, route, seed=seed)
        with tempfile.TemporaryDirectory() as place:
            operator = held(world, self.problem, np.random.default_rng([seed, 1]), Path(place))
            samples = source.problem.read(Path(place) / "samples.csv")
            rows = samples.labels["plane"].rows().values()
            samples = samples.take(np.sort(np.concatenate([each for each in rows if len(each) > 3])))
        return Trial(bind(source.problem, samples), world, dict.fromkeys(COUNTED, 0) | dict(operator.counts))


SETTINGS = {"hsr_jr680": Mistyped("hsr_jr680")}
study = Study("mistyping", SETTINGS, {"plain fit": Method(lm)}, trials=SESSIONS, details=0)
quick = dataclasses.replace(study, trials=2)


def report(run: Run) -> list[str]:
    """Slips named, touches doubted, tolerances kept."""
    lines = [
        "# Sessions with somebody who mistypes",
        "",
        f"{run.study.trials} sessions of `casacal measure` over a pseudo-terminal, each with another HSR-JR680 and",
        f"other faces. Of a hundred touches {100 * WRONG:g} are typed wrong, by a sign, a digit, the face or a turn of",
        f"the pointer. *Gross* is a slip of more than {GROSS:g} standard deviations of what was to be expected there:",
        "smaller ones nobody could tell from an arm that is not known yet. *At once*: when it came, or with the next",
        f"touch. A session ends when the tip error is below {TOLERANCE:g} mm 19 times of 20. Intervals are Clopper and",
        "Pearson's.",
        "",
        "![named](named.png)",
        "",
    ]
    total = {name: sum(_all(run, name)) for name in COUNTED}
    met = [true for true, one in zip(_all(run, "true"), _all(run, "met"), strict=True) if one]
    rows = [
        ("gross slips named at once", _rate(total["gross at once"], total["gross"])),
        ("of these, the right touch first of what is named", _rate(total["gross first"], total["gross at once"])),
        ("gross slips named before the end", _rate(total["gross named"], total["gross"])),
        ("all slips, down to a last digit, named", _rate(total["named"], total["slips"])),
        ("touches doubted though nothing was wrong", _rate(total["doubted wrongly"], total["touches"])),
        ("touches doubted while a slip was not found yet", _rate(total["doubted beside a slip"], total["touches"])),
        ("sessions that met the tolerance", _rate(len(met), len(_all(run, "met")))),
        ("of these, true tip error of a plain fit below it", _rate(sum(t <= TOLERANCE for t in met), len(met))),
    ]
    lines += table(("", "share"), [(name, "-" if rate is None else percent(rate)) for name, rate in rows])
    _draw(run, total, run.out / "named.png")
    touches = total["touches"] / max(len(_all(run, "touches")), 1)
    return [
        *lines,
        "",
        f"{total['slips']:.0f} slips, {total['gross']:.0f} of them gross; {touches:.0f} touches a session.",
    ]


def _all(run: Run, name: str) -> list[float]:
    return [float(value) for setting in run.study.settings for value in run.values(setting, "plain fit", name)]


def _rate(some: float, whole: float) -> Interval | None:
    return success_rate(int(some), int(whole)) if whole else None


def _draw(run: Run, total: dict[str, float], path: Path) -> None:
    made = figure(7, 2.4)
    shares, errors = made.subplots(1, 2)
    colours = palette(2)
    named = [100 * total[f"gross {kind} at once"] / max(total[f"gross {kind}"], 1) for kind in KINDS]
    shares.barh(KINDS, named, color=colours[0])
    shares.set_xlabel("gross slips named at once, %")
    shares.set_xlim(0, 100)
    errors.hist([min(value, 2 * TOLERANCE) for value in _all(run, "true")], bins=24, color=colours[0])
    errors.axvline(TOLERANCE, color=colours[1])
    errors.set_xlabel("true tip error, mm")
    errors.set_ylabel("sessions")
    save(made, path)


if __name__ == "__main__":
    script(__file__)
