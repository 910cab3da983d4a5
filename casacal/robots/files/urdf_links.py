"""The masses of the links of a URDF."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.robots.files.urdf import Triple, numbers_in
from casacal.robots.files.urdf_reader import read_urdf
from casacal.robots.urdf_chain import MM, hangs


def weights_of(
    path: str | Path, base: str | None, tip: str | None, payload: float
) -> tuple[tuple[float, ...], tuple[Triple, ...]]:
    """What each moving joint between two links carries up to the next: mass (n,), kg, and centre (n, 3).

    Centres are in the base link's frame at joint values of zero, mm. Links that hang beside the chain count where they
    hang, other joints at zero; a payload (kg) hangs at the origin of the tip link.

    Raises ProblemError where no link of the arm has a mass, a mass or a place is no number, or the file is none.
    """
    found = read_urdf(path)
    chain = found.chain(base, tip)
    root = chain[0].parent if chain else ""
    moving = [joint.name for joint in chain if joint.kind != "fixed"]
    if not (math.isfinite(payload) and payload >= 0):
        raise ProblemError(f"A payload of {payload!r} kg came", "Give zero or more")
    weighs = _inertials(path)
    masses, moments = np.zeros(len(moving)), np.zeros((len(moving), 3))
    if payload:
        weighs.append((chain[-1].child, payload, np.zeros(3)))
    for link, mass, centre in weighs:
        hung = hangs(found, link, root, moving)
        if hung is not None and hung[0] >= 0:
            k, pose = hung
            masses[k] += mass
            moments[k] += mass * (pose @ [*centre, 1.0])[:3]
    if not masses.sum() > 0:
        raise ProblemError(f"{path}: no link of the arm has a mass", "Add <inertial>, or give masses= yourself")
    places = moments / np.where(masses > 0, masses, 1.0)[:, None]
    return tuple(map(float, masses)), tuple((float(x), float(y), float(z)) for x, y, z in places)


def _inertials(path: str | Path) -> list[tuple[str, float, Array]]:
    """Links with a mass (kg), and where its centre is in the link's own frame (3, mm)."""
    weighs = []
    for link in ElementTree.parse(path).getroot().findall("link"):
        inertial, name = link.find("inertial"), link.get("name", "")
        mass, origin = (inertial.find(tag) if inertial is not None else None for tag in ("mass", "origin"))
        if mass is None:
            continue
        kg = _numbers(path, f"mass of link '{name}'", mass.get("value", ""), 1)[0]
        xyz = "0 0 0" if origin is None else origin.get("xyz", "0 0 0")
        place = np.array(_numbers(path, f"centre of mass of link '{name}'", xyz, 3))
        if kg < 0:
            raise ProblemError(f"{path}: the mass of link '{name}' is {kg:g}", "Give kilograms, zero or more")
        weighs.append((name, float(kg), place * MM))
    return weighs


def _numbers(path: str | Path, what: str, text: str, count: int) -> list[float]:
    values = numbers_in(text, count)
    if not values:
        raise ProblemError(f"{path}: the {what} is '{text}'", f"Give {count} number{'s' if count > 1 else ''}")
    return values
