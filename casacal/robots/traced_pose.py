"""A pose function as the graph that CasADi traced: what is compared, and what travels where Python code cannot."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from casacal.kinematics import Expression, Product, position
from casacal.unknowns import Unknown
from casacal.unknowns.fits import packed_symbols
from casacal.values import FrozenMapping


@dataclass(frozen=True, eq=False)
class TracedPose:
    """`pose(p, q)` as a graph: the parameters' values, by key, and q give the factors of the 4x4 flange pose (mm).

    Two are equal when their graphs are, instruction by instruction.
    """

    unknowns: Mapping[str, Unknown]
    graph: ca.Function

    @staticmethod
    def of(pose: Callable[[Any, Expression], Expression], parameters: Mapping[str, Unknown], joints: int) -> TracedPose:
        """Trace a pose function; lets pass what the function raises."""
        q = ca.SX.sym("q", joints)
        symbols, values = packed_symbols(parameters)
        built = pose(SimpleNamespace(**values), q)
        factors = [ca.SX(f) for f in built.factors] if isinstance(built, Product) else [ca.SX(built)]
        return TracedPose(FrozenMapping(parameters), ca.Function("pose", [*symbols, q], factors))

    def __call__(self, p: Any, q: Expression) -> Expression:
        """The flange pose, as the function that was traced gives it."""
        values = [unknown.packed(getattr(p, key)) for key, unknown in self.unknowns.items()]
        factors = self.graph.call([*values, q])
        return factors[0] if len(factors) == 1 else Product(factors)

    @property
    def drawn(self) -> dict[str, Any]:
        """Values of the parameters by key, as `pose` takes them, of the arm as drawn."""
        return {
            key: unknown.at(ca.DM(np.asarray(unknown.nominal)), ca.DM.zeros(unknown.size))
            for key, unknown in self.unknowns.items()
        }

    @cached_property
    def levers(self) -> ca.Function:
        """q -> derivative (3, n) of the flange's origin by the joint values, mm, of the arm as drawn."""
        q = ca.SX.sym("q", self.graph.size1_in(self.graph.n_in() - 1))
        place = position(self(SimpleNamespace(**self.drawn), q))
        return ca.Function("levers", [q], [ca.densify(ca.jacobian(place, q))])

    @cached_property
    def text(self) -> str:
        """The graph as text."""
        return str(self.graph.serialize())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TracedPose) and list(self.unknowns) == list(other.unknowns) and self.text == other.text

    def __hash__(self) -> int:
        return hash(self.text)

    def __getstate__(self) -> dict[str, Any]:
        return {"unknowns": self.unknowns, "graph": self.graph}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        for name, item in state.items():
            object.__setattr__(self, name, item)


def travels(function: Callable[..., Any]) -> bool:
    """Whether a function can be found by its name wherever its package is installed."""
    module = getattr(function, "__module__", None) or type(function).__module__
    if module == "__main__" or module not in sys.modules:
        return False
    try:
        return pickle.loads(pickle.dumps(function)) is not None
    except Exception:  # closures, lambdas, and whatever a user's object raises
        return False
