"""Do 40 planned touches do what 120 random ones do, on arms that are not as drawn, and is the promise kept?

Four robots, each planned once by its drawing; then arms drawn from the prior, before faces that stand elsewhere than
planned, are touched so and fitted. The true tip error is over the workspace, apart from where the base stands.

    casacal study studies/planned.py [--quick] [--trials N] [--workers N] [--out DIR]
"""

import dataclasses
import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from casacal import bind, lm, load_problem, plan
from casacal.fit import BoundProblem, Result
from casacal.planning import Route
from casacal.planning.candidates import pool_of
from casacal.planning.route import FIT
from casacal.study import Method, Run, Study
from casacal.uncertainty.tip_error import expected_accuracy
from studies.reporting import PROBLEMS, figure, palette, save, script, table
from studies.true_cell import World

ARMS, POOL, FEW, MANY, DRAWS = 50, 3000, 40, 120, 10
ROBOTS = {"hsr_jr680": "HSR-JR680", "ur5": "UR5", "kuka_iiwa14": "KUKA iiwa 14", "adept_cobra600": "Cobra 600 (SCARA)"}
PLANNED, RANDOM = f"{FEW} planned", f"{MANY} random"


@cache
def route_of(robot: str, kind: str, draw: int) -> Route:
    """A plan, or one of some draws of random touches."""
    source = load_problem(PROBLEMS / robot)
    if kind == PLANNED:
        return plan(source.problem, source.cell, touches=FEW, pool=POOL, check=0.0, again=0.0)
    pool = pool_of(source.problem, source.cell, POOL, 0)
    return Route(pool.take(np.random.default_rng(draw).choice(POOL, MANY, replace=False)), (FIT,) * MANY)


@dataclass(frozen=True)
class Trial:
    """Touches of a true arm."""

    problem: BoundProblem
    world: World

    def judge(self, result: Result) -> dict[str, float]:
        """True tip error, and what was promised, mm."""
        places = {name: k for k, name in enumerate(self.problem.names)}
        x = np.array([result.x[places[name]] for name in self.world.bound.names])
        promised = expected_accuracy(self.problem, result.x)[1]
        return {"true": self.world.tip_error(x), "promised": promised}


@dataclass(frozen=True)
class Touched:
    """A robot and the touches that are made on it."""

    robot: str
    kind: str

    def trial(self, seed: int) -> Trial:
        """Another arm; of random touches also one of ten draws."""
        problem = load_problem(PROBLEMS / self.robot).problem
        world = World(problem, route_of(self.robot, self.kind, seed % DRAWS), seed=seed)
        return Trial(bind(problem, world.samples), world)


SETTINGS = {f"{name}, {kind}": Touched(robot, kind) for robot, name in ROBOTS.items() for kind in (PLANNED, RANDOM)}
study = Study("planned", SETTINGS, {"lm": Method(lm)}, trials=ARMS, details=0)
quick = dataclasses.replace(
    study, settings={name: each for name, each in SETTINGS.items() if each.robot == "ur5"}, trials=2
)


def report(run: Run) -> list[str]:
    """Promised and true tip errors."""
    names = [name for name in ROBOTS.values() if f"{name}, {PLANNED}" in run.study.settings]
    lines = [
        f"# {FEW} planned touches against {MANY} random ones",
        "",
        f"{run.study.trials} arms drawn from the prior for each line, before faces that stand some millimetres and",
        f"milliradians elsewhere than planned; {FEW} touches chosen among {POOL} by the drawing, or {MANY} drawn at",
        "random from the same. Where the dial is at its end, the arm is moved until it reads what was expected. Tip",
        "error over the workspace, apart from where the base stands, mm, root mean square over arms; in brackets its",
        "standard error.",
        "",
        "![errors](errors.png)",
        "",
    ]
    rows = []
    for name in names:
        cells = [name]
        for kind in (PLANNED, RANDOM):
            promised, true = (run.values(f"{name}, {kind}", "lm", each) for each in ("promised", "true"))
            cells += [f"{_rms(promised):.3f}", f"{_rms(true):.3f} ({_error_of_rms(true):.3f})"]
        rows.append(cells)
    head = ("robot", f"{PLANNED}: promised", "true", f"{RANDOM}: promised", "true")
    _draw(run, names, run.out / "errors.png")
    return [*lines, *table(head, rows)]


def _rms(values: np.ndarray) -> float:
    return math.sqrt(float((values**2).mean()))


def _error_of_rms(values: np.ndarray) -> float:
    """Standard error of the root of a mean square."""
    if len(values) < 2:
        return math.nan
    return float((values**2).std(ddof=1)) / math.sqrt(len(values)) / (2 * _rms(values))


def _draw(run: Run, names: list[str], path: Path) -> None:
    made = figure(7, 0.5 * len(names) + 1.2)
    axes = made.subplots()
    for k, (kind, colour) in enumerate(zip((PLANNED, RANDOM), palette(2), strict=True)):
        places = np.arange(len(names)) + 0.2 * (2 * k - 1)
        true, promised = (
            [_rms(run.values(f"{name}, {kind}", "lm", each)) for name in names] for each in ("true", "promised")
        )
        axes.barh(places, true, height=0.35, color=colour, label=f"{kind}, true")
        axes.plot(promised, places, "k|", ms=12, label="promised" if k else None)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel("tip error, mm")
    axes.legend(frameon=False, fontsize=8)
    save(made, path)


if __name__ == "__main__":
    script(__file__)
