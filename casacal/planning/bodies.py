"""Convex bodies and the gap between them: separating axes (Gottschalk, Lin and Manocha, OBBTree, 1996).

Two convex bodies are apart if and only if their shadows on some direction are, and for polyhedra it is enough to try
the normals of their faces and the products of their edges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from casacal.array_types import Array

SIDES = 8
"""Sides of the prism around a cylinder."""

SHORT = 1e-9
"""Length of a direction below which it is none: edges that are parallel."""


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
