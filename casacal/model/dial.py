"""A dial indicator on flat faces, or on faces whose angles are certified; or a tool that simply touches them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import casadi as ca
import numpy as np

from casacal.data.columns import Dimension
from casacal.errors import ProblemError
from casacal.model.geometry import Direction, Frame, Plane, rotation_between, transform
from casacal.model.instrument import Instrument, Probe, Sight, Suspect, Travel, Trusted, Words, tool_point
from casacal.model.kinematics import Expression, rotation, transform_point
from casacal.model.unknown import Parameter, Unknown, unit_vector
from casacal.values import Array, FrozenMapping, is_real, plain

GAIN_STD = 0.15  # percent of a dial that nobody certified


def dial_gain(percent: float = GAIN_STD) -> Parameter:
    """Prior of a dial's gain error, in percent: from its certificate, else 0.15 %.

    What touches of planes leave of a wrong gain is too small to be seen: geometry absorbs nearly all of it, as an arm
    that is too large or too small. So this has to be said.
    """
    return Parameter(0.0, unit="%", prior_std=percent)


def dial_cycle(micrometres: float = 3.0) -> Parameter:
    """An error that comes back with every turn of the pointer: priors of its cosine and sine, in micrometres."""
    return Parameter((0.0, 0.0), unit="um", prior_std=micrometres, labels=("_cos", "_sin"))


def dial_zero(std: float = 10.0, *, per: str = "session") -> Parameter:
    """Shift of a dial's zero where it was set anew: an unknown for each value of a column, with a prior in mm."""
    return Parameter(0.0, unit="mm", prior_std=std, per=per)


APPROACH = (
    "if the dial is at the end of its travel, move along the plunger until it reads about what is expected: readings "
    "that differ determine the size of the arm"
)
PLUNGER_STD = 0.01  # rad by which a plunger may stand off the axis that it was mounted along


@dataclass(frozen=True)
class Step:
    """A face parallel to another one at a known distance, as on a gauge block.

    on: label of the other face. height: distance along its normal, towards the tool, mm. std: of the certificate, mm.
    """

    on: str
    height: float
    std: float = 0.0003


