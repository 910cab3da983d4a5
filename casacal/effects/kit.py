"""The effects to expect of any arm, whatever measures it, and problems that have them as their terms."""

from __future__ import annotations

from casacal.effects.compliance import DOWN, GravitySag, LinkSag
from casacal.effects.effect import Effect
from casacal.effects.gears import Backlash, GearRipple, JointCoupling, TransmissionError
from casacal.effects.smooth import Drift, FaceForm, JointField, PlateForm, SphereForm, ThermalGrowth
from casacal.effects.trusted import CONSTANTS, FocalLength
from casacal.model.problem import Problem
from casacal.model.term import Term


def kit(*, down: tuple[float, float, float] = DOWN, links: bool = False) -> tuple[Effect, ...]:
    """The standard effects; those that mean nothing to a robot or an instrument have no unknowns there.

    down: direction of gravity in the base frame; of an arm that hangs or stands at a wall it is another. links: sag by
    the weights of all links, of which nothing is known, in place of that by one weight at the flange.
    """
    gears = TransmissionError(order=1), TransmissionError(order=2), GearRipple(), JointCoupling()
    sag = LinkSag(down=down) if links else GravitySag(down=down)
    forms = FaceForm(), SphereForm(), PlateForm(), JointField()
    return (*gears, sag, Backlash(), *forms, Drift(), ThermalGrowth(), FocalLength(), CONSTANTS)


def rich_kit(*, down: tuple[float, float, float] = DOWN) -> tuple[Effect, ...]:
    """Standard effects for rows whose errors are mostly shared: with a wider error field of unknown origin."""
    return tuple(JointField(reach=0.7, rank=120) if isinstance(each, JointField) else each for each in kit(down=down))


STANDARD, BY_LINKS, RICH = kit(), kit(links=True), rich_kit()  # the same values each time: what is compiled knows them


def own_terms(problem: Problem) -> tuple[Term, ...]:
    """Terms that a problem declares, but for the constants that its instruments take for exact."""
    return tuple(term for term in problem.terms if term != CONSTANTS)


def with_kit(problem: Problem) -> Problem:
    """A problem with its own terms, or with the effects that any arm is expected to have."""
    return problem if own_terms(problem) else problem.with_terms(*STANDARD)


def with_link_kit(problem: Problem) -> Problem:
    """A problem with the standard effects, gravity sag by the weights of links."""
    return problem.with_terms(*BY_LINKS)


def with_rich_kit(problem: Problem) -> Problem:
    """A problem with the effects of `rich_kit`."""
    return problem.with_terms(*RICH)
