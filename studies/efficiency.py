"""Does any filter or optimiser reach the accuracy that the data allow, and are its standard deviations honest?

Simulated HSR-JR680 on a three-face corner, truth drawn from the prior. Each estimator sees the same arms, poses and
noise. Efficiency is MSE over the squared Bayesian bound (1 is best possible on average); NEES over 24 DH parameters and
NIS should be 1 a degree of freedom; coverage is the part of per-axis tip errors inside their 95 % intervals.

    python -m studies.efficiency [--trials N] [--quick] [--workers N] [--out DIR]
"""

import argparse
import dataclasses
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

from casacal import Problem, bind, ekf, lm, load_problem, sckf, sckf_lm, simulate
from casacal.metrics import bayesian_bound, nees, tip_rms, tip_stds, without_rigid, workspace_joints
from studies import reporting

METHODS = {"EKF": ekf, "SCKF": sckf, "LM": lm, "SCKF+LM": sckf_lm}
SETTINGS = {"noise 0.06 mm": (0.06, 1.0), "noise 0.01 mm": (0.01, 1.0), "noise 0.01 mm, errors x5": (0.01, 5.0)}
"""Name to noise (mm) and the factor on prior and true errors."""
ARM = slice(0, 24)
BOOTSTRAPS = 2000


def problem_of(noise: float, factor: float) -> Problem:
    """The example problem with another noise and a wider prior."""
    problem = load_problem(reporting.PROBLEMS / "hsr_jr680").problem
    instrument = dataclasses.replace(problem.instruments[0], noise_std=noise)
    priors = {key: factor * float(unknown.prior_stds[0]) for key, unknown in problem.robot.parameters.items()}
    return Problem(problem.robot, instrument).with_prior(priors)


def trials(seeds: list[int], *, setting: str, methods: tuple[str, ...]) -> np.ndarray:
    """One entry a seed and method: squared error, squared bound, NEES, NIS, coverage; (seeds, methods, 5)."""
    problem = problem_of(*SETTINGS[setting])
    cell = load_problem(reporting.PROBLEMS / "hsr_jr680").cell
    joints = workspace_joints(problem.robot)
    rows = []
    for seed in seeds:
        simulation = simulate(problem, cell, seed=seed)
        bound = bind(problem, simulation.samples)
        truth = simulation.truth(bound)
        tips, slopes = bound.tips(truth, joints), bound.tip_jacobian(truth, joints)
        best = bayesian_bound(bound.normal(truth).information, bound.prior_std, slopes, tips)
        row = []
        for name in methods:
            result = METHODS[name](bound)
            error = without_rigid((bound.tips(result.x, joints) - tips).ravel(), tips)
            assert np.isfinite(result.covariance).all(), f"{name} lost a direction in seed {seed}"
            stds = tip_stds(result.covariance, without_rigid(bound.tip_jacobian(result.x, joints), tips)).ravel()
            nis = np.nan
            if "innovation" in result.trace:
                nis = float(np.mean((result.trace["innovation"] / result.trace["innovation_std"])[80:] ** 2))
            consistency = nees((result.x - truth)[ARM], result.covariance[ARM, ARM]) / 24
            row.append((tip_rms(error) ** 2, best**2, consistency, nis, float(np.mean(np.abs(error) < 1.96 * stds))))
        rows.append(row)
    return np.array(rows)


def interval(values: np.ndarray) -> str:
    """Mean with its bootstrap 95 % interval; empty where there is nothing to average."""
    if np.isnan(values).all():
        return ""
    rng = np.random.default_rng(0)
    means = rng.choice(values, size=(BOOTSTRAPS, len(values))).mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return f"{values.mean():.3f} ({low:.3f} to {high:.3f})"


def section(name: str, found: np.ndarray, methods: tuple[str, ...]) -> list[str]:
    """Table of one setting."""
    rows = []
    for j, method in enumerate(methods):
        squared, best, consistency, nis, covered = found[:, j].T
        figures = [interval(squared / best), interval(consistency), interval(nis), interval(covered)]
        rows.append((method, f"{np.sqrt(squared.mean()):.3f}", *figures))
    bound = np.sqrt(found[:, 0, 1].mean())
    header = ("method", "tip RMS, mm", "MSE / bound^2", "NEES / 24", "NIS, last third", "coverage of 95 %")
    said = f"{len(found)} trials; Bayesian bound {bound:.3f} mm RMS."
    return [f"## {name}", "", said, "", *reporting.table(header, rows)]


def conclusion(found: dict[str, np.ndarray], methods: tuple[str, ...]) -> list[str]:
    """What the figures say, in figures."""
    lines = []
    for j, method in enumerate(methods):
        ratios = [f"{np.mean(rows[:, j, 0] / rows[:, j, 1]):.2f}" for rows in found.values()]
        lines.append(f"- {method}: MSE / bound^2 of {', '.join(ratios)} in the three settings.")
    one, other = methods.index("LM"), methods.index("SCKF+LM")
    worst = max(float(np.abs(np.sqrt(rows[:, one, 0] / rows[:, other, 0]) - 1).max()) for rows in found.values())
    lines.append(f"- LM and SCKF+LM: tip errors of a trial differ by at most {worst:.1e} of their size.")
    return lines


def main() -> None:
    """Run, report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--quick", action="store_true", help="20 trials a setting")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=reporting.HERE / "efficiency")
    options = parser.parse_args()
    count, methods = 20 if options.quick else options.trials, tuple(METHODS)
    lines = [
        "# Do the estimators reach what the data allow?",
        "",
        "HSR-JR680; floor, wall and side wall of 600 mm around (1350, 0, 700) mm, tilt up to 30 degrees, 120 touches,",
        f"dial travel 10 mm, prior 0.7 mm and 1 mrad (times the setting's factor); seeds 0 to {count - 1}. Tip errors",
        "over 400 workspace poses, up to the base frame. Means with bootstrap 95 % intervals.",
        "",
    ]
    found = {}
    chunks = [list(range(i, min(i + 10, count))) for i in range(0, count, 10)]
    with ProcessPoolExecutor(options.workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        for name in SETTINGS:
            parts = pool.map(partial(trials, setting=name, methods=methods), chunks)
            found[name] = np.concatenate(list(parts))
            lines += [*section(name, found[name], methods), ""]
            print("\n".join(lines[-9:]))
    lines += ["## In short", "", *conclusion(found, methods)]
    reporting.write(options.out, lines, f"python -m studies.efficiency --trials {count}")


if __name__ == "__main__":
    main()
