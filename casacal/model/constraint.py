"""What is known of unknowns beside rows and their own priors: ties, bounds, certified sums, errors that go together.

    Problem(robot, dial, constraints=(
        equal("twins", lambda p: p.a[1] - p.a[2]),
        between("elbow", lambda p: p.d[3], 440.0, 442.0),
        certified("arm", lambda p: p.a[1] + p.a[2], 817.1, std=0.05),
    ))

p holds the values of all unknowns as `pose` and `residual` take them: p.a for a key, p["dial.tool"] for one of several
instruments, p["plane.floor"] where there is one for each label.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from casacal.errors import CasacalError, ProblemError, UnknownNameError, came, refuse_unknown, said
from casacal.kernels.program import graph_data
from casacal.model.geometry import packed_symbols
from casacal.model.unknown import Unknown
from casacal.values import Value, is_finite, is_real, plain


class NamedValues:
    """Values of unknowns by full name, each made when it is first asked for."""

    def __init__(self, make: Callable[[str], Any]) -> None:
        self._make, self._made = make, dict[str, Any]()

    def __getitem__(self, name: str) -> Any:
        if name not in self._made:
            self._made[name] = self._make(name)
        return self._made[name]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return self[name]


@dataclass(frozen=True, eq=False)
class Constraint(Value):
    """A quantity that an arm is known to keep; made by `equal`, `between` and `certified`.

    expression: p -> one number in `unit`. low, high: its range, both ends alike for an equality, infinite where open.
    std: standard deviation about `low` of a certified quantity; zero where it holds exactly. names, graph: once it is
    part of a problem, the unknowns that it names, and the function of their packed values; `expression` is then None.
    """

    name: str
    expression: Callable[[Any], Any] | None
    low: float
    high: float
    unit: str = "mm"
    std: float = 0.0
    names: tuple[str, ...] = ()
    graph: ca.Function | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name or not self.name.isprintable():
            raise ProblemError(f"A constraint is named {self.name!r}", "Give it a word or two, such as 'twins'")
        if not callable(self.expression) and self.graph is None:
            fix = "Give a function of p, such as lambda p: p.a[1] - p.a[2]"
            raise ProblemError(f"Got {came(self.expression)} as the expression of '{self.name}'", fix)
        if not all(is_real(end) and not math.isnan(end) for end in (self.low, self.high)) or not is_finite(self.std):
            what = f"'{self.name}' lies between {self.low!r} and {self.high!r}, give or take {self.std!r}"
            raise ProblemError(what, "Give numbers")
        if self.low > self.high or not (is_finite(self.low) or is_finite(self.high)) or self.std < 0:
            what = f"'{self.name}' lies between {self.low:g} and {self.high:g}, give or take {self.std:g}"
            raise ProblemError(what, "Give the lower end first, one end at least that is finite, and no negative error")

    @property
    def text(self) -> str:
        """All that it says, once it is part of a problem."""
        graph = None if self.graph is None else graph_data(self.graph)
        return f"{self.name} {self.low!r} {self.high!r} {self.unit} {self.std!r} {self.names} {graph}"

    def __eq__(self, other: object) -> bool:
        """Whether both say the same, instruction by instruction."""
        return isinstance(other, Constraint) and self.expression == other.expression and self.text == other.text

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
        return replace(self, expression=None, names=tuple(symbols), graph=graph)


def equal(name: str, expression: Callable[[Any], Any], *, value: float = 0.0, unit: str = "mm") -> Constraint:
    """A quantity of the unknowns that is exactly `value`: lengths out of one mould, a loop that closes.

    Args:
        name: what results and sentences call it.
        expression: p -> one number, built from the values of the unknowns.
        value: what it equals, in `unit`.
        unit: of the quantity, "mm" or "rad" or one's own word.

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

    @property
    def text(self) -> str:
        """All that it says."""
        return repr(self)

    def traced(self, unknowns: Mapping[str, Unknown]) -> Correlation:
        """Itself; raises UnknownNameError for what is no single number of these unknowns."""
        refuse_unknown(
            "number", self.names, [n for k, u in unknowns.items() if not u.per for n in u.component_names(k)]
        )
        return self

    @staticmethod
    def of(names: Sequence[str], covariance: Any) -> tuple[Correlation, dict[str, float]]:
        """Correlation and standard deviations of a covariance (k, k); ProblemError for what is none."""
        matrix, several = np.asarray(covariance, dtype=np.float64), not isinstance(names, str) and len(set(names)) > 1
        sound = several and matrix.shape == (len(names), len(names)) and np.array_equal(matrix, matrix.T)
        if not sound or not np.isfinite(matrix).all() or np.linalg.eigvalsh(matrix)[0] <= 0:
            what = f"What came of {names!r} is no covariance: symmetric, with positive eigenvalues, a row for each name"
            raise ProblemError(what, 'Give such as {("a2", "a3"): [[0.4, 0.1], [0.1, 0.4]]}; `equal` ties exactly')
        std = np.sqrt(np.diagonal(matrix))
        made = Correlation(", ".join(names), tuple(names), plain(matrix / np.outer(std, std)))
        return made, dict(zip(names, std.tolist(), strict=True))
