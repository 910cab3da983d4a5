"""Identifiability from the data: rank, null directions by kind, weak directions.

Definition, so that figures can be compared: the whitened Jacobian at the nominal; its rank at 1e-9 of the largest
singular value, columns times 1 mrad and 1 mm, whatever the priors say; in the space that it sees, columns times prior
standard deviation.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from casacal.fit.least_squares import LeastSquares
from casacal.linalg import correlation, right_directions, svd
from casacal.uncertainty.tip_error import FIELD_TOLERANCE, natural_scale, row_space, tip_rms, without_rigid
from casacal.values import Array

Kind = Literal["invisible", "rigid", "scale", "blind"]

PERTURBATIONS = 2  # random parameter errors at which a structural null direction must still be null
SAME_DIRECTION = 0.9  # fraction of a null direction that must lie in the null space there
CORRELATED = 0.95
LEVER = 1000.0  # millimetres at which an angle counts when unknowns are named by their part in a direction

MEANING: dict[Kind, str] = {
    "invisible": "has no effect on the arm",
    "rigid": "only moves base frame and planes together",
    "scale": "makes the whole arm larger or smaller; no length was measured",
    "blind": "moves the tip elsewhere in the workspace but not in these samples",
}


KnownFrom: TypeAlias = Literal["samples", "samples and prior", "prior alone", "held"]
"""Source of a parameter's value, in files and tables alike; "held" was not estimated."""

WEAK = "better known from the priors than from these samples"


@dataclass(frozen=True)
class NullDirection:
    """A combination of unknowns (n,) that the samples do not see, in units of prior standard deviations."""

    kind: Kind
    direction: Array
    words: str
    tip_mm: float  # tip motion by one prior standard deviation along it, apart from the base, mm RMS
    structural: bool  # whether it stays null when the parameters move; else only these values hide it


@dataclass(frozen=True)
class WeakDirection:
    """A combination of unknowns (n,) of which the prior knows more than the data (whitened singular value < 1)."""

    singular_value: float
    direction: Array
    words: str
    tip_mm: float  # as for null directions


@dataclass(frozen=True)
class Identifiability:
    """Rank and null space of a bound problem at its nominal."""

    unknowns: int
    rank: int
    condition: float  # largest over smallest singular value that is not null
    singular_values: Array
    null: tuple[NullDirection, ...]
    weak: tuple[WeakDirection, ...]

    @property
    def directions(self) -> tuple[NullDirection | WeakDirection, ...]:
        """Null directions, then weak ones."""
        return (*self.null, *self.weak)

    def count(self, kind: Kind) -> int:
        """Number of null directions of one kind."""
        return sum(direction.kind == kind for direction in self.null)

    def without_tips(self) -> Identifiability:
        """Directions with their tip motion set to NaN."""
        null = tuple(replace(each, tip_mm=math.nan) for each in self.null)
        weak = tuple(replace(each, tip_mm=math.nan) for each in self.weak)
        return replace(self, null=null, weak=weak)


def identifiability(
    problem: LeastSquares, tip_jacobian: Array, tips: Array, *, active: Collection[str] = ()
) -> Identifiability:
    """Rank, null directions and weak directions of a problem at its nominal, along what constraints leave there.

    Args:
        problem: its Jacobian at x0 is judged.
        tip_jacobian: of the workspace tips by x, (3 N, n), mm per unit of x.
        tips: those tips (N, 3), mm, in the frame whose origin scale keeps in place.
        active: names of the bounds that count as equalities. Unknowns are then as many as are left to be told.

    """
    scale, natural = prior_scale(problem), natural_scale(problem)
    # unknowns are ranked by how far they move things, an angle at a lever of a metre
    lever = np.where(np.array(problem.units) == "rad", LEVER, 1.0)
    rank, space = _seen(problem, problem.x0, active)
    field = tip_jacobian * scale
    elsewhere = []  # projectors on the null space, in natural units, at parameters off by random errors of those sizes
    for seed in range(PERTURBATIONS):
        off = np.minimum(scale, natural) * np.random.default_rng(seed).normal(size=problem.unknowns)
        kept, right = _seen(problem, problem.x0 + off, active)
        elsewhere.append(right[kept:].T @ right[kept:])

    def cost(direction: Array) -> float:
        return tip_rms(without_rigid(field @ (direction / np.linalg.norm(direction)), tips))

    null = []
    for kind, basis in split_null_space(space[rank:].T, tip_jacobian * natural, tips):
        for change in sparse_basis(basis).T:
            still = min(float(np.linalg.norm(project @ change) / np.linalg.norm(change)) for project in elsewhere)
            words = f"{_named(change * natural * lever, problem.names)}: {MEANING[kind]}"
            direction = change * natural / scale
            null.append(NullDirection(kind, direction, words, cost(direction), still > SAME_DIRECTION))
    unseen, left = space[rank:].T * (natural / scale)[:, None], len(space)
    along = np.eye(left) if left == problem.unknowns else np.linalg.qr((space * (natural / scale)).T)[0]
    whole, _ = np.linalg.qr(np.column_stack([along.T @ unseen, np.eye(left)]))
    rest = along @ whole[:, left - rank :]  # complement of the null space
    _, sizes, within = svd((problem.compact_jacobian(problem.x0) * scale) @ rest)
    right = within @ rest.T
    weak = []
    for size, each in ((size, each) for size, each in zip(sizes.tolist(), right, strict=True) if size < 1):
        words = f"{_named(each * scale * lever, problem.names)}: {WEAK}"
        weak.append(WeakDirection(size, each, words, cost(each)))
    condition = float(sizes[0] / sizes[-1]) if rank else float("inf")
    values = np.concatenate([sizes, np.zeros(left - rank)])
    return Identifiability(left, rank, condition, values, tuple(null), tuple(weak))


