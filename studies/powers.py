"""How often is a fault of realistic size noticed, by its own test, and how often could any test notice it?

The HSR-JR680 of the paper's cell with one fault at a time, and without any. Every trial asks what `casacal check` asks:
the gain of the likelihood by each effect of the kit, and the F tests of a dial's own errors. Beside the power stands
the most that any unbiased test can have which knows the fault's very shape in these rows, but not its size or sign:
geometry hides part of every fault, and noise the rest.

    casacal study studies/powers.py [--quick] [--trials N] [--workers N] [--out DIR]
"""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

from casacal import Cell, Problem, bind, lm, load_problem, simulate
from casacal.effects.selection import UNLIKELY, VERY_STRONG, dial_errors, effect_sizes_of, with_effects
from casacal.fit import BoundProblem, Result
from casacal.fit.bound_problem import repeatability
from casacal.study import Method, Run, Study
from casacal.study.statistics import Interval, success_rate
from casacal.uncertainty.noise import found_noise
from studies.reporting import PROBLEMS, figure, palette, percent, save, script, table

ARMS, ROWS, LEVEL = 100, 120, 0.05
SOURCE = load_problem(PROBLEMS / "hsr_jr680")
NONE = "none"


@dataclass(frozen=True)
class Fault:
    """Fields of a `Cell`, the test that should notice it, and the power that was asked of that."""

    key: str
    fields: dict[str, Any]
    asked: float = math.nan
    fixed: bool = True
    """Whether all that it does is the same however often it is measured, so that it has a shape in the rows."""


FAULTS = {
    NONE: Fault("", {}),
    "dial gain 0.2 %": Fault("gain", {"dial_gain": 0.002}, 0.84),
    "dial cycle 5 um": Fault("cycle", {"dial_cycle": 0.005}, 0.95),
    "gear waves, 2nd order, 0.1 mrad": Fault("wave2", {"gear_waves": ((2, 1e-4),)}, 0.68),
    "compliance 0.5 mm": Fault("give", {"compliance": 0.5}, 0.80),
    "drift 20 um": Fault("drift", {"drift": 0.02}, 1.0),
    "backlash 60 urad": Fault("play", {"backlash": 60e-6}, 1.0),
    "joint repeatability 20 urad": Fault("repeatability", {"joint_std": 20e-6}, fixed=False),
    "faces 50 um off flat": Fault("form", {"flatness": 0.05}),
}


@dataclass(frozen=True)
class Trial:
    """Samples with a fault, and the most that a test can notice of it."""

    problem: BoundProblem
    most: float

    def judge(self, result: Result) -> dict[str, float]:
        """Chances of all tests by key, and the power of the best."""
        return {"most": self.most, **{key: float(values[0]) for key, values in result.trace.items()}}


@dataclass(frozen=True)
class Faulty:
    """A cell with a fault in it."""

    fault: Fault
    problem: Problem = SOURCE.problem

    def trial(self, seed: int) -> Trial:
        """The same arm for the same seed."""
        cell = dataclasses.replace(SOURCE.cell, **self.fault.fields)
        bound = bind(self.problem, simulate(self.problem, cell, samples=ROWS, seed=seed).samples)
        return Trial(bound, self._most(cell, seed) if self.fault.fixed and self.fault.fields else math.nan)

    def _most(self, cell: Cell, seed: int) -> float:
        """Power of the test that knows the shape: what the fault alone does to the rows, where geometry is unknown."""
        made = simulate(self.problem, dataclasses.replace(cell, repeatability=1e-9), samples=ROWS, seed=seed)
        bound = bind(self.problem, made.samples)
        x = made.truth(bound)
        shape, rows = bound.residual(x), bound.jacobian(x)
        known = np.linalg.inv(rows.T @ rows + bound.prior_information)
        toward = rows.T @ shape
        size = math.sqrt(max(float(shape @ shape - toward @ known @ toward), 0.0))
        limit = norm.isf(LEVEL / 2)
        return float(norm.sf(limit - size) + norm.sf(limit + size))


def asked(problem: BoundProblem) -> Result:
    """How unlikely rows are without each error, in place of the trace of a fit: a chance, or the ratio of likelihoods.

    Of joints that do not repeat, where that was told from other noise, one over what they do, in microradians.
    """
    bound = problem.problem
    fit = with_effects(bound.with_noise(found_noise(bound).scale), bound.problem)
    result = lm(fit)
    said = {error.key: error.chance for error in dial_errors(fit, result.x)}
    said |= {each.key: math.exp(-each.gain) for each in effect_sizes_of(fit, result.x)}
    said["repeatability"] = 1 / (1 + 1e6 * repeatability(fit.scale)[1])
    return dataclasses.replace(lm(bound), trace={key: np.array([value]) for key, value in said.items()})


