"""A calibration as a value: the fit, figures and findings on its rows, and every figure that follows from it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from casacal.calibration.before_fit import outside, rounded, sign_before_fit
from casacal.calibration.finding import Finding
from casacal.calibration.inputs import Reference
from casacal.calibration.mirror import either_way, mirror_image
from casacal.calibration.motion import Motion, Sensitivity, Tried, among, sees_the_tip, sensitivity, used_arm
from casacal.calibration.numbers import borne_out, priors_of, tool_elsewhere_at, wrong_number, wrong_scale
from casacal.data.repeats import without_copies
from casacal.data.samples import Measurements, Samples
from casacal.deployment.result import MirrorImage
from casacal.effects import selection
from casacal.effects.trusted import Leverage, TrustedConstants, beyond, leverages, with_constants
from casacal.errors import CasacalError
from casacal.fit.arm_alone import ArmAlone, ArmProblem, arm_alone, extended
from casacal.fit.bound_problem import BoundProblem, bind, each_alone
from casacal.fit.least_squares import Result
from casacal.fit.lm import lm
from casacal.fit.methods import minimises
from casacal.model.problem_file import ProblemFile
from casacal.planning.cures import Cure, cure_for, cures
from casacal.uncertainty import tip_error
from casacal.uncertainty.figures import HALF_WEIGHT, residual_figures
from casacal.uncertainty.identifiability import Identifiability, identifiability, known_from
from casacal.uncertainty.moves import PriorMoves, prior_moves
from casacal.uncertainty.noise import Noise, noise_over_stated
from casacal.values import Array, Box, FrozenMapping, Value
from casacal.wording import listed

if TYPE_CHECKING:
    from casacal.calibration.earlier import EarlierResult

HARMLESS = 0.01  # tip motion (mm under the prior) below which an unseen direction needs no cure
FAR = 4.0  # prior standard deviations beyond which a parameter has moved too far: one clean arm in several hundred does
LACK_OF_FIT = 2.0  # found over stated noise beyond which something systematic is wrong, as `check` judges it
PART = 0.5  # tip error with a tool that is exactly known over that as it is, below which the tool decides most of it
NOT_NEEDED = "none needed"
Figures: TypeAlias = dict[str, float]
Metrics: TypeAlias = dict[str, dict[str, Figures | None]]
"""Keys "before" and "after", then "fit" and "heldout"; None where no row is held out."""


def parts_of(fit: BoundProblem) -> dict[str, str]:
    """The unit of each of several instruments and of each block of a residual, by the name of its noise; else none."""
    problem = fit.problem
    if len(problem.instruments) == 1 and not problem.instruments[0].blocks:
        return {}
    found: dict[str, str] = {}
    for name, instrument in zip(problem.names, problem.instruments, strict=True):
        before = f"{name} " if len(problem.instruments) > 1 else ""
        blocks = {f"{before}{block.name}": block.unit for block in instrument.blocks}
        found |= blocks or {name: instrument.words.unit}
    return found


@dataclass(frozen=True)
class HiddenTool:
    """Poorly observed tool coordinates that account for most of the tip error.

    std_mm: of the least known. tip_mm: the tip error to expect were the tool's point exactly known.
    """

    names: tuple[str, ...]
    std_mm: float
    tip_mm: float


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Value):
    """A calibrated robot: the fit, the rows held out, the arm before, the reference, where the time went; and figures.

    First what the rows say: which were set aside, held out or copied, their noise, what is wrong with them; then what
    follows of the arm.
    """

    method: str
    seed: int
    samples: Samples | Measurements
    """As they were given, of one instrument or of several."""
    fit: BoundProblem
    heldout: BoundProblem | None
    result: Result
    before: Result
    reference: Reference | None
    seconds: Mapping[str, float]
    source: ProblemFile
    """The problem as it was given: its file, where it has one."""
    aside: tuple[Finding, ...] = ()
    """Findings on the rows that were set aside, with their lines."""
    heldout_by: str = "rows"
    """Unit of the held-out rows: rows, region, face, or the name of a column."""
    tried: tuple[Tried, ...] = ()
    """Effects beside the geometry that could be corrected, and which are."""
    geometry: BoundProblem | None = None
    """The fitted rows under the geometry alone, with the noise found under it; None where that is `fit`.

    What is wrong with the samples is looked for there: effects would explain part of it away."""
    earlier: EarlierResult | None = None
    """The result that was known before these rows; None where the drawing was."""

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
    def corrected(self) -> tuple[str, ...]:
        """Keys of the effects beside the geometry that are corrected; others count as errors."""
        return tuple(each.key for each in self.tried if each.corrected)

    @property
    def told(self) -> tuple[str, ...]:
        """Keys of the corrected effects that columns of the rows drive."""
        return tuple(each.key for each in self.tried if each.told)

    @property
    def passed(self) -> bool:
        """Whether the method converged and, where it promises the minimum, the reference agrees."""
        if not self.result.converged:
            return False
        return self.reference is None or not minimises(self.method) or self.reference.agrees

    @property
    def bare(self) -> BoundProblem:
        """The fitted rows under the geometry alone."""
        return self.fit if self.geometry is None else self.geometry

    @property
    def counts_effects(self) -> bool:
        """Whether effects of the arm are estimated, and not only constants of the instruments."""
        return bool({*self.fit.beside} - {"", TrustedConstants.key})

    @cached_property
    def doubted(self) -> BoundProblem:
        """`bare` with the constants that the instruments take for exact as unknowns.

        Itself where the fit has none of them, or one is farther off than its prior covers, which is a mistake to find.
        """
        if TrustedConstants.key not in self.fit.beside or beyond(self.fit, self.result.x):
            return self.bare
        return self.bare.under(with_constants(self.bare.problem), backend="blocks")  # nothing is worth compiling for it

    @cached_property
    def plain(self) -> Result:
        """The minimum of `doubted`, without effects of the arm: what is wrong with the rows shows there."""
        alike = self.bare is self.fit or self.result.loss is not None  # beside a loss nothing of the arm is estimated
        return self.result if alike else lm(self.doubted)

    @property
    def aside_lines(self) -> tuple[int | str, ...]:
        """Lines of the rows that were set aside; with the instrument's name where there are several."""
        lines = sorted({(found.instrument, line) for found in self.aside for line in found.lines})
        return tuple(f"{name} {line}" if name else line for name, line in lines)

    @cached_property
    def mirror_image(self) -> MirrorImage | None:
        """Conventions that would reflect the arm and fit as well; None where nobody has to ask, or it was settled."""
        if self.source.confirmed:
            return None
        return mirror_image(self.fit) if self.earlier is None else self.earlier.mirror_image

    @cached_property
    def either_way(self) -> bool:
        """Whether the fitted rows leave open in which direction the dial counts."""
        return self.earlier is None and either_way(self.fit)

    @cached_property
    def noise(self) -> Noise:
        """Noise over what was stated, as this result's residuals show it, and the factors with which it was used."""
        return noise_over_stated(self.result)

    @cached_property
    def copies(self) -> int:
        """Rows that say again what another says, copies and lines of one standstill: neither fitted nor held out."""
        return sum(len(some) - len(without_copies(some)) for some in Measurements.of(self.samples).sets)

    @property
    def noise_words(self) -> str:
        """Which noise every figure uses: what was stated, or what the rows showed."""
        return "noise as found" if self.noise.scale else "stated noise"

    @property
    def assumed(self) -> str:
        """Assumptions of every accuracy figure, as a clause: noise, priors, and what readings cannot check.

        A constant with a prior of its own is among them where half of the tip error comes from it.
        """
        noise = "noise as found" if self.noise.scale else "the stated noise"
        found, (_, tip) = self.unjudged.leverages, self.unjudged.tip_std
        known = {each.words for each in found}
        trusted = [each.words.trusted for each in self.fit.problem.instruments if each.words.trusted not in known]
        telling = [each.within for each in found[:1] if each.left_mm > PART * tip]
        way = ["the dial's sign"] if self.either_way else []
        return listed([noise, "priors", *way, *dict.fromkeys(filter(None, trusted)), *telling])

    @cached_property
    def used_x(self) -> Array:
        """Unknowns (n,) of the arm as it is used: the estimate, with effects that are not corrected at zero."""
        return used_arm(self.fit, self.result, self.corrected)

    @cached_property
    def uncorrected_x(self) -> Array:
        """Unknowns (n,) of the arm where nobody can correct an effect, as in a table of lengths and angles."""
        return used_arm(self.fit, self.result, ()) if self.corrected else self.used_x

    @cached_property
    def heldout_x(self) -> tuple[Array, Array]:
        """Unknowns of the held-out rows, before and after; faces that were not fitted stand where their rows say."""
        before, after = self.before.x, self.used_x
        if self.heldout is None:
            return before, after
        return extended(self.heldout, before), extended(self.heldout, after)

    @cached_property
    def earlier_chance(self) -> float:
        """Chance of rows so far from what an earlier result expects of them; one where there is none."""
        if self.earlier is None:
            return 1.0
        arrived = minimises(self.method)  # others end anywhere, which says nothing of the rows
        return self.earlier.chance_of(self.result if arrived else lm(self.fit, start=self.result.x))

    @cached_property
    def left_out(self) -> tuple[selection.LeftOut, ...]:
        """Each fitted face as the others predict it; a fit for each, and so only when it is asked for."""
        return selection.leave_one_face_out(self.fit, self.result)

    @cached_property
    def metrics(self) -> Metrics:
        """Plane residuals in mm, before and after, on fitted and held-out rows; not accuracy."""
        return self._metrics(None)

    @cached_property
    def metrics_by_instrument(self) -> dict[str, Metrics]:
        """`metrics` by instrument and by block of a residual, each in its unit; empty for a single plain instrument."""
        return {part: self._metrics(part) for part in parts_of(self.fit)}

    def _metrics(self, part: str | None) -> Metrics:
        """Residual figures in the instrument's unit, or of one of `parts_of` in its own unit."""

        def figures(bound: BoundProblem | None, x: Array) -> Figures | None:
            if bound is None or part is None:
                return None if bound is None else residual_figures(bound.plain_residual(x)[bound.leading])
            rows = bound.noise_labels.rows().get(part, np.zeros(0, dtype=np.intp))
            return residual_figures(bound.plain_residual(x)[rows]) if rows.size else None

        pairs = zip(("before", "after"), (self.before.x, self.used_x), self.heldout_x, strict=True)
        return {when: {"fit": figures(self.fit, x), "heldout": figures(self.heldout, held)} for when, x, held in pairs}

    @cached_property
    def down_weighted(self) -> tuple[int | str, ...]:
        """Lines of the rows that a robust loss gave less than half of their weight; named as `aside_lines`."""
        if self.result.loss is None:
            return ()
        low = np.unique(self.fit.sample_of[self.result.weights < HALF_WEIGHT]).tolist()
        return tuple(self.fit.measured.place(k) for k in low)

    @cached_property
    def tool_findings(self) -> tuple[Finding, ...]:
        """A warning where the samples put the tool elsewhere than the problem file; otherwise empty."""
        if not self.fit.unknowns or self.earlier is not None:  # the earlier result says where it is
            return ()
        return tuple(tool_elsewhere_at(self.doubted, self.plain.x, self.plain.covariance))

    @cached_property
    def data_errors(self) -> tuple[Finding, ...]:
        """Errors that the whole data check finds in the rows that were fitted; it takes many fits.

        None beside an earlier result, which says better than the drawing what is wrong with so few rows.
        """
        if self.earlier is not None:
            return ()
        from casacal.calibration.check import check

        found = check(self.bare.problem, self.fit.measured.plain)
        return tuple(each for each in found if each.severity == "error")

    @cached_property
    def plain_errors(self) -> tuple[Finding, ...]:
        """Errors that need few fits or none: travel, limits, rounding, the dial's sign, a number of the arm."""
        found = list[Finding]()
        for each in each_alone(self.bare.problem, self.bare.samples):
            try:
                alone = bind(each.problem, each.samples) if each.name else self.bare
            except CasacalError:  # it cannot be bound by itself
                continue
            findings = [*outside(alone.problem, alone.samples[0]), *rounded(alone), *sign_before_fit(alone)]
            found += [replace(one, instrument=each.name) for one in findings]
        if self.result.loss is None and self.earlier is None:
            found += wrong_number(self.doubted, alone=self.fit is self.bare)
        return tuple(each for each in found if each.severity == "error")

    @cached_property
    def borne_out(self) -> frozenset[str]:
        """Numbers of the arm that contradict their priors and, freed, predict regions of postures left out.

        Only where rows measure the tip itself: no fit to faces says that of the tip. They call for a wider prior, and
        are no reason to refuse a calibration.
        """
        if self.earlier is not None or not sees_the_tip(self.fit):
            return frozenset()
        errors = self.data_errors if self.suspicious else self.plain_errors
        named = {error.about.removesuffix(" elsewhere") for error in errors}
        named.add(self.fit.names[int(np.argmax(self.moves))])
        ours = (name for name, *_ in priors_of(self.bare.problem) if name in named)
        return frozenset(name for name in ours if borne_out(self.bare, name))

    @property
    def unjudged(self) -> Calibration:
        """The calibration with every figure, whatever the verdict."""
        return self

    @cached_property
    def seen(self) -> ArmProblem:
        """The fit with the unknowns of single labels (faces, stations) marginalised; figures of the arm rest on it."""
        return arm_alone(self.fit, self.result.x)[0]

    @cached_property
    def seen_x(self) -> Array:
        """Estimate of the unknowns of `seen` (s,)."""
        return arm_alone(self.fit, self.result.x)[1]

    @property
    def std(self) -> Array:
        """Standard deviations (n,) of the unknowns, mm and rad."""
        return self.result.std

    @property
    def covariance(self) -> Array:
        """Covariance (s, s) of the unknowns of `seen`; infinite variances where neither data nor prior hold one."""
        return among(self.result, self.seen)

    @cached_property
    def motion(self) -> Motion:
        """All that moves the tip: geometry, and effects beside it."""
        return Motion.of(self.fit, self.result, self.used_x, self.corrected)

    @cached_property
    def workspace(self) -> tuple[Array, Array, Array]:
        """Joint values, tips and tip Jacobian at the estimate over fixed workspace poses that no sample visited."""
        joints = tip_error.workspace_joints(self.fit.problem.robot)
        arm, x = self.motion.arm, self.motion.x
        return joints, arm.tips(x, joints), arm.tip_jacobian(x, joints)

    @cached_property
    def tip_std(self) -> tuple[float, float]:
        """Tip error to expect, mm RMS over the workspace, apart from the pose of the base: from priors, and now.

        An estimate that is not the minimum errs by what the posterior allows there, and by its own way to the minimum.
        """
        before, now = self._expected()
        return before, math.hypot(now, self.tip_from_minimum)

    @cached_property
    def flange_std(self) -> tuple[float, float]:
        """Expected error (prior, posterior) of the flange's origin, mm RMS, whatever tool it carries.

        NaN now where the estimate is not the minimum, and where the tool stands elsewhere than the problem says: what
        the samples see is the tip, and how much of the difference is the tool's, how much the arm's, nobody knows then.
        """
        before, now = self._expected(flange=True)
        return before, now if minimises(self.method) and not self.tool_findings else math.nan

    def _expected(self, *, flange: bool = False) -> tuple[float, float]:
        motion = self.motion
        return tip_error.expected_accuracy(motion.arm, motion.x, motion.off, flange=flange, covariance=self._robust)

    @property
    def _robust(self) -> Array | None:
        """Covariance (s, s) of the moving unknowns under a loss; None where it is the posterior's."""
        return None if self.result.loss is None else self.motion.covariance

    def tip_std_in(self, box: Box) -> tuple[float, float]:
        """Expected tip error inside a box, mm: RMS, and the largest; CasacalError where the arm hardly reaches it."""
        motion = self.motion
        inside, worst = tip_error.accuracy_in_box(motion.arm, motion.x, box, motion.off, self._robust)
        return math.hypot(inside, self.tip_from_minimum), math.hypot(worst, self.tip_from_minimum)

    @cached_property
    def hidden_tool(self) -> HiddenTool | None:
        """Poorly observed tool coordinates that cause most of the tip error; None where the arm itself causes it."""
        if not (math.isfinite(self.tip_std[1]) and math.isfinite(self.flange_std[1])):
            return None
        motion, (_, tips, slopes) = self.motion, self.workspace
        arm, covariance = motion.arm, motion.covariance
        stds = np.sqrt(np.diagonal(covariance))
        tool = [j for j in tip_error.tool_unknowns(arm, motion.x) if arm.units[j] == "mm" and math.isfinite(stds[j])]
        hidden = [j for j in tool if known_from(stds[j], float(arm.prior_std[j])) != "samples"]
        if not hidden:
            return None
        held = np.where(np.isfinite(covariance), covariance, 0.0)  # what is lost does not move the tip
        with_tool = held[tool]
        known = held - with_tool.T @ np.linalg.solve(with_tool[:, tool], with_tool)
        now, tip = (tip_error.spread_rms(each, slopes, tips, motion.off) for each in (covariance, known))
        names, std = tuple(arm.names[j] for j in hidden), float(stds[hidden].max())
        return HiddenTool(names, std, tip) if tip < PART * now else None

    @cached_property
    def tip_from_minimum(self) -> float:
        """Distance of the tip from its place at the minimum, mm RMS over the workspace, apart from the base."""
        if minimises(self.method):
            return 0.0
        joints, tips, _ = self.workspace
        least = lm(self.fit, start=self.result.x, loss=self.result.loss)
        if not least.converged:
            least = lm(self.fit, loss=self.result.loss)
        arm = self.motion.arm
        x = Motion.of(self.fit, least, used_arm(self.fit, least, self.corrected)).x
        return tip_error.tip_rms(tip_error.without_rigid((tips - arm.tips(x, joints)).ravel(), tips))

    @cached_property
    def tip_std_without_prior(self) -> tuple[float, int]:
        """Tip error from the samples without priors, mm RMS, and how many directions they miss (then infinite)."""
        return tip_error.classical_accuracy(self.seen, self.seen_x)

    @cached_property
    def identifiability(self) -> Identifiability:
        """Rank, null and weak directions of arm and touches as drawn: at the nominal.

        All that says how large something is, tip errors, verdicts on parameters, cures and what they do to these
        directions, is worked out at the estimate. Rank cannot be: what the drawing hides exactly, by axes that are
        parallel or a plate that is level, an estimate hides but for its own corrections, so that at a tolerance of
        1e-9 rounding would decide it, and no two runs could be compared. `structural` says what stays hidden.
        """
        joints, (drawn, x0) = tip_error.workspace_joints(self.fit.problem.robot), arm_alone(self.bare, self.bare.x0)
        slopes, tips = drawn.tip_jacobian(x0, joints), drawn.tips(x0, joints)
        return identifiability(drawn, slopes, tips, active=self.result.active)

    @cached_property
    def cures(self) -> tuple[Cure, ...]:
        """Next steps, best first: 24 planned touches each (60 of the same kind too), and the tip error after them.

        Worked out when asked for, in about a second. Figures compare with `tip_std`, and mean as little where the
        verdict is not to use this result. Touches tell geometry; what else errs, and an estimate's way to the minimum,
        stays.
        """
        rows = self.doubted.with_noise(self.fit.scale)  # a step tells a dial's gain, too
        at = dict(zip(self.fit.names, self.result.x, strict=True))
        x = np.array([at[name] for name in rows.names])
        stays = self.tip_std[1] ** 2 - tip_error.expected_accuracy(rows, x)[1] ** 2
        return cures(rows, x, stays=max(stays, 0.0) if math.isfinite(stays) else 0.0)

    @cached_property
    def advice(self) -> tuple[str, ...]:
        """Cure of each null, then each weak direction, in the words of `cures`; none needed if it moves no tip."""
        directions = self.unjudged.identifiability.directions
        if all(direction.tip_mm < HARMLESS for direction in directions):
            return (NOT_NEEDED,) * len(directions)
        # the information of single touches about the geometry, with the noise of the fit with effects
        weighed = self.bare if self.bare is self.fit else self.bare.with_noise(self.fit.scale)
        geometry, x = arm_alone(weighed, self.result.x[~np.array(self.fit.beside, dtype=bool)])
        now = geometry.posterior(geometry.information(x), x)
        return tuple(
            NOT_NEEDED if direction.tip_mm < HARMLESS else cure_for(geometry, now, self.unjudged.cures, direction)
            for direction in directions
        )

    @cached_property
    def sensitivity(self) -> Sensitivity:
        """How estimate and tip follow every reading and prior; raises CasacalError where it is no minimum."""
        (_, tips, slopes), arm = self.workspace, self.motion.arm
        field = np.zeros((tips.size, self.fit.unknowns))
        field[:, arm.free if isinstance(arm, ArmAlone) else slice(None)] = tip_error.without_rigid(slopes, tips)
        return sensitivity(self.fit, self.result, field)

    @cached_property
    def effect_sizes(self) -> tuple[selection.EffectSize, ...]:
        """Estimated sizes of non-geometric effects, likeliest first; empty where effects were left out."""
        return selection.effect_sizes_of(self.fit, self.result.x)

    @cached_property
    def dial_errors(self) -> tuple[selection.DialError, ...]:
        """Whether the rows show an error of the dial that nobody declared; none where effects were not asked for."""
        return selection.dial_errors(self.fit, self.result.x) if self.counts_effects else ()

    @cached_property
    def leverages(self) -> tuple[Leverage, ...]:
        """What each constant that the instruments take for exact is worth at the tip; none under geometry alone."""
        return leverages(self.fit, self.result)

    @cached_property
    def prior_moves(self) -> PriorMoves:
        """How far arm and tool moved beyond what their priors allow, all together."""
        return prior_moves(self.seen, self.seen_x, self.unjudged.covariance)

    @cached_property
    def instrument_findings(self) -> tuple[Finding, ...]:
        """Errors where instruments differ in what they share or expect, or all lengths have a common scale error."""
        if not self.result.converged:
            return ()
        shared = list[Finding]()
        if len(self.fit.samples) > 1:
            from casacal.calibration.agreement import disagreement, not_the_same

            shared = (not_the_same(self.fit, self.result) if self.fit.problem.shared else []) or disagreement(self.bare)
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
        if effects.any() and self.plain.converged and not selection.errors_are_shared(self.fit):
            moved[~effects] = np.fmax(moved[~effects], _moves(self.plain)[: int((~effects).sum())])
        return moved

    @property
    def suspicious(self) -> bool:
        """Whether the fit calls for the data check: parameters far off, lack of fit, or no confirmed minimum."""
        # a robust fit has already set aside the rows that pull parameters far
        far = self.result.loss is None and bool((_moves(self.plain) > FAR).any())
        low = max(self.noise.low, noise_over_stated(self.plain).low)
        return far or not self.passed or low > LACK_OF_FIT


def _moves(result: Result) -> Array:
    return np.asarray(np.abs(result.x - result.problem.x0) / result.problem.prior_std)
