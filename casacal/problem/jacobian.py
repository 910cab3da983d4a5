"""Where the Jacobian is made: slopes of residual and tip by the unknowns, and the noise that slopes carry.

The paper derives them by hand to first order: the error of a link in eqs (3) and (4) of arXiv:2208.02652, that of the
tip, J, in (5), and the row of the identification matrix that a touch of a plane makes of it in (7) to (9). Here
automatic differentiation of the symbolic graph takes the place of all of these. It is exact for any convention and any
instrument, and at any estimate rather than at the drawing alone, so that errata E6 to E8 cannot arise.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from casacal.discrepancy.gears import per_radian
from casacal.errors import ProblemError
from casacal.instruments import Instrument
from casacal.robots.robot import Robot


def residual_jacobian(residual: ca.SX, z: ca.SX) -> ca.SX:
    """de/dz (m, nz) of a residual e (m): the identification Jacobian, eqs (7)-(9) of arXiv:2208.02652."""
    return ca.jacobian(residual, z)


def position_jacobian(point: ca.SX, z: ca.SX) -> ca.SX:
    """dP/dz (3, nz) of a point P (3, mm), the tip's or the flange's: the J of eqs (3)-(5) of arXiv:2208.02652."""
    return ca.jacobian(point, z)


def residual_noise(
    robot: Robot, instrument: Instrument, residual: ca.SX, q: ca.SX, columns: Mapping[str, ca.SX]
) -> ca.SX:
    """Standard deviation (m) of the residual: errors of joints and columns, carried by its slope, beside its own."""
    variance: ca.SX = ca.vertcat(*own_variances(instrument, residual.numel(), columns))
    for name, std in instrument.column_stds.items():
        variance += (ca.jacobian(residual, columns[name]) * std) ** 2
    for j, joint in enumerate(robot.axes):
        if joint.repeatability_std > 0:
            variance += (ca.jacobian(residual, q[j]) * joint.repeatability_std) ** 2
    return ca.SX(ca.sqrt(variance))


def own_variances(instrument: Instrument, components: int, columns: Mapping[str, ca.SX]) -> list[Any]:
    """Variance of each component of a residual by itself, as the instrument declares it: a number or from a column.

    Raises ProblemError where its blocks are not those of its residual.
    """
    if not instrument.blocks:
        return [ca.SX(instrument.residual_std**2)] * components
    name, total = type(instrument).__name__, sum(block.size for block in instrument.blocks)
    if total != components:
        fix = "Give each component a block"
        raise ProblemError(f"The blocks of {name} hold {total} residuals, and it has {components}", fix)
    found: list[Any] = []
    for block in instrument.blocks:
        if isinstance(block.std, str) and block.std not in columns:
            raise ProblemError(
                f"The noise of '{block.name}' of {name} is said to stand in the column '{block.std}', which it does "
                "not read",
                f"Its columns: {', '.join(columns) or 'none'}",
            )
        std = columns[block.std] if isinstance(block.std, str) else ca.SX(block.std)
        found += [std**2] * block.size
    return found


def joint_noise(robot: Robot, residual: ca.SX, q: ca.SX) -> ca.SX:
    """Standard deviation (m) of the residual where every joint errs on its own, by a radian or what counts as one."""
    slopes = ca.jacobian(residual, q) @ ca.diag(ca.DM(per_radian(robot)))
    return ca.sqrt(ca.sum2(slopes**2))
