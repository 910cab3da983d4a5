"""What arm, dial and faces do beside their geometry: what it costs, what knowing of it wins back, what is promised.

Twelve faults of realistic sizes, one at a time, and none, on four simulated robots. Every trial goes the user's whole
way three times: least squares that trust dial and stated noise, `calibrate` with geometry alone, and with the effects
to expect of any arm. The truth is the simulated tip with all that moves it.

    casacal study studies/model_errors.py [--quick] [--trials N] [--workers N] [--out DIR]
"""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from casacal import Cell, Problem, bind, calibrate, dial_gain
from casacal import simulate as simulated
from casacal.calibration.verdict import verdict_of
from casacal.fit import BoundProblem, Result
from casacal.simulation import Simulation
from casacal.study import Method, Run, Study
from casacal.study.statistics import mean_interval
from casacal.uncertainty.tip_error import tip_rms, tip_stds, without_rigid, workspace_joints
from studies.cell_mistakes import UPRIGHT, fit_for, robots
from studies.reporting import figure, number, palette, percent, save, script, table

ARMS, ROWS = 50, 120
LEVELS = ("calibrated", "use with care", "do not use")
NO_VERDICT = -1
NONE, CERTIFIED = "none", "none, dial certified to 0.05 %"
GAIN = 0.15
"""Prior of the dial's gain, percent, as `casacal new` declares it."""

SIZES = {
    "joint repeatability": {"joint_std": 20e-6},
    "backlash": {"backlash": 60e-6},
    "thermal growth": {"thermal": 3e-5},
    "gear wave, 1st order": {"gear_waves": ((1, 1e-4),)},
    "gear wave, 2nd order": {"gear_waves": ((2, 1e-4),)},
    "dial cycle": {"dial_cycle": 0.005},
    "dial gain": {"dial_gain": 0.0015},
    "compliance": {"compliance": 0.3},
    "flatness": {"flatness": 0.02},
    "drift": {"drift": 0.02},
    "quantisation": {"resolution": 0.01},
}
"""Changes of a cell by fault; lengths mm, angles rad."""


def mixture() -> dict[str, float | tuple[tuple[int, float], ...]]:
    """Half of everything at once."""
    halves = {name: value / 2 for sizes in SIZES.values() for name, value in sizes.items() if name != "gear_waves"}
    return {**halves, "gear_waves": ((1, 0.5e-4), (2, 0.5e-4))}


FAULTS = {NONE: {}, **SIZES, "mixture": mixture(), CERTIFIED: {}}
"""All lines of the study. The true gain is drawn from what a dial declares; "dial gain" adds as much again."""


@dataclass(frozen=True)
class Trial:
    """One arm, its touches, and where its tip truly goes."""

    problem: BoundProblem
    made: Simulation

    def judge(self, result: Result) -> dict[str, float]:
        """What the way found of the tip: its true error, what it promised, what its intervals cover."""
        joints, level = workspace_joints(self.made.problem.robot), float(result.trace["level"][0])
        true = self.made.true_tips(joints)
        drawn = (self.problem.tips(self.problem.x0, joints) - true).ravel()
        stds, tips = result.trace["stds"], result.trace["tips"]
        error = without_rigid((tips - true).ravel(), true)
        return {
            "level": level,
            "tip_rms_mm": tip_rms(error),
            "promised_mm": math.sqrt(float((stds**2).sum(axis=1).mean())),
            "coverage": float(np.mean(np.abs(error) < 1.96 * stds.ravel())),
            "drawn_mm": tip_rms(without_rigid(drawn, true)),
        }


def trusting(problem: BoundProblem) -> Result:
    """Least squares over all rows: noise as stated, a perfect dial, geometry for all there is, and no verdict."""
    given = problem.problem.problem
    trusted = Problem(given.robot, dataclasses.replace(given.instrument, gain=None))
    return _told(problem.problem, trusted, "none", trusting=True)


def geometry(problem: BoundProblem) -> Result:
    """`calibrate` that takes geometry for all there is."""
    return _told(problem.problem, problem.problem.problem, "none")


def kit(problem: BoundProblem) -> Result:
    """`calibrate` that knows of effects beside the geometry."""
    return _told(problem.problem, problem.problem.problem, "kit")


