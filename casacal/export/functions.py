"""The calibrated arm as CasADi functions, for optimal control, code generation and whatever else takes them."""

from __future__ import annotations

from typing import Literal

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.compensation.arm import CalibratedArm, arm_values, as_used, local_coordinates, row_constants
from casacal.compensation.result_file import arm_from
from casacal.errors import CasacalError


def pose_function(arm: CalibratedArm, *, nominal: bool = False, free: bool = False) -> ca.Function:
    """Function q (n; rad, mm) -> flange pose (4x4; mm) of an arm as calibrated.

    Args:
        arm: what was calibrated.
        nominal: as drawn in place of as calibrated.
        free: the robot's parameters are inputs too, by name and before q; `values_of` gives what they are. Effects
            beside the geometry are then no part of it.

    Raises CasacalError when both nominal and free are asked for.

    """
    _check(nominal, free)
    arm = arm_from(arm)
    problem = arm.source.problem
    if free:
        return problem.symbols_of(0).value_functions["pose"]
    q = ca.SX.sym("q", len(problem.robot.axes))
    pose = ca.SX(problem.robot.pose(arm_values(arm, nominal=True), q)) if nominal else pose_at(arm, q)
    return ca.Function("pose", [q], [ca.densify(each) for each in ca.cse([pose])], ["q"], ["pose"])


def pose_at(arm: CalibratedArm, q: ca.SX) -> ca.SX:
    """Flange pose (4x4; mm) of an arm as calibrated at joint values (n; rad, mm), corrected effects included."""
    problem = as_used(arm)
    if not problem.effects:
        return ca.SX(problem.robot.pose(arm_values(arm), q))
    symbols = problem.symbols
    d = ca.vertcat(q, ca.DM.zeros(len(symbols.columns)))
    z = ca.DM(local_coordinates(arm, of=problem))
    return ca.reshape(symbols.functions["pose"](z, ca.DM(row_constants(arm, problem)), d), 4, 4)


def tip_function(arm: CalibratedArm, *, nominal: bool = False, free: bool = False) -> ca.Function:
    """Function q (n; rad, mm) -> tip (3; mm), where the instrument touches at reading zero.

    nominal, errors: as for `pose_function`; ProblemError where there are several instruments. free: what the tip
    depends on of the robot's parameters, the instrument's unknowns and the columns are inputs too, by name.
    """
    _check(nominal, free)
    arm = arm_from(arm)
    if free:
        return arm.source.problem.without_effects.symbols.value_functions["tip"]
    problem = arm.source.problem.without_effects if nominal else as_used(arm)
    symbols = problem.symbols
    q, z = ca.SX.sym("q", symbols.q.numel()), local_coordinates(arm, nominal=nominal, of=problem)
    d = ca.vertcat(q, ca.DM.zeros(len(symbols.columns)))
    tip = symbols.functions["tip"](z, ca.DM(row_constants(arm, problem)), d)
    return ca.Function("tip", [q], [ca.densify(each) for each in ca.cse([tip])], ["q"], ["tip"])


def values_of(
    arm: CalibratedArm, *, frame: Literal["flange", "tip"] = "flange", nominal: bool = False
) -> dict[str, Array]:
    """Values by name for the parameters that are free in `pose_function` or, with frame "tip", in `tip_function`.

    Numbers are (n,), frames (4, 4); mm and rad. Raises CasacalError where the tip depends on what differs by label.
    """
    arm = arm_from(arm)
    problem = arm.source.problem
    if frame == "flange":
        known = arm_values(arm, nominal=nominal)
        unknowns = problem.robot.parameters
        return {key: _array(ca.DM(unknown.packed(getattr(known, key)))) for key, unknown in unknowns.items()}
    symbols = problem.without_effects.symbols
    wanted = [key for key in symbols.value_functions["tip"].name_in() if key in symbols.unknowns]
    if unsure := set(wanted) & set(symbols.constants):
        raise CasacalError(
            f"The tip depends on '{sorted(unsure)[0]}', which the samples propose or which differs by label",
            "Use tip_function() without free",
        )
    packed = [ca.SX(symbols.unknowns[key].packed(getattr(symbols.p, key))) for key in wanted]
    found = ca.Function("values", [symbols.z], packed).call([ca.DM(local_coordinates(arm, nominal=nominal))])
    return {key: _array(matrix) for key, matrix in zip(wanted, found, strict=True)}


def _check(nominal: bool, free: bool) -> None:
    if nominal and free:
        raise CasacalError("Free parameters are neither nominal nor calibrated", "Leave out nominal or free")


def _array(matrix: ca.DM) -> Array:
    dense = np.asarray(ca.densify(matrix), dtype=np.float64)
    return dense.ravel() if dense.shape[1] == 1 else dense
