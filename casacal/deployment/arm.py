"""A calibrated arm: kinematics, estimate, covariance, and columns that drive effects, as one instrument sees it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from casacal.data.samples import Samples
from casacal.deployment.document import result_of
from casacal.deployment.result import CalibrationResult
from casacal.effects.compliance import LinkSag
from casacal.effects.effect import effects_of, refuse_unless
from casacal.effects.kit import with_kit, with_link_kit
from casacal.errors import CasacalError, RefusedResultError
from casacal.model.problem import Problem
from casacal.model.problem_file import ProblemFile
from casacal.model.robot import Robot
from casacal.model.term import Site
from casacal.model.unknown import Parameter
from casacal.values import Array, FrozenMapping, Value
from casacal.wording import listed

TRUTH = "this is the true arm of a simulation, not a calibration"
FLANGE_UNKNOWN = "the error of the flange is not known, see the verdict: --frame tip if this tip does the work"
PERHAPS_RADIANS = "warning: no joint value is larger than 6.3 degrees: are they radians?"
FRAMES = ("flange", "tip")  # frame of a pose: `robot.pose`, or where the instrument touches
NAMED = ("parameters", "unknowns", "without_corrections")  # parts of a result whose entries have the name of an unknown
OTHERS = "others."  # prefix of unknowns that the other instruments share
ALL_ROWS = "plane"  # label of the face where there is one for all rows
NO_COLUMNS: Mapping[str, Array] = FrozenMapping({})
MOST_SPANS, FAR_SPANS, NEAR_NOTHING = 10.0, 0.5, 0.02
"""How far from the fitted rows an amount may be, in spans of these: more is refused, or else said; and how little all
amounts of a file may be, but for none at all."""


@dataclass(frozen=True, eq=False)
class CalibratedArm(Value):
    """An arm as calibrated, or a true one of a simulation: what `predict`, `compensate` and exports take.

    file: where it was read from, for messages. source: the problem it answers. document: what result.json holds.
    """

    file: str
    source: ProblemFile
    document: Mapping[str, Any]

    @cached_property
    def found(self) -> CalibrationResult:
        """The document as a typed value."""
        return result_of(self.document)

    def with_its_kit(self, problem: Problem) -> Problem:
        """A problem with its effects; where it has none, the standard ones with the sag model of this result."""
        by_links = LinkSag.words in self.found.called.values()
        return with_link_kit(problem) if by_links and not problem.terms else with_kit(problem)

    @cached_property
    def used(self) -> Problem:
        """The problem whose pose has the effects that are corrected, and no others; CasacalError where it lacks one."""
        problem, keys = self.source.problem, self.corrected
        if not keys:
            return problem.without_terms
        known = {term.key: term for term in self.with_its_kit(problem).terms}
        if lost := [key for key in keys if key not in known]:
            raise CasacalError(
                f"{self.file}: it corrects an effect beside the geometry ('{lost[0]}') that the problem does not have",
                "Give the problem that it was calibrated with, or calibrate again",
            )
        return problem.with_terms(*(known[key] for key in keys))

    @property
    def corrected(self) -> tuple[str, ...]:
        """Keys of the effects beside the geometry that are corrected; none of a truth."""
        return self.found.effects.corrected

    @property
    def verdict(self) -> dict[str, str] | None:
        """The verdict as {level, words}; None for a truth, and for a result from before there were verdicts."""
        said = self.found.verdict
        return None if said is None else {"level": said.level, "words": said.words}

    @property
    def denial(self) -> str | None:
        """The words of a verdict not to use this result; None for any other."""
        said = self.found.verdict
        return said.words if said is not None and said.level == "do not use" else None

    @property
    def caution(self) -> str | None:
        """The words of a verdict to use this result with care; None for any other."""
        said = self.found.verdict
        return said.words if said is not None and said.level == "use with care" else None

    @property
    def mirror_words(self) -> str | None:
        """What is open where the samples fit a mirror image of the arm as well; None where nothing is."""
        image = self.found.mirror_image
        return None if image is None else image.words

    @property
    def flange_known(self) -> bool:
        """Whether the flange's error is known: not by a method or with a tool whose part in it nobody can tell."""
        return self.found.method == "truth" or not math.isnan(self.found.tip.flange_expected_mm)

    def check_usable(self, *, force: bool) -> None:
        """Raise RefusedResultError for a result whose verdict is not to use it, unless that is wanted all the same."""
        if self.denial is not None and not force:
            fix = "Mend what the verdict names and calibrate again; --force (force=True) uses it all the same"
            raise RefusedResultError(f"{self.file}: {self.denial.removesuffix('.')}", f"{fix}, and says so")

    def __repr__(self) -> str:
        against = "" if self.denial is None else ", do not use"
        return f"<CalibratedArm {self.source.problem.robot.name} of {self.file}, by {self.found.method}{against}>"


