"""A result of several instruments as one of them sees the arm: its tip, its faces, its noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from casacal.compensation.arm import CalibratedArm
from casacal.problem.problem import Problem
from casacal.values import FrozenMapping

NAMED = ("parameters", "unknowns", "without_corrections")  # parts of a result whose entries have the name of an unknown
OTHERS = "others."  # before the names of what other instruments share
ALL_ROWS = "plane"  # what a face is called where there is one for all rows


def seen_by(arm: CalibratedArm, instrument: str | None = None) -> CalibratedArm:
    """The same arm with one of its instruments, by default the first; itself where it has no other.

    Names of that instrument's unknowns lose its own name, as if it were the only one. What the others have for
    themselves stays under their names. Raises UnknownNameError where no instrument is called so.
    """
    problem = arm.source.problem
    if len(problem.instruments) == 1:
        if instrument is not None:
            problem.number(instrument)
        return arm
    name = problem.names[0] if instrument is None else instrument
    one = problem.measured_by(name)
    source = replace(arm.source, problem=one)
    return CalibratedArm(
        arm.file, source, FrozenMapping(_document(arm.document, name, problem.names[0], _of_others(problem, name)))
    )


def _of_others(problem: Problem, name: str) -> Callable[[str], bool]:
    """Whether an unknown is one that other instruments share, and this one has by the same key for itself."""
    theirs = [key for key, by in problem.shared.items() if name not in by]
    unknowns = dict(zip(problem.names, problem.instruments, strict=True))
    exact = {
        each
        for key in theirs
        for unknown in [unknowns[problem.shared[key][0]].unknowns[key]]
        for each in (key, *unknown.names(key), *unknown.component_names(key))
    }
    return lambda each: each in exact or any(each.startswith(f"{key}.") for key in theirs)


def _document(document: Mapping[str, Any], name: str, first: str, of_others: Callable[[str], bool]) -> dict[str, Any]:
    def own(each: str) -> str:
        return f"{OTHERS}{each}" if of_others(each) else each.removeprefix(f"{name}.")

    found = dict(document)
    if first != name and found.get("tip") is not None:  # it is of the first instrument's tip
        found["tip"] = {**found["tip"], "expected_rms_mm": None, "prior_rms_mm": None}
    found |= _renamed(found, own)
    if isinstance(said := found.get("discrepancy"), Mapping):
        told = {"told": [{**each, **_renamed(each, own)} for each in said["told"]]} if "told" in said else {}
        found["discrepancy"] = {**said, **_renamed(said, own), **told}
    if isinstance(found.get("proposed"), Mapping):
        found["proposed"] = {own(key): value for key, value in found["proposed"].items()}
    if isinstance(noise := found.get("noise"), Mapping):
        found["noise"] = {**noise, "by_face": _faces(noise.get("by_face") or {}, name)}
    data = found.get("data")
    if isinstance(data, Mapping) and name in (data.get("instruments") or {}):
        found["data"] = {**data, **data["instruments"][name]}
    return found


def _renamed(part: Mapping[str, Any], own: Callable[[str], str]) -> dict[str, Any]:
    """What of a part has the names of unknowns, with other names."""
    rows = {key: [{**row, "name": own(row["name"])} for row in part[key]] for key in NAMED if key in part}
    names = part.get("covariance_of")
    return rows if names is None else {**rows, "covariance_of": [own(each) for each in names]}


def _faces(by_face: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Noise by the faces of one instrument."""
    before = f"{name} "
    found = {face.removeprefix(before): value for face, value in by_face.items() if face.startswith(before)}
    return {**found, ALL_ROWS: by_face[name]} if name in by_face else found
