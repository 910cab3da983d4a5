"""Effects: terms with an expected size, its doubt, and columns of a file that drive them."""

from __future__ import annotations

import math
from abc import ABC
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from casacal.data.samples import Samples
from casacal.data.text import finite_numbers
from casacal.errors import ProblemError, SamplesError
from casacal.model.instrument import Instrument
from casacal.model.problem import Problem
from casacal.model.term import Site, Term
from casacal.model.unknown import Parameter
from casacal.values import Array, Rows, is_real
from casacal.wording import listed


class Effect(Term, ABC):
    """A small error of arm or cell that no link length, twist or offset describes.

    Its unknowns are zero on average; how far they are from it is their size: what one would expect of such an arm, to
    be corrected by what the samples show. Beside what a `Term` has, it says `size` and `doubt`.
    """

    size: float
    """Standard deviation to expect of an unknown of weight one, in its unit."""
    doubt: float
    """Times by which the size may well be larger; it may be smaller by the square of it, up to six; one holds it."""
    most: ClassVar[float] = 5.0
    """Times its size that it never exceeds: a gear that is five times as bad is broken, and something else errs."""
    unit: ClassVar[str] = ""
    """Unit of its size; that of its unknowns where empty."""
    elastic: ClassVar[bool] = False
    """Whether its largest size is still plausible as the effect itself, as of an arm softer than expected."""

    def amounts(self, site: Site, samples: Samples) -> Mapping[str, Array]:
        """Columns of `further` (N,), by name, that hold amounts: the effect is known near those of the fitted rows."""
        columns = self.told(site, samples)
        return {column: columns[name] for column, name in zip(self.further, self.columns(site), strict=False)}

    def check(self) -> None:
        """Raise ProblemError unless size, doubt and most are numbers that mean something."""
        for what, least in (("size", 0.0), ("doubt", 1.0), ("most", 1.0)):
            value = getattr(self, what)
            if not is_real(value) or not least <= value < math.inf or value == 0:
                fix = f"Give a positive number, {least:g} or more" if least else "Give a positive number"
                raise ProblemError(f"The {what} of {type(self).__name__} is {value!r}", fix)


def effects_of(problem: Problem) -> tuple[Effect, ...]:
    """The effects among the terms of a problem."""
    return tuple(term for term in problem.terms if isinstance(term, Effect))


def weighted(weights: Array, size: float, unit: str, per: str | None = None) -> Parameter:
    """Unknowns about zero whose standard deviations are a size times their weights (m,)."""
    return Parameter([0.0] * len(weights), unit=unit, prior_std=[size * float(weight) for weight in weights], per=per)


def is_plainly(instrument: Instrument, kind: str) -> bool:
    """Whether an instrument is of a class of `casacal.model`, such as "points.SphereTouch", and not one made of it."""
    return f"{type(instrument).__module__}.{type(instrument).__qualname__}" == f"casacal.model.{kind}"


class ByColumns(Effect, ABC):
    """An effect of which a column of the samples for each joint says something."""

    columns_of: tuple[str, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "columns_of", tuple(self.columns_of))

    @property
    def further(self) -> tuple[str, ...]:
        """These columns."""
        return self.columns_of


def check_columns_of(columns: Sequence[str], joints: int, what: str) -> None:
    """Raise ProblemError unless there is a column for each joint."""
    if len(columns) != joints:
        raise ProblemError(f"Got {len(columns)} columns of {what} for {joints} joints", "Name one for each")


def read_columns_of(samples: Samples, columns: Sequence[str], joints: int, what: str) -> Array:
    """Numbers (N, n) of some columns that samples have beside those of their instrument, one for each joint.

    Raises ProblemError where one is missing, SamplesError for a cell that is no number.
    """
    check_columns_of(columns, joints, what)
    if missing := [column for column in columns if column not in samples.extra]:
        known = ", ".join(samples.extra)
        others = f", nor {listed(missing[1:])}" if missing[1:] else ""
        fix = f"Give it; further columns there are: {known}" if known else "Add it, and read the rows with this problem"
        raise ProblemError(f"{samples.file} has no column '{missing[0]}' of {what}{others}", fix)
    found = []
    for column in columns:
        cells = samples.extra[column]
        if not isinstance(cells, np.ndarray):  # samples of another problem hold them as text
            cells = np.array(finite_numbers(samples.file, column, cells, samples.lines))
        found.append(cells)
    return np.column_stack(found)


def refuse_unless(good: Rows, samples: Samples, columns: Sequence[str], values: Array, what: str, fix: str) -> None:
    """Raise SamplesError for the first of some values (N, n) of columns that is not good (N, n)."""
    for row, j in np.argwhere(~good)[:1]:
        said, line = f"{values[row, j]:g} {what}", int(samples.lines[row])
        raise SamplesError(samples.file, said, fix, line=line, column=columns[j])
