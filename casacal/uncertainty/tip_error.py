"""Expected tip error: over the workspace or inside a box, before and after touches, and the bound of any estimator."""

from __future__ import annotations

import math

import numpy as np

from casacal.errors import CasacalError
from casacal.fit.arm_alone import ArmAlone, ArmProblem
from casacal.fit.least_squares import LeastSquares
from casacal.linalg import posterior_covariance, right_directions, svd
from casacal.model.robot import Robot, random_joints
from casacal.values import Array, Box, Index

WORKSPACE_POSES = 400
NATURAL_UNITS = {"rad": 1e-3, "mm": 1.0}
FEW_POSES = 10
FEW_UNKNOWNS = 100
OF_THE_FLANGE = 0.01  # motion of the flange over that of the tip, below which an unknown is the tool's
BLIND_FIELD = 1e-9  # motion (mm per unit) below which a tip does not see an unknown
RANK_TOLERANCE = 1e-9  # fraction of the largest singular value below which a direction counts as null
FIELD_TOLERANCE = 1e-4  # of the largest tip motion, below which it is none, and above what null directions mix in
TRIES = 40_000  # random joint values among which those inside a box are looked for
FEWEST = 20


def workspace_joints(robot: Robot, *, poses: int = WORKSPACE_POSES, seed: int = 0) -> Array:
    """Fixed joint values (poses, n; rad, mm) that move every joint through its limits; no sample lies there."""
    return random_joints(robot, poses, np.random.default_rng([20220802, seed]))


def rigid_fields(tips: Array, about: Array) -> Array:
    """Six rigid displacement fields (3 N, 6) of tips (N, 3): three shifts, three turns about a point (3,)."""
    turns = [np.cross(axis, tips - about).ravel() for axis in np.eye(3)]
    shifts = [np.tile(axis, len(tips)) for axis in np.eye(3)]
    return np.column_stack([*shifts, *turns])


def without_rigid(field: Array, tips: Array) -> Array:
    """A displacement of tips, or several as columns (3 N, m), with its best rigid motion taken out.

    Planes alone cannot see where the base frame stands, so six rigid fields of the tips (N, 3) are projected out.
    """
    basis, _ = np.linalg.qr(rigid_fields(tips, tips.mean(axis=0)))
    return np.asarray(field - basis @ (basis.T @ field))


def up_to_base(field: Array, tips: Array, frame_field: Array, frame_tips: Array) -> Array:
    """Displacements (3 N, m) of some tips with the rigid motion taken out that fits another set's displacements best.

    The other set (3 M, m) of tips (M, 3), usually the workspace, says what counts as a move of the base frame.
    """
    about = frame_tips.mean(axis=0)
    motion = np.linalg.lstsq(rigid_fields(frame_tips, about), frame_field, rcond=None)[0]
    return np.asarray(field - rigid_fields(tips, about) @ motion)


def tip_stds(covariance: Array, field: Array, off: Array | None = None) -> Array:
    """Standard deviation (N, 3; mm) of each tip along each axis.

    Args:
        covariance: of the unknowns (n, n); infinite variances count where the field sees them.
        field: derivative (3 N, n) of the tips by the unknowns, apart from the pose of the base if that is wanted.
        off: by how much the arm that is asked for leaves unknowns (n,) where they are not; it counts as an error.

    """
    lost = ~np.isfinite(np.diagonal(covariance))
    held = np.where(np.isfinite(covariance), covariance, 0.0)
    if len(held) <= FEW_UNKNOWNS:  # where the threads of matrix products would only wait for one another
        variance = np.einsum("ik,ik->i", np.einsum("ij,jk->ik", field, held), field)
    else:
        variance = ((field @ held) * field).sum(axis=1)
    if off is not None:
        variance += (field @ off) ** 2
    variance[(np.abs(field[:, lost]) > BLIND_FIELD).any(axis=1)] = np.inf
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)).reshape(-1, 3))


def tip_rms(field: Array) -> float:
    """Root mean square length (mm) of a displacement (3 N,) of N tips."""
    return math.sqrt(float((field.reshape(-1, 3) ** 2).sum(axis=1).mean()))


def scale_direction(bound: ArmProblem) -> Array:
    """Change of x (n,) when all lengths of arm and tool, and the places of all planes, grow by a part of one."""
    direction = np.zeros(bound.unknowns)
    for _, unit, nominal, j in bound.parameters():
        if j is not None and unit == "mm":
            direction[j] = nominal
    for slot in bound.slots:
        direction[slot.columns] += slot.unknown.growth(slot.nominal)
    return direction


