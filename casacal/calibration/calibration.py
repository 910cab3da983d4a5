"""A calibration as a value: the fit, what it is compared with, and every figure that follows from them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from casacal.array_types import Array
from casacal.binding.marginal import Marginal, Seen, seen
from casacal.calibration.fitted import MINIMISERS, Fitted
from casacal.calibration.motion import Motion, among, used_arm
from casacal.calibration.sensitivity import Sensitivity, sensitivity
from casacal.checks import Finding
from casacal.checks.numbers import wrong_scale
from casacal.checks.several import not_the_same
from casacal.estimators import lm
from casacal.least_squares.linalg import posterior_covariance
from casacal.least_squares.result import Result
from casacal.planning.cures import Cure, cure_for, cures
from casacal.uncertainty.beside_geometry import DialError, EffectSize, dial_errors, effect_sizes_of
from casacal.uncertainty.discrepancy import errors_are_shared
from casacal.uncertainty.expectation import classical_accuracy, expected_accuracy
from casacal.uncertainty.identifiability import (
    Identifiability,
    NullDirection,
    WeakDirection,
    identifiability,
    known_from,
)
from casacal.uncertainty.noise import noise_over_stated
from casacal.uncertainty.prior_moves import PriorMoves, prior_moves
from casacal.uncertainty.workspace import tip_rms, tip_stds, tool_unknowns, without_rigid, workspace_joints

HARMLESS = 0.01  # tip motion (mm under the prior) below which an unseen direction needs no cure
FAR = 4.0  # prior standard deviations beyond which a parameter has moved too far: one clean arm in several hundred does
LACK_OF_FIT = 2.0  # found over stated noise beyond which something systematic is wrong, as `check` judges it
PART = 0.5  # tip error with a tool that is exactly known over that as it is, below which the tool decides most of it

NOT_NEEDED = "none needed"


@dataclass(frozen=True)
class HiddenTool:
    """Coordinates of the tool that the samples hardly show and that decide most of the tip error.

    std_mm: of the least known. tip_mm: the tip error to expect were the tool's point exactly known.
    """

    names: tuple[str, ...]
    std_mm: float
    tip_mm: float


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Fitted):
    """A calibrated robot: the fit, and every figure of the arm that follows from it."""

    @property
    def unjudged(self) -> Calibration:
        """The calibration whose figures are all there, whatever the verdict says of them."""
        return self

    @cached_property
    def seen(self) -> Seen:
        """What figures of the arm are worked out from: the fit, apart from what single labels have for themselves."""
        return seen(self.fit, self.result.x)[0]

    @cached_property
    def seen_x(self) -> Array:
        """The estimate of its unknowns (s,)."""
        return seen(self.fit, self.result.x)[1]

    @property
    def std(self) -> Array:
        """Standard deviations (n,) of the unknowns, mm and rad."""
        return self.result.std

    @property
    def covariance(self) -> Array:
        """Covariance of its unknowns (s, s); infinite variances where neither data nor prior hold one."""
        return among(self.result, self.seen)

    @cached_property
    def motion(self) -> Motion:
        """All that moves the tip: geometry, and effects beside it."""
        return Motion.of(self.fit, self.result, self.used_x, self.corrected)

    @cached_property
    def workspace(self) -> tuple[Array, Array, Array]:
        """Joint values, tips and tip Jacobian at the estimate over fixed workspace poses that no sample visited."""
        joints = workspace_joints(self.fit.problem.robot)
        arm, x = self.motion.arm, self.motion.x
        return joints, arm.tips(x, joints), arm.tip_jacobian(x, joints)

    @cached_property
    def tip_std(self) -> tuple[float, float]:
        """Tip error to expect, mm RMS over the workspace, apart from the position of the base: from priors, and now.

        An estimate that is not the minimum errs by what the posterior allows there, and by its own way to the minimum.
        """
        before, now = self._expected()
        return before, math.hypot(now, self.tip_from_minimum)

    @cached_property
    def flange_std(self) -> tuple[float, float]:
        """The same of the flange's origin, whatever tool it carries.

        NaN now where the estimate is not the minimum, and where the tool stands elsewhere than the problem says: what
        the samples see is the tip, and how much of the difference is the tool's, how much the arm's, nobody knows then.
        """
        before, now = self._expected(flange=True)
        return before, now if self.method in MINIMISERS and not self.tool_findings else math.nan

    def _expected(self, *, flange: bool = False) -> tuple[float, float]:
        motion, robust = self.motion, self.result.loss is not None
        covariance = motion.covariance if robust else None
        return expected_accuracy(motion.arm, motion.x, motion.off, flange=flange, covariance=covariance)

    @cached_property
    def hidden_tool(self) -> HiddenTool | None:
        """What of the tool is not known and decides most of the tip error; None where the arm itself decides it."""
        if not (math.isfinite(self.tip_std[1]) and math.isfinite(self.flange_std[1])):
            return None
        motion, (_, tips, slopes) = self.motion, self.workspace
        arm, covariance = motion.arm, motion.covariance
        stds = np.sqrt(np.diagonal(covariance))
        tool = np.array([j for j in tool_unknowns(arm, motion.x) if arm.units[j] == "mm"], dtype=int)
        hidden = [j for j in tool if known_from(stds[j], float(arm.prior_std[j])) != "samples"]
        if not hidden:
            return None
        with_tool = covariance[tool]
        known = covariance - with_tool.T @ np.linalg.solve(with_tool[:, tool], with_tool)
        field = without_rigid(slopes, tips)
        now, tip = (tip_rms(tip_stds(each, field, motion.off).ravel()) for each in (covariance, known))
        names, std = tuple(arm.names[j] for j in hidden), float(stds[hidden].max())
        return HiddenTool(names, std, tip) if tip < PART * now else None

    @cached_property
    def tip_from_minimum(self) -> float:
        """How far the tip stands from where the minimum puts it, mm RMS over the workspace, apart from the base."""
        if self.method in MINIMISERS:
            return 0.0
        joints, tips, _ = self.workspace
        least = lm(self.fit, start=self.result.x, loss=self.result.loss)
        if not least.converged:
            least = lm(self.fit, loss=self.result.loss)
        arm = self.motion.arm
        x = Motion.of(self.fit, least, used_arm(self.fit, least, self.corrected)).x
        return tip_rms(without_rigid((tips - arm.tips(x, joints)).ravel(), tips))

    @cached_property
    def tip_std_without_prior(self) -> tuple[float, int]:
        """The same from the samples alone, and how many directions that move the tip they miss (then infinite)."""
        return classical_accuracy(self.seen, self.seen_x)

    @cached_property
    def identifiability(self) -> Identifiability:
        """Rank, null and weak directions of arm and touches as drawn: at the nominal.

        All that says how large something is, tip errors, verdicts on parameters, cures and what they do to these
        directions, is worked out at the estimate. Rank cannot be: what the drawing hides exactly, by axes that are
        parallel or a plate that is level, an estimate hides but for its own corrections, so that at a tolerance of
        1e-9 rounding would decide it, and no two runs could be compared. `structural` says what stays hidden.
        """
        joints, (drawn, x0) = workspace_joints(self.fit.problem.robot), seen(self.bare, self.bare.x0)
        return identifiability(drawn, drawn.tip_jacobian(x0, joints), drawn.tips(x0, joints))

    @cached_property
    def cures(self) -> tuple[Cure, ...]:
        """What to do next, best first: 24 planned touches each (60 of the same kind too), and the tip error after them.

        Worked out when asked for, in about a second. Figures compare with `tip_std`, and mean as little where the
        verdict is not to use this result. Touches tell geometry; what else errs, and an estimate's way to the minimum,
        stays.
        """
        geometry, x = seen(self.weighed, self.bare_x)
        stays = self.tip_std[1] ** 2 - expected_accuracy(geometry, x)[1] ** 2
        return cures(self.weighed, self.bare_x, stays=max(stays, 0.0) if math.isfinite(stays) else 0.0)

    @cached_property
    def advice(self) -> tuple[str, ...]:
        """What lowers each null, then each weak direction, in the words of `cures`; none needed if it moves no tip."""
        found = self.identifiability
        directions: tuple[NullDirection | WeakDirection, ...] = (*found.null, *found.weak)
        if all(direction.tip_mm < HARMLESS for direction in directions):
            return (NOT_NEEDED,) * len(directions)
        geometry, x = seen(self.weighed, self.bare_x)
        now = posterior_covariance(geometry.information(x), geometry.prior_std)
        return tuple(
            NOT_NEEDED if direction.tip_mm < HARMLESS else cure_for(geometry, now, self.cures, direction)
            for direction in directions
        )

    @cached_property
    def sensitivity(self) -> Sensitivity:
        """How estimate and tip follow every reading and prior; raises CasacalError where it is no minimum."""
        (_, tips, slopes), arm = self.workspace, self.motion.arm
        field = np.zeros((tips.size, self.fit.unknowns))
        field[:, arm.free if isinstance(arm, Marginal) else slice(None)] = without_rigid(slopes, tips)
        return sensitivity(self.fit, self.result, field)

    @cached_property
    def effect_sizes(self) -> tuple[EffectSize, ...]:
        """What arm and cell do beside their geometry, the likeliest first; none where that was not asked for."""
        return effect_sizes_of(self.fit, self.result.x)

    @cached_property
    def dial_errors(self) -> tuple[DialError, ...]:
        """Whether the rows show an error of the dial that nobody declared; none where effects were not asked for."""
        return dial_errors(self.fit, self.result.x) if any(self.fit.beside) else ()

    @cached_property
    def prior_moves(self) -> PriorMoves:
        """How far arm and tool moved beyond what their priors allow, all together."""
        return prior_moves(self.seen, self.seen_x, self.covariance)

    @cached_property
    def instrument_findings(self) -> tuple[Finding, ...]:
        """That what instruments share is not the same, or that their scale is wrong and the tip with it."""
        if not self.result.converged:
            return ()
        shared = not_the_same(self.fit, self.result) if self.fit.problem.shared else []
        return (*shared, *wrong_scale(self.seen, self.seen_x, self.covariance))

    @property
    def moves(self) -> Array:
        """How far each unknown (n,) moved from its nominal, in prior standard deviations; 0 under a flat prior.

        As far as it moves under geometry alone, if that is farther: effects beside it may explain a fault away, but
        they have sizes and no nominal, and do not count themselves. Where what rows err by together is what was stated
        as their noise, geometry alone takes them for more than they are, and does not count.
        """
        moved, effects = _moves(self.result), np.array(self.fit.beside, dtype=bool)
        moved[effects] = 0.0
        if effects.any() and self.plain.converged and not errors_are_shared(self.fit):
            moved[~effects] = np.fmax(moved[~effects], _moves(self.plain))
        return moved

    @property
    def suspicious(self) -> bool:
        """Whether something about the fit calls for a look at the samples themselves: then the data check is asked."""
        # a robust fit has already set aside the rows that pull parameters far
        far = self.result.loss is None and bool((_moves(self.plain) > FAR).any())
        low = max(self.noise.low, noise_over_stated(self.plain).low)
        return far or not self.passed or low > LACK_OF_FIT


def _moves(result: Result) -> Array:
    return np.asarray(np.abs(result.x - result.problem.x0) / result.problem.prior_std)
