"""Shapes of the links of a URDF: boxes, cylinders and spheres of its <collision>s, where they are at zero."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.robots.files.urdf import ZERO, Triple
from casacal.robots.files.urdf_reader import read_urdf
from casacal.robots.urdf_chain import MM, beside_base, hangs, placed
from casacal.values import Value

SIZES = {"box": ("size", 3), "cylinder": ("radius length", 1), "sphere": ("radius", 1)}
"""What each shape says of its size, and how many numbers that are."""

LARGEST = 20.0
"""Metres, beyond which a size must be millimetres."""


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
    origin, geometry = collision.find("origin"), collision.find("geometry")
    place: list[Triple] = [ZERO, ZERO]
    for k, key in enumerate(("xyz", "rpy")):
        if origin is not None and key in origin.attrib:
            x, y, z = _numbers(
                path, f"{key} of a collision of link '{link}'", origin.attrib[key], 3, ", metres or radians"
            )
            place[k] = (x, y, z)
    for part in [] if geometry is None else geometry:
        if part.tag not in SIZES:
            continue
        keys, count = SIZES[part.tag]
        size = [
            value
            for key in keys.split()
            for value in _numbers(
                path, f"{key} of a collision of link '{link}'", part.get(key, ""), count, ", metres or radians"
            )
        ]
        if min(size) <= 0 or max(size) > LARGEST:
            raise ProblemError(
                f"{path}: the collision {part.tag} of link '{link}' measures {' '.join(f'{s:g}' for s in size)}",
                f"Give metres, above zero and below {LARGEST:g}",
            )
        yield part.tag, tuple(value * MM for value in size), placed(place[0], place[1])


def _numbers(path: str | Path, what: str, text: str, count: int, units: str = "") -> list[float]:
    try:
        values = [float(part) for part in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise ProblemError(f"{path}: the {what} is '{text}'", f"Give {count} number{'s' if count > 1 else ''}{units}")
    return values