def prior_scale(problem: LeastSquares) -> Array:
    """Prior standard deviation of each unknown (n,), or its natural scale where the prior is flat."""
    return np.where(np.isfinite(problem.prior_std), problem.prior_std, natural_scale(problem))


def correlated_pairs(covariance: Array, names: Sequence[str]) -> list[tuple[str, str, float]]:
    """Pairs of unknowns whose posterior correlation exceeds 0.95 in size, strongest first."""
    matrix = correlation(covariance)
    rows, columns = np.nonzero(np.triu(np.abs(matrix) > CORRELATED, k=1))
    pairs = [(names[int(i)], names[int(j)], float(matrix[i, j])) for i, j in zip(rows, columns, strict=True)]
    return sorted(pairs, key=lambda pair: -abs(pair[2]))


def _seen(problem: LeastSquares, x: Array, active: Collection[str]) -> tuple[int, Array]:
    """As `row_space` of the whitened Jacobian at x in natural units, (k, n) along the k ways that constraints leave."""
    natural, along = natural_scale(problem), problem.tangent(x, active)
    rows = problem.compact_jacobian(x) * natural
    if along is None:
        return row_space(rows)
    basis, _ = np.linalg.qr(along / natural[:, None])
    rank, right = row_space(rows @ basis)
    return rank, right @ basis.T


def split_null_space(null: Array, tip_jacobian: Array, tips: Array) -> list[tuple[Kind, Array]]:
    """Split a null space (n, k) by what it does to the tips: one basis (n, k_i) per kind, each kind inside the next.

    First what no tip shows (invisible), then what is a rigid motion of all tips, then what is that and a scale of the
    tips' field, the rest is blind.
    """
    field = tip_jacobian @ null
    size = FIELD_TOLERANCE * max(float(np.linalg.norm(tip_jacobian, axis=0).max(initial=0.0)), 1e-300)
    bent = without_rigid(field, tips)
    growth = without_rigid(tips.ravel(), tips)
    growth = growth / np.linalg.norm(growth)
    rest = bent - np.outer(growth, growth @ bent)
    taken, parts = np.zeros((null.shape[1], 0)), []
    stages: tuple[tuple[Kind, Array], ...] = (("invisible", field), ("rigid", bent), ("scale", rest))
    for kind, shown in stages:
        sizes, right = right_directions(shown)
        kernel = right[sizes < size].T
        parts.append((kind, _beyond(kernel, taken)))
        taken = kernel
    parts.append(("blind", _beyond(np.eye(null.shape[1]), taken)))
    return [(kind, null @ basis) for kind, basis in parts]


def sparse_basis(basis: Array) -> Array:
    """Another basis (n, k) of the same space in which each vector names few unknowns.

    Gauss-Jordan elimination with complete pivoting: each vector has an unknown of its own, at size one.
    """
    work = basis.copy()
    for j in range(work.shape[1]):
        i, pivot = np.unravel_index(np.argmax(np.abs(work[:, j:])), work[:, j:].shape)
        work[:, [j, j + int(pivot)]] = work[:, [j + int(pivot), j]]
        work[:, j] /= work[i, j]
        others = [k for k in range(work.shape[1]) if k != j]
        work[:, others] -= np.outer(work[:, j], work[i, others])
    work[np.abs(work) < 1e-9] = 0.0
    return work


def known_from(posterior_std: float, prior_std: float) -> KnownFrom:
    """Source of a parameter's value: samples (posterior/prior std < 0.5), both (to 0.95), or prior alone."""
    if not np.isfinite(posterior_std):
        return "prior alone"
    ratio = posterior_std / prior_std if np.isfinite(prior_std) else 0.0
    return "samples" if ratio < 0.5 else "samples and prior" if ratio <= 0.95 else "prior alone"


def _beyond(space: Array, inner: Array) -> Array:
    """Orthonormal basis of the part of `space` (k, a) orthogonal to `inner` (k, b), which it contains."""
    left, sizes, _ = svd(space - inner @ (inner.T @ space))
    return np.asarray(left[:, sizes > 0.5])


def _named(direction: Array, names: Sequence[str], most: int = 4) -> str:
    """The unknowns that take part most, in words."""
    order = np.argsort(-np.abs(direction).round(6), kind="stable")  # rounding must not order what is equal
    strong = [i for i in order if abs(direction[i]) > 0.1 * abs(direction[order[0]])]
    shown = [names[i] for i in strong[:most]]
    more = f" and {len(strong) - most} more" if len(strong) > most else ""
    return f"{', '.join(shown)}{more} change together" if len(strong) > 1 else f"{shown[0]} changes alone"
