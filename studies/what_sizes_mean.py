"""What is a backlash of 20 urad worth at the tip? Effects of usual sizes, on four arms, before anything is measured.

For each effect and robot: how far it moves the tip over the workspace, how much of that no length, twist or offset can
take up, and how far it misleads a calibration that takes geometry for all there is, with the touches of a usual cell.
All of it is linear in the size, so one line serves for any: half the size, half the millimetres.

    casacal study studies/what_sizes_mean.py [--quick] [--trials N] [--workers N] [--out DIR]
"""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from casacal import Cell, Problem, bind, lm, simulate
from casacal.fit import BoundProblem, Result
from casacal.study import Method, Run, Study
from casacal.uncertainty.tip_error import tip_rms, without_rigid, workspace_joints
from studies.cell_mistakes import fit_for, robots
from studies.reporting import figure, number, palette, save, script, table

ROWS = 120
SIZES = {
    "joint repeatability 10 urad": {"joint_std": 10e-6},
    "backlash 20 urad": {"backlash": 20e-6},
    "gear wave once per turn, 0.1 mrad": {"gear_waves": ((1, 1e-4),)},
    "gear wave twice per turn, 0.1 mrad": {"gear_waves": ((2, 1e-4),)},
    "sag of 0.1 mm": {"compliance": 0.1},
    "growth by 10 um/m (steel, 0.8 kelvin)": {"thermal": 1e-5},
    "dial gain 0.1 %": {"dial_gain": 1e-3},
    "dial cycle 3 um": {"dial_cycle": 0.003},
    "faces 10 um off flat": {"flatness": 0.01},
    "drift of 10 um": {"drift": 0.01},
    "readings in steps of 10 um": {"resolution": 0.01},
}
"""Fields of `Cell` by what they mean; lengths mm, angles rad."""


@dataclass(frozen=True)
class Misled:
    """One arm with one effect and nothing else wrong: no error of geometry, no noise but that of the effect."""

    problem: BoundProblem
    moved_mm: float
    beyond_mm: float
    true: np.ndarray
    """Tips (N, 3; mm) over the workspace."""

    def judge(self, result: Result) -> dict[str, float]:
        """Figures of the effect, and the tip error of a fit, mm RMS."""
        joints = workspace_joints(self.problem.problem.robot)
        error = without_rigid((self.problem.tips(result.x, joints) - self.true).ravel(), self.true)
        return {"moved_mm": self.moved_mm, "beyond_mm": self.beyond_mm, "misled_mm": tip_rms(error)}


@dataclass(frozen=True)
class Effect:
    """A robot, its cell as drawn, and one effect."""

    problem: Problem
    cell: Cell

    def trial(self, seed: int) -> Misled:
        """Touches of an arm that is as drawn but for the effect."""
        drawn = dataclasses.replace(self.cell, error_scale=0.0, repeatability=1e-9)
        made = simulate(self.problem, drawn, samples=ROWS, seed=seed)
        bound, joints = bind(self.problem, made.samples), workspace_joints(self.problem.robot)
        tips, true = bound.tips(bound.x0, joints), made.true_tips(joints)
        moved = without_rigid((true - tips).ravel(), tips)
        field = without_rigid(bound.tip_jacobian(bound.x0, joints), tips)
        columns = field[:, ~bound.datum] * bound.start_std[~bound.datum]
        beyond = moved - columns @ np.linalg.lstsq(columns, moved, rcond=1e-6)[0]
        return Misled(bound, tip_rms(moved), tip_rms(beyond), true)


NAMES = ("hsr_jr680", "ur5", "kuka_iiwa14", "adept_cobra600")


def settings(names: tuple[str, ...], sizes: tuple[str, ...]) -> dict[str, Effect]:
    """Every effect on every robot that can have it."""
    found, arms = {}, robots()
    for words in sizes:
        for name in names:
            problem, cell = arms[name]
            if not fit_for(name, SIZES[words]):
                continue
            found[f"{words}: {name}"] = Effect(problem, dataclasses.replace(cell, **SIZES[words]))
    return found


METHODS = {"geometry alone": Method(lm)}
study = Study("what_sizes_mean", settings(NAMES, tuple(SIZES)), METHODS, trials=20, details=0)
quick = dataclasses.replace(study, settings=settings(("ur5",), tuple(SIZES)[2:4]), trials=2)


def report(run: Run) -> list[str]:
    """One table for each robot."""
    draw(run, run.out / "misled.png")
    lines = [
        "# What effects of usual sizes mean at the tip",
        "",
        f"Simulated arms that are as drawn but for one effect, {run.study.trials} of each, touched {ROWS} times in the",
        "cell of their problem, without noise. Tips are compared over 400 workspace poses, apart from where the base",
        "stands; figures are mm RMS. *Moves the tip*: by how much, where nobody calibrates. *Beyond geometry*: what is",
        "left of that with the best lengths, twists and offsets, found by someone who sees the tip everywhere.",
        "*Misleads*: tip error after a calibration from the touches that takes geometry for all there is: a dial that",
        "errs moves no tip, but its reader bends the arm. All grows in proportion to the size.",
        "",
        "![tip error after a calibration that takes geometry for all there is, by effect and robot](misled.png)",
    ]
    for robot in robots_of(run):
        rows = []
        for setting in (name for name in run.study.settings if name.endswith(f": {robot}")):
            figures = (rms(run, setting, key) for key in ("moved_mm", "beyond_mm", "misled_mm"))
            rows.append((setting.partition(": ")[0], *map(number, figures)))
        header = ("effect", "moves the tip", "beyond geometry", "misleads")
        lines += ["", f"## {robot}", "", *table(header, rows)]
    return lines


def robots_of(run: Run) -> list[str]:
    """Robots of this run, in order."""
    return list(dict.fromkeys(name.partition(": ")[2] for name in run.study.settings))


def rms(run: Run, setting: str, name: str) -> float:
    """Root mean square of a figure (mm) over the trials of a setting."""
    return math.sqrt(float(np.mean(run.values(setting, "geometry alone", name) ** 2)))


def draw(run: Run, path: Path) -> None:
    """What misleads by how much, a row for each effect, a mark for each robot."""
    effects = list(dict.fromkeys(name.partition(": ")[0] for name in run.study.settings))
    made = figure(8, 0.32 * len(effects) + 1.4)
    axes = made.subplots()
    for robot, colour in zip(robots_of(run), palette(4), strict=False):
        there = [k for k, effect in enumerate(effects) if f"{effect}: {robot}" in run.study.settings]
        found = [rms(run, f"{effects[k]}: {robot}", "misled_mm") for k in there]
        axes.plot(found, there, "o", color=colour, label=robot)
    axes.set_yticks(range(len(effects)), effects)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel("tip error after a calibration of the geometry alone, mm RMS")
    axes.legend(frameon=False, fontsize=8)
    save(made, path)


if __name__ == "__main__":
    script(__file__)
