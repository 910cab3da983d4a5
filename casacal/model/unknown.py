"""Base of all unknowns, and scalar parameters: link lengths, twists, offsets, a tool point."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from casacal.errors import ProblemError, said
from casacal.model.kinematics import Expression
from casacal.values import Array, Rows, plain, read_only

OTHER_UNITS = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), (1000.0, "mm")),
    **dict.fromkeys(("in", "inch", "inches"), (25.4, "mm")),
    **dict.fromkeys(("deg", "degree", "degrees"), (math.pi / 180, "rad")),
    **dict.fromkeys(("radian", "radians"), (1.0, "rad")),
    **{"cm": (10.0, "mm"), "mrad": (1e-3, "rad")},
    **dict.fromkeys(("millimetre", "millimetres", "millimeter", "millimeters"), (1.0, "mm")),
}
"""Units that a drawing may have, and the factor to that of models."""
PRIOR_STD = {"mm": 0.7, "rad": 1e-3}  # where a user gives none: what machining and assembly leave of arms; see `priors`

LARGEST_STD = 1e12  # a standard deviation beyond which, or below whose inverse, arithmetic ends before knowledge does

START_STD = {"mm": 10.0, "rad": 0.01}  # where filters and populations start with a flat prior; never part of the cost


class Unknown(ABC):
    """A nominal value and a smooth map to values from `size` local coordinates, zero at the nominal.

    A kind of one's own gives `units`, `prior_stds`, `nominal` and `at`; properties may be plain attributes.

    `raw_*` is a second, redundant description (a normal as a free 3-vector with a unit-norm constraint, say), which
    only the IPOPT reference uses, so that agreement between the two means something. By default it is the first one.
    """

    per: str | None = None

    @property
    def size(self) -> int:
        """Number of free local coordinates."""
        return len(self.units)

    @property
    @abstractmethod
    def units(self) -> tuple[str, ...]:
        """Unit of each local coordinate: "mm", "rad" or the user's own."""

    @property
    @abstractmethod
    def prior_stds(self) -> Array:
        """Prior standard deviation of each local coordinate (size,); infinite where the prior is flat."""

    @property
    def start_stds(self) -> Array:
        """Where filters and populations start (size,): the prior, or 10 mm and 10 mrad where that is flat."""
        return start_stds(self.prior_stds, None, self.units, f"a {type(self).__name__.lower()}")

    @property
    @abstractmethod
    def nominal(self) -> Array | None:
        """Numbers (nominal_size,) that fix the nominal value, or None when the data must propose it."""

    @property
    def nominal_size(self) -> int:
        """Number of components of a nominal value; as many as local coordinates where the data propose it."""
        return self.size if self.nominal is None else len(self.nominal)

    @property
    def raw_size(self) -> int:
        """Number of raw coordinates; as many as local ones unless a kind says otherwise."""
        return self.size

    def names(self, key: str) -> tuple[str, ...]:
        """Names of the free local coordinates when the unknown itself is called `key`: "key", or key1, key2, ..."""
        return (key,) if self.size == 1 else tuple(f"{key}{i + 1}" for i in range(self.size))

    @abstractmethod
    def at(self, nominal: Expression, local: Expression) -> Expression:
        """Value at local coordinates (size,) about a nominal; symbols or floats."""

    def nominal_plane(self, nominal: Array) -> tuple[Array, Array] | None:
        """Unit normal (3,) and a point (3, mm) where the unknown is a plane; None otherwise."""
        del nominal
        return None

    def growth(self, nominal: Array) -> Array:
        """Change of the local coordinates (size,) where all that it says of places grows by a part of one; none here.

        A `Parameter` is not asked: only its robot knows which of its numbers are lengths.
        """
        del nominal
        return np.zeros(self.size)

    def packed(self, value: Expression) -> Expression:
        """A value as one matrix."""
        return value

    def unpacked(self, matrix: Expression) -> Expression:
        """The value that such a matrix is of."""
        return matrix

    def shown(self, nominal: Array, local: Array) -> tuple[str, Any]:
        """Heading in result.json and numbers at local coordinates (size,); no heading for parameters."""
        del nominal, local
        return "", None

    def placed(self, near: Array, normal: Array) -> Array:
        """Numbers of a simulated nominal near a point (3, mm); where it is flat, it looks along `normal` (3)."""
        del near, normal
        kind = type(self).__name__
        raise ProblemError(f"A {kind} does not say where a simulation places it", "Give it a nominal, or `placed`")

    def recentred(self, nominal: Array, local: Array) -> Array:
        """Numbers of a nominal where local coordinates (size,) lead from one; as it was where a kind does not say."""
        del local
        return nominal

    def raw_start(self, nominal: Array) -> Array:
        """Raw coordinates of the nominal; nobody asks where all is held, nor for the two that follow."""
        del nominal
        return np.zeros(self.raw_size)

    def raw_value(self, nominal: Expression, raw: Expression) -> Expression:
        """Value at raw coordinates."""
        return self.at(nominal, raw)

    def raw_local(self, nominal: Expression, raw: Expression) -> Expression:
        """Local coordinates (size,) of a raw point that meets the constraints."""
        del nominal
        return raw

    def raw_constraints(self, raw: Expression) -> list[Expression]:
        """Expressions that vanish where raw coordinates are valid."""
        del raw
        return []

    def with_free(self, free: Sequence[bool]) -> Unknown:
        """Copy with only the flagged of its present free coordinates left free; none by default."""
        del free
        raise ProblemError(f"A {type(self).__name__} cannot be held", "Leave it free, or give it `with_free`")

    def component_names(self, key: str) -> tuple[str, ...]:
        """Names of all components, free or held, that can be freed one by one; none by default."""
        del key
        return ()

    def freed(self, component: str | None = None) -> Unknown:
        """Copy that is estimated as a whole, or one more component of it, by what its name adds to the key's."""
        del component
        if is_dataclass(self) and "free" in {each.name for each in fields(self)}:
            return replace(self, free=True)
        raise ProblemError(f"{type(self).__name__} cannot be freed", "Declare it free in the problem")

    def with_prior(self, stds: Sequence[float]) -> Unknown:
        """Copy with another prior standard deviation for each free coordinate: a dataclass's field `prior_std`."""
        if is_dataclass(self) and "prior_std" in {each.name for each in fields(self)}:
            return replace(self, prior_std=tuple(map(float, stds)))
        raise ProblemError(f"The prior of a {type(self).__name__} cannot be replaced", "Give it `with_prior`")


