"""An arm as rods of some thickness along its links: which of them come too near to a table, a box, or one another.

A rod leads the shortest way from axis to axis, as the drawing has them. What a drawing does not tell is not seen: the
shape of a link, an upper arm that runs beside its axes, cables. Distances are exact.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import casadi as ca
import numpy as np

from casacal.errors import CasacalError, ProblemError
from casacal.model.links import Links, foot
from casacal.model.robot import Robot, random_joints
from casacal.values import Array, Rows

STILL = 1e-6  # mm; a place whose height changes by less stays where the arm was built
TRIALS = 200  # postures that show how far an arm reaches, and what of it moves up and down
OF_REACH = 0.065
"""Radius of the links over the reach of the flange, both from the sizes that makers state.

A UR5 reaches 930 mm with tubes of 57 mm, a UR10e 1400 mm with 65 to 90 mm, an iiwa 946 mm with 68 mm.
"""
SLIM = 0.5  # radius of the last two links and the tool, over that of the others: 37 mm on a UR5
IN_METRES = 10.0  # mm; a box that ends nearer to the base was given in metres
IN_AIR = 1.0  # mm of the tool, from its tip on, that may be in what it touches


class Collision(NamedTuple):
    """Which postures (N,) bring a part of the arm too near to something."""

    part: str
    other: str
    rows: Rows


@dataclass(frozen=True, eq=False)
class Solid:
    """A box in any posture: its name, its lowest and highest corner (3, mm) in its own axes (3, 3, rows), its origin.

    touched: whether it is there to be touched, so that the last link and the tool may come near, but not through it.
    """

    name: str
    low: Array
    high: Array
    origin: Array = field(default_factory=lambda: np.zeros(3))
    axes: Array = field(default_factory=lambda: np.eye(3))
    touched: bool = False

    @staticmethod
    def box(name: str, ranges: object) -> Solid:
        """Ranges of x, y and z (mm) in the base frame; raises CasacalError for what is none."""
        try:
            low, high = np.array(ranges, dtype=np.float64).T
            sound = low.shape == (3,) and bool((low < high).all())
        except (TypeError, ValueError):
            sound = False
        if not sound:
            raise CasacalError(f"The box to keep out of is {ranges!r}", "Give ranges of x, y and z in mm, each rising")
        if np.abs([low, high]).max() < IN_METRES:
            raise CasacalError(f"The box to keep out of is {ranges!r} mm", "Give mm in the base frame: 0.5 m are 500")
        return Solid(name, low, high)


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Rods of an arm as drawn: its base up to the first axis, then one rod a link; the tool is one more.

    place: joint values (N, n; rad, mm) -> nodes between the rods (N, n + 2, 3; mm), from the base to the flange; None
    for an arm whose joints do not carry one another in order, of which the tip alone is known. rising: which nodes
    joints move up or down (n + 2,). reach: of the flange, from the first axis, mm.
    """

    place: Callable[[Array], Array] | None
    rising: Rows
    reach: float

    @staticmethod
    def of(robot: Robot) -> Skeleton:
        """Rods along the links of an arm."""
        try:
            links = Links.of(robot)
        except ProblemError:
            return Skeleton(None, np.zeros(0, dtype=bool), 0.0)
        turns, count = links.turns, len(links.turns)
        after = links.places[-1]  # from the flange back, so that upright axes are as high as what they carry
        for j in reversed(range(count)):
            after = foot(links.axes[j], links.points[j], after) if turns[j] else after
        first, laid, here = after, list[Array](), after
        for j in range(count - 1):  # a link that carries a slide leads to what slides, where it stands at zero
            turning = [k for k in range(j + 1, count) if turns[k]]
            here = foot(links.axes[turning[0]], links.points[turning[0]], here) if turning else links.places[-1]
            laid.append(here)
        q = ca.SX.sym("q", count)
        model = q if links.conventions is None else links.conventions.to_model(q)
        carried = replace(links, places=np.array([*laid, links.places[-1]])).carried(model)
        placed = ca.Function("places", [q], [ca.vec(ca.horzcat(ca.DM.zeros(3), ca.DM(first), *carried))])

        def place(joints: Array) -> Array:
            return np.array(placed.map(len(joints))(joints.T)).T.reshape(len(joints), count + 2, 3)

        trial = place(random_joints(robot, TRIALS, np.random.default_rng(0)))
        reach = float(np.linalg.norm(trial[:, -1] - trial[:, 1], axis=1).max())
        return Skeleton(place, np.ptp(trial[..., 2], axis=0) > STILL, reach)

    @property
    def radius(self) -> float:
        """Radius of the links as arms of this reach have them, mm."""
        return round(OF_REACH * self.reach)

    def collisions(
        self, joints: Array, tips: Array, radius: float, *, table: float, solids: Sequence[Solid] = ()
    ) -> Iterator[Collision]:
        """What comes too near in postures (N, n; rad, mm) with tips (N, 3; mm), for links of a radius (mm).

        The fixed base is not looked at, nor what no joint raises or lowers where it is about the table. A radius of
        zero looks at joints, flange and tip alone, and at no link.
        """
        yield Collision("the tool", "the table", tips[:, 2] < table - STILL)
        if self.place is None:
            for box in (solid for solid in solids if not solid.touched):
                yield Collision("the tool", box.name, to_box(tips, tips, box.low, box.high) <= 0)
            return
        nodes = np.concatenate([self.place(joints), tips[:, None]], axis=1)
        count = nodes.shape[1] - 1  # rods: the base, one for each joint, the tool
        names = ["the base", *(f"link {k}" for k in range(1, count - 1)), "the tool"]
        radii = radii_of(radius, count)
        lengths = np.linalg.norm(np.diff(nodes, axis=1), axis=2)
        # what leads to a tip nearby comes as low as the touch does: half the way from it is as thick as it can be
        room = np.minimum(radii, (lengths[:, ::-1].cumsum(axis=1)[:, ::-1] - lengths) / 2)
        for k in np.flatnonzero(self.rising[1:]).tolist():
            yield Collision(names[k], "the table", nodes[:, k + 1, 2] < table + room[:, k] - STILL)
        part = np.minimum(IN_AIR / np.maximum(lengths[:, -1:], STILL), 1)
        in_air = nodes[:, -1] + part * (nodes[:, -2] - nodes[:, -1])
        for solid in solids:
            ends = (nodes - solid.origin) @ solid.axes.T
            if solid.touched:
                ends[:, -1] = (in_air - solid.origin) @ solid.axes.T
            for k in range(1 if radius else count - 2, count):
                start = ends[:, k] if radius else ends[:, k + 1]
                thick = radii[k] if not solid.touched else room[:, k] if k < count - 2 else 0.0
                yield Collision(names[k], solid.name, _hits(start, ends[:, k + 1], solid, thick))
        middles = (nodes[:, 1:] + nodes[:, :-1]) / 2
        for one in range(count - 2 if radius else 0):
            for two in range(one + 2, count):
                least, longest = radii[one] + radii[two], (lengths[:, one] + lengths[:, two]) / 2
                rows = lengths[:, one + 1 : two].sum(axis=1) > 2 * radius  # what lies between lets them part
                rows &= np.linalg.norm(middles[:, one] - middles[:, two], axis=1) <= longest + least + STILL
                rods = (nodes[rows, one], nodes[rows, one + 1], nodes[rows, two], nodes[rows, two + 1])
                rows[rows] = between(*rods) <= least
                yield Collision(names[one], names[two], rows)


