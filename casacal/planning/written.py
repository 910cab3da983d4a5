"""A plan as a file: postures in the order in which they are made, what to expect there, what each is for."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from casacal.files import write_text
from casacal.planning.plan import Plan
from casacal.planning.route import EXPECTED
from casacal.samples.layout import Layout
from casacal.samples.samples import Samples
from casacal.samples.write import WRITTEN

PLANNED_DECIMALS = 4
"""Of joint values in degrees and mm: what controllers take, and a few micrometres at the tip."""


def plan_text(plan: Plan, layout: Layout, name: str) -> str:
    """The plan as CSV: number, purpose, joints (degrees, mm), readings to expect, labels.

    layout: of the problem's samples. name: of the problem. Readings have other names than in samples, so that a plan
    cannot be taken for a measurement.
    """
    return postures_text(plan.samples, plan.purposes, layout, _notes(plan, name))


def postures_text(samples: Samples, purposes: Sequence[str], layout: Layout, notes: Sequence[str]) -> str:
    """Postures that nobody has measured yet, in the form of a plan: what each (N,) is for, and notes above them."""
    joints = enumerate(zip(layout.joints, samples.joints.T, strict=True), 1)
    quantities = [(f"q{i}", kind, values) for i, (kind, values) in joints]
    quantities += [(EXPECTED + column, kind, samples.columns[column]) for column, kind in layout.columns.items()]
    header, columns = ["touch", "purpose"], [[str(k) for k in range(1, len(purposes) + 1)], list(purposes)]
    for what, kind, values in quantities:
        ending, factor, decimals = WRITTEN[kind]
        decimals = decimals if what.startswith(EXPECTED) else PLANNED_DECIMALS
        header.append(what + ending)
        columns.append([f"{value * factor:.{decimals}f}" for value in values])
    header += list(samples.labels)
    columns += [list(labels) for labels in samples.labels.values()]
    text = io.StringIO()
    text.writelines(f"# {line}\n" for line in notes)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(zip(*columns, strict=True))
    return text.getvalue()


def write_plan(path: str | Path, plan: Plan, layout: Layout, name: str) -> None:
    """Write `plan_text` to a file, whole or not at all."""
    write_text(path, plan_text(plan, layout, name))


def _notes(plan: Plan, name: str) -> list[str]:
    return [
        f"planned by casacal for {name}: not a measurement",
        f"expected tip error {plan.error:.4g} mm RMS, apart from where the base stands, if stated noise and priors are "
        f"right; of as many at random {plan.at_random:.4g} mm",
        "bring the arm to each posture; where the instrument is at its end, go along the plunger until it reads about "
        "what is expected (readings that differ tell the size of the arm); write down the joint values that the "
        "controller shows and the reading that there is",
        "purpose fit: to calibrate with; again: the same once more, at the end; check: kept apart, for casacal verify",
    ]