def arm_values(result: CalibratedArm, *, nominal: bool = False) -> SimpleNamespace:
    """Parameters `p` (CasADi DM by name) of `robot.pose`, calibrated without corrected effects, or as drawn."""
    values = SimpleNamespace()
    for key, unknown in result.source.problem.robot.parameters.items():
        local = ca.DM(_local(key, unknown, result, nominal, alone=True))
        setattr(values, key, unknown.at(ca.DM(np.asarray(unknown.nominal)), local))
    return values


def local_coordinates(result: CalibratedArm, *, nominal: bool = False, of: Problem | None = None) -> Array:
    """Local coordinates (nz,) of the first instrument's row model at the result, or at the nominal values.

    of: the problem with effects that are corrected, as of `used`, or with more; by default without any, and then the
    values are those for an arm that nobody corrects beyond its geometry. nominal: all zero.

    Zero for unknowns that differ by label. Raises CasacalError when the result lacks one.
    """
    geometry = result.source.problem.without_terms
    symbols, known = (of or geometry).symbols, geometry.symbols.unknowns
    found = {} if nominal else result.found.of_effects
    values = [np.zeros(0)]
    for key, unknown in symbols.unknowns.items():
        if key in known:
            values.append(_local(key, unknown, result, nominal, alone=not symbols.acting))
        else:  # of an effect, where it is corrected
            values.append(np.array([found.get(name, 0.0) for name in unknown.names(key)]))
    return np.concatenate(values)


def row_constants(result: CalibratedArm, of: Problem) -> Array:
    """Numbers c (nc,) of an instrument's row model: nominals that rows proposed; zero for what differs by label."""
    proposed = result.found.proposed
    found = [np.zeros(0)]
    for key in of.model.constants:
        unknown = of.symbols.unknowns[key]
        known = unknown.nominal if unknown.nominal is not None else proposed.get(key)
        if known is None or np.size(known) != unknown.nominal_size:
            known = np.zeros(unknown.nominal_size)
        found.append(np.ravel(known))
    return np.concatenate(found)


def covariance_of(result: CalibratedArm) -> tuple[Array, list[tuple[int, int]]]:
    """Covariance of the result's unknowns (n, n), and the index of each among them by its position in z."""
    covariance, names = named_covariance(result)
    local = [n for key, u in result.source.problem.symbols.unknowns.items() for n in u.names(key)]
    return covariance, [(i, names.index(name)) for i, name in enumerate(local) if name in names]


def named_covariance(result: CalibratedArm) -> tuple[Array, list[str]]:
    """Covariance (n, n) as the result holds it, and the unknowns that it is of; raises CasacalError without one."""
    found = result.found
    if found.covariance is not None:
        return found.covariance, list(found.covariance_of)
    if result.denial is None:
        raise CasacalError(f"{result.file}: it holds no covariance", "Calibrate again with this version")
    said = f"{result.file}: a result that is not to be used has no standard deviations"
    raise CasacalError(said, "Mend what its verdict names, and calibrate again")


def with_effects(result: CalibratedArm) -> tuple[Array, dict[str, float]] | None:
    """Covariance (n, n) of geometry and effects together, and the error of each by name; None without effects."""
    found = result.found.effects
    if found.covariance is None or found.off is None or result.found.covariance is None:
        return None
    return found.covariance, dict(zip(found.covariance_of, found.off.tolist(), strict=True))


def all_motion(result: CalibratedArm) -> tuple[Array, list[str]]:
    """Covariance (n, n) of all that a result says of arm, cell and effects that move the tip, and their names."""
    found = with_effects(result)
    return named_covariance(result) if found is None else (found[0], list(found[1]))


