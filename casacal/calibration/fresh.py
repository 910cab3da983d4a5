"""Fresh rows bound to the calibrated arm that they are judged by; joints, tool and base that may have shifted since."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from casacal.calibration.as_arm import AsArm
from casacal.calibration.inputs import problem_from, samples_of
from casacal.calibration.saved import arm_from
from casacal.data.repeats import copies, fitted_among, in_fitted_postures
from casacal.data.samples import Samples
from casacal.data.text import typed_rows
from casacal.deployment.arm import (
    NOTHING,
    CalibratedArm,
    TellingColumns,
    all_motion,
    for_instrument,
    named_covariance,
    with_effects,
)
from casacal.errors import CasacalError, ProblemError, SamplesError, UnknownNameError, came
from casacal.files import jsonable
from casacal.fit.bound_problem import OTHERS, REPEATABILITY, SHARED, BoundProblem
from casacal.fit.least_squares import Conditioned, Gaussian
from casacal.fit.lm import lm
from casacal.fit.slots import make_slots
from casacal.model.kinematics import Expression, Product, rotate_x, rotate_y, rotate_z, translate
from casacal.model.problem import Problem
from casacal.model.problem_file import ProblemFile
from casacal.model.robot import Robot, random_joints
from casacal.model.term import Here, Site, Term
from casacal.model.unknown import Parameter, Unknown
from casacal.uncertainty.fresh_rows import FreshRows, covariance_root
from casacal.uncertainty.tip_error import workspace_joints
from casacal.values import Array, Index, Rows, is_real
from casacal.wording import counted, listed

JOINTS, TOOL, TURN, BASE, BASE_TURN = "shift_q", "shift_tool", "shift_turn", "shift_base", "shift_base_turn"
"""Keys of the unknowns: joints as the controller counts them, tool and base in mm along and rad about their axes."""

WIDE = 10.0  # standard deviation that stands for nothing known; these unknowns are given priors by whoever uses them
SAME = 1e-6  # part of the motion of tip and flange by a joint that the arm's unknowns may fail to follow
POSES = 60  # postures at which these motions are compared
ANYWHERE = {"rad": 0.1, "mm": 100.0}  # standard deviations of what may have moved as far as anything does
MOST = 30_000_000  # elements of a Jacobian that is held as a whole
ANEW = ("growth",)  # keys of effects that move the tip and differ from session to session
ALIKE = 1e-6  # difference (mm; of a rotation's elements) of two poses below which arms are one
COMPARED = 8  # random joint values at which they are compared
SPENT = 0.5  # part of the rows that are those of the calibration, from which on they verify nothing


@dataclass(frozen=True)
class Shifts(Term):
    """Shifts of encoder zeros, tool and base since the calibration."""

    size: float = WIDE

    moves = True
    key = "shift"
    words = "a change since the calibration"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Coordinates of a shift: one per joint, and three translations and three rotations of tool and base."""
        units = {JOINTS: "rad", TOOL: "mm", TURN: "rad", BASE: "mm", BASE_TURN: "rad"}
        counts = {JOINTS: len(site.robot.axes)}
        return {k: Parameter([0.0] * counts.get(k, 3), unit=unit, prior_std=self.size) for k, unit in units.items()}

    def joints(self, here: Here) -> Expression:
        """Shifts of the encoder zeros."""
        return ca.SX(getattr(here.p, JOINTS))

    def pose(self, here: Here) -> Expression:
        """The flange as base and tool carry it: base pose tool."""
        matrix = here.pose.matrix if isinstance(here.pose, Product) else ca.SX(here.pose)
        base = _rigid(getattr(here.p, BASE), getattr(here.p, BASE_TURN))
        return ca.mtimes([base, matrix, _rigid(getattr(here.p, TOOL), getattr(here.p, TURN))])


def with_shifts(bound: BoundProblem) -> BoundProblem:
    """The rows with the shifts as further unknowns after all others; priors of terms are lost."""
    return bound.under(bound.problem.with_terms(*bound.problem.terms, Shifts()))


def shift_columns(shifted: BoundProblem, key: str) -> Index:
    """Positions in x of a key's unknowns."""
    slot = next(slot for slot in shifted.slots if slot.key == key and slot.term == Shifts.key)
    return np.array(slot.columns, dtype=np.intp)