@dataclass(frozen=True, kw_only=True)
class DialOnPlane(Instrument):
    """The paper's instrument: the tip of a plunger on a plane, residual n . (p - gamma), eq (6) with a unit normal.

    Args:
        noise_std: standard deviation of one measurement, mm: of the reading along the plunger, or, without a
            reading, of the touch along the normal.
        reading: True when the samples carry a `reading` column; False for contact only. Samples that do not match
            are refused.
        sign: +1 when a larger reading means a longer tool (the paper's d6 + reading), -1 when the plunger is pushed
            in. Never guessed.
        contact_std: standard deviation of touch and form of the face along the normal, mm, beside the reading's.
        travel: smallest and largest reading, mm, such as (-5, 5) of a dial that was set to zero in the middle; one
            number is the largest of a dial that begins at zero.
        tool: point of the plunger at reading zero, in the flange frame, mm; where the zero was set is part of it.
        plunger: direction of the plunger, out of the tool, in the flange frame.
        plane: the face, or one for each label.
        steps: faces that share the plane of another one at a known height, by label; a known length is what fixes the
            size of the arm.
        gain: how much too much of every way the dial may show, such as `dial_gain(0.15)`; None trusts it.
        cycle: what comes back with every turn of its pointer, such as `dial_cycle(3)`; None trusts it.
        turn: what one turn of the pointer shows, mm.
        zero_shift: what must be added to all readings, mm, where the dial was set to zero anew between sessions:
            `dial_zero()`, an unknown for each value of a column; None where it was set once.

    """

    noise_std: float
    reading: bool = True
    sign: Literal[1, -1] = 1
    contact_std: float = 0.0
    travel: Travel = 10.0
    tool: Parameter = tool_point(free=False)
    plunger: Direction = Direction((0.0, 0.0, 1.0), free=False)
    plane: Plane = Plane(per="plane")
    steps: Mapping[str, Step] = field(default_factory=dict)
    gain: Parameter | None = None
    cycle: Parameter | None = None
    turn: float = 1.0
    zero_shift: Parameter | None = None

    datum: ClassVar[tuple[str, ...]] = ("plane",)
    ranges = ("travel",)

    def __post_init__(self) -> None:
        object.__setattr__(self, "steps", FrozenMapping(self.steps))
        if not 0 < self.noise_std < math.inf:
            raise ProblemError(f"noise_std of the dial is {self.noise_std!r}", "Give a positive number of mm")
        if not 0 <= self.contact_std < math.inf:
            raise ProblemError(f"contact_std of the dial is {self.contact_std!r}", "Give zero or more mm")
        if self.sign not in (1, -1):
            raise ProblemError(f"sign of the dial is {self.sign!r}", "Give +1 (extends the tool) or -1 (shortens it)")
        object.__setattr__(self, "travel", plain(self.travel))
        ends = self.travel if isinstance(self.travel, tuple) else (0.0, self.travel)
        if len(ends) != 2 or not all(map(is_real, ends)) or not -math.inf < ends[0] < ends[1] < math.inf:
            fix = "Give a positive number of mm, or the smallest and the largest reading, such as (-5, 5)"
            raise ProblemError(f"travel of the dial is {self.travel!r}", fix)
        if not 0 < self.turn < math.inf:
            raise ProblemError(f"A turn of the pointer is {self.turn!r}", "Give what it shows, a positive number of mm")
        if (self.gain or self.cycle or self.zero_shift) and not self.reading:
            fix = "Leave them out, or declare reading=True"
            raise ProblemError("A touch without a dial has a gain, a cycle or a zero", fix)
        for label, step in self.steps.items():
            if step.on in self.steps or step.on == label:
                what = f"Step '{label}' is on '{step.on}', which is a step itself"
                raise ProblemError(what, "Name a face that is not a step")
            if not 0 < abs(step.height) < math.inf or not 0 < step.std < math.inf:
                raise ProblemError(f"Step '{label}' is {step.height!r} +- {step.std!r} mm", "Give its certified height")
        if self.steps and self.plane.per is None:
            raise ProblemError("The dial has steps but one plane for all labels", 'Declare plane=Plane(per="plane")')

    @property
    def columns(self) -> Mapping[str, Dimension]:
        """The reading, where there is one."""
        return {"reading": "length"} if self.reading else {}

    @property
    def refused_columns(self) -> Mapping[str, str]:
        """A reading, where the instrument is declared as contact only."""
        return {} if self.reading else {"reading": "the problem declares contact without a dial (reading=False)"}

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        """Tool point, plunger direction, plane, and the error of each step's certificate."""
        errors = {f"step_{i}": Parameter(0.0, prior_std=step.std) for i, step in enumerate(self.steps.values(), 1)}
        return {**self._of_dial, "plane": self.plane, **errors}

    @property
    def _of_dial(self) -> Mapping[str, Unknown]:
        every = {key: getattr(self, key) for key in ("tool", "plunger", "gain", "cycle", "zero_shift")}
        return {key: unknown for key, unknown in every.items() if unknown is not None}

    @property
    def known_columns(self) -> Mapping[str, Mapping[str, float]]:
        """Height of a row's face above its plane, and which step it is."""
        if not self.steps:
            return {}
        height = {"height": {label: step.height for label, step in self.steps.items()}}
        return height | {f"on_step_{i}": {label: 1.0} for i, label in enumerate(self.steps, 1)}

    def instance(self, key: str, label: str) -> str:
        """A step shares the plane of the face it stands on, and what else is of that face."""
        return self.steps[label].on if key not in self._of_dial and label in self.steps else label

    @property
    def column_stds(self) -> Mapping[str, float]:
        """Noise of the reading, mm."""
        return {"reading": self.noise_std} if self.reading else {}

    @property
    def residual_std(self) -> float:
        """Noise along the normal, mm."""
        return self.contact_std if self.reading else math.hypot(self.noise_std, self.contact_std)

    @property
    def words(self) -> Words:
        """Distances from planes."""
        trusted = "the dial's gain" if self.reading and self.gain is None else ""
        said = Words("distance from the planes", "mm", "planes", "planes fitted alone", trusted)
        return replace(said, approach=APPROACH) if self.reading else said

    @property
    def known_by(self) -> str:
        """The label of the faces."""
        return self.plane.per or "plane"

    groups = known_by

    @property
    def probe(self) -> Probe:
        """The plunger, or the tool that simply touches."""
        return Probe(
            noise_std=self.noise_std,
            contact_std=self.contact_std,
            column="reading" if self.reading else None,
            sign=self.sign,
            travel=self.travel,
            label=self.plane.per,
            moves=tuple(key for key in self._of_dial if key != "zero_shift"),
            steps=tuple(self.steps),
            turn=self.turn if self.reading else 0.0,
            zero=None if self.zero_shift is None else "zero_shift",
            zero_label=None if self.zero_shift is None else self.zero_shift.per,
        )

    @property
    def trusted(self) -> Mapping[str, Trusted]:
        """The dial's gain and the direction of its plunger, unless they are declared as unknowns."""
        if not self.reading:
            return {}
        words, cure = "the direction of the plunger", "plunger=Direction(...) in the problem"
        found = Trusted.held("plunger", self.plunger, words, PLUNGER_STD, cure=cure)
        if self.gain is None:
            words, cure = "the dial's gain", "a gauge block"
            found["gain"] = Trusted(words=words, std=GAIN_STD, unit="%", scales=("reading",), cure=cure)
        return found

    @property
    def suspects(self) -> tuple[Suspect, ...]:
        """A wrong sign first, then units."""
        if not self.reading:
            return ()
        cause = "a larger reading shortens the tool where the problem says it lengthens it, or the other way round"
        fix = f"Reverse the sign of the dial in the problem (--set sign={-self.sign} tries it)"
        return (Suspect("wrong dial sign", cause, fix, ("reading",), -1.0), *Suspect.units(self.columns))

    def with_faces_by_label(self) -> DialOnPlane | None:
        """A copy with a plane for each label; None where a further face needs a certified angle."""
        if self.probe.knows_angles:
            return None
        return self if self.plane.per is not None else replace(self, plane=replace(self.plane, per="plane"))

    def with_step(self, label: str, on: str, height: float) -> DialOnPlane | None:
        """A copy with one more step; None where the faces of a body have places of their own."""
        return None if self.probe.knows_angles else replace(self, steps={**self.steps, label: Step(on, height)})

    def plunger_direction(self, pose: Expression, p: Any) -> Expression:
        """The plunger, turned into the base frame."""
        return rotation(pose) @ p.plunger

    def tip(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Tip of the plunger (3, mm): the tool point, plus sign * reading along the plunger."""
        return transform_point(pose, p.tool + self.reach(p, row) * p.plunger)

    def reach(self, p: Any, row: Any) -> Expression:
        """True extension of the tip along the plunger, mm: sign * reading, corrected by the dial's gain and cycle."""
        way = shown = getattr(row, "reading", 0.0)
        if self.gain is not None:
            way = way + shown * p.gain / 100  # not in place: a row of numbers is the caller's
        if self.cycle is not None:
            angle = 2 * math.pi * shown / self.turn
            way = way + (p.cycle[0] * ca.cos(angle) + p.cycle[1] * ca.sin(angle)) / 1000
        return self.sign * way

    def shifted(self, normal: Expression, pose: Expression, p: Any) -> Expression:
        """Shift of the tip along a normal (3) since the dial was set to zero anew, mm.

        The tip itself is that of one zero, so that where others stand is no matter of the arm.
        """
        if self.zero_shift is None:
            return 0.0
        return self.sign * p.zero_shift * ca.dot(normal, self.plunger_direction(pose, p))

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Signed distance of the tip from the face, mm."""
        known = sum(getattr(row, f"on_step_{i}") * getattr(p, f"step_{i}") for i in range(1, len(self.steps) + 1))
        height = row.height if self.steps else 0.0
        return p.plane.distance(self.tip(pose, p, row)) - height - known + self.shifted(p.plane.normal, pose, p)

    def propose(self, key: str, sight: Sight) -> Array:
        """The plane that was touched, as `Sight.touched_plane` has it."""
        heights = sight.columns["height"] if self.steps else None
        return sight.touched_plane(heights) if key == "plane" else super().propose(key, sight)


@dataclass(frozen=True, kw_only=True)
class DialOnBody(DialOnPlane):
    """Faces of one body: their normals are known up to a common rotation, each face's place along its normal is not.

    Three unknowns for the body and one per face, instead of three per face. Angles fix shape, not size: for that a face
    must stand at a known distance from another one (`DialOnPlane.steps`).

    Args:
        normals: normal of each face in the body's own axes, out of the material, by label.
        body: orientation of the body in the base frame; proposed from the data when not given.
        offset: place of each face along its normal, mm.

    """

    normals: Mapping[str, Sequence[float]] = field(default_factory=dict)
    body: Frame = Frame(turns_only=True)
    offset: Parameter = Parameter(None, unit="mm", per="plane")

    datum = ("body", "offset")

    def __post_init__(self) -> None:
        super().__post_init__()
        triples = {label: tuple(float(value) for value in normal) for label, normal in self.normals.items()}
        object.__setattr__(self, "normals", FrozenMapping(triples))
        directions = np.array([unit_vector(n, f"The normal of '{label}'") for label, n in self.normals.items()])
        if len(directions) < 2 or np.linalg.matrix_rank(directions, tol=1e-3) < 2:
            raise ProblemError("The body has fewer than two directions of faces", "Give normals that are not parallel")
        if self.steps:
            raise ProblemError("A body with certified angles has steps", "Use DialOnPlane for the stepped faces")

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        """Tool point, plunger direction, orientation of the body, offset of each face."""
        return {**self._of_dial, "body": self.body, "offset": self.offset}

    @property
    def known_columns(self) -> Mapping[str, Mapping[str, float]]:
        """Components of the row's normal in the body's axes."""
        units = {label: unit_vector(n, "A normal") for label, n in self.normals.items()}
        return {f"n{axis}": {label: float(n[i]) for label, n in units.items()} for i, axis in enumerate("xyz")}

    @property
    def probe(self) -> Probe:
        """The dial's, on faces whose angles are known."""
        return replace(super().probe, label="plane", knows_angles=True)

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Signed distance of the tip from its face, mm."""
        normal = ca.mtimes(rotation(p.body), ca.vertcat(row.nx, row.ny, row.nz))
        return ca.dot(normal, self.tip(pose, p, row)) - p.offset + self.shifted(normal, pose, p)

    def propose(self, key: str, sight: Sight) -> Array:
        """Rotation that carries the certified normals to fitted ones; then the mean place of each face along its own.

        Raises ProblemError for rows whose label has no normal.
        """
        normals = np.column_stack([sight.columns[name] for name in ("nx", "ny", "nz")])
        if (np.linalg.norm(normals, axis=1) < 0.5).any():
            raise ProblemError("Some rows are labelled with a face that the body does not have", "Add its normal")
        if key == "body":
            distinct, which = np.unique(normals, axis=0, return_inverse=True)
            touched = [sight.touched_normal(which.ravel() == i) for i in range(len(distinct))]
            return Frame.encode(transform(rotation_between(distinct, np.array(touched))[0], np.zeros(3)))
        if key == "offset":
            normal = sight.touched_normal(np.ones(len(normals), dtype=bool))
            return np.array([float((normal * sight.tips).sum(1).mean())])
        return super().propose(key, sight)
