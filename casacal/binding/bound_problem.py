"""A problem bound to samples: the least-squares problem that estimators see."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.limits import COMPACT
from casacal.binding.noise_scale import scaled_noise
from casacal.binding.raw_graph import RawGraph
from casacal.binding.row_groups import RowGroups, places
from casacal.binding.slots import Block, Slot, make_block, make_slots
from casacal.binding.sums import Sums
from casacal.binding.symbolic import SymbolicProblem
from casacal.kernels.native_filter import extended_pass
from casacal.kinematics import stacked_poses
from casacal.least_squares.arrow import Arrow
from casacal.least_squares.elimination import GroupRows
from casacal.least_squares.groups import Groups
from casacal.least_squares.losses import Loss
from casacal.least_squares.objective import ExtendedPass, FilterPass, LeastSquares, Normal, Step
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.threads import thread_count
from casacal.values import FrozenMapping, alike, read_only, short


def bind(problem: Problem, *samples: Samples, backend: str | None = None, threads: int | None = None) -> BoundProblem:
    """Bind a problem to its samples, one set per instrument: nominal values, unknowns and weights are settled here.

    Planes and frames without a nominal get one from the nominal robot (a total-least-squares plane, a rigid fit); the
    noise of each row is evaluated there and held.

    Args:
        problem: robot and instruments.
        samples: rows of each instrument.
        backend: "c" or "blocks", what evaluates the rows; None takes CASACAL_BACKEND, else C where there is a compiler.
        threads: how many share thousands of rows; None takes CASACAL_THREADS, else the processors at hand. Results do
            not depend on it.

    Returns:
        What estimators see: n unknowns in mm and rad, whitened residuals (rows,).

    Raises ProblemError when the number of sample sets is wrong or a label has too few rows for its own unknowns.

    """
    return BoundProblem(problem, make_slots(problem, samples), samples, backend, threads)


class BoundProblem(LeastSquares):
    """A `Problem` with its samples; see `bind`."""

    def __init__(
        self,
        problem: Problem,
        slots: Sequence[Slot],
        samples: Sequence[Samples],
        backend: str | None = None,
        threads: int | None = None,
        noise_scale: Sequence[Mapping[str, float]] = (),
    ) -> None:
        self.problem, self.slots, self.samples = problem, tuple(slots), tuple(samples)
        self.noise_scale = tuple(FrozenMapping(scale) for scale in noise_scale)
        pairs = [(slot, j) for slot in self.slots for j in range(slot.unknown.size)]
        self.names = tuple(slot.unknown.names(slot.name)[j] for slot, j in pairs)
        self.units = tuple(slot.unknown.units[j] for slot, j in pairs)
        self.x0 = read_only(np.zeros(len(pairs)))
        self.prior_std = read_only(np.array([slot.unknown.prior_stds[j] for slot, j in pairs], dtype=np.float64))
        self.start_std = read_only(np.array([slot.unknown.start_stds[j] for slot, j in pairs], dtype=np.float64))
        self.datum = read_only(np.array([slot.datum for slot, _ in pairs], dtype=bool))
        blocks = [make_block(problem, i, self.slots, samples[i]) for i in range(len(problem.instruments))]
        self.blocks = scaled_noise(blocks, [instrument.groups for instrument in problem.instruments], self.noise_scale)
        self._asked, self._threads = backend, thread_count(threads)
        self._groups = tuple(RowGroups(block, self.unknowns, backend, self._threads) for block in self.blocks)
        self._starts = np.cumsum([0] + [block.noise.size for block in self.blocks])

    def __reduce__(self) -> tuple[Any, ...]:
        """What it was made from; kernels and sums are computed again."""
        return BoundProblem, (self.problem, self.slots, self.samples, self._asked, self._threads, self.noise_scale)

    def __eq__(self, other: object) -> bool:
        if self is other or not isinstance(other, BoundProblem):
            return self is other
        mine, theirs = ((b.problem, b.slots, b.samples, b.noise_scale) for b in (self, other))
        return alike(mine, theirs)

    def __hash__(self) -> int:
        return hash((self.problem, self.names, self.rows))

    def __repr__(self) -> str:
        return f"<{self.problem!r}, bound to {self.rows} rows: {self.unknowns} unknowns {short(self.names)}>"

    @property
    def block(self) -> Block:
        """The rows of the only instrument; raises ProblemError where there are several."""
        _ = self.problem.instrument
        return self.blocks[0]

    @property
    def rows(self) -> int:
        """Scalar residuals of all instruments."""
        return int(self._starts[-1])

    def on(self, *samples: Samples) -> BoundProblem:
        """Bind the same unknowns, with the same nominal values, to other rows; raises ProblemError for a new label."""
        return BoundProblem(self.problem, self.slots, samples, self._asked, self._threads, self.noise_scale)

    def with_noise(self, *scale: Mapping[str, float]) -> BoundProblem:
        """The same rows, their stated noise times a factor for each face of each instrument; "" stands for others."""
        return BoundProblem(self.problem, self.slots, self.samples, self._asked, self._threads, scale)

    @property
    def backend(self) -> str:
        """Name of the back end that evaluates the rows: "c" or "blocks"."""
        return self._groups[0].backend

    def plain_residual(self, x: Array) -> Array:
        """Residuals (rows,) in their own unit, mm for a plane, before whitening."""
        return np.concatenate([groups.residual(x).ravel() for groups in self._groups])

    def residual(self, x: Array) -> Array:
        """Whitened residuals (rows,) at x (n,)."""
        pairs = zip(self._groups, self.blocks, strict=True)
        return np.concatenate([(groups.residual(x) / block.noise).ravel() for groups, block in pairs])

    def jacobian(self, x: Array) -> Array:
        """Whitened Jacobian (rows, n) at x (n,)."""
        parts = []
        for groups, block in zip(self._groups, self.blocks, strict=True):
            whole = np.zeros((*block.noise.shape, self.unknowns))
            for piece, _, slopes in groups.slopes(x):
                whole[piece.rows[:, None, None], np.arange(slopes.shape[1])[:, None], piece.columns] = (
                    slopes / block.noise[piece.rows][..., None]
                )
            parts.append(whole.reshape(block.noise.size, self.unknowns))
        return np.vstack(parts)

    def normal(self, x: Array, loss: Loss | None = None) -> Normal:
        """Cost, gradient and information of the data, accumulated in the kernels: the Jacobian is never held."""
        return self._sums.normal(x, loss)

    @property
    def groups(self) -> Groups | None:
        """Which unknowns belong to one label alone, where these are many: they are taken out label by label."""
        return self._sums.groups

    def group_rows(self, x: Array, loss: Loss | None = None) -> Iterator[GroupRows]:
        """The whitened Jacobian at x (n,) group by group, where information is an arrow; rows weighted by a loss."""
        return self._sums.group_rows(x, loss)

    def damped_step(self, x: Array, normal: Normal, damping: float) -> Step | None:
        """A damped Gauss-Newton step; in C where rows are evaluated in C."""
        native, information = self._sums.native, normal.information
        if native is None or isinstance(information, Arrow):
            return super().damped_step(x, normal, damping)
        found = native.step(x, normal.gradient, information, damping)
        return None if found is None else Step(*found)

    def compact_jacobian(self, x: Array) -> Array:
        """Rows (k, n) with the J'J of the whitened Jacobian: itself, or the triangle R of many rows."""
        if self.rows <= COMPACT:
            return self.jacobian(x)
        return self._sums.triangles(x)

    @cached_property
    def _sums(self) -> Sums:
        return Sums(self._groups, self.slots, (self.x0, self.start_std, self.prior_information), self._threads)

    def costs(self, states: Array) -> Array:
        """Objective at many states (m, n): (m,)."""
        away = states - self.x0
        away *= away
        total = away @ (self.prior_information / 2)
        for groups in self._groups:
            total += groups.costs(states)
        return np.asarray(total)

    def filter_pass(self, first: int, mean: Array, root: Array) -> FilterPass:
        """Let a cubature filter take in the rows of one instrument from `first` on, in C where there is a compiler."""
        i = int(np.searchsorted(self._starts, first, side="right")) - 1
        start = int(self._starts[i])
        done = self._groups[i].filter_pass(first - start, self.x0, self.start_std, mean, root)
        return replace(done, stop=start + done.stop)

    def extended_pass(self, mean: Array, covariance: Array) -> ExtendedPass | None:
        """Let an extended filter take in all rows, in C where there is a compiler."""
        if self._sums.packed is None:
            return None
        mean, covariance = mean.copy(), np.ascontiguousarray(covariance.copy())
        trace = extended_pass(self._sums.packed, places(self._groups), self.x0, self.start_std, mean, covariance)
        return ExtendedPass(mean, covariance, *trace)

    def row(self, k: int, states: Array) -> Array:
        """Whitened residual k at many states (m, n): (m,)."""
        groups, row = self._locate(k)
        return groups.row(row, states)

    def row_jacobian(self, k: int, x: Array) -> tuple[float, Array]:
        """Whitened residual k and its gradient (n,) at x (n,)."""
        groups, row = self._locate(k)
        return groups.row_jacobian(row, x)

    def tips(self, x: Array, joints: Array, instrument: int = 0) -> Array:
        """Tips (N, 3; mm) at joint values (N, n; rad, mm) and reading zero."""
        return np.asarray(self._tip_inputs(self.blocks[instrument], x, joints, "tip")[0])

    def tip_jacobian(self, x: Array, joints: Array, instrument: int = 0, by: NDArray[np.intp] | None = None) -> Array:
        """Derivative (3 N, n) of those tips by x, or by some (s,) of its unknowns, in units of mm per unit of x."""
        block = self.blocks[instrument]
        _, slopes = self._tip_inputs(block, x, joints, "tip_jacobian")
        by = np.arange(self.unknowns) if by is None else by
        _, inside, seen = np.intersect1d(by, block.columns[0], return_indices=True)
        jacobian = np.zeros((3 * len(joints), by.size))
        jacobian[:, inside] = slopes.reshape(len(jacobian), -1)[:, seen]
        return jacobian

    def poses(self, x: Array, joints: Array, instrument: int = 0) -> Array:
        """Flange poses (N, 4, 4; mm) at joint values (N, n; rad, mm)."""
        return stacked_poses(self._tip_inputs(self.blocks[instrument], x, joints, "pose")[0])

    def parameters(self) -> Iterator[tuple[str, str, float, int | None]]:
        """Every number of every parameter: name, unit, nominal, and its position in x (None when held)."""
        return (number for slot in self.slots for number in slot.numbers())

    @cached_property
    def graph(self) -> RawGraph:
        """The symbolic form in raw coordinates, for the IPOPT reference."""
        return RawGraph.of(self.slots, self.blocks, self._threads)

    @cached_property
    def symbolic(self) -> SymbolicProblem:
        """All rows as CasADi expressions of x, for one's own programs and solvers."""
        return SymbolicProblem(self, self.slots, self.blocks)

    def _tip_inputs(self, block: Block, x: Array, joints: Array, name: str) -> list[Array]:
        data = np.zeros((len(joints), joints.shape[1] + len(block.known)))
        data[:, : joints.shape[1]] = joints
        outputs: list[Array] = getattr(block.model.batch, name)(x[block.columns[0]], block.constants[0], data)
        return outputs

    def _locate(self, k: int) -> tuple[RowGroups, int]:
        i = int(np.searchsorted(self._starts, k, side="right")) - 1
        return self._groups[i], k - int(self._starts[i])
