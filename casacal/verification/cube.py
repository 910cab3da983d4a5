"""ISO 9283:1998, clause 6.8: poses and a straight path in a diagonal plane of a cube, as targets for the drawn arm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from casacal.deployment.compensate import Rounding
from casacal.deployment.inverse_kinematics import PosedArm
from casacal.errors import CasacalError, UnknownNameError
from casacal.files import MADE
from casacal.model.kinematics import quaternions_of
from casacal.model.problem import Problem
from casacal.model.robot import joint_units, random_joints
from casacal.planning.clearance import Around, Clearance
from casacal.simulation.cell import Disturbances
from casacal.values import Array, FrozenMapping, Index, Rows, Value, is_finite, read_only

CYCLE = "P5", "P4", "P3", "P2", "P1"  # order of a cycle, from P1 on (7.2.1)
CYCLES, PATH_CYCLES = 30, 10  # 6.9
FLANGE = "flange_qw", "flange_qx", "flange_qy", "flange_qz"
INSET = 0.1  # of the diagonal, between a corner and its pose (6.8.4)
PLANES = FrozenMapping({"x+": (1, 0), "x-": (-1, 0), "y+": (0, 1), "y-": (0, -1)})
"""The four diagonal planes that hold horizontal edges (6.8.3), by where their upward normals lean."""
ROUND = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2  # corners of the plane: by its level edge, by its slope
STOPS = 11  # normal planes in which the path is judged
LEAD = 0.02  # of the diagonal: the path begins and ends so far outside the part that is judged (8.2)
SPINS = np.arange(4) * math.pi / 2  # turns of the tool about the plane's normal that are tried
BANK, STARTS = 4096, 6  # random postures, and how many of them lead to the centre of a given cube
GRID, LEADERS, FINEST = 5, 4, 0.03  # places along an axis where cubes are sought, those kept; last step over the reach
GROWTH = np.arange(0.1, 1.6, 0.1)  # sides of a cube, over the reach
LEAST_STEPS = np.linspace(0.1, 1, 10)
NEAR = 0.5  # rad; joint motion while a cube grows by a step beyond which the arm has changed its posture


@dataclass(frozen=True, eq=False)
class CubePlan(Value):
    """Poses P1 to P5 and stops L0 to L12 of the path from P2 to P4, in the order of `names`.

    centre (3,; mm, base frame) and side (mm) of the cube; plane: which way its diagonal plane's normal leans. tips
    (N, 3; mm): where the measured point is to be; tool (3,; mm): that point in the flange frame. poses (N, 4, 4; mm):
    of the flange, its z axis into the plane. joints (N, n; rad, mm): of the arm as drawn; turns (n,): which of them
    turn. words: what was looked at.
    """

    names: tuple[str, ...]
    centre: Array
    side: float
    plane: str
    tool: Array
    joints: Array
    poses: Array
    tips: Array
    turns: tuple[bool, ...]
    words: str

    def text(self) -> str:
        """CSV of joint targets, as `compensate` and `predict` take them, with commanded points and poses of the flange.

        The poses' columns begin with flange_, so that nobody takes them for those of the tip.
        """
        (x, y, z), (a, b, c) = self.centre, self.tool
        names = [f"q{k}_{'deg' if turn else 'mm'}" for k, turn in enumerate(self.turns, 1)]
        names += [*["tip_x_mm", "tip_y_mm", "tip_z_mm", "flange_x_mm", "flange_y_mm", "flange_z_mm"], *FLANGE]
        lines = [
            f"# {MADE}: ISO 9283 cube of {self.side:g} mm about {x:g}, {y:g}, {z:g} mm, plane {self.plane}, measured "
            f"point {a:g}, {b:g}, {c:g} mm in the flange frame",
            f"# {CYCLES} cycles {', '.join(CYCLE)} from P1 on; {PATH_CYCLES} of the line L0 to L{STOPS + 1}",
            ",".join(["point", *names]),
        ]
        places, quaternions = self.poses[:, :3, 3], quaternions_of(self.poses[:, :3, :3])
        joints = self.joints * np.where(self.turns, 180 / math.pi, 1.0)
        for name, *row in zip(self.names, joints, self.tips, places, quaternions, strict=True):
            digits = zip(row, (7, 6, 6, 12), strict=True)
            lines.append(",".join([name, *(f"{value:.{k}f}" for values, k in digits for value in values)]))
        return "\n".join(lines) + "\n"

    def sheet_text(self) -> str:
        """CSV to fill in: a line for each measurement, of cycles of poses and of the path; lines may stay empty."""
        path = [name for name in self.names if name.startswith("L")]
        lines = [f"# {MADE}: to be filled in", "cycle,point,x_mm,y_mm,z_mm"]
        for cycles, points in ((CYCLES, CYCLE), (PATH_CYCLES, path)):
            lines += [f"{k},{name},,," for k in range(1, cycles + 1) for name in points]
        return "\n".join(lines) + "\n"


def plan_cube(
    problem: Problem,
    *,
    centre: Sequence[float] | None = None,
    side: float | None = None,
    plane: str | None = None,
    tool: Sequence[float] | None = None,
    cell: Disturbances | None = None,
    clearance: Clearance | None = None,
) -> CubePlan:
    """Poses and path of ISO 9283 for the arm as drawn, in one posture of the arm and one orientation of the tool.

    The cube's edges are parallel to those of the base. P1 is its centre, P2 to P5 lie 10 % of the diagonal from the
    corners of a diagonal plane (6.8.4), the path is 80 % of the diagonal, from P2 to P4 (6.8.6).

    Args:
        problem: the arm with its instrument.
        centre, side: the cube, mm; by default about the largest that the arm reaches with all eight corners. Of a given
            one the arm must reach poses and path.
        plane: "x+", "x-", "y+" or "y-"; by default what gives the largest cube, or reaches the given one.
        tool: the measured point in the flange frame, mm; by default the instrument's tip as it is declared.
        cell: table, faces and boxes of which arm and tool keep clear; by default a table at z = 0.
        clearance: further boxes, and how thick the links are.

    Raises CasacalError for a cube out of reach, for half of a cube, and for arms of fewer than six joints.

    """
    if len(problem.robot.axes) < 6:
        what = f"{problem.robot.name} has {len(problem.robot.axes)} joints: no orientation can be asked of it"
        raise CasacalError(what, "List points of your own: a CSV with the columns point,x_mm,y_mm,z_mm and P1 to P5")
    if plane is not None and plane not in PLANES:
        raise UnknownNameError("plane", str(plane), PLANES)
    if (centre is None) != (side is None):
        raise CasacalError("A cube is given by centre and side", "Give both, or neither for the largest one")
    search = _CubeSearch.of(problem, tool, (clearance or Clearance()).around(problem.robot, cell or Disturbances()))
    if centre is None or side is None:
        place, side, turn, plane, start = search.largest(plane)
    else:
        place = _vector(centre, "centre of the cube")
        if not (is_finite(side) and 10 <= side <= 1e5):
            raise CasacalError(f"The side of the cube is {side!r} mm", "Give mm: 0.4 m are 400")
        turn, plane, start = search.fitting(place, float(side), plane)
    size, found = search.grown(place[None], turn[None], start[None], _visited(), side * LEAST_STEPS)
    side, joints = float(size[0]), Rounding()(search.arm, found[0])
    origins, turns, _ = search.arm(joints)
    poses = np.tile(np.eye(4), (len(joints), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turns, origins
    names = ("P1", "P2", "P3", "P4", "P5", *(f"L{k}" for k in range(STOPS + 2)))
    tips, revolute = origins + turns @ search.tool, tuple(map(bool, problem.robot.revolute))
    place, point, joints, poses, tips = map(read_only, (place, search.tool, joints, poses, tips))
    return CubePlan(names, place, side, plane, point, joints, poses, tips, revolute, search.around.words)


def _visited() -> Array:
    """P1 to P5 and the stops of the path (18, 3) in a cube of side 1: along the plane's level edge, slope, normal."""
    corners = np.column_stack([ROUND * [1, math.sqrt(2)], np.zeros(4)])
    along = np.array([INSET - LEAD, *np.linspace(INSET, 1 - INSET, STOPS), 1 - INSET + LEAD])[:, None]
    path = corners[0] + along * (corners[2] - corners[0])
    return np.vstack([np.zeros(3), corners * (1 - 2 * INSET), path])


