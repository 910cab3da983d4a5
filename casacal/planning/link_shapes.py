"""The shapes of an arm's links, as its URDF has them, as convex bodies, and the gap between them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.errors import ProblemError
from casacal.problem.cell import Face
from casacal.robots.files.urdf_links import LinkShape, shapes_of
from casacal.robots.joint_space import random_joints
from casacal.robots.links import Links
from casacal.robots.robot import Robot
from casacal.robots.urdf_chain import UrdfChain
from casacal.unknowns.fits import transform
from casacal.values import Value

SIDES = 8  # sides of the prism around a cylinder
SHORT = 1e-9  # length of a direction below which it is none: edges that are parallel


@dataclass(frozen=True, eq=False)
class Body:
    """A convex polyhedron in N postures, or in one, all around it as thick as `radius` (mm).

    corners (N, c, 3), normals of its faces (N, f, 3), directions of its edges (N, e, 3), in the base frame.
    """

    corners: Array
    normals: Array
    edges: Array
    radius: float = 0.0

    @staticmethod
    def box(pose: Array, size: Array) -> Body:
        """A box of three sides (mm) about a pose (4, 4)."""
        corners = np.array(list(product((-0.5, 0.5), repeat=3))) * size
        axes = np.eye(3)
        return Body(corners[None], axes[None], axes[None]).moved(pose[None])

    @staticmethod
    def cylinder(pose: Array, radius: float, length: float) -> Body:
        """A prism of eight sides around a cylinder about the z of a pose (4, 4)."""
        turn = (np.arange(SIDES) + 0.5) * 2 * math.pi / SIDES
        around = np.column_stack([np.cos(turn), np.sin(turn)]) * radius / math.cos(math.pi / SIDES)
        corners = np.vstack([np.column_stack([around, np.full(SIDES, z)]) for z in (-length / 2, length / 2)])
        up = np.array([[0.0, 0.0, 1.0]])
        flat = np.pad(np.diff(around[: SIDES // 2 + 1], axis=0), ((0, 0), (0, 1)))
        normals = np.cross(flat / np.linalg.norm(flat, axis=1, keepdims=True), up)
        return Body(corners[None], np.vstack([normals, up])[None], np.vstack([flat, up])[None]).moved(pose[None])

    @staticmethod
    def ball(centres: Array, radius: float) -> Body:
        """A ball about each of N points (N, 3)."""
        return Body(centres[:, None], np.zeros((1, 0, 3)), np.zeros((1, 0, 3)), radius)

    def moved(self, poses: Array) -> Body:
        """The same, moved by N poses (N, 4, 4)."""
        turns = poses[:, :3, :3].transpose(0, 2, 1)
        return replace(
            self,
            corners=self.corners @ turns + poses[:, None, :3, 3],
            normals=self.normals @ turns,
            edges=self.edges @ turns,
        )


def gap(one: Body, other: Body) -> Array:
    """How far two bodies are apart at least (N,), mm; not above zero where they meet."""
    crossed = np.cross(one.edges[:, :, None], other.edges[:, None])
    count = max(len(one.corners), len(other.corners))
    between = other.corners.mean(axis=1, keepdims=True) - one.corners.mean(axis=1, keepdims=True)
    parts = (one.normals, other.normals, crossed.reshape(len(crossed), -1, 3), between)
    axes = np.concatenate([np.broadcast_to(part, (count, *part.shape[1:])) for part in parts], axis=1)
    length = np.linalg.norm(axes, axis=2, keepdims=True)
    axes = axes / np.maximum(length, SHORT)
    mine, its = (axes @ body.corners.transpose(0, 2, 1) for body in (one, other))
    apart = np.maximum(mine.min(axis=2) - its.max(axis=2), its.min(axis=2) - mine.max(axis=2))
    apart = np.where(length[..., 0] > SHORT, apart, -np.inf)
    return np.asarray(apart.max(axis=1) - one.radius - other.radius)


FREE = 5.0  # distance that shapes keep, mm: arms err by some, and drawings of their shapes by more
THICK = 40.0  # thickness of what carries a face, mm
TOOL = 20.0  # distance from the tip, mm, within which a shape is the tool's, which may come near a face
POSTURES = 400  # random postures; two shapes that meet in all of them are drawn too large, or belong together


@dataclass(frozen=True, eq=False)
class LinkShapes(Value):
    """Boxes, cylinders and spheres that the links of an arm carry.

    shapes: of all links. unread: links of which the file has other shapes too, such as meshes, that are not looked at.
    """

    robot: Robot
    shapes: tuple[LinkShape, ...]
    unread: tuple[str, ...] = ()

    @staticmethod
    def of(robot: Robot) -> LinkShapes:
        """Of a robot that was read from a URDF.

        Raises ProblemError for any other, for a file that is there no more, and for shapes that are none.
        """
        arm = robot.arm
        if not isinstance(arm, UrdfChain):
            fix = "Give a link_radius"
            raise ProblemError(f"'{robot.name}' does not come from a URDF, so the shapes of its links are unknown", fix)
        shapes, unread = shapes_of(arm.path, arm.chain[0].parent, arm.chain[-1].child)
        return LinkShapes(robot, shapes, unread)

    @property
    def words(self) -> str:
        """What was looked at and what not, as a sentence; empty where the file has no shapes at all."""
        said = []
        if self.shapes:
            links = len({shape.link for shape in self.shapes})
            said.append(f"Kept {FREE:g} mm clear: {len(self.shapes)} shapes of {links} links, as the URDF has them.")
        if self.let_be:
            pairs = ", ".join(f"{one} and {other}" for one, other in self.let_be)
            said.append(f"Not checked against each other, because they touch in every posture: {pairs}.")
        if self.unread:
            said.append(
                f"Not checked: shapes of {', '.join(self.unread)} that are not boxes, cylinders or spheres, or move "
                f"with other joints; use --link-radius for all links."
            )
        return " ".join(said)

    def clear(self, boxes: tuple[Body, ...], faces: tuple[Face, ...], joints: Array, tips: Array) -> NDArray[np.bool_]:
        """Which postures (N, n; rad, mm), whose tips are at (N, 3), keep off boxes, faces and each other."""
        placed = self.at(joints)
        good = np.ones(len(joints), dtype=bool)
        plates = [  # what carries a face, whose top it is
            Body.box(
                transform(face.axes.T, np.asarray(face.centre) - THICK / 2 * face.axes[0]),
                np.array([THICK, *face.size]),
            )
            for face in faces
        ]
        last = len(self.robot.axes) - 1
        for shape, body in zip(self.shapes, placed, strict=True):
            if shape.carrier < 0:  # where the base stands nobody can change
                continue
            for box in boxes:
                good &= gap(body, box) > FREE
            tool = gap(body, Body.ball(tips, TOOL)) <= 0 if shape.carrier == last else np.zeros(len(joints), dtype=bool)
            for plate in plates:
                good &= tool | (gap(body, plate) > FREE)
        for one, other in self.pairs:
            good &= gap(placed[one], placed[other]) > FREE
        return good

    def above(self, table: float, joints: Array) -> NDArray[np.bool_]:
        """Which postures (N, n; rad, mm) hold all shapes beyond the first moving link above a table (height in mm)."""
        good = np.ones(len(joints), dtype=bool)
        for shape, body in zip(self.shapes, self.at(joints), strict=True):
            if shape.carrier > 0:
                good &= body.corners[..., 2].min(axis=1) - body.radius >= table
        return good

    def at(self, joints: Array) -> list[Body]:
        """Each shape in postures (N, n; rad, mm), in the base frame."""
        flat = np.array(self._motions.map(len(joints))(joints.T))  # (4, 4 n N): of each posture, of each link
        motions = flat.reshape(4, len(joints), -1, 4).transpose(1, 2, 0, 3)
        bodies = [(shape.carrier, _body(shape)) for shape in self.shapes]
        return [body if carrier < 0 else body.moved(motions[:, carrier]) for carrier, body in bodies]

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Shapes that could meet: not those of one link or of neighbours, nor those that meet wherever the arm is."""
        return self._pairs[0]

    @property
    def let_be(self) -> tuple[tuple[str, str], ...]:
        """Links, not neighbours, whose shapes meet wherever the arm is, and are not held against one another."""
        names = ((self.shapes[one].link, self.shapes[other].link) for one, other in self._pairs[1])
        return tuple(dict.fromkeys(names))

    @cached_property
    def _pairs(self) -> tuple[tuple[tuple[int, int], ...], tuple[tuple[int, int], ...]]:
        joints = random_joints(self.robot, POSTURES, np.random.default_rng(0))
        placed, meet, always = self.at(joints), list[tuple[int, int]](), list[tuple[int, int]]()
        for k, one in enumerate(self.shapes):
            for other in range(k + 1, len(self.shapes)):
                if abs(one.carrier - self.shapes[other].carrier) > 1:
                    apart = (gap(placed[k], placed[other]) > FREE).any()
                    (meet if apart else always).append((k, other))
        return tuple(meet), tuple(always)

    @cached_property
    def _motions(self) -> ca.Function:
        """q (n; rad, mm) -> how each link has moved (4, 4 n) from where it is at zero."""
        links, q = Links.of(self.robot), ca.SX.sym("q", len(self.robot.axes))
        model = q if links.conventions is None else links.conventions.to_model(q)
        return ca.Function("motions", [q], [ca.densify(ca.horzcat(*(ca.SX(each) for each in links.motions(model))))])


def _body(shape: LinkShape) -> Body:
    if shape.kind == "sphere":
        return Body.ball(shape.pose[None, :3, 3], shape.size[0])
    if shape.kind == "cylinder":
        return Body.cylinder(shape.pose, shape.size[0], shape.size[1])
    return Body.box(shape.pose, np.array(shape.size))
