"""All that a result knows, and fresh rows beside it: the joint state that an update estimates anew."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.changes.posterior import Prior
from casacal.compensation.arm import CalibratedArm
from casacal.compensation.motion import corrected_values, known_motion
from casacal.errors import CasacalError
from casacal.uncertainty.fresh_rows import covariance_root
from casacal.verification.fresh import Fresh


@dataclass(frozen=True, eq=False)
class State:
    """Unknowns of the rows (n,), then those (o,) that only the result knows: s = at + S v.

    others: names of these, and where each stands in the result's covariance. x (n,), moved (o,): where rows put them;
    covariance: of all (n + o, n + o).
    """

    others: tuple[str, ...]
    places: tuple[int, ...]
    x: Array
    moved: Array
    covariance: Array
    chi_square: float


def motion_of(arm: CalibratedArm) -> tuple[Array, list[str]]:
    """Covariance (n, n) of all that a result says of arm, cell and effects that move the tip, and their names."""
    said = arm.document.get("discrepancy") or {}
    if "covariance" not in said:
        return known_motion(arm)
    rows = [[np.inf if value is None else float(value) for value in row] for row in said["covariance"]]
    return np.array(rows), list(said["covariance_of"])


def updated_state(arm: CalibratedArm, fresh: Fresh, free: Sequence[Array], dropped: Callable[[str], bool]) -> State:
    """The posterior of everything: the result's own as the prior, with directions (n,) that are free.

    dropped: names of what the result knows and nobody does any more. Raises CasacalError where the result leaves
    directions without bound, and where the rows cannot be fitted.
    """
    bound, (whole, names) = fresh.bound, motion_of(arm)
    corrected, own = corrected_values(arm), set(fresh.own_names)
    known = np.flatnonzero(fresh.known)
    index = {name: i for i, name in enumerate(names)}
    shared = [index[bound.names[j]] if not bound.beside[j] or bound.names[j] in corrected else -1 for j in known]
    places = [i for i, name in enumerate(names) if i not in shared and name not in own and not dropped(name)]
    both, k = np.zeros((known.size + len(places),) * 2), known.size
    both[:k, :k], both[k:, k:] = fresh.covariance, whole[np.ix_(places, places)]
    rows = np.flatnonzero(np.array(shared) >= 0)
    cross = whole[np.ix_([shared[r] for r in rows], places)]
    both[np.ix_(rows, np.arange(k, len(both)))], both[np.ix_(np.arange(k, len(both)), rows)] = cross, cross.T
    if not np.isfinite(both).all():
        raise CasacalError(
            f"{arm.file}: it leaves directions without bound, so there is no prior to update",
            "Calibrate again with old and new rows",
        )
    root, alone = covariance_root(both), np.flatnonzero(~fresh.known)
    more, count = len(free), root.shape[1]
    ways = np.zeros((bound.unknowns + len(places), count + alone.size + more))
    ways[known, :count], ways[bound.unknowns :, :count] = root[:k], root[k:]
    ways[alone, count + np.arange(alone.size)] = 1.0
    for i, direction in enumerate(free):
        ways[: bound.unknowns, count + alone.size + i] = direction
    at = np.where(fresh.known, fresh.at, fresh.x)
    firm = np.isfinite(bound.prior_std[alone])
    prior = Prior(
        at,
        ways[: bound.unknowns],
        np.concatenate([np.zeros(count), np.where(firm, bound.x0[alone] - at[alone], 0.0), np.zeros(more)]),
        np.concatenate([np.ones(count), bound.prior_std[alone], np.full(more, np.inf)]),
        np.concatenate([np.ones(count), bound.start_std[alone], np.full(more, 1e-3)]),
    )
    found = prior.given(bound)
    covariance = ways @ found.covariance @ ways.T
    moved = ways[bound.unknowns :] @ found.v
    others = tuple(names[i] for i in places)
    return State(others, tuple(places), found.x, moved, (covariance + covariance.T) / 2, found.chi_square)
