"""Constants that instruments take for exact, such as a dial's gain: unknowns with the prior of their class."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from casacal.effects.effect import Effect, is_plainly, weighted
from casacal.fit.bound_problem import BoundProblem
from casacal.fit.least_squares import Result
from casacal.model.instrument import Trusted
from casacal.model.kinematics import Expression
from casacal.model.problem import Problem
from casacal.model.term import Here, Site
from casacal.model.unknown import Parameter
from casacal.uncertainty.tip_error import tip_rms, without_rigid, workspace_joints
from casacal.values import Array
from casacal.wording import sized

COVERED = 3.0  # standard deviations of a constant up to which its prior is what covers an error of it


@dataclass(frozen=True, kw_only=True)
class TrustedConstants(Effect):
    """What `Instrument.trusted` names, each as wrong as its class allows: r(x, c) with c ~ N(c0, std^2).

    An error of such a constant leaves next to nothing in the residuals, because the arm's lengths imitate it: nothing
    in the rows would widen an interval that takes it for exact. Its prior does.

    Args:
        size: times the standard deviations that the instrument states.

    """

    size: float = 1.0
    doubt: float = 1.0

    moves = False
    lasting = True
    key = "trusted"
    words = "constants of the instrument"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Errors in standard deviations, by the name of each constant; a direction has two."""
        labels = list[str]()
        for name, each in site.instrument.trusted.items():
            labels += [f"_{name}{i}" for i in range(1, each.count + 1)] if each.count > 1 else [f"_{name}"] * each.count
        zeros = [0.0] * len(labels)
        return {self.key: Parameter(zeros, unit="1", prior_std=self.size, labels=labels)} if labels else {}

    def reading(self, here: Here) -> Mapping[str, Expression]:
        """Corrections of columns that err in proportion."""
        found: dict[str, Expression] = {}
        for constant, u in self._errors(here):
            for column in constant.scales:
                found[column] = found.get(column, 0.0) + getattr(here.row, column) * u * constant.std / 100
        return found

    def residual(self, here: Here) -> Expression | None:
        """Change of the residual where held unknowns stand elsewhere."""
        shifted: dict[str, Expression] = {}
        for constant, u in self._errors(here):
            if constant.shifts:
                shifted[constant.shifts] = shifted.get(constant.shifts, 0.0) + u * constant.std
        if not shifted:
            return None
        p = SimpleNamespace(**vars(here.p))
        for key, by in shifted.items():
            unknown = here.instrument.unknowns[key]
            freed, nominal = unknown.freed(), ca.DM(np.asarray(unknown.nominal))
            moved = freed.at(nominal, by) - freed.at(nominal, ca.DM.zeros(freed.size))
            setattr(p, key, getattr(p, key) + moved)
        moved_residual, residual = (here.instrument.residual(here.pose, values, here.row) for values in (p, here.p))
        return moved_residual - residual

    def _errors(self, here: Here) -> list[tuple[Trusted, Expression]]:
        """Each constant with its errors, in standard deviations."""
        u, first, found = getattr(here.p, self.key), 0, []
        for constant in here.instrument.trusted.values():
            found.append((constant, u[first : first + constant.count]))
            first += constant.count
        return found


CONSTANTS = TrustedConstants()  # one value, so that what was compiled with it is known again


def with_constants(problem: Problem) -> Problem:
    """A problem in which the trusted constants are unknowns, beside its own terms."""
    if CONSTANTS in problem.terms or not any(instrument.trusted for instrument in problem.instruments):
        return problem
    return problem.with_terms(*problem.terms, CONSTANTS)


@dataclass(frozen=True, kw_only=True)
class FocalLength(Effect):
    """A camera's focal length: poses err in proportion along its axis, the z axis of the body.

    What lies across comes of the board's size and is right. Poses of what is no camera show none of it.

    Args:
        size: part of the distance between camera and board.

    """

    size: float = 5e-4
    doubt: float = 4.0

    moves = False
    most = 20.0
    key = "focal"
    words = "error of the focal length"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """One part, for poses that are read."""
        poses = is_plainly(site.instrument, "tracked_pose.TrackedPose")
        return {self.key: weighted(np.ones(1), self.size, "1")} if poses else {}

    def reading(self, here: Here) -> Mapping[str, Expression]:
        """Corrections of the position along the body's z axis."""
        camera: Any = here.instrument
        place, axis = ca.vertcat(here.row.x, here.row.y, here.row.z), camera.turn(here.row)[:, 2]
        along = getattr(here.p, self.key) * ca.dot(axis, place) * axis
        return dict(zip("xyz", ca.vertsplit(along), strict=True))


def _constants(bound: BoundProblem) -> Iterator[tuple[str, Trusted, list[int]]]:
    """Full name of each trusted constant, itself, and the places of its errors in x."""
    columns = (j for j, key in enumerate(bound.beside) if key == TrustedConstants.key)
    for i, instrument in enumerate(bound.problem.instruments):
        for name, constant in instrument.trusted.items():
            yield bound.problem.prefix(i) + name, constant, [next(columns) for _ in range(constant.count)]


def beyond(bound: BoundProblem, x: Array) -> list[tuple[Trusted, float]]:
    """Constants that stand farther off what is stated, at x (n,), than their prior covers, and how far, in their unit.

    That is a mistake. Nothing where constants are taken for exact.
    """
    found = _constants(bound) if TrustedConstants.key in bound.beside else ()
    return [
        (constant, float(np.linalg.norm(x[own]) * constant.std))
        for _, constant, own in found
        if (np.abs(x[own]) > COVERED * bound.prior_std[own]).any()
    ]


@dataclass(frozen=True)
class Leverage:
    """What a constant that an instrument takes for exact is worth at the tip.

    std: of its error, as taken, in `unit`. tip_mm: by how much the estimate of the tip moves, mm RMS over the workspace
    apart from the pose of the base, where the constant errs by that and everybody takes it for exact. left_mm: the
    part of the expected tip error that comes from it, as far as the rows themselves have narrowed it down.
    """

    name: str
    words: str
    std: float
    unit: str
    tip_mm: float
    left_mm: float
    cure: str

    @property
    def within(self) -> str:
        """The constant and how far it is relied on, such as "the dial's gain within 0.15 %"."""
        return f"{self.words} within {sized(self.std, self.unit)}"


def leverages(fit: BoundProblem, result: Result) -> tuple[Leverage, ...]:
    """Leverage of every trusted constant, the largest first, by the tip's regression on it given the others."""
    constants = [j for j, key in enumerate(fit.beside) if key == TrustedConstants.key]
    if not constants:
        return ()
    joints = workspace_joints(fit.problem.robot)
    field = without_rigid(fit.tip_jacobian(result.x, joints), fit.tips(result.x, joints))
    covariance = np.where(np.isfinite(result.covariance), result.covariance, 0.0)
    moved = {}
    for j in constants:
        rest = [k for k in constants if k != j]
        known = np.linalg.solve(covariance[np.ix_(rest, rest)], covariance[np.ix_(rest, [j])])
        slope = covariance[:, j] - (covariance[:, rest] @ known)[:, 0]
        each = tip_rms(field @ slope) / slope[j]
        moved[j] = each * np.array([fit.prior_std[j], math.sqrt(covariance[j, j])])
    found = []
    for name, constant, own in _constants(fit):
        whole, left = np.linalg.norm([moved[j] for j in own], axis=0)
        figures = float(whole), float(left)
        found.append(Leverage(name, constant.words, constant.std, constant.unit, *figures, constant.cure))
    return tuple(sorted(found, key=lambda each: -each.left_mm))
