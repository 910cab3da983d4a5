"""Someone errs in the cell: does casacal notice, does it say what, and is the arm ever worse than its drawing?

Ten mistakes on four simulated robots with dials of 1 and 10 mm travel, and clean samples of several sizes beside them.
Every trial goes the user's whole way: `calibrate` with its defaults (but for the cross-check), and its verdict.

    casacal study studies/gross_mistakes.py [--quick] [--trials N] [--workers N] [--out DIR]
"""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from casacal import Cell, Problem, bind, calibrate
from casacal.calibration.verdict import verdict_of
from casacal.fit import BoundProblem, Result
from casacal.simulation import Simulation
from casacal.study import Method, Run, Study
from casacal.study.statistics import success_rate
from studies.cell_mistakes import MISTAKES, NONE, robots, simulated, tip_errors, with_travel
from studies.reporting import figure, number, percent, save, script, table

TRAVELS = (1.0, 10.0)
ROWS = (60, 120, 240)
"""Sizes of clean samples; with mistakes there are always 120."""
LEVELS = ("calibrated", "use with care", "do not use")
WAY = "casacal calibrate"


def whole_way(problem: BoundProblem) -> Result:
    """What `casacal calibrate` finds, with level, reasons and promise kept beside its trace."""
    given = problem.problem
    found = calibrate(given.problem, given.block.samples, reference=False)
    verdict = verdict_of(found)
    said = np.array([verdict.words, *verdict.reasons])
    level, promised = np.array([LEVELS.index(verdict.level)]), np.array([found.unjudged.tip_std[1]])
    trace = {"said": said, "level": level, "promised": promised}
    geometry = ~np.array(found.fit.beside, dtype=bool)
    return dataclasses.replace(found.result, x=found.used_x[geometry], information=None, trace=trace)


@dataclass(frozen=True)
class Trial:
    """One arm, its touches as the user has them, and the truth."""

    problem: BoundProblem
    made: Simulation
    mistake: str

    def judge(self, result: Result) -> dict[str, float]:
        """Level of the verdict, whether it names the mistake, tip error promised, true, and of the drawing."""
        said = " ".join(result.trace["said"]).lower()
        estimates = {"tip_rms_mm": (self.problem, result.x), "drawn_mm": (self.problem, self.problem.x0)}
        return {
            "level": float(result.trace["level"][0]),
            "named": float(any(words in said for words in MISTAKES[self.mistake])),
            "promised_mm": float(result.trace["promised"][0]),
            **tip_errors(self.made, estimates),
        }


@dataclass(frozen=True)
class Erring:
    """A setting: a robot, its cell, a dial and a mistake."""

    problem: Problem
    cell: Cell
    mistake: str
    rows: int = 120

    def trial(self, seed: int) -> Trial:
        """The same arm for the same seed."""
        made, problem, samples = simulated(self.problem, self.cell, self.mistake, self.rows, seed)
        return Trial(bind(problem, samples), made, self.mistake)


def settings(names: tuple[str, ...], mistakes: tuple[str, ...], travels: tuple[float, ...]) -> dict[str, Erring]:
    """Every mistake on every robot with every dial; clean samples in several sizes."""
    found, arms = {}, robots()
    for mistake in mistakes:
        for name in names:
            for travel in travels:
                problem, cell = arms[name]
                cell = dataclasses.replace(cell, travel=travel)
                for rows in ROWS if mistake == NONE else (120,):
                    place = f"{mistake}: {name}, {travel:g} mm, {rows} rows"
                    found[place] = Erring(with_travel(problem, travel), cell, mistake, rows)
    return found


NAMES = ("hsr_jr680", "ur5", "kuka_iiwa14", "adept_cobra600")
study = Study(
    "gross_mistakes", settings(NAMES, tuple(MISTAKES), TRAVELS), {WAY: Method(whole_way)}, trials=20, details=0
)
FEW = (NONE, "sign of the dial", "three wrong labels")
quick = dataclasses.replace(study, settings=settings(("adept_cobra600",), FEW, (10.0,)), trials=2)


def of(run: Run, setting: str, figure: str) -> np.ndarray:
    """One figure of all trials of a setting; NaN where the samples were refused altogether."""
    return run.values(setting, WAY, figure)


