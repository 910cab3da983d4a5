"""What was found of an arm that may have changed: figures as attributes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.samples.samples import Samples
from casacal.values import Value, frozen

NOTHING, CHANGED, ROWS, UNDECIDED = "nothing", "changed", "rows", "undecided"
"""How it ended: nothing changed that these rows show; one thing did; rows are off; it cannot be told."""


@dataclass(frozen=True, eq=False)
class CauseFound(Value):
    """One thing that may have changed.

    name, kind: such as "joint 4", "joint"; "tool", "base", "place" of what was said to stand, "row" of a row that is
    off. line: of such a row. shift, std: by how much (k,), in `units`, along `labels`, with standard deviations; where
    rows see only some directions of it, what they see. p: chance of as much explained where nothing changed. share:
    part of the evidence. left: chance of what stays unexplained.
    """

    name: str
    kind: str
    line: int
    labels: tuple[str, ...]
    units: tuple[str, ...]
    shift: Array
    std: Array
    p: float
    share: float
    left: float

    def __post_init__(self) -> None:
        frozen((self.shift, self.std))


@dataclass(frozen=True, eq=False)
class Shown(Value):
    """A joint's shift (rad, mm) that these rows would have shown with a chance of 90 %; infinite where none."""

    name: str
    unit: str
    shift: float


@dataclass(frozen=True, eq=False, repr=False)
class Figures(Value):
    """Whether an arm has changed since its calibration, by fresh rows.

    robot, result, verdict: which calibration, and what it said of itself. samples, sha256, rows: which rows, how many
    were judged. own, standing: unknowns that these rows alone know, and what was said to stand. drift: what may have
    drifted since, standard deviations by name.
    alarm: rate of false alarms that was asked for. p, level: the smallest chance of all tests, and below which it is an
    alarm, so that this rate is met. chi_square, freedom, p_all: of all rows together.
    ended: "nothing", "changed", "rows" or "undecided". causes: the one, or those that cannot be told apart, likeliest
    first. bad_lines: rows that are off. joints: what would have been found of each. unseen: what cannot show here.
    touches: postures that would tell the causes apart, with expected readings; None where none are needed or known.
    tells: log-odds to expect of them between the two causes that are hardest to tell apart.
    copied_lines, fitted_lines: rows that were left out.
    """

    robot: str
    result: str
    verdict: tuple[str, str]
    samples: str
    sha256: str
    rows: int
    own: tuple[str, ...]
    standing: tuple[str, ...]
    drift: tuple[tuple[str, float], ...]
    alarm: float
    p: float
    level: float
    chi_square: float
    freedom: int
    p_all: float
    ended: str
    causes: tuple[CauseFound, ...]
    bad_lines: tuple[int, ...]
    joints: tuple[Shown, ...]
    unseen: tuple[str, ...]
    touches: Samples | None
    tells: float
    copied_lines: tuple[int, ...]
    fitted_lines: tuple[int, ...]

    @property
    def changed(self) -> bool | None:
        """Whether the arm changed; None where these rows cannot say."""
        return {NOTHING: False, CHANGED: True}.get(self.ended)

    @property
    def largest_unseen(self) -> float:
        """The largest shift of a turning joint that was looked for and might have been missed, rad."""
        return float(np.max([each.shift for each in self.joints if each.unit == "rad"], initial=0.0))