def conditional_scale_std(bound: ArmProblem) -> float:
    """Standard deviation of eps at the nominal when all else is exactly known: 1 / |J g|, g the scale direction."""
    return 1.0 / float(np.linalg.norm(bound.compact_jacobian(bound.x0) @ scale_direction(bound)))


def marginal_scale_std(bound: ArmProblem) -> float:
    """Standard deviation of eps at the nominal when each other unknown errs by its prior, planes freely.

    Generalised least squares of eps as one more unknown without a prior: 1 / var = g'F g - g'F (F + Lambda)^-1 F g,
    F the data's information. The prior lets the lengths err one by one, so some of eps hides among them: this is larger
    than the posterior standard deviation of the arm's size, and the more so the looser the prior.
    """
    information, direction, scale = bound.information(bound.x0), scale_direction(bound), bound.start_std
    pull = information @ direction
    inner = scale[:, None] * (information + bound.prior_information) * scale
    left = float(direction @ pull) - float((scale * pull) @ np.linalg.lstsq(inner, scale * pull, rcond=1e-14)[0])
    return float(1.0 / np.sqrt(max(left, 1e-300)))


def row_space(rows: Array) -> tuple[int, Array]:
    """Rank of a matrix (m, n), and right singular vectors (n, n; rows) of which the first `rank` span its row space."""
    sizes, right = right_directions(rows)
    return int((sizes > RANK_TOLERANCE * max(float(sizes.max(initial=0.0)), 1e-300)).sum()), right


def bayesian_bound(information: Array, prior: Array, tip_jacobian: Array, tips: Array) -> float:
    """Smallest RMS tip error (mm) over the workspace, apart from rigid motion, that data and prior allow.

    sqrt(trace(H (F + Lambda)^-1 H') / N): F and Lambda the information of data and prior (n, n), H the tips' Jacobian
    (3 N, n) with the rigid fields projected out, N tips (N, 3). Infinite when a flat direction that the data do not see
    moves a tip.
    """
    return spread_rms(posterior_covariance(information, prior), tip_jacobian, tips)


def spread_rms(covariance: Array, tip_jacobian: Array, tips: Array, off: Array | None = None) -> float:
    """RMS tip error (mm) of an estimate with a covariance (n, n), apart from rigid motion; `off` as for `tip_stds`."""
    return tip_rms(tip_stds(covariance, without_rigid(tip_jacobian, tips), off))


def classical_bound(jacobian: Array, scale: Array, tip_jacobian: Array, tips: Array) -> tuple[float, int]:
    """Smallest RMS tip error (mm) without a prior, by H F^+ H', and the number of null directions that move a tip.

    Infinite when there is such a direction. jacobian: whitened (rows, n); its columns are scaled by `scale` (n,).
    """
    sizes, right = right_directions(jacobian * scale)
    observable = sizes > RANK_TOLERANCE * max(float(sizes.max(initial=0.0)), 1e-300)
    field = without_rigid(tip_jacobian * scale, tips)
    lost = svd(field @ right[~observable].T)[1]
    blind = int((lost > FIELD_TOLERANCE * max(float(np.linalg.norm(field, axis=0).max(initial=0.0)), 1e-300)).sum())
    spread = (field @ right[observable].T) / sizes[observable]
    return (math.inf if blind else math.sqrt(float((spread**2).sum()) / len(tips))), blind


def tool_unknowns(bound: ArmProblem, x: Array) -> Index:
    """Positions in x (n,) of the unknowns that move the tip and hardly, by the weight they shift, the flange."""
    joints = workspace_joints(bound.problem.robot, poses=FEW_POSES)
    tip = np.abs(bound.tip_jacobian(x, joints)).max(axis=0)
    flange = np.abs(flange_jacobian(bound, x, joints)[1]).max(axis=0)
    return np.flatnonzero((tip > BLIND_FIELD) & (flange < OF_THE_FLANGE * tip) & ~bound.datum)


def flange_jacobian(bound: ArmProblem, x: Array, joints: Array) -> tuple[Array, Array]:
    """Flange origins (N, 3; mm) at joint values (N, n; rad, mm), and their derivative (3 N, n) by x."""
    if isinstance(bound, ArmAlone):
        return bound.blocks[0].slopes("flange", bound.expand(x), joints, bound.free)
    return bound.blocks[0].slopes("flange", x, joints)


