"""What is known of unknowns beside the rows: ties, bounds, and certified sizes, as expressions of a problem's symbols.

    Problem(robot, dial, constraints=(
        equal("twins", lambda p: p.a[1] - p.a[2]),
        between("elbow", lambda p: p.d[3], 440.0, 442.0),
    ))

p holds the values of all unknowns as `pose` and `residual` take them: p.a for a key, p["dial.tool"] for one of several
instruments, p["plane.floor"] where there is one for each label.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca

from casacal.errors import CasacalError, ProblemError, UnknownNameError, came, said
from casacal.kernels.program import graph_data
from casacal.model.geometry import packed_symbols
from casacal.model.unknown import Unknown
from casacal.values import Value, is_finite, is_real


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
class TracedQuantity(Value):
    """A user's expression as a graph: packed values of the unknowns that it names, in this order, to one number."""

    names: tuple[str, ...]
    graph: ca.Function

    def __call__(self, packed: Callable[[str], Any]) -> Any:
        """The number, of packed values by name."""
        return self.graph(*map(packed, self.names))

    @property
    def text(self) -> str:
        """Names and graph as text."""
        return f"{self.names} {graph_data(self.graph)}"

    def __eq__(self, other: object) -> bool:
        """Whether both graphs are alike, instruction by instruction."""
        return isinstance(other, TracedQuantity) and self.text == other.text


@dataclass(frozen=True, eq=False)
class Constraint(Value):
    """A quantity that an arm is known to keep; made by `equal`, `between` and `certified`.

    expression: p -> one number in `unit`. low, high: its range, both ends alike for an equality, infinite where open.
    std: standard deviation about `low` of a certified quantity; zero where it holds exactly.
    """

    name: str
    expression: Callable[[Any], Any]
    low: float
    high: float
    unit: str = "mm"
    std: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name or not self.name.isprintable():
            raise ProblemError(f"A constraint is named {self.name!r}", "Give it a word or two, such as 'twins'")
        if not callable(self.expression):
            fix = "Give a function of p, such as lambda p: p.a[1] - p.a[2]"
            raise ProblemError(f"Got {came(self.expression)} as the expression of '{self.name}'", fix)
        if not all(is_real(end) and not math.isnan(end) for end in (self.low, self.high)):
            raise ProblemError(f"'{self.name}' lies between {self.low!r} and {self.high!r}", "Give two numbers")
        if self.low > self.high or math.inf in (self.low, -self.high) or -self.low == self.high == math.inf:
            what = f"'{self.name}' is to lie between {self.low:g} and {self.high:g}, where no number is held"
            raise ProblemError(what, "Give the lower end first, and one end at least that is finite")
        if not is_finite(self.std) or self.std < 0:
            raise ProblemError(f"The standard deviation of '{self.name}' is {self.std!r}", "Give a positive number")

    @property
    def quantity(self) -> TracedQuantity:
        """The expression, once it is part of a problem."""
        assert isinstance(self.expression, TracedQuantity)
        return self.expression

    @property
    def text(self) -> str:
        """All that it says, once it is part of a problem."""
        return f"{self.name} {self.low!r} {self.high!r} {self.unit} {self.std!r} {self.quantity.text}"

    def traced(self, unknowns: Mapping[str, Unknown]) -> Constraint:
        """A copy with its expression as a graph; raises ProblemError for what is no number of these unknowns."""
        if isinstance(self.expression, TracedQuantity):
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
        return replace(self, expression=TracedQuantity(tuple(symbols), graph))


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
    """A quantity of the unknowns that is not below `low` nor above `high`, in `unit`; infinite where one end is open.

    Arguments and errors as for `equal`.
    """
    return Constraint(name, expression, low, high, unit)
