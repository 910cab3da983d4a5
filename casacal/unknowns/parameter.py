"""Numbers: link lengths, twists, offsets, a tool point."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from casacal.array_types import Array, Rows
from casacal.errors import ProblemError
from casacal.kinematics import Expression
from casacal.unknowns.unknown import PRIOR_STD, Unknown, check_stds, spread, start_stds
from casacal.values import plain, read_only


@dataclass(frozen=True)
class Parameter(Unknown):
    """A number or a vector of numbers, each with a nominal value, a unit and a prior.

    Args:
        values: nominal value, a float (then the value is a scalar) or a sequence (then a vector); None for a scalar
            that the data are to propose, or, with labels, for a vector.
        unit: "mm", "rad" or any other word; only "mm" and "rad" have a default `start_std`.
        prior_std: standard deviation of the deviation from nominal, one or one each, in `unit`; `math.inf` is flat;
            None takes 0.7 mm or 1 mrad (`casacal.priors` says why), or flat when the data are to propose the value.
        start_std: where filters start components with a flat prior; never part of the cost.
        free: False holds the value at nominal; a sequence says so component by component.
        labels: suffixes of the component names, such as ("_x", "_y", "_z"); default "1", "2", ...
        per: name of a label column; one instance for each of its values.
        held_as_proposed: True holds it where the data propose it, as `Problem.fix` does.

    Raises ProblemError for values that are not finite or stds that are not positive.

    """

    values: float | Sequence[float] | None
    unit: str = "mm"
    prior_std: float | Sequence[float] | None = None
    start_std: float | Sequence[float] | None = None
    free: bool | Sequence[bool] = True
    labels: Sequence[str] | None = None
    per: str | None = None
    held_as_proposed: bool = False

    def __post_init__(self) -> None:
        for name in ("values", "prior_std", "start_std", "free", "labels"):
            object.__setattr__(self, name, plain(getattr(self, name)))
        if self._all.ndim > 1 or self._all.size == 0 or not np.isfinite(self._all).all():
            raise ProblemError(f"A parameter has the nominal value {self.values!r}", "Give one finite number, or a row")
        if self.labels is not None and len(self.labels) != self._all.size:
            raise ProblemError(
                f"A parameter of {self._all.size} values has {len(self.labels)} labels", "Give one label per value"
            )
        if self.values is None and not self._free.all() and not self.held_as_proposed:
            raise ProblemError("A parameter is held but has no value", "Give its value, or leave it free")
        check_stds(self._prior, "prior_std of a parameter")
        _ = self.start_stds  # or a sentence

    @cached_property
    def _all(self) -> Array:
        proposed = 0.0 if self.labels is None else np.zeros(len(self.labels))
        return np.array(proposed if self.values is None else self.values, dtype=np.float64)

    @cached_property
    def _free(self) -> Rows:
        return spread(self.free, self._all.size, "free of a parameter").astype(bool)

    @cached_property
    def _prior(self) -> Array:
        given = self.prior_std
        if given is None and self.values is not None and self.unit not in PRIOR_STD:
            raise ProblemError(
                f"A parameter in '{self.unit}' has no prior_std", "Give one, or math.inf for a flat prior"
            )
        if given is None:
            given = math.inf if self.values is None else PRIOR_STD[self.unit]
        return spread(given, self._all.size, "prior_std of a parameter")

    @property
    def size(self) -> int:
        """Number of free components."""
        return int(self._free.sum())

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each free component."""
        return (self.unit,) * self.size

    @cached_property
    def prior_stds(self) -> Array:
        """Prior standard deviations of the free components."""
        return np.asarray(read_only(self._prior[self._free]))

    @cached_property
    def start_stds(self) -> Array:
        """Prior, or start where flat, of the free components."""
        given = self.start_std
        start = None if given is None else spread(given, self._all.size, "start_std")[self._free]
        return np.asarray(read_only(start_stds(self.prior_stds, start, self.units, "a parameter")))

    @property
    def nominal(self) -> Array | None:
        """All components, free or held; None when the data must propose them."""
        return None if self.values is None else np.atleast_1d(self._all).copy()

    @property
    def nominal_size(self) -> int:
        """One number per component."""
        return self._all.size

    @property
    def raw_size(self) -> int:
        """One number per free component."""
        return self.size

    def component_names(self, key: str) -> tuple[str, ...]:
        """Names of all components, free or held: the key itself for a scalar, else key1, key2, ..."""
        if self._all.ndim == 0:
            return (key,)
        suffixes = self.labels or [str(i + 1) for i in range(self._all.size)]
        return tuple(key + suffix for suffix in suffixes)

    def names(self, key: str) -> tuple[str, ...]:
        """Names of the free components."""
        return tuple(name for name, free in zip(self.component_names(key), self._free, strict=True) if free)

    def at(self, nominal: Expression, local: Expression) -> Expression:
        """Nominal plus deviation: a scalar, or a vector of all components."""
        entries, free = [], 0
        for i, is_free in enumerate(self._free):
            entries.append(nominal[i] + local[free] if is_free else nominal[i])
            free += int(is_free)
        return entries[0] if self._all.ndim == 0 else ca.vertcat(*entries)

    def placed(self, near: Array, normal: Array) -> Array:
        """The place itself for a point, which is three numbers in mm; else zero."""
        del normal
        is_point = self.unit == "mm" and self._all.shape == (3,)
        return np.asarray(near, dtype=np.float64).copy() if is_point else np.zeros(self.nominal_size)

    def recentred(self, nominal: Array, local: Array) -> Array:
        """All components where the free ones have moved."""
        found = np.array(nominal, dtype=np.float64)
        found[self._free] += local
        return found

    def raw_start(self, nominal: Array) -> Array:
        """Return the free components themselves."""
        return np.asarray(np.asarray(nominal)[self._free])

    def raw_value(self, nominal: Expression, raw: Expression) -> Expression:
        """Value with the free components replaced."""
        return self.at(nominal, self.raw_local(nominal, raw))

    def raw_local(self, nominal: Expression, raw: Expression) -> Expression:
        """Deviations from nominal."""
        free = np.flatnonzero(self._free).tolist()
        return ca.vertcat(raw - nominal[free]) if free else ca.vertcat()

    def with_free(self, free: Sequence[bool]) -> Parameter:
        """Copy that keeps free only the flagged ones of its free components."""
        mask = self._free.copy()
        mask[np.flatnonzero(mask)] = list(free)
        return replace(self, free=tuple(bool(value) for value in mask), held_as_proposed=True)

    def freed(self, component: str | None = None) -> Parameter:
        """Copy with all components free, or with one more of them."""
        if component is None:
            return replace(self, free=True)
        free = [name == component or bool(was) for name, was in zip(self.component_names(""), self._free, strict=True)]
        return replace(self, free=tuple(free))

    def with_prior(self, stds: Sequence[float]) -> Parameter:
        """Copy with other prior standard deviations of its free components."""
        prior = self._prior.copy()
        prior[self._free] = list(stds)
        return replace(self, prior_std=tuple(float(value) for value in prior))
