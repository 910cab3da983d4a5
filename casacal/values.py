"""Values: frozen dataclasses that compare, pickle and copy by their fields alone; names of arrays in signatures."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from casacal.errors import came

Array: TypeAlias = NDArray[np.float64]  # numbers
Rows: TypeAlias = NDArray[np.bool_]  # which rows: true or false for each
Index: TypeAlias = NDArray[np.intp]  # positions
Box: TypeAlias = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]  # ranges of x, y, z, mm

K = TypeVar("K")
V = TypeVar("V")


class FrozenMapping(Mapping[K, V]):
    """A mapping that nobody can change: it pickles, and equals any mapping with the same items."""

    __slots__ = ("_items",)

    def __init__(self, items: Mapping[K, V]) -> None:
        self._items = dict(items)

    def __getitem__(self, key: K) -> V:
        return self._items[key]

    def __iter__(self) -> Iterator[K]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Mapping) and alike(dict(self), dict(other))

    __hash__ = None  # type: ignore[assignment]  # compared by its items

    def __reduce__(self) -> tuple[type, tuple[dict[K, V]]]:
        return FrozenMapping, (dict(self),)

    def __repr__(self) -> str:
        return repr(dict(self))


EMPTY: FrozenMapping[Any, Any] = FrozenMapping({})


class Names(SimpleNamespace):
    """Values by attribute, as p of `pose(p, q)` and row of `residual`; AttributeError lists the names that exist."""

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"there is no '{name}', but {', '.join(vars(self)) or 'nothing at all'}")


class Value:
    """Base of the frozen dataclasses (`eq=False`) that hold arrays and mappings.

    What a value remembers beside its fields (compiled functions, figures once asked for) is neither compared nor
    pickled: it follows from the fields and is found again when it is asked for. A copy of a value is the value itself.
    """

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        if type(self) is not type(other):
            return NotImplemented
        compared = (field.name for field in dataclasses.fields(self) if field.compare)  # type: ignore[arg-type]
        return all(alike(getattr(self, name), getattr(other, name)) for name in compared)

    def __hash__(self) -> int:
        raise TypeError(f"a {type(self).__name__} holds arrays, so it has no hash")

    def __getstate__(self) -> dict[str, Any]:
        return _state(self)

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        for name, item in state.items():
            object.__setattr__(self, name, frozen(item))

    def __copy__(self) -> Any:
        return self

    def __deepcopy__(self, memo: object) -> Any:
        return self


def frozen(item: Any) -> Any:
    """The item with its arrays, at any depth of mappings and tuples, made read-only in place."""
    if isinstance(item, np.ndarray):
        item.setflags(write=False)
    elif isinstance(item, Mapping):
        return FrozenMapping({key: frozen(value) for key, value in item.items()})
    elif type(item) is tuple:
        return tuple(frozen(value) for value in item)
    return item


def read_only(values: Any) -> Any:
    """A read-only array with the same numbers: the array itself where nobody can write to it, else a copy."""
    array = np.asarray(values)
    owner: Any = array
    while (
        isinstance(owner, np.ndarray) and not owner.flags.writeable
    ):  # a view that is not writable may have one that is
        owner = owner.base
    if owner is not None and not isinstance(owner, bytes):
        array = array.copy()
        array.setflags(write=False)
    return array


def plain(item: Any) -> Any:
    """A list or an array as a tuple, at any depth, and NumPy's numbers as Python's: what nobody can change."""
    if isinstance(item, (np.ndarray, np.generic)):
        item = item.tolist()
    return tuple(plain(value) for value in item) if isinstance(item, (list, tuple)) else item


def alike(one: Any, two: Any) -> bool:
    """Whether two values are equal, at any depth of arrays, mappings and lists; NaN equals NaN."""
    if isinstance(one, np.ndarray) or isinstance(two, np.ndarray):
        a, b = np.asarray(one), np.asarray(two)
        return np.array_equal(a, b, equal_nan=a.dtype.kind in "fc" and b.dtype.kind in "fc")
    if isinstance(one, Mapping) and isinstance(two, Mapping):
        return one.keys() == two.keys() and all(alike(value, two[key]) for key, value in one.items())
    if isinstance(one, (tuple, list)) and isinstance(two, (tuple, list)):
        return len(one) == len(two) and all(alike(a, b) for a, b in zip(one, two, strict=True))
    if isinstance(one, float) and isinstance(two, float) and math.isnan(one):
        return math.isnan(two)
    return bool(one is two or one == two)


def short(items: Sequence[Any], most: int = 6) -> str:
    """The first few of many items, for a `repr` of a line."""
    shown = ", ".join(map(str, items[:most]))
    return shown + (f", ... ({len(items)} in all)" if len(items) > most else "")


def _state(value: Any) -> dict[str, Any]:
    return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}


def is_real(value: object) -> bool:
    """Whether something is one real number, Python's or NumPy's; True and False are none."""
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def as_given(value: object) -> str:
    """A value in a refusal: a number as it is, anything else by its type."""
    try:
        return f"{value:g}" if is_real(value) else came(value)
    except OverflowError:
        return came(value)


def is_finite(value: object) -> bool:
    """Whether something is one real number, and neither infinite nor not a number."""
    try:
        return is_real(value) and math.isfinite(value)  # type: ignore[arg-type]
    except OverflowError:  # a whole number of Python's beyond them all
        return False
