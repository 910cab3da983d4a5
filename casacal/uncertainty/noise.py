"""Noise estimated from residuals and repeats, as a factor of the stated noise, and joint repeatability."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from casacal.data.repeats import Repeats
from casacal.fit.bound_problem import OTHERS, REPEATABILITY, SHARED, BoundProblem, by_face, of_repeats, repeatability
from casacal.fit.least_squares import Result
from casacal.fit.lm import lm
from casacal.kernels.losses import Loss
from casacal.linalg import posterior_covariance
from casacal.uncertainty.evidence import NormalEquations
from casacal.uncertainty.figures import HALF_WEIGHT, effective_unknowns, leverages, noise_interval, ratio_interval
from casacal.values import Array, FrozenMapping, Value

SETTLED = 0.003  # relative change of the factor that ends the search
MOST_ROUNDS = 30  # fits to find it; each round leaves the part of its error that unknowns have of the rows
UNEQUAL = 1e-3  # chance of faces alike at which they are taken to differ in noise
SMOOTH = 4.0  # standard deviations beyond which products of a face's neighbouring residuals are not those of noise
FEWEST = 8.0  # degrees of freedom of a face that can tell its own noise
LACKING = 0.01  # chance of so large an F below which repeats share an error that the model does not describe
EXACT = 1e-18  # variance of repeats over that between places, below which they do not scatter at all: rounding
EXPECTED = 15e-6  # rad, joint repeatability to expect of an industrial arm; 15 to 30 urad, some 0.05 mm at the tip
DOUBT = 2.5  # times by which that may well be off
LOOSE, LOOSE_DOUBT = 300e-6, 3.0  # of one joint with play in its gear, rad, and times by which that may be off
LOOSEST = 5e-3  # rad beyond which no gear has play, and something else stands behind it
RARE = -math.log(300)  # one arm of fifty has such a joint, and it is one of six
KNOWN = 1.3  # times by which the rest of the noise may well exceed what was stated, where the joints explain the noise
PARTS = (0.5, 0.8, 1.0, 1.2)  # of the noise beyond the stated, tried as the joints'; with weights of its own more
WORTH_A_LOOK = 1.0  # standard deviations by which touches that see more of the joints must err more to be tried
LOOSE_WORTH_A_LOOK = 3.0  # likewise for one joint alone, which nobody suspects without a reason
WORTH = 2.0  # gain in log likelihood from which noise that is alike for all rows is put down to the joints
SMALLEST = 1e-3  # part of a row's variance that its own residual must hold to be judged by it
MOST_ROWS = 4096  # rows, evenly over all, at which is looked whether more should be tried


@dataclass(frozen=True, eq=False)
class Noise(Value):
    """Found over stated noise with its 95 % interval, and the factor, one or more, with which each face is used.

    In `scale` "" stands for all faces that are not named. `repeats` is what touches of the same place say.
    """

    ratio: float
    low: float
    high: float
    scale: Mapping[str, float]
    repeats: PureError | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "scale", FrozenMapping(self.scale))


def found_noise(bound: BoundProblem, loss: Loss | None = None) -> Noise:
    """The noise at which found over used is one, or what was stated where less was found.

    Fits of Levenberg-Marquardt, each with the noise that the one before it found. Faces get factors of their own where
    they differ more than chance explains (Bartlett's test) in what looks like noise. Where neighbouring rows of a face
    err alike, what is on top of the stated noise is no roughness of that face but something of the arm that the model
    does not say, and the other faces are not free of it because they show it less.

    Args:
        bound: with the noise as stated.
        loss: a robust loss, whose ignored rows do not count.

    """
    result, scale, shared = lm(bound, loss=loss), 1.0, 0.0
    again = None if loss is not None else repeats_in(bound)
    for _ in range(MOST_ROUNDS):
        # with a stated noise that is far too small rounding may keep a fit from its last digits; that is noise enough
        if not math.isfinite(result.cost) or (not result.converged and scale > 1):
            return noise_over_stated(result)
        known = None if again is None else pure_error(result, again)
        before, scale = (scale, shared), max(scale * _interval(result, again)[0], 1.0)
        shared = 0.0 if known is None else known.shared
        if abs(math.log(scale / before[0])) < SETTLED and abs(shared - before[1]) < SETTLED:
            break
        used = {OTHERS: scale, SHARED: shared} if shared else {OTHERS: scale}
        result = lm(bound.with_noise(used), start=result.x, loss=loss)
    own = None if shared else _by_face(result, scale)
    for _ in range(MOST_ROUNDS):  # a factor for each face
        if own is None:
            break
        result, before_it = lm(bound.with_noise(own), start=result.x, loss=loss), own
        own = _by_face(result, 1.0, before_it)
        if own is None or max(abs(math.log(own[name] / before_it[name])) for name in own) < SETTLED:
            break
    return noise_over_stated(result)


def noise_over_stated(result: Result) -> Noise:
    """Ratio of residual noise to stated noise, independent of the factors in use."""
    bound = result.problem
    assert isinstance(bound, BoundProblem)
    scale = bound.scale
    stated = bound.with_noise().noise
    of_a_touch = bound.with_noise({name: each for name, each in scale.items() if name != SHARED}).noise
    mean = math.sqrt(float((of_a_touch**2).sum() / (stated**2).sum()))
    units = {block.unit for instrument in bound.problem.instruments for block in instrument.blocks}
    if len(bound.samples) > 1 or len(units) > 1:  # residuals of different units
        mean = math.sqrt(float(((of_a_touch / stated) ** 2).mean()))
    again = repeats_in(bound) if result.loss is None else None
    ratio, low, high = (mean * each for each in _interval(result, again))
    return Noise(ratio, low, high, scale, None if again is None else pure_error(result, again))


def _interval(result: Result, again: Repeats | None) -> tuple[float, float, float]:
    """Found over used noise; of groups of repeats where they share what the model leaves out."""
    bound = result.problem
    assert isinstance(bound, BoundProblem)
    if again is None or not bound.scale.get(SHARED, 0.0):
        return noise_interval(result)
    free = max(len(again.sizes) - effective_unknowns(bound, result.x), 1.0)
    alike = again.summed(bound.residual(result.x)) / np.sqrt(again.sizes)  # of the same scale as a single row
    return ratio_interval(float((alike**2).sum()), free)


def _by_face(result: Result, common: float, scale: Mapping[str, float] | None = None) -> dict[str, float] | None:
    """A factor for each face where they differ in noise, or where they did before; None where they do not."""
    bound = result.problem
    assert isinstance(bound, BoundProblem)
    faces = bound.noise_labels
    if len(faces.names) < 2:
        return None
    kept = result.weights >= HALF_WEIGHT
    squares, free = bound.residual(result.x) ** 2 * kept, kept - leverages(bound, result) * kept
    total, freedom = (np.bincount(faces.codes, each, len(faces.names)).astype(np.float64) for each in (squares, free))
    if (freedom < FEWEST).any():
        return None
    if scale is None:
        if bartlett(total, freedom) > UNEQUAL or _smooth(bound, bound.residual(result.x)):
            return None
        scale = dict.fromkeys(faces.names, common)
    found = np.sqrt(total / freedom)
    return {name: max(scale[name] * float(each), 1.0) for name, each in zip(faces.names, found, strict=True)}


def _smooth(bound: BoundProblem, r: Array) -> bool:
    """Whether rows of some face that follow one another err alike: products of neighbours, of unit size each."""
    for rows in bound.faces.rows().values():
        own = r[bound.residuals_of(rows)].reshape(len(rows), -1)
        own = own / max(float(np.sqrt((own**2).mean())), 1e-300)
        products = own[1:] * own[:-1]
        if float(products.sum()) > SMOOTH * math.sqrt(max(products.size, 1)):
            return True
    return False


def bartlett(total: Array, freedom: Array) -> float:
    """Chance that variances, sums of squares (k,) over degrees of freedom (k,), differ so much (Bartlett 1937)."""
    from scipy.special import gammaincc

    if len(total) < 2:
        return 1.0  # nothing to differ from
    variance, pooled = np.maximum(total / freedom, 1e-300), max(float(total.sum() / freedom.sum()), 1e-300)
    spread = float(freedom.sum() * math.log(pooled) - (freedom * np.log(variance)).sum())
    faces = len(total)
    correction = 1 + (float((1 / freedom).sum()) - 1 / float(freedom.sum())) / (3 * (faces - 1))
    return float(gammaincc((faces - 1) / 2, max(spread / correction, 0.0) / 2))


@dataclass(frozen=True)
class PureError:
    """Pure error from repeated touches; all ratios are to the stated noise."""

    places: int  # postures that were touched more than once
    ratio: float  # scatter of repeats about their mean, and its 95 % interval
    low: float
    high: float
    f: float  # mean square between postures, after the fit, over that within them
    chance: float  # of so large an F where the model describes all but the scatter of repeats
    shared: float  # part of a touch's variance that its repeats share; zero where F is no surprise


def repeats_in(bound: BoundProblem) -> Repeats:
    """Which whitened rows repeat one another, component by component of the residual."""
    again = bound.repeats
    width = int(bound.components.max(initial=1))
    sizes = np.zeros((len(again.sizes), width), dtype=np.intp)
    np.add.at(sizes, (again.codes[bound.sample_of], bound.component_of), 1)
    there = np.cumsum((sizes > 0).ravel()) - 1  # samples of one instrument may have fewer components than another's
    codes = there[again.codes[bound.sample_of] * width + bound.component_of]
    return Repeats(codes, sizes[sizes > 0])


def pure_error(result: Result, again: Repeats) -> PureError | None:
    """Pure error and lack of fit at a result; None where nothing was touched twice, or read the same, or all is one.

    Residuals within a group differ by pure error alone; between groups there is also what the model leaves out, a
    random effect of variance t^2 shared by a group: E[between] = s^2 + k t^2, k the groups' mean size (Searle 1971).
    """
    from scipy.special import fdtrc

    bound = result.problem
    assert isinstance(bound, BoundProblem)
    if not again.any or len(again.sizes) < 2:
        return None
    of_a_touch = bound.residual(result.x) * bound.noise_factors(bound.scale)
    r = of_a_touch / bound.noise_factors(by_face(bound.scale))
    mean = again.summed(r) / again.sizes
    within, freedom = float(((r - mean[again.codes]) ** 2).sum()), float(len(r) - len(mean))
    left = max(len(mean) - effective_unknowns(bound, result.x), 1.0)
    between = float((again.sizes * mean**2).sum()) / left
    noise = within / freedom
    if not noise > EXACT * between:  # copies, which tell nothing of scatter
        return None
    f = between / noise
    chance = float(fdtrc(left, freedom, f))
    size = (len(r) - float((again.sizes**2).sum()) / len(r)) / max(len(mean) - 1, 1)
    effect = max(between - noise, 0.0) / size
    shared = effect / (effect + noise) if chance < LACKING and effect > 0 else 0.0
    total = float(((of_a_touch - (again.summed(of_a_touch) / again.sizes)[again.codes]) ** 2).sum())
    ratio, low, high = ratio_interval(total, freedom)
    return PureError(int((bound.repeats.sizes > 1).sum()), ratio, low, high, f, chance, shared)


def erring_joints(bound: BoundProblem, x: Array, equations: NormalEquations) -> list[int]:
    """Joints that may err more than other noise says where a fit stands: 0 for all alike, and one alone by its number.

    A score test of the variance: squares of what is left, over what is expected of them, against g^2 / noise^2. bound:
    with effects at their sizes. equations: of its rows, linearised at x (n,).
    """
    held = posterior_covariance(equations.information, bound.prior_information)
    if not np.isfinite(held).all():  # something that neither rows nor prior hold: what is left of a row is not known
        return []
    step = held @ equations.toward - (x - bound.x0)
    count = len(bound.measured)
    few = np.unique(np.linspace(0, count - 1, min(count, MOST_ROWS)).astype(np.intp))
    part = bound if few.size == count else bound.take(few)
    jacobian = part.jacobian(x)
    free = 1.0 - np.einsum("ij,ij->i", jacobian @ held, jacobian)
    judged = free > SMALLEST
    if not judged.any():
        return []
    squares = (part.residual(x) + jacobian @ step)[judged] ** 2 / free[judged]
    scores = []
    for joint in range(1 + part.blocks[0].samples.joints.shape[1]):
        share = ((part.joint_noise(joint) / part.noise) ** 2)[judged]
        apart = share - share.mean()
        spread = math.sqrt(2 * float(apart @ apart)) * float(squares.mean())
        scores.append(float(apart @ squares) / spread if spread > 0 else 0.0)
    alone = [j for j in (1 + np.argsort(scores[1:])[::-1][:2]).tolist() if scores[j] > LOOSE_WORTH_A_LOOK]
    return [0] * (scores[0] > WORTH_A_LOOK) + alone


def with_joints(whole: BoundProblem, found: BoundProblem, joints: Sequence[int]) -> Iterator[BoundProblem]:
    """Copies in which parts of the noise found beyond the stated are put down to all joints (0) or to one alone."""
    shared = of_repeats(found.scale)
    level, own = (float((each.noise**2).mean()) for each in (found, found.with_noise(shared)))
    for joint in joints if level > own else ():
        square = float((whole.joint_noise(joint) ** 2).mean())
        for part in PARTS if 0 < square < math.inf else ():
            rad = math.sqrt(part * (level - own) / square)
            if joint == 0 or rad <= LOOSEST:
                rest = math.sqrt(max(level - part * (level - own), own) / own)
                yield whole.with_noise({OTHERS: rest, f"{REPEATABILITY}{joint or ''}": rad, **shared})


def is_usual(bound: BoundProblem, most: float) -> bool:
    """Whether a usual joint repeatability explains the noise, with other noise at most `most` times the stated."""
    joint, rad = repeatability(bound.scale)
    rest = max(by_face(bound.scale).values(), default=1.0)
    return joint == 0 and 0 < rad <= EXPECTED * DOUBT and rest <= most


def beforehand(bound: BoundProblem) -> float:
    """Logarithm of the prior density of such noise, relative to its mode where all joints err alike."""
    joint, rad = repeatability(bound.scale)
    usual, doubt, rare = (LOOSE, LOOSE_DOUBT, RARE) if joint else (EXPECTED, DOUBT, 0.0)
    joints = math.log(rad / usual) / math.log(doubt)
    rest = math.log(max(by_face(bound.scale).values(), default=1.0)) / math.log(KNOWN)
    return rare - (joints**2 + rest**2) / 2
