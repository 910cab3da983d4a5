"""Which non-geometric effects are there, how large, and which are corrected: by evidence and by rows held out."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from scipy.special import fdtrc

from casacal.data.columns import Labels
from casacal.data.holdout import FACES, INSTRUMENTS, REGIONS, splits, splits_by
from casacal.effects.compliance import LinkSag
from casacal.effects.effect import Effect, effects_of
from casacal.effects.kit import own_terms, with_kit, with_link_kit, with_rich_kit
from casacal.effects.smooth import JointField
from casacal.effects.trusted import TrustedConstants
from casacal.errors import ProblemError
from casacal.fit.bound_problem import OTHERS, SHARED, BoundProblem, by_face, of_repeats, times
from casacal.fit.least_squares import Result
from casacal.fit.lm import lm
from casacal.linalg import posterior_covariance
from casacal.model.dial import dial_cycle, dial_gain
from casacal.model.problem import Problem
from casacal.uncertainty.evidence import NormalEquations, Sizes, effect_sizes, evidence, normal_equations
from casacal.uncertainty.figures import HALF_WEIGHT, rms
from casacal.uncertainty.fresh_rows import FreshRows, chance, covariance_root
from casacal.uncertainty.noise import WORTH, beforehand, erring_joints, with_joints
from casacal.uncertainty.tip_error import tip_rms, without_rigid, workspace_joints
from casacal.values import Array, Index
from casacal.wording import sized

ENOUGH = 300  # rows from which on a field of many unknowns can be told
MANY = 300  # unknowns of the geometry beyond which each has too few rows to tell of effects
MANY_FACES = 150  # and faces, whose forms are unknown
NEARLY = 0.98  # part of the most that an effect may be from which it is taken to stand there
SAGS = 0.5  # times the usual sag from which on it is asked whose weight it is
PART = 0.05  # least part of the stated noise that single rows may show where they err together
VERY_STRONG = 5.0  # log of a ratio of densities: 2 ln B above 10 (Kass and Raftery, JASA 90, 1995, section 3.2)
UNLIKELY = 0.01 / 2  # chance below which an error of the dial is taken to be there: 1 %, for the two that are tested
FLAT = 1e-3  # slope of a residual by its reading below which the reading does not count
STEP = 0.5  # millimetres by which readings are shifted for their slope: a distance from a plane is linear in them
UNSEEN = 1e-9  # part of the squared length of a column that a fit must leave of it for it to be seen at all
MOST_FACES = 12  # faces beyond which as many fits take long, and one face more or less says little
MOST_ROWS = 5_000  # rows beyond which they do, too
AS_PROMISED = 1.3  # misses of rows left out over those predicted, up to which a fit is borne out by them
GONE = 1e12  # times a prior's information by which an effect is taken away

Way: TypeAlias = tuple[BoundProblem, NormalEquations]
"""Rows under effects and noise, with their normal equations."""


def with_effects(bound: BoundProblem, problem: Problem, *, find_noise: bool = True) -> BoundProblem:
    """The bound problem with the standard effects, their sizes and the noise estimated from the rows.

    Sizes are those at which the rows are likeliest (restricted marginal likelihood) where the geometry stands. Noise is
    never less than stated; where many rows err together by more than each does alone, all errors of a row together are
    not. An arm that sags does so by one weight at its flange or by those of all links, whichever is likelier. Itself
    where nothing is unknown, faces are too many for their rows, or the geometry cannot be fitted.

    Args:
        bound: of the geometry alone, with the noise as it was found without effects.
        problem: the same geometry; its effects, or those to expect of any arm where it has none.
        find_noise: whether noise is found beside the sizes; else it stays as it is.

    """
    pairs = zip(bound.problem.instruments, bound.samples, strict=True)
    faces = sum(len(some.faces(each.groups).names) for each, some in pairs if each.probe is not None)
    if not 0 < bound.unknowns <= MANY or faces > MANY_FACES:
        return bound
    geometry = lm(bound)
    if not geometry.converged:
        return bound
    standard, least = _Linear.of(bound, with_kit(problem), geometry.x), 1.0 if find_noise else None
    if own_terms(problem):
        return standard.sized(least)
    if find_noise and bound.rows > ENOUGH:
        part = standard.sized(PART)
        field = [slot.unknown.prior_stds[0] for slot in part.slots if slot.term == JointField.key]
        if field and float(field[0]) > float(np.median(part.noise)):  # rows err together by more than each does alone
            found = _Linear.of(bound, with_rich_kit(problem), geometry.x).sized(PART)
            if err_as_stated(found):
                return found
    found = standard.sized(least)
    if times_found(found).get(LinkSag.key, 0.0) > SAGS:
        try:
            by_links = _Linear.of(bound, with_link_kit(problem), geometry.x)
        except ProblemError:  # joints that do not carry one another in order have no links beyond them
            return found
        if by_links.best(least).evidence > standard.best(least).evidence:
            return by_links.sized(least)
    return found


@dataclass(frozen=True)
class _Linear:
    """The rows under a problem with effects where the geometry stands, with noise as it was and, second, all alike.

    Faces that differed in noise may differ in what effects do to them instead: what makes the rows likelier is taken.
    """

    x: Array
    ways: tuple[Way, ...]

    @staticmethod
    def of(bound: BoundProblem, problem: Problem, geometry: Array) -> _Linear:
        """Linearised rows where the geometry alone stands at `geometry` (n,)."""
        whole = bound.under(problem)
        x = whole.x0.copy()
        places = {name: j for j, name in enumerate(whole.names)}
        x[[places[name] for name in bound.names]] = geometry
        ways, scale = [whole], whole.scale
        if set(scale) - {OTHERS, SHARED}:
            ways.append(whole.with_noise({OTHERS: min(by_face(scale).values()), **of_repeats(scale)}))
        return _Linear(x, tuple((way, normal_equations(way, x)) for way in ways))

    def sized(self, least: float | None) -> BoundProblem:
        """Rows with sizes and noise as found, the noise at least the part `least` of the stated; None holds it.

        Joint repeatability comes on top of the stated noise; it is not sought unless `least` is one.
        """
        best = self.best(least)
        if least != 1.0:
            return best.rows
        factors, even, equations = by_face(best.rows.scale), best.rows, best.equations
        faces = len(factors)
        if faces_differ := faces > 1:  # some of which see more of the joints than others
            even = even.with_noise({OTHERS: rms(np.array([*factors.values()])), **of_repeats(even.scale)})
            equations = normal_equations(even, self.x)
        joints = erring_joints(even, self.x, equations)
        if even.rows > ENOUGH:  # what so many rows share is told as such, and would pass for one joint before it is
            joints = [joint for joint in joints if joint == 0]
        joints = [0, *joints] if faces_differ and 0 not in joints else joints
        parts = [(way, normal_equations(way, self.x)) for way in with_joints(self.ways[0][0], best.rows, joints)]
        if not parts:
            return best.rows
        looks = [self._sizes(part, least, best.times, search=False) for part in parts]
        likely = [look.evidence + beforehand(way) for look, (way, _) in zip(looks, parts, strict=True)]
        found = self._likeliest(parts[int(np.argmax(likely))], least, best.times)
        # a factor for each face fits better than one number by chance (Schwarz, Annals of Statistics, 1978)
        against = -(faces - 1) * math.log(best.rows.rows) / 2 if faces_differ else WORTH
        return found.rows if found.evidence + beforehand(found.rows) - against > best.evidence else best.rows

    def best(self, least: float | None) -> _Found:
        """The likeliest of the ways, before joint repeatability is separated from the noise."""
        ways = self.ways if least is not None else self.ways[:1]
        return max((self._likeliest(way, least) for way in ways), key=lambda found: found.evidence)

    def _likeliest(self, way: Way, least: float | None, start: Mapping[str, float] | None = None) -> _Found:
        """The rows at the sizes and the noise that make them likeliest."""
        (whole, normal), sizes = way, self._sizes(way, least, start)
        rows = whole.with_sizes(sizes.times, noise=times(whole.scale, sizes.noise) if sizes.noise != 1 else None)
        return _Found(sizes.evidence, rows, sizes.times, normal.with_noise(sizes.noise))

    def _sizes(self, way: Way, least: float | None, start: Mapping[str, float] | None, *, search: bool = True) -> Sizes:
        """The likeliest sizes and noise, and how likely the rows are, as densities of readings; see `effect_sizes`."""
        (whole, normal), x = way, self.x
        stated = 1 / min(by_face(whole.scale).values(), default=1.0)
        known = {effect.key: (effect.doubt, effect.most) for effect in effects_of(whole.problem)}
        given = (whole, x, whole.beside, known)
        sizes = effect_sizes(*given, stated=stated, least=least, normal=normal, start=start, search=search)
        return replace(sizes, evidence=sizes.evidence - float(np.log(whole.noise).sum()))


@dataclass(frozen=True)
class _Found:
    """Rows with sizes and noise as found, and the logarithm of their likelihood."""

    evidence: float
    rows: BoundProblem
    times: Mapping[str, float]
    equations: NormalEquations


def times_found(whole: BoundProblem) -> dict[str, float]:
    """Size of each effect as found over its expected size, by key."""
    problem, found = whole.problem, {}
    for effect in effects_of(problem):
        slot = next((slot for slot in whole.slots if slot.term == effect.key), None)
        for i in range(len(problem.instruments)):
            expected = effect.unknowns(problem.symbols_of(i).site)
            if slot is not None and effect.key in expected:
                found[effect.key] = float(slot.unknown.prior_stds[0]) / float(expected[effect.key].prior_stds[0])
                break
    return found


def at_most(whole: BoundProblem) -> tuple[Effect, ...]:
    """Effects that are as large as they may be: no arm is so bad, and something else may stand behind them."""
    found = times_found(whole)
    return tuple(each for each in effects_of(whole.problem) if found.get(each.key, 0.0) > NEARLY * each.most)


def errors_are_shared(whole: BoundProblem) -> bool:
    """Whether rows have less noise of their own than was stated, and with what they share as much or more."""
    own, stated = (float(np.median(each.noise)) for each in (whole, whole.with_noise()))
    return own < stated and err_as_stated(whole)


def err_as_stated(whole: BoundProblem) -> bool:
    """Whether noise and all effects of a row together, root mean square, are as much as was stated, or more."""
    of_effects = np.array(whole.beside, dtype=bool)
    information = np.diagonal(whole.normal(whole.x0).information)
    noise = float(np.median(whole.noise))
    together = noise * float(np.sqrt(1 + information[of_effects] @ whole.prior_std[of_effects] ** 2 / whole.rows))
    return together >= float(np.median(whole.with_noise().noise))


@dataclass(frozen=True)
class EffectSize:
    """An effect beside the geometry as the rows show it.

    gain: by how much the logarithm of the rows' likelihood is larger with it than without. size: at which the rows are
    likeliest, all effects together, and expected_size: of any arm, both in `unit`.
    """

    key: str
    words: str
    gain: float
    size: float
    expected_size: float
    unit: str

    @property
    def shown(self) -> bool:
        """Whether the evidence is very strong."""
        return self.gain > VERY_STRONG


@dataclass(frozen=True)
class DialError:
    """An error of a dial that its problem does not declare, at its likeliest size.

    chance: of rows like these without it. tip_mm: what it makes of the estimate, mm RMS at the tip over the workspace,
    apart from the pose of the base.
    """

    key: str
    words: str
    chance: float
    size: float
    unit: str
    tip_mm: float

    @property
    def shown(self) -> bool:
        """Whether the rows show it."""
        return self.chance < UNLIKELY

    @property
    def shown_size(self) -> str:
        """The size as people read it."""
        return sized(self.size, self.unit)


def effect_sizes_of(fit: BoundProblem, x: Array) -> tuple[EffectSize, ...]:
    """Every effect of a fit, the likeliest first; x: where it stands (n,). Empty for the geometry alone."""
    times = times_found(fit)
    known = [effect for effect in effects_of(fit.problem) if effect.key in times and effect.key in fit.beside]
    known = [effect for effect in known if not isinstance(effect, TrustedConstants)]  # those have `leverages`
    gains = in_sample_gains(fit, x, [effect.key for effect in known]) if known else {}
    found = []
    for effect in known:
        key, unit = effect.key, effect.unit or fit.units[fit.beside.index(effect.key)]
        found.append(EffectSize(key, effect.words, gains[key], effect.size * times[key], effect.size, unit))
    return tuple(sorted(found, key=lambda each: -each.gain))


def dial_errors(fit: BoundProblem, x: Array) -> tuple[DialError, ...]:
    """Undeclared dial errors that would improve a fit: a gain, and an error periodic in the pointer's angle.

    Columns B (N, m) beside a minimum of residuals r, with C its covariance: what the fit leaves of them,
    K = B'(I - J C J')B, lowers the sum of squares by B'r K^-1 B'r; that over the rest is F distributed. A gain that the
    fit doubts anyway is held for its own test.

    Args:
        fit: with noise and effects as they were found, so that none of these passes for the dial's error.
        x: its minimum (n,).

    """
    if not fit.unknowns or not any(instrument.probe for instrument in fit.problem.instruments):
        return ()
    slopes, joints = fit.jacobian(x), workspace_joints(fit.problem.robot)
    tips, found = fit.tips(x, joints), []
    fields = without_rigid(fit.tip_jacobian(x, joints), tips)
    free = fit.rows - int((~np.isfinite(fit.prior_std)).sum())
    for key, words, unit, columns in _dial_columns(fit, x):
        before, _, name = key.rpartition(".")
        held = f"{before}{'.' if before else ''}{TrustedConstants.key}_{name}"
        kept = np.array([each != held for each in fit.names], dtype=bool)
        jacobian, field, prior = slopes[:, kept], fields[:, kept], fit.prior_information[np.ix_(kept, kept)]
        covariance = posterior_covariance(jacobian.T @ jacobian, prior)
        covariance = np.where(np.isfinite(covariance), covariance, 0.0)
        away = (x - fit.x0)[kept]
        residual = fit.residual(x) - slopes[:, ~kept] @ x[~kept]
        step = -covariance @ (jacobian.T @ residual + prior @ away)  # none where nothing is held
        residual = residual + jacobian @ step
        square = float(residual @ residual) + float((away + step) @ prior @ (away + step))
        cross = jacobian.T @ columns
        left, own = columns.T @ columns - cross.T @ covariance @ cross, columns.T @ columns
        freedom = free - columns.shape[1]
        if freedom < 1 or np.linalg.eigvalsh(left)[0] < UNSEEN * np.linalg.eigvalsh(own)[-1]:
            continue
        size = -np.linalg.solve(left, columns.T @ residual)
        gained = float(-size @ (columns.T @ residual))
        ratio = gained / len(size) / (max(square - gained, 0.0) / freedom + 1e-300)
        moved = tip_rms(field @ (covariance @ (cross @ size)))
        chance = float(fdtrc(len(size), freedom, ratio))
        found.append(DialError(key, words, chance, float(np.linalg.norm(size)), unit, moved))
    return tuple(found)


def _dial_columns(fit: BoundProblem, x: Array) -> Iterator[tuple[str, str, str, Array]]:
    """Key, words, unit, and whitened rows (N, m) by one percent of gain, by micrometres of cosine and sine.

    What was read holds the arm's errors, too, and little else where all touches were programmed to one depth: there a
    gain that makes readings vanish would seem to explain why the arm errs. So the gain is of what the drawn arm would
    read, which depends on no error; the pointer's angle, of what the fitted one does.
    """
    for i, instrument in enumerate(fit.problem.instruments):
        probe, declared = instrument.probe, instrument.unknowns
        if probe is None or probe.column is None or not probe.turn:
            continue
        read = np.zeros(fit.rows)
        read[fit.sample_rows(i)] = fit.samples[i].columns[probe.column]
        shifted = []  # residuals where the readings are a step more, and a step less
        for step in (STEP, -STEP):
            sets, columns = list(fit.samples), fit.samples[i].columns
            sets[i] = replace(sets[i], columns={**columns, probe.column: columns[probe.column] + step})
            shifted.append(fit.on(*sets).plain_residual(x))
        steep = (shifted[0] - shifted[1]) / (2 * STEP)
        sloped = np.abs(steep) > FLAT
        drawn, fitted = (
            read - np.where(sloped, fit.plain_residual(at) / np.where(sloped, steep, 1.0), 0.0) for at in (fit.x0, x)
        )
        slope, before = steep / fit.noise, fit.problem.prefix(i)
        if "gain" not in declared:
            yield f"{before}gain", "gain of the dial", dial_gain().unit, (slope * drawn / 100)[:, None]
        if "cycle" not in declared:
            angle = 2 * math.pi * fitted / probe.turn
            ways = slope[:, None] / 1000 * np.column_stack([np.cos(angle), np.sin(angle)])
            words = "error of the dial that repeats with every turn of its pointer"
            yield f"{before}cycle", words, dial_cycle().unit, ways


@dataclass(frozen=True)
class LeftOut:
    """A face as the others predict it: residuals of its rows, RMS in mm, found and predicted; chi-square, chance."""

    face: str
    rows: int
    actual_mm: float
    predicted_mm: float
    chi_square: float
    freedom: int
    p: float

    @property
    def ratio(self) -> float:
        """Found over predicted: about one where the model is right, more where it is not."""
        return self.actual_mm / self.predicted_mm


def leave_one_face_out(bound: BoundProblem, result: Result) -> tuple[LeftOut, ...]:
    """Fit the arm without each face in turn, and judge that face's rows by what the fit expects of them.

    Nothing where there is one face or very many, and no entry for a face without which the fit does not converge or
    which has no more rows than unknowns of its own. Rows that a robust loss ignored do not count.

    Args:
        bound: with the noise as it is used.
        result: its fit, from which each of these starts.

    """
    faces = bound.faces
    if not 2 <= len(faces.names) <= MOST_FACES or bound.rows > MOST_ROWS:
        return ()
    return tuple(_left_out(bound, result, faces.rows()))


def regions_borne_out(bound: BoundProblem, result: Result) -> bool:
    """Whether a fit without each region of postures in turn predicts that region's rows as well as it says."""
    parts = splits_by({}, bound.measured.joints).get(REGIONS, [])
    found = list(_left_out(bound, result, {str(k): rows for k, rows in enumerate(parts)}))
    if not found or len(found) < len(parts):
        return False
    actual, predicted = (math.hypot(*(getattr(each, name) for each in found)) for name in ("actual_mm", "predicted_mm"))
    return actual <= AS_PROMISED * predicted


