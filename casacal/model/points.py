"""A tip at points of a bar, a tracker or a plate, or at distances from spheres, another ball or an anchor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from casacal.errors import ProblemError
from casacal.model.geometry import Direction, Frame, rigid_fit
from casacal.model.instrument import COORDINATE, Instrument, Sight, Suspect, Trusted, Words, tool_point
from casacal.model.kinematics import Expression, transform_point
from casacal.model.unknown import Parameter
from casacal.values import Array, FrozenMapping, is_finite

AXES = ("x", "y", "z")

# standard deviations of what is taken for exact, where nobody states one; scales in percent of a length
TRACKER_SCALE = 0.001  # 10 um in a metre: air of a few kelvin other than assumed
WIRE_SCALE = 0.01
PLATE_SCALE = 0.005  # a steel plate some kelvin from 20 degrees
RADIUS_STD = 0.02  # mm, of two turned balls together


@dataclass(frozen=True, kw_only=True)
class ToolTip(Instrument):
    """Base of instruments that observe one point of the flange, `tool` (mm).

    noise_std: standard deviation of each residual, mm; raises ProblemError for one that is not positive.
    """

    noise_std: float
    tool: Parameter = tool_point()

    def __post_init__(self) -> None:
        if not is_finite(self.noise_std) or not self.noise_std > 0:
            what = f"noise_std of {type(self).__name__} is {self.noise_std!r}"
            raise ProblemError(what, "Give a positive number of mm")

    @property
    def residual_std(self) -> float:
        """Noise of each residual, mm."""
        return self.noise_std

    def tip(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Return the point in the base frame (3, mm)."""
        del row
        return transform_point(pose, p.tool)


def proposed_point(per: str) -> Parameter:
    """A point (3, mm) in the base frame for each value of a label column, which the rows propose; its prior is flat."""
    return Parameter(None, unit="mm", labels=("_x", "_y", "_z"), per=per)


def centre_of(points: Array, distances: Array, *, zero: bool = False) -> Array:
    """Point (3, mm) from which points (N, 3) lie at distances (N,), or at these but for one number if `zero`.

    |p|^2 - 2 p'c + |c|^2 = d^2 is linear in c and |c|^2; a common zero adds 2 d. Where the points leave a direction
    open, as on a plane, c lies in their midst along it.
    """
    middle = points.mean(axis=0)
    p = points - middle
    columns = [-2 * p, np.ones((len(p), 1))] + ([2 * distances[:, None]] if zero else [])
    solved, *_ = np.linalg.lstsq(np.hstack(columns), distances**2 - (p**2).sum(axis=1), rcond=1e-9)
    return np.asarray(middle + solved[:3])


@dataclass(frozen=True, kw_only=True)
class FixedPoint(ToolTip):
    """A tip that comes to one point for each value of the column "point", in many postures; three residuals per row.

    Without that column there is one point. With the arm held (`Problem.fix`), four touches of a spike give the tool.
    Points have no size: how large the arm is comes from its prior, unless something beside it is a known length.

    Args:
        noise_std: how well the tip is brought to the point, each coordinate, mm.
        tool: the tip in the flange frame, mm.
        point: the point in the base frame, mm; proposed from the data when not given.

    """

    point: Parameter = proposed_point("point")

    datum = ("point",)
    words = Words("distance from the points", "mm", "touches", "points fitted alone", group="point")

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Vector from the point to the tip (3, mm)."""
        return self.tip(pose, p, row) - p.point

    def propose(self, key: str, sight: Sight) -> Array:
        """Return the mean of the nominal tips."""
        return np.asarray(sight.tips.mean(axis=0)) if key == "point" else super().propose(key, sight)


@dataclass(frozen=True, kw_only=True)
class Sockets(ToolTip):
    """A ball put by hand into sockets along a bar, which stands at one or several places; three residuals per row.

    The way between two sockets is known, which makes the size of the arm known. Columns "socket" and "place" say which
    socket of which place a row is of; without the latter there is one place.

    Args:
        noise_std: how well the ball comes to rest, each coordinate, mm.
        along: where each socket stands along the bar, mm, by its label; two at least.
        tool: the centre of the ball in the flange frame, mm.
        start: the bar's zero at each place in the base frame, mm; proposed from the data when not given.
        bar: the bar's direction at each place; proposed from the data when not given.

    Raises ProblemError for fewer than two sockets, and for two at the same place.

    """

    along: Mapping[str, float] = field(default_factory=dict)
    start: Parameter = proposed_point("place")
    bar: Direction = Direction(None, per="place")

    datum = ("start", "bar")
    known_by = "socket"
    knows_every_label = True  # a socket that is not listed stands nowhere
    words = Words(
        "distance from the sockets", "mm", "rests", "sockets fitted alone", "the sockets' distances", group="place"
    )
    trusted = Trusted.scale("the sockets' distances", PLATE_SCALE, "along", cure="measuring the bar")

    def __post_init__(self) -> None:
        super().__post_init__()
        places = self.along if isinstance(self.along, Mapping) else {}
        along = {str(label): float(value) for label, value in places.items() if is_finite(value)}
        object.__setattr__(self, "along", FrozenMapping(along))
        if len(set(along.values())) < max(len(places), 2):
            what = f"The sockets stand at {dict(places) or self.along} along the bar"
            raise ProblemError(what, 'Give two places or more, such as {"0": 0, "1": 50}')

    @property
    def known_columns(self) -> Mapping[str, Mapping[str, float]]:
        """Position of the row's socket along the bar, mm."""
        return {"along": self.along}

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Vector from the socket to the ball's centre (3, mm)."""
        return self.tip(pose, p, row) - (p.start + row.along * p.bar)

    def propose(self, key: str, sight: Sight) -> Array:
        """Line through the nominal tips by their sockets; raises ProblemError where a place has one socket alone."""
        if key not in self.datum:
            return super().propose(key, sight)
        along = sight.columns["along"]
        apart = along - along.mean()
        towards = apart @ sight.tips
        if not np.ptp(along) or not np.linalg.norm(towards) > 1e-9:
            fix = "Put the ball into two sockets at every place"
            raise ProblemError("Some place of the bar has rows of one socket alone", fix)
        way = towards / np.linalg.norm(towards)
        return Direction.encode(way) if key == "bar" else np.asarray(sight.tips.mean(axis=0) - along.mean() * way)