def report(run: Run) -> list[str]:
    """What was refused, what was named, and what was accepted though it was worse than the drawing."""
    draw(run, run.out / "promise.png")
    mistaken = [name for name in run.study.settings if not name.startswith(f"{NONE}:")]
    clean = [name for name in run.study.settings if name.startswith(f"{NONE}:")]
    return [
        "# When someone errs in the cell",
        "",
        f"Ten mistakes on four simulated robots, dials of 1 and 10 mm, {run.study.trials} arms each, 120 touches",
        "unless said. *Accepted*: the verdict is not “do not use”; single rows may have been set aside. *Worse*: an",
        "accepted arm whose true tip error exceeds that of its drawing, over 400 workspace poses and apart from where",
        "the base stands. *Named*: the verdict or its reasons say what was done wrong. Rates with Clopper and",
        "Pearson's 95 % intervals.",
        "",
        "## In short",
        "",
        *in_short(run, mistaken, clean),
        "",
        "![promised and true tip error of clean samples](promise.png)",
        "",
        "## By mistake",
        "",
        *by_mistake(run, mistaken),
        "",
        "## Clean samples",
        "",
        *clean_table(run, clean),
    ]


def in_short(run: Run, mistaken: list[str], clean: list[str]) -> list[str]:
    """The rates that matter."""
    level = np.concatenate([of(run, name, "level") for name in mistaken])
    named = np.concatenate([of(run, name, "named") for name in mistaken])
    true, drawn = (np.concatenate([of(run, name, f) for name in mistaken]) for f in ("tip_rms_mm", "drawn_mm"))
    accepted = level < LEVELS.index("do not use")
    worse = int((accepted & (true > drawn)).sum())
    fine = np.concatenate([of(run, name, "level") for name in clean])
    return [
        f"- {len(level)} trials with a mistake: {int(accepted.sum())} accepted, {worse} of them worse than drawn.",
        f"- Named: {percent(success_rate(int(np.nansum(named)), len(named)))}.",
        f"- {len(fine)} clean trials: *calibrated* {percent(success_rate(int((fine == 0).sum()), len(fine)))}, "
        f"{int((fine == 2).sum())} refused.",
    ]


def by_mistake(run: Run, mistaken: list[str]) -> list[str]:
    """One line for each mistake, over robots and dials."""
    rows = []
    for mistake in dict.fromkeys(name.partition(":")[0] for name in mistaken):
        names = [name for name in mistaken if name.startswith(f"{mistake}:")]
        level, named, true, drawn = (
            np.concatenate([of(run, name, f) for name in names]) for f in ("level", "named", "tip_rms_mm", "drawn_mm")
        )
        accepted = level < LEVELS.index("do not use")
        ratio = np.sqrt((true[accepted] ** 2).mean() / (drawn[accepted] ** 2).mean()) if accepted.any() else math.nan
        rows.append((mistake, len(level), int(accepted.sum()), int((accepted & (true > drawn)).sum()),
                     percent(success_rate(int(np.nansum(named)), len(named))), number(float(np.nanmedian(true))),
                     number(float(np.nanmedian(drawn))), number(ratio)))  # fmt: skip
    header = ("mistake", "trials", "accepted", "worse", "named", "true error of all, median mm", "drawing, median mm",
              "accepted over drawing, RMS")  # fmt: skip
    return table(header, rows)


def clean_table(run: Run, clean: list[str]) -> list[str]:
    """Levels, and the promise over the true error, both RMS over arms."""
    rows = []
    for name in clean:
        level, promised, true = (of(run, name, f) for f in ("level", "promised_mm", "tip_rms_mm"))
        counts = [int((level == k).sum()) for k in range(3)]
        ratio = math.sqrt(float((promised**2).mean() / (true**2).mean()))
        rows.append((name.partition(": ")[2], *counts, number(ratio)))
    return table(("setting", *LEVELS, "promised over true, RMS"), rows)


def draw(run: Run, path: Path) -> None:
    """Promised against true error of clean samples."""
    made = figure(6.5, 4.5)
    axes = made.subplots()
    for name in {name.partition(", ")[0].partition(": ")[2] for name in run.study.settings if name.startswith(NONE)}:
        own = [setting for setting in run.study.settings if setting.startswith(f"{NONE}: {name},")]
        promised, true = (np.concatenate([of(run, s, f) for s in own]) for f in ("promised_mm", "tip_rms_mm"))
        axes.loglog(true, promised, ".", label=name)
    ends = axes.get_xlim()
    axes.plot(ends, ends, "k:", lw=1)
    axes.set_xlabel("true tip error, mm RMS")
    axes.set_ylabel("promised, mm RMS")
    axes.legend(frameon=False)
    save(made, path)


if __name__ == "__main__":
    script(__file__)