def _local(key: str, unknown: Any, result: CalibratedArm, nominal: bool, *, alone: bool) -> Array:
    """Local coordinates of an unknown at the result; zero for those that differ by label."""
    if nominal or unknown.per is not None or not unknown.size:
        return np.zeros(unknown.size)
    known = result.found.values(alone=alone)
    if not isinstance(unknown, Parameter) and not known.keys() & set(unknown.names(key)):  # held by the calibration
        return np.zeros(unknown.size)
    missing = [name for name in unknown.names(key) if name not in known]
    if missing:
        raise CasacalError(f"{result.file}: '{missing[0]}' is missing", "Give a result of this problem")
    return np.array([known[name] for name in unknown.names(key)])


def cautions(arm: CalibratedArm, *, posed: bool = True) -> list[str]:
    """What is to be known of a result before anything relies on it; `posed`: anything Cartesian."""
    truth = f"warning: {arm.file}: {TRUTH}" if arm.found.method == "truth" else None
    return [words for words in (truth, arm.caution, arm.mirror_words if posed else None) if words is not None]


def for_instrument(arm: CalibratedArm, instrument: str | None = None) -> CalibratedArm:
    """The arm with one of its instruments, by default the first; itself where it has no other.

    Names of that instrument's unknowns lose its own name, as if it were the only one. What the others have for
    themselves stays under their names. Raises UnknownNameError where no instrument is called so.
    """
    problem = arm.source.problem
    name = problem.names[0] if instrument is None else instrument
    problem.number(name)
    if len(problem.instruments) == 1:
        return arm
    # unknowns that other instruments share, where this one has its own by that key
    theirs = [key for key, by in problem.shared.items() if name not in by]
    exact = set(theirs)
    for key in theirs:
        unknown = problem.instruments[problem.number(problem.shared[key][0])].unknowns[key]
        exact |= {*unknown.names(key), *unknown.component_names(key)}

    def own(each: str) -> str:
        of_others = each in exact or any(each.startswith(f"{key}.") for key in theirs)
        return f"{OTHERS}{each}" if of_others else each.removeprefix(f"{name}.")

    found = dict(arm.document)
    if name != problem.names[0] and found.get("tip") is not None:  # it is of the first instrument's tip
        found["tip"] = {**found["tip"], "expected_rms_mm": None, "prior_rms_mm": None}
    found |= _renamed(found, own)
    if isinstance(said := found.get("discrepancy"), Mapping):
        tip = {} if name == problem.names[0] else {"expected_rms_mm_without_corrections": None}
        found["discrepancy"] = {**said, **_renamed(said, own), **tip}
    if isinstance(planes := found.get("planes"), Mapping):  # named by instrument and label, shared ones by their label
        others = tuple(f"{each} " for each in problem.names if each != name)
        found["planes"] = {key.removeprefix(f"{name} "): at for key, at in planes.items() if not key.startswith(others)}
    if isinstance(found.get("proposed"), Mapping):
        found["proposed"] = {own(key): value for key, value in found["proposed"].items()}
    if isinstance(noise := found.get("noise"), Mapping):
        by_face, before = noise.get("by_face") or {}, f"{name} "
        faces = {face.removeprefix(before): value for face, value in by_face.items() if face.startswith(before)}
        found["noise"] = {**noise, "by_face": faces | ({ALL_ROWS: by_face[name]} if name in by_face else {})}
    data = found.get("data")
    if isinstance(data, Mapping) and name in (data.get("instruments") or {}):
        found["data"] = {**data, **data["instruments"][name]}
    return CalibratedArm(arm.file, replace(arm.source, problem=problem.measured_by(name)), FrozenMapping(found))


def _renamed(part: Mapping[str, Any], own: Callable[[str], str]) -> dict[str, Any]:
    """The entries of a part that are named by unknowns, renamed."""
    rows = {key: [{**row, "name": own(row["name"])} for row in part[key]] for key in NAMED if key in part}
    names = part.get("covariance_of")
    return rows if names is None else {**rows, "covariance_of": [own(each) for each in names]}


