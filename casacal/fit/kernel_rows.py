"""The rows of a block laid over their kernel: which columns, weights and unknowns each row takes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from casacal.errors import ProblemError
from casacal.fit.constrained import ConstraintSet
from casacal.fit.least_squares import Gaussian, LeastSquares
from casacal.fit.slots import Block, Slot
from casacal.kernels.block_rows import Buffered, CurvatureKernel
from casacal.kernels.losses import Loss
from casacal.kernels.rows import Lanes, Piece
from casacal.linalg import LEAST_SLOPE
from casacal.model.constraint import Constraint, Correlation
from casacal.model.unknown import Parameter
from casacal.threads import shared_out
from casacal.values import Array, Index

Places: TypeAlias = tuple[Index, Index]


@dataclass(frozen=True)
class RawBlock:
    """Rows whose residuals depend on the same raw coordinates, with the constants (nc,) that they share."""

    kernel: CurvatureKernel
    columns: Index  # positions of the kernel's v in the whole raw vector
    constants: Array
    lanes: Lanes
    threads: int

    def __call__(self, v: Array, loss: Loss | None = None) -> tuple[float, Array, Array]:
        """Cost of the rows, its gradient (z,) and Hessian (z, z) by what they see of v (n,)."""
        return self.kernel(v[self.columns], self.constants, self.lanes, loss=loss, threads=self.threads)


class RawGraph:
    """The symbolic form of a problem: its objective over raw coordinates v, and what makes these valid.

    blocks: rows that see the same of v. start: v of the nominal. constraints: v -> g, zero where v is valid, and after
    that the constraints of the problem (m,); low, high: between what g lies. local: v -> x, the local coordinates of
    the other estimators. prior: v -> its cost, gradient and entries of the Hessian's upper triangle, at `prior_places`
    (rows, columns). bend: (v, multipliers) -> entries, at `bend_places`, of the Hessian of the constraints times these.
    """

    def __init__(
        self,
        slots: Sequence[Slot],
        blocks: Sequence[Block],
        threads: int,
        problem: LeastSquares,
        constraints: Sequence[Constraint] = (),
    ) -> None:
        starts = np.cumsum([0] + [slot.unknown.raw_size for slot in slots])
        first = {slot.name: int(start) for slot, start in zip(slots, starts, strict=False)}
        found = []
        for block in blocks:
            for row_slots, constants, rows in zip(block.slots, block.constants, block.by_pattern, strict=True):
                columns = [first[s.name] + j for s in row_slots for j in range(s.unknown.raw_size)]
                kernel, there = block.model.curvature, np.array(columns, dtype=np.intp)
                lanes = kernel.lanes(block.rows(rows), block.noise[rows])
                found.append(RawBlock(kernel, there, constants, lanes, threads))
        free = [slot for slot in slots if slot.unknown.size]
        self.blocks, self.start = tuple(found), np.concatenate([s.unknown.raw_start(s.nominal) for s in free])
        symbols = [ca.SX.sym(slot.name, slot.unknown.raw_size) for slot in slots]
        at = dict(zip((slot.name for slot in slots), symbols, strict=True))
        pairs, v, none = list(zip(slots, symbols, strict=True)), ca.vertcat(*symbols), ca.SX(0, 1)
        valid = ca.densify(ca.vertcat(*(g for s, symbol in pairs for g in s.unknown.raw_constraints(symbol)), none))
        ends = np.array([(0.0, 0.0)] * valid.numel() + [(each.low, each.high) for each in constraints])
        self.low, self.high = ends.reshape(-1, 2).T
        valid = ca.vertcat(valid, _quantities(constraints, slots, lambda s: s.unknown.raw_value(s.nominal, at[s.name])))
        local = (s.unknown.raw_local(s.nominal, symbol) for s, symbol in pairs if s.unknown.size)
        self.constraints = ca.Function("constraints", [v], [valid])
        self.local = ca.Function("local", [v], [ca.densify(ca.vertcat(*local, none))])
        self.prior, self.prior_places = _by_entries(_prior(slots, problem), 2)
        multipliers = ca.SX.sym("lam", valid.numel())
        hessian, _ = ca.hessian(ca.dot(multipliers, valid), v)
        self.bend, self.bend_places = _by_entries(ca.Function("bend", [v, multipliers], [ca.triu(hessian)]), 0)


def _quantities(constraints: Sequence[Constraint], slots: Sequence[Slot], value: Callable[[Slot], Any]) -> ca.SX:
    """What constraints hold (m,), of the values of slots; ProblemError for a label that the samples do not have."""
    placed = {slot.name: slot for slot in slots}

    def packed(name: str) -> Any:
        if name not in placed:
            there = ", ".join(name for name in placed if "." in name)
            raise ProblemError(f"A constraint names '{name}', which no samples are of", f"There are: {there or 'none'}")
        slot = placed[name]
        held = None if slot.unknown.size else slot.unknown.at(ca.DM(slot.nominal), ca.SX(0, 1))
        return slot.unknown.packed(value(slot) if held is None else held)

    return ca.densify(ca.vertcat(*(each.function(*map(packed, each.names)) for each in constraints), ca.SX(0, 1)))


def constraint_set(constraints: Sequence[Constraint], slots: Sequence[Slot], scale: Array) -> ConstraintSet | None:
    """Constraints as functions of x (n,), each coordinate of size `scale`; None without any. Raises ProblemError."""
    if not constraints:
        return None
    x = ca.SX.sym("x", scale.size)
    values = _quantities(constraints, slots, lambda s: s.unknown.at(ca.DM(s.nominal), x[list(s.columns)]))
    slopes = ca.jacobian(values, x)
    function = ca.Function("constraints", [x], [values, ca.densify(slopes)])

    def evaluate(at: Array) -> tuple[Array, Array]:
        there, matrix = function(at)
        return np.asarray(there).ravel(), np.asarray(matrix)

    names = tuple(each.name for each in constraints)
    low, high = np.array([(each.low, each.high) for each in constraints]).T
    return ConstraintSet(names, low, high, evaluate, np.array(ca.DM(slopes.sparsity(), 1)) > 0, scale)


EXACT = 1e-6  # standard deviation over that of the priors below which a certified quantity leaves rounding alone


def stated_prior(known: Sequence[Constraint | Correlation], slots: Sequence[Slot]) -> Gaussian | None:
    """Joint prior of unknowns that belong together, by correlation or by what is certified; None where none do.

    Their own priors, correlated, are told the certified quantities as a Kalman filter is told linear measurements.
    Raises ProblemError for a flat prior among them, and for a quantity that is not linear.
    """
    measured = [each for each in known if isinstance(each, Constraint) and each.std]
    correlated = [each for each in known if isinstance(each, Correlation)]
    if not measured and not correlated:
        return None
    free = [slot for slot in slots if slot.unknown.size]
    every = [name for slot in free for name in slot.unknown.names(slot.name)]
    stds = np.concatenate([np.zeros(0), *(slot.unknown.prior_stds for slot in free)])
    told = constraint_set(measured, slots, np.ones(len(every)))
    seen = np.array([any(name in each.names for each in correlated) for name in every], dtype=bool)
    seen |= False if told is None else told.depends.any(axis=0)
    names, std = tuple(np.array(every)[seen].tolist()), stds[seen]
    for name in np.array(names)[~np.isfinite(std)].tolist():
        raise ProblemError(f"'{name}' is known together with others, and its prior is flat", "Give it a prior_std")
    matrix = np.eye(len(names))
    for each in correlated:
        own = [k for k, name in enumerate(each.names) if name in names]  # those that are held leave the others theirs
        here = [names.index(each.names[k]) for k in own]
        matrix[np.ix_(here, here)] = np.array(each.matrix)[np.ix_(own, own)]
    prior = Gaussian(names, np.zeros(len(names)), matrix * np.outer(std, std))
    if told is None:
        return prior
    values, slopes = told.evaluate(np.zeros(len(every)))
    for name, bent in zip(told.names, slopes - told.evaluate(np.ones(len(every)))[1], strict=True):
        if np.abs(bent).max() > LEAST_SLOPE:
            raise ProblemError(f"'{name}' is certified, and not linear in the unknowns", "Certify sums of numbers")
    rows = slopes[:, seen]
    spread, noise = prior.covariance @ rows.T, np.diag([each.std**2 for each in measured])
    for certified, variance in zip(measured, np.diagonal(rows @ spread), strict=True):
        if certified.std < EXACT * math.sqrt(variance):
            what = f"'{certified.name}' is certified to {certified.std:g}, below a millionth of what priors leave it"
            raise ProblemError(what, "State a larger std, or keep it exactly with equal()")
    gain = np.linalg.solve(rows @ spread + noise, spread.T).T
    left = prior.covariance - gain @ spread.T
    return Gaussian(names, gain @ (told.low - values), (left + left.T) / 2)


def _by_entries(function: ca.Function, i: int) -> tuple[Buffered, Places]:
    """A function, and the rows and columns of the entries of its output i."""
    rows, columns = (np.array(index, dtype=np.intp) for index in function.sparsity_out(i).get_triplet())
    return Buffered(function), (rows, columns)


def _prior(slots: Sequence[Slot], problem: LeastSquares) -> ca.Function:
    """v -> the prior's cost, gradient and upper Hessian: unknowns that are known together are one piece of it."""
    pieces, alone = list[tuple[ca.SX, ...]](), problem.known is None
    for numbers, some in itertools.groupby(slots, lambda slot: alone and isinstance(slot.unknown, Parameter)):
        for together in [list(some)] if numbers or not alone else [[slot] for slot in some]:
            first = together[0].first
            here = slice(first, first + sum(slot.unknown.size for slot in together))
            information, x0 = problem.prior_information[here, here], problem.x0[here]
            own = ca.SX.sym("v", sum(slot.unknown.raw_size for slot in together))
            if not information.any():  # as faces mostly are
                pieces.append((own, ca.SX(1, 1), ca.SX.zeros(own.numel()), ca.SX(own.numel(), own.numel())))
                continue
            starts = np.cumsum([0, *(slot.unknown.raw_size for slot in together)])
            parts = [(slot, own[a:b]) for slot, a, b in zip(together, starts, starts[1:], strict=False)]
            local = (slot.unknown.raw_local(slot.nominal, part) for slot, part in parts if slot.unknown.size)
            away = ca.vertcat(*local) - ca.DM(x0)
            share = ca.dot(away, ca.mtimes(ca.sparsify(ca.DM(information)), away)) / 2
            bend, slope = ca.hessian(share, own)
            pieces.append((own, *ca.cse([share, slope, ca.triu(bend)])))
    v, cost, gradient, hessian = zip(*pieces, strict=True)
    total = ca.densify(ca.sum1(ca.vertcat(*cost)))
    return ca.Function("prior", [ca.vertcat(*v)], [total, ca.densify(ca.vertcat(*gradient)), ca.diagcat(*hessian)])