def radii_of(radius: float, rods: int) -> Array:
    """Radii (mm) of the base, the links and the tool, of which the last ones are slim."""
    slim = max(min(2, rods - 5), 0) + 1
    return np.array([radius] * (rods - slim) + [SLIM * radius] * slim)


def above_table(robot: Robot, table: float, boxes: Sequence[object] = ()) -> Callable[[Array, Array], Rows]:
    """Which postures (N, n; rad, mm), with their tips (N, 3; mm), hold joints, flange and tip above a table (mm).

    boxes: ranges of x, y and z (mm) in which neither flange nor tip is.
    """
    skeleton, solids = Skeleton.of(robot), [Solid.box("box", box) for box in boxes]

    def stands(joints: Array, tips: Array) -> Rows:
        found = skeleton.collisions(joints, tips, 0.0, table=table, solids=solids)
        return np.asarray(~np.any([each.rows for each in found], axis=0))

    return stands


def _hits(start: Array, end: Array, solid: Solid, thick: float | Array) -> Rows:
    """Which rods (N,) between places (N, 3), so thick, hit a solid; only those whose middle is near are measured."""
    middle, half = (start + end) / 2, np.linalg.norm(end - start, axis=1) / 2
    rows = np.linalg.norm(middle - middle.clip(solid.low, solid.high), axis=1) <= half + thick + STILL
    thickness = np.broadcast_to(thick, rows.shape)[rows]
    rows[rows] = to_box(start[rows], end[rows], solid.low, solid.high) <= thickness
    return np.asarray(rows)


def to_box(start: Array, end: Array, low: Array, high: Array) -> Array:
    """Distances (N,; mm) of segments between places (N, 3) from a box along the axes; zero inside.

    The square of it is convex along a segment, and its slope linear between the planes of the box that are crossed.
    """
    along = end - start
    with np.errstate(divide="ignore", invalid="ignore"):
        crossed = np.concatenate([(low - start) / along, (high - start) / along], axis=1)
    crossed = np.where(np.isfinite(crossed), crossed, 0.0).clip(0, 1)
    part = np.sort(np.concatenate([crossed, np.tile([0.0, 1.0], (len(start), 1))], axis=1), axis=1)
    points = start[:, None] + part[..., None] * along[:, None]
    slope = ((points - points.clip(low, high)) * along[:, None]).sum(axis=2)
    rows, after = np.arange(len(start)), (slope < 0).sum(axis=1).clip(1, 7)
    before, rise = slope[rows, after - 1], slope[rows, after] - slope[rows, after - 1]
    share = np.where(rise > 0, (-before / np.where(rise > 0, rise, 1.0)).clip(0, 1), 0.0)
    at = part[rows, after - 1] + share * (part[rows, after] - part[rows, after - 1])
    nearest = start + at[:, None] * along
    return np.asarray(np.linalg.norm(nearest - nearest.clip(low, high), axis=1))


def between(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Distances (N,; mm) of segments a-b and c-d between places (N, 3): at an end of one of them, or inside both."""

    def from_end(place: Array, start: Array, end: Array) -> Array:
        along = end - start
        part = ((place - start) * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), STILL)
        return np.asarray(np.linalg.norm(place - start - part.clip(0, 1)[:, None] * along, axis=1))

    ends = np.minimum.reduce([from_end(a, c, d), from_end(b, c, d), from_end(c, a, b), from_end(d, a, b)])
    u, v, w = b - a, d - c, c - a
    normal = np.cross(u, v)
    square = (normal**2).sum(axis=1)
    size = np.maximum(square, STILL)
    s, t = ((np.cross(w, each) * normal).sum(axis=1) / size for each in (v, u))
    inside = (square > STILL) & (s > 0) & (s < 1) & (t > 0) & (t < 1)  # else along one another, or no length
    return np.asarray(np.where(inside, np.abs((w * normal).sum(axis=1)) / np.sqrt(size), ends))