def _told(
    bound: BoundProblem,
    problem: Problem,
    discrepancy: Literal["kit", "none"],
    *,
    trusting: bool = False,
) -> Result:
    """Level, tips (N, 3) and their standard deviations (N, 3) over the workspace, in place of a trace.

    The estimate may have more unknowns than the trial's problem, so that it stays behind.
    """
    found = calibrate(
        problem,
        bound.block.samples,
        reference=False,
        discrepancy=discrepancy,
        noise="stated" if trusting else "found",
        outliers="keep" if trusting else "set aside",
    )
    motion, joints = found.unjudged.motion, workspace_joints(found.fit.problem.robot)
    tips = motion.arm.tips(motion.x, joints)
    field = without_rigid(motion.arm.tip_jacobian(motion.x, joints), tips)
    stds = tip_stds(motion.covariance, field, motion.off)
    level = NO_VERDICT if trusting else LEVELS.index(verdict_of(found).level)
    trace = {"level": np.array([level]), "tips": tips, "stds": stds}
    return dataclasses.replace(found.result, x=bound.x0.copy(), trace=trace)


@dataclass(frozen=True)
class Faulty:
    """A setting: a robot, its cell with a fault in it, and how many touches."""

    problem: Problem
    cell: Cell
    rows: int = ROWS

    def trial(self, seed: int) -> Trial:
        """The same arm for the same seed, whatever the fault."""
        made = simulated(self.problem, self.cell, samples=self.rows, seed=seed)
        return Trial(bind(self.problem, made.samples), made)


def settings(names: tuple[str, ...], faults: tuple[str, ...]) -> dict[str, Faulty]:
    """Every fault on every robot that can have it."""
    found, arms = {}, robots()
    for fault in faults:
        for name in names:
            problem, cell = arms[name]
            disturbed = fit_for(name, FAULTS[fault])
            if FAULTS[fault] and not disturbed:
                continue
            gain = dial_gain(0.05 if fault == CERTIFIED else GAIN)
            declared = Problem(problem.robot, dataclasses.replace(problem.instrument, gain=gain))
            found[f"{fault}: {name}"] = Faulty(declared, dataclasses.replace(cell, **disturbed))
    return found


NAMES = ("hsr_jr680", "ur5", "kuka_iiwa14", UPRIGHT)
METHODS = {"trusting": Method(trusting), "geometry alone": Method(geometry), "with effects": Method(kit)}
study = Study("model_errors", settings(NAMES, tuple(FAULTS)), METHODS, trials=ARMS, details=0)
quick = dataclasses.replace(study, settings=settings(("adept_cobra600",), (NONE, "gear wave, 1st order")), trials=1)


def rms(values: np.ndarray) -> float:
    """Root mean square; NaN of nothing."""
    return math.sqrt(float(np.mean(np.square(values)))) if values.size else math.nan


def over(run: Run, names: list[str], way: str) -> dict[str, np.ndarray]:
    """Figures of all trials of some settings in which a way came to its end."""
    figures = ("level", "tip_rms_mm", "promised_mm", "coverage", "drawn_mm")
    found = {f: np.concatenate([run.values(name, way, f) for name in names]) for f in figures}
    answered = np.isfinite(found["level"])
    return {f: values[answered] for f, values in found.items()}


def report(run: Run) -> list[str]:
    """What each fault costs, with and without effects, and whether promises and intervals hold."""
    draw(run, run.out / "promise.png")
    every = list(run.study.settings)
    lines = [
        "# What arm, dial and faces do beside their geometry",
        "",
        f"Simulated: {', '.join(robots_of(run))}; arms of each for every fault: {run.study.trials}, each with {ROWS}",
        f"touches. The dial's gain is declared as good to {GAIN:g} %, or to 0.05 % where it is certified, and truly",
        "drawn from that; the fault “dial gain” adds as much again. Sizes of the faults stand at the end.",
        '*Trusting* is least squares over all rows with the noise as stated (`noise="stated", outliers="keep",',
        'discrepancy="none"`), a dial that is taken for perfect, and no verdict; *geometry alone* is',
        '`discrepancy="none"`, *with effects* `discrepancy="kit"`, both with the dial as declared and the noise as',
        "found. Tip errors",
        "are against all that moves the true tip (gears, gravity, warmth half-way through the session), over 400",
        "workspace poses and apart from where the base stands, mm, RMS over arms, whatever the verdict. *Promised*: of",
        "the same, by the result itself. *Covered*: share of errors along each axis inside 1.96 standard deviations,",
        "mean over arms. *Worse*: arms that are not denied though their error exceeds that of the drawing. *Levels*:",
        "calibrated, use with care, do not use.",
        "",
        "## In short",
        "",
        *in_short(run, every),
        "",
        "![promised and true tip error by fault](promise.png)",
        "",
        "## By fault, over all robots",
        "",
        *fault_table(run),
    ]
    for robot in robots_of(run):
        lines += ["", f"## {robot}", "", *fault_table(run, robot)]
    sizes = [(fault, ", ".join(f"{key} {size}" for key, size in FAULTS[fault].items())) for fault in faults(run)]
    return [*lines, "", "## The faults", "", "As fields of `Cell`, in mm, rad and parts of one.",
            f"No joint of {UPRIGHT} carries a weight: it has no compliance, alone or in the mixture.", "",
            *table(("fault", "fields"), sizes)]  # fmt: skip


