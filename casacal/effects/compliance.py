"""Joint compliance: to a weight at the flange, to the weights of the links beyond a joint, or to measured torques."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from casacal.data.samples import Samples
from casacal.effects.effect import ByColumns, Effect, check_columns_of, read_columns_of, refuse_unless, weighted
from casacal.errors import ProblemError
from casacal.model.kinematics import Expression, position
from casacal.model.links import Links
from casacal.model.robot import random_joints
from casacal.model.term import Here, Site
from casacal.model.unknown import Parameter
from casacal.values import Array, Rows, is_real

LARGEST_PAYLOAD = 10_000.0  # kg; beyond it a value is absurd whatever the arm
LARGEST_TORQUE = 100_000.0  # Nm (N of a sliding joint), likewise
HEAVIEST = 1e5  # kilograms of a link; more is another unit
NOTHING = 1e-9  # part of the largest moment that is rounding
DOWN = (0.0, 0.0, -1.0)  # gravity in the base frame of an arm that stands
LOAD = 5.0  # kilograms of payload that are expected to pull about as much as all of the arm's own links
MASS = "payload"  # column of a row model
APART = 0.5  # by how much of what all give one joint gives more or less than the others
LEAST_SAG = 1.0  # mm at 1 rad per metre of lever, below which joints carry no weight, as those of an upright SCARA
POSTURES = 64  # joint values over which an arm's sag is averaged


@dataclass(frozen=True, kw_only=True)
class Loaded(Effect):
    """An effect of weights, to which a payload adds; a column of the samples may say it, kg per row.

    size: by how much the flange sags, mm. down: direction of gravity in the base frame.
    """

    payload: str = ""
    size: float = 0.15
    doubt: float = 2.5
    down: tuple[float, float, float] = DOWN

    moves = True
    elastic = True
    unit = "mm"
    key = "give"

    def __post_init__(self) -> None:
        if not isinstance(self.payload, str):
            fix = "Name the column that holds it, such as 'payload_kg'"
            raise ProblemError(f"Got {self.payload!r} as the payload", fix)
        direction = np.asarray(self.down)
        if direction.shape != (3,) or direction.dtype.kind not in "if" or not 0 < np.linalg.norm(direction) < np.inf:
            raise ProblemError(f"Gravity points along {self.down!r}", "Give three numbers, such as down=(0, 0, -1)")
        object.__setattr__(self, "down", tuple((direction / np.linalg.norm(direction)).tolist()))

    @property
    def further(self) -> tuple[str, ...]:
        """The column of the payload, if there is one."""
        return (self.payload,) if self.payload else ()

    def columns(self, site: Site) -> tuple[str, ...]:
        """The payload, where a column says it."""
        del site
        return (MASS,) if self.payload else ()

    def told(self, site: Site, samples: Samples) -> Mapping[str, Array]:
        """Payload of each row (N,), kg; raises ProblemError, SamplesError where rows do not hold it."""
        del site
        if not self.payload:
            return {}
        kilograms = read_columns_of(samples, (self.payload,), 1, "payload")
        said = f"is no payload from 0 to {LARGEST_PAYLOAD:,.0f} kg"
        good = (kilograms >= 0) & (kilograms <= LARGEST_PAYLOAD)
        refuse_unless(good, samples, (self.payload,), kilograms, said, "Give kilograms, 0 for none")
        return {MASS: kilograms[:, 0]}


@dataclass(frozen=True, kw_only=True)
class GravitySag(Loaded):
    """Joint compliance under a weight: each joint deflects in proportion to the lever of that weight about it.

    The weight hangs at the flange or at the tip, or between; all joints give alike, and each a little differently.

    Args:
        size: by how much the flange sags where all give alike, mm, RMS over the joints' ranges.
        down: direction of gravity in the base frame.
        payload: column of the samples that says what hangs at the tip in each row, kg, such as "payload_kg": each joint
            then gives to it as well, in proportion. `predict` and `compensate` correct the sag where their file has
            that column; where it lacks it, as with the payload of the fitted rows on average.

    """

    words = "gravity sag"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Compliance of all turning joints to a weight at flange and at tip, then each joint's own; rad per m of lever.

        With a payload, then the same for `LOAD` kilograms at the tip.
        """
        turns = site.robot.revolute
        postures = random_joints(site.robot, POSTURES, np.random.default_rng(0))
        levers = np.array(site.robot.traced.levers.map(POSTURES)(postures.T)).reshape(3, POSTURES, -1)
        along = np.einsum("a,akj->kj", np.array(self.down), levers)[:, turns]
        pull = float(np.sqrt(((along**2).sum(axis=1) ** 2).mean()) / 1000)  # sag (mm) where each gives 1 rad per metre
        if not pull > LEAST_SAG:
            return {}
        each = np.full(int(turns.sum()), APART)
        loaded = [[1.0], each] if self.payload else []
        weights = np.concatenate([[1.0, 1.0], each, *loaded]) / pull
        return {self.key: weighted(weights, self.size, "rad")}

    def joints(self, here: Here) -> Expression:
        """Joint deflections u dh/dq, h the height of flange and tip along gravity, in metres."""
        u, count = getattr(here.p, self.key), int(here.robot.revolute.sum())
        at_zero = SimpleNamespace(**{**vars(here.row), **dict.fromkeys(here.instrument.columns, 0.0)})  # of readings
        places = (position(here.pose), here.instrument.tip(here.pose, here.p, at_zero))
        flange, tip = (ca.gradient(ca.dot(ca.DM(self.down), place) / 1000, here.q) for place in places)
        at_tip = [u[1] + u[k] for k in range(2, 2 + count)]
        if self.payload:
            load = getattr(here.row, MASS) / LOAD
            at_tip = [own + load * (u[2 + count] + u[3 + count + k]) for k, own in enumerate(at_tip)]
        pulls, turns = iter(at_tip), here.robot.revolute
        return ca.vertcat(*(u[0] * flange[j] + next(pulls) * tip[j] if turn else 0 for j, turn in enumerate(turns)))


