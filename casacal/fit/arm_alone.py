"""A bound problem with faces, stations and terms that move no tip marginalised, and its extension to new labels."""

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
    """A bound problem in the unknowns (s,) of its geometry; those of terms are marginalised at `at` (n,).

    With `motion`, unknowns of terms that move the tip are kept too, and of those that last from session to session.
    """

    whole: BoundProblem

    def __init__(self, whole: BoundProblem, at: Array, *, motion: bool = False) -> None:
        kept = {term.key for term in whole.problem.terms if term.moves or term.lasting} if motion else set()
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


ArmProblem: TypeAlias = BoundProblem | ArmAlone  # what figures of the arm are computed from


def arm_alone(bound: BoundProblem, x: Array, *, motion: bool = False) -> tuple[ArmProblem, Array]:
    """Problem with nuisance unknowns marginalised at x (n,), and its part of x; both unchanged where there are none."""
    if not any(bound.beside):
        return bound, x
    found = ArmAlone(bound, x, motion=motion)
    return found, x[found.free]


def moving(bound: BoundProblem, x: Array) -> tuple[ArmProblem, Array]:
    """Problem in all unknowns that move the tip, or last, those of terms too, at x (n,), others marginalised; its x."""
    return arm_alone(bound, x, motion=True)


def bind_further(bound: BoundProblem, *samples: Samples) -> BoundProblem:
    """Bind the same unknowns, followed by those of new labels, to other rows; one set of samples per instrument.

    Raises ProblemError as `bind` does.
    """
    nominals = {slot.name: slot.nominal for slot in bound.slots}
    slots = list(bound.slots)
    for slot in make_slots(bound.problem, samples, nominals):
        if slot.name not in nominals:
            slots.append(replace(slot, first=slots[-1].first + slots[-1].unknown.size))
    if len(slots) == len(nominals):
        return bound.on(*samples)
    like = (bound.problem, slots, samples, bound.backend)
    return BoundProblem(*like, scale=bound.scale, surveys=bound.surveys, known=bound.known)


def extended(further: BoundProblem, x: Array) -> Array:
    """x (n,) extended to the unknowns (n + k,) of `further`: those of new labels are fitted, the others held."""
    new = np.arange(further.unknowns) >= x.size
    if not new.any():
        return x
    part = Conditioned(further, new, np.concatenate([x, np.zeros(int(new.sum()))]))
    return np.asarray(part.expand(lm(part).x))
