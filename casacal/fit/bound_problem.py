"""A problem bound to samples: the least-squares problem that estimators see, its rows, and what they ask of it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from casacal.data.columns import Labels
from casacal.data.samples import Measurements, Samples, sets_of
from casacal.errors import ProblemError, SamplesError
from casacal.fit.kernel_rows import FEW, KernelRows, RawGraph, constraint_set, stated_prior
from casacal.fit.least_squares import DampedStep, ExtendedPass, FilterPass, Gaussian, LeastSquares, Normal
from casacal.fit.nominal import surveys_of
from casacal.fit.slots import Block, Slot, make_block, make_slots, nominals
from casacal.kernels.filter_passes import FilterRows
from casacal.kernels.losses import Loss
from casacal.kernels.native_rows import VARIABLE, NativeKernels, NativeNormal, PackedPieces
from casacal.model.kinematics import stacked_poses
from casacal.model.problem import Problem
from casacal.model.robot import refuse_open
from casacal.model.term import Survey
from casacal.threads import thread_count
from casacal.values import EMPTY, Array, FrozenMapping, Index, Rows, alike, read_only, short

if TYPE_CHECKING:
    from casacal.data.repeats import Repeats
    from casacal.fit.symbolic import SymbolicProblem

COMPACT, HELD = 50_000, 10_000_000  # rows, and numbers of a whole Jacobian, beyond which none is held
MOST_SUMS = 4_000_000  # numbers that the sums of all pieces may take: beyond, each piece sums what it sees alone

OTHERS = ""  # stands for every face that is not named

SHARED = "\0shared"  # the part of the noise's variance that repeated touches share; no label holds a zero byte

REPEATABILITY = "\0joints"
"""Stands for what joints do not repeat, rad (`PER_RAD` mm of a sliding one are one), on top of the rest.

