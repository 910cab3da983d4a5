"""Moves against priors: unknowns farther from nominal than their priors allow, and one scale common to all lengths."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr

from casacal.fit.arm_alone import ArmAlone, ArmProblem
from casacal.fit.bound_problem import BoundProblem
from casacal.linalg import whitening_of
from casacal.uncertainty.figures import chance_beyond
from casacal.uncertainty.tip_error import scale_direction
from casacal.values import Array, Index

DULL = 1e-3  # part of a prior's variance that samples must take away from a direction before it can be said to move
BEYOND = 36.0  # largest size times this lies beyond what any such sum reaches: exp(-BEYOND / 2) of the chance
MOST_TERMS = 1 << 14
VANISHED = 1e-14  # size of a characteristic function from which on it adds nothing
MOST_ROWS = 20_000  # rows that the scatter is worked out from; more add memory, not insight
FEWEST = 4  # directions that rows must see before some of them can say how far the others may move
RANGE = np.geomspace(1e-2, 1e2, 121)  # times the priors that arms may differ from their drawing
ROUNDING = 1e-12
LARGEST = 700.0  # whose exponential is still a number


@dataclass(frozen=True)
class PriorMoves:
    """Joint size of the moves of arm and tool from nominal."""

    factor: float  # root mean square move over what the priors allow: one where they fit this arm
    decided: float  # unknowns that the samples decide, of those with a prior
    chance: float  # of moves as large as these, where priors and model are right


def chance_of_move(bound: ArmProblem, x: Array, covariance: Array, own: Index) -> float:
    """Chance that some unknowns (k,) move as far as they did: chi-square of x'(P - C)^+ x, P their priors' covariance.

    What the samples do not see has not moved and does not count. One where a prior is flat.
    """
    spread = covariance[np.ix_(own, own)]
    if not own.size or not np.isfinite(bound.prior_std[own]).all() or not np.isfinite(spread).all():
        return 1.0
    white = whitening_of(bound.prior_covariance[np.ix_(own, own)])
    gained, moved = np.eye(own.size) - white @ spread @ white.T, white @ (x - bound.x0)[own]
    values, along = np.linalg.eigh(gained)
    decided = values > DULL
    if not decided.any():
        return 1.0
    return chance_beyond(float((((along[:, decided].T @ moved) ** 2) / values[decided]).sum()), float(decided.sum()))


def prior_moves(bound: ArmProblem, x: Array, covariance: Array) -> PriorMoves:
    """Moves of all unknowns with a finite prior, but for those that only say where the touched thing stands.

    The sum of squares is one of independent normal numbers, weighted with eigenvalues; two moments of it are matched
    (Satterthwaite). covariance: (n, n), of the estimate x (n,).
    """
    own = np.flatnonzero(np.isfinite(bound.prior_std) & ~bound.datum)
    white, spread = whitening_of(bound.prior_covariance[np.ix_(own, own)]), covariance[np.ix_(own, own)]
    if not np.isfinite(spread).all():  # an unbounded unknown drags others along
        return PriorMoves(0.0, 0.0, 1.0)
    weights = np.clip(np.linalg.eigvalsh(np.eye(own.size) - white @ spread @ white.T), 0.0, 1.0)
    total, decided = float(((white @ (x - bound.x0)[own]) ** 2).sum()), float(weights.sum())
    if decided <= 0:
        return PriorMoves(0.0, 0.0, 1.0)
    freedom = decided**2 / float((weights**2).sum())
    return PriorMoves(math.sqrt(total / decided), decided, chance_beyond(freedom * total / decided, freedom))


@dataclass(frozen=True, eq=False)
class PriorScatter:
    """Predicted residual scatter of the nominal arm, planes fitted, under prior errors and noise.

    Their mean square is a sum of chi-squares, mm^2: of what size each (m,), and of how many degrees of freedom (m,).
    """

    sizes: Array
    freedoms: Array

    @property
    def rms(self) -> float:
        """Root mean square residual to expect, mm."""
        return math.sqrt(float(self.sizes @ self.freedoms))

    def chance_below(self, rms: float) -> float:
        """Probability that the drawn arm misses the planes by no more than `rms` (mm).

        From the characteristic function at odd steps (Imhof, Biometrika 48, 1961; Davies, Biometrika 60, 1973).
        """
        largest = np.abs(self.sizes).max()
        sizes, counts, beyond = self.sizes / largest, self.freedoms, rms**2 / largest
        mean, spread = abs(float(sizes @ counts)), math.sqrt(2 * float(sizes**2 @ counts))
        step = 2 * math.pi / (mean + abs(beyond) + 2 * BEYOND + 8 * spread)
        total, first = 0.0, 0
        while first < MOST_TERMS:
            u = step * (np.arange(first, first + 512) + 0.5)
            angles, logs = -beyond * u, np.zeros(len(u))
            for size, count in zip(sizes, counts, strict=True):
                angles += count / 2 * np.arctan(2 * size * u)
                logs += count / 4 * np.log1p((2 * size * u) ** 2)
            total += float((np.sin(angles) * np.exp(-logs) / u).sum()) * step
            if math.exp(-float(logs[-1])) / u[-1] < VANISHED:
                break
            first += 512
        return 1.0 - min(max(0.5 + total / math.pi, 0.0), 1.0)


def prior_scatter(bound: BoundProblem, *, flat_counts: bool = False) -> PriorScatter:
    """The scatter at the nominal; the arm's priors alone count and flat ones not, so that it is never overstated.

    Where it must not be understated, `flat_counts`, the tool's count as well, and flat ones as wide as filters start.
    """
    held = {slot.key for slot in bound.slots if slot.datum and slot.held_as_drawn}
    if held:  # just where the drawn arm has it: it took over that arm's errors, as if it had been fitted
        bound = bound.under(bound.problem.free(*sorted(held)))
    stds = bound.start_std if flat_counts else bound.prior_std
    bound = bound.thinned(MOST_ROWS)
    noise = bound.noise
    slopes = bound.jacobian(bound.x0) * noise[:, None]
    stands = bound.datum.copy()  # faces, and what else is of one label alone, such as where a dial was set to zero
    for slot in bound.slots:
        stands[slot.columns] |= slot.label is not None
        if not flat_counts and slot.key not in bound.problem.robot.parameters:
            stds = np.where(np.isin(np.arange(len(stds)), slot.columns), np.inf, stds)
    arm = ~stands & np.isfinite(stds)
    root = bound.prior_root[arm] * bound.start_std[arm, None]
    moved, planes = slopes[:, arm] @ np.linalg.cholesky(root @ root.T), slopes[:, stands]
    left = moved - planes @ np.linalg.lstsq(planes, moved, rcond=None)[0]
    powers = left.T @ left / len(noise)  # the mean square residual as a quadratic form of independent errors
    if not np.isfinite(powers).all():  # a residual that is none at the drawn arm: nothing is known of it
        return PriorScatter(np.array([math.nan]), np.ones(1))
    own = np.clip(np.linalg.eigvalsh(powers), 0.0, None)
    largest = float(noise.max())  # in units of it, so that no square overflows
    mean, spread = float(((noise / largest) ** 2).mean()), float(((noise / largest) ** 4).mean())
    freedom = len(noise) * mean**2 / spread  # two moments of what the noise of all rows adds are matched
    return PriorScatter(np.append(own, mean / freedom * largest * largest), np.append(np.ones(len(own)), freedom))


@dataclass(frozen=True, eq=False)
class CommonScale:
    """Common relative error of all lengths, and the chance of so much if nothing scales them.

    off: by how much unknowns (s,) are elsewhere for it.
    """

    part: float
    chance: float
    off: Array


def common_scale(bound: ArmProblem, x: Array, covariance: Array) -> CommonScale | None:
    """The scale that the moves of an estimate x (s,) have in common; None where rows see too little of them.

    What rows say of the unknowns, apart from priors, is z ~ N(0, N + t^2 A + B): N its own error, A and B what the
    priors of the arm and of all else allow, t how much of its priors this arm uses. A common scale e adds e g to it, g
    the lengths in prior standard deviations. Twice the logarithm of the ratio of the likelihoods with e and without,
    each at its best t, is turned into Student's t: so it does not matter how well the arm's priors fit, only whether
    its lengths move together where its angles and offsets do not. A dial whose gain is declared has that in B.
    """
    own = np.flatnonzero(np.isfinite(bound.prior_std) & ~bound.datum)
    if not np.isfinite(covariance[np.ix_(own, own)]).all():
        return None
    white = whitening_of(bound.prior_covariance[np.ix_(own, own)])
    spread = white @ covariance[np.ix_(own, own)] @ white.T
    grown = scale_direction(bound.whole)[bound.free] if isinstance(bound, ArmAlone) else scale_direction(bound)
    growth = white @ grown[own]
    if not (np.isfinite(x[own]).all() and growth.any()):
        return None
    left, along = np.linalg.eigh(spread)
    decided = left < 1 - DULL
    left, along = np.clip(left[decided], ROUNDING, None), along[:, decided]
    moved, towards = white @ (x - bound.x0)[own], along.T @ growth
    if len(left) < FEWEST or float(np.linalg.norm(towards)) < ROUNDING:
        return None
    said = along.T @ moved / (1 - left)
    arm = np.isin(own, [j for _, unit, _, j in bound.parameters() if j is not None and unit in ("mm", "rad")])
    fixed = np.diag(left / (1 - left)) + along[~arm].T @ along[~arm]
    free = along[arm].T @ along[arm]

    def likelihoods(t: float) -> tuple[float, float, float]:
        root = np.linalg.cholesky(fixed + t**2 * free)
        z, g = np.linalg.solve(root, np.column_stack([said, towards])).T
        plain = -float(np.log(np.diag(root)).sum()) - float(z @ z) / 2
        return plain, plain + float(z @ g) ** 2 / float(g @ g) / 2, float(z @ g) / float(g @ g)

    tried = [likelihoods(t) for t in RANGE]
    best = max(range(len(RANGE)), key=lambda k: tried[k][1])
    ratio, part = 2 * (tried[best][1] - max(each[0] for each in tried)), tried[best][2]
    freedom = len(left) - 1
    student = math.sqrt(freedom * math.expm1(min(max(ratio, 0.0) / (freedom + 1), LARGEST)))
    allowed = np.where(arm, RANGE[best] ** 2, 1.0)
    rest = allowed * (along @ np.linalg.solve(fixed + RANGE[best] ** 2 * free, said - part * towards))
    off = np.zeros(bound.unknowns)
    off[own] = np.linalg.solve(white, moved - rest)
    return CommonScale(part, 2 * float(stdtr(freedom, -student)), off)