def _rigid(place: Expression, turn: Expression) -> Expression:
    factors = (translate(place[0], place[1], place[2]), rotate_x(turn[0]), rotate_y(turn[1]), rotate_z(turn[2]))
    return ca.mtimes([each.matrix if isinstance(each, Product) else ca.SX(each) for each in factors])


def joint_direction(shifted: BoundProblem, x: Array, column: int, arm: Rows) -> Array | None:
    """Direction (n,) in the arm's unknowns that does what one unit of a joint's shift does; None where there is none.

    One number of the arm where one does it, as an offset of a DH table; else the least of several, in their priors.
    shifted: rows bound with shifts. x (n,): where everything stands; column: the joint's shift in it. arm: which
    unknowns (n,) are the arm's.
    """
    joints = workspace_joints(shifted.problem.robot, poses=POSES)
    block, columns = shifted.blocks[0], shifted.blocks[0].columns[0]
    field = np.zeros((6 * len(joints), shifted.unknowns))
    motions = (block.posture(what, x, joints)[1] for what in ("tip_jacobian", "flange_jacobian"))
    field[:, columns] = np.vstack([motion.reshape(3 * len(joints), -1) for motion in motions])
    wanted, own = field[:, column], np.flatnonzero(arm)
    if not (size := float(np.linalg.norm(wanted))):
        return None
    squares = (field[:, own] ** 2).sum(axis=0)
    times = np.divide(field[:, own].T @ wanted, squares, out=np.zeros(own.size), where=squares > 0)
    misses = np.linalg.norm(wanted[:, None] - field[:, own] * times, axis=0)
    found, best = np.zeros(shifted.unknowns), int(misses.argmin())
    if misses[best] <= SAME * size:
        found[own[best]] = times[best]
        return found
    scale = shifted.start_std[own]
    moves = np.linalg.lstsq(field[:, own] * scale, wanted, rcond=1e-10)[0] * scale
    if np.linalg.norm(wanted - field[:, own] @ moves) > SAME * size:
        return None
    found[own] = moves
    return found


@dataclass(frozen=True, eq=False)
class Fresh:
    """Rows of an instrument, bound to the unknowns of a result.

    known: which unknowns (n,) the result knows; the others belong to these rows. at: the estimate (n,), zero of those
    that it does not. covariance: of the known ones (k, k). other: whether it is another instrument than that of the
    calibration.
    """

    bound: BoundProblem
    known: Rows
    at: Array
    covariance: Array
    other: bool = False

    @property
    def lost(self) -> Rows:
        """Which of the known (k,) neither samples nor prior held: nothing is promised along these."""
        return ~np.isfinite(np.diagonal(self.covariance))

    @property
    def of_arm(self) -> Index:
        """Positions in x of what is known of the arm."""
        keys = self.bound.problem.robot.parameters
        of_arm = np.array([slot.key in keys for slot in self.bound.slots for _ in slot.columns], dtype=bool)
        return np.flatnonzero(of_arm & self.known)

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
        """Whitened Jacobian (m, n) at x."""
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
                if self.known[j] and not slot.term:
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
                fix = f"Leave it out of --loosen and free it (--free {name}), or name with --standing what did not move"
                raise CasacalError(what, fix)
            else:
                raise UnknownNameError("unknown of the calibration", name, {**places, **dict.fromkeys(joints)})
        return replace(self, covariance=covariance) if stds else self

    def _of_joint(self, i: int) -> Array:
        """Direction (n,) in the arm's unknowns that is equivalent to a shift of a joint's encoder zero."""
        shifted = with_shifts(self.bound)
        x = np.append(self.at, np.zeros(shifted.unknowns - self.at.size))
        x[np.array(shifted.beside, dtype=bool)] = 0.0  # gears that err are no part of an offset
        arm, column = np.isin(np.arange(x.size), self.of_arm), int(shift_columns(shifted, JOINTS)[i])
        if (found := joint_direction(shifted, x, column, arm)) is None:
            what = f"no free unknown of the arm is what joint {i + 1} may have slipped by"
            raise CasacalError(what, "Calibrate with its parameters free (without --fix), from old and new rows")
        return found[: self.at.size]

    @property
    def gaussian(self) -> Gaussian:
        """Joint distribution of the calibrated unknowns: the prior of these rows."""
        names = tuple(name for name, known in zip(self.bound.names, self.known, strict=True) if known)
        return Gaussian(names, self.at[self.known], self.covariance)

    def some(self, rows: Index) -> FreshRows:
        """The linear model of some residuals (rows), with every prior row."""
        return self.linear.take(np.concatenate([rows, np.arange(self.bound.rows, len(self.linear.residual))]))


