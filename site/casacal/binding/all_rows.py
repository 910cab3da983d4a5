"""The rows of all instruments together: which sample each residual is of, its face, its noise; and any posture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.blocks import Block
from casacal.kinematics import stacked_poses
from casacal.problem.problem import Problem
from casacal.samples.measurements import Measurements, Places
from casacal.samples.repeats import Repeats, repeats_in
from casacal.samples.samples import Samples
from casacal.tables.columns import Labels


class AllRows:
    """Samples of every instrument, numbered one after another, and the scalar residuals (rows,) that they have."""

    problem: Problem
    samples: tuple[Samples, ...]
    blocks: tuple[Block, ...]

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
        """What (rows,) the noise of each residual may differ by: its face, or its instrument where there are several.

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

    @cached_property
    def leading(self) -> NDArray[np.bool_]:
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
        return repeats_in(self.measured, self.groups_by)

    @cached_property
    def starts(self) -> Places:
        """The first residual of each instrument, and after the last how many there are."""
        return np.cumsum([0, *(block.noise.size for block in self.blocks)])

    @cached_property
    def components(self) -> Places:
        """How many residuals each sample has (N,)."""
        return np.concatenate([np.full(len(block.noise), block.noise.shape[1]) for block in self.blocks])

    @cached_property
    def sample_of(self) -> Places:
        """The sample that each residual is of (rows,)."""
        return np.repeat(np.arange(len(self.components)), self.components)

    @cached_property
    def first_of(self) -> Places:
        """The first residual of each sample (N,)."""
        return np.cumsum(self.components) - self.components

    @cached_property
    def component_of(self) -> Places:
        """Which component of its sample's residual each one is (rows,)."""
        return np.arange(self.sample_of.size) - self.first_of[self.sample_of]

    def residuals_of(self, samples: Places | NDArray[np.bool_]) -> Places:
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

    @cached_property
    def joint_noise(self) -> Array:
        """The same where every joint errs by one radian of its own, and nothing else."""
        return np.concatenate([block.joint_noise.ravel() for block in self.blocks])

    def tips(self, x: Array, joints: Array, instrument: int = 0) -> Array:
        """Tips (N, 3; mm) at joint values (N, n; rad, mm) and reading zero."""
        return np.asarray(self.blocks[instrument].posture("tip", x, joints)[0])

    def tip_jacobian(
        self,
        x: Array,
        joints: Array,
        instrument: int = 0,
        by: NDArray[np.intp] | None = None,
        *,
        usual: bool = True,
    ) -> Array:
        """Derivative (3 N, n) of those tips by x, or by some (s,) of its unknowns, in units of mm per unit of x.

        usual: as for `Block.posture`.
        """
        block = self.blocks[instrument]
        _, slopes = block.posture("tip_jacobian", x, joints, usual=usual)
        by = np.arange(x.size) if by is None else by
        _, inside, seen = np.intersect1d(by, block.columns[0], return_indices=True)
        jacobian = np.zeros((3 * len(joints), by.size))
        jacobian[:, inside] = slopes.reshape(len(jacobian), -1)[:, seen]
        return jacobian

    def poses(self, x: Array, joints: Array, instrument: int = 0) -> Array:
        """Flange poses (N, 4, 4; mm) at joint values (N, n; rad, mm)."""
        return stacked_poses(self.blocks[instrument].posture("pose", x, joints)[0])


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
