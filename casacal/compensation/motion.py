"""What a result says of effects beside the geometry: their sizes, and how far they move the arm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.compensation.arm import (
    CalibratedArm,
    corrections,
    covariance_of,
    local_coordinates,
    named_covariance,
    row_constants,
)
from casacal.discrepancy.effect import Site
from casacal.errors import CasacalError
from casacal.problem.compile import RowModel


@dataclass(frozen=True, eq=False)
class Moved:
    """A model of the arm with all that moves it, z (nz,) at the result, and which of z (k,) are known how well (k, k).

    off: by how much these (k,) are elsewhere than the arm is said to be. elsewhere: columns of a row at any posture.
    constants: c (nc,) of the model.
    """

    model: RowModel
    z: Array
    columns: list[int]
    covariance: Array
    off: Array | None
    elsewhere: Array
    constants: Array


def sizes_of(result: CalibratedArm) -> Mapping[str, float] | None:
    """Times by which effects were found larger than expected, by key; None where geometry was all there is."""
    said = result.document.get("discrepancy")
    return None if not said else {each["key"]: float(each["times"]) for each in said["effects"]}


def corrected_values(result: CalibratedArm) -> Mapping[str, float]:
    """Unknowns of the effects that are corrected, by name, as they were found."""
    said, keys = result.document.get("discrepancy") or {}, corrections(result)
    return {row["name"]: float(row["value"]) for row in said.get("unknowns", ()) if row["effect"] in keys}


def with_effects(result: CalibratedArm) -> tuple[Array, dict[str, float]] | None:
    """Covariance (n, n) of geometry and effects together, and by how much each is elsewhere than the arm is said to be.

    By name, in the order of the covariance; None where a result says nothing of effects.
    """
    said = result.document.get("discrepancy") or {}
    if "covariance" not in said:
        return None
    rows = [[np.inf if value is None else float(value) for value in row] for row in said["covariance"]]
    return np.array(rows), dict(zip(said["covariance_of"], map(float, said["off"]), strict=True))


def all_motion(result: CalibratedArm) -> tuple[Array, list[str]]:
    """Covariance (n, n) of all that a result says of arm, cell and effects that move the tip, and their names."""
    found = with_effects(result)
    return named_covariance(result) if found is None else (found[0], list(found[1]))


def known_motion(result: CalibratedArm) -> tuple[Array, list[str]]:
    """The same of all that a result corrects and of its other unknowns.

    Raises CasacalError where it holds none.
    """
    return all_motion(result) if corrections(result) else named_covariance(result)


def moved_arm(result: CalibratedArm) -> Moved:
    """All that moves the arm of a result; raises CasacalError where it holds no covariance, or of another kit."""
    problem, found = result.source.problem, with_effects(result)
    covariance, columns = covariance_of(result)
    if found is None:
        index = [j for _, j in columns]
        model, z = problem.model, local_coordinates(result, of=problem)
        elsewhere, constants = np.zeros(len(model.names)), row_constants(result, problem)
        return Moved(model, z, [i for i, _ in columns], covariance[np.ix_(index, index)], None, elsewhere, constants)
    model, site = problem.with_kit.model, Site(problem.robot, problem.instrument)
    names = [name for key, unknown in model.unknowns.items() for name in unknown.names(key)]
    lost = sorted({each["name"] for each in result.document["discrepancy"]["unknowns"]} - set(names))
    if lost:
        raise CasacalError(
            f"{result.file}: it holds an effect beside the geometry ('{lost[0]}') that the problem does not have",
            "Give the problem that it was calibrated with, or calibrate again",
        )
    whole, off = found
    places = {name: j for j, name in enumerate(off)}
    at = [i for i, name in enumerate(names) if name in places]
    index = [places[names[i]] for i in at]
    known = dict.fromkeys(model.names, 0.0)
    for effect in model.effects:
        known |= effect.away(site)
    return Moved(
        model,
        local_coordinates(result, of=problem.with_kit),
        at,
        whole[np.ix_(index, index)],
        np.array([off[names[i]] for i in at]),
        np.array(list(known.values())),
        row_constants(result, problem.with_kit),
    )
