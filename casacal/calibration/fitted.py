"""A fit and what its rows say: which were set aside, held out or copied, their noise, what is wrong with them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from casacal.array_types import Array
from casacal.binding.all_rows import each_alone
from casacal.binding.bound_problem import BoundProblem, bind
from casacal.binding.marginal import extended
from casacal.calibration.given import Reference
from casacal.calibration.metrics import Metrics, metrics_of, parts_of
from casacal.calibration.motion import Tried, used_arm
from casacal.checks import Finding, check
from casacal.checks.check import labels_alike
from casacal.checks.fitted_faults import tool_elsewhere_at
from casacal.checks.numbers import wrong_number
from casacal.checks.rows import outside, repeated, rounded
from casacal.checks.setup import sign_before_fit
from casacal.errors import CasacalError
from casacal.estimators import lm
from casacal.least_squares.result import Result
from casacal.problem.problem_file import ProblemFile
from casacal.samples.measurements import Measurements
from casacal.samples.repeats import copies_of
from casacal.samples.samples import Samples
from casacal.uncertainty.figures import HALF_WEIGHT
from casacal.uncertainty.noise import Noise, noise_over_stated
from casacal.uncertainty.transfer import LeftOut, leave_one_face_out
from casacal.values import FrozenMapping, Value

MINIMISERS = ("lm", "sckf-lm", "ipopt")  # methods that promise the minimum; filters and controls may honestly miss it


@dataclass(frozen=True, eq=False, repr=False)
class Fitted(Value):
    """A fit, the rows held out, the arm before, the reference, and where the time went."""

    method: str
    seed: int
    samples: Samples | Measurements
    """As they were given, of one instrument or of several."""
    fit: BoundProblem
    heldout: BoundProblem | None
    result: Result
    before: Result
    reference: Reference | None
    seconds: Mapping[str, float]
    source: ProblemFile
    """The problem as it was given: its file, where it has one."""
    aside: tuple[Finding, ...] = ()
    """What is wrong with the rows that were set aside, with their lines."""
    heldout_by: str = "rows"
    """What was held out together: rows, region, face, or the name of a column."""
    tried: tuple[Tried, ...] = ()
    """Effects beside the geometry that could be corrected, and which are."""
    geometry: BoundProblem | None = None
    """The same rows without effects beside the geometry, and with the noise as it was found so; None where it is `fit`.

    What is wrong with the samples is looked for there: effects would explain part of it away."""

    def __eq__(self, other: object) -> bool:
        """Whether all but the time taken is equal."""
        if self is other or not isinstance(other, Fitted):
            return self is other
        return super().__eq__(replace(other, seconds=self.seconds))

    def __hash__(self) -> int:
        return hash((self.method, self.seed, self.fit))

    def __post_init__(self) -> None:
        object.__setattr__(self, "seconds", FrozenMapping(self.seconds))

    @property
    def corrected(self) -> tuple[str, ...]:
        """Keys of the effects beside the geometry that are corrected; others count as errors."""
        return tuple(each.key for each in self.tried if each.corrected)

    @property
    def told(self) -> tuple[str, ...]:
        """Keys of those among them that columns of the rows tell."""
        return tuple(each.key for each in self.tried if each.told)

    @property
    def passed(self) -> bool:
        """Whether the method converged and, where it promises the minimum, the reference agrees."""
        if not self.result.converged:
            return False
        return self.reference is None or self.method not in MINIMISERS or self.reference.agrees

    @property
    def bare(self) -> BoundProblem:
        """The fitted rows under the geometry alone."""
        return self.fit if self.geometry is None else self.geometry

    @cached_property
    def weighed(self) -> BoundProblem:
        """The same with the noise as it was found beside effects: what a single touch tells of the geometry."""
        return self.bare if self.bare is self.fit else self.bare.with_noise(self.fit.scale)

    @property
    def bare_x(self) -> Array:
        """The estimate of its unknowns."""
        return np.asarray(self.result.x[~np.array(self.fit.beside, dtype=bool)])

    @cached_property
    def plain(self) -> Result:
        """The minimum under the geometry alone: what is wrong with the rows shows there."""
        return self.result if self.bare is self.fit else lm(self.bare)

    @property
    def aside_lines(self) -> tuple[int | str, ...]:
        """Lines of the rows that were set aside; with the instrument's name where there are several."""
        lines = sorted({(found.instrument, line) for found in self.aside for line in found.lines})
        return tuple(f"{name} {line}" if name else line for name, line in lines)

    @cached_property
    def noise(self) -> Noise:
        """Noise over what was stated, as this result's residuals show it, and the factors with which it was used."""
        return noise_over_stated(self.result)

    @cached_property
    def copies(self) -> int:
        """Rows that are copies of an earlier one, to the last digit, and so neither fitted nor held out."""
        return int(sum(copies_of(some).sum() for some in Measurements.of(self.samples).sets))

    @cached_property
    def repeated(self) -> tuple[Finding, ...]:
        """Warnings of such rows, with the instrument's name where there are several."""
        given = Measurements.of(self.samples)
        pairs = zip(given.names, given.sets, strict=True)
        return tuple(replace(finding, instrument=name) for name, some in pairs for finding in repeated(some))

    @cached_property
    def labels_alike(self) -> tuple[Finding, ...]:
        """Warnings of labels that may be slips of others, such as Floor beside floor."""
        return labels_alike(self.bare.problem, Measurements.of(self.samples))

    @property
    def noise_words(self) -> str:
        """Which noise every figure uses: what was stated, or what the rows showed."""
        return "noise as found" if self.noise.scale else "stated noise"

    @property
    def assumed(self) -> str:
        """What figures of accuracy take for right: noise, priors, and what readings cannot tell of themselves."""
        noise = "noise as found" if self.noise.scale else "the stated noise"
        trusted = self.fit.problem.words.trusted
        return f"{noise}, priors and {trusted}" if trusted else f"{noise} and priors"

    @cached_property
    def used_x(self) -> Array:
        """Unknowns (n,) of the arm as it is used: the estimate, with effects that are not corrected at zero."""
        return used_arm(self.fit, self.result, self.corrected)

    @cached_property
    def uncorrected_x(self) -> Array:
        """Unknowns (n,) of the arm where nobody can correct an effect, as in a table of lengths and angles."""
        return used_arm(self.fit, self.result, ()) if self.corrected else self.used_x

    @cached_property
    def heldout_x(self) -> tuple[Array, Array]:
        """Unknowns of the held-out rows, before and after; faces that were not fitted stand where their rows say."""
        before, after = self.before.x, self.used_x
        if self.heldout is None:
            return before, after
        return extended(self.heldout, before), extended(self.heldout, after)

    @cached_property
    def left_out(self) -> tuple[LeftOut, ...]:
        """Each fitted face as the others predict it; a fit for each, and so only when it is asked for."""
        return leave_one_face_out(self.fit, self.result)

    @cached_property
    def metrics(self) -> Metrics:
        """Plane residuals in mm, before and after, on fitted and held-out rows; not accuracy."""
        return metrics_of(self.fit, self.heldout, (self.before.x, self.used_x), self.heldout_x)

    @cached_property
    def metrics_by_instrument(self) -> dict[str, Metrics]:
        """The same of each of several instruments, and of each block of a residual, in its unit; else nothing."""
        pairs = (self.before.x, self.used_x), self.heldout_x
        return {part: metrics_of(self.fit, self.heldout, *pairs, part=part) for part in parts_of(self.fit)}

    @cached_property
    def down_weighted(self) -> tuple[int | str, ...]:
        """Lines of the rows that a robust loss gave less than half of their weight; named as `aside_lines`."""
        if self.result.loss is None:
            return ()
        low = np.unique(self.fit.sample_of[self.result.weights < HALF_WEIGHT]).tolist()
        return tuple(self.fit.measured.place(k) for k in low)

    @cached_property
    def tool_findings(self) -> tuple[Finding, ...]:
        """That the tool stands elsewhere than the problem says, where it does."""
        if not self.fit.unknowns:
            return ()
        return tuple(tool_elsewhere_at(self.bare, self.plain.x, self.plain.covariance))

    @cached_property
    def data_errors(self) -> tuple[Finding, ...]:
        """Errors that the whole data check finds in the rows that were fitted; it takes many fits."""
        found = check(self.bare.problem, self.fit.measured.plain)
        return tuple(each for each in found if each.severity == "error")

    @cached_property
    def plain_errors(self) -> tuple[Finding, ...]:
        """Errors that need few fits or none: travel, limits, rounding, the dial's sign, a number of the arm."""
        found = list[Finding]()
        for alone in self._each_bare():
            told = [*outside(alone.problem, alone.samples[0]), *rounded(alone), *sign_before_fit(alone)]
            name = alone.problem.names[0] if len(self.fit.samples) > 1 else ""
            found += [replace(each, instrument=name) for each in told]
        if self.result.loss is None:
            found += wrong_number(self.bare, alone=self.fit is self.bare)
        return tuple(each for each in found if each.severity == "error")

    def _each_bare(self) -> Iterator[BoundProblem]:
        """The fitted rows of each instrument by itself, under the geometry alone; those that can be bound so."""
        if len(self.fit.samples) == 1:
            yield self.bare
            return
        for alone in each_alone(self.bare.problem, self.bare.samples):
            with contextlib.suppress(CasacalError):
                yield bind(alone.problem, alone.samples)
