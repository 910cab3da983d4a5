"""Small dense linear algebra of estimation: triangularisation, damped step, covariance."""

from __future__ import annotations

import numpy as np
from scipy.linalg import qr as pivoted_qr
from scipy.linalg import svd as by_driver
from scipy.linalg.lapack import dpocon, dpotrf, dpotrs

from casacal.values import Array

LEAST_LEFT = 1e-10  # fraction of a variance that must remain for a downdate to keep six digits; below it a QR is used

LEAST_PIVOT = 1e-12  # part of a diagonal element below which Cholesky's pivot is mostly rounding; in C too

WELL_CONDITIONED = 1e-12  # reciprocal condition number above which a unit-diagonal information is inverted as it is

LEAST_SLOPE = 1e-9  # part of a row's length, or of the largest pivot, below which nothing but rounding is left of it

ROUNDING = 16 * float(np.finfo(float).eps)  # part of a unit diagonal that rounding leaves of what nothing holds


def tria(wide: Array) -> Array:
    """Lower triangular S (n, n) with S S' = A A' and a non-negative diagonal, from A (n, m), m >= n.

    Eq (14) of arXiv:2208.02652 as it must be read (erratum E10): the transpose of the R of qr(A').
    """
    upper = np.linalg.qr(wide.T, mode="r")
    signs = np.where(np.diagonal(upper) < 0, -1.0, 1.0)
    return np.ascontiguousarray((signs[:, None] * upper).T)


def downdated(root: Array, u: Array) -> Array | None:
    """Lower triangular root of S (I - u u') S', without a QR: S L with L L' = I - u u'; None when |u| is nearly one.

    With s_j = 1 - u_1^2 - ... - u_j^2: L_jj = sqrt(s_j / s_(j-1)), L_ij = -u_i u_j / sqrt(s_j s_(j-1)) for i > j. A
    scalar measurement makes a square-root filter's belief, S (n, n), smaller in just this way.
    """
    left = 1.0 - np.cumsum(u**2)
    if not left[-1] > LEAST_LEFT:
        return None
    before = np.concatenate([[1.0], left[:-1]])
    weighted = root * u
    beyond = np.cumsum(weighted[:, ::-1], axis=1)[:, ::-1] - weighted  # columns j: sum of S_i u_i over i > j
    return np.asarray(np.tril(root * np.sqrt(left / before) - beyond * (u / np.sqrt(left * before))))


def damped_solution(information: Array, gradient: Array, damping: Array | float) -> Array | None:
    """Solve (H + diag(damping)) s = -g (n,) by Cholesky; None when that matrix is not safely positive definite.

    Safely: no pivot falls below `LEAST_PIVOT` of its diagonal element. Damping is one number, or one per coordinate.
    """
    if not gradient.size:
        return gradient.copy()
    matrix = information.copy()
    matrix.flat[:: len(matrix) + 1] += damping
    diagonal = np.diagonal(matrix)
    root, failed = dpotrf(matrix, lower=1)
    if failed or not (np.diagonal(root) ** 2 > LEAST_PIVOT * diagonal).all() or not np.isfinite(root[-1, -1]):
        return None
    return np.asarray(-dpotrs(root, gradient, lower=1)[0])


def svd(matrix: Array, *, full: bool = False) -> tuple[Array, Array, Array]:
    """U (m, k), singular values (k,) and V' (k, n) of a matrix (m, n), k the smaller of m and n; `full`: U, V square.

    Divide and conquer gives up on a few finite matrices, QR iteration does not; LinAlgError where one is not finite.
    """
    try:
        left, values, right = np.linalg.svd(matrix, full_matrices=full)
    except np.linalg.LinAlgError:
        if not np.isfinite(matrix).all():
            raise
        left, values, right = by_driver(matrix, full_matrices=full, lapack_driver="gesvd")
    return left, values, right


def right_directions(matrix: Array) -> tuple[Array, Array]:
    """All n singular values of a matrix (m, n), zero where m is smaller, and right singular vectors (n, n; rows)."""
    _, values, right = svd(matrix, full=len(matrix) < matrix.shape[1])
    return np.pad(values, (0, len(right) - len(values))), right


