"""A problem bound to samples: the least-squares problem that estimators see."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.binding.blocks import make_block
from casacal.binding.evaluated_rows import EvaluatedRows
from casacal.binding.kernel_rows import KernelRows
from casacal.binding.noise_scale import scaled_noise
from casacal.binding.nominal import surveys_of
from casacal.binding.raw_graph import RawGraph
from casacal.binding.slots import Slot, make_slots, nominals
from casacal.binding.symbolic import SymbolicProblem
from casacal.discrepancy.effect import Survey
from casacal.problem.problem import Problem
from casacal.samples.measurements import Measurements, Places, sets_of
from casacal.samples.samples import Samples
from casacal.threads import thread_count
from casacal.values import FrozenMapping, alike, read_only, short

NO_FACTORS: Mapping[str, float] = FrozenMapping({})


def bind(
    problem: Problem, *samples: Samples | Measurements, backend: str | None = None, threads: int | None = None
) -> BoundProblem:
    """Bind a problem to its samples, one set per instrument: nominal values, unknowns and weights are settled here.

    Planes and frames without a nominal get one from the nominal robot (a total-least-squares plane, a rigid fit); the
    noise of each row is evaluated there and held.

    Args:
        problem: robot and instruments.
        samples: rows of each instrument, one after another or together.
        backend: "c" or "blocks", what evaluates the rows; None takes CASACAL_BACKEND, else C where there is a compiler.
        threads: how many share thousands of rows; None takes CASACAL_THREADS, else the processors at hand. Results do
            not depend on it.

    Returns:
        What estimators see: n unknowns in mm and rad, whitened residuals (rows,).

    Raises ProblemError when the number of sample sets is wrong or a label has too few rows for its own unknowns.

    """
    return BoundProblem(problem, make_slots(problem, sets := sets_of(samples)), sets, backend, threads)


class BoundProblem(EvaluatedRows):
    """A `Problem` with its samples; see `bind`."""

    def __init__(
        self,
        problem: Problem,
        slots: Sequence[Slot],
        samples: Sequence[Samples],
        backend: str | None = None,
        threads: int | None = None,
        scale: Mapping[str, float] = NO_FACTORS,
        surveys: Sequence[Survey | None] = (),
        stated: KernelRows | None = None,
    ) -> None:
        self.problem, self.slots, self.samples = problem, tuple(slots), tuple(samples)
        self.scale = FrozenMapping(scale)
        seen, none = [slot for slot in self.slots if slot.unknown.size], np.zeros(0)
        sizes = [slot.unknown.size for slot in seen]
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

    def take(self, rows: Sequence[int] | Places) -> BoundProblem:
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

    def with_noise(self, scale: Mapping[str, float] = NO_FACTORS) -> BoundProblem:
        """The same rows, their stated noise times a factor for each face, or each of several instruments.

        "" stands for those that are not named; without any, it is the noise as stated.
        """
        return self._like(self.slots, self.samples, scale)

    def _like(self, slots: Sequence[Slot], samples: Sequence[Samples], scale: Mapping[str, float]) -> BoundProblem:
        stated = self._stated if list(map(id, samples)) == list(map(id, self.samples)) else None
        return BoundProblem(self.problem, slots, samples, self._asked, self._threads, scale, self.surveys, stated)

    def first_part(self) -> tuple[BoundProblem, NDArray[np.intp]] | None:
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