def natural_scale(problem: LeastSquares) -> Array:
    """Natural scale of each unknown (n,), independent of its prior: 1 mrad, 1 mm."""
    return np.array([NATURAL_UNITS.get(unit, 1.0) for unit in problem.units])


def planned_accuracy(bound: ArmProblem) -> tuple[float, float]:
    """Tip error (mm RMS over the workspace) to expect: from the prior alone, and with these rows.

    Apart from where the base stands. At the nominal, so that it can be asked of planned or simulated touches before
    anyone moves a robot. It trusts stated noise and priors.
    """
    free = None if bound.constraints is None else bound.posterior(bound.information(bound.x0), bound.x0, ())
    return expected_accuracy(bound, bound.x0, covariance=free)


def expected_accuracy(
    bound: ArmProblem,
    x: Array,
    off: Array | None = None,
    *,
    usual: bool = True,
    flange: bool = False,
    covariance: Array | None = None,
) -> tuple[float, float]:
    """Expected accuracy at x (n,), of tip or flange origin; `off` as for `tip_stds`, `usual` as for `Block.posture`.

    Constraints hold in both figures, bounds on which x lies in the second alone.

    covariance: (n, n) of an estimate that does not count all rows alike; by default what rows and prior give.
    """
    joints = workspace_joints(bound.problem.robot)
    if flange:
        tips, slopes = flange_jacobian(bound, x, joints)
    else:
        tips, slopes = bound.tips(x, joints), bound.tip_jacobian(x, joints, usual=usual)
    information = bound.information(x if off is None else x + off)
    before = spread_rms(bound.posterior(np.zeros_like(information), x, ()), slopes, tips)
    if covariance is not None:
        return before, spread_rms(covariance, slopes, tips, off)
    return before, spread_rms(bound.posterior(information, x), slopes, tips, off)


def classical_accuracy(bound: ArmProblem, x: Array) -> tuple[float, int]:
    """Tip error (mm RMS) that the rows alone allow at x (n,), without a prior, and how many unseen directions move it.

    Infinite when there is such a direction.
    """
    joints = workspace_joints(bound.problem.robot)
    rows, scale, slopes = bound.compact_jacobian(x), natural_scale(bound), bound.tip_jacobian(x, joints)
    if (along := bound.tangent(x)) is not None:
        along, _ = np.linalg.qr(along / scale[:, None])
        rows, slopes, scale = (rows * scale) @ along, (slopes * scale) @ along, np.ones(along.shape[1])
    return classical_bound(rows, scale, slopes, bound.tips(x, joints))


def accuracy_in_box(
    bound: ArmProblem, x: Array, box: Box, off: Array | None = None, covariance: Array | None = None
) -> tuple[float, float]:
    """Tip error (mm RMS) to expect inside a box at x (n,), and its largest value there.

    Both apart from the pose of the base; `off` as for `tip_stds`. covariance: (n, n) of x, where it is not the
    posterior's, as under a robust loss. Raises CasacalError when the arm hardly reaches the box.
    """
    joints, frame = joints_in_box(bound, x, box), workspace_joints(bound.problem.robot)
    here, there = ((bound.tip_jacobian(x, each), bound.tips(x, each)) for each in (joints, frame))
    field = up_to_base(*here, *there)
    if covariance is None:
        covariance = bound.posterior(bound.information(x if off is None else x + off), x)
    stds = np.linalg.norm(tip_stds(covariance, field, off), axis=1)
    return math.sqrt(float((stds**2).mean())), float(stds.max())


def joints_in_box(bound: ArmProblem, x: Array, box: Box) -> Array:
    """Random joint values (M, n; rad, mm) at which the tip is inside a box; CasacalError where it hardly gets there."""
    low, high = np.array(box).T
    if not (low < high).all():
        ranges = ",".join(f"{lower:g}:{upper:g}" for lower, upper in box)
        raise CasacalError(f"The box {ranges} is empty", "Give each range as LOW:HIGH in mm")
    tried = random_joints(bound.problem.robot, TRIES, np.random.default_rng(0))
    tips = bound.tips(x, tried)
    joints = tried[((tips >= low) & (tips <= high)).all(axis=1)][:WORKSPACE_POSES]
    if len(joints) < FEWEST:
        what = f"Only {len(joints)} of {TRIES} random postures put the tip inside the box"
        raise CasacalError(what, "Choose a box in the arm's reach")
    return np.asarray(joints)
