"""Touches to make, in the order of a short way through the joints."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from casacal.data.samples import EXPECTED, WRITTEN, Layout, Samples, read_columns, samples_text
from casacal.errors import CasacalError, SamplesError
from casacal.fit.slots import instances
from casacal.model.problem import Problem
from casacal.model.robot import Robot, joint_units
from casacal.values import Array, Index, Value

FIT, AGAIN, CHECK = "fit", "again", "check"
PURPOSES = (FIT, AGAIN, CHECK)
"""Purposes of a touch: to be fitted; to be repeated at the end and fitted; to be kept for verification."""


@dataclass(frozen=True, eq=False)
class Route(Value):
    """Touches in the order in which they should be made.

    samples: postures (N, n; rad, mm), readings to expect on the arm as drawn, and labels. purposes: of each (N,),
    "fit", "again" or "check".
    """

    samples: Samples
    purposes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.purposes)

    def __repr__(self) -> str:
        return f"<Route of {len(self)} touches>"


PLANNED_DECIMALS = 4  # decimals of joint values in degrees and mm: controllers take them; micrometres at the tip


def postures_text(samples: Samples, purposes: Sequence[str], layout: Layout, notes: Sequence[str]) -> str:
    """Postures that nobody has measured yet, in the form of a plan: what each (N,) is for, and notes above them."""
    before = {"touch": [str(k) for k in range(1, len(purposes) + 1)], "purpose": list(purposes)}
    return samples_text(layout, samples, notes, before=before, joint_decimals=PLANNED_DECIMALS, prefix=EXPECTED)


def joints_shown(joints: Array, layout: Layout) -> list[str]:
    """Joint values (n,; rad, mm) as a plan has them, in degrees and mm."""
    pairs = zip(joints, layout.joints, strict=True)
    return [f"{value * WRITTEN[kind][1]:.{PLANNED_DECIMALS}f}" for value, kind in pairs]


def touches_needed(problem: Problem, touches: Samples) -> int:
    """Smallest number of touches from which `calibrate` can fit all unknowns of the arm and the touched faces."""
    own = sum(
        u.size * len(instances(problem.instrument, key, u, touches)) for key, u in problem.instrument.unknowns.items()
    )
    total = own + sum(unknown.size for unknown in problem.robot.parameters.values())
    return -(-total // problem.models[0].components)


def read_route(path: str | Path, layout: Layout) -> Route:
    """Read what `write_plan` wrote, or a file of the same form; rows may be left out, moved and added by hand.

    layout: of the problem's samples. Raises SamplesError.
    """
    expected = Layout(layout.joints, {EXPECTED + name: kind for name, kind in layout.columns.items()}, layout.labels)
    columns = read_columns(path)
    measured = [name for name in columns.header if name.rpartition("_")[0] in layout.columns]
    if layout.columns and measured and not any(name.startswith(EXPECTED) for name in columns.header):
        fix = "Give what casacal plan wrote; its readings are called expected_..."
        raise SamplesError(columns.file, f"'{measured[0]}' is a measurement, which a plan does not have", fix)
    read = Samples.from_columns(columns, expected)
    if "purpose" in columns.header and "purpose" not in read.extra:  # of millions of rows only numbers are kept
        raise SamplesError(read.file, f"{len(read):,} touches are too many for a plan", "Give fewer, in parts")
    purposes = tuple(str(cell).strip() or FIT for cell in read.extra.get("purpose", (FIT,) * len(read)))
    for purpose, line in zip(purposes, read.lines, strict=True):
        if purpose not in PURPOSES:
            fix = f"Write {FIT}, {AGAIN} or {CHECK}"
            raise SamplesError(read.file, f"'{purpose}' is no purpose", fix, line=line, column="purpose")
    readings = {name.removeprefix(EXPECTED): values for name, values in read.columns.items()}
    return Route(replace(read, columns=readings, extra={}), purposes)


def renumbered(path: str | Path) -> bool:
    """Whether rows of a plan were left out, moved or added since it was written, by its column of numbers."""
    columns = read_columns(path)
    if "touch" not in columns.header:
        return False
    numbers = columns.text("touch")
    return [numbers.names[code] for code in numbers.codes] != [str(k) for k in range(1, len(numbers) + 1)]


def refuse_plan_of_another(path: str | Path, name: str, table: float) -> None:
    """Raise CasacalError for a plan whose first lines say that it was made for another problem, or on another table."""
    first, second, *_ = [*Path(path).read_text(encoding="utf-8", errors="replace").split("\n", 2), ""]
    stood = re.match(r"\W*table at z = (\S+) mm", second)
    if stood and float(stood[1]) != float(f"{table:g}"):
        what = f"{path} was planned with the table at z = {stood[1]} mm, and here it is at {table:g} mm"
        raise CasacalError(what, f"Give --table={stood[1]}, or Cell(..., table={stood[1]}) in the problem file")
    planned = re.match(r"\W*planned by casacal for (.+): not a measurement", first)
    if planned and planned[1] != name:
        raise CasacalError(f"{path} was planned for '{planned[1]}', and the problem is '{name}'", "Name its own plan")


SWEEPS = 40  # times that all pairs of steps are looked at


def shortest_way(robot: Robot, joints: Array) -> Index:
    """An order (N,) of postures (N, n; rad, mm) that is short: the nearest next, then crossings undone (2-opt).

    What counts is the joint that has furthest to go, which takes longest; `AXIS_WEIGHT` mm of a sliding joint count as
    a radian. It begins at the posture that is nearest to mid-range.
    """
    count = len(joints)
    if count < 2:
        return np.arange(count)
    places, middle = joints / joint_units(robot), np.mean(robot.limits, axis=0) / joint_units(robot)
    apart = np.abs(places[:, None] - places).max(axis=2)
    order = [int(np.abs(places - middle).max(axis=1).argmin())]
    left = set(range(count)) - set(order)
    while left:
        here = np.array(sorted(left))
        order.append(int(here[apart[order[-1], here].argmin()]))
        left.remove(order[-1])
    way = np.array(order)
    for _ in range(SWEEPS):
        shorter = False
        for i in range(count - 2):
            j = np.arange(i + 2, count)
            after = np.append(apart[way[i + 1], way[j[:-1] + 1]], 0.0)
            before = np.append(apart[way[j[:-1]], way[j[:-1] + 1]], 0.0)
            change = apart[way[i], way[j]] + after - apart[way[i], way[i + 1]] - before
            best = int(change.argmin())
            if change[best] < -1e-12:
                way[i + 1 : j[best] + 1] = way[i + 1 : j[best] + 1][::-1].copy()
                shorter = True
        if not shorter:
            break
    return way
