"""What happens to each method when something in the cell is not as the model says, and does anyone notice?

The simulated HSR-JR680 on three faces with one thing wrong at a time: the dial's sign, its stated noise, gross rows,
compliance, backlash, faces that are not flat, a tool that stays normal. Trial k of every arm of the study has the same
true robot, so each is compared with the well-specified case trial by trial.

    casacal study studies/misspecified.py [--quick] [--trials N] [--workers N] [--out DIR]
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from casacal import Problem, lm, load_problem
from casacal.calibration.verdict import NOISE_BAND
from casacal.fit import Result
from casacal.kernels.losses import huber
from casacal.simulation import Simulated
from casacal.simulation.cell import flatness_din_876
from casacal.simulation.trials import SimulatedTrial
from casacal.study import Method, Run, Study
from casacal.study.statistics import mean_interval, paired, quantiles, success_rate
from casacal.uncertainty.figures import noise_interval
from studies import rivals
from studies.paper_pictures import COLOURS
from studies.reporting import PROBLEMS, figure, number, percent, save, script, table

SOURCE = load_problem(PROBLEMS / "hsr_jr680")
CELL = SOURCE.cell
RIGHT = "as the model says"
ROBUST = "LM, Huber"


class Watched(SimulatedTrial):
    """A trial that also asks whether the residuals agree with the stated noise."""

    def judge(self, result: Result) -> dict[str, float]:
        """Figures of a simulated trial; found over stated noise, and the lower and upper end of its interval."""
        covariance = result.covariance
        known = bool(np.isfinite(covariance).all())
        found = noise_interval(result) if known else (np.nan,) * 3
        names = ("noise_ratio", "noise_low", "noise_high")
        return {**super().judge(result), **dict(zip(names, found, strict=True))}


@dataclass(frozen=True)
class Arm(Simulated):
    """A simulated setting whose trials are watched."""

    def trial(self, seed: int) -> Watched:
        """The same arm and touches as `Simulated` gives."""
        made = super().trial(seed)
        return Watched(made.problem, made.heldout, made.truth)


def assumed(**changes: float) -> Problem:
    """The problem as someone states it who has the dial wrong."""
    problem = SOURCE.problem
    return Problem(problem.robot, dataclasses.replace(problem.instruments[0], **changes))


def arms() -> dict[str, Arm]:
    """One thing wrong at a time."""
    problem = SOURCE.problem
    lacking = {
        "5 % of rows gross, 1 mm": {"outliers": 0.05, "outlier_size": 1.0},
        "gravity compliance 0.3 mm": {"compliance": 0.3},
        "backlash 40 urad, repeatability 20 urad": {"backlash": 40e-6, "joint_std": 20e-6},
        "faces of grade II": {"flatness": flatness_din_876("II", 600.0)},
        "tool always normal (tilt 0)": {"tilt": 0.0},
    }
    return {
        RIGHT: Arm(problem, CELL),
        "dial's sign wrong": Arm(problem, CELL, fitted=assumed(sign=-problem.instruments[0].sign)),
        "stated noise 10 times too small": Arm(problem, CELL, fitted=assumed(noise_std=0.001)),
        "stated noise 10 times too large": Arm(problem, CELL, fitted=assumed(noise_std=0.1)),
        **{name: Arm(problem, dataclasses.replace(CELL, **changes)) for name, changes in lacking.items()},
    }


METHODS = {
    rivals.BEFORE: rivals.CONTROLS[rivals.BEFORE],
    rivals.PLANES: rivals.CONTROLS[rivals.PLANES],
    **rivals.LOCAL,
    ROBUST: Method(lm, {"loss": huber()}),
}
study = Study("misspecified", arms(), METHODS, trials=200, details=0)
quick = dataclasses.replace(study, trials=4)


def report(run: Run) -> list[str]:
    """What each mistake costs at the tip, whether the residuals betray it, and whether intervals still hold."""
    draw(run, run.out / "cost_of_mistakes.png")
    lines = [
        "# When something is not as the model says",
        "",
        f"Simulated HSR-JR680 on three faces, 85 touches fitted, 35 held out, {run.study.trials} trials per",
        "setting. Tip error over 400 workspace poses, apart from where the base stands, mm RMS. *Noticed*: share of",
        "trials in which the 95 % interval of found over stated noise lies outside "
        f"{NOISE_BAND[0]} to {NOISE_BAND[1]}, where",
        "`casacal calibrate` warns of the noise; its other warnings and `casacal check` are not counted.",
        "*Coverage*: share of tip errors inside their 95 % intervals. Intervals are from the bootstrap; for rates they",
        "are Clopper and Pearson's.",
        "",
        "## In short",
        "",
        *in_short(run),
        "",
        "![what each mistake costs](cost_of_mistakes.png)",
        "",
    ]
    for setting in run.study.settings:
        lines += [f"## {setting}", "", *setting_table(run, setting), ""]
    return lines[:-1]


def over_right(run: Run, setting: str, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Tip error (trials,) of a method, and that of LM where all is as the model says."""
    return run.values(setting, method, "tip_rms_mm"), run.values(RIGHT, rivals.LM, "tip_rms_mm")