def _left_out(bound: BoundProblem, result: Result, parts: Mapping[str, Index]) -> Iterator[LeftOut]:
    """Each part of the rows as a fit to the others predicts it; none where that fit does not converge."""
    for face, rows in parts.items():
        others = bound.take(np.setdiff1d(np.arange(len(bound.measured)), rows))
        fit = lm(others, start=result.x, loss=result.loss)
        if not fit.converged:
            continue
        known = np.isfinite(np.diagonal(fit.covariance))  # what the others do not hold, these rows alone know
        index = bound.residuals_of(rows)
        index = index[result.weights[index] >= HALF_WEIGHT]
        slopes = bound.jacobian(fit.x)[index]
        spread = slopes[:, known] @ covariance_root(fit.covariance[np.ix_(known, known)])
        judged = FreshRows(bound.residual(fit.x)[index], spread, slopes[:, ~known])
        if judged.freedom < 1:
            continue
        of_unit = bound.leading[index]
        actual, predicted = (rms((sizes * bound.noise[index])[of_unit]) for sizes in (judged.left, judged.std))
        p = chance(judged.chi_square, judged.freedom)
        yield LeftOut(face, len(rows), actual, predicted, judged.chi_square, judged.freedom, p)


def in_sample_gains(bound: BoundProblem, x: Array, keys: Iterable[str]) -> dict[str, float]:
    """Gain in the log-likelihood of the rows by each effect at its size.

    That is what the whole adds up to, row by row; an effect that gains little there gains nothing elsewhere.

    Args:
        bound: with effects of sizes as found, and noise as found.
        x: its fit (n,).
        keys: of the effects.

    """
    rows, prior = normal_equations(bound, x), bound.prior_information
    whole = evidence(rows, prior)
    return {key: whole - evidence(rows, _without(bound, prior, key)) for key in keys}


