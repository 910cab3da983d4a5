"""Rows held out of a fit, by which it is judged."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casacal.errors import CasacalError, came
from casacal.samples.samples import Samples
from casacal.tables.labels import combinations


def split(samples: Samples, holdout: float, seed: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows to fit and rows held out, the given part of each label's rows, at random.

    Raises CasacalError unless 0 <= holdout < 1.
    """
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise CasacalError(f"The seed is {seed!r}", "Give a whole number from zero on")
    if not isinstance(holdout, (int, float)):
        raise CasacalError(
            f"{came(holdout)} came as the held-out part", "Give a fraction from 0 to below 1, such as 0.3"
        )
    if not 0 <= holdout < 1:
        raise CasacalError(f"The held-out part is {holdout:g}", "Give a fraction from 0 to below 1, such as 0.3")
    rng = np.random.default_rng(seed)
    distinct, codes = combinations(list(samples.labels.values()), len(samples))
    mask = np.zeros(len(samples), dtype=bool)
    for k, labels in enumerate(distinct):
        rows = np.flatnonzero(codes == k)
        chosen = rng.permutation(rows)[: round(holdout * len(rows))]
        if len(chosen) == len(rows):
            shown = " ".join(labels) or "all rows"
            raise CasacalError(f"Holding out {holdout:g} leaves no row of '{shown}' to fit", "Hold fewer rows out")
        mask[chosen] = True
    return np.flatnonzero(~mask), np.flatnonzero(mask)