@dataclass(frozen=True, eq=False)
class TellingColumns:
    """Values of the columns that drive effects, for effects that are corrected by columns.

    columns: by name in the row model, each (N,); their means in the fitted rows where these rows lack them.
    missing: by an effect's words the columns that these rows lack. beyond: a sentence for each column with amounts far
    from those of the fitted rows. deviations: standard deviation, in the fitted rows, of each column at its mean.
    """

    columns: Mapping[str, Array]
    missing: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    beyond: tuple[str, ...] = ()
    deviations: Mapping[str, float] = field(default_factory=dict)

    @staticmethod
    def by(arm: CalibratedArm, rows: Samples) -> TellingColumns:
        """Columns of rows that drive an effect; raises SamplesError where one holds what it may not."""
        further = arm.found.effects.further
        if not further:
            return NOTHING
        site, said = Site(arm.source.problem.robot, arm.source.problem.instrument), arm.found.effects
        columns, lacking = dict[str, Array](), dict[str, tuple[str, ...]]()
        away, beyond = dict[str, float](), list[str]()
        for effect in effects_of(arm.used):
            if effect.key not in further:
                continue
            if absent := tuple(name for name in further[effect.key] if name not in rows.extra):
                lacking[effect.words] = absent
                for name in set(effect.columns(site)) & set(said.mean):
                    columns[name] = np.full(len(rows), said.mean[name])
                    away[name] = said.spread[name]
            else:
                columns |= effect.told(site, rows)
                beyond += _beyond(rows, effect.amounts(site, rows), said.ranges)
        return TellingColumns(columns, FrozenMapping(lacking), tuple(beyond), FrozenMapping(away))


NOTHING = TellingColumns(NO_COLUMNS)
"""Columns of an arm without effects that columns drive."""


def _beyond(rows: Samples, amounts: Mapping[str, Array], ranges: Mapping[str, tuple[float, float]]) -> list[str]:
    """A sentence for each column (N,) of an effect far from its fitted range; SamplesError if out of all proportion."""
    known = {name: ranges[name] for name in amounts if name in ranges}
    span = max((max(high, 0.0) - min(low, 0.0) for low, high in known.values()), default=0.0)
    said = []
    for name, (low, high) in known.items():
        values, fitted = amounts[name], f"the {low:g} to {high:g} of the fitted rows"
        away = np.maximum(low - values, values - high)
        fix = "Give it in their unit, such as kg and not g, or Nm and not mNm; or calibrate with such rows"
        good = (away <= MOST_SPANS * span) | (span == 0)  # of one that was always zero nothing is in proportion
        refuse_unless(good[:, None], rows, (name,), values[:, None], f"is out of all proportion to {fitted}", fix)
        row = int(np.argmax(away))
        if away[row] > FAR_SPANS * span:
            where = f"warning: {name} is {values[row]:g} on line {int(rows.lines[row])}"
            said.append(f"{where}, far from {fitted}, so what it corrects there is extrapolated.")
    largest = max((float(np.abs(amounts[name]).max(initial=0.0)) for name in known), default=0.0)
    if 0 < largest < NEAR_NOTHING * span:
        said.append(
            f"warning: {listed(list(known))} reach {largest:g} in these rows, next to nothing beside the {span:g} of "
            "the fitted rows: are they in the unit of those, such as Nm and not kNm?"
        )
    return said


def whole_rows(
    first: Array, joints: int, names: Sequence[str], columns: Mapping[str, Array], elsewhere: Array | float = 0.0
) -> Array:
    """Rows (N, n + k) of a row model: the first columns (N, m), others (N,) by name, and `elsewhere` in the rest."""
    rows = np.zeros((len(first), joints + len(names)))
    rows[:, joints:] = elsewhere
    rows[:, : first.shape[1]] = first
    for name, values in columns.items():
        rows[:, joints + names.index(name)] = values
    return rows


def unit_notes(robot: Robot, joints: Array) -> list[str]:
    """A warning of joint values (N, n; rad, mm) that are all so small that they may be radians, read as degrees."""
    small = 0 < math.degrees(np.abs(joints[:, robot.revolute]).max(initial=0.0)) <= math.tau
    return [PERHAPS_RADIANS] if small else []


def column_notes(arm: CalibratedArm, missing: Mapping[str, tuple[str, ...]], beyond: Sequence[str]) -> list[str]:
    """Sentences on columns that drive effects: corrected, missing, or far beyond the fitted rows."""
    found = arm.found
    words_of_effects = [words for key, words in found.called.items() if key in found.effects.further]
    done = listed([words for words in words_of_effects if words not in missing])
    lacking = [
        f"Without {listed(names)}, {words} is corrected as in the fitted rows on average, and what rows differ by "
        "counts as an error; with them, each is corrected by its own."
        for words, names in missing.items()
    ]
    return [*([f"Corrected by columns of the rows: {done}."] if done else []), *beyond, *lacking]
