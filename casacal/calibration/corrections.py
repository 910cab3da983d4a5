"""Which effects beside the geometry are corrected: those that tell of rows they have not seen, and help the tip."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from casacal.binding.bound_problem import BoundProblem
from casacal.calibration.motion import Motion, sees_the_tip, used_arm
from casacal.discrepancy.effect import Site
from casacal.least_squares.result import Result
from casacal.uncertainty.discrepancy import at_most
from casacal.uncertainty.expectation import expected_accuracy
from casacal.uncertainty.transfer import gains, in_sample_gains
from casacal.values import FrozenMapping, Value

VERY_STRONG = 5.0
"""Logarithm of a ratio of densities from which evidence is called very strong (Kass and Raftery, Journal of the
American Statistical Association 90, 1995, section 3.2: 2 ln B above 10)."""


@dataclass(frozen=True, eq=False)
class Tried(Value):
    """An effect that could be corrected, and what became of it.

    evidence: by how much the logarithm of the rows' likelihood is larger with it. unseen: the same of rows that were
    left out, by what was left out together; empty where the first was too little to ask. helps: whether the tip error
    to expect is smaller with it; None where that was not asked.
    """

    key: str
    words: str
    evidence: float
    unseen: Mapping[str, float]
    helps: bool | None

    def __post_init__(self) -> None:
        object.__setattr__(self, "unseen", FrozenMapping(self.unseen))

    @property
    def corrected(self) -> bool:
        """Whether `predict` and all that follows it make up for it."""
        return bool(self.helps)


def tried_corrections(fit: BoundProblem, result: Result) -> tuple[Tried, ...]:
    """Every effect of a fit that moves the tip alike whenever it comes to a posture, the most telling first.

    One is corrected where all splits of the rows, by faces, regions of postures and further columns, say with very
    strong evidence that it tells of rows it has not seen, and where the tip is then expected to be nearer. Corrections
    that stand already count. A gear that would have to be broken to be so bad is none: something else errs. Where rows
    see the tip itself, what tells of unseen ones corrects it, whatever it is.

    Args:
        fit: with the effects in it.
        result: its fit.

    """
    sites = [Site(fit.problem.robot, instrument) for instrument in fit.problem.instruments]
    known = {
        effect.key: effect.words
        for effect in fit.problem.effects
        if effect.moves and effect.key in fit.beside and not any(effect.columns(site) for site in sites)
    }
    if not known or not result.converged:
        return ()
    told = in_sample_gains(fit, result.x, known)
    likely = [key for key in known if told[key] > VERY_STRONG]
    unseen = gains(fit, result.x, likely) if likely else {}
    doubted = () if not likely or sees_the_tip(fit) else at_most(fit)
    doubtful = {effect.key for effect in doubted if not effect.elastic}
    stands: list[str] = []
    found = []
    for key in sorted(known, key=lambda key: -told[key]):
        elsewhere = unseen.get(key, {})
        wins = bool(elsewhere) and min(elsewhere.values()) > VERY_STRONG and key not in doubtful
        helps = _tip(fit, result, [*stands, key]) < _tip(fit, result, stands) if wins else None
        stands += [key] if helps else []
        found.append(Tried(key, known[key], told[key], elsewhere, helps))
    return tuple(found)


def _tip(fit: BoundProblem, result: Result, corrected: Collection[str]) -> float:
    """Tip error (mm RMS) to expect over the workspace where these effects are corrected."""
    motion = Motion.of(fit, result, used_arm(fit, result, corrected))
    return expected_accuracy(motion.arm, motion.x, motion.off)[1]