FEW = 8_192  # rows below which all stay together: threads would spend more on one another than they save
MOST_PIECES = 16
LARGEST_PIECE = 16_384
MANY_LANES = 50_000  # candidates times rows from which candidates are shared out
PIECES = 1024  # pieces whose sums are held at a time
STATES = 32  # candidates evaluated together, when there are many


class KernelRows:
    """Residuals, slopes and their sums over all rows.

    How rows fall into pieces depends on their number alone, and pieces are summed in order: threads change no digit.
    """

    def __init__(
        self,
        blocks: Sequence[Block],
        unknowns: int,
        backend: str | None,
        threads: int,
        packed: KernelRows | None = None,
    ) -> None:
        self.blocks, self._unknowns, self._backend, self._shared_by = tuple(blocks), unknowns, backend, threads
        self._packed = packed  # rows with other noise whose packed data are reused; None where these are packed anew
        self._kernels = [block.model.rows(backend) for block in blocks]
        self._threads = threads if sum(len(block.noise) for block in blocks) >= FEW else 1
        self._starts = np.cumsum([0, *(block.noise.size for block in blocks)])

    @property
    def backend(self) -> str:
        """Name of the back end in use."""
        return self._kernels[0].name

    def with_noise(self, blocks: Sequence[Block]) -> KernelRows:
        """Rows with other noise; packed data are shared."""
        return KernelRows(blocks, self._unknowns, self._backend, self._shared_by, self._packed or self)

    @cached_property
    def noise(self) -> Array:
        """Standard deviation of each residual (rows,)."""
        each = [block.noise.ravel() for block in self.blocks]
        return each[0] if len(each) == 1 else np.concatenate(each)

    @cached_property
    def pieces(self) -> tuple[Piece, ...]:
        """Rows by instrument and pattern, packed for the kernels when first used."""
        if self._packed is not None:
            return tuple(
                replace(piece, lanes=piece.kernels.reweighted(piece.lanes, 1.0 / self.noise[piece.numbers].T))
                for piece in self._packed.pieces
            )
        found = []
        for block, kernels, first in zip(self.blocks, self._kernels, self._starts, strict=False):
            components = np.arange(block.noise.shape[1])
            for columns, constants, samples in zip(block.columns, block.constants, block.by_pattern, strict=True):
                for rows in _parts(samples):
                    lanes = kernels.lanes(block.rows(rows), block.noise[rows])
                    numbers = rows[:, None]  # of a million rows no copy is held that need not be
                    if first or components.size > 1:
                        numbers = first + numbers * components.size + components
                    found.append(Piece(kernels, lanes, numbers, columns, constants))
        return tuple(found)

    @property
    def places(self) -> Index:
        """Piece, lane in it and component of each row (rows, 3)."""
        found = np.empty((int(self._starts[-1]), 3), dtype=np.intp)
        for k, piece in enumerate(self.pieces):
            lanes, components = np.indices(piece.numbers.shape)
            found[piece.numbers] = np.stack([np.full_like(lanes, k), lanes, components], axis=-1)
        return found

    def residual(self, x: Array) -> Array:
        """Plain residuals (rows,)."""
        e = np.empty(int(self._starts[-1]))

        def fill(piece: Piece) -> None:
            e[piece.numbers] = piece.kernels.residual(piece.parameters(x), piece.lanes).T

        shared_out(fill, self.pieces, self._threads)
        return e

    def slopes(self, x: Array) -> Iterator[tuple[Piece, Array, Array]]:
        """Piece by piece, plain residuals (n, m) and slopes (n, m, z)."""
        for piece in self.pieces:
            e, j = piece.kernels.slopes(piece.parameters(x), piece.lanes)
            yield piece, e.T, j.transpose(2, 0, 1)

    def triangle(self, x: Array) -> Array:
        """R (k, n) with the J'J of the whitened Jacobian; few pieces are held at a time."""

        def of_piece(piece: Piece) -> Array:
            _, slopes = piece.kernels.slopes(piece.parameters(x), piece.lanes)
            whitened = slopes / self.noise[piece.numbers].T[:, None]
            own = np.linalg.qr(whitened.transpose(1, 0, 2).reshape(piece.columns.size, -1).T, mode="r")
            whole = np.zeros((len(own), self._unknowns))
            whole[:, piece.columns] = own
            return whole

        return np.asarray(np.linalg.qr(np.vstack(shared_out(of_piece, self.pieces, self._threads)), mode="r"))

    def costs(self, states: Array, loss: Loss | None = None) -> Array:
        """Half the whitened sum of squares, or the sum of a loss, at many x (m, n): (m,)."""

        def of_piece(piece: Piece, some: Array) -> Array:
            p, noise = np.ascontiguousarray(piece.parameters(some)), self.noise[piece.numbers].T
            if loss is None:
                return piece.kernels.costs(p, piece.lanes)
            return np.array([loss.cost(piece.kernels.residual(each, piece.lanes) / noise).sum() for each in p])

        def total(some: Array) -> Array:
            found = [of_piece(piece, some) for piece in self.pieces]
            return found[0] if len(found) == 1 else np.sum(found, axis=0)

        if len(states) * sum(len(block.noise) for block in self.blocks) < MANY_LANES:
            return total(states)
        few = [states[k : k + STATES] for k in range(0, len(states), STATES)]
        return np.concatenate(shared_out(total, few, self._shared_by))

    def sums(self, x: Array, loss: Loss | None = None) -> Iterator[tuple[Piece, float, Array]]:
        """Piece by piece, half the whitened sum of squares, and (J r)'(J r) (z + 1, z + 1); with a loss, weighted."""

        def part(piece: Piece) -> tuple[float, Array]:
            kernels, p, lanes = piece.kernels, piece.parameters(x), piece.lanes
            if loss is None:
                s = kernels.normal(p, lanes)
                return float(s[-1, -1]) / 2, s
            noise = self.noise[piece.numbers].T
            r = kernels.residual(p, lanes) / noise
            weighted = kernels.reweighted(lanes, np.sqrt(loss.weight(r)) / noise)  # a weight on r^2 is its root on r
            return float(loss.cost(r).sum()), kernels.normal(p, weighted)

        for k in range(0, len(self.pieces), PIECES):
            some = self.pieces[k : k + PIECES]
            for piece, (cost, s) in zip(some, shared_out(part, some, self._threads), strict=True):
                yield piece, cost, s


def _parts(rows: Index) -> list[Index]:
    """Rows in pieces: one of few, else as many as threads may want, none too large to be packed at once."""
    if len(rows) < FEW:
        return [rows] if len(rows) else []
    count = max(min(2 * len(rows) // FEW, MOST_PIECES), -(-len(rows) // LARGEST_PIECE))
    return np.array_split(rows, count)
