"""Does a real arm get better, and who says so: the planes it touched, or the laser tracker that watched it?

A Yaskawa Motoman MA1400 touched plates with a ball (Stepanova et al., Robotics and Computer-Integrated Manufacturing
73, 102250, 2022). Every method calibrates it from a random 70 % of the contacts; the rest, and two runs seen by a
laser tracker, judge. The measurements are not part of this project: name their folder in CASACAL_MOTOMAN.

    CASACAL_MOTOMAN=FOLDER casacal study studies/real_arm.py [--quick] [--trials N] [--workers N] [--out DIR]
"""

import hashlib
import math
import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from casacal import Problem, Samples, TrackedPoint, bind, lm, load_problem
from casacal.data.holdout import split
from casacal.fit import BoundProblem, Result
from casacal.fit.least_squares import Conditioned
from casacal.study import Run, Study
from casacal.study.statistics import mean_interval, paired
from casacal.uncertainty.figures import residual_figures
from studies import rivals
from studies.paper_pictures import COLOURS, base, common
from studies.reporting import PROBLEMS, figure, save, script, table

FOLDER = Path(os.environ.get("CASACAL_MOTOMAN", "-"))
CONTACTS = "contacts.csv"
TRACKED = {"tracker_free_mm": "tracker_free.csv", "tracker_wall_mm": "tracker_wall.csv"}
TRACKER_STD = 0.1
HELDOUT = 0.3
SHIPPED, DEFAULT = "shipped prior", "default prior, 0.7 mm and 1 mrad"
LOOSE = "loose prior, 10 mm and 10 mrad"


@dataclass(frozen=True)
class ContactTrial:
    """A split of the contacts, judged by the rest of them and by the tracker."""

    problem: BoundProblem
    heldout: BoundProblem
    tracked: dict[str, BoundProblem]

    def judge(self, result: Result) -> dict[str, float]:
        """Objective, plane residuals fitted and held out, and distance from where the tracker saw the reflector."""
        heldout = residual_figures(self.heldout.plain_residual(result.x))
        return {
            "cost": self.problem.cost(result.x),
            "fit_rmse_mm": residual_figures(self.problem.plain_residual(result.x))["rmse_mm"],
            **{f"heldout_{name}": value for name, value in heldout.items()},
            **{name: tracker_rms(self.problem, result.x, seen) for name, seen in self.tracked.items()},
        }

    def detail(self, result: Result) -> dict[str, list[float]]:
        """The estimate and its spread."""
        return {"names": list(self.problem.names), "x": result.x.tolist(), "std": result.std.tolist()}


def tracker_rms(problem: BoundProblem, x: np.ndarray, tracked: BoundProblem) -> float:
    """Distance (mm RMS) of the reflector from where the tracker saw it; only reflector and tracker are fitted."""
    estimate = dict(zip(problem.names, x, strict=True))
    arm = tracked.problem.robot.parameters.keys()
    free = np.array([slot.key not in arm for slot in tracked.slots for _ in slot.columns])
    held = np.array([0.0 if loose else estimate[name] for name, loose in zip(tracked.names, free, strict=True)])
    part = Conditioned(tracked, free, held)
    points = tracked.plain_residual(part.expand(lm(part).x)).reshape(-1, 3)
    return math.sqrt(float((points**2).sum(axis=1).mean()))


@dataclass(frozen=True)
class Contacts:
    """Contacts of a real arm, split at random, and the tracker's runs; they are read when a trial asks for them."""

    problem: Problem
    digests: tuple[str, ...]
    """SHA-256 of the measurements; none where they are absent and only a report is made."""

    def trial(self, seed: int) -> ContactTrial:
        """One split: the given part of each plate's contacts is held out."""
        contacts = self._contacts
        fitted, held = split(contacts, HELDOUT, seed)
        fit = bind(self.problem, contacts.take(fitted))
        return ContactTrial(fit, fit.on(contacts.take(held)), self._seen)

    @cached_property
    def _contacts(self) -> Samples:
        return self.problem.read(FOLDER / CONTACTS)

    @cached_property
    def _seen(self) -> dict[str, BoundProblem]:
        watched = Problem(self.problem.robot, TrackedPoint(noise_std=TRACKER_STD))
        return {name: bind(watched, watched.read(FOLDER / file)) for name, file in TRACKED.items()}


def alike(problem: Problem, length: float, angle: float) -> Problem:
    """The arm under one prior for all lengths (mm) and one for all angles (rad)."""
    return problem.with_prior({"a": length, "d": length, "alpha": angle, "theta": angle})


def described(trials: int, population: int, budget: int) -> Study:
    """The study over the folder of measurements."""
    problem = load_problem(PROBLEMS / "motoman_ma1400").problem
    priors = {SHIPPED: problem, DEFAULT: alike(problem, 0.7, 1e-3), LOOSE: alike(problem, 10.0, 0.01)}
    files = [FOLDER / name for name in (CONTACTS, *TRACKED.values())]
    digests = tuple(hashlib.sha256(file.read_bytes()).hexdigest() for file in files if file.is_file())
    methods = {
        **{name: rivals.CONTROLS[name] for name in (rivals.BEFORE, rivals.PLANES, rivals.NULL_STEP)},
        **rivals.population(population, (budget,)),
        **rivals.LOCAL,
        **rivals.REFERENCES,
    }
    settings = {name: Contacts(prior, digests) for name, prior in priors.items()}
    return Study("real_arm", settings, methods, trials=trials)


