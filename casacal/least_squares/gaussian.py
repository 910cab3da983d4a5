"""A Gaussian over named unknowns: what is known before any row, with all correlations."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.least_squares.linalg import whitening_of
from casacal.values import Value


@dataclass(frozen=True, eq=False)
class Gaussian(Value):
    """Mean (n,) and covariance (n, n) of unknowns in their own units, mm and rad.

    An infinite variance says that nothing is known of an unknown; its covariances are zero.
    """

    names: tuple[str, ...]
    mean: Array
    covariance: Array

    def of(self, names: Collection[str]) -> Gaussian:
        """What is known of some of the unknowns, whatever the others are; in its own order."""
        kept = [j for j, name in enumerate(self.names) if name in names]
        return Gaussian(tuple(self.names[j] for j in kept), self.mean[kept], self.covariance[np.ix_(kept, kept)])

    def given(self, values: Mapping[str, float]) -> Gaussian:
        """What is then known of the others, where some of the unknowns are held at these values."""
        held = [j for j, name in enumerate(self.names) if name in values and np.isfinite(self.covariance[j, j])]
        rest = [j for j, name in enumerate(self.names) if name not in values]
        off = np.array([values[self.names[j]] for j in held]) - self.mean[held]
        white = whitening_of(self.covariance[np.ix_(held, held)])
        along = white @ self.covariance[np.ix_(held, rest)]
        names, covariance = tuple(self.names[j] for j in rest), self.covariance[np.ix_(rest, rest)]
        return Gaussian(names, self.mean[rest] + along.T @ (white @ off), covariance - along.T @ along)

    def beside(self, other: Gaussian) -> Gaussian:
        """Together with another of other unknowns that have nothing to do with these."""
        mine, whole = len(self.names), np.zeros((len(self.names) + len(other.names),) * 2)
        whole[:mine, :mine], whole[mine:, mine:] = self.covariance, other.covariance
        return Gaussian((*self.names, *other.names), np.concatenate([self.mean, other.mean]), whole)

    def placed(self, names: Sequence[str], mean: Array, std: Array) -> tuple[Array, Array]:
        """Means and standard deviations (n,) of unknowns by name, with those of this in their places."""
        mean, std = mean.copy(), std.copy()
        for j, name in enumerate(names):
            if name in self.names:
                k = self.names.index(name)
                mean[j], std[j] = self.mean[k], np.sqrt(self.covariance[k, k])
        return mean, std


def prior_rows(names: Sequence[str], prior_std: Array, known: Gaussian | None) -> Array:
    """Whitened rows W (k, n) of a prior: W'W is its information, zero along what is flat.

    Each unknown has its own standard deviation (n,; infinite: flat), or is one of those that are `known` together.
    """
    together = {} if known is None else {name: j for j, name in enumerate(known.names)}
    firm = [j for j, name in enumerate(names) if np.isfinite(prior_std[j]) and name not in together]
    rows = np.zeros((len(firm), len(names)))
    rows[np.arange(len(firm)), firm] = 1.0 / prior_std[firm]
    if known is None:
        return rows
    held = [j for j, name in enumerate(names) if name in together and np.isfinite(prior_std[j])]
    index = [together[names[j]] for j in held]
    dense = np.zeros((len(held), len(names)))
    dense[:, held] = whitening_of(known.covariance[np.ix_(index, index)])
    return np.vstack([rows, dense])
