"""What moves the tip: the geometry, and effects beside it that are corrected or only counted as errors."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from casacal.effects.selection import MOST_ROWS, VERY_STRONG, at_most, gains, in_sample_gains
from casacal.effects.trusted import TrustedConstants
from casacal.fit.arm_alone import ArmAlone, ArmProblem, moving
from casacal.fit.bound_problem import BoundProblem
from casacal.fit.least_squares import Conditioned, Result
from casacal.fit.lm import lm
from casacal.model.term import Site
from casacal.uncertainty.tip_error import expected_accuracy, tip_stds, without_rigid, workspace_joints
from casacal.values import Array, FrozenMapping, Value
from casacal.wording import listed

SMALLEST = 1e-2
"""Part of the largest move, in prior standard deviations, below which geometry is not asked to mimic an effect: last
link against tool, for one, which the tip hardly sees, would go a metre to gain a micrometre."""


@dataclass(frozen=True, eq=False)
class Motion:
    """The tip of a fitted arm as it is used, and what is known of it.

    arm: with s unknowns. x: those of the arm as used (s,). off: by how much the estimate is elsewhere (s,), which is an
    error of the tip; None where it is nowhere else. covariance: of the estimate (s, s).
    """

    arm: ArmProblem
    x: Array
    off: Array | None
    covariance: Array

    @staticmethod
    def of(fit: BoundProblem, result: Result, used: Array, corrected: Collection[str] = ()) -> Motion:
        """Motion of a fit whose arm is used at `used` (n,); corrected effects that are in doubt count as errors too."""
        # something else may be the cause of an effect at the largest accepted size; but where rows see the tip itself,
        # a correction brings it nearer whatever it is
        large = at_most(fit) if corrected and not sees_the_tip(fit) else ()
        doubted = {effect.key for effect in large} & set(corrected)
        sure = used_arm(fit, result, set(corrected) - doubted) if doubted else used
        arm, estimate = moving(fit, result.x)
        x, less = (each[arm.free] if isinstance(arm, ArmAlone) else each for each in (used, sure))
        off = estimate - less
        return Motion(arm, x, off if off.any() else None, among(result, arm))


def used_arm(fit: BoundProblem, result: Result, corrected: Collection[str]) -> Array:
    """Unknowns (n,) of the arm as it is used: effects that are not corrected at zero, geometry in their place.

    What an effect does to the tip over the workspace is expected of the arm as much as anything else. Where nobody
    corrects it, parameters take over what they can mimic of it, in the least squares of the tip; faces follow. Rows
    that saw the tip itself count as much as the workspace: they are where the arm works.
    """
    stands = {"", TrustedConstants.key, *corrected}  # constants of the instrument err alike at every posture
    left = np.array([key not in stands for key in fit.beside], dtype=bool)
    if not left.any():
        return result.x
    arm, x = moving(fit, result.x)
    assert isinstance(arm, ArmAlone)
    # columns of the rows count as unknown: no geometry can stand for what an effect does by them
    joints, everything = workspace_joints(fit.problem.robot), arm.expand(x)
    tips = np.asarray(fit.blocks[0].posture("tip", everything, joints, usual=False)[0])
    field = without_rigid(fit.tip_jacobian(everything, joints, 0, arm.free, usual=False), tips) / math.sqrt(len(joints))
    if sees_the_tip(fit):  # freed of station poses
        some = fit.thinned(MOST_ROWS)
        slopes = some.jacobian(result.x) * float(np.median(some.noise[some.leading]))
        stations = slopes[:, fit.datum]
        slopes -= stations @ np.linalg.lstsq(stations, slopes, rcond=None)[0]
        field = np.vstack([field, (slopes / math.sqrt(len(some.measured)))[:, arm.free]])
    geometry = ~np.array([bool(key) for key in effect_keys(arm)], dtype=bool) & ~arm.datum
    lost = field[:, left[arm.free]] @ x[left[arm.free]]
    moves = np.linalg.lstsq(field[:, geometry] * arm.start_std[geometry], lost, rcond=SMALLEST)[0]
    used = np.where(left, 0.0, result.x)
    used[arm.free[geometry]] += moves * arm.start_std[geometry]
    used = fit.feasible(used)
    faces = Conditioned(fit, fit.datum, used)
    return np.asarray(faces.expand(lm(faces, start=used[fit.datum]).x))


def sees_the_tip(fit: BoundProblem) -> bool:
    """Whether every row measures the tip itself, all three axes."""
    return all(instrument.words.accuracy for instrument in fit.problem.instruments)


def effect_keys(arm: ArmProblem) -> tuple[str, ...]:
    """Key of the effect that each unknown belongs to; empty for those of the geometry."""
    return tuple(arm.whole.beside[j] for j in arm.free) if isinstance(arm, ArmAlone) else arm.beside


def among(result: Result, arm: ArmProblem) -> Array:
    """Covariance (s, s) of some unknowns of a fit."""
    return result.covariance[np.ix_(arm.free, arm.free)] if isinstance(arm, ArmAlone) else result.covariance


def tip_extremes(motion: Motion, workspace: tuple[Array, Array, Array]) -> tuple[float, float]:
    """Largest move of the tip from nominal, and its largest predicted standard deviation, over the workspace, mm.

    Both apart from the position of the base; the three axes together. Of joint values, tips and slopes there.
    """
    joints, tips, slopes = workspace
    moved = without_rigid((tips - motion.arm.tips(motion.arm.x0, joints)).ravel(), tips).reshape(-1, 3)
    stds = tip_stds(motion.covariance, without_rigid(slopes, tips), motion.off)
    return float(np.linalg.norm(moved, axis=1).max()), float(np.linalg.norm(stds, axis=1).max())


def chance_worse(motion: Motion, workspace: tuple[Array, Array, Array]) -> float:
    """Chance that the tip errs more over the workspace, by its RMS, than as drawn; of the same arguments.

    Where it errs by e ~ N(0, H S H') and was moved by m, it erred by e - m before: |e - m| < |e| where m'e > m'm / 2.
    """
    joints, tips, slopes = workspace
    moved = without_rigid((tips - motion.arm.tips(motion.arm.x0, joints)).ravel(), tips)
    along = without_rigid(slopes, tips).T @ moved
    covariance = np.where(np.isfinite(motion.covariance), motion.covariance, 0.0)  # of what no tip sees, if any
    spread = math.sqrt(along @ covariance @ along + (0.0 if motion.off is None else along @ motion.off) ** 2)
    return math.erfc(float(moved @ moved) / (math.sqrt(8) * spread)) / 2 if spread > 0 else 0.0


@dataclass(frozen=True, eq=False)
class Tried(Value):
    """An effect that could be corrected, and what became of it.

    evidence: gain in log likelihood of the fitted rows. unseen: the same of held-out rows, by what was held out
    together; empty where the evidence was too small. helps: whether the expected tip error falls with it; None where
    that was not computed. further: columns of a file that drive it.
    """

    key: str
    words: str
    evidence: float
    unseen: Mapping[str, float]
    helps: bool | None
    further: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "unseen", FrozenMapping(self.unseen))

    @property
    def corrected(self) -> bool:
        """Whether `predict` and all that follows it correct it; row by row where columns drive it."""
        return bool(self.helps)

    @property
    def told(self) -> bool:
        """Whether columns of the rows drive its correction; rows without them take their means in the fitted rows."""
        return self.corrected and bool(self.further)

    @property
    def became(self) -> str:
        """Whether an effect was corrected, and why, as a clause."""
        splits = ", ".join(f"{name} {gain:+.1f}" for name, gain in self.unseen.items())
        became = "corrected" if self.corrected else "not corrected"
        if self.told:
            became = f"corrected by {listed(self.further)}"
        least = f"at least {VERY_STRONG:+g} each required"
        outcome = f"{self.words}, {became}: log likelihood of held-out rows {splits} ({least})"
        return outcome if self.helps or self.helps is None else f"{outcome}, but no gain at the tip"


def tried_corrections(fit: BoundProblem, result: Result) -> tuple[Tried, ...]:
    """Every effect of a fit that moves the tip alike whenever it comes to a posture, the most telling first.

    After them those that columns of the rows tell, on top of what is corrected: they can be where rows have these.

    One is corrected where all splits of the rows, by faces, regions of postures and further columns, say with very
    strong evidence that it tells of rows it has not seen, and where the tip is then expected to be nearer. Corrections
    that stand already count. A gear that would have to be broken to be so bad is none: something else errs. Where rows
    see the tip itself, what tells of unseen ones corrects it, whatever it is.
    """
    sites = [Site(fit.problem.robot, instrument) for instrument in fit.problem.instruments]
    known = {
        effect.key: effect
        for effect in fit.problem.terms
        if effect.moves
        and effect.key in fit.beside
        and (effect.further or not any(effect.columns(site) for site in sites))
    }
    if not known or not result.converged:
        return ()
    evidence = in_sample_gains(fit, result.x, known)
    likely = [key for key in known if evidence[key] > VERY_STRONG]
    unseen = gains(fit, result.x, likely) if likely else {}
    doubted = () if not likely or sees_the_tip(fit) else at_most(fit)
    doubtful = {effect.key for effect in doubted if not effect.elastic}
    stands: list[str] = []
    found = []
    for key in sorted(known, key=lambda key: (bool(known[key].further), -evidence[key])):
        elsewhere = unseen.get(key, {})
        wins = bool(elsewhere) and min(elsewhere.values()) > VERY_STRONG and key not in doubtful
        errors = (tip_error(fit, result, keys, usual=bool(known[key].further)) for keys in ([*stands, key], stands))
        helps = next(errors) < next(errors) if wins else None
        stands += [key] if helps else []
        found.append(Tried(key, known[key].words, evidence[key], elsewhere, helps, known[key].further))
    return tuple(found)


def tip_error(fit: BoundProblem, result: Result, corrected: Collection[str], *, usual: bool = True) -> float:
    """Tip error (mm RMS) to expect over the workspace where these effects are corrected.

    With all that effects do where columns that rows tell are as large as in the fitted rows; without `usual` apart from
    that, which is no matter of postures.
    """
    motion = Motion.of(fit, result, used_arm(fit, result, corrected))
    return expected_accuracy(motion.arm, motion.x, motion.off, usual=usual)[1]