def with_memory(fresh: Fresh, arm: CalibratedArm) -> Fresh:
    """A copy that takes geometry and effects of the arm, with their joint covariance, from the earlier result.

    Itself where a result says nothing of effects.
    """
    if (found := with_effects(arm)) is None:
        return fresh
    whole, off = found
    places, bound, columns = {name: i for i, name in enumerate(off)}, fresh.bound, np.flatnonzero(fresh.known)
    own = {term.key for term in bound.problem.terms if term.lasting and fresh.other}  # of the other instrument
    anew = {*ANEW, *own}
    stays = [k for k, j in enumerate(columns) if bound.names[j] in places and bound.beside[j] not in anew]
    index = [places[bound.names[columns[k]]] for k in stays]
    covariance, at = fresh.covariance.copy(), fresh.at.copy()
    covariance[np.ix_(stays, stays)] = whole[np.ix_(index, index)]
    estimate = arm.found.effects.estimate
    for k, i in zip(stays, index, strict=True):
        j = columns[k]
        at[j] = at[j] + off[bound.names[j]] if estimate is None else estimate[i]  # the former in older files
    return replace(fresh, at=at, covariance=covariance)


def guesses(bound: BoundProblem, known: Rows) -> tuple[Index, Array]:
    """Unknowns (g,) that rows alone know and that have a prior, and the whitened rows (g, n) that these priors are."""
    firm = np.flatnonzero(~known & np.isfinite(bound.prior_std))
    held = np.zeros((firm.size, bound.unknowns))
    held[np.arange(firm.size), firm] = 1.0 / bound.prior_std[firm]
    return firm, held


def fresh_rows(
    result: CalibratedArm,
    problem: Problem,
    samples: Samples,
    *,
    other: bool,
    standing: Collection[str],
    backend: str | None = None,
    threads: int | None = None,
) -> Fresh:
    """Bind fresh rows to a result.

    problem: its arm, and the rows' instrument. other: whether that is not the calibration's. standing: labels of faces,
    or keys, of what stands where it was. backend, threads: as for `bind`. CasacalError for what cannot stand,
    SamplesError for too few or many rows.
    """
    kept = _kept(result, problem, samples, standing)
    bound = _bound(result, problem, samples, kept, other=other, backend=backend, threads=threads)
    covariance, names = all_motion(result) if result.corrected else named_covariance(result)
    values, corrected = {**result.found.values(alone=False), **result.found.unknowns}, result.found.of_effects
    places = {name: j for j, name in enumerate(names)}
    known, at = np.zeros(bound.unknowns, dtype=bool), np.zeros(bound.unknowns)
    for slot in bound.slots:
        if slot.term:
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
    result: CalibratedArm,
    problem: Problem,
    samples: Samples,
    kept: Mapping[str, Array],
    *,
    other: bool,
    backend: str | None,
    threads: int | None,
) -> BoundProblem:
    """Bind rows with the calibration's effects and noise; ProblemError where rows lack columns that tell an effect."""
    for effect in problem.terms:
        for name in effect.further:
            if name not in samples.extra:
                what = f"{samples.file} has no column '{name}', which says what {effect.words} did to each row"
                fix = f"Add it; further columns there are: {', '.join(samples.extra) or 'none'}"
                raise ProblemError(what, fix)
    slots = make_slots(problem, [samples], kept)
    for slot in slots:  # what the drawn arm proposes from fresh rows is neither known nor estimated
        if slot.unknown.nominal is None and not slot.unknown.size and slot.name not in kept:
            fix = "Calibrate without --fix, or name it with --standing if it has not moved"
            raise CasacalError(f"'{slot.name}' was held in the calibration, and its position now is not known", fix)
    bound = BoundProblem(problem, slots, (samples,), backend, threads)
    if effects := result.found.effects.effects:  # what errs beside the geometry errs here, too, and anew
        times = {each.key: each.times for each in effects}
        bound = bound.under(result.with_its_kit(problem)).with_sizes(times)
    factors = _noise_used(result, bound, other=other)
    bound = bound.with_noise(factors) if factors else bound
    if bound.rows * bound.unknowns > MOST:
        most = MOST // bound.unknowns
        raise SamplesError(samples.file, f"{len(samples):,} rows are too many at once", f"Give up to {most:,} of them")
    return bound


