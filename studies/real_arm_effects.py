"""A real arm with what errs beside its geometry: what knowing of it wins, and does the promise hold?

The same Motoman MA1400 as in `real_arm.py`, calibrated the user's whole way, by `casacal.calibrate`, from its contacts
alone: with geometry as all there is, and with the effects to expect of any arm, which are corrected where they win by
transfer. A laser tracker that no fit has seen judges the arm as `predict` says it is, and the promise: the standard
deviations that the result has of the poses that the tracker saw. The measurements are not part of this project: name
their folder in CASACAL_MOTOMAN.

    CASACAL_MOTOMAN=FOLDER casacal study studies/real_arm_effects.py [--quick] [--trials N] [--workers N] [--out DIR]
"""

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from casacal import Problem, Samples, TrackedPoint, bind, calibrate, load_problem
from casacal.calibration.calibrated import Calibrated
from casacal.calibration.verdict import verdict_of
from casacal.data.holdout import split
from casacal.fit import BoundProblem, Result
from casacal.fit.arm_alone import ArmAlone
from casacal.study import Method, Run, Study
from casacal.study.statistics import mean_interval
from casacal.uncertainty.tip_error import rigid_fields, tip_stds
from studies.real_arm import CONTACTS, DEFAULT, FOLDER, HELDOUT, SHIPPED, TRACKED, alike, skipped
from studies.reporting import PROBLEMS, figure, palette, save, script, table

__all__ = ["quick", "report", "skipped", "study"]

LEVELS = ("calibrated", "use with care", "do not use")
NOISES = (0.01, 0.45)
"""Stated noise, mm: that of a dial, which no ball set down by hand has, and what the contacts err by."""
REFLECTOR = np.array([45.0, 0.0, 245.0])
"""Where it sits on the flange by the drawing, mm; it is fitted."""
STEP = 1e-3
"""Of a start standard deviation, for derivatives of poses."""


@dataclass(frozen=True)
class Tracked:
    """What the tracker saw in one run: joint values (N, n) and points (N, 3; mm)."""

    joints: np.ndarray
    points: np.ndarray

    def fitted(self, poses: np.ndarray) -> tuple[float, np.ndarray]:
        """Distance (mm RMS) of poses (N, 4, 4) with their best reflector and station, and that reflector."""

        def left(reflector: np.ndarray) -> np.ndarray:
            reached = poses[:, :3, :3] @ reflector + poses[:, :3, 3]
            middle, there = reached.mean(axis=0), self.points.mean(axis=0)
            turn, _ = Rotation.align_vectors(self.points - there, reached - middle)
            return np.asarray((turn.apply(reached - middle) + there - self.points).ravel())

        found = least_squares(left, REFLECTOR, x_scale=10.0)
        return math.sqrt(float((found.fun.reshape(-1, 3) ** 2).sum(axis=1).mean())), found.x

    def promised(self, found: Calibrated) -> float:
        """Standard deviation (mm RMS) that a result has of the same, reflector and station fitted."""
        poses = found.predict(self.joints, force=True).poses
        motion, x = found.unjudged.motion, found.unjudged.used_x
        columns = motion.arm.free if isinstance(motion.arm, ArmAlone) else np.arange(x.size)
        reflector = self.fitted(poses)[1]

        def reached(at: np.ndarray) -> np.ndarray:
            moved = found.fit.poses(at, self.joints)
            return (moved[:, :3, :3] @ reflector + moved[:, :3, 3]).ravel()

        slopes = []
        for column in columns:
            step = np.zeros(x.size)
            step[column] = STEP * found.fit.start_std[column]
            slopes.append((reached(x + step) - reached(x - step)) / (2 * step[column]))
        field, places = np.column_stack(slopes), reached(x).reshape(-1, 3)
        free = np.column_stack([rigid_fields(places, places.mean(axis=0)), poses[:, :3, :3].reshape(-1, 3)])
        basis = np.linalg.svd(free, full_matrices=False)[0]
        stds = tip_stds(motion.covariance, field - basis @ (basis.T @ field), motion.off)
        return math.sqrt(float((stds**2).sum(axis=1).mean()))


def tracked(problem: Problem) -> dict[str, Tracked]:
    """The tracker's runs, of an arm of some joints."""
    watched, found = Problem(problem.robot, TrackedPoint(noise_std=0.1)), {}
    for name, file in TRACKED.items():
        rows = watched.read(FOLDER / file)
        found[name] = Tracked(rows.joints, np.column_stack([rows.columns[axis] for axis in "xyz"]))
    return found


@dataclass(frozen=True)
class Trial:
    """Some of the contacts."""

    problem: BoundProblem

    def judge(self, result: Result) -> dict[str, float]:
        """Tracker error and its promise for both runs, and what the verdict was."""
        return {name: float(values[0]) for name, values in result.trace.items()}


@dataclass(frozen=True)
class Touched:
    """Contacts under one prior and one stated noise; each trial has a random part of them."""

    problem: Problem
    held_out: float = HELDOUT

    def trial(self, seed: int) -> Trial:
        """Some of the contacts."""
        return Trial(bind(self.problem, self._contacts.take(split(self._contacts, self.held_out, seed)[0])))

    @cached_property
    def _contacts(self) -> Samples:
        return self.problem.read(FOLDER / CONTACTS)


def drawn(problem: BoundProblem) -> Result:
    """The arm as it was drawn."""
    return _told(problem.problem, None)


