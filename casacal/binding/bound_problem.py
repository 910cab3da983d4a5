"""A problem bound to samples: the least-squares problem that estimators see."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from casacal.array_types import Index
from casacal.binding.blocks import make_block
from casacal.binding.evaluated_rows import EvaluatedRows
from casacal.binding.kernel_rows import KernelRows
from casacal.binding.noise_scale import scaled_noise
from casacal.binding.nominal import surveys_of
from casacal.binding.raw_graph import RawGraph
from casacal.binding.slots import Slot, make_slots, nominals
from casacal.binding.symbolic import SymbolicProblem
from casacal.discrepancy.effect import Survey
from casacal.errors import ProblemError, SamplesError
from casacal.problem.problem import Problem
from casacal.samples.measurements import Measurements, sets_of
from casacal.samples.samples import Samples
from casacal.threads import thread_count
from casacal.values import EMPTY, FrozenMapping, alike, read_only, short


def bind(
    problem: Problem, *samples: Samples | Measurements, backend: str | None = None, threads: int | None = None
) -> BoundProblem:
    """Bind a problem to its samples, one set per instrument: nominals, unknowns (mm, rad), weights (rows,) are settled.

    Planes and frames without a nominal get one from the nominal robot (a total-least-squares plane, a rigid fit); the
    noise of each row is evaluated there and held.

    Args:
        problem: robot and instruments.
        samples: rows of each instrument, one after another or together.
        backend: "c" or "blocks", what evaluates the rows; None takes CASACAL_BACKEND, else C where there is a compiler.
        threads: how many share thousands of rows; None takes CASACAL_THREADS, else the processors at hand. Results do
            not depend on it.

    Raises ProblemError when the number of sample sets is wrong, a label has too few rows for its own unknowns, a row
    has a derivative that is not finite at the nominal, or there are more unknowns than `MOST_UNKNOWNS`.

    """
    for some in (sets := sets_of(samples)):
        if isinstance(some, Samples):  # what is none, is refused below
            _refuse_absurd(some)
    bound = BoundProblem(problem, make_slots(problem, sets), sets, backend, threads)
    if bound.unknowns and not np.isfinite(bound.normal(bound.x0).gradient).all():
        _refuse_kinks(bound)
    return bound


MOST_UNKNOWNS = 2_000  # with which a calibration takes about a minute and a gigabyte
ABSURD = 1e12  # mm, rad or of whatever is read; squares of more overflow


def _refuse_absurd(samples: Samples) -> None:
    """Raise SamplesError where there are no rows, or values with which nothing can be computed."""
    if not len(samples):
        raise SamplesError(samples.file, "there are no rows", "Give at least as many as there are unknowns")
    joints = {f"joint {k}": values for k, values in enumerate(samples.joints.T, 1)}
    for name, values in {**joints, **samples.columns}.items():
        if not np.abs(values).max() < ABSURD and len(far := np.flatnonzero(np.abs(values) >= ABSURD)):
            what = f"{values[far[0]]:g} as {name} is no value that anything shows"
            raise SamplesError(samples.file, what, "Check the value and its unit", line=samples.lines[far[0]])


def _refuse_kinks(bound: BoundProblem) -> None:
    """Raise ProblemError for the first row with a residual at the nominal but no derivative, as of a norm at zero."""
    smooth = np.isfinite(bound.jacobian(bound.x0)).all(axis=1)
    for row in np.flatnonzero(~smooth & np.isfinite(bound.residual(bound.x0))):
        i = int(np.searchsorted(bound.starts, row, side="right")) - 1
        samples, before = bound.samples[i], sum(map(len, bound.samples[:i]))
        line = samples.lines[int(bound.sample_of[row]) - before]
        raise ProblemError(
            f"{samples.file}, line {line}: the residual of {type(bound.problem.instruments[i]).__name__} has no finite "
            "derivative in this row, as a norm has none at zero, nor acos at one",
            "Write it smoothly, such as sqrt(sumsqr(v) + 1e-6) for norm_2(v) or atan2 for acos; or leave the row out",
        )


class BoundProblem(EvaluatedRows):
    """A `Problem` with its samples; see `bind`."""

    def __init__(
        self,
        problem: Problem,
        slots: Sequence[Slot],
        samples: Sequence[Samples],
        backend: str | None = None,
        threads: int | None = None,
        scale: Mapping[str, float] = EMPTY,
        surveys: Sequence[Survey | None] = (),
        stated: KernelRows | None = None,
    ) -> None:
        self.problem, self.slots, self.samples = problem, tuple(slots), tuple(samples)
        self.scale = FrozenMapping(scale)
        seen, none = [slot for slot in self.slots if slot.unknown.size], np.zeros(0)
        sizes = [slot.unknown.size for slot in seen]
        if sum(sizes) > MOST_UNKNOWNS:
            came = f"{sum(sizes):,} unknowns came, and a problem holds {MOST_UNKNOWNS:,} at most"
            raise ProblemError(came, "Take the rows of fewer faces or other labels, or hold unknowns with --fix")
        self.names = tuple(name for slot in seen for name in slot.unknown.names(slot.name))
        self.units = tuple(unit for slot in seen for unit in slot.unknown.units)
        self.beside = tuple(slot.beside for slot in seen for _ in slot.columns)
        """The effect that each unknown (n,) belongs to, or none."""
        self.x0 = read_only(np.zeros(sum(sizes)))
        self.prior_std = read_only(np.concatenate([none, *(slot.unknown.prior_stds for slot in seen)]))
        self.start_std = read_only(np.concatenate([none, *(slot.unknown.start_stds for slot in seen)]))
        self.datum = read_only(np.repeat([slot.datum for slot in seen], sizes).astype(bool))
        self.surveys = tuple(surveys) or surveys_of(problem, samples, nominals(self.slots))
        self._asked, self._threads = backend, thread_count(threads)
        if stated is None:
            made = [make_block(problem, i, self.slots, some, self.surveys[i]) for i, some in enumerate(samples)]
            stated = KernelRows(made, self.unknowns, backend, self._threads)
        self._stated = self._rows = stated  # with the noise as it was stated
        self.blocks = stated.blocks
        if self.scale:
            self.blocks = scaled_noise(self, self.scale)
            self._rows = stated.with_noise(self.blocks)

    def __reduce__(self) -> tuple[Any, ...]:
        """What it was made from; kernels and sums are computed again."""
        made_from = (self.problem, self.slots, self.samples, self._asked, self._threads, self.scale, self.surveys)
        return BoundProblem, made_from

    def __eq__(self, other: object) -> bool:
        if self is other or not isinstance(other, BoundProblem):
            return self is other
        mine, theirs = ((b.problem, b.slots, b.samples, b.scale) for b in (self, other))
        return alike(mine, theirs)

    def __hash__(self) -> int:
        return hash((self.problem, self.names, self.rows))

    def __repr__(self) -> str:
        return f"<{self.problem!r}, bound to {self.rows} rows: {self.unknowns} unknowns {short(self.names)}>"

    def on(self, *samples: Samples | Measurements) -> BoundProblem:
        """Bind the same unknowns, with the same nominal values, to other rows; raises ProblemError for a new label."""
        return self._like(self.slots, sets_of(samples), self.scale)

    def take(self, rows: Sequence[int] | Index) -> BoundProblem:
        """The same unknowns on some of the samples, by their numbers."""
        return self.on(*self.measured.take(rows).sets)

    def thinned(self, most: int) -> BoundProblem:
        """Itself, or so many of its samples, evenly spread."""
        count = len(self.measured)
        return self if count <= most else self.take(np.unique(np.linspace(0, count - 1, most).astype(int)))

    def under(self, problem: Problem) -> BoundProblem:
        """The same rows and nominal values under another problem of the same geometry, such as one with effects."""
        slots = make_slots(problem, self.samples, {slot.name: slot.nominal for slot in self.slots})
        return BoundProblem(problem, slots, self.samples, self._asked, self._threads, self.scale)

    def with_sizes(self, times: Mapping[str, float], *, noise: Mapping[str, float] | None = None) -> BoundProblem:
        """The same rows, sizes of effects multiplied by a factor for each key; with other factors of noise, if any."""
        slots = [slot.sized(times.get(slot.beside, 1.0)) for slot in self.slots]
        return self._like(slots, self.samples, self.scale if noise is None else noise)

    def with_noise(self, scale: Mapping[str, float] = EMPTY) -> BoundProblem:
        """The same rows, their stated noise times a factor for each face, or each of several instruments.

        "" stands for those that are not named; without any, it is the noise as stated.
        """
        return self._like(self.slots, self.samples, scale)

    def _like(self, slots: Sequence[Slot], samples: Sequence[Samples], scale: Mapping[str, float]) -> BoundProblem:
        stated = self._stated if list(map(id, samples)) == list(map(id, self.samples)) else None
        return BoundProblem(self.problem, slots, samples, self._asked, self._threads, scale, self.surveys, stated)

    def first_part(self) -> tuple[BoundProblem, Index] | None:
        """The geometry alone, where there are effects beside it."""
        geometry = np.flatnonzero([not key for key in self.beside])
        return (self.under(self.problem.without_effects), geometry) if geometry.size < self.unknowns else None

    def parameters(self) -> Iterator[tuple[str, str, float, int | None]]:
        """Numbers of all parameters but those of effects: name, unit, nominal, position in x (None when held)."""
        return (number for slot in self.slots if not slot.beside for number in slot.numbers())

    @cached_property
    def graph(self) -> RawGraph:
        """The symbolic form in raw coordinates, for the IPOPT reference."""
        return RawGraph(self.slots, self.blocks, self._threads)

    @cached_property
    def symbolic(self) -> SymbolicProblem:
        """All rows as CasADi expressions of x, for one's own programs and solvers."""
        return SymbolicProblem(self, self.slots, self.blocks)