def spread(values: float | Sequence[float], count: int, what: str) -> Array:
    """One number for all, or one each: an array (count,); raises ProblemError when their number fits neither."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0:
        return np.full(count, float(array))
    if array.shape != (count,):
        raise ProblemError(f"{what} has {array.size} values for {count} components", "Give one value, or one each")
    return array.copy()


def check_stds(stds: Array, what: str) -> None:
    """Refuse standard deviations that are not positive; infinity means a flat prior."""
    if np.isnan(stds).any() or (stds <= 0).any():
        fix = "A standard deviation is positive, or math.inf for a flat prior; use free=False to hold a value"
        raise ProblemError(f"{what} is {_shown(stds)}", fix)
    absurd = np.isfinite(stds) & ((stds > LARGEST_STD) | (stds < 1 / LARGEST_STD))
    if absurd.any():
        fix = "Give math.inf (inf on the command line) for a flat prior, or free=False (--fix) to hold a value"
        raise ProblemError(f"{what} is {stds[absurd][0]:g}, which no prior knowledge is", fix)


def start_stds(prior: Array, start: Array | None, units: tuple[str, ...], what: str) -> Array:
    """Standard deviations (n,) where filters start: the prior's, or where that is flat `start` (10 mm, 10 mrad)."""
    result = prior.copy()
    for j in np.flatnonzero(~np.isfinite(prior)):
        if start is not None:
            result[j] = start[j]
        elif units[j] in START_STD:
            result[j] = START_STD[units[j]]
        else:
            raise ProblemError(f"{what} has a flat prior and the unit '{units[j]}'", "Give it a start_std")
    if not np.isfinite(result).all() or (result <= 0).any():
        raise ProblemError(f"start_std of {what} is {_shown(result)}", "Give positive finite numbers")
    return result


