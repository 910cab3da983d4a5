"""The choice among touches that could be made by exchange (Fedorov 1972), I-optimal.

With C the posterior covariance of the unknowns and M the weight of their errors, trace(C M) is the mean squared error
of what is asked for (Atkinson, Donev and Tobias, Optimum Experimental Designs, 2007, chapter 10). A row a (m, n), the m
whitened residuals of one measurement, lowers it by trace((1 + a C a')^-1 a C M C a'); without it, it rises likewise.
Rows are exchanged one by one for the best of all others until none is better. From nothing, one by one, such plans stay
on one face for ever: the first rows on another one tell of that face alone, and earn nothing. So they start at random.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from casacal.data.samples import Samples
from casacal.errors import CasacalError
from casacal.fit.bound_problem import BoundProblem
from casacal.fit.slots import instances
from casacal.model.problem import Problem
from casacal.uncertainty.tip_error import joints_in_box, up_to_base, workspace_joints
from casacal.values import Array, Box, Index, Rows

SWEEPS = 10  # times that every row of a plan is tried against all others
BETTER = 1e-7  # part of the error by which an exchange must lower it


Criterion: TypeAlias = Literal["tip", "parameters"]
"""A plan makes the mean error of the tip small, the trace of C M (I-optimal), or the determinant of C (D-optimal)."""


def gains(rows: Array, covariance: Array, weight: Array, criterion: Criterion = "tip") -> Array:
    """Fall (N,) of trace(C M), or of ln det C, by each measurement (N, m, n)."""
    size, unknowns = rows.shape[1:]
    flat = rows.reshape(-1, unknowns)
    cross = flat @ covariance
    moved = cross @ weight  # in one product: a stack of small ones takes many times as long
    if size == 1:
        spread = 1 + np.einsum("kn,kn->k", cross, flat)
        return np.asarray(np.log(spread) if criterion == "parameters" else (moved * cross).sum(axis=1) / spread)
    cross, moved = cross.reshape(rows.shape), moved.reshape(rows.shape)
    spread = np.einsum("kin,kjn->kij", cross, rows) + np.eye(size)
    if criterion == "parameters":
        return np.asarray(np.linalg.slogdet(spread)[1])
    saved = np.einsum("kin,kjn->kij", moved, cross)
    return np.asarray(np.trace(np.linalg.solve(spread, saved), axis1=1, axis2=2))


UNKNOWN = 1e-9  # information, in units of what filters start from, of what nobody knows beforehand
CANCELLED = 1e-6  # part of what a measurement tells that others tell as well, below which it is worked out anew
ROUNDING = 1e-12
"""As `UNKNOWN`, but as part of the largest information, where rows know some unknowns well and others not at all."""


@dataclass(frozen=True)
class Choice:
    """Measurements among which is chosen, in units of what each unknown may be.

    rows: whitened slopes of each (N, m, n). known: information (n, n) without them. weight: M (n, n).
    """

    rows: Array
    known: Array
    weight: Array

    @staticmethod
    def of(
        bound: BoundProblem,
        joints: Array,
        *,
        count: int | None = None,
        loose: Mapping[str, float] | None = None,
        at: Array | None = None,
    ) -> Choice:
        """Choice among a pool of touches, for a tip that is wanted at some joint values (M, q).

        count: how many of the rows can be chosen; the others have been made. loose: what may have moved since, by the
        name of the unknown: its standard deviation. at: the arm (n,), by default as drawn.
        """
        x, units = bound.x0 if at is None else at, bound.start_std
        rows, field = row_slopes(bound, x), wanted_field(bound, x, joints)
        known = bound.prior_information * np.outer(units, units) + UNKNOWN * np.eye(units.size)
        if count is not None and count < len(rows):
            made = rows[count:].reshape(-1, bound.unknowns)
            known, rows = known + made.T @ made, rows[:count]
        if loose:
            covariance = np.linalg.inv(known)
            for name, std in loose.items():
                j = bound.names.index(name)
                covariance[j, j] += (std / units[j]) ** 2
            known = np.linalg.inv(covariance)
        if (along := bound.tangent(x, ())) is not None:  # the only ways that equalities leave
            along = along / units[:, None]
            rows, known, field = rows @ along, along.T @ known @ along, field @ along
        return Choice(rows, np.asarray(known), field.T @ field / len(joints))

    @staticmethod
    def on_top(extra: BoundProblem, x: Array, known: Array, field: Array) -> Choice:
        """Choice among extra bound rows at x (n,), added to information (n, n) that holds no priors.

        field: slopes (3M, s) of a tip that is wanted at M postures, by the first unknowns; the others move none.
        """
        units = extra.start_std
        held = known + extra.prior_information
        held = held * np.outer(units, units)
        held += max(UNKNOWN, ROUNDING * float(np.trace(held))) * np.eye(units.size)
        slopes = field.reshape(-1, field.shape[-1]) * units[: field.shape[-1]]
        weight = np.zeros_like(held)
        weight[: slopes.shape[1], : slopes.shape[1]] = slopes.T @ slopes / (len(slopes) / 3)
        return Choice(row_slopes(extra, x), np.asarray(held), weight)

    def error(self, chosen: Index) -> float:
        """Tip error (mm RMS) that some measurements leave: the root of trace(C M)."""
        return float(np.sqrt(np.trace(np.linalg.solve(self._information(chosen), self.weight))))

    def _information(self, chosen: Index) -> Array:
        flat = self.rows[chosen].reshape(-1, self.known.shape[0])
        return np.asarray(self.known + flat.T @ flat)

    def exchange(
        self, start: Index, *, criterion: Criterion = "tip", barred: Rows | None = None
    ) -> tuple[Index, float]:
        """Improve a plan until no single exchange does: its rows (k,), and the tip error or ln det C they leave.

        start: the plan to begin with (k,), no row twice. barred: which measurements (N,) must not be taken.
        """
        plan, free = start.copy(), np.ones(len(self.rows), dtype=bool)
        free[plan] = False
        if barred is not None:
            free[barred] = False
        without = _Without.of(self, plan)
        for _ in range(SWEEPS):
            changed = False
            for place in range(len(plan)):
                others, left = without.gains(plan[place], criterion)
                present = float(others[plan[place]])
                others[~free] = -np.inf
                best = int(np.argmax(others))
                if others[best] > present + BETTER * (left - present if criterion == "tip" else 1.0):
                    free[plan[place]], free[best] = barred is None or not barred[plan[place]], False
                    plan[place], changed = best, True
                    without = _Without.of(self, plan)
            if not changed:
                break
        return plan, self.error(plan) if criterion == "tip" else -float(np.linalg.slogdet(self._information(plan))[1])

    def best_of(
        self,
        count: int,
        starts: int,
        rng: np.random.Generator,
        criterion: Criterion = "tip",
        barred: Rows | None = None,
    ) -> Index:
        """`count` measurements, the best of some exchanges; none of those that are barred (N,)."""
        there = np.arange(len(self.rows)) if barred is None else np.flatnonzero(~barred)
        begins = [rng.choice(there, count, replace=False) for _ in range(starts)]
        found = (self.exchange(start, criterion=criterion, barred=barred) for start in begins)
        return min(found, key=lambda each: each[1])[0]

    def curve(self, best: Index, rng: np.random.Generator, criterion: Criterion = "tip") -> dict[int, float]:
        """Error by number of measurements: half and a quarter as many, these, and half as many again."""
        found = {len(best): self.error(best)}
        for count in sorted({max(round(len(best) * part), 3) for part in (0.25, 0.5, 0.75, 1.5)} - {len(best)}):
            if count <= len(self.rows):
                found[count] = self.error(self.best_of(count, 1, rng, criterion))
        return dict(sorted(found.items()))

    def lost(self, best: Index, part: float, draws: int, rng: np.random.Generator) -> float:
        """Error, RMS over some draws, when a part of the measurements is lost at random."""
        left = max(len(best) - max(round(part * len(best)), 1), 1)
        errors = [self.error(rng.choice(best, left, replace=False)) for _ in range(draws)]
        return float(np.sqrt(np.mean(np.square(errors))))


@dataclass(frozen=True)
class _Without:
    """A plan less any one of its measurements, by the Sherman-Morrison-Woodbury formula in place of an inverse each.

    Without a (m, n) the covariance is C + C a' K a C, K = (1 - a C a')^-1; so every product of it with rows f (N, m, n)
    is one with C, made once for the plan, and another of f C a' and f C M C a'.
    """

    choice: Choice
    plan: Index
    covariance: Array
    flat: Array
    weighed: Array
    spread: Array
    saved: Array

    @staticmethod
    def of(choice: Choice, plan: Index) -> _Without:
        """From information that is inverted once."""
        covariance = np.asarray(np.linalg.inv(choice._information(plan)), dtype=np.float64)
        size, unknowns = choice.rows.shape[1:]
        flat = choice.rows.reshape(-1, unknowns)
        weighed = covariance @ choice.weight @ covariance
        if size == 1:
            products = (np.einsum("kn,kn->k", flat @ each, flat) for each in (covariance, weighed))
            spread, saved = (each[:, None, None] for each in products)
        else:
            spread, saved = (choice.rows @ each @ choice.rows.transpose(0, 2, 1) for each in (covariance, weighed))
        return _Without(choice, plan.copy(), covariance, flat, weighed, spread, saved)

    def gains(self, one: int, criterion: Criterion) -> tuple[Array, float]:
        """Fall (N,) of trace(C M), or of ln det C, by each measurement added to the plan less `one`; its trace(C M)."""
        a, size = self.choice.rows[one], self.choice.rows.shape[1]
        left = np.eye(size) - a @ self.covariance @ a.T
        weight = self.choice.weight
        if np.linalg.eigvalsh(left)[0] < CANCELLED:  # it alone tells something: too little is left of the difference
            rest: Array = np.asarray(np.linalg.inv(self.choice._information(self.plan[self.plan != one])))
            return gains(self.choice.rows, rest, weight, criterion), float(np.sum(rest * weight))
        k, shape = np.linalg.inv(left), (-1, size, size)
        across = (self.flat @ (self.covariance @ a.T)).reshape(shape)
        weighed = (self.flat @ (self.weighed @ a.T)).reshape(shape)
        inner = k @ (a @ self.weighed @ a.T) @ k
        total = float(np.sum(self.covariance * weight) + np.trace(k @ (a @ self.weighed @ a.T)))
        if size == 1:
            spread = 1 + (self.spread + k * across**2)[:, 0, 0]
            saved = (self.saved + 2 * k * weighed * across + inner * across**2)[:, 0, 0]
            return (np.log(spread) if criterion == "parameters" else saved / spread), total
        turned = across.transpose(0, 2, 1)
        spread = np.eye(size) + self.spread + across @ k @ turned
        if criterion == "parameters":
            return np.asarray(np.linalg.slogdet(spread)[1]), total
        mixed = weighed @ k @ turned
        saved = self.saved + mixed + mixed.transpose(0, 2, 1) + across @ inner @ turned
        return np.asarray(np.trace(np.linalg.solve(spread, saved), axis1=1, axis2=2)), total


def seldom(problem: Problem, pool: Samples, chosen: Index) -> tuple[Rows, Rows]:
    """Measurements of a pool (N,) of faces that the chosen ones touch too seldom to say where they are.

    Such touches place the face at best, and tell nothing of the arm. Of all such faces, and of the one that is touched
    least but touched.
    """
    taken = np.zeros(len(pool), dtype=bool)
    taken[chosen] = True
    few, least = np.zeros(len(pool), dtype=bool), np.zeros(len(pool), dtype=bool)
    fewest = len(pool)
    for key in problem.instrument.datum:
        unknown = problem.instrument.unknowns[key]
        flat = int((~np.isfinite(unknown.prior_stds)).sum())
        for _, rows in instances(problem.instrument, key, unknown, pool):
            count = int(taken[rows].sum())
            if count * problem.models[0].components > flat:
                continue
            few[rows] = True
            if 0 < count < fewest:
                fewest, least[:] = count, False
                least[rows] = True
    return few, least


def row_slopes(bound: BoundProblem, x: Array) -> Array:
    """Whitened slopes (N, m, n) of each measurement at x (n,), in units of what filters start from."""
    return np.asarray((bound.jacobian(x) * bound.start_std).reshape(len(bound.measured), -1, bound.unknowns))


def wanted_field(bound: BoundProblem, x: Array, joints: Array) -> Array:
    """Moves (3 M, n) of the tip at joint values (M, q), apart from the pose of the base, in the same units."""
    frame = workspace_joints(bound.problem.robot)
    sets = [(bound.tip_jacobian(x, q), bound.tips(x, q)) for q in (joints, frame)]
    return np.asarray(up_to_base(*sets[0], *sets[1]) * bound.start_std)


def wanted_joints(bound: BoundProblem, box: Box | None, targets: Array | None) -> Array:
    """Joint values (M, n) at which the tip is wanted."""
    if box is not None:
        return joints_in_box(bound, bound.x0, box)
    if targets is None:
        return workspace_joints(bound.problem.robot)
    joints = np.atleast_2d(np.asarray(targets, dtype=np.float64))
    if joints.shape[1] != len(bound.problem.robot.axes) or not np.isfinite(joints).all():
        fix = f"Give finite joint values (M, {len(bound.problem.robot.axes)}) in rad and mm"
        raise CasacalError(f"Targets have the shape {np.shape(targets)}", fix)
    return joints
