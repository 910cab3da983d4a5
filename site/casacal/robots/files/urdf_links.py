"""The links of a URDF: their masses, and their shapes where they are at zero."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.robots.files.urdf import ZERO, Triple, numbers_in
from casacal.robots.files.urdf_reader import read_urdf
from casacal.robots.urdf_chain import MM, beside_base, hangs, placed
from casacal.values import Value


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


SIZES = {"box": ("size", 3), "cylinder": ("radius length", 1), "sphere": ("radius", 1)}
"""What each shape says of its size, and how many numbers that are."""

LARGEST = 20.0  # metres, beyond which a size must be millimetres


@dataclass(frozen=True, eq=False)
class LinkShape(Value):
    """A box (sides, mm), cylinder along its z (radius, length) or sphere (radius) that a link carries.

    carrier: the joint that moves it, -1 for the base. pose: of its middle in the base frame (4, 4; mm), all joints at
    zero in the arm's model.
    """

    link: str
    kind: str
    size: tuple[float, ...]
    carrier: int
    pose: Array


def shapes_of(path: str | Path, base: str | None, tip: str | None) -> tuple[tuple[LinkShape, ...], tuple[str, ...]]:
    """Shapes of the links from a base link to a tip link, of what hangs on them, and of what stands with the base.

    Also named: links of which shapes are not looked at: of other kinds, such as meshes, and what moves against the base
    by joints that are not the arm's. Raises ProblemError for sizes and places that are no numbers, or not in metres.
    """
    found = read_urdf(path)
    chain = found.chain(base, tip)
    root, moving = chain[0].parent, [joint.name for joint in chain if joint.kind != "fixed"]
    shapes, unread = list[LinkShape](), list[str]()
    for link in ElementTree.parse(path).getroot().findall("link"):
        name = link.get("name", "")
        hung = hangs(found, name, root, moving)
        if hung is None and link.find("collision") is not None:
            place = beside_base(found, name, root)
            hung = None if place is None else (-1, place)
            if place is None:
                unread.append(name)
        if hung is None:
            continue
        for collision in link.findall("collision"):
            read = list(_shapes(path, name, collision))
            shapes += [LinkShape(name, kind, size, hung[0], hung[1] @ pose) for kind, size, pose in read]
            if not read and name not in unread:
                unread.append(name)
    return tuple(shapes), tuple(unread)


def _shapes(
    path: str | Path, link: str, collision: ElementTree.Element
) -> Iterator[tuple[str, tuple[float, ...], Array]]:
    """Kind, size (mm) and pose in the link's frame of what a <collision> holds; nothing of what is not looked at."""

    def read(key: str, text: str, count: int) -> list[float]:
        return _numbers(path, f"{key} of a collision of link '{link}'", text, count, ", metres or radians")

    origin, geometry = collision.find("origin"), collision.find("geometry")
    place: list[Triple] = [ZERO, ZERO]
    for k, key in enumerate(("xyz", "rpy")):
        if origin is not None and key in origin.attrib:
            x, y, z = read(key, origin.attrib[key], 3)
            place[k] = (x, y, z)
    for part in [] if geometry is None else geometry:
        if part.tag not in SIZES:
            continue
        keys, count = SIZES[part.tag]
        size = [value for key in keys.split() for value in read(key, part.get(key, ""), count)]
        if min(size) <= 0 or max(size) > LARGEST:
            what = f"{path}: the collision {part.tag} of link '{link}' measures {' '.join(f'{s:g}' for s in size)}"
            raise ProblemError(what, f"Give metres, above zero and below {LARGEST:g}")
        yield part.tag, tuple(value * MM for value in size), placed(place[0], place[1])


def _numbers(path: str | Path, what: str, text: str, count: int, units: str = "") -> list[float]:
    values = numbers_in(text, count)
    if not values:
        raise ProblemError(f"{path}: the {what} is '{text}'", f"Give {count} number{'s' if count > 1 else ''}{units}")
    return values