def revealed_solution(rows: Array, gradient: Array, damping: float) -> tuple[Array, float, float] | None:
    """Solve (A'A + damping I) s = -g by singular values of A (m, n), apart from directions that it does not see.

    Squaring A loses what lies below 1e-8 of its largest singular value. What lies below rounding itself is a gauge,
    along which g is rounding too: the step has no part in it.

    Returns s (n,), its squared length |A s|^2 and the fall -g's - |A s|^2 / 2; None where A or g is not finite.
    """
    if not (np.isfinite(rows).all() and np.isfinite(gradient).all()):
        return None
    _, values, directions = svd(rows)
    held = values > len(values) * np.finfo(float).eps * values[0]
    values, directions = values[held], directions[held]
    slope = directions @ gradient
    along = -slope / (values**2 + damping)
    squared_length = float(np.sum((values * along) ** 2))
    return along @ directions, squared_length, -float(slope @ along) - squared_length / 2


def freed_of(rows: Array, others: Array) -> Array:
    """R (k, s) with the A'A that is left of columns A (m, s) where the unknowns of other columns B (m, k) move freely.

    By orthogonal projection, which loses no digit. Directions of the others that no row sees take nothing away.
    """
    left, values, _ = svd(others)
    left = left[:, values > others.shape[1] * np.finfo(float).eps * values.max(initial=0.0)]
    return np.asarray(np.linalg.qr(rows - left @ (left.T @ rows), mode="r"))


def whitening_of(covariance: Array) -> Array:
    """W (n, n) with W C W' = I. A direction in which rounding left no variance keeps what rounding may have taken."""
    scale = np.sqrt(np.diagonal(covariance))
    scaled = covariance / np.outer(scale, scale)
    root, failed = dpotrf(scaled, lower=1)
    if not failed:
        return np.asarray(inverse_triangle(root) / scale)
    values, vectors = np.linalg.eigh(scaled)
    values = np.maximum(values, ROUNDING * len(values))
    return np.asarray((vectors / np.sqrt(values)).T / scale)


def unit_scale(diagonal: Array) -> Array:
    """Scale that takes a matrix with this diagonal (n,) to unit diagonal."""
    return np.asarray(1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)))


def posterior_covariance(data_information: Array, prior: Array, within: Array | None = None) -> Array:
    """Covariance (J'J + Lambda)^-1 (n, n), with J'J of the data and Lambda of the prior, both (n, n).

    Unknowns that neither data nor prior hold get an infinite variance. within: columns Z (n, k) as of `null_basis`
    along which x moves, no other way; then Z (Z'(J'J + Lambda)Z)^-1 Z'.
    """
    if within is not None:
        inner = posterior_covariance(within.T @ data_information @ within, within.T @ prior @ within)
        lost = ~np.isfinite(np.diagonal(inner))
        found = within[:, ~lost] @ inner[np.ix_(~lost, ~lost)] @ within[:, ~lost].T
        wide = (np.abs(within[:, lost]) > LEAST_SLOPE).any(axis=1)
        found[wide], found[:, wide], found[wide, wide] = 0.0, 0.0, np.inf
        return np.asarray(found)
    if not len(prior):
        return np.zeros((0, 0))
    if not np.isfinite(data_information).all():
        return np.diag(np.full(len(prior), np.inf))
    information = data_information + prior
    # unit diagonal: nearly the best conditioning that scaling alone can give (van der Sluis 1969)
    scale = unit_scale(np.diagonal(information))
    scaled = scale[:, None] * information * scale
    root, failed = dpotrf(scaled, lower=1)
    if not failed and dpocon(root, np.abs(scaled).sum(axis=0).max(), uplo="L")[0] > WELL_CONDITIONED:
        half = inverse_triangle(root) * scale
        return np.asarray(half.T @ half)
    values, vectors = np.linalg.eigh(scaled)
    held = values > len(values) * np.finfo(float).eps * max(float(values[-1]), 0.0)
    inverse = (vectors[:, held] / values[held]) @ vectors[:, held].T
    covariance = scale[:, None] * inverse * scale
    lost = (vectors[:, ~held] ** 2).sum(axis=1) > 1e-8
    covariance[lost, :] = 0.0
    covariance[:, lost] = 0.0
    covariance[lost, lost] = np.inf
    return np.asarray(covariance)


def determined(data_information: Array, prior_rows: Array) -> float:
    """Number of unknowns that the data determined: the trace of J (J'J + W'W)^-1 J', flat priors allowed.

    It is the rank of J'J + W'W less what the rows W (k, n) of the prior hold, each of them at most one.
    """
    information = data_information + prior_rows.T @ prior_rows
    scale = unit_scale(np.diagonal(information))
    values, vectors = np.linalg.eigh(scale[:, None] * information * scale)
    held = values > ROUNDING * len(values)
    along = (prior_rows * scale) @ vectors[:, held]
    return float(held.sum() - np.clip((along**2 / values[held]).sum(axis=1), 0.0, 1.0).sum())