def geometry(problem: BoundProblem) -> Result:
    """Geometry as all there is."""
    return _told(problem.problem, "none")


def kit(problem: BoundProblem) -> Result:
    """Effects beside it."""
    return _told(problem.problem, "kit")


def _told(bound: BoundProblem, discrepancy: Literal["kit", "none"] | None) -> Result:
    """The figures of `Trial.judge` in place of a trace; the estimate itself, of more unknowns, stays behind."""
    rows, way = bound.block.samples, discrepancy or "none"
    method = "plane-only" if discrepancy is None else "lm"
    found = calibrate(bound.problem, rows, method=method, reference=False, discrepancy=way)
    level = math.nan if discrepancy is None else LEVELS.index(verdict_of(found).level)
    trace = {"level": level, "corrected": len(found.corrected)}
    for name, seen in tracked(bound.problem).items():
        # refused results too are judged
        poses = found.predict(seen.joints, nominal=discrepancy is None, force=True).poses
        trace[name] = seen.fitted(poses)[0]
        trace[f"promised_{name}"] = math.nan if discrepancy is None else seen.promised(found)
    kept = {name: np.array([value], dtype=np.float64) for name, value in trace.items()}
    return dataclasses.replace(found.result, problem=bound, x=bound.x0.copy(), information=None, trace=kept)


def settings() -> dict[str, Touched]:
    """Both priors with both noises."""
    problem = load_problem(PROBLEMS / "motoman_ma1400").problem
    found = {}
    for words, prior in ((SHIPPED, problem), (DEFAULT, alike(problem, 0.7, 1e-3))):
        for noise in NOISES:
            stated = Problem(prior.robot, dataclasses.replace(prior.instrument, noise_std=noise))
            found[f"{words}; stated noise {noise:g} mm"] = Touched(stated)
    return found


BEFORE, ALONE, EFFECTS = "as drawn", "geometry alone", "with effects"
METHODS = {BEFORE: Method(drawn), ALONE: Method(geometry), EFFECTS: Method(kit)}
study = Study("real_arm_effects", settings(), METHODS, trials=20, details=0)
few = {name: dataclasses.replace(touched, held_out=0.8) for name, touched in list(settings().items())[:1]}
quick = dataclasses.replace(study, settings=few, trials=1)


def report(run: Run) -> list[str]:
    """Tracker over drawing, and promise over error."""
    draw(run, run.out / "promise.png")
    lines = [
        "# A real arm with what errs beside its geometry",
        "",
        "Motoman MA1400, calibrated by `casacal.calibrate` from its contacts with six plates, and judged by a laser",
        f"tracker that no fit has seen. Each of {run.study.trials} trials has a random 70 % of the 552 contacts; the",
        "figures are means over these, with the interval of the mean. *Over drawing*: distance of the tracker's points",
        "from where `predict` puts them, RMS, with reflector and station fitted, over that of the arm as drawn.",
        "*Promised over actual*: what the result itself expects of these distances, over what they are. *Corrected*:",
        "trials in which an effect was corrected. *Levels*: calibrated, use with care, do not use; figures stand",
        "whatever the verdict.",
        "",
        "Simulated arms and contacts alone settle how effects are sized and corrected. But whoever wrote these rules",
        "knew what the tracker said of earlier ones: this set is no blind test.",
        "",
        "![promise and error](promise.png)",
        "",
    ]
    for setting in run.study.settings:
        rows = []
        for method in (ALONE, EFFECTS):
            cells: list[object] = [method]
            for name in TRACKED:
                ratio = run.values(setting, method, name) / run.values(setting, BEFORE, name)
                promise = run.values(setting, method, f"promised_{name}") / run.values(setting, method, name)
                cells += [mean_interval(ratio), mean_interval(promise)]
            level, corrected = (run.values(setting, method, name) for name in ("level", "corrected"))
            levels = " / ".join(str(int((level == k).sum())) for k in range(len(LEVELS)))
            rows.append((*cells, int((corrected > 0).sum()), levels))
        header = ("way", "free: over drawing", "promised over actual", "wall: over drawing", "promised over actual",
                  "corrected", "levels")  # fmt: skip
        lines += [f"## {setting}", "", *table(header, rows), ""]
    return lines[:-1]


def draw(run: Run, path: Path) -> None:
    """Error over that of the drawing against promised over actual, each trial a point."""
    made = figure(9, 3.6)
    for axes, name in zip(made.subplots(1, 2, sharey=True), TRACKED, strict=True):
        for way, colour in zip((ALONE, EFFECTS), palette(2), strict=True):
            for setting in run.study.settings:
                ratio = run.values(setting, way, name) / run.values(setting, BEFORE, name)
                promise = run.values(setting, way, f"promised_{name}") / run.values(setting, way, name)
                axes.plot(ratio, promise, "o" if setting.startswith(SHIPPED) else "x", color=colour, ms=5)
            axes.plot([], [], "s", color=colour, label=way)
        axes.axvline(1, color="0.6", lw=0.8)
        axes.axhline(1, color="0.6", lw=0.8)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel(f"tracker error over drawing, {name.split('_')[1]}")
    made.axes[0].set_ylabel("promised over actual")
    made.axes[-1].legend(frameon=False, fontsize=8, title="o shipped, x default prior", title_fontsize=8)
    save(made, path)


if __name__ == "__main__":
    script(__file__)
