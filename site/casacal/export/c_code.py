"""The calibrated arm as C."""

from __future__ import annotations

import re

import casadi as ca
import numpy as np

from casacal.compensation.arm import CalibratedArm
from casacal.compensation.result_file import arm_from
from casacal.errors import CasacalError
from casacal.export.functions import inputs_of, pose_at, told_names
from casacal.export.remark import remark

LEVER = 300.0  # millimetres that weigh as much as one radian in a step

HEAD = """/*
{remarks}
 *
 * {name}: {count} joints, in rad (sliding ones mm), as the controller shows them; lengths in mm.
 * Matrices are row by row. The base frame is that of the model. C99; needs math.h alone.
 *{means}
 * void {prefix}_pose(const double q[{count}],{also} double pose[16]);
 *     flange pose, 4 x 4
 * void {prefix}_jacobian(const double q[{count}],{also} double jacobian[{size}]);
 *     6 x {count}: velocity of the flange's origin (mm), then angular velocity (rad), in the base frame, by each joint
 * void {prefix}_step(const double q[{count}],{also} const double target[16], double damping, double next[{count}],
 *                    double error[6]);
 *     one damped least-squares step towards a pose, next = q + J' (J J' + damping^2 I)^-1 error, in which a radian of
 *     turn weighs as {lever:g} mm; damping in mm, such as 1; error: what is missing at q, mm and rad. Repeat until it
 *     is small, and mind the joint limits: they are not known here.
 */
"""

WRAPPERS = """
void {prefix}_pose(const double q[{count}],{also} double pose[16]) {{
  const double* arg[{args}] = {{q{pass_on}}};
  double* res[{results}] = {{pose}};
  {prefix}_pose_raw(arg, res, 0, 0, 0);
}}

void {prefix}_jacobian(const double q[{count}],{also} double jacobian[{size}]) {{
  const double* arg[{args}] = {{q{pass_on}}};
  double* res[{results}] = {{jacobian}};
  {prefix}_jacobian_raw(arg, res, 0, 0, 0);
}}

void {prefix}_step(const double q[{count}],{also} const double target[16], double damping, double next[{count}],
    double error[6]) {{
  const double* arg[{args}] = {{q{pass_on}, target, &damping}};
  double* res[{results}] = {{next, error}};
  {prefix}_step_raw(arg, res, 0, 0, 0);
}}
"""


def c_text(result: CalibratedArm, *, prefix: str | None = None) -> str:
    """Self-contained C99 of the calibrated forward kinematics, its Jacobian and a damped step; see its head comment.

    `prefix` begins the names of the functions; by default the problem's name. Raises CasacalError where it is no C
    name.
    """
    result = arm_from(result)
    if prefix is None:
        plain = re.sub(r"[\W_]+", "_", result.source.name, flags=re.ASCII).strip("_")
        prefix = plain if plain[:1].isalpha() else f"arm_{plain}".rstrip("_")
    if not ca.Function.check_name(f"{prefix}_pose"):
        fix = "Give a prefix of letters, digits and _"
        raise CasacalError(f"'{prefix}' cannot begin the name of a C function", fix)
    functions = c_functions(result, prefix)
    generator = ca.CodeGenerator(f"{prefix}_code", {"with_header": False})
    for function in functions:
        generator.add(function)
    count, told = functions[0].numel_in(0), len(told_names(result))
    values = {
        "prefix": prefix,
        "count": count,
        "size": 6 * count,
        "args": max(f.sz_arg() for f in functions),
        "results": max(f.sz_res() for f in functions),
        "lever": LEVER,
        "name": _comment(result.source.problem.robot.name),
        "also": f" const double told[{told}]," if told else "",
        "means": "" if not told else f" told: {_comment(', '.join(told_names(result)))}, as in the samples.\n *",
        "pass_on": ", told" if told else "",
        "remarks": "\n".join(f" * {_comment(line)}" for line in remark(result)),
    }
    return HEAD.format(**values) + generator.dump() + WRAPPERS.format(**values)


def c_functions(result: CalibratedArm, prefix: str) -> list[ca.Function]:
    """Functions behind the C code: q -> pose (16); q -> Jacobian (6 n); q, target, damping -> next (n), error (6)."""
    robot = result.source.problem.robot
    count = len(robot.axes)
    q, target, damping = ca.SX.sym("q", count), ca.SX.sym("target", 16), ca.SX.sym("damping")
    known = list(inputs_of(result, q).values())
    pose = pose_at(result, *known)
    turn = pose[:3, :3]
    slopes = ca.jacobian(ca.vec(turn), q)
    spins = []
    for i in range(count):  # dR/dq R' = [w]
        cross = ca.mtimes(ca.reshape(slopes[:, i], 3, 3), turn.T)
        spins.append(ca.vertcat(cross[2, 1] - cross[1, 2], cross[0, 2] - cross[2, 0], cross[1, 0] - cross[0, 1]) / 2)
    jacobian = ca.densify(ca.vertcat(ca.jacobian(pose[:3, 3], q), ca.horzcat(*spins)))
    wanted = ca.reshape(target, 4, 4).T
    # orientation error: half the sum of the axes' cross products, Siciliano et al., Robotics (2009), eq (3.85)
    turned = sum((ca.cross(turn[:, k], wanted[:3, k]) for k in range(3)), ca.SX.zeros(3)) / 2
    error = ca.vertcat(wanted[:3, 3] - pose[:3, 3], turned)
    weights = ca.DM(np.diag([1.0] * 3 + [LEVER] * 3))
    lifted = ca.mtimes(weights, jacobian)
    normal = ca.mtimes(lifted, lifted.T) + damping**2 * ca.DM.eye(6)
    factors = ca.ldl(ca.densify(normal), False)  # positive definite while there is damping
    step = ca.mtimes(lifted.T, ca.ldl_solve(ca.mtimes(weights, error), *factors))
    inputs = [known, known, [*known, target, damping]]
    outputs = [[ca.vec(pose.T)], [ca.vec(jacobian.T)], [q + step, error]]
    names = (f"{prefix}_pose_raw", f"{prefix}_jacobian_raw", f"{prefix}_step_raw")
    return [
        ca.Function(name, given, [ca.densify(out) for out in ca.cse(made)])
        for name, given, made in zip(names, inputs, outputs, strict=True)
    ]


def _comment(text: str) -> str:
    """A text that cannot end a C comment."""
    return " ".join(text.replace("*/", "* /").split())
