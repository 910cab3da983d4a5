"""How well the samples know the size of the arm: (a, d, c) times 1 + eps changes no contact, only a length shows it."""

from __future__ import annotations

import numpy as np

from casacal.array_types import Array
from casacal.binding.marginal import Seen


def scale_direction(bound: Seen) -> Array:
    """Change of x (n,) when all lengths of arm and tool, and the places of all planes, grow by a part of one."""
    direction = np.zeros(bound.unknowns)
    for _, unit, nominal, j in bound.parameters():
        if j is not None and unit == "mm":
            direction[j] = nominal
    for slot in bound.slots:
        direction[slot.columns] += slot.unknown.growth(slot.nominal)
    return direction


def conditional_scale_std(bound: Seen) -> float:
    """Standard deviation of eps at the nominal when all else is exactly known: 1 / |J g|, g the scale direction."""
    return 1.0 / float(np.linalg.norm(bound.compact_jacobian(bound.x0) @ scale_direction(bound)))


def marginal_scale_std(bound: Seen) -> float:
    """Standard deviation of eps at the nominal when each other unknown errs by its prior, planes freely.

    Generalised least squares of eps as one more unknown without a prior: 1 / var = g'F g - g'F (F + Lambda)^-1 F g,
    F the data's information. The prior lets the lengths err one by one, so some of eps hides among them: this is larger
    than the posterior standard deviation of the arm's size, and the more so the looser the prior.
    """
    information, direction = bound.information(bound.x0), scale_direction(bound)
    scale = bound.start_std
    pull = information @ direction
    inner = scale[:, None] * (information + np.diag(bound.prior_information)) * scale
    left = float(direction @ pull) - float((scale * pull) @ np.linalg.lstsq(inner, scale * pull, rcond=1e-14)[0])
    return float(1.0 / np.sqrt(max(left, 1e-300)))
