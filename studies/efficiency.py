"""Does any filter or optimiser reach the accuracy that the data allow, and are its standard deviations honest?

Simulated HSR-JR680 on a three-face corner, truth drawn from the prior. Each estimator sees the same arms, poses and
noise. Efficiency is MSE over the squared Bayesian bound (1 is best possible on average); NEES should be 1 per unknown;
coverage is the part of per-axis tip errors inside their 95 % intervals.

    casacal study studies/efficiency.py [--quick] [--trials N] [--workers N] [--out DIR]
"""

import dataclasses

import numpy as np

from casacal import Problem, load_problem
from casacal.simulation import Simulated
from casacal.study import Run, Study
from casacal.study.statistics import mean_interval
from studies import rivals
from studies.reporting import PROBLEMS, script, table

SOURCE = load_problem(PROBLEMS / "hsr_jr680")
SETTINGS = {"noise 0.06 mm": (0.06, 1.0), "noise 0.01 mm": (0.01, 1.0), "noise 0.01 mm, errors x5": (0.01, 5.0)}
"""Name to noise (mm) and the factor on prior and true errors."""


def problem_of(noise: float, factor: float) -> Problem:
    """The example problem with another noise and a wider prior."""
    problem = SOURCE.problem
    priors = {key: factor * float(unknown.prior_stds[0]) for key, unknown in problem.robot.parameters.items()}
    return Problem(problem.robot, dataclasses.replace(problem.instruments[0], noise_std=noise)).with_prior(priors)


study = Study(
    "efficiency",
    {name: Simulated(problem_of(*setting), SOURCE.cell, samples=155) for name, setting in SETTINGS.items()},
    rivals.LOCAL,
    trials=1000,
    details=0,
)
quick = dataclasses.replace(study, trials=10)


def report(run: Run) -> list[str]:
    """One table per setting, and what they say together."""
    lines = [
        "# Do the estimators reach what the data allow?",
        "",
        "HSR-JR680; floor, wall and side wall of 600 mm around (1350, 0, 700) mm, tilt up to 30 degrees, 120 touches",
        f"fitted, dial travel 10 mm, prior 0.7 mm and 1 mrad (times the setting's factor); {run.study.trials} trials",
        "per setting. Tip errors over 400 workspace poses, apart from where the base stands. Means with bootstrap 95 %",
        "intervals.",
        "",
        "## In short",
        "",
        *in_short(run),
        "",
    ]
    for setting in run.study.settings:
        rows = []
        for method in run.study.methods:
            tip = mean_interval(run.values(setting, method, "tip_rms_mm"))
            figures = [mean_interval(run.values(setting, method, name)) for name in ("nees", "coverage")]
            rows.append((method, tip, mean_interval(efficiency(run, setting, method)), *figures))
        header = ("method", "tip RMS, mm", "MSE / bound^2", "NEES per unknown", "coverage of 95 %")
        lines += [f"## {setting}", "", *table(header, rows), ""]
    return lines[:-1]


def efficiency(run: Run, setting: str, method: str) -> np.ndarray:
    """Squared tip error over the squared bound (trials,)."""
    return (run.values(setting, method, "tip_rms_mm") / run.values(setting, method, "bound_mm")) ** 2


def in_short(run: Run) -> list[str]:
    """What the figures say, in figures."""
    lines = []
    for method in run.study.methods:
        ratios = ", ".join(f"{np.nanmean(efficiency(run, setting, method)):.2f}" for setting in run.study.settings)
        lines.append(f"- {method}: MSE / bound^2 of {ratios} in the three settings.")
    tips = [
        np.concatenate([run.values(setting, method, "tip_rms_mm") for setting in run.study.settings])
        for method in (rivals.LM, rivals.BOTH)
    ]
    apart = float(np.nanmax(np.abs(tips[0] / tips[1] - 1)))
    return [*lines, f"- LM and SCKF+LM: tip errors of a trial differ by at most {apart:.1e} of their size."]


if __name__ == "__main__":
    script(__file__)