WAY = "casacal check"
METHODS = {WAY: Method(asked)}
study = Study("powers", {name: Faulty(fault) for name, fault in FAULTS.items()}, METHODS, trials=ARMS, details=0)
few = {name: Faulty(FAULTS[name]) for name in (NONE, "drift 20 um")}
quick = dataclasses.replace(study, settings=few, trials=3)


def report(run: Run) -> list[str]:
    """Powers by fault, beside what can be reached, and false alarms."""
    draw(run, run.out / "powers.png")
    lines = [
        "# How often a fault is noticed",
        "",
        f"Simulated HSR-JR680, three faces, {ROWS} touches, noise 0.01 mm, {run.study.trials} arms for each line.",
        "*Noticed*: share of arms of which it is said to be there: a log likelihood that gains more than "
        f"{VERY_STRONG:g}, of",
        f"the dial a chance below {UNLIKELY:g}. *At 5 % of clean arms*: the same where the limit is that which 5 % of",
        "the clean arms are beyond. *Best*: mean power at 5 % of a test that knows what the fault does to every row of",
        "that arm, but for size and sign, and of the geometry its priors alone. Where the fault is random from row to",
        "row there is no such shape. *Asked* are the powers that",
        "were set as a target beforehand. Intervals are Clopper and Pearson's.",
        "",
        "![powers](powers.png)",
        "",
    ]
    rows = []
    for name in run.study.settings:
        fault = FAULTS[name]
        if not fault.key:
            continue
        plain, level = (
            _noticed(run, name, limit, fault.key) for limit in (said_at(fault.key), limit_of(run, fault.key))
        )
        best = float(np.mean(run.values(name, WAY, "most")))
        asked = "-" if math.isnan(fault.asked) else percent_of(fault.asked)
        rows.append((name, percent(plain), percent(level), "-" if math.isnan(best) else percent_of(best), asked))
    lines += table(("fault", "noticed", "at 5 % of clean arms", "best", "asked"), rows)
    alarms = [(key, percent(_noticed(run, NONE, said_at(key), key))) for key in (*DIAL, *EFFECTS)]
    return [*lines, "", "## False alarms", "", "Share of clean arms of which it is said to be there.", "",
            *table(("error", "alarms"), alarms)]  # fmt: skip


def percent_of(share: float) -> str:
    """A share as people read it."""
    return f"{100 * share:.0f} %"


DIAL = ("gain", "cycle")
"""Errors of the dial that are tested, by key."""
EFFECTS = ("wave1", "wave2", "give", "play", "form", "field", "drift", "growth", "repeatability")
"""Effects by key, and joints that do not repeat."""


def said_at(key: str) -> float:
    """The number below which an error is said to be there."""
    return UNLIKELY if key in DIAL else 1.0 if key == "repeatability" else math.exp(-VERY_STRONG)


def limit_of(run: Run, key: str) -> float:
    """The chance below which 5 % of the clean arms fall."""
    return float(np.quantile(run.values(NONE, WAY, key), LEVEL))


def _noticed(run: Run, setting: str, limit: float, key: str) -> Interval:
    found = run.values(setting, WAY, key)
    return success_rate(int((found < limit).sum()), len(found))


def draw(run: Run, path: Path) -> None:
    """Power of each test, and the most there could be."""
    names = [name for name in run.study.settings if name != NONE]
    made = figure(7, 0.34 * len(names) + 1.2)
    axes = made.subplots()
    known, best = palette(2)
    keys = [FAULTS[name].key for name in names]
    found = [_noticed(run, name, limit_of(run, key), key).value for name, key in zip(names, keys, strict=True)]
    axes.plot([100 * each for each in found], range(len(names)), "o", color=known, label="as asked")
    most = [100 * float(np.mean(run.values(name, WAY, "most"))) for name in names]
    axes.plot(most, range(len(names)), "|", ms=12, color=best, label="best")
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlabel("noticed at 5 % false alarms, %")
    axes.legend(frameon=False, fontsize=8)
    save(made, path)


if __name__ == "__main__":
    script(__file__)