def inverse_triangle(root: Array) -> Array:
    """Inverse (n, n) of the lower triangle of a matrix, by forward substitution.

    For the few unknowns of an arm this is faster than the libraries, whose threads wait for one another.
    """
    inverse = np.zeros(root.shape)
    for i in range(len(root)):
        inverse[i, :i] = -(root[i, :i] @ inverse[:i, :i]) / root[i, i]
        inverse[i, i] = 1.0 / root[i, i]
    return inverse


def correlation(covariance: Array) -> Array:
    """Correlation matrix (n, n) of a covariance; zero where a variance is infinite."""
    variance = np.diagonal(covariance)
    inverse = np.where(np.isfinite(variance) & (variance > 0), 1.0 / np.sqrt(np.where(variance > 0, variance, 1)), 0.0)
    finite = np.where(np.isfinite(covariance), covariance, 0.0)
    return np.asarray(inverse[:, None] * finite * inverse)


def null_basis(rows: Array, scale: Array) -> tuple[Array, int]:
    """Columns (n, n - r) that span {x: A x = 0} for rows A (m, n), and the rank r of A.

    Some of x lead and the others follow: each column moves one that leads by one, and others only as far as they must.
    scale: size of each of x (n,), by which those that follow are chosen.
    """
    sizes = np.linalg.norm(rows * scale, axis=1)
    upper, order = pivoted_qr(rows * scale / np.where(sizes > 0, sizes, 1.0)[:, None], mode="r", pivoting=True)
    r = int((np.abs(np.diagonal(upper)) > LEAST_SLOPE).sum())
    basis, follow, lead = np.zeros((len(scale), len(scale) - r)), order[:r], order[r:]
    basis[lead, np.arange(len(lead))] = 1.0
    basis[follow] = -scale[follow, None] * np.linalg.solve(upper[:r, :r], upper[:r, r:]) / scale[lead]
    return basis, r


def nearest(rows: Array, least: Array) -> tuple[Array, Array] | None:
    """Shortest w (n,) with A w >= b, and which rows of A (m, n) hold it there; None where no w meets them all.

    Least distance programming as a non-negative least-squares problem, Lawson and Hanson, Solving Least Squares
    Problems (1974), section 23.4; the rows that it finds then give w to the last digit.
    """
    if (least <= 0).all():
        return np.zeros(rows.shape[1]), np.zeros(len(rows), dtype=bool)
    from scipy.optimize import nnls  # a third of a second that those without bounds need not spend

    sizes = np.linalg.norm(rows, axis=1)
    moved = sizes > LEAST_SLOPE * sizes.max(initial=0.0)  # a bound that nothing can move is no matter of w
    rows = rows / np.where(moved, sizes, np.inf)[:, None]
    least = np.where(moved, least, 0.0) / np.where(moved, sizes, 1.0)
    whole, wanted = np.vstack([rows.T, least]), np.append(np.zeros(rows.shape[1]), 1.0)
    pull, missed = nnls(whole, wanted)
    if missed <= LEAST_SLOPE:
        return None
    held = pull > 0
    return np.linalg.lstsq(rows[held], least[held], rcond=None)[0], held


def constrained_solution(
    rows: Array, gradient: Array, damping: float, equal: Array, gap: Array, above: Array, least: Array
) -> Array | None:
    """Minimise |A s|^2 / 2 + damping |s|^2 / 2 + g's over s (n,) with E s = gap and B s >= least; None where none does.

    Null-space method for the equalities (Nocedal and Wright, Numerical Optimization, 2nd edition, section 16.2), then
    least distance in the metric of what is left. Directions that A does not see take no part.
    """
    left, sizes, right = svd(equal, full=True)
    kept = sizes > LEAST_SLOPE * sizes.max(initial=0.0)
    first, free = right[: len(sizes)][kept], right[int(kept.sum()) :]
    s = first.T @ ((left.T @ gap)[: len(sizes)][kept] / sizes[kept])
    _, values, directions = svd(rows @ free.T)
    seen = values > len(values) * np.finfo(float).eps * values.max(initial=0.0)
    # in units of these the objective is half the square of a length about -pull
    basis = (free.T @ directions[seen].T) / np.sqrt(values[seen] ** 2 + damping)
    s = s - basis @ (basis.T @ (gradient + rows.T @ (rows @ s) + damping * s))
    found = nearest(above @ basis, least - above @ s)
    return None if found is None else s + basis @ found[0]
