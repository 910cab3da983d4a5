"""A bound problem in the unknowns of arm and touches alone, or of faces held out of a fit: others taken out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from casacal.data.samples import Samples
from casacal.fit.bound_problem import BoundProblem
from casacal.fit.least_squares import Conditioned
from casacal.fit.lm import lm
from casacal.fit.slots import make_slots
from casacal.values import Array


class ArmAlone(Conditioned):
    """The unknowns (s,) of a bound problem's geometry, and of terms beside it none, or those that move the tip.

    The others stand at a given x and move freely with these. With `motion`, terms that move the tip are among them.
    """

    whole: BoundProblem

    def __init__(self, whole: BoundProblem, at: Array, *, motion: bool = False) -> None:
        kept = {term.key for term in whole.problem.terms if term.moves} if motion else set()
        out = np.array([bool(key) and key not in kept for key in whole.beside], dtype=bool)
        super().__init__(whole, ~out, at, out=out)
        self.problem, self.blocks, self.slots = whole.problem, whole.blocks, whole.slots

    def __eq__(self, other: object) -> bool:
        if self is other or not isinstance(other, ArmAlone):
            return self is other
        same = np.array_equal(self.free, other.free) and np.array_equal(self.held_at, other.held_at)
        return same and self.whole == other.whole

    def __hash__(self) -> int:
        return hash((self.whole, self.names))

    def parameters(self) -> Iterator[tuple[str, str, float, int | None]]:
        """Every number of every parameter: name, unit, nominal, and its position in x (None when held)."""
        places = {name: j for j, name in enumerate(self.names)}
        return ((name, unit, nominal, places.get(name)) for name, unit, nominal, _ in self.whole.parameters())

    def tips(self, x: Array, joints: Array, instrument: int = 0) -> Array:
        """Tips (N, 3; mm) at joint values (N, n; rad, mm) and reading zero."""
        return self.whole.tips(self.expand(x), joints, instrument)

    def tip_jacobian(self, x: Array, joints: Array, instrument: int = 0, *, usual: bool = True) -> Array:
        """Derivative (3 N, s) of those tips by x, in units of mm per unit of x; `usual` as for `Block.posture`."""
        return self.whole.tip_jacobian(self.expand(x), joints, instrument, self.free, usual=usual)


Seen: TypeAlias = BoundProblem | ArmAlone
"""What figures of the arm are worked out from."""


def seen(bound: BoundProblem, x: Array, *, motion: bool = False) -> tuple[Seen, Array]:
    """Problem with nuisance unknowns marginalised at x (n,), and its part of x; both unchanged where there are none."""
    if not any(bound.beside):
        return bound, x
    found = ArmAlone(bound, x, motion=motion)
    return found, x[found.free]


def moving(bound: BoundProblem, x: Array) -> tuple[Seen, Array]:
    """All that moves the tip at x (n,), geometry and terms beside it, and the part of x that it has."""
    return seen(bound, x, motion=True)


def bind_further(bound: BoundProblem, *samples: Samples) -> BoundProblem:
    """Bind the same unknowns to other rows, and after them those of labels that are new; one set per instrument.

    Raises ProblemError as `bind` does.
    """
    seen = {slot.name: slot.nominal for slot in bound.slots}
    slots = list(bound.slots)
    for slot in make_slots(bound.problem, samples, seen):
        if slot.name not in seen:
            slots.append(replace(slot, first=slots[-1].first + slots[-1].unknown.size))
    if len(slots) == len(seen):
        return bound.on(*samples)
    return BoundProblem(
        bound.problem, slots, samples, bound.backend, scale=bound.scale, surveys=bound.surveys, known=bound.known
    )


def extended(further: BoundProblem, x: Array) -> Array:
    """All unknowns (n + k,) of such rows at x (n,): those of new labels are fitted to their rows, nothing else is."""
    new = np.arange(further.unknowns) >= x.size
    if not new.any():
        return x
    part = Conditioned(further, new, np.concatenate([x, np.zeros(int(new.sum()))]))
    return np.asarray(part.expand(lm(part).x))
