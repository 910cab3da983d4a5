"""What moves the tip: the geometry, effects beside it that are corrected or only counted, every reading and prior.

The estimate's derivatives are by the implicit function theorem: at the minimum g(x, y) = 0, so that dx/dy =
-H^-1 dg/dy, with H the exact Hessian in x (Nocedal and Wright, Numerical Optimization, 2006, theorem A.2). Weights,
effects' sizes and nominal values that the samples propose stay as they stand.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from casacal.effects.selection import MOST_ROWS, VERY_STRONG, at_most, gains, in_sample_gains
from casacal.effects.trusted import TrustedConstants
from casacal.errors import CasacalError
from casacal.fit.arm_alone import ArmAlone, ArmProblem, moving
from casacal.fit.bound_problem import BoundProblem
from casacal.fit.least_squares import Conditioned, Result
from casacal.fit.lm import lm
from casacal.model.instrument import Instrument
from casacal.model.term import Site
from casacal.model.trace import RowModel
from casacal.uncertainty.tip_error import expected_accuracy, tip_stds, without_rigid, workspace_joints
from casacal.values import Array, FrozenMapping, Value, read_only
from casacal.wording import listed

SMALLEST = 1e-2  # part of the largest move, in prior standard deviations, below which geometry mimics no effect
FLAT = 1e-3  # largest component of the gradient, by prior standard deviations, that counts as zero
MOST_EXACT = 5_000  # whose exact Hessian takes a few seconds


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

    Both apart from the pose of the base; the three axes together. Of joint values, tips and slopes there.
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
        became += f" by {listed(self.further)}" if self.told else ""
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
    moving_ones = (effect for effect in fit.problem.terms if effect.moves and effect.key in fit.beside)
    alike = (each for each in moving_ones if each.further or not any(each.columns(site) for site in sites))
    known = {effect.key: effect for effect in alike}
    if not known or not result.converged:
        return ()
    evidence = in_sample_gains(fit, result.x, known)
    likely = [key for key in known if evidence[key] > VERY_STRONG]
    unseen = gains(fit, result.x, likely) if likely else {}
    doubted = () if not likely or sees_the_tip(fit) else at_most(fit)
    doubtful = {effect.key for effect in doubted if not effect.elastic}
    stands, found = list[str](), []
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


@dataclass(frozen=True, eq=False)
class Sensitivity(Value):
    """Derivatives of the estimate x (n), mm and rad, and what they do to the tip over the workspace.

    names: of the unknowns. readings: line and column of each number (k) of a row beside the joint values, as in the
    file. by_reading: dx/dy (n, k), by the columns' units. by_prior: dx/dx0 (n, n), column j by the prior's mean of
    unknown j. rows: line of each row (N). tip_by_row (N), tip_by_prior (n): how far the tip moves, mm RMS over the
    workspace apart from the pose of the base, where all of a row, or a prior's mean, errs by one standard deviation.
    """

    names: tuple[str, ...]
    readings: tuple[tuple[int | str, str], ...]
    by_reading: Array
    by_prior: Array
    rows: tuple[int | str, ...]
    tip_by_row: Array
    tip_by_prior: Array

    def __post_init__(self) -> None:
        for name in ("by_reading", "by_prior", "tip_by_row", "tip_by_prior"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def without_tips(self) -> Sensitivity:
        """A copy with NaN in place of every tip error."""
        rows, priors = (np.full_like(tips, np.nan) for tips in (self.tip_by_row, self.tip_by_prior))
        return replace(self, tip_by_row=rows, tip_by_prior=priors)

    def most(self, count: int = 5) -> tuple[list[tuple[int | str, float]], list[tuple[str, float]]]:
        """The rows, by line, and the priors, by name, that move the tip most, each with mm RMS; none that move none."""
        by_row, by_prior = self.tip_by_row, self.tip_by_prior
        first, best = (np.argsort(-tips, kind="stable")[:count] for tips in (by_row, by_prior))
        rows = [(self.rows[j], float(by_row[j])) for j in first if by_row[j] > 0]
        return rows, [(self.names[j], float(by_prior[j])) for j in best if by_prior[j] > 0]


def sensitivity(fit: BoundProblem, result: Result, tip: Array) -> Sensitivity:
    """Sensitivity at a minimum; tip: derivative (3 M, n) of M tips by the unknowns, mm.

    Raises CasacalError where the estimate is no minimum of the plain objective, or rows are too many.
    """
    if result.loss is not None or not result.converged or not result.kkt < FLAT:
        raise CasacalError("This estimate is no minimum of the plain objective", "Use lm or sckf-lm without a loss")
    if fit.rows > MOST_EXACT:
        what = f"{fit.rows:,} rows with {fit.unknowns:,} unknowns are too many for the sensitivity"
        raise CasacalError(what, f"Take at most {MOST_EXACT:,} rows")
    kinds, starts = fit.symbolic.kinds, fit.measured.starts
    models = [_row_function(*each) for each in zip(fit.problem.models, fit.problem.instruments, strict=True)]
    hessian, found = fit.prior_information.copy(), []
    for kind in kinds:
        inputs, of_row = (result.x[kind.columns], kind.constants), models[kind.instrument][0]
        rows = [[each.full() for each in of_row(*inputs, *row)] for row in zip(kind.data, kind.noise, strict=True)]
        hessian[np.ix_(kind.columns, kind.columns)] += np.sum([row[2] for row in rows], axis=0)
        found.append((np.array([row[0] for row in rows]), np.concatenate([row[1] for row in rows], axis=1)))
    scale, along = fit.start_std[:, None], fit.tangent(result.x)
    basis = None if along is None else np.linalg.qr(along / scale)[0]  # along what constraints leave
    scaled = hessian * np.outer(fit.start_std, fit.start_std)
    values, vectors = np.linalg.eigh(scaled if basis is None else basis.T @ scaled @ basis)
    held = values > len(values) * np.finfo(float).eps * values.max(initial=0.0)  # what nothing holds does not move
    root = scale * (vectors if basis is None else basis @ vectors)[:, held]
    inverse = (root / values[held]) @ root.T
    squares = inverse @ (tip.T @ tip) @ inverse / (len(tip) / 3)  # of the tip by gradients
    readings, by_reading = list[tuple[int, str]](), []
    tips = np.zeros(len(fit.measured))
    for kind, (slopes, changes) in zip(kinds, found, strict=True):
        places = int(starts[kind.instrument]) + kind.samples
        block = squares[np.ix_(kind.columns, kind.columns)]
        tips[places] = np.sqrt(np.maximum(np.einsum("kmi,ij,kmj->k", slopes, block, slopes), 0.0))
        readings += [(int(k), name) for k in places for name in models[kind.instrument][1]]
        by_reading.append(-inverse[:, kind.columns] @ changes)
    in_file = np.argsort([k for k, _ in readings], kind="stable")
    pull, held = fit.prior_information, np.diagonal(fit.prior_information)
    std = np.where(held > 0, 1 / np.sqrt(np.where(held > 0, held, 1.0)), 0.0)  # of each, were the others known
    return Sensitivity(
        fit.names,
        tuple((fit.measured.place(readings[j][0]), readings[j][1]) for j in in_file),
        np.concatenate(by_reading, axis=1)[:, in_file],
        inverse @ pull,
        tuple(fit.measured.place(k) for k in range(len(fit.measured))),
        tips,
        std * np.sqrt(np.maximum(np.diagonal(pull @ squares @ pull), 0.0)),
    )


def _row_function(model: RowModel, instrument: Instrument) -> tuple[ca.Function, list[str]]:
    """(z, c, d, w) -> whitened slopes (m, nz) of a row, its gradient's change by columns (nz, k), its Hessian (nz, nz).

    And these columns: what the instrument reads.
    """
    z, c, d = (ca.SX.sym(name, model.residual.numel_in(i)) for i, name in enumerate("zcd"))
    w = ca.SX.sym("w", model.components)
    e = model.residual(z, c, d) / w
    slopes = ca.jacobian(e, z)
    hessian, gradient = ca.hessian(ca.sumsqr(e) / 2, z)
    first, names = d.numel() - len(model.names), [name for name in model.names if name in instrument.columns]
    columns = [first + model.names.index(name) for name in names]
    outputs = [slopes, ca.jacobian(gradient, d[columns]), hessian]
    return ca.Function("row", [z, c, d, w], [ca.densify(each) for each in outputs]), names
