"""Fresh rows bound to an arm as it was calibrated: what is known of it, and what these rows alone know."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import OTHERS, REPEATABILITY, BoundProblem
from casacal.binding.slots import make_slots
from casacal.calibration.shifts import JOINTS, joint_direction, shift_columns, with_shifts
from casacal.compensation.arm import CalibratedArm, all_motion, named_covariance, with_effects
from casacal.errors import CasacalError, ProblemError, SamplesError, UnknownNameError
from casacal.estimators import lm
from casacal.least_squares.conditioned import Conditioned
from casacal.least_squares.gaussian import Gaussian
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.uncertainty.fresh_rows import FreshRows, covariance_root
from casacal.unknowns import Unknown
from casacal.values import is_real
from casacal.wording import counted

ANYWHERE = {"rad": 0.1, "mm": 100.0}  # standard deviations of what may have moved as far as anything does
MOST = 30_000_000  # elements of a Jacobian that is held as a whole


@dataclass(frozen=True, eq=False)
class Fresh:
    """Rows of an instrument, and where the result says that everything stands.

    known: which unknowns (n,) the result knows; the others belong to these rows. at: the estimate (n,), zero of those
    that it does not. covariance: of the known ones (k, k). other: whether it is another instrument than that of the
    calibration.
    """

    bound: BoundProblem
    known: NDArray[np.bool_]
    at: Array
    covariance: Array
    other: bool = False

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Which of the known (k,) neither samples nor prior held: nothing is promised along these."""
        return ~np.isfinite(np.diagonal(self.covariance))

    @property
    def of_arm(self) -> NDArray[np.intp]:
        """Positions in x of what is known of the arm."""
        keys = self.bound.problem.robot.parameters
        of_arm = np.array([slot.key in keys for slot in self.bound.slots for _ in slot.columns], dtype=bool)
        return np.flatnonzero(of_arm & self.known)

    @property
    def own_names(self) -> tuple[str, ...]:
        """Unknowns that these rows alone know."""
        return tuple(name for name, known in zip(self.bound.names, self.known, strict=True) if not known)

    @cached_property
    def x(self) -> Array:
        """All unknowns (n,): the arm as calibrated, what the rows alone know fitted to them."""
        return self.fitted(self.at)

    def fitted(self, at: Array) -> Array:
        """All unknowns (n,) with the known ones held at `at` and the others fitted to these rows."""
        part = Conditioned(self.bound, ~self.known, at)
        return np.asarray(part.expand(lm(part).x))

    @cached_property
    def jacobian(self) -> Array:
        """Whitened (m, n) at x."""
        return self.bound.jacobian(self.x)

    @cached_property
    def linear(self) -> FreshRows:
        """All residuals, linear about x, and after them a row for each prior of what these rows alone know.

        A guess beforehand counts like a reading.
        """
        bound, lost = self.bound, self.lost
        firm, held = guesses(bound, self.known)
        slopes = np.vstack([self.jacobian, held])
        off = (self.x[firm] - bound.x0[firm]) / bound.prior_std[firm]
        free = ~self.known
        free[np.flatnonzero(self.known)[lost]] = True
        spread = slopes[:, ~free] @ covariance_root(self.covariance[np.ix_(~lost, ~lost)])
        return FreshRows(np.concatenate([bound.residual(self.x), off]), spread, slopes[:, free])

    def loosened(self, stds: Mapping[str, float | None]) -> Fresh:
        """A copy whose calibrated unknowns have a larger covariance, C' = C + E S^2 E'.

        stds: standard deviations (mm, rad) by the name of an unknown ("theta4"), the key of several ("theta"), a face
        ("floor"), or a joint ("joint4"), whose zero may then be elsewhere; None for anywhere. Raises UnknownNameError
        for what these rows take from no calibration, CasacalError for what is no size, or a joint that no unknown of
        the arm follows.
        """
        bound, places = self.bound, dict[str, list[int]]()
        position = np.cumsum(self.known) - 1
        for slot in bound.slots:
            for j, name in zip(slot.columns, slot.unknown.names(slot.name), strict=True):
                if self.known[j] and not slot.beside:
                    for word in filter(None, dict.fromkeys((name, slot.name, slot.key, slot.label))):
                        places.setdefault(word, []).append(int(position[j]))
        joints = {f"joint{i}": axis for i, axis in enumerate(bound.problem.robot.axes, 1)}
        covariance, units = self.covariance.copy(), np.array(bound.units)[self.known]
        for name, std in stds.items():
            if std is not None and not (is_real(std) and 0 <= std < math.inf):
                raise CasacalError(f"The drift of '{name}' is {std!r}", "Give a number of mm or rad, zero or more")
            if name in places:
                sizes = [ANYWHERE.get(units[k], 1.0) if std is None else float(std) for k in places[name]]
                covariance[places[name], places[name]] += np.square(sizes)
            elif name in joints:
                size = ANYWHERE["rad" if joints[name].turns else "mm"] if std is None else float(std)
                along = size * self._of_joint(list(joints).index(name))[self.known]
                covariance += np.outer(along, along)
            elif name in {**bound.problem.robot.parameters, **bound.problem.instrument.unknowns}:
                what = f"'{name}' may have changed, but this problem holds it, or nothing says that it stood"
                fix = f"Free it (--free {name}) and calibrate anew; or name with --standing what has not been moved"
                raise CasacalError(what, fix)
            else:
                raise UnknownNameError("unknown of the calibration", name, {**places, **dict.fromkeys(joints)})
        return replace(self, covariance=covariance) if stds else self

    def _of_joint(self, i: int) -> Array:
        """Direction (n,) in the arm's unknowns that a shift of a joint's zero is."""
        shifted = with_shifts(self.bound)
        arm = np.isin(np.arange(shifted.unknowns), self.of_arm)
        x = np.append(self.at, np.zeros(shifted.unknowns - self.at.size))
        x[np.array(shifted.beside, dtype=bool)] = 0.0  # gears that err are no part of an offset
        found = joint_direction(shifted, x, int(shift_columns(shifted, JOINTS)[i]), arm)
        if found is None:
            what = f"no free unknown of the arm is what joint {i + 1} may have slipped by"
            fix = "Calibrate with its parameters free (without --fix), from old and new rows"
            raise CasacalError(what, fix)
        return found[: self.at.size]

    @property
    def gaussian(self) -> Gaussian:
        """Joint distribution of the calibrated unknowns: the prior of these rows."""
        names = tuple(name for name, known in zip(self.bound.names, self.known, strict=True) if known)
        return Gaussian(names, self.at[self.known], self.covariance)

    def some(self, rows: NDArray[np.intp]) -> FreshRows:
        """The linear model of some residuals (rows), with every prior row."""
        return self.linear.take(np.concatenate([rows, np.arange(self.bound.rows, len(self.linear.residual))]))


