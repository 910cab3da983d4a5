"""A calibration as a value: the fit, what it is compared with, and every figure that follows from them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.binding.further import extended
from casacal.binding.marginal import Seen, seen
from casacal.calibration.reference import Reference
from casacal.checks import Finding, check
from casacal.checks.dial_sign import sign_before_fit
from casacal.checks.numbers import wrong_number
from casacal.checks.rows import outside, rounded
from casacal.checks.tool import tool_elsewhere_at
from casacal.estimators import lm
from casacal.least_squares.linalg import posterior_covariance
from casacal.least_squares.result import Result
from casacal.problem.problem_file import ProblemFile
from casacal.samples.repeats import copies_of
from casacal.samples.samples import Samples
from casacal.uncertainty.cures import Cure, cure_for, cures
from casacal.uncertainty.expectation import classical_accuracy, expected_accuracy
from casacal.uncertainty.figures import HALF_WEIGHT, residual_figures
from casacal.uncertainty.flange import flange_accuracy
from casacal.uncertainty.identifiability import (
    Identifiability,
    NullDirection,
    WeakDirection,
    identifiability,
)
from casacal.uncertainty.left_out import LeftOut, leave_one_face_out
from casacal.uncertainty.noise import Noise, noise_over_stated
from casacal.uncertainty.prior_moves import PriorMoves, prior_moves
from casacal.uncertainty.workspace import tip_rms, without_rigid, workspace_joints
from casacal.values import FrozenMapping, Value

MINIMISERS = ("lm", "sckf-lm", "ipopt")
"""Methods that promise the minimum; filters and controls may honestly miss it."""

HARMLESS = 0.01
"""Tip motion (mm under the prior) below which an unseen direction needs no cure."""

NOT_NEEDED = "none needed"


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Value):
    """A calibrated robot: the fit, the rows held out, the arm before, the reference, and where the time went."""

    method: str
    seed: int
    samples: Samples
    fit: BoundProblem
    heldout: BoundProblem | None
    result: Result
    before: Result
    reference: Reference | None
    seconds: Mapping[str, float]
    source: ProblemFile
    """The problem as it was given: its file, where it has one."""
    aside: tuple[Finding, ...] = ()
    """What is wrong with the rows that were set aside, with their lines."""
    heldout_by: str = "rows"
    """What was held out together: rows, region, face, or the name of a column."""

    def __eq__(self, other: object) -> bool:
        """Whether all but the time taken is equal."""
        if self is other or not isinstance(other, Calibration):
            return self is other
        return super().__eq__(replace(other, seconds=self.seconds))

    def __hash__(self) -> int:
        return hash((self.method, self.seed, self.fit))

    def __post_init__(self) -> None:
        object.__setattr__(self, "seconds", FrozenMapping(self.seconds))

    @property
    def unjudged(self) -> Calibration:
        """The calibration whose figures are all there, whatever the verdict says of them."""
        return self

    @property
    def passed(self) -> bool:
        """Whether the method converged and, where it promises the minimum, the reference agrees."""
        if not self.result.converged:
            return False
        return self.reference is None or self.method not in MINIMISERS or self.reference.agrees

    @property
    def aside_lines(self) -> tuple[int, ...]:
        """Lines of the rows that were set aside."""
        return tuple(sorted({line for found in self.aside for line in found.lines}))

    @cached_property
    def noise(self) -> Noise:
        """Noise over what was stated, as this result's residuals show it, and the factors with which it was used."""
        return noise_over_stated(self.result)

    @cached_property
    def copies(self) -> int:
        """Rows that are copies of an earlier one, to the last digit, and so neither fitted nor held out."""
        return int(copies_of(self.samples).sum())

    @property
    def noise_words(self) -> str:
        """Which noise every figure uses: what was stated, or what the rows showed."""
        return "noise as found" if self.noise.scale else "stated noise"

    @cached_property
    def heldout_x(self) -> tuple[Array, Array]:
        """Unknowns of the held-out rows, before and after; faces that were not fitted stand where their rows say."""
        before, after = self.before.x, self.result.x
        if self.heldout is None:
            return before, after
        return extended(self.heldout, before), extended(self.heldout, after)

    @cached_property
    def left_out(self) -> tuple[LeftOut, ...]:
        """Each fitted face as the others predict it; a fit for each, and so only when it is asked for."""
        return leave_one_face_out(self.fit, self.result)

    @cached_property
    def metrics(self) -> dict[str, dict[str, dict[str, float] | None]]:
        """Plane residuals in mm, before and after, on fitted and held-out rows; not accuracy."""
        return {
            when: {
                "fit": residual_figures(self.fit.plain_residual(result.x)),
                "heldout": None if self.heldout is None else residual_figures(self.heldout.plain_residual(held)),
            }
            for when, result, held in zip(("before", "after"), (self.before, self.result), self.heldout_x, strict=True)
        }

    @cached_property
    def seen(self) -> Seen:
        """What figures of the arm are worked out from: the fit, apart from what single labels have for themselves."""
        return seen(self.fit, self.result.x)[0]

    @cached_property
    def seen_x(self) -> Array:
        """The estimate of its unknowns (s,)."""
        return seen(self.fit, self.result.x)[1]

    @property
    def covariance(self) -> Array:
        """Covariance of its unknowns (s, s); infinite variances where neither data nor prior hold one."""
        return self.result.spread[0]

    @cached_property
    def workspace(self) -> tuple[Array, Array, Array]:
        """Joint values, tips and tip Jacobian at the estimate over fixed workspace poses that no sample visited."""
        joints = workspace_joints(self.fit.problem.robot)
        return joints, self.seen.tips(self.seen_x, joints), self.seen.tip_jacobian(self.seen_x, joints)

    @cached_property
    def tip_std(self) -> tuple[float, float]:
        """Tip error to expect, mm RMS over the workspace, apart from where the base stands: from priors, and now.

        An estimate that is not the minimum errs by what the posterior allows there, and by its own way to the minimum.
        """
        before, now = expected_accuracy(self.seen, self.seen_x)
        return before, math.hypot(now, self.tip_from_minimum)

    @cached_property
    def flange_std(self) -> tuple[float, float]:
        """The same of the flange's origin, whatever tool it carries.

        NaN now where the estimate is not the minimum, and where the tool stands elsewhere than the problem says: what
        the samples see is the tip, and how much of the difference is the tool's, how much the arm's, nobody knows then.
        """
        before, now = flange_accuracy(self.seen, self.seen_x)
        return before, now if self.method in MINIMISERS and not self.tool_findings else math.nan

    @cached_property
    def tool_findings(self) -> tuple[Finding, ...]:
        """That the tool stands elsewhere than the problem says, where it does."""
        if self.fit.groups is not None or not self.fit.unknowns:  # thousands of faces are looked at face by face
            return ()
        return tuple(tool_elsewhere_at(self.fit, self.result.x, self.result.spread[0]))

    @cached_property
    def tip_from_minimum(self) -> float:
        """How far the tip stands from where the minimum puts it, mm RMS over the workspace, apart from the base."""
        if self.method in MINIMISERS:
            return 0.0
        joints, tips, _ = self.workspace
        least = lm(self.fit, start=self.result.x, loss=self.result.loss)
        if not least.converged:
            least = lm(self.fit, loss=self.result.loss)
        arm, x = seen(self.fit, least.x)
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
        joints, (drawn, x0) = workspace_joints(self.fit.problem.robot), seen(self.fit, self.fit.x0)
        return identifiability(drawn, drawn.tip_jacobian(x0, joints), drawn.tips(x0, joints))

    @cached_property
    def cures(self) -> tuple[Cure, ...]:
        """What to do next, best first: 24 extra touches each, simulated at the estimate, with the tip error after them.

        Worked out when asked for, in less than a second. Figures compare with `tip_std`, and mean as little where the
        verdict is not to use this result.
        """
        found = cures(self.fit, self.result.x)
        return tuple(
            replace(cure, expected_rms_mm=math.hypot(cure.expected_rms_mm, self.tip_from_minimum)) for cure in found
        )

    @cached_property
    def advice(self) -> tuple[str, ...]:
        """What lowers each null, then each weak direction, in the words of `cures`; none needed if it moves no tip."""
        found = self.identifiability
        directions: tuple[NullDirection | WeakDirection, ...] = (*found.null, *found.weak)
        if all(direction.tip_mm < HARMLESS for direction in directions):
            return (NOT_NEEDED,) * len(directions)
        now = posterior_covariance(self.seen.information(self.seen_x), self.seen.prior_std)
        return tuple(
            NOT_NEEDED if direction.tip_mm < HARMLESS else cure_for(self.seen, now, self.cures, direction)
            for direction in directions
        )

    @cached_property
    def down_weighted(self) -> tuple[int, ...]:
        """Lines of the rows that a robust loss gave less than half of their weight."""
        if self.result.loss is None:
            return ()
        samples = self.fit.block.samples
        per_row = self.fit.rows // len(samples)
        low = np.flatnonzero(self.result.weights < HALF_WEIGHT).tolist()
        return tuple(dict.fromkeys(samples.lines[k // per_row] for k in low))

    @cached_property
    def prior_moves(self) -> PriorMoves:
        """How far arm and tool moved beyond what their priors allow, all together."""
        return prior_moves(self.seen, self.seen_x, self.covariance)

    @cached_property
    def data_errors(self) -> tuple[Finding, ...]:
        """Errors that the whole data check finds in the rows that were fitted; it takes many fits."""
        found = check(self.fit.problem, self.fit.block.samples)
        return tuple(each for each in found if each.severity == "error")

    @cached_property
    def plain_errors(self) -> tuple[Finding, ...]:
        """Errors that need few fits or none: travel, limits, rounding, the dial's sign, a number of the arm."""
        found = [*outside(self.fit.problem, self.fit.block.samples), *rounded(self.fit), *sign_before_fit(self.fit)]
        if self.result.loss is None:
            found += wrong_number(self.fit)
        return tuple(each for each in found if each.severity == "error")
