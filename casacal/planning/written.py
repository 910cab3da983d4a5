"""A plan in sentences, in JSON's own types, and as a file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from casacal.files import write_text
from casacal.instruments.description import readings_within
from casacal.planning.choice import drawn_touch
from casacal.planning.clearance import Clearance
from casacal.planning.plan import Plan
from casacal.planning.route import AGAIN, CHECK, FIT, postures_text
from casacal.planning.set_ups import POOL, SetUp, worth_most
from casacal.problem.problem import Problem
from casacal.robots.links import is_chain
from casacal.simulation.cell import Cell
from casacal.wording import METRE, UNBOUNDED

FLAT = 0.93  # error over that of fewer touches above which more bring little

ENDS = 0.7  # error of all candidates over that of a number, below which a flat part is not the end of the curve


def told(
    plan: Plan,
    compared: Sequence[SetUp],
    *,
    where: str,
    pool: int,
    after: bool,
    every: bool = True,
    kept_clear: bool = False,
) -> list[str]:
    """Sentences: the set-up that is worth most, how many, what to expect, the curve and where it flattens.

    where: where the tip is wanted, in words. pool: among how many was chosen. after: whether others were made before.
    every: whether all set-ups are listed, not only one that is much better. kept_clear: whether touches keep clear of
    something, which set-ups are compared without.
    """
    fitted, check, again = (plan.purposes.count(purpose) for purpose in (FIT, CHECK, AGAIN))
    without = "Without them" if after else "Priors alone"
    alone = f"{plan.before:.3g} mm" if plan.before < METRE else UNBOUNDED
    left = ", ".join(f"{count} {error:.3g}" for count, error in plan.curve.items())
    flat = [few for few, many in pairwise(sorted(plan.curve)) if plan.curve[many] > FLAT * plan.curve[few]]
    flat = [few for few in flat if plan.best > ENDS * plan.curve[few]]  # or it only seems so, and many more gain much
    left += f"; more than {flat[0]} gain little" if flat else ""
    better = worth_most(compared) if compared else None
    said = [] if better is None else [_advice(*better, fitted, kept_clear)]
    said += [
        f"{len(plan)} touches: {fitted} to fit, {again} of them once more, {check} kept to verify",
        f"Expect a tip error of {plan.error:.3g} mm RMS {where}, apart from the position of the base, if the stated "
        "noise and priors are right; effects beside the geometry are not counted",
        f"{without}: {alone}; the same number at random: {plan.at_random:.3g} mm; all {pool} candidates: "
        f"{plan.best:.3g} mm",
        f"On arms that differ from the drawing as the priors allow: {plan.over_arms:.3g} mm; with a tenth of the "
        f"touches lost: {plan.if_lost:.3g} mm",
        f"Number of fitted touches and expected tip error, mm: {left}",
    ]
    if compared and every:
        said.append(
            f"Set-ups, each with {fitted} fitted touches of {POOL} candidates, with the table alone to clear, and "
            f"none made before; so these figures compare with one another, not with the plan above, chosen of {pool}:"
        )
    for each in compared if every else ():
        reach = "this arm cannot touch it" if math.isinf(each.error) else f"{each.error:.3g} mm"
        said.append(f"  {reach}: {each.words}")
    return said


def _advice(best: SetUp, now: SetUp, fitted: int, kept_clear: bool) -> str:
    """What another set-up would be worth."""
    without = "; both ignore what must be kept clear of" if kept_clear else ""
    now_is = f"{now.error:.3g} mm as it is" if math.isfinite(now.error) else "this one is out of reach"
    return (
        f"Consider another set-up first ({best.words}): with {fitted} fitted touches of {POOL} candidates it leaves "
        f"{best.error:.3g} mm, {now_is}{without}"
    )


def where_faces_stand(plan: Plan, problem: Problem) -> list[dict[str, Any]]:
    """Each face of a plan: label, centre_mm (3), normal (3), size_mm (2), and off_mm, for JSON.

    off_mm: how far the real face may stand off along its normal, from and to, mm, until the first touch leaves the
    range of the dial in the posture that was planned; None where there is no dial.
    """
    probe, cell, found = problem.instrument.probe, plan.cell, list[dict[str, Any]]()
    if probe is None or not isinstance(cell, Cell):
        return found
    arm, readings, tips, _ = drawn_touch(problem, probe, plan.samples)
    beyond, _ = arm.place(arm.local, plan.samples.joints, readings[:, None] + 1)
    ends = readings_within(probe.travel if cell.travel is None else cell.travel)
    rows = plan.samples.faces(problem.instrument.groups).rows()
    for face in cell.faces:
        touched = rows.get(face.label, np.arange(len(plan)) if len(cell.faces) == 1 else np.zeros(0, dtype=int))
        off = None
        if probe.column is not None and len(touched):
            rise = (beyond - tips)[touched] @ face.axes[0]
            ways = np.sort([(end - readings[touched]) * rise for end in ends], axis=0)
            off = [float(ways[0].max()), float(ways[1].min())]
        found.append({"label": face.label, "centre_mm": face.centre, "normal": face.axes[0], "size_mm": face.size})
        found[-1] |= {"touches": len(touched), "off_mm": off}
    return found


def links_checked(clearance: Clearance | None) -> bool:
    """Whether links were looked at, as rods of some thickness."""
    return clearance is not None and clearance.link_radius is not None


def cell_words(plan: Plan, problem: Problem, clearance: Clearance | None) -> list[str]:
    """What was kept clear of, and where each face stands: sentences for whoever sets up the cell and runs the plan."""
    table, said = plan.cell.table, list[str]()
    if not links_checked(clearance):
        kept = "joints, flange and tip are" if is_chain(problem.robot) else "the tip is"
        limit = f"only {kept} kept above the table at z = {table:g} mm" if table > -math.inf else "nothing is looked at"
        said.append(
            f"Collisions not checked: of the arm {limit}; links, cables and what stands around were not looked at. Go "
            "through the plan slowly, or give --link-radius and --keep-out"
        )
    faces = where_faces_stand(plan, problem)
    for each in faces:
        (x, y, z), (u, v, w), (wide, deep) = each["centre_mm"], each["normal"], each["size_mm"]
        place = f"centre ({x:.0f}, {y:.0f}, {z:.0f}) mm, normal ({u:.3f}, {v:.3f}, {w:.3f}), {wide:.0f} x {deep:.0f} mm"
        off = each["off_mm"]
        may = "" if off is None else f"; may stand off by {off[0]:+.1f} to {off[1]:+.1f} mm along its normal"
        said.append(f"Face {each['label']}: {place}{may}")
    if faces:
        said.append(
            "Places are in the base frame. Where a real face stands further off, bring the tip to it along the plunger "
            "and take the joint values that the controller shows: the fit finds the face"
        )
    return said


def document(
    plan: Plan, problem: Problem, compared: Sequence[SetUp], written: Sequence[str], clearance: Clearance | None = None
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
    found |= {"table_mm": plan.cell.table, "collisions_checked": links_checked(clearance)}
    found["faces"] = where_faces_stand(plan, problem)
    if compared:
        found["setups"] = [{"words": each.words, "expected_mm": each.error} for each in compared]
    return found


def plan_text(plan: Plan, problem: Problem, name: str, clearance: Clearance | None = None) -> str:
    """The plan as CSV: number, purpose, joints (degrees, mm), readings to expect, labels; above them where faces stand.

    problem: with the one instrument that it was made for. name: of the problem. Readings have other names than in
    samples, so that a plan cannot be taken for a measurement.
    """
    layout, approach = problem.layout(), problem.instrument.words.approach
    notes = [
        f"planned by casacal for {name}: not a measurement",
        f"table at z = {plan.cell.table:g} mm",
        f"expected tip error {plan.error:.4g} mm RMS, apart from the position of the base, if stated noise and priors "
        f"are right; of as many at random {plan.at_random:.4g} mm",
        *cell_words(plan, problem, clearance),
        f"bring the arm to each posture; {f'{approach}; ' if approach else ''}write down the joint values that the "
        f"controller shows{', and the reading' if layout.columns else ''}",
        "purpose fit: for calibration; again: the same touch repeated at the end; check: kept for casacal verify",
    ]
    return postures_text(plan.samples, plan.purposes, layout, notes)


def write_plan(path: str | Path, plan: Plan, problem: Problem, name: str, clearance: Clearance | None = None) -> None:
    """Write `plan_text` to a file, whole or not at all."""
    write_text(path, plan_text(plan, problem, name, clearance))
