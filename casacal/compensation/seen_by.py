"""A result of several instruments as one of them sees the arm: its tip, its faces, its noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from casacal.compensation.arm import CalibratedArm
from casacal.values import FrozenMapping

NAMED = ("parameters", "unknowns", "without_corrections")  # parts of a result whose entries have the name of an unknown
OTHERS = "others."  # before the names of what other instruments share
ALL_ROWS = "plane"  # what a face is called where there is one for all rows


def seen_by(arm: CalibratedArm, instrument: str | None = None) -> CalibratedArm:
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
        found["discrepancy"] = {**said, **_renamed(said, own)}
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