@dataclass(frozen=True, kw_only=True)
class PointInFrame(ToolTip):
    """A tip and the coordinates x, y, z (mm) of where it stands in another frame; three residuals per row.

    station: transform from the robot's base to that frame; proposed from the data when not given.
    """

    station: Frame = Frame()

    datum = ("station",)

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Predicted minus given coordinates (3, mm)."""
        return transform_point(p.station, self.tip(pose, p, row)) - ca.vertcat(row.x, row.y, row.z)

    def propose(self, key: str, sight: Sight) -> Array:
        """Rigid fit of the nominal tips to the points (Arun, Huang and Blostein 1987); ProblemError on a line."""
        if key != "station":
            return super().propose(key, sight)
        places = np.column_stack([sight.columns[axis] for axis in AXES])
        matrix = rigid_fit(sight.tips, places)
        if len(places) > 1 and (places == places[0]).all():
            told = ", ".join(f"{value:g}" for value in places[0])
            what = f"All rows of {type(self).__name__} tell one place ({told}), as of a target that was lost"
            raise ProblemError(what, "Measure again, and see that the device tells where the target is")
        if matrix is None:
            fix = "Measure at least three points that do not lie on one line"
            raise ProblemError(f"The points of {type(self).__name__} lie on a line", fix)
        return Frame.encode(matrix)


@dataclass(frozen=True, kw_only=True)
class TrackedPoint(PointInFrame):
    """A reflector on the flange whose x, y, z are read in the tracker's own frame; three residuals per row.

    Args:
        noise_std: standard deviation of each coordinate, mm.
        tool: the reflector in the flange frame, mm.
        station: transform from the robot's base to the tracker's frame; proposed from the data when not given.

    """

    columns = FrozenMapping(dict.fromkeys(AXES, "length"))
    trusted = Trusted.scale("the scale of the coordinates", TRACKER_SCALE, *AXES, cure="a known length")

    @property
    def suspects(self) -> tuple[Suspect, ...]:
        """Units, and a mirrored frame."""
        cause = "the points seem to come in a left-handed frame: one axis counted the other way, or two exchanged"
        fix = "Export them in a right-handed frame, or correct the column that is wrong"
        return (*Suspect.units(self.columns), Suspect("left-handed frame", cause, fix, ("z",), -1.0))

    @property
    def words(self) -> Words:
        """Coordinates of points."""
        by, scale = self.station.per or Words.group, "the scale of the coordinates"
        return Words(COORDINATE, "mm", "points", "station fitted alone", scale, by, accuracy=True)


@dataclass(frozen=True, kw_only=True)
class KnownPoint(PointInFrame):
    """A tip brought to points of a plate, which the column "point" names; three residuals per row.

    Args:
        noise_std: how well the tip is brought to a point, each coordinate, mm.
        points: where each point stands on the plate (3, mm), by its label; three that do not lie on one line at least.
        tool: the tip in the flange frame, mm.
        station: transform from the robot's base to the plate's frame; proposed from the data when not given. Its
            inverse is the plate as a work object.

    Raises ProblemError for points that do not fix where the plate is.

    """

    points: Mapping[str, Sequence[float]] = field(default_factory=dict)

    known_by = groups = "point"
    knows_every_label = True  # a point that is not listed stands nowhere
    words = Words(COORDINATE, "mm", "points", "plate fitted alone", "the points' coordinates", "point", accuracy=True)
    trusted = Trusted.scale("the points' coordinates", PLATE_SCALE, *AXES, cure="measuring the plate")

    def __post_init__(self) -> None:
        super().__post_init__()
        labelled = self.points.items() if isinstance(self.points, Mapping) else [("", self.points)]
        for label, point in labelled:
            if not (isinstance(point, (tuple, list, np.ndarray)) and len(point) == 3 and all(map(is_finite, point))):
                fix = "Give x, y and z of each point in mm, by its label"
                raise ProblemError(f"Point '{label}' of the plate is {point!r}", fix)
        triples = {str(label): tuple(float(value) for value in point) for label, point in labelled}
        object.__setattr__(self, "points", FrozenMapping(triples))
        known = np.array(list(triples.values())).reshape(-1, 3)
        if len(known) < 3 or np.linalg.matrix_rank(known - known.mean(axis=0), tol=1e-6) < 2:
            what = f"The plate has {len(known)} points, and they do not say how it lies"
            raise ProblemError(what, "Give three or more that do not lie on one line")

    @property
    def known_columns(self) -> Mapping[str, Mapping[str, float]]:
        """Coordinates of the row's point on the plate, mm."""
        return {axis: {label: point[i] for label, point in self.points.items()} for i, axis in enumerate(AXES)}


