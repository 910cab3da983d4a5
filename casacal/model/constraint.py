"""What is known of unknowns beside rows and their own priors: ties, bounds, certified sums, errors that go together.

p holds the values of all unknowns as `pose` and `residual` take them: p.a for a key, p["dial.tool"] for one of several
instruments, p["plane.floor"] where there is one for each label.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from casacal.errors import CasacalError, ProblemError, UnknownNameError, came, refuse_unknown, said
from casacal.kernels.program import graph_data, graph_from
from casacal.model.geometry import packed_symbols
from casacal.model.unknown import Unknown
from casacal.values import Value, is_finite, is_real, plain

NOT_UNITS = ("deg", "degrees", "mrad", "um", "cm", "m", "in", "inch", "inches")  # p has no value in any of these


class NamedValues(dict[str, Any]):
    """Values of unknowns by full name, each made when it is first asked for."""

    def __init__(self, make: Callable[[str], Any]) -> None:
        super().__init__()
        self._make = make

    def __missing__(self, name: str) -> Any:
        return self.setdefault(name, self._make(name))

    def __getattribute__(self, name: str) -> Any:
        return super().__getattribute__(name) if name.startswith("_") or name == "setdefault" else self[name]


@dataclass(frozen=True, eq=False)
class Constraint(Value):
    """A quantity that an arm is known to keep; made by `equal`, `between` and `certified`.

    expression: p -> one number in `unit`. low, high: its range, both ends alike for an equality, infinite where open.
    std: standard deviation about `low` of a certified quantity; zero where it holds exactly. names, graph: once it is
    part of a problem, the unknowns that it names, and in JSON what it makes of their packed values; `expression` is
    then None.
    """

    name: str
    expression: Callable[[Any], Any] | None
    low: float
    high: float
    unit: str = "mm"
    std: float = 0.0
    names: tuple[str, ...] = ()
    graph: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name or not self.name.isprintable():
            raise ProblemError(f"A constraint is named {self.name!r}", "Give it a word or two, such as 'twins'")
        if not callable(self.expression) and not self.graph:
            fix = "Give a function of p, such as lambda p: p.a[1] - p.a[2]"
            raise ProblemError(f"Got {came(self.expression)} as the expression of '{self.name}'", fix)
        if not isinstance(self.unit, str) or self.unit in NOT_UNITS:
            fix = "Build it in mm or rad, as p has its values, and say so"
            raise ProblemError(f"'{self.name}' has the unit {self.unit!r}", fix)
        numbers = is_real(self.low) and is_real(self.high) and is_finite(self.std)
        held = numbers and (is_finite(self.low) or is_finite(self.high)) and self.low <= self.high and self.std >= 0
        if not held:
            what = f"'{self.name}' lies between {self.low!r} and {self.high!r}, give or take {self.std!r}"
            fix = "Give numbers, the lower end first, one end finite at least, and no negative error"
            raise ProblemError(what, fix)

    @cached_property
    def function(self) -> ca.Function:
        """Packed values of the unknowns that it names to the quantity, once it is part of a problem."""
        return graph_from(json.loads(self.graph))

    def traced(self, unknowns: Mapping[str, Unknown]) -> Constraint:
        """A copy with its expression as a graph; raises ProblemError for what is no number of these unknowns."""
        if self.expression is None:
            return self
        symbols = dict[str, ca.SX]()

        def make(name: str) -> Any:
            labelled = (key for key, u in unknowns.items() if u.per is not None and name.startswith(f"{key}."))
            key = name if name in unknowns else next(labelled, "")
            if not key:
                raise UnknownNameError("unknown", name, unknowns)
            if key == name and (per := unknowns[key].per) is not None:
                raise ProblemError(f"there is one '{key}' for each {per}", f'Name it: p["{key}.LABEL"]')
            (symbols[name],), values = packed_symbols({name: unknowns[key]})
            return values[name]

        fix = "Build one number from p with CasADi's operations, such as p.a[1] - p.a[2]"
        try:
            built = self.expression(NamedValues(make))
        except CasacalError as error:
            raise ProblemError(f"Constraint '{self.name}': {error.what}", error.fix) from error
        except Exception as error:  # whatever a user's function raises
            raise ProblemError(f"Constraint '{self.name}' failed with {said(error)}", fix) from error
        if not isinstance(built, ca.SX) or built.shape != (1, 1):
            shape = f" of the shape {built.shape}" if isinstance(built, ca.SX) else ""
            raise ProblemError(f"Constraint '{self.name}' gives {came(built)}{shape}, not one number from p", fix)
        if not ca.depends_on(built, ca.vertcat(*map(ca.vec, symbols.values()), ca.SX(0, 1))):
            raise ProblemError(f"Constraint '{self.name}' depends on no unknown", fix)
        try:
            graph = ca.Function("quantity", list(symbols.values()), [ca.densify(built)])
        except RuntimeError as error:
            raise ProblemError(f"Constraint '{self.name}' depends on a symbol that is no part of p", fix) from error
        return replace(self, expression=None, names=tuple(symbols), graph=json.dumps(graph_data(graph)))


def equal(name: str, expression: Callable[[Any], Any], *, value: float = 0.0, unit: str = "mm") -> Constraint:
    """A quantity of the unknowns that is exactly `value`: lengths out of one mould, a loop that closes.

    Args:
        name: what results and sentences call it.
        expression: p -> one number, built from the values of the unknowns.
        value: what it equals, in `unit`.
        unit: of the quantity, "mm" or "rad", in which p has its values; or one's own word, such as "mm^2".

    Raises ProblemError for what is none of these.

    """
    return Constraint(name, expression, value, value, unit)


def between(
    name: str, expression: Callable[[Any], Any], low: float = -math.inf, high: float = math.inf, *, unit: str = "mm"
) -> Constraint:
    """A quantity that is not below `low` nor above `high`, in `unit`; infinite where open. The rest as for `equal`."""
    return Constraint(name, expression, low, high, unit)


def certified(name: str, expression: Callable[[Any], Any], value: float, *, std: float, unit: str = "mm") -> Constraint:
    """A linear quantity that was measured beforehand as `value` with the standard error `std`, as a certificate says.

    It says nothing of the unknowns one by one, and joins their own priors, which must be finite. The rest as for
    `equal`, which a `std` of zero makes of it.
    """
    return Constraint(name, expression, value, value, unit, std)


@dataclass(frozen=True)
class Correlation:
    """Correlation matrix (k, k) of the prior errors of some unknowns; made by `Problem.with_prior`."""

    name: str
    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]

    def traced(self, unknowns: Mapping[str, Unknown]) -> Correlation:
        """Itself; raises UnknownNameError for what is no single number of these unknowns."""
        known = [name for key, unknown in unknowns.items() if not unknown.per for name in unknown.component_names(key)]
        refuse_unknown("number", self.names, known)
        return self

    @staticmethod
    def of(names: Sequence[str], covariance: Any) -> tuple[Correlation, dict[str, float]]:
        """Correlation and standard deviations of a covariance (k, k); ProblemError for what is none."""
        try:
            matrix = np.asarray(covariance, dtype=np.float64)
        except (TypeError, ValueError):
            matrix = np.zeros(0)
        several = not isinstance(names, str) and len(set(names)) > 1
        sound = several and matrix.shape == (len(names), len(names)) and np.array_equal(matrix, matrix.T)
        if not sound or not np.isfinite(matrix).all() or np.linalg.eigvalsh(matrix)[0] <= 0:
            what = f"What came of {names!r} is no covariance: symmetric, with positive eigenvalues, a row for each name"
            raise ProblemError(what, 'Give such as {("a2", "a3"): [[0.4, 0.1], [0.1, 0.4]]}; `equal` ties exactly')
        std = np.sqrt(np.diagonal(matrix))
        made = Correlation(", ".join(names), tuple(names), plain(matrix / np.outer(std, std)))
        return made, dict(zip(names, std.tolist(), strict=True))
