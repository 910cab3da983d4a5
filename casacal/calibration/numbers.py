"""Numbers that differ from the problem file: the tool's place, one of the arm's, or a scale of all lengths."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from casacal.calibration.finding import Fault, Finding, Undone, quick_fit
from casacal.data.samples import Samples
from casacal.effects.selection import regions_borne_out, with_effects
from casacal.effects.trusted import CONSTANTS
from casacal.errors import CasacalError
from casacal.fit.arm_alone import ArmProblem
from casacal.fit.bound_problem import BoundProblem, bind, times
from casacal.fit.least_squares import Result
from casacal.fit.lm import lm
from casacal.model.problem import Problem
from casacal.model.unknown import Parameter
from casacal.uncertainty.evidence import evidence, normal_equations
from casacal.uncertainty.figures import noise_interval
from casacal.uncertainty.moves import DULL, chance_of_move, common_scale
from casacal.uncertainty.noise import found_noise
from casacal.uncertainty.tip_error import tip_rms, tip_stds, without_rigid, workspace_joints
from casacal.values import Array, Index
from casacal.wording import figures, listed, mm

MEASURED = 1.0  # standard deviation, mm, with which people measure a tool
DISTINGUISHED = 4.5  # cost, in units of the noise, by which rows tell two causes apart: three standard deviations
CHANCE_OF_MOVE = 1e-3  # chance that a tool as stated moves so far, all its components together
FAR = 2.0  # prior standard deviations that a component must move: small moves look improbable where the model is wrong
NO_DRAWING = 2.0  # mm by which no length of an arm differs from its drawing
ANOTHER = 20.0  # standard deviations of a tool's prior by which a tool may differ that was exchanged or misread
TOGETHER = 0.9  # correlation of a length and the tool, without sign, from which the rows see their sum alone
WIDE = {"rad": 0.1, "mm": 20.0}  # smallest prior under which `calibrate` tries another number, by unit
TWISTS = "alpha", "beta"  # angles of a DH table that no mastering moves
WRONG = 5.0  # prior standard deviations from the drawing at which a number is another, not an error of manufacture
SURE = 3.0  # standard deviations, with the noise as found, by which it must lie beyond
ALONE = 16.0  # times the others' mean by which a number's prior cost must stand out: four standard deviations, squared
SCALE, TOOL = "scale of the readings", "tool elsewhere"
BY_CHANCE = 1e-4  # chance of a common scale, and more, where nothing scales lengths
UNLIKELY = 1e-2  # the same, beyond which it is mentioned
WARM = 1e-3  # part by which an arm grows that is 40 degrees warmer than its drawing, and more, of any metal
MOST_PART = 0.1  # no dial is so wrong; where all touches were driven to one depth, readings seem to mean nothing at all
TRIED = 2  # numbers that are freed one by one, those first that gain most
LITTLE = {"mm": 5.0, "rad": math.radians(2.0)}  # by which an arm may differ that is otherwise built as drawn


def tool_keys(problem: Problem) -> list[str]:
    """Keys of the instrument's unknown lengths that place its tip; empty for an instrument without one."""
    probe, unknowns = problem.instrument.probe, problem.instrument.unknowns
    moves = () if probe is None else probe.moves
    return [key for key in moves if isinstance(found := unknowns.get(key), Parameter) and found.unit == "mm"]


def priors_of(problem: Problem) -> Iterator[tuple[str, str, float, str]]:
    """Name, key, prior and unit of every free number of the arm that has a finite one."""
    for key, unknown in problem.robot.parameters.items():
        if isinstance(unknown, Parameter):
            for name, std, unit in zip(unknown.names(key), unknown.prior_stds, unknown.units, strict=True):
                if math.isfinite(std):
                    yield name, key, float(std), unit


def as_good(bound: BoundProblem, groups: Mapping[str, Sequence[str]], freed: Result) -> dict[str, str]:
    """Groups of unknowns, by title, that explain the rows as well as `freed` does, each with its deviation.

    bound: the rows with every prior as stated. Each group is fitted with its own priors away.
    """
    found, cost = dict[str, str](), freed.cost + DISTINGUISHED * max(noise_interval(freed)[0], 1.0) ** 2
    for title, keys in groups.items():
        try:
            other = bind(bound.problem.free(*keys).with_prior(dict.fromkeys(keys, math.inf)), *bound.samples)
            fitted = lm(other)
        except CasacalError:  # nothing of it can be freed
            continue
        if fitted.converged and fitted.cost <= cost:
            parts = tuple(f"{key}{sign}" for key in keys for sign in "_.")
            rows = [j for j, each in enumerate(other.names) if each in keys or each.startswith(parts)]
            far = max(rows, key=lambda j: abs(fitted.x[j]))
            found[title] = f"{other.names[far]} by {figures(fitted.x[far], signed=True)} {other.units[far]}"
    return found