def _kept(result: CalibratedArm, problem: Problem, samples: Samples, standing: Collection[str]) -> dict[str, Array]:
    """Nominal values, by slot name, of the unknowns that have not moved since the calibration."""
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

    New faces get the mean square of the calibrated ones. Another instrument keeps its own noise, and where both read
    lengths, what every face showed beside the calibration's instrument is added: joints that do not repeat err whoever
    watches, while a face that is not flat errs alone.
    """
    noise = result.found.noise
    if not noise.by_face:
        return {}
    pairs = {name: (face.stated_mm, face.without_joints_mm) for name, face in noise.by_face.items()}
    joints = {f"{REPEATABILITY}{noise.loose_joint or ''}": noise.joints_rad} if noise.joints_rad > 0 else {}
    if other:
        read = {*result.source.problem.instrument.columns.values(), *bound.problem.instrument.columns.values()}
        excess = min(used**2 - stated**2 for stated, used in pairs.values()) if read <= {"length"} else 0.0
        stated = float(np.median(bound.block.noise))
        return {OTHERS: math.sqrt(1 + max(excess, 0.0) / stated**2), **joints}
    factors = {name: used / stated for name, (stated, used) in pairs.items()}
    if not joints and all(factor == 1 for factor in factors.values()):
        return {}
    shared = {SHARED: noise.shared} if noise.shared > 0 else {}
    of_new_faces = {OTHERS: math.sqrt(float(np.mean([factor**2 for factor in factors.values()])))}
    return {**of_new_faces, **factors, **joints, **shared}


@dataclass(frozen=True)
class Judged:
    """Fresh rows and the calibration that they are held against.

    robot, result, verdict: which calibration, and what it said of itself (level and words; empty for a truth).
    samples, sha256, rows: which rows, and how many. own: unknowns that these rows alone know, fitted to them.
    standing: what was said to stand where it was calibrated. copied_lines, fitted_lines: rows that were left out:
    copies of others among them, and those that the arm was calibrated from. remarks: sentences on rows in
    postures that were fitted, and on columns that tell effects and are far from what they were in the fitted rows.
    """

    robot: str
    result: str
    verdict: tuple[str, str]
    samples: str
    sha256: str
    rows: int
    own: tuple[str, ...]
    standing: tuple[str, ...]
    copied_lines: tuple[int, ...]
    fitted_lines: tuple[int, ...]
    remarks: tuple[str, ...]

    @property
    def typed(self) -> str:
        """The rows as arguments of a command."""
        return typed_rows(self.samples)

    @property
    def said(self) -> str:
        """The rows in a sentence."""
        return f"{counted(self.rows, 'fresh row')} of {self.samples}"

    @property
    def own_verdict(self) -> list[str]:
        """The result's own verdict as a sentence, where it is not simply calibrated; otherwise empty."""
        level, words = self.verdict
        return [] if level in ("", "calibrated") else [f"The result's own verdict: {words}"]

    def left_out(self, copied: str, fitted: str) -> list[str]:
        """Rows that do not count, a sentence for each reason: `copied`, `fitted`, with {} for the rows' file."""
        found = ((self.copied_lines, copied), (self.fitted_lines, fitted))
        return [f"{counted(len(lines))} {why.format(self.samples)}." for lines, why in found if lines]

    def fitted_words(self, names: str = "") -> str:
        """Clauses on the unknowns fitted to these rows and on what was assumed not to have moved."""
        own = f"{counted(len(self.own), 'unknown')} fitted to these rows{names}"
        still = f"; assumed not to have moved: {', '.join(self.standing)}" if self.standing else ""
        return (own if self.own else "nothing fitted to these rows") + still

    def document(self, first: Mapping[str, Any], found: Any, instead: Mapping[str, Any]) -> dict[str, Any]:
        """JSON document: entries of `first`, then the fields of `found`, those in `instead` replaced."""
        rows = {each.name: getattr(self, each.name) for each in fields(self)}
        rows["verdict"] = dict(zip(("level", "words"), self.verdict, strict=True)) if self.verdict[0] else None
        last = {name: rows.pop(name) for name in ("copied_lines", "fitted_lines", "remarks")}
        figures = {each.name: getattr(found, each.name) for each in fields(found) if each.name != "judged"}
        return dict(jsonable({**first, **rows, **figures, **instead, **last}))


