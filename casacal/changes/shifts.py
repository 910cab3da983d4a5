"""What may have changed, as unknowns about zero that any robot and any instrument have: joints, tool, base.

A joint's zero is a shift of the value that the controller says, whatever the arm's own parameters are called.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casacal.binding.bound_problem import BoundProblem
from casacal.discrepancy.effect import Effect, Here, Site
from casacal.kinematics import Expression, Product, rotate_x, rotate_y, rotate_z, translate
from casacal.unknowns import Parameter

JOINTS, TOOL, TURN, BASE, BASE_TURN = "shift_q", "shift_tool", "shift_turn", "shift_base", "shift_base_turn"
"""Keys of the unknowns: joints as the controller counts them, tool and base in mm along and rad about their axes."""

WIDE = 10.0
"""Standard deviation that stands for nothing known; these unknowns are given priors by whoever uses them."""


@dataclass(frozen=True)
class Shifts(Effect):
    """Joints, tool and base that stand elsewhere than where they were calibrated."""

    size: float = WIDE
    doubt: float = 1.0

    moves = True
    key = "shift"
    words = "a change since the calibration"

    def unknowns(self, site: Site) -> Mapping[str, Parameter]:
        """Of every joint, and three places and three turns of tool and base."""
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
    """The same rows with these unknowns after all others; priors of effects are lost."""
    problem = bound.problem
    return bound.under(problem.with_effects(*problem.effects, Shifts()))


def shift_columns(shifted: BoundProblem, key: str) -> NDArray[np.intp]:
    """Positions in x of a key's unknowns."""
    slot = next(slot for slot in shifted.slots if slot.key == key and slot.beside == Shifts.key)
    return np.array(slot.columns, dtype=np.intp)


def _rigid(place: Expression, turn: Expression) -> Expression:
    factors = (translate(place[0], place[1], place[2]), rotate_x(turn[0]), rotate_y(turn[1]), rotate_z(turn[2]))
    return ca.mtimes([each.matrix if isinstance(each, Product) else ca.SX(each) for each in factors])