def gains(bound: BoundProblem, x: Array, keys: Iterable[str]) -> dict[str, dict[str, float]]:
    """Gain in the log density of unseen rows by effect and by split, as `in_sample_gains`; no split without parts."""
    bound = bound.thinned(MOST_ROWS)
    slopes, r, prior = bound.jacobian(x), bound.residual(x), bound.prior_information
    heights = slopes @ (x - bound.x0) - r
    priors = {key: _without(bound, prior, key) for key in keys}
    found: dict[str, dict[str, float]] = {key: {} for key in priors}
    if len(bound.samples) == 1:
        parted = splits(bound.samples[0], bound.groups_by[0])
    else:
        every = bound.measured
        parted = splits_by({FACES: bound.faces, INSTRUMENTS: Labels(every.names, every.instruments)}, every.joints)
    for name, parts in parted.items():
        rows = [bound.residuals_of(part) for part in parts]
        equations = [NormalEquations.of(slopes[part], heights[part]) for part in rows]
        whole = _densities(equations, prior)
        for key, without in priors.items():
            found[key][name] = whole - _densities(equations, without)
    return found


def _densities(parts: list[NormalEquations], prior: Array) -> float:
    """Sum over parts of the log density of each given the others, up to a constant."""
    whole, total = evidence(sum(parts[1:], parts[0]), prior), 0.0
    for k in range(len(parts)):
        others = [part for j, part in enumerate(parts) if j != k]
        rest = sum(others[1:], others[0])
        # a face that is left out stands where it likes
        known = np.flatnonzero((np.diagonal(prior) > 0) | (np.diagonal(rest.information) > 0))
        own = np.ix_(known, known)
        total += whole - evidence(NormalEquations(rest.information[own], rest.toward[known], rest.square), prior[own])
    return total


def _without(bound: BoundProblem, prior: Array, key: str) -> Array:
    """Information (n, n) of the prior with an effect's unknowns held at zero."""
    gone = np.array(bound.beside) == key
    return np.asarray(prior + np.diag(np.where(gone, GONE * np.diagonal(prior), 0.0)))