def robots_of(run: Run) -> list[str]:
    """Robots of this run, in order."""
    return list(dict.fromkeys(name.partition(": ")[2] for name in run.study.settings))


def faults(run: Run) -> list[str]:
    """Faults of this run, in order."""
    return list(dict.fromkeys(name.partition(": ")[0] for name in run.study.settings))


def of(run: Run, fault: str, robot: str | None = None) -> list[str]:
    """Settings of a fault, on one robot or on all."""
    return [n for n in run.study.settings if n.partition(": ")[0] == fault and robot in (None, n.partition(": ")[2])]


def in_short(run: Run, names: list[str]) -> list[str]:
    """Cost, promise and coverage of both ways over all trials."""
    lines = []
    for way in run.study.methods:
        f = over(run, names, way)
        worse = (f["level"] < LEVELS.index("do not use")) & (f["tip_rms_mm"] > f["drawn_mm"])
        lines.append(
            f"- **{way}**: tip error {number(rms(f['tip_rms_mm']))} mm RMS of {number(rms(f['drawn_mm']))} as drawn; "
            f"promised {number(rms(f['promised_mm']))} mm; covered {percent(mean_interval(f['coverage']))}; "
            f"{int(worse.sum())} of {len(worse)} accepted though worse than drawn."
        )
    return lines


def fault_table(run: Run, robot: str | None = None) -> list[str]:
    """One line for each fault and way."""
    rows = []
    for fault in (name for name in faults(run) if of(run, name, robot)):
        for way in run.study.methods:
            f = over(run, of(run, fault, robot), way)
            worse = (f["level"] < LEVELS.index("do not use")) & (f["tip_rms_mm"] > f["drawn_mm"])
            counts = [str(int((f["level"] == k).sum())) for k in range(len(LEVELS))]
            levels = "none" if (f["level"] == NO_VERDICT).all() else " / ".join(counts)
            errors = [number(rms(f[name])) for name in ("drawn_mm", "tip_rms_mm", "promised_mm")]
            covered = f"{100 * float(np.mean(f['coverage'])):.0f} %" if f["coverage"].size else "-"
            rows.append((fault, way, len(worse), *errors, covered, int(worse.sum()), levels))
    header = ("fault", "way", "arms", "as drawn", "true", "promised", "covered", "worse", "levels")
    return table(header, rows)


def draw(run: Run, path: Path) -> None:
    """Promised over true tip error, and coverage, by fault."""
    names = faults(run)
    made = figure(9, 0.32 * len(names) + 1.8)
    ratio, share = made.subplots(1, 2, sharey=True)
    for k, (way, colour) in enumerate(zip(run.study.methods, palette(3), strict=True)):
        found = [over(run, of(run, fault), way) for fault in names]
        places = np.arange(len(names)) + 0.2 * (k - 1)
        ratio.plot([rms(f["promised_mm"]) / rms(f["tip_rms_mm"]) for f in found], places, "o", color=colour, label=way)
        share.plot([100 * float(np.mean(f["coverage"])) for f in found], places, "o", color=colour)
    ratio.axvline(1, color="0.6", lw=0.8)
    share.axvline(95, color="0.6", lw=0.8)
    ratio.set_yticks(range(len(names)), names)
    ratio.invert_yaxis()
    ratio.set_xlabel("promised over true tip error, RMS")
    share.set_xlabel("inside 95 % intervals, %")
    ratio.legend(frameon=False, fontsize=8)
    save(made, path)


if __name__ == "__main__":
    script(__file__)