def noticed(run: Run, setting: str, method: str) -> np.ndarray:
    """Trials (trials,) in which the residuals disagree with the stated noise by so much that casacal warns."""
    low, high = (run.values(setting, method, f"noise_{end}") for end in ("low", "high"))
    return (low > NOISE_BAND[1]) | (high < NOISE_BAND[0])


def in_short(run: Run) -> list[str]:
    """One line per setting: what it costs LM, who does best, and whether it is noticed."""
    lines = []
    for setting in run.study.settings:
        costs = {method: paired(*over_right(run, setting, method)).ratio for method in (*rivals.LOCAL, ROBUST)}
        best = min(costs, key=lambda method: costs[method].value)
        hits = noticed(run, setting, rivals.LM)
        again = "" if best == rivals.LM else f"; best is {best} with {costs[best]}"
        lines.append(
            f"- **{setting}**: LM's tip error is {costs[rivals.LM]} times that of the well-specified case{again}; "
            f"noticed in {percent(success_rate(int(hits.sum()), len(hits)))}."
        )
    return lines


def setting_table(run: Run, setting: str) -> list[str]:
    """All methods in one setting."""
    rows = []
    for method in run.study.methods:
        tip = run.values(setting, method, "tip_rms_mm")
        hits = noticed(run, setting, method)
        coverage = mean_interval(run.values(setting, method, "coverage"))
        estimates = method not in (rivals.BEFORE, rivals.PLANES)
        rows.append((method, number(quantiles(run.values(setting, method, "heldout_rmse_mm"))[0]),
                     mean_interval(tip), paired(*over_right(run, setting, method)).ratio,
                     coverage if estimates else "",
                     number(quantiles(run.values(setting, method, "noise_ratio"))[0]) if estimates else "",
                     percent(success_rate(int(hits.sum()), len(hits))) if estimates else ""))  # fmt: skip
    header = ("method", "plane RMSE held out, median", "tip RMS, mean", "over LM well specified", "coverage",
              "found / stated noise", "noticed")  # fmt: skip
    return table(header, rows)


def draw(run: Run, path: Path) -> None:
    """Tip error over that of the well-specified LM, arm by arm."""
    methods = (rivals.EKF, rivals.SCKF, rivals.LM, ROBUST)
    made = figure(9, 5)
    axes = made.subplots()
    for place, method in enumerate(methods):
        ratios = [paired(*over_right(run, setting, method)).ratio for setting in run.study.settings]
        spans = np.array([[r.value - r.low, r.high - r.value] for r in ratios]).T
        axes.errorbar([r.value for r in ratios], np.arange(len(ratios)) + 0.15 * (place - 1.5), xerr=spans, fmt="o",
                      ms=4, color=COLOURS.get(method, "#d1622b"), label=method)  # fmt: skip
    axes.axvline(1, color="0.6", lw=0.8)
    axes.set_xscale("log")
    axes.set_yticks(range(len(run.study.settings)), list(run.study.settings))
    axes.invert_yaxis()
    axes.set_xlabel("tip error over that of LM where all is as the model says")
    axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))
    axes.spines[["top", "right"]].set_visible(False)
    save(made, path)


if __name__ == "__main__":
    script(__file__)