def check_own_kind(unknown: Unknown, what: str) -> None:
    """Raise ProblemError where a kind of unknown of one's own says of itself what cannot be."""
    if type(unknown).__module__.startswith("casacal."):
        return
    whose = f"{what}, a {type(unknown).__name__}"
    units = unknown.units
    if not isinstance(units, tuple) or not all(isinstance(unit, str) for unit in units):
        raise ProblemError(f"The units of {whose}, are {units!r}", 'Give a tuple such as ("mm", "rad")')
    try:
        stds = np.asarray(unknown.prior_stds, dtype=np.float64)
        nominal = np.zeros(len(units)) if unknown.nominal is None else np.asarray(unknown.nominal, dtype=np.float64)
    except (TypeError, ValueError):
        fix = "Give prior_stds and nominal as arrays of numbers"
        raise ProblemError(f"prior_stds or nominal of {whose}, are no numbers", fix) from None
    if stds.shape != (len(units),) or not (stds > 0).all():
        fix = f"Give {len(units)} positive numbers, one for each of its units; inf is flat"
        raise ProblemError(f"prior_stds of {whose}, are {stds.tolist()}", fix)
    if nominal.ndim != 1 or not np.isfinite(nominal).all():
        raise ProblemError(f"The nominal of {whose}, is {nominal.tolist()}", "Give finite numbers, or None")
    local = ca.SX.sym("local", len(units))
    try:
        value = ca.SX(unknown.packed(unknown.at(ca.DM(nominal), local)))
    except Exception as error:  # whatever a user's function raises
        fix = "It takes nominal and local, each a column, and gives a value built of both"
        raise ProblemError(f"`at` of {whose}, failed: {said(error)}", fix) from error
    for j, unit in enumerate(units):
        if not ca.depends_on(value, local[j]):
            fix = "Build the value from all of local, which is zero at the nominal"
            raise ProblemError(f"`at` of {whose}, does not use number {j + 1} of local ({unit})", fix)


def tangent_basis(unit: Array) -> Array:
    """Two unit vectors (3, 2) that complete a unit vector (3,) to a right-handed orthonormal basis."""
    k = int(np.argmin(np.abs(unit)))
    after, last = (k + 1) % 3, (k + 2) % 3
    first = np.zeros(3)
    first[after], first[last] = unit[last], -unit[after]  # unit x e_k
    first /= math.sqrt(float(first @ first))
    return np.column_stack([first, unit[[1, 2, 0]] * first[[2, 0, 1]] - unit[[2, 0, 1]] * first[[1, 2, 0]]])


def unit_vector(values: Sequence[float] | Array, what: str) -> Array:
    """Normalise a 3-vector; raises ProblemError when it has no direction."""
    vector = np.asarray(values, dtype=np.float64)
    length = float(np.linalg.norm(vector)) if vector.shape == (3,) else math.nan
    if not math.isfinite(length) or length < 1e-12:
        raise ProblemError(f"{what} is {_shown(vector)}", "Give three numbers that are not all zero")
    return np.asarray(vector / length)


def _shown(values: Array) -> str:
    return "[" + ", ".join(f"{value:g}" for value in np.ravel(values)[:8]) + "]"


@dataclass(frozen=True)
class Parameter(Unknown):
    """A number or a vector of numbers, each with a nominal value, a unit and a prior.

    Args:
        values: nominal value, a float (then the value is a scalar) or a sequence (then a vector); None for a scalar
            that the data are to propose, or, with labels, for a vector.
        unit: "mm", "rad" or any other word; only "mm" and "rad" have a default `start_std`.
        prior_std: standard deviation of the deviation from nominal, one or one each, in `unit`; `math.inf` is flat;
            None takes 0.7 mm or 1 mrad, or flat when the data are to propose the value.
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
            what = f"A parameter of {self._all.size} values has {len(self.labels)} labels"
            raise ProblemError(what, "Give one label per value")
        if self.values is None and not self._free.all() and not self.held_as_proposed:
            raise ProblemError("A parameter is held but has no value", "Give its value, or leave it free")
        other = self.unit.strip().lower() if isinstance(self.unit, str) else ""
        if other in OTHER_UNITS or (other in START_STD and other != self.unit):
            factor, unit = OTHER_UNITS.get(other, (1.0, other))
            what = f"A parameter is in '{self.unit}', and models are in mm and rad"
            raise ProblemError(what, f"Give value and prior_std times {factor:g}, with unit='{unit}'")
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
        std = self.prior_std
        if std is None and self.values is not None and self.unit not in PRIOR_STD:
            what = f"A parameter in '{self.unit}' has no prior_std"
            raise ProblemError(what, "Give one, or math.inf for a flat prior")
        if std is None:
            std = math.inf if self.values is None else PRIOR_STD[self.unit]
        return spread(std, self._all.size, "prior_std of a parameter")

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
        stated = self.start_std
        start = None if stated is None else spread(stated, self._all.size, "start_std")[self._free]
        return np.asarray(read_only(start_stds(self.prior_stds, start, self.units, "a parameter")))

    @property
    def nominal(self) -> Array | None:
        """All components, free or held; None when the data must propose them."""
        return None if self.values is None else np.atleast_1d(self._all).copy()

    @property
    def nominal_size(self) -> int:
        """One number per component."""
        return self._all.size

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
        places = np.cumsum(self._free) - 1  # index of each free component in `local`
        entries = [nominal[i] + local[int(places[i])] if free else nominal[i] for i, free in enumerate(self._free)]
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
        return ca.vertcat(raw - nominal[np.flatnonzero(self._free).tolist()])

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