def alike_numbers(bound: BoundProblem, keys: Sequence[str]) -> dict[str, str]:
    """Numbers of the arm that explain rows as well as the tool (its keys) elsewhere does, and by how much."""
    problem = bound.problem.free(*keys)
    freed = lm(bind(problem.with_prior(dict.fromkeys(keys, math.inf)), *bound.samples))
    if problem.free_names() != bound.problem.free_names():  # a tool that is held is yet no better than one measures it
        bound = bind(problem.with_prior(dict.fromkeys(keys, MEASURED)), *bound.samples)
    return as_good(bound, {name: [name] for name, *_ in priors_of(bound.problem)}, freed)


def tool_elsewhere_at(bound: BoundProblem, x: Array, covariance: Array) -> list[Finding]:
    """A warning where the tool moved far beyond its prior in a fit, at its estimate (n,) with the covariance (n, n).

    Also where a length of the arm moved, under a wide prior, by as much as no drawing errs, and the tool elsewhere fits
    as well. Nothing for a held tool, or for one without a prior.
    """
    pairs = zip(bound.problem.instruments, bound.problem.full_names, strict=True)
    moves = {full[key] for each, full in pairs if each.probe is not None for key in each.probe.moves}
    columns = [j for slot in bound.slots if slot.key in moves for j in slot.columns]
    own = np.array([j for j in columns if bound.units[j] == "mm" and np.isfinite(bound.prior_std[j])], dtype=np.intp)
    far = (np.abs(x[own]) > FAR * bound.prior_std[own]).any()
    if not far or chance_of_move(bound, x, covariance, own) > CHANCE_OF_MOVE:
        return _length_for_tool(bound, x, covariance, own)
    moved = ", ".join(f"{bound.names[j]} by {x[j]:+.2f} mm (its prior: {bound.prior_std[j]:.2g})" for j in own)
    cause = f"the samples put the tool in another place than the problem file does: {moved}"
    fix = "Measure the tool again, and correct its position or prior in the problem file"
    keys = [slot.key for slot in bound.slots if slot.key in moves and "mm" in slot.unknown.units]
    if others := alike_numbers(bound, keys):
        cause += f"; or {'; '.join(others.values())}, which these samples cannot tell from it"
        fix = f"Measure the tool from the flange first; only if it is as stated, look at {listed(list(others), 'or')}"
    return [Finding("warning", "tool elsewhere", cause, fix)]


def _length_for_tool(bound: BoundProblem, x: Array, covariance: Array, tool: Index) -> list[Finding]:
    """A warning where a length of the arm moved far and the tool (its places in x) elsewhere fits as well."""
    stds = np.sqrt(np.diagonal(covariance))
    for name, unit, _, j in bound.parameters():
        if j is None or unit != "mm" or j in tool or not abs(x[j]) > NO_DRAWING:
            continue
        alike = [k for k in tool.tolist() if abs(covariance[j, k]) > TOGETHER * stds[j] * stds[k]]
        if not any(abs(x[j]) <= ANOTHER * bound.prior_std[k] for k in alike):
            continue
        keys = list(dict.fromkeys(slot.key for slot in bound.slots for k in alike if k in slot.columns))
        held = bind(bound.problem.fix(name), *bound.samples)
        if other := as_good(held, {"tool": keys}, lm(bound.with_noise())):  # its rivals have the noise as stated
            cause = f"{name} moved by {x[j]:+.2f} mm; {other['tool']} fits as well, and puts the flange elsewhere"
            fix = f"Measure the tool from the flange; only if it is as stated, keep {name}"
            return [Finding("warning", f"tool or {name}", cause, fix)]
    return []


def numbers(problem: Problem) -> Iterator[Fault]:
    """Each number of the arm that has a prior, as a fault to be undone.

    Of more freedom than a tool elsewhere, which is commoner: among so many, one or the other may fit by chance.
    """
    for name, _, _, unit in priors_of(problem):
        cause = f"{name} seems to differ from the problem file"
        yield Fault(f"{name} elsewhere", cause, _fix(name, unit), partial(_freed, name=name), 4, common=False)


def wrong_number(bound: BoundProblem, *, alone: bool = False) -> list[Finding]:
    """An error where one number of the arm, and no other, contradicts its prior.

    A prior that holds a number back from where it is leaves residuals that look like noise, and once they count as
    noise, nothing contradicts the prior any more. So this looks at the fit with the noise as stated. Where the rows are
    likelier with the number as drawn and larger effects beside the geometry, it is not said to be another, unless
    geometry is to stand `alone`; nor where only the constants that an instrument takes for exact, or only their being
    unknown, make it seem so.
    """
    found = _wrong_number(bound, alone)
    if found and CONSTANTS in bound.problem.terms:
        exact = bound.problem.with_terms(*(term for term in bound.problem.terms if term != CONSTANTS))
        return found if _wrong_number(bound.under(exact), alone) else []
    return found


