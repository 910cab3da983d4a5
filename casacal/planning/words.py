"""What a plan is worth, in sentences and in JSON's own types."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from casacal.planning.clearance import Clearance
from casacal.planning.plan import Plan
from casacal.planning.route import AGAIN, CHECK, FIT
from casacal.planning.setups import SetUp

FLAT = 0.93
"""Error over that of fewer touches above which more bring little."""


def told(plan: Plan, compared: Sequence[SetUp], *, where: str, pool: int, after: bool) -> list[str]:
    """Sentences: how many, what to expect, the curve and where it flattens, other set-ups.

    where: where the tip is wanted, in words. pool: among how many was chosen. after: whether others were made before.
    """
    fitted, check, again = (plan.purposes.count(purpose) for purpose in (FIT, CHECK, AGAIN))
    without = "Without them" if after else "Priors alone"
    left = ", ".join(f"{count} {error:.3g}" for count, error in plan.curve.items())
    said = [
        f"{len(plan)} touches: {fitted} to fit, {again} of them once more, {check} kept to verify",
        f"Expect a tip error of {plan.error:.3g} mm RMS {where}, apart from where the base stands, if stated noise and "
        f"priors are right. {without}: {plan.before:.3g} mm; as many at random: {plan.at_random:.3g} mm; all {pool} "
        f"that were looked at: {plan.best:.3g} mm. On arms that are not as drawn, by as much as priors say: "
        f"{plan.over_arms:.3g} mm; a tenth of the touches lost: {plan.if_lost:.3g} mm",
        f"Fitted touches and what they leave, mm: {left}{_flat(plan)}",
    ]
    if compared:
        said.append(f"Other set-ups, each with {fitted} fitted touches chosen among fewer:")
    for each in compared:
        reach = "this arm cannot touch it" if math.isinf(each.error) else f"{each.error:.3g} mm"
        said.append(f"  {reach}: {each.words}")
    return said


def document(
    plan: Plan, compared: Sequence[SetUp], written: Sequence[str], clearance: Clearance | None = None
) -> dict[str, Any]:
    """The same for another program."""
    counts = {purpose: plan.purposes.count(purpose) for purpose in dict.fromkeys(plan.purposes)}
    errors = {
        "expected": plan.error,
        "at_random": plan.at_random,
        "before": plan.before,
        "of_all": plan.best,
        "if_a_tenth_is_lost": plan.if_lost,
        "over_arms": plan.over_arms,
    }
    curve = [{"touches": count, "expected_mm": error} for count, error in plan.curve.items()]
    found: dict[str, Any] = {"touches": counts, "tip_rms_mm": errors, "curve": curve, "written": list(written)}
    if clearance is not None and clearance.shapes is not None:
        shapes = clearance.shapes
        found["shapes"] = {
            "looked_at": [each.link for each in shapes.shapes],
            "not_looked_at": list(shapes.unread),
            "let_be": [list(pair) for pair in shapes.let_be],
        }
    if compared:
        found["setups"] = [{"words": each.words, "expected_mm": each.error} for each in compared]
    return found


def _flat(plan: Plan) -> str:
    """Where the curve flattens, in words."""
    for few, many in pairwise(sorted(plan.curve)):
        if plan.curve[many] > FLAT * plan.curve[few]:
            return f"; beyond {few} little is gained"
    return ""