ANEW = ("growth",)  # keys of effects that move the tip and differ from session to session


def with_memory(fresh: Fresh, arm: CalibratedArm) -> Fresh:
    """A copy that takes geometry and effects of the arm, with their joint covariance, from the earlier result.

    Itself where a result says nothing of effects.
    """
    found = with_effects(arm)
    if found is None:
        return fresh
    whole, off = found
    places, bound, columns = {name: i for i, name in enumerate(off)}, fresh.bound, np.flatnonzero(fresh.known)
    stays = [k for k, j in enumerate(columns) if bound.names[j] in places and bound.beside[j] not in ANEW]
    index = [places[bound.names[columns[k]]] for k in stays]
    covariance, at = fresh.covariance.copy(), fresh.at.copy()
    covariance[np.ix_(stays, stays)] = whole[np.ix_(index, index)]
    for k in stays:
        at[columns[k]] += off[bound.names[columns[k]]]
    return replace(fresh, at=at, covariance=covariance)


def guesses(bound: BoundProblem, known: NDArray[np.bool_]) -> tuple[NDArray[np.intp], Array]:
    """Unknowns (g,) that rows alone know and that have a prior, and the whitened rows (g, n) that these priors are."""
    firm = np.flatnonzero(~known & np.isfinite(bound.prior_std))
    held = np.zeros((firm.size, bound.unknowns))
    held[np.arange(firm.size), firm] = 1.0 / bound.prior_std[firm]
    return firm, held


def fresh_rows(
    result: CalibratedArm, problem: Problem, samples: Samples, *, other: bool, standing: Collection[str]
) -> Fresh:
    """Bind fresh rows to a result.

    problem: its arm, and the instrument of the rows. other: whether that is another one than that of the calibration.
    standing: labels of faces, or keys of unknowns, that stand where the calibration found them. Raises CasacalError for
    what cannot be standing, SamplesError for too few rows or too many.
    """
    kept = _kept(result, problem, samples, standing)
    bound = _bound(result, problem, samples, kept, other=other)
    covariance, names = all_motion(result) if result.corrected else named_covariance(result)
    values, corrected = {**result.found.values(alone=False), **result.found.unknowns}, result.found.of_effects
    places = {name: j for j, name in enumerate(names)}
    known, at = np.zeros(bound.unknowns, dtype=bool), np.zeros(bound.unknowns)
    for slot in bound.slots:
        if slot.beside:
            known[slot.columns] = True
            at[slot.columns] = [corrected.get(bound.names[j], 0.0) for j in slot.columns]
            continue
        of_arm = slot.key in problem.robot.parameters
        remains = not (other or slot.datum) and slot.unknown.nominal is not None  # as a tool does, unlike a face
        if not (of_arm or slot.name in kept or remains):
            continue
        for j, name in zip(slot.columns, slot.unknown.names(slot.name), strict=True):
            if name in places and name in values:
                known[j], at[j] = True, values[name]
            elif of_arm or slot.name in kept:
                fix = "Calibrate again with this version" if of_arm else "Leave it out of --standing"
                raise CasacalError(f"{result.file}: it does not say how well '{name}' is known", fix)
    own = int((~known).sum())
    if bound.rows <= own:
        what = f"{counted(len(samples), 'row')} for {own} unknowns that these rows alone know"
        fix = "Take more rows, or name with --standing what has not moved since the calibration"
        raise SamplesError(samples.file, what, fix)
    # geometry and corrections are known as the result says, other effects by their sizes
    found, columns = np.diag(bound.prior_std[known] ** 2), np.flatnonzero(known)
    said = np.flatnonzero([not bound.beside[j] or bound.names[j] in corrected for j in columns])
    index = [places[bound.names[j]] for j in columns[said]]
    found[np.ix_(said, said)] = covariance[np.ix_(index, index)]
    return Fresh(bound, known, at, found, other)