@dataclass(frozen=True, kw_only=True)
class LinkSag(Loaded):
    """Joint compliance to the moments that the weights of the links beyond a joint have about it.

    It takes the place of `GravitySag`, whose key it has. Where masses are known, each joint has a give of its own: one
    number. Where they are not, each joint gives by as much as it likes to each link beyond it: n (n + 1) / 2 numbers
    for n joints, which ask for many postures.

    Args:
        size: by how much the flange sags from all of it, mm, RMS over the joints' ranges.
        down: direction of gravity in the base frame.
        masses: of the links that joint 1, 2, ... carry (n,), kg, payload included in the last; or none.
        payload: column of the samples that says what hangs at the flange in each row, kg, beside these masses, such as
            "payload_kg"; as for `GravitySag`.
        centres: their centres of mass in the base frame where the joints of the model stand at zero (n, 3), mm; by
            default each on the axis of the next joint, the last at the flange.

    """

    masses: tuple[float, ...] = ()
    centres: tuple[tuple[float, float, float], ...] = ()

    words = "gravity sag of the links"

    def __post_init__(self) -> None:
        super().__post_init__()
        masses: tuple[Any, ...] = tuple(self.masses) if np.iterable(self.masses) else (self.masses,)
        rows: tuple[Any, ...] = tuple(self.centres) if np.iterable(self.centres) else (self.centres,)
        wrong = [mass for mass in masses if not (is_real(mass) and 0 <= mass <= HEAVIEST)]
        if wrong or (masses and not sum(masses)):
            said = f"Got {wrong[0]!r} as the mass of a link" if wrong else "The links weigh nothing"
            raise ProblemError(said, f"Give kilograms, from zero to {HEAVIEST:g}, and not zero for all")
        centres = tuple(tuple(row) if np.iterable(row) else (row,) for row in rows)
        odd = [row for row in centres if len(row) != 3 or not all(is_real(x) and abs(x) < np.inf for x in row)]
        if odd:
            raise ProblemError(f"Got {odd[0]!r} as a centre of mass", "Give three numbers of mm for each link")
        if centres and not masses:
            raise ProblemError("Centres of mass came without masses", "Give both, or none")
        object.__setattr__(self, "masses", masses)
        object.__setattr__(self, "centres", centres)

    @staticmethod
    def from_urdf(
        path: str | Path,
        *,
        base: str | None = None,
        tip: str | None = None,
        size: float = 0.15,
        doubt: float = 2.5,
        down: tuple[float, float, float] = DOWN,
        payload: float | str = 0.0,
    ) -> LinkSag:
        """Masses and centres of mass as the <inertial> of a URDF's links has them; fixed joints are folded in.

        Args:
            path, base, tip: as for `Robot.from_urdf`.
            size, doubt, down: as for the effect itself.
            payload: what hangs at the tip link's origin, kg, or the column of the samples that says it.

        Raises ProblemError where the file names no mass, or cannot be read.

        """
        from casacal.model.urdf import weights_of

        column, kilograms = (payload, 0.0) if isinstance(payload, str) else ("", payload)
        masses, centres = weights_of(path, base, tip, kilograms)
        return LinkSag(size=size, doubt=doubt, down=down, masses=masses, centres=centres, payload=column)

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Compliance of each joint, or of each joint to each link beyond it, rad per metre of lever (and kg)."""
        feels, sag = self._pull(site)
        if not sag > LEAST_SAG:
            return {}
        return {self.key: weighted(np.full(int(feels.sum()), 1 / sag), self.size, "rad")}

    def joints(self, here: Here) -> Expression:
        """Joint deflections u dh/dq over all links, h the depth of the link along gravity, in metres."""
        u, feels = getattr(here.p, self.key), self._pull(here)[0]
        moments = self._moments(here, here.q, getattr(here.row, MASS) if self.payload else 0)
        off, place = [ca.SX(0)] * len(here.robot.axes), iter(range(u.numel()))
        for i, j in zip(*np.nonzero(feels), strict=True):
            off[i] += u[next(place)] * moments[int(i), int(j)]
        return self._links(here).to_controller(ca.vertcat(*off))

    def _links(self, site: Site) -> Links:
        """Links with the stated centres of mass; ProblemError where masses or centres are not one for each joint."""
        links, count = site.links, len(site.robot.axes)
        for what, values in (("masses", self.masses), ("centres of mass", self.centres)):
            if values and len(values) != count:
                raise ProblemError(f"Got {len(values)} {what} for {count} joints", "Give one for what each one carries")
        return replace(links, places=np.array(self.centres)) if self.centres else links

    def _moments(self, site: Site, q: Expression, load: Expression) -> Expression:
        """Moment arms of the load on each joint (rows): per link (n, n) in m, or of all links (n, 1) in kg m.

        load: kg at the flange; without masses it is a link more, in units of `LOAD`.
        """
        slopes = self._links(site).levers(np.array(self.down))(q).T
        own = ca.mtimes(slopes, ca.DM(self.masses)) if self.masses else slopes
        if not self.payload:
            return own
        hangs = load * self._at_flange(site)(q)[len(site.robot.axes) - 1, :].T
        return own + hangs if self.masses else ca.horzcat(own, hangs / LOAD)

    def _at_flange(self, site: Site) -> ca.Function:
        """Levers of weights that all hang at the flange."""
        places = np.tile(site.links.places[-1], (len(site.robot.axes), 1))
        return replace(site.links, places=places).levers(np.array(self.down))

    def _pull(self, site: Site) -> tuple[Rows, float]:
        """Mask (n, links) of moments that are not zero, and flange sag (mm RMS) at a compliance of 1 rad per moment."""
        count = len(site.robot.axes)
        q = ca.SX.sym("q", count)
        flange = self._at_flange(site)(q)[count - 1, :]
        moments = ca.Function("moments", [q], [ca.densify(self._moments(site, q, ca.SX(LOAD))), flange])
        postures = random_joints(site.robot, POSTURES, np.random.default_rng(0))
        about, sinks = (np.array(each) for each in moments.map(POSTURES)(postures.T))
        about, sinks = about.reshape(count, POSTURES, -1), 1000 * sinks.reshape(POSTURES, count).T
        found = np.sqrt((about**2).mean(axis=1)) * site.robot.revolute[:, None]
        feels: Rows = np.asarray(found > NOTHING * found.max())  # no link before a joint, none about an upright axis
        return feels, float(np.sqrt(((about * sinks[..., None] * feels[:, None]) ** 2).sum(axis=(0, 2)).mean()))


@dataclass(frozen=True, kw_only=True)
class TorqueCompliance(ByColumns):
    """Joint compliance to measured torques: each joint deflects by its own compliance times a column of the samples.

    `predict` and `compensate` correct it where their file has these columns too, measured or commanded, and exports to
    C and CasADi take the torques as a further input. Where they are not known they stand at their means in the fitted
    rows.

    Args:
        columns_of: the column of each joint's torque, in Nm, such as ("torque1_Nm", ...); one for each joint.
        size: of a joint's give, rad/Nm (mm/N of a sliding one).

    """

    columns_of: tuple[str, ...]
    size: float = 1e-4
    doubt: float = 10.0

    moves = True
    elastic = True
    most = 100.0
    key = "yield"
    words = "joint compliance under measured torque"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Compliance of each joint, rad/Nm."""
        check_columns_of(self.columns_of, len(site.robot.axes), "torques")
        return {self.key: weighted(np.ones(len(self.columns_of)), self.size, "rad")}

    def columns(self, site: Site) -> tuple[str, ...]:
        """The torque about each joint."""
        del site
        return tuple(f"torque_{j + 1}" for j in range(len(self.columns_of)))

    def told(self, site: Site, samples: Samples) -> Mapping[str, Array]:
        """Torques (N,) by joint; raises ProblemError, SamplesError where rows do not hold them."""
        torques = read_columns_of(samples, self.columns_of, len(site.robot.axes), "torques")
        said, fix = f"is absurd (beyond {LARGEST_TORQUE:,.0f} Nm)", "Check the value and its unit"
        refuse_unless(np.abs(torques) <= LARGEST_TORQUE, samples, self.columns_of, torques, said, fix)
        return dict(zip(self.columns(site), torques.T, strict=True))

    def joints(self, here: Here) -> Expression:
        """Joint deflections: compliance times torque, rad."""
        u = getattr(here.p, self.key)
        return ca.vertcat(*(u[j] * getattr(here.row, name) for j, name in enumerate(self.columns(here))))