study, quick, skipped = described(20, 5, 1_000_000), described(2, 1, 100_000), None
if not (FOLDER / CONTACTS).is_file():
    skipped = "the Motoman measurements are not here; name their folder in CASACAL_MOTOMAN"


def report(run: Run) -> list[str]:
    """Planes against tracker, method by method."""
    draw(run, run.out / "planes_and_tracker.png")
    lines = [
        "# A real arm: what the planes say and what the tracker says",
        "",
        f"Motoman MA1400, 552 contacts with plates, {run.study.trials} random splits, 70 % fitted, 30 % held out.",
        "The tracker saw 212 poses in free space and 25 near the wall, none of them used in the fit. To compare with",
        "it, only the reflector's place on the flange and the tracker's own frame are fitted. Figures are mm RMS,",
        "means over splits. The splits share one set of measurements, so the intervals show how results vary from",
        "split to split, not from arm to arm. Ratios are geometric means over the splits that both took part in;",
        "the picture shows the splits that all did.",
        "",
        "*Shipped prior*: that of problems/motoman_ma1400, made by hand for an arm that left the factory calibrated:",
        "0.1 mm, 0.1 mrad for twists, 0.5 mrad for joints' zeros. *Default prior*: that of an arm of which no more is",
        "known than its drawing.",
        "",
        "## In short",
        "",
        *in_short(run),
        "",
        "![plane residual against tracker](planes_and_tracker.png)",
        "",
    ]
    for setting in run.study.settings:
        rows = []
        for method in run.study.methods:
            columns = ("heldout_rmse_mm", *TRACKED)
            figures = [mean_interval(run.values(setting, method, name)) for name in columns]
            before, lm = (
                paired(both_runs(run, setting, method), both_runs(run, setting, other)).ratio
                for other in (rivals.BEFORE, rivals.LM)
            )
            planes = paired(*(run.values(setting, name, "heldout_rmse_mm") for name in (method, rivals.LM))).ratio
            failed = len(run.failures(setting, method))
            rows.append((method, len(run.of(setting, method)), *figures, before, planes, lm, failed))
        header = ("method", "splits", "planes, held out", "tracker, free", "tracker, wall", "tracker / before",
                  "planes / LM's", "tracker / LM's", "failures")  # fmt: skip
        lines += [f"## {setting}", "", *table(header, rows), ""]
    return lines[:-1]


def both_runs(run: Run, setting: str, method: str) -> np.ndarray:
    """Geometric mean (trials,) of both tracker runs."""
    free, wall = (run.values(setting, method, name) for name in TRACKED)
    return np.sqrt(free * wall)


def in_short(run: Run) -> list[str]:
    """What LM does to planes and tracker under each prior."""
    lines, both = [], (rivals.LM, rivals.PLANES)
    for setting in run.study.settings:
        planes = paired(*(run.values(setting, method, "heldout_rmse_mm") for method in both)).ratio
        tracker = paired(*(both_runs(run, setting, method) for method in both)).ratio
        word = "better" if tracker.high < 1 else "worse" if tracker.low > 1 else "neither better nor worse"
        lines.append(
            f"- **{setting}**: LM brings the held-out plane residual to {planes} times what fitting the planes alone "
            f"leaves; the arm's error as the tracker sees it is {tracker} times as large: {word}."
        )
    return lines


def draw(run: Run, path: Path) -> None:
    """Each method at its held-out plane residual and its tracker error, under each prior."""
    made, count = figure(13, 4.4), common(run, list(run.study.methods))
    ticks = {SHIPPED: (0.18, 0.2, 0.22, 0.24), DEFAULT: (0.2, 0.3, 0.5, 1), LOOSE: (0.2, 0.5, 1, 2, 4)}
    for axes, setting in zip(made.subplots(1, 3), run.study.settings, strict=True):
        for method in run.study.methods:
            names = ("heldout_rmse_mm", "tracker_free_mm")
            x, y = (float(np.nanmean(run.values(setting, method, name)[:count])) for name in names)
            marker = {rivals.NULL_STEP: "X", rivals.SCIPY: "+", rivals.IPOPT: "x"}.get(method, "o")
            axes.plot(x, y, marker, ms=8, color=COLOURS.get(base(method), "#c02020"), label=base(method))
        axes.set_xlabel("plane residual, held out, mm RMS")
        axes.set_title(setting, fontsize=10)
        axes.set_yscale("log")
        axes.set_yticks(ticks[setting], [f"{tick:g}" for tick in ticks[setting]])
        axes.minorticks_off()
        axes.spines[["top", "right"]].set_visible(False)
    made.axes[0].set_ylabel("tracker, free space, mm RMS")
    made.axes[-1].legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))
    save(made, path)


if __name__ == "__main__":
    script(__file__)