With a number behind it, from 1, it is that joint alone, which is loose.
"""


def by_face(scale: Mapping[str, float]) -> dict[str, float]:
    """The factors of faces alone."""
    return {name: value for name, value in scale.items() if not name.startswith((SHARED, REPEATABILITY))}


def of_repeats(scale: Mapping[str, float]) -> dict[str, float]:
    """Noise between repeats: the stated noise without what repeats share."""
    return {name: value for name, value in scale.items() if name == SHARED}


def without_joints(scale: Mapping[str, float]) -> dict[str, float]:
    """The problem without joint repeatability."""
    return {name: value for name, value in scale.items() if not name.startswith(REPEATABILITY)}


def repeatability(scale: Mapping[str, float]) -> tuple[int, float]:
    """The number of the joint that does not repeat, 0 for all alike, and by how much, rad; zeros for none."""
    found = ((name.removeprefix(REPEATABILITY), rad) for name, rad in scale.items() if name.startswith(REPEATABILITY))
    return next(((int(number or 0), rad) for number, rad in found), (0, 0.0))


def times(scale: Mapping[str, float], factor: float) -> dict[str, float]:
    """All noise times another factor; what repeats share is a part of the noise and stays."""
    found = {name: value if name == SHARED else value * factor for name, value in scale.items()}
    return found if by_face(found) else {**found, OTHERS: factor}


def bind(
    problem: Problem, *samples: Samples | Measurements, backend: str | None = None, threads: int | None = None
) -> BoundProblem:
    """Bind a problem to its samples, one set per instrument: nominals, unknowns (mm, rad), weights (rows,) are settled.

    Planes and frames without a nominal get one from the nominal robot (a total-least-squares plane, a rigid fit); the
    noise of each row is evaluated there and held.

    Args:
        problem: robot and instruments.
        samples: rows of each instrument, one after another or together.
        backend: "c" or "blocks", what evaluates the rows; None takes CASACAL_BACKEND, else C where there is a compiler
            and it is worth the wait: not for up to 1000 rows with terms beside the geometry.
        threads: how many share thousands of rows; None takes CASACAL_THREADS, else the processors at hand. Results do
            not depend on it.

    Raises ProblemError when the number of sample sets is wrong, a label has too few rows for its own unknowns, a row
    has a derivative that is not finite at the nominal, constraints cannot be met together or say the same, or there are
    more unknowns than `MOST_UNKNOWNS`. Raises SamplesError for rows that are absurd, or in which the nominal arm's
    loops do not close.

    """
    for some in (sets := sets_of(samples)):
        if isinstance(some, Samples) and isinstance(problem, Problem):  # what is none, is refused below
            _refuse_absurd(some)
            refuse_open(problem.robot, some, problem.models[0].arm.closed(some.joints))
    slots = make_slots(problem, sets)
    bound = BoundProblem(problem, slots, sets, backend, threads, known=stated_prior(problem.constraints, slots))
    if bound.unknowns and not np.isfinite(bound.normal(bound.x0).gradient).all():
        _refuse_kinks(bound)
    if (known := bound.constraints) is None:
        return bound
    values, _ = known.evaluate(bound.x0)
    for k in np.flatnonzero(~known.depends.any(axis=1) & ~((known.low <= values) & (values <= known.high))):
        if max(known.low[k] - values[k], values[k] - known.high[k]) > 1e-9 * (1 + abs(values[k])):
            ends = [f"{end:.6g}" for end in dict.fromkeys((known.low[k], known.high[k]))]
            what = f"'{known.names[k]}' is {values[k]:.6g} of unknowns that are held, and is to be {' to '.join(ends)}"
            raise ProblemError(what, "Free one of them, correct the drawing, or leave the constraint out")
    if twice := known.redundant(bound.feasible(bound.x0)):
        named = " and ".join(f"'{name}'" for name in twice)
        raise ProblemError(f"The equalities {named} say the same of the unknowns", "Leave one of them out")
    return bound


MOST_UNKNOWNS = 2_000  # with which a calibration takes about a minute and a gigabyte
ABSURD = 1e12  # mm, rad or of whatever is read; squares of more overflow
FEW_ROWS = 1000  # up to which a fit with terms beside the geometry takes tenths of a second in blocks; a compiler, ten


def _refuse_absurd(samples: Samples) -> None:
    """Raise SamplesError where there are no rows, or values with which nothing can be computed."""
    if not len(samples):
        raise SamplesError(samples.file, "there are no rows", "Give at least as many as there are unknowns")
    joints = {f"joint {k}": values for k, values in enumerate(samples.joints.T, 1)}
    for name, values in {**joints, **samples.columns}.items():
        if not np.abs(values).max() < ABSURD and len(far := np.flatnonzero(np.abs(values) >= ABSURD)):
            what = f"{values[far[0]]:g} as {name} is no value that anything shows"
            line, *also = (int(samples.lines[k]) for k in far.tolist())
            raise SamplesError(samples.file, what, "Check the value and its unit", line=line, also=also)


def _refuse_kinks(bound: BoundProblem) -> None:
    """Raise ProblemError for the first row with a residual at the nominal but no derivative, as of a norm at zero."""
    smooth = np.isfinite(bound.jacobian(bound.x0)).all(axis=1)
    for row in np.flatnonzero(~smooth & np.isfinite(bound.residual(bound.x0))).tolist():
        name, (block, sample, _) = type(bound.problem.instruments[bound._instrument(row)]).__name__, bound._locate(row)
        where = f"{block.samples.file}, line {block.samples.lines[sample]}"
        what = f"{where}: the residual of {name} has no finite derivative in this row, as a norm has none at zero"
        fix = "Write it smoothly, such as sqrt(sumsqr(v) + 1e-6) for norm_2(v) or atan2 for acos; or leave the row out"
        raise ProblemError(f"{what}, nor acos at one", fix)


class BoundProblem(LeastSquares):
    """A `Problem` with its samples; see `bind`.

    First what it is made of and made into; then its rows, samples of every instrument numbered one after another with
    the scalar residuals (rows,) that they have; then what estimators ask, on the rows' kernels, where no whole Jacobian
    is held unless it is asked for.
    """

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
        known: Gaussian | None = None,
    ) -> None:
        self.problem, self.slots, self.samples = problem, tuple(slots), tuple(samples)
        self.scale = FrozenMapping(scale)
        free, none = [slot for slot in self.slots if slot.unknown.size], np.zeros(0)
        sizes = [slot.unknown.size for slot in free]
        if sum(sizes) > MOST_UNKNOWNS:
            came = f"{sum(sizes):,} unknowns came, and a problem holds {MOST_UNKNOWNS:,} at most"
            raise ProblemError(came, "Take the rows of fewer faces or other labels, or hold unknowns with --fix")
        self.names = tuple(name for slot in free for name in slot.unknown.names(slot.name))
        self.units = tuple(unit for slot in free for unit in slot.unknown.units)
        self.beside = tuple(slot.term for slot in free for _ in slot.columns)
        """Key of the term that each unknown (n,) belongs to; empty for the geometry."""
        self.x0 = read_only(np.zeros(sum(sizes)))
        self.prior_std = read_only(np.concatenate([none, *(slot.unknown.prior_stds for slot in free)]))
        self.start_std = read_only(np.concatenate([none, *(slot.unknown.start_stds for slot in free)]))
        self.known = None if known is None else known.of(self.names)
        if self.known is not None:
            self.x0, self.prior_std = map(read_only, self.known.placed(self.names, self.x0, self.prior_std))
            self.start_std = read_only(np.where(np.isfinite(self.prior_std), self.prior_std, self.start_std))
        self.constraints = constraint_set(problem.exact, self.slots, self.start_std)
        self.datum = read_only(np.repeat([slot.datum for slot in free], sizes).astype(bool))
        self.surveys = tuple(surveys) or surveys_of(problem, samples, nominals(self.slots))
        self._backend, self._threads = backend, thread_count(threads)  # as requested; `backend` is the one in use
        if stated is None:
            made = [make_block(problem, i, self.slots, some, self.surveys[i]) for i, some in enumerate(samples)]
            few = problem.terms and sum(map(len, samples)) <= FEW_ROWS
            if backend is None and few and VARIABLE not in os.environ:
                backend = "blocks"
            stated = KernelRows(made, self.unknowns, backend, self._threads)
        self._stated = self._rows = stated  # with the noise as it was stated
        self.blocks = stated.blocks
        if self.scale:  # what was stated times the factor of each row, with what joints do not repeat
            whole, (joint, rad), found = self.noise_factors(scale), repeatability(scale), list[Block]()
            for i, block in enumerate(self.blocks):
                noise = block.noise * whole[self.sample_rows(i)].reshape(block.noise.shape)
                noise = np.hypot(noise, rad * block.joint_noise(joint)) if rad > 0 else noise
                found.append(replace(block, noise=noise))
            self.blocks = tuple(found)
            self._rows = stated.with_noise(self.blocks)

    def __reduce__(self) -> tuple[Any, ...]:
        """Constructor and arguments for pickling; kernels and sums are recomputed."""
        made_from = (self.problem, self.slots, self.samples, self._backend, self._threads, self.scale, self.surveys)
        return BoundProblem, (*made_from, None, self.known)

    def __eq__(self, other: object) -> bool:
        if self is other or not isinstance(other, BoundProblem):
            return self is other
        mine, theirs = ((b.problem, b.slots, b.samples, b.scale, b.known) for b in (self, other))
        return alike(mine, theirs)

    def __hash__(self) -> int:
        return hash((self.problem, self.names, self.rows))

    def __repr__(self) -> str:
        return f"<{self.problem!r}, bound to {self.rows} rows: {self.unknowns} unknowns {short(self.names)}>"

    def on(self, *samples: Samples | Measurements) -> BoundProblem:
        """Bind the same unknowns, with the same nominal values, to other rows; raises ProblemError for a new label."""
        return self._like(self.slots, sets_of(samples), self.scale)

    def take(self, rows: Sequence[int] | Index) -> BoundProblem:
        """The problem on a subset of its samples, by row numbers; unknowns keep their places."""
        return self.on(*self.measured.take(rows).sets)

    def thinned(self, most: int) -> BoundProblem:
        """The problem itself, or with at most `most` of its samples, evenly spread."""
        count = len(self.measured)
        return self if count <= most else self.take(np.unique(np.linspace(0, count - 1, most).astype(int)))

    def under(self, problem: Problem, *, backend: str | None = None) -> BoundProblem:
        """The rows and nominal values bound to another problem of the same geometry, such as one with other terms."""
        slots = make_slots(problem, self.samples, {slot.name: slot.nominal for slot in self.slots})
        backend = backend or self._backend
        return BoundProblem(problem, slots, self.samples, backend, self._threads, self.scale, known=self.known)

    def with_known(self, known: Gaussian) -> BoundProblem:
        """The problem with a joint Gaussian prior on some unknowns, by name, in place of their own priors."""
        parts = (self.problem, self.slots, self.samples, self._backend, self._threads, self.scale, self.surveys)
        return BoundProblem(*parts, self._stated, known)

    def with_sizes(self, times: Mapping[str, float], *, noise: Mapping[str, float] | None = None) -> BoundProblem:
        """The problem with prior standard deviations of terms scaled by a factor per key, and noise by others."""
        slots = [slot.sized(times.get(slot.term, 1.0)) for slot in self.slots]
        return self._like(slots, self.samples, self.scale if noise is None else noise)

    def with_noise(self, scale: Mapping[str, float] = EMPTY) -> BoundProblem:
        """The problem with stated noise scaled by a factor per face, or per instrument where there are several.

        "" stands for those that are not named; without any, it is the noise as stated.
        """
        return self._like(self.slots, self.samples, scale)

    def _like(self, slots: Sequence[Slot], samples: Sequence[Samples], scale: Mapping[str, float]) -> BoundProblem:
        stated = self._stated if list(map(id, samples)) == list(map(id, self.samples)) else None
        parts = (self.problem, slots, samples, self._backend, self._threads, scale, self.surveys, stated, self.known)
        return BoundProblem(*parts)

    def first_part(self) -> tuple[BoundProblem, Index] | None:
        """The geometry alone, where there are terms beside it."""
        geometry = np.flatnonzero([not key for key in self.beside])
        return (self.under(self.problem.without_terms), geometry) if geometry.size < self.unknowns else None

    def parameters(self) -> Iterator[tuple[str, str, float, int | None]]:
        """Numbers of all parameters but those of terms: name, unit, nominal, position in x (None when held)."""
        return (number for slot in self.slots if not slot.term for number in slot.numbers())

    def noise_factors(self, scale: Mapping[str, float]) -> Array:
        """The factor of each residual's stated noise (rows,), but for what joints do not repeat.

        Where repeats share the part c of their variance, m of them weigh together like one of variance
        (1 + (m - 1) c) / m, the design effect of samples in clusters (Kish, Survey Sampling, 1965).
        """
        faces = self.noise_labels
        known = np.array([scale.get(name, scale.get(OTHERS, 1.0)) for name in faces.names], dtype=np.float64)
        found = known[faces.codes]
        if (shared := scale.get(SHARED, 0.0)) > 0:
            again = self.repeats
            found = found * np.sqrt(1 + (again.sizes[again.codes] - 1) * shared)[self.sample_of]
        return np.asarray(found)

    @property
    def block(self) -> Block:
        """The rows of the only instrument; raises ProblemError where there are several."""
        _ = self.problem.instrument
        return self.blocks[0]

    @cached_property
    def measured(self) -> Measurements:
        """The samples of all instruments."""
        return Measurements(self.problem.names, self.samples)

    @property
    def groups_by(self) -> tuple[str | None, ...]:
        """The column by which each instrument's rows are grouped."""
        return tuple(instrument.groups for instrument in self.problem.instruments)

    @cached_property
    def faces(self) -> Labels:
        """The face (N,) of each sample, or what else its instrument groups rows by."""
        return self.measured.labelled(self.groups_by)

    @cached_property
    def noise_labels(self) -> Labels:
        """Noise group of each residual (rows,): its face, or its instrument where there are several.

        Where an instrument's residual has blocks, their names, after its own among several.
        """
        instruments, several = self.problem.instruments, len(self.samples) > 1
        if not several and not instruments[0].blocks:
            return self.faces.take(self.sample_of)
        names, codes = list[str](), np.zeros(self.sample_of.size, dtype=np.intp)
        for i, (name, instrument) in enumerate(zip(self.problem.names, instruments, strict=True)):
            own, blocks = self.sample_rows(i), [(block.name, block.size) for block in instrument.blocks]
            blocks = blocks or [("", self.blocks[i].noise.shape[1])]
            which = np.repeat(np.arange(len(blocks)), [size for _, size in blocks])
            codes[own] = len(names) + which[self.component_of[own]]
            names += [f"{name} {block}".strip() if several else block for block, _ in blocks]
        return Labels(names, codes)

    @property
    def noise_groups(self) -> tuple[Index, ...]:
        """Residuals of each noise group."""
        return tuple(self.noise_labels.rows().values())

    @cached_property
    def leading(self) -> Rows:
        """Which residuals (rows,) are of the unit in which their instrument speaks; figures are of these."""
        found = []
        for block, instrument in zip(self.blocks, self.problem.instruments, strict=True):
            units = [part.unit for part in instrument.blocks for _ in range(part.size)]
            alike = [unit == instrument.words.unit for unit in units] or [True] * block.noise.shape[1]
            found.append(np.tile(alike, len(block.noise)))
        return np.concatenate(found)

    @cached_property
    def repeats(self) -> Repeats:
        """Which samples repeat one another."""
        from casacal.data.repeats import repeats_in

        return repeats_in(self.measured, self.groups_by)

    @cached_property
    def starts(self) -> Index:
        """The first residual of each instrument, and after the last how many there are."""
        return np.cumsum([0, *(block.noise.size for block in self.blocks)])

    @cached_property
    def components(self) -> Index:
        """Number of residuals of each sample (N,)."""
        return np.concatenate([np.full(len(block.noise), block.noise.shape[1]) for block in self.blocks])

    @cached_property
    def sample_of(self) -> Index:
        """The sample that each residual is of (rows,)."""
        return np.repeat(np.arange(len(self.components)), self.components)

    @cached_property
    def first_of(self) -> Index:
        """The first residual of each sample (N,)."""
        return np.cumsum(self.components) - self.components

    @cached_property
    def component_of(self) -> Index:
        """Which component of its sample's residual each one is (rows,)."""
        return np.arange(self.sample_of.size) - self.first_of[self.sample_of]

    def residuals_of(self, samples: Index | Rows) -> Index:
        """Numbers of the residuals of some samples, in the order of all."""
        chosen = np.zeros(len(self.components), dtype=bool)
        chosen[samples] = True
        return np.flatnonzero(chosen[self.sample_of])

    def sample_rows(self, i: int) -> slice:
        """The residuals of instrument `i`, among all."""
        return slice(int(self.starts[i]), int(self.starts[i + 1]))

    def largest(self, values: Array) -> Array:
        """The largest (N,) of values (rows,) in each sample."""
        return np.asarray(np.maximum.reduceat(values, self.first_of))

    @cached_property
    def noise(self) -> Array:
        """Standard deviation (rows,) of each residual at the nominal, in its unit."""
        return np.concatenate([block.noise.ravel() for block in self.blocks])

    def joint_noise(self, joint: int = 0) -> Array:
        """Residual noise (rows,) where every joint errs independently by one radian, or one alone by its number."""
        return np.concatenate([block.joint_noise(joint).ravel() for block in self.blocks])

    def tips(self, x: Array, joints: Array, instrument: int = 0) -> Array:
        """Tips (N, 3; mm) at joint values (N, n; rad, mm) and reading zero."""
        return np.asarray(self.blocks[instrument].posture("tip", x, joints)[0])

    def tip_jacobian(
        self, x: Array, joints: Array, instrument: int = 0, by: Index | None = None, *, usual: bool = True
    ) -> Array:
        """Derivative (3 N, n) of those tips by x, or by some (s,) of its unknowns, in units of mm per unit of x.

        usual: as for `Block.posture`.
        """
        return self.blocks[instrument].slopes("tip", x, joints, by, usual=usual)[1]

    def poses(self, x: Array, joints: Array, instrument: int = 0) -> Array:
        """Flange poses (N, 4, 4; mm) at joint values (N, n; rad, mm)."""
        return stacked_poses(self.blocks[instrument].posture("pose", x, joints)[0])

    @property
    def rows(self) -> int:
        """Scalar residuals of all instruments."""
        return int(self.starts[-1])

    @property
    def backend(self) -> str:
        """Back end that evaluates the rows: "c" or "blocks"."""
        return self._rows.backend

    def plain_residual(self, x: Array) -> Array:
        """Residuals (rows,) in their own unit, mm for a plane, before whitening."""
        return self._rows.residual(x)

    def residual(self, x: Array) -> Array:
        """Whitened residuals (rows,) at x (n,)."""
        return self._rows.residual(x) / self._rows.noise

    def jacobian(self, x: Array) -> Array:
        """Whitened Jacobian (rows, n) at x (n,)."""
        whole = np.zeros((self.rows, self.unknowns))
        for piece, _, slopes in self._rows.slopes(x):
            whole[piece.numbers[..., None], piece.columns] = slopes / self._rows.noise[piece.numbers][..., None]
        return whole

    def compact_jacobian(self, x: Array) -> Array:
        """Rows (k, n) with the J'J of the whitened Jacobian: itself, or the triangle R of many rows."""
        few = self.rows <= COMPACT and self.rows * self.unknowns <= HELD
        return self.jacobian(x) if few else self._rows.triangle(x)

    @cached_property
    def _packed(self) -> PackedPieces | None:
        """All rows for C; None where C does not evaluate all."""
        pieces = self._rows.pieces
        in_c = all(isinstance(piece.kernels, NativeKernels) for piece in pieces)
        return PackedPieces(pieces) if pieces and in_c else None

    @cached_property
    def _native(self) -> NativeNormal | None:
        """Sums in C; None where some rows are not evaluated in C, or pieces and unknowns are many."""
        if self._packed is None or len(self._packed.pieces) * self.unknowns**2 > MOST_SUMS:
            return None
        threads = self._threads if self.rows >= FEW else 1
        return NativeNormal(self._packed, self.x0, self.start_std, self.prior_information, threads)

    def normal(self, x: Array, loss: Loss | None = None) -> Normal:
        """Cost, gradient and information of the data, accumulated in the kernels; rows weighted by a loss."""
        if loss is None and self._native is not None:
            return Normal(*self._native.sums(x))
        cost, gradient, information = 0.0, np.zeros(x.size), np.zeros((x.size, x.size))
        for piece, some, s in self._rows.sums(x, loss):
            cost += some
            gradient[piece.columns] += s[:-1, -1]
            information[piece.columns[:, None], piece.columns] += s[:-1, :-1]
        return Normal(cost, gradient, information)

    def damped_step(self, x: Array, normal: Normal, damping: float) -> DampedStep | None:
        """A damped Gauss-Newton step; in C where rows are evaluated in C."""
        if self._native is None:
            return super().damped_step(x, normal, damping)
        found = self._native.step(x, normal.gradient, normal.information, damping)
        return None if found is None else DampedStep(*found)

    def costs(self, states: Array, loss: Loss | None = None) -> Array:
        """Objective at many states (m, n): (m,); with a loss where one is given."""
        away = (states - self.x0) @ self.prior_rows.T
        return np.asarray((away**2).sum(axis=1) / 2 + self._rows.costs(states, loss))

    def extended_pass(self, mean: Array, covariance: Array) -> ExtendedPass | None:
        """Let an extended filter take in all rows, in C where there is a compiler."""
        if self._packed is None:
            return None
        mean, covariance = mean.copy(), np.ascontiguousarray(covariance.copy())
        trace = self._packed.extended_pass(self._rows.places, self.x0, self.start_std, mean, covariance)
        return ExtendedPass(mean, covariance, *trace)

    def row(self, k: int, states: Array) -> Array:
        """Whitened residual k at many states (m, n): (m,)."""
        block, sample, component = self._locate(k)
        pattern = block.pattern[sample]
        z, c, d = states[:, block.columns[pattern]], block.constants[pattern], block.data[sample]
        (e,) = block.model.batch("residual")(z, c, d)
        return np.asarray(e[:, component] / block.noise[sample, component])

    def row_jacobian(self, k: int, x: Array) -> tuple[float, Array]:
        """Whitened residual k and its gradient (n,) at x (n,)."""
        block, sample, component = self._locate(k)
        pattern, noise = block.pattern[sample], block.noise[sample, component]
        columns = block.columns[pattern]
        e, slopes = block.model.batch("jacobian")(x[columns][None], block.constants[pattern], block.data[sample])
        gradient = np.zeros(self.unknowns)
        gradient[columns] = slopes.reshape(-1, columns.size)[component] / noise
        return float(e[0, component] / noise), gradient

    def filter_pass(self, first: int, mean: Array, root: Array) -> FilterPass:
        """Let a cubature filter take in the rows of one instrument from `first` on, in C where there is a compiler."""
        i = self._instrument(first)
        block, before = self.blocks[i], int(self.starts[i])
        once = np.hstack([block.constants[block.pattern], block.data])
        rows = FilterRows(block.pattern, block.columns, self.x0, self.start_std, once, 1 / block.noise)
        mean, root = mean.copy(), np.ascontiguousarray(root.copy())
        stop, *trace = block.model.filter(self._backend)(first - before, rows, mean, root)
        return FilterPass(before + stop, mean, root, *(each[first - before : stop] for each in trace))

    def _instrument(self, k: int) -> int:
        return int(np.searchsorted(self.starts, k, side="right")) - 1

    def _locate(self, k: int) -> tuple[Block, int, int]:
        """The block of residual k, its sample there, and its component."""
        i = self._instrument(k)
        block = self.blocks[i]
        return block, *divmod(k - int(self.starts[i]), block.noise.shape[1])

    @cached_property
    def graph(self) -> RawGraph:
        """The symbolic form in raw coordinates, for the IPOPT reference."""
        return RawGraph(self.slots, self.blocks, self._threads, self, self.problem.exact)

    @cached_property
    def symbolic(self) -> SymbolicProblem:
        """All rows as CasADi expressions of x, for one's own programs and solvers."""
        from casacal.fit.symbolic import SymbolicProblem

        return SymbolicProblem(self, self.slots, self.blocks)


@dataclass(frozen=True)
class Alone:
    """One instrument of a problem and its samples; the name is empty for an only one."""

    name: str
    problem: Problem
    samples: Samples


def each_alone(problem: Problem, samples: Sequence[Samples]) -> Iterator[Alone]:
    """The instruments of a problem one by one, in their order, each with its samples."""
    if len(samples) == 1:
        yield Alone("", problem, samples[0])
        return
    for name, some in zip(problem.names, samples, strict=True):
        yield Alone(name, problem.measured_by(name), some)
