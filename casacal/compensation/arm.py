"""A calibrated arm as a value: the problem it answers, and what was found of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.compensation.result import CalibrationResult, result_of
from casacal.discrepancy import LinkSag, with_kit, with_link_kit
from casacal.errors import CasacalError, RefusedResultError
from casacal.problem.problem import Problem
from casacal.problem.problem_file import ProblemFile
from casacal.unknowns import Parameter
from casacal.values import Value

TRUTH = "this is the true arm of a simulation, not a calibration"
FRAMES = ("flange", "tip")  # what a pose may be of: `robot.pose`, or where the instrument touches


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
        """A problem with its effects; where it has none with those of any arm, by whichever weight bends this one."""
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
    """Covariance of the result's unknowns (n, n), and which position of the model's z is which of them."""
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