def _wrong_number(bound: BoundProblem, alone: bool) -> list[Finding]:
    stated = bound.with_noise() if bound.scale else bound
    result = lm(stated)
    if not result.converged:
        return []
    # numbers whose prior costs far more than that of any other: without it twice the cost falls by x^2 / (s^2 - C), the
    # square of a standard normal number where the prior is right; where all priors are too tight, or the noise is, all
    # of these grow
    gains = {}
    for name, key, _, unit in priors_of(bound.problem):
        j = stated.names.index(name)
        std, moved = float(stated.prior_std[j]), float(result.x[j] - stated.x0[j])
        learned = std**2 - result.covariance[j, j]
        gains[name, key, unit] = float(moved**2 / learned) if learned > DULL * std**2 else 0.0
    total, others = sum(gains.values()), max(len(gains) - 1, 1)
    first = sorted(gains, key=lambda each: -gains[each])[:TRIED]
    for name, key, unit in first:
        if not gains[name, key, unit] > ALONE * max((total - gains[name, key, unit]) / others, 1.0):
            continue
        freed = bind(bound.problem.with_prior({name: math.inf}), *bound.samples)
        found = lm(freed)
        j, noise = freed.names.index(name), max(noise_interval(found)[0], 1.0)
        by, std = float(found.x[j]), math.sqrt(found.covariance[j, j]) * noise
        prior = float(bound.prior_std[j])
        if found.converged and abs(by) > WRONG * prior + SURE * std:
            wide = bind(bound.problem.with_prior({name: abs(by)}), *bound.samples)
            if not alone and _likelihood(wide) < _likelihood(stated):
                return []  # errors that rows share pull a number far as well
            size = f"{_by(bound.problem, key, name, by)}, which is {abs(by) / prior:.2g} prior standard deviations"
            if several := _one_of_several(bound, name, found, size):
                return several
            cause = f"{name} seems to differ from the problem file{size}; no other parameter is so far off"
            return [Finding("error", f"{name} elsewhere", cause, _fix(name, unit) + _tried(name, unit, by))]
    return []


def borne_out(bound: BoundProblem, name: str) -> bool:
    """Whether a number of the arm, freed of its prior, moves little and predicts regions of postures left out."""
    problem = bound.problem.with_prior({name: math.inf})
    freed = bind(problem, *bound.samples)
    fit = with_effects(freed.with_noise(found_noise(freed).scale), problem)
    found = lm(fit)
    j = fit.names.index(name)
    return abs(found.x[j]) < LITTLE.get(fit.units[j], 0.0) and found.converged and regions_borne_out(fit, found)


def _one_of_several(bound: BoundProblem, name: str, freed: Result, size: str) -> list[Finding]:
    """An error on a number and others of tool, instrument and arm that explain the rows as well, if there are any.

    The instrument's own numbers come first, the tool before all others: it is what people exchange and mistype.
    """
    problem = bound.problem
    own = dict.fromkeys(full for key, full in problem.full_names[0].items() if key not in problem.instrument.datum)
    tool = [problem.full_names[0][key] for key in tool_keys(problem)]
    groups = {**({"tool": tool} if tool else {}), **{key: [key] for key in own if key not in tool}}
    rivals = as_good(bound, groups | {each: [each] for each, *_ in priors_of(problem) if each != name}, freed)
    if not rivals:
        return []
    probe = problem.instrument.probe
    zero = " and the zero of the dial" if probe is not None and probe.column is not None else ""
    said = [f"{'the ' if title == 'tool' else ''}{title} ({by})" for title, by in rivals.items()]
    each = "; ".join([*said, f"{name} ({size.removeprefix(', ')})"])
    cause = f"one of these seems to differ from the problem file, and these samples cannot tell which: {each}"
    first = f"the tool from the flange{zero} first" if "tool" in rivals else listed([*rivals, name])
    fix = f"Measure {first}, and correct in the problem file only what proves to be wrong"
    fix += ": another choice fits as well and puts the flange elsewhere"
    return [Finding("error", f"{listed([*rivals, name], 'or')} elsewhere", cause, fix)]


