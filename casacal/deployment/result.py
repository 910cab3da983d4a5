"""The result of a calibration as a typed value, used by everything after it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from casacal.values import Array, Value
from casacal.wording import listed, sentence

Level = Literal["calibrated", "use with care", "do not use"]
SCHEMA = 2  # version of the files written now. Those without a number are older: they need their problem.py
TIP_ERRORS = ("expected", "prior", "flange_expected", "flange_prior")


@dataclass(frozen=True)
class Verdict:
    """How far a result may be used: a level, one sentence, and the reasons when it is not simply calibrated."""

    level: Level
    words: str
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ParameterFound(Value):
    """One number of the arm or the instrument, mm or rad; the standard deviation is NaN where it is not known."""

    name: str
    unit: str
    nominal: float
    estimate: float
    std: float
    known_from: str = ""

    @property
    def change(self) -> float:
        """Estimate less nominal."""
        return self.estimate - self.nominal


@dataclass(frozen=True)
class MirrorImage:
    """Other joint conventions that explain the rows as well, and make of the arm its mirror image.

    reversed: joints (from 1) that count the other way. half_turned: joints that begin half a turn off. off_mm: RMS
    distance of the tips from where they are taken to be, over the workspace, after the best rigid motion.
    """

    reversed: tuple[int, ...]
    half_turned: tuple[int, ...]
    off_mm: float

    @property
    def conventions(self) -> str:
        """The conventions in words: "joints 1, 4 and 6 counted the other way"."""
        halves = f" and {_joints(self.half_turned)} half a turn off" if self.half_turned else ""
        return f"{_joints(self.reversed)} counted the other way{halves}"

    @property
    def cause_and_fix(self) -> tuple[str, str]:
        """What is open and what it would mean, and what settles it."""
        cause = (
            f"with {self.conventions} the samples fit as well: Cartesian positions would be mirrored, "
            f"{self.off_mm:.0f} mm off, and corrected joint targets right"
        )
        return cause, "Four poses off the pendant settle it: casacal doctor PROBLEM POSES --keep"

    @property
    def words(self) -> str:
        """Both as sentences."""
        return " ".join(map(sentence, self.cause_and_fix))


def _joints(numbers: Sequence[int]) -> str:
    return f"joint{'s' if len(numbers) > 1 else ''} {listed([str(number) for number in numbers])}"


@dataclass(frozen=True, eq=False)
class TipErrors(Value):
    """Tip error to expect over the workspace, mm RMS, now and by the priors, and the flange's; NaN where denied."""

    expected_mm: float
    prior_mm: float
    flange_expected_mm: float
    flange_prior_mm: float


@dataclass(frozen=True, eq=False)
class FaceNoise(Value):
    """Noise of a face, mm: as stated, as used, and as used without joint repeatability."""

    stated_mm: float
    used_mm: float
    without_joints_mm: float


@dataclass(frozen=True, eq=False)
class NoiseFound(Value):
    """Noise over stated noise with its 95 % interval, noise by face, and joint repeatability, rad.

    loose_joint: the number of the joint that alone does not repeat, from 1; 0 where all are alike. shared: the part of
    the noise's variance, as it was used, that repeats of a touch have in common.
    """

    ratio: float
    low: float
    high: float
    joints_rad: float
    loose_joint: int
    by_face: Mapping[str, FaceNoise]
    shared: float = 0.0


@dataclass(frozen=True)
class EffectFound:
    """An effect beside the geometry, and by how many times its usual size it was found."""

    key: str
    words: str
    times: float


@dataclass(frozen=True, eq=False)
class EffectsFound(Value):
    """Non-geometric effects of arm and cell.

    effects: all that were looked for. corrected: keys of those that are. values, of: unknowns by name, and the key of
    the effect that each belongs to. without_corrections: the geometry, by name, where nobody corrects an effect.
    covariance (k, k) of the unknowns `covariance_of`, geometry and effects together, their `estimate`, and by how much
    each of these is elsewhere than the arm is said to be (`off`); None where the verdict denies them, and the estimate
    in older files. usual, mean, spread: RMS, mean and
    standard deviation in the fitted rows of the columns of a row model that tell effects. ranges: lowest and highest
    amount by column of a file. further: columns of a file that tell an effect, by its key. uncorrected_mm: tip error
    to expect, mm RMS, where nobody corrects an effect.
    """

    effects: tuple[EffectFound, ...]
    corrected: tuple[str, ...]
    values: Mapping[str, float]
    of: Mapping[str, str]
    without_corrections: Mapping[str, float]
    covariance_of: tuple[str, ...]
    covariance: Array | None
    off: Array | None
    estimate: Array | None
    usual: Mapping[str, float]
    mean: Mapping[str, float]
    spread: Mapping[str, float]
    ranges: Mapping[str, tuple[float, float]]
    further: Mapping[str, tuple[str, ...]]
    uncorrected_mm: float


@dataclass(frozen=True, eq=False)
class FittedData(Value):
    """The samples: file (of each of several instruments), SHA-256, and the listing of the fitted rows, where known."""

    file: str | None
    sha256: str
    fitted_rows: Mapping[str, Any] | None
    instruments: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class CalibrationResult(Value):
    """Calibrated parameters of an arm; or, method "truth", its true ones in a simulation.

    unknowns: deviations from nominal by name, mm and rad, and `proposed` what those of faces and the like count from.
    covariance (n, n) of the unknowns `covariance_of`, infinite where neither samples nor prior hold one; None where
    the verdict denies it, and of a truth. planes: names of the faces.
    """

    method: str
    status: str
    converged: bool
    verdict: Verdict | None
    parameters: tuple[ParameterFound, ...]
    unknowns: Mapping[str, float]
    proposed: Mapping[str, Array]
    planes: tuple[str, ...]
    covariance_of: tuple[str, ...]
    covariance: Array | None
    tip: TipErrors
    noise: NoiseFound
    effects: EffectsFound
    data: FittedData
    cost: float = math.nan
    mirror_image: MirrorImage | None = None

    def values(self, *, alone: bool) -> dict[str, float]:
        """Deviations of all unknowns of geometry and instrument, by name; `alone`: where no effect is corrected."""
        known = {**self.unknowns, **{row.name: row.change for row in self.parameters}}
        return {**known, **self.effects.without_corrections} if alone else known

    @property
    def of_effects(self) -> dict[str, float]:
        """Unknowns of the effects that are corrected, by name, as they were found."""
        found = self.effects
        return {name: value for name, value in found.values.items() if found.of[name] in found.corrected}

    @property
    def called(self) -> dict[str, str]:
        """The words for each effect, by key."""
        return {each.key: each.words for each in self.effects.effects}
