"""Joints, tool and base that stand elsewhere than where they were calibrated, as unknowns and as moves of the arm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.kinematics import Expression, Product, rotate_x, rotate_y, rotate_z, translate
from casacal.problem.term import Here, Site, Term
from casacal.uncertainty.workspace import workspace_joints
from casacal.unknowns import Parameter

JOINTS, TOOL, TURN, BASE, BASE_TURN = "shift_q", "shift_tool", "shift_turn", "shift_base", "shift_base_turn"
"""Keys of the unknowns: joints as the controller counts them, tool and base in mm along and rad about their axes."""

WIDE = 10.0  # standard deviation that stands for nothing known; these unknowns are given priors by whoever uses them


@dataclass(frozen=True)
class Shifts(Term):
    """Joints, tool and base that stand elsewhere than where they were calibrated."""

    size: float = WIDE

    moves = True
    key = "shift"
    words = "a change since the calibration"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Coordinates of a shift: one per joint, and three translations and three rotations of tool and base."""
        each = [0.0] * len(site.robot.axes)
        found = {JOINTS: Parameter(each, unit="rad", prior_std=self.size)}
        for key, unit in ((TOOL, "mm"), (TURN, "rad"), (BASE, "mm"), (BASE_TURN, "rad")):
            found[key] = Parameter([0.0, 0.0, 0.0], unit=unit, prior_std=self.size)
        return found

    def joints(self, here: Here) -> Expression:
        """The shifts themselves."""
        return ca.SX(getattr(here.p, JOINTS))

    def pose(self, here: Here) -> Expression:
        """The flange as base and tool carry it: base pose tool."""
        matrix = here.pose.matrix if isinstance(here.pose, Product) else ca.SX(here.pose)
        base = _rigid(getattr(here.p, BASE), getattr(here.p, BASE_TURN))
        return ca.mtimes([base, matrix, _rigid(getattr(here.p, TOOL), getattr(here.p, TURN))])


def with_shifts(bound: BoundProblem) -> BoundProblem:
    """The rows with the shifts as further unknowns after all others; priors of terms are lost."""
    problem = bound.problem
    return bound.under(problem.with_terms(*problem.terms, Shifts()))


def shift_columns(shifted: BoundProblem, key: str) -> NDArray[np.intp]:
    """Positions in x of a key's unknowns."""
    slot = next(slot for slot in shifted.slots if slot.key == key and slot.beside == Shifts.key)
    return np.array(slot.columns, dtype=np.intp)


def _rigid(place: Expression, turn: Expression) -> Expression:
    factors = (translate(place[0], place[1], place[2]), rotate_x(turn[0]), rotate_y(turn[1]), rotate_z(turn[2]))
    return ca.mtimes([each.matrix if isinstance(each, Product) else ca.SX(each) for each in factors])


SAME = 1e-6  # part of the motion of tip and flange by a joint that the arm's unknowns may fail to follow
POSES = 60  # postures at which these motions are compared


def joint_direction(shifted: BoundProblem, x: Array, column: int, arm: NDArray[np.bool_]) -> Array | None:
    """Direction (n,) in the arm's unknowns that does what one unit of a joint's shift does; None where there is none.

    One number of the arm where one does it, as an offset of a DH table; else the least of several, in their priors.
    shifted: rows bound with shifts. x (n,): where everything stands; column: the joint's shift in it. arm: which
    unknowns (n,) are the arm's.
    """
    joints = workspace_joints(shifted.problem.robot, poses=POSES)
    block, columns = shifted.blocks[0], shifted.blocks[0].columns[0]
    field = np.zeros((6 * len(joints), shifted.unknowns))
    motions = (block.posture(what, x, joints)[1] for what in ("tip_jacobian", "flange_jacobian"))
    field[:, columns] = np.vstack([motion.reshape(3 * len(joints), -1) for motion in motions])
    wanted, own = field[:, column], np.flatnonzero(arm)
    size = float(np.linalg.norm(wanted))
    if not size:
        return None
    squares = (field[:, own] ** 2).sum(axis=0)
    times = np.divide(field[:, own].T @ wanted, squares, out=np.zeros(own.size), where=squares > 0)
    misses = np.linalg.norm(wanted[:, None] - field[:, own] * times, axis=0)
    found, best = np.zeros(shifted.unknowns), int(misses.argmin())
    if misses[best] <= SAME * size:
        found[own[best]] = times[best]
        return found
    scale = shifted.start_std[own]
    moves = np.linalg.lstsq(field[:, own] * scale, wanted, rcond=1e-10)[0] * scale
    if np.linalg.norm(wanted - field[:, own] @ moves) > SAME * size:
        return None
    found[own] = moves
    return found