def _bound(
    result: CalibratedArm, problem: Problem, samples: Samples, kept: Mapping[str, Array], *, other: bool
) -> BoundProblem:
    """Rows with what errs beside the geometry, and with noise as the calibration used it."""
    _check_columns(problem, samples)
    slots = make_slots(problem, [samples], kept)
    for slot in slots:  # what the drawn arm proposes from fresh rows is neither known nor estimated
        if slot.unknown.nominal is None and not slot.unknown.size and slot.name not in kept:
            fix = "Calibrate without --fix, or name it with --standing if it has not moved"
            raise CasacalError(f"'{slot.name}' was held in the calibration, and its position now is not known", fix)
    bound = BoundProblem(problem, slots, (samples,))
    if effects := result.found.effects.effects:  # what errs beside the geometry errs here, too, and anew
        times = {each.key: each.times for each in effects}
        bound = bound.under(result.with_its_kit(problem)).with_sizes(times)
    factors = _noise_used(result, bound, other=other)
    bound = bound.with_noise(factors) if factors else bound
    if bound.rows * bound.unknowns > MOST:
        most = MOST // bound.unknowns
        raise SamplesError(samples.file, f"{len(samples):,} rows are too many at once", f"Give up to {most:,} of them")
    return bound


def _check_columns(problem: Problem, samples: Samples) -> None:
    """Raise ProblemError where rows lack columns that tell an effect.

    How large its error is without them is known, but not how rows share it: torques follow the posture, a payload is
    the same for many rows. Neither chi-square nor the error along the arm's own directions has a distribution then.
    """
    for effect in problem.terms:
        for name in effect.further:
            if name not in samples.extra:
                what = f"{samples.file} has no column '{name}', which says what {effect.words} did to each row"
                fix = f"Add it; further columns there are: {', '.join(samples.extra) or 'none'}"
                raise ProblemError(what, fix)


def _kept(result: CalibratedArm, problem: Problem, samples: Samples, standing: Collection[str]) -> dict[str, Array]:
    """Nominal values of what stands where it was calibrated, by name of its slot."""
    instrument, proposed, kept = problem.instrument, result.found.proposed, {}
    there: dict[str, list[str]] = {}
    unknowns: dict[str, Unknown] = {}
    for key, unknown in instrument.unknowns.items():
        labels = [] if unknown.per is None else samples.labels[unknown.per].names
        for label in dict.fromkeys(instrument.instance(key, label) for label in labels):
            name = f"{key}.{label}"
            unknowns[name] = unknown
            for word in (key, label, name):
                there.setdefault(word, []).append(name)
        if unknown.per is None and (unknown.size or unknown.nominal is None):
            unknowns[key] = unknown
            there.setdefault(key, []).append(key)
    for word in standing:
        if word not in there:
            raise UnknownNameError("face or unknown of these rows", word, there)
        for name in there[word]:
            nominal = unknowns[name].nominal
            if nominal is None and len(proposed.get(name, ())) != unknowns[name].nominal_size:
                fix = "Leave it out of --standing, or calibrate again"
                raise CasacalError(f"{result.file}: it does not give the position of '{word}'", fix)
            kept[name] = np.array(proposed[name]) if nominal is None else nominal
    return kept


def _noise_used(result: CalibratedArm, bound: BoundProblem, *, other: bool) -> dict[str, float]:
    """Factor of each face's noise over what was stated, as the calibration used it; "" stands for other faces.

    New faces get the mean square of the calibrated ones. Another instrument keeps its own noise, and what every face
    showed beside the calibration's instrument is added: joints that do not repeat err whoever watches, while a face
    that is not flat errs alone.
    """
    noise = result.found.noise
    if not noise.by_face:
        return {}
    pairs = {name: (face.stated_mm, face.without_joints_mm) for name, face in noise.by_face.items()}
    joints = {REPEATABILITY: noise.joints_rad} if noise.joints_rad > 0 else {}
    if other:
        excess = min(used**2 - stated**2 for stated, used in pairs.values())
        stated = float(np.median(bound.block.noise))
        return {OTHERS: math.sqrt(1 + max(excess, 0.0) / stated**2), **joints}
    factors = {name: used / stated for name, (stated, used) in pairs.items()}
    return {OTHERS: math.sqrt(float(np.mean([factor**2 for factor in factors.values()]))), **factors, **joints}