def wrong_scale(bound: ArmProblem, x: Array, covariance: Array) -> list[Finding]:
    """A finding where all lengths of an estimate x (n,) share a scale error, as after an instrument of wrong scale.

    No arm is built so, and such rows fit well. It counts where it moves the tip, over the workspace and apart from the
    base, by more than half of what this is expected to err. A dial on planes, which contain no length, is an error.
    Trackers and the like see how much an arm grew: they count where it is more than warmth does, and as a warning where
    one of a hundred arms has it.
    """
    dials = [one for one in bound.problem.instruments if one.probe is not None and one.probe.column is not None]
    alone = all(one.probe is not None for one in bound.problem.instruments)
    found = common_scale(bound, x, covariance) if dials or not alone else None
    least, seldom = (0.0, BY_CHANCE) if alone else (WARM, UNLIKELY)
    if found is None or found.chance > seldom or not least <= abs(found.part) <= MOST_PART:
        return []
    joints = workspace_joints(bound.problem.robot)
    field = without_rigid(bound.tip_jacobian(x, joints), bound.tips(x, joints))
    moved = tip_rms(field @ found.off)
    if moved < tip_rms(tip_stds(covariance, field).ravel()) / 2:
        return []
    size, way = f"{100 * abs(found.part):.2g}", "large" if found.part > 0 else "small"
    cause = f"all lengths came out {size} % too {way} together; no arm is built so, "
    if not alone:
        cause += (
            f"and warmth changes it by less than 0.1 %, but lengths that are taken for too {way} do that, and then "
        )
        cause += f"the tip errs by {mm(moved)}, which no figure counts"
        fix = f"Compare with a known length: {bound.problem.words.trusted or 'the scale of the instrument'}"
        return [Finding("error" if found.chance <= BY_CHANCE else "warning", SCALE, cause, fix)]
    cause += f"but a dial that shows {size} % too {'much' if found.part > 0 else 'little'} does that"
    declared = any("gain" in one.unknowns for one in dials)
    state = f"--prior gain={size}" if declared else f"gain=dial_gain({size}) of the instrument"
    fix = "Have the dial calibrated, or touch a gauge block's step, which contains a length; or declare that the gain "
    fix += f"may be so wrong ({state}), so that the priors decide how large the arm is"
    return [Finding("error", SCALE, cause, fix)]


def without_its_likes(findings: Iterable[Finding]) -> list[Finding]:
    """The findings without numbers that only look wrong because the scale of the readings is, or noise by rounding."""
    found = list(findings)
    if any(each.about.endswith(" rounded") for each in found):
        found = [each for each in found if each.about != "noise"]
    scaled = any(each.about == SCALE for each in found)
    if any(each.about.startswith(("tool or ", "tool, ")) for each in found):
        found = [each for each in found if each.about != TOOL]
    return [each for each in found if not (scaled and each.about.endswith(" elsewhere") and each.about != TOOL)]


def _likelihood(bound: BoundProblem) -> float:
    """Log marginal likelihood of the rows, with sizes of non-geometric effects and noise as found."""
    fit = with_effects(bound.with_noise(found_noise(bound).scale), bound.problem)
    found = lm(fit)
    fit = fit.with_noise(times(fit.scale, noise_interval(found)[0]))
    return evidence(normal_equations(fit, found.x), fit.prior_information) - float(np.log(fit.noise).sum())


def _freed(problem: Problem, samples: Samples, *, name: str) -> Undone:
    """The number free of its prior, and where the samples put it, so that further fits begin there."""
    freed = problem.with_prior({name: math.inf})
    if (fitted := quick_fit(freed, samples)) is None:
        return Undone(problem, samples)
    bound, result = fitted
    key, unit = next((key, unit) for each, key, _, unit in priors_of(problem) if each == name)
    by = float(result.x[bound.names.index(name)])
    return Undone(freed, samples, _by(problem, key, name, by), result.x, _tried(name, unit, by))


def _by(problem: Problem, key: str, name: str, by: float) -> str:
    unknown = problem.robot.parameters[key]
    assert isinstance(unknown, Parameter)
    assert unknown.nominal is not None
    at = float(unknown.nominal[unknown.component_names(key).index(name)])
    if unknown.unit == "rad":
        return f", by {figures(math.degrees(by), signed=True)} degrees from {figures(math.degrees(at), 6)}"
    return f", by {figures(by, 4, signed=True)} {unknown.unit} from {figures(at, 6)}"


def _fix(name: str, unit: str) -> str:
    mastered = unit == "rad" and not name.startswith(TWISTS)
    return f"Correct {name} in the problem file{', or re-master that joint' if mastered else ''}"


def _tried(name: str, unit: str, by: float) -> str:
    """Option with a prior at least as wide as the deviation, in one digit, so that `calibrate` can try it."""
    if unit not in WIDE:
        return ""
    most = max(abs(by), WIDE[unit])
    digit = 10.0 ** math.floor(math.log10(most))
    return f" (--prior {name}={math.ceil(most / digit) * digit:g} tries it)"