@dataclass(frozen=True, eq=False)
class Opened:
    """A result as measured by the rows' instrument, the rows that count, and lines of those that do not."""

    arm: CalibratedArm
    source: ProblemFile
    rows: Samples
    copied: tuple[int, ...]
    fitted: tuple[int, ...]
    other: bool  # whether another instrument than the calibration's took the rows
    remarks: tuple[str, ...]
    """As `Judged` has them."""

    def fresh(self, standing: Collection[str]) -> Fresh:
        """Rows bound to the arm; raises CasacalError as `fresh_rows`, SamplesError for what is not finite."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            fresh = fresh_rows(self.arm, self.source.problem, self.rows, other=self.other, standing=standing)
            if not np.isfinite(fresh.bound.residual(fresh.x)).all() or not np.isfinite(fresh.jacobian).all():
                fix = "Check their values with check"
                raise SamplesError(self.rows.file, "the residuals of some rows are not finite", fix)
        return fresh

    @property
    def noise_freedom(self) -> float:
        """Degrees of freedom of the noise where the calibration found it itself, infinite where it was stated.

        The logarithm of a standard deviation from nu degrees of freedom has the variance 1 / (2 nu).
        """
        noise = self.arm.found.noise
        used = any(face.used_mm > face.stated_mm for face in noise.by_face.values())
        if not used or not noise.high > noise.low > 0:
            return math.inf
        return 0.5 / (math.log(noise.high / noise.low) / (2 * 1.96)) ** 2

    def judged(self, fresh: Fresh, standing: tuple[str, ...]) -> Judged:
        """Record of these rows and of the calibration that they judge; `standing`: what has not moved."""
        verdict = self.arm.found.verdict
        said = ("", "") if verdict is None else (verdict.level, verdict.words)
        own = tuple(name for name, known in zip(fresh.bound.names, fresh.known, strict=True) if not known)
        robot, rows, lines = self.source.problem.robot.name, self.rows, (self.copied, self.fitted)
        return Judged(
            robot, self.arm.file, said, rows.file, rows.sha256, len(rows), own, standing, *lines, self.remarks
        )


def opened(
    result: AsArm | CalibratedArm | str | Path,
    samples: Samples | Any,
    *,
    problem: Problem | ProblemFile | str | Path | None,
    instrument: str | None,
    standing: Collection[str],
) -> Opened:
    """Read a result and the fresh rows that judge it; raises CasacalError as `verify` does."""
    if isinstance(standing, str):
        raise CasacalError(f"Got the text '{standing}' as the list of what has not moved", f"Give ['{standing}']")
    if not isinstance(standing, Collection):
        raise CasacalError(f"Got {came(standing)} as the list of what has not moved", "Give names, such as ['floor']")
    found = arm_from(result, "the result")
    if problem is None:
        arm, other = for_instrument(found, measured_by(found, samples, instrument)), None
    else:
        arm, other = for_instrument(found), problem_from(problem).problem
        other = other if instrument is None else other.measured_by(instrument)
    source, robot = arm.source, arm.source.problem.robot
    if other is not None:  # the result's arm with another problem's instrument
        if not same_arm(robot, other.robot):
            what = f"{arm.file}: the arm of the problem ({other.robot.name}) is not the calibrated one ({robot.name})"
            raise CasacalError(what, "Give a problem whose robot is that of the calibration, parameter by parameter")
        source = ProblemFile.of(Problem(robot, other.instrument, terms=arm.source.problem.terms))
    return fresh_among(arm, source, samples_of(samples, source, 0), other=problem is not None)


def measured_by(arm: CalibratedArm, samples: Any, instrument: str | None) -> str | None:
    """Which instrument of a calibration took some rows: the one that is named, else the one that reads most of them.

    Raises CasacalError where none could have, or several as well.
    """
    problem, fits = arm.source.problem, dict[str, int]()
    if instrument is not None or len(problem.instruments) == 1:
        return instrument
    if isinstance(samples, (str, Path)) and not Path(samples).is_file():
        raise CasacalError(f"There is no file '{samples}' of fresh rows", "Name one that is there")
    reasons = []
    for i, name in enumerate(problem.names):
        try:
            rows = samples_of(samples, arm.source, i)
            labelled = [column for column, labels in rows.labels.items() if labels.names != (column,)]
            fits[name] = len(rows.columns) + len(labelled)
        except CasacalError as error:
            reasons.append(f"for the {name}: {error.what}")
    best = [name for name, count in fits.items() if count == max(fits.values())]
    if len(best) == 1:
        return best[0]
    if best:
        fix = f"Name it: instrument='{best[0]}', or --instrument {best[0]}"
        raise CasacalError(f"These rows may be of {' or '.join(best)}", fix)
    raise CasacalError(f"These rows fit none of the instruments: {'; '.join(reasons)}", "Correct the columns")


def same_arm(one: Robot, two: Robot) -> bool:
    """Whether two arms have the same parameters, and the same poses wherever these move a little."""
    kinds = [[axis.turns for axis in each.axes] for each in (one, two)]
    if kinds[0] != kinds[1] or set(one.parameters) != set(two.parameters):
        return False
    rng = np.random.default_rng(0)
    for q in random_joints(one, COMPARED, rng):
        poses = []
        moved = {key: rng.normal(size=u.nominal_size) * 1e-3 for key, u in one.parameters.items()}
        for robot in (one, two):
            values = []
            for key, unknown in robot.traced.unknowns.items():
                if unknown.nominal is None or np.size(unknown.nominal) != moved[key].size:
                    return False
                value = unknown.at(ca.DM(np.ravel(unknown.nominal) + moved[key]), ca.DM.zeros(unknown.size))
                values.append(unknown.packed(value))
            pose = ca.DM.eye(4)
            for factor in robot.traced.graph.call([*values, ca.DM(q)]):
                pose = pose @ factor
            poses.append(np.array(pose))
        if not np.abs(poses[0] - poses[1]).max() < ALIKE:
            return False
    return True


def fresh_among(arm: CalibratedArm, source: ProblemFile, rows: Samples, *, other: bool) -> Opened:
    """Open rows without copies, and without rows that the arm was calibrated from.

    Raises SamplesError where half of the rows or more are those that were fitted.
    """
    again = copies(rows)
    once, data = rows.take(np.flatnonzero(~again)), arm.found.data
    reused, part = np.zeros(len(once), dtype=bool), 0.0
    if data.fitted_rows is not None:
        reused, part = fitted_among(once, source.problem.layout(), data.fitted_rows)
    elif data.sha256 == rows.sha256 and arm.found.method != "truth":
        part = 1.0  # a result from before results held their rows
    if part >= SPENT:
        said = "these are the rows" if reused.all() or not reused.any() else "half of the rows or more are those"
        fix = "Take fresh rows, in other postures"
        raise SamplesError(rows.file, f"{said} that the arm was calibrated from, which say nothing new", fix)
    copied = tuple(int(rows.lines[k]) for k in np.flatnonzero(again).tolist())
    fitted = tuple(int(once.lines[k]) for k in np.flatnonzero(reused).tolist())
    fresh = once.take(np.flatnonzero(~reused))
    if other:
        return Opened(arm, source, fresh, copied, fitted, other, NOTHING.beyond)
    remarks, groups = [*TellingColumns.by(arm, fresh).beyond], source.problem.instrument.groups
    if groups is not None and fresh.labels[groups].names == (groups,):
        keys = [key for key, unknown in source.problem.instrument.unknowns.items() if unknown.per == groups]
        names = [name.split(".") for name in arm.found.unknowns]
        known = {name[-2] for name in names if len(name) > 2 and name[-3] in keys}
        if len(known) > 1:
            said = f"count as one, while the calibration knows {listed(sorted(known))}"
            remarks.append(f"The rows have no column '{groups}' and {said}: add the column if they are on several.")
    before = data.fitted_rows
    repeats = 0 if before is None else int(in_fitted_postures(fresh, source.problem.layout(), before).sum())
    if repeats >= SPENT * len(fresh):  # even wrong parameters predict these
        said = "They show that readings repeat, not that the arm is right elsewhere: take rows in other postures."
        remarks.append(f"{repeats} of {len(fresh)} rows are in postures that were fitted. {said}")
    return Opened(arm, source, fresh, copied, fitted, other, tuple(remarks))