def _vector(values: Sequence[float], what: str) -> Array:
    """Three finite numbers; raises CasacalError."""
    if np.shape(values) != (3,) or not all(map(is_finite, values)):
        raise CasacalError(f"The {what} is {values!r}", "Give three numbers of mm")
    return np.array(values, dtype=np.float64)


def _frames(planes: Sequence[str]) -> tuple[Array, list[str]]:
    """Rotations (k, 3, 3) of a flange whose z axis points down into a plane, by its spin; and the plane of each."""
    found, names = list[Array](), list[str]()
    for name in planes:
        normal = np.array([*PLANES[name], 1]) / math.sqrt(2)
        level = np.cross([0, 0, 1], normal) * math.sqrt(2)
        for spin in SPINS:
            x = math.cos(spin) * level + math.sin(spin) * np.cross(normal, level)
            found.append(np.column_stack([x, np.cross(-normal, x), -normal]))
            names.append(name)
    return np.array(found), names


@dataclass(frozen=True, eq=False)
class _CubeSearch:
    """The drawn arm, its measured point in the flange frame (3,; mm), what stands around, and clear postures (m, n)."""

    arm: PosedArm
    tool: Array
    around: Around
    bank: Array

    @staticmethod
    def of(problem: Problem, tool: Sequence[float] | None, around: Around) -> _CubeSearch:
        drawn, rng = problem.without_terms, np.random.default_rng(0)
        unknowns = [drawn.symbols.unknowns[key] for key in drawn.model.constants]
        known = [np.zeros(each.nominal_size) if each.nominal is None else np.ravel(each.nominal) for each in unknowns]
        local, constants = np.zeros(drawn.model.pose.numel_in(0)), np.concatenate([np.zeros(0), *known])
        arm, bank = PosedArm.of(drawn, local, "flange", constants), random_joints(drawn.robot, BANK, rng)
        middle = np.mean(drawn.robot.limits, axis=0)
        bank -= math.tau * drawn.robot.revolute * np.round((bank - middle) / math.tau)
        place, turn, _ = arm(bank)
        if tool is None:
            tip = PosedArm.of(drawn, local, "tip", constants)(bank[:1])[0]
            tool = (turn[0].T @ (tip[0] - place[0])).round(9) + 0.0
            if not np.isfinite(tool).all():
                raise CasacalError("The problem does not say where the measured point is", "Give it: --tool X,Y,Z, mm")
        point = _vector(tool, "measured point")
        if 0 < np.linalg.norm(point) < 1:
            raise CasacalError(f"The measured point is {tuple(point.tolist())} mm", "Give mm: 0.15 m are 150")
        clear = around.clear(bank, place + turn @ point)
        if not clear.any():
            raise CasacalError("The arm keeps clear in none of its postures", "Look at table, boxes and link radius")
        return _CubeSearch(arm, point, around, bank[clear])

    def taken(self, joints: Array, tips: Array, turns: Array) -> Rows:
        """Which postures (N, n) bring the tool to tips (N, 3) and turns (N, 3, 3) and keep clear."""
        return self.arm.takes(joints, tips - turns @ self.tool, turns) & self.around.clear(joints, tips)

    def starts(self, tips: Array, turns: Array, count: int = STARTS) -> tuple[Array, Index]:
        """Postures (M, n) that bring the tool to tips (N, 3) and turns (N, 3, 3), and of which row each is (M,)."""
        from scipy.spatial import KDTree

        place, turn, _ = self.arm(self.bank)
        where = np.hstack([(place + turn @ self.tool) / 300, turn.reshape(-1, 9)])
        near = KDTree(where).query(np.hstack([tips / 300, turns.reshape(-1, 9)]), k=min(count, len(where)))[1]
        near = near.reshape(len(tips), -1)
        rows = np.repeat(np.arange(len(tips)), near.shape[1])
        joints = self.arm.reach(tips[rows] - turns[rows] @ self.tool, turns[rows], self.bank[near.ravel()], steps=16)
        good = self.taken(joints, tips[rows], turns[rows])
        return joints[good], rows[good]

    def grown(self, centres: Array, turns: Array, starts: Array, points: Array, sides: Array) -> tuple[Array, Array]:
        """Largest of rising sides (M,; 0 for none) to which cubes grow from postures in their centres.

        points (k, 3) in a cube of side 1; also the joint values (M, k, n) there.
        """
        count = len(points)
        joints, size = np.repeat(starts[:, None], count, axis=1), np.zeros(len(starts))
        normal = -turns[:, :, 2]
        level = np.cross([0, 0, 1], normal)
        level /= np.linalg.norm(level, axis=1, keepdims=True)
        axes = np.stack([level, np.cross(normal, level), normal], axis=1)
        rows = np.arange(len(starts))
        for side in sides:
            if not rows.size:
                break
            tips = (centres[rows, None] + side * (points @ axes[rows])).reshape(-1, 3)
            turn = np.repeat(turns[rows], count, axis=0)
            last = joints[rows].reshape(-1, joints.shape[2])
            trial = self.arm.reach(tips - turn @ self.tool, turn, last, steps=20)
            near = np.abs((trial - last) / joint_units(self.arm.robot)).max(axis=1) < NEAR
            good = (near & self.taken(trial, tips, turn)).reshape(-1, count).all(axis=1)
            rows = rows[good]
            joints[rows], size[rows] = trial.reshape(-1, count, joints.shape[2])[good], side
        return size, joints

    def fitting(self, centre: Array, side: float, plane: str | None) -> tuple[Array, str, Array]:
        """Orientation (3, 3), plane and posture (n,) in the centre of a cube whose poses and path are reached."""
        turns, planes = _frames([plane] if plane else list(PLANES))
        starts, rows = self.starts(np.tile(centre, (len(turns), 1)), turns)
        size, joints = self.grown(np.tile(centre, (len(rows), 1)), turns[rows], starts, _visited(), side * LEAST_STEPS)
        if not (full := np.flatnonzero(size == side)).size:
            most = f"up to a side of {size.max():.0f} mm" if size.any() else "not even its centre"
            x, y, z = centre
            what = f"Of the cube of {side:g} mm about {x:g}, {y:g}, {z:g} mm the arm reaches {most}"
            raise CasacalError(what, "Move it or make it smaller, or leave centre and side out for the largest")
        way = np.abs(np.ptp(joints[full], axis=1) / joint_units(self.arm.robot)).max(axis=1)
        best = full[np.argmin(way)]
        return turns[rows[best]], planes[rows[best]], starts[best]

    def largest(self, plane: str | None) -> tuple[Array, float, Array, str, Array]:
        """Centre (3,), side, orientation (3, 3), plane and posture (n,) of about the largest cube."""
        turns, planes = _frames([plane] if plane else list(PLANES))
        places, bank_turns, _ = self.arm(self.bank)
        tips = places + bank_turns @ self.tool
        low, high = tips.min(axis=0), tips.max(axis=0)
        reach = float((high - low).max()) / 2
        ticks = np.linspace(low, high, GRID + 2)[1:-1]
        grid = np.stack(np.meshgrid(*ticks.T, indexing="ij"), axis=-1).reshape(-1, 3).round()
        corners = np.vstack([ROUND[:, [0, 1, 1]] * [1, math.sqrt(2), 0], ROUND[:, [0, 1, 1]] * [1, 0, math.sqrt(2)]])
        frame = np.tile(np.arange(len(turns)), len(grid))
        starts, rows = self.starts(np.repeat(grid, len(turns), axis=0), turns[frame], 1)
        centres, frame = np.repeat(grid, len(turns), axis=0)[rows], frame[rows]
        sides, step, best = np.floor(reach * GROWTH), reach / GRID, 0.0
        shifts = np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
        while step > FINEST * reach:
            size, _ = self.grown(centres, turns[frame], starts, corners, sides)
            order = np.lexsort((centres[:, 0], size))[::-1][:LEADERS]
            if not size[order[0]]:
                raise CasacalError("The arm takes no cube in one posture", "Look at joint limits, table and boxes")
            centres, frame, starts, size = centres[order], frame[order], starts[order], size[order]
            found = centres[0], float(size[0]), turns[frame[0]], planes[frame[0]], starts[0]
            step, best = (step if size[0] > best else step / 2), float(size[0])
            sides = np.append(sides[sides < best], np.floor(best * np.linspace(1, 1.2, 9)))
            moved = (centres[:, None] + step * shifts).round().reshape(-1, 3)
            frame, starts = np.repeat(frame, len(shifts)), np.repeat(starts, len(shifts), axis=0)
            starts = self.arm.reach(moved - turns[frame] @ self.tool, turns[frame], starts, steps=20)
            good = self.taken(starts, moved, turns[frame])
            centres, frame, starts = moved[good], frame[good], starts[good]
        return found