FEWEST = 5  # rows of an anchor that propose where it is: three coordinates, their square, and the zero


@dataclass(frozen=True, kw_only=True)
class SphereTouch(ToolTip):
    """A ball that touches a sphere for each value of the column "sphere" all around; one residual per row.

    Without that column there is one sphere. Spheres of known size make the size of the arm known.

    Args:
        noise_std: standard deviation of a contact, mm.
        tool: the centre of the ball in the flange frame, mm.
        radii: radius of the sphere and of the ball together, mm, with the prior of its certificate.
        centre: centre of each sphere in the base frame, mm; proposed from the data when not given.

    """

    radii: Parameter
    centre: Parameter = proposed_point("sphere")

    datum = ("centre",)
    words = Words(
        *("distance from the spheres", "mm", "touches", "spheres fitted alone"),
        *("the radius and form of spheres and probe", "sphere"),
    )

    @property
    def trusted(self) -> Mapping[str, Trusted]:
        """The radius, where it is held."""
        return Trusted.held("radii", self.radii, "the radius of spheres and probe", RADIUS_STD, cure="measuring both")

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Gap between ball and sphere, mm."""
        return ca.norm_2(self.tip(pose, p, row) - p.centre) - p.radii

    def propose(self, key: str, sight: Sight) -> Array:
        """Centre of the sphere through the nominal tips."""
        if key != "centre":
            return super().propose(key, sight)
        return centre_of(sight.tips, np.zeros(len(sight.tips)))  # all alike, however large: |c|^2 takes them in


@dataclass(frozen=True, kw_only=True)
class SelfContact(ToolTip):
    """A ball on each of two arms, as far apart as both radii; one residual per row. For robots that `facing` makes.

    It sees the two arms against each other and nothing of the room: what both get wrong alike, it cannot know.

    Args:
        noise_std: standard deviation of a contact, mm.
        tool: centre of the ball on the first arm, in its flange frame, mm.
        other: centre of the ball on the other arm, in that one's flange frame, mm.
        apart: sum of both radii, mm, with the prior of what is known of it.

    """

    other: Parameter = tool_point()
    apart: Parameter

    words = Words("distance between the balls", "mm", "touches", "nothing fitted")

    @property
    def trusted(self) -> Mapping[str, Trusted]:
        """The sum of both radii, where it is held."""
        return Trusted.held("apart", self.apart, "the radii of the balls", RADIUS_STD, cure="measuring both")

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Gap between the balls, mm."""
        return ca.norm_2(self.tip(pose, p, row) - p.other) - p.apart


@dataclass(frozen=True, kw_only=True)
class Distance(ToolTip):
    """The length from an anchor to a point on the flange, read in the column "length"; one residual per row.

    The column "anchor" tells anchors apart; without it there is one.

    Args:
        noise_std: standard deviation of a length, mm.
        tool: the end of the wire or bar in the flange frame, mm.
        anchor: the other end in the base frame, mm; proposed from the data when not given.
        zero: what must be added to all lengths' model, mm: a wire that does not start at zero; flat unless given.

    """

    zero: Parameter = Parameter(0.0, unit="mm", prior_std=float("inf"))
    anchor: Parameter = proposed_point("anchor")

    columns = FrozenMapping({"length": "length"})
    datum = ("anchor", "zero")
    words = Words(
        "residual of the length", "mm", "lengths", "anchors and zero fitted alone", "the scale of the lengths", "anchor"
    )
    trusted = Trusted.scale("the scale of the lengths", WIRE_SCALE, "length", cure="a known length")

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Predicted minus read length, mm."""
        return ca.norm_2(self.tip(pose, p, row) - p.anchor) + p.zero - row.length

    def propose(self, key: str, sight: Sight) -> Array:
        """Point from which the nominal tips lie at the lengths read, but for the zero where that is unknown."""
        if key != "anchor":
            return super().propose(key, sight)
        if len(sight.tips) < FEWEST:
            fix = f"Take {FEWEST} or more from every anchor, or say where it is"
            raise ProblemError(f"An anchor has {len(sight.tips)} lengths", fix)
        return centre_of(sight.tips, sight.columns["length"], zero=bool(self.zero.size))
