"""A dial indicator on faces whose angles to each other are certified, such as those of a square or a cube."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.instruments.description import Probe, Sight
from casacal.instruments.dial_on_plane import DialOnPlane
from casacal.kinematics import Expression, rotation
from casacal.unknowns import Frame, Parameter, Unknown
from casacal.unknowns.fits import rotation_between, transform
from casacal.unknowns.unknown import unit_vector
from casacal.values import FrozenMapping


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
        own = {"body": self.body, "offset": self.offset}
        return {"tool": self.tool, "plunger": self.plunger, **self.own_errors, **self.zero_shifts, **own}

    @property
    def known_columns(self) -> Mapping[str, Mapping[str, float]]:
        """Components of the row's normal in the body's axes."""
        units = {label: unit_vector(n, "A normal") for label, n in self.normals.items()}
        return {f"n{axis}": {label: float(n[i]) for label, n in units.items()} for i, axis in enumerate("xyz")}

    @property
    def probe(self) -> Probe:
        """The dial's, on faces whose angles are known."""
        return replace(super().probe, label="plane", knows_angles=True)

    def with_faces_by_label(self) -> None:
        """None: a further face needs a certified angle."""
        return

    def with_step(self, label: str, on: str, height: float) -> None:
        """None: the faces of a body have places of their own."""
        del label, on, height

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
            seen = [sight.touched_normal(which.ravel() == i) for i in range(len(distinct))]
            return Frame.encode(transform(rotation_between(distinct, np.array(seen))[0], np.zeros(3)))
        if key == "offset":
            normal = sight.touched_normal(np.ones(len(normals), dtype=bool))
            return np.array([float((normal * sight.tips).sum(1).mean())])
        return super().propose(key, sight)
