"""The calibrated arm as CasADi functions, in a file of such a one, and as C."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Any, Literal

import casadi as ca
import numpy as np

from casacal.deployment.arm import CalibratedArm, arm_values, local_coordinates, row_constants
from casacal.deployment.remark import remark
from casacal.deployment.result_file import arm_from
from casacal.errors import CasacalError
from casacal.model.problem import Problem
from casacal.model.term import Site
from casacal.model.trace import row_function
from casacal.values import Array


def pose_function(arm: CalibratedArm, *, nominal: bool = False, free: bool = False, force: bool = False) -> ca.Function:
    """Function q (n; rad, mm) -> flange pose (4x4; mm) of an arm as calibrated.

    Where columns tell effects that can then be corrected, such as torques, their values are a second input, `told`
    (k), in the order of `further_columns`. nominal: as drawn in place of as calibrated. free: the robot's parameters
    are inputs too, by name and before q, with values by `values_of`. Effects beside the geometry are then no part.
    force: take a result whose verdict is not to use it; the function's name then says so.

    Raises CasacalError when both nominal and free are asked for, RefusedResultError for a result not to be used.
    """
    arm, said = _begun(arm, nominal, free, force)
    problem = arm.source.problem
    if free:
        return problem.without_terms.symbols_of(0).value_functions["pose"]
    q = ca.SX.sym("q", len(problem.robot.axes))
    if nominal:
        return row_function("pose", [q], [ca.SX(problem.robot.pose(arm_values(arm, nominal=True), q))], ["q"])
    inputs = inputs_of(arm, q)
    return row_function(f"pose{said}", [*inputs.values()], [pose_at(arm, *inputs.values())], [*inputs])


def further_columns(arm: CalibratedArm) -> tuple[str, ...]:
    """The columns whose values are the input `told`, in order; none where no column tells an effect."""
    return tuple(name for names in arm_from(arm).found.effects.further.values() for name in names)


def inputs_of(arm: CalibratedArm, q: ca.SX) -> dict[str, ca.SX]:
    """Inputs by name: joint values, and values of the further columns where there are any."""
    count = len(further_columns(arm))
    return {"q": q, "told": ca.SX.sym("told", count)} if count else {"q": q}


def _row(arm: CalibratedArm, problem: Problem, q: ca.SX, further: ca.SX | None = None) -> ca.SX:
    """The row d (nd) at readings of zero: joint values, and the values (k) of further columns in their places."""
    columns, values = dict[str, Any](), ca.vertsplit(further) if further is not None else []
    site = Site(problem.robot, problem.instrument)
    effects = {effect.key: effect for effect in problem.terms}
    for key, names in arm.found.effects.further.items():
        columns |= zip(effects[key].columns(site), values[: len(names)], strict=False)
        values = values[len(names) :]
    return ca.vertcat(q, *(columns.get(name, 0) for name in problem.symbols.columns))


def pose_at(arm: CalibratedArm, q: ca.SX, further: ca.SX | None = None) -> ca.SX:
    """Flange pose (4x4; mm) as calibrated at joint values (n; rad, mm) and values (k) of `further_columns`."""
    problem = arm.used
    if not problem.terms:
        return ca.SX(problem.robot.pose(arm_values(arm), q))
    z, c = ca.DM(local_coordinates(arm, of=problem)), ca.DM(row_constants(arm, problem))
    return ca.reshape(problem.symbols.functions["pose"](z, c, _row(arm, problem, q, further)), 4, 4)


def tip_function(arm: CalibratedArm, *, nominal: bool = False, free: bool = False, force: bool = False) -> ca.Function:
    """Function q (n; rad, mm) -> tip (3; mm), where the instrument touches at reading zero; `told` as there.

    nominal, force, errors: as for `pose_function`; ProblemError where there are several instruments. free: what the tip
    depends on of the robot's parameters, the instrument's unknowns and the columns are inputs too, by name.
    """
    arm, said = _begun(arm, nominal, free, force)
    if free:
        return arm.source.problem.without_terms.symbols.value_functions["tip"]
    q = ca.SX.sym("q", len(arm.source.problem.robot.axes))
    problem = arm.source.problem.without_terms if nominal else arm.used
    inputs = {"q": q} if nominal else inputs_of(arm, q)
    d = ca.vertcat(q, ca.DM.zeros(len(problem.symbols.columns))) if nominal else _row(arm, problem, *inputs.values())
    z = local_coordinates(arm, nominal=nominal, of=problem)
    tip = problem.symbols.functions["tip"](z, ca.DM(row_constants(arm, problem)), d)
    return row_function(f"tip{said}", [*inputs.values()], [tip], [*inputs])


def values_of(
    arm: CalibratedArm, *, frame: Literal["flange", "tip"] = "flange", nominal: bool = False, force: bool = False
) -> dict[str, Array]:
    """Values by name for the parameters that are free in `pose_function` or, with frame "tip", in `tip_function`.

    Numbers are (n,), frames (4, 4); mm and rad. force: take a result whose verdict is not to use it. Raises
    RefusedResultError for such a one, and CasacalError where the tip depends on what differs by label.
    """
    arm = arm_from(arm)
    arm.check_usable(force=force or nominal)
    problem = arm.source.problem
    if frame == "flange":
        known = arm_values(arm, nominal=nominal)
        unknowns = problem.robot.parameters
        return {key: _array(ca.DM(unknown.packed(getattr(known, key)))) for key, unknown in unknowns.items()}
    symbols = problem.without_terms.symbols
    wanted = [key for key in symbols.value_functions["tip"].name_in() if key in symbols.unknowns]
    if unsure := set(wanted) & set(symbols.constants):
        what = f"The tip depends on '{sorted(unsure)[0]}', which the samples propose or which differs by label"
        raise CasacalError(what, "Use tip_function() without free")
    packed = [ca.SX(symbols.unknowns[key].packed(getattr(symbols.p, key))) for key in wanted]
    found = ca.Function("values", [symbols.z], packed).call([ca.DM(local_coordinates(arm, nominal=nominal))])
    return {key: _array(matrix) for key, matrix in zip(wanted, found, strict=True)}


def casadi_text(arm: CalibratedArm) -> str:
    """The function of `pose_function` as `casadi.Function.load` reads it; a denial is part of its name."""
    made = pose_function(arm, force=True)
    inputs = inputs_of(arm_from(arm), ca.SX.sym("q", made.numel_in(0)))
    made = ca.Function(made.name(), [*inputs.values()], [made(*inputs.values())], [*inputs], ["pose"])
    with tempfile.TemporaryDirectory() as folder:
        made.save(str(Path(folder) / "arm"))
        return (Path(folder) / "arm").read_text(encoding="ascii")


def _begun(source: CalibratedArm, nominal: bool, free: bool, force: bool) -> tuple[CalibratedArm, str]:
    """The arm, and the suffix of a function's name for a forced verdict; refused where the arm is not to be used."""
    if nominal and free:
        raise CasacalError("Free parameters are neither nominal nor calibrated", "Leave out nominal or free")
    arm = arm_from(source)
    if nominal or free:
        return arm, ""
    arm.check_usable(force=force)
    return arm, "" if arm.denial is None else "_forced_against_the_verdict"


def _array(matrix: ca.DM) -> Array:
    dense = np.asarray(ca.densify(matrix), dtype=np.float64)
    return dense.ravel() if dense.shape[1] == 1 else dense


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
    """C99 of the calibrated kinematics, its Jacobian and a damped step, in functions whose names begin with a prefix.

    By default with the problem's name. Raises CasacalError where it is no C name.
    """
    result = arm_from(result)
    if prefix is None:
        plain = re.sub(r"[\W_]+", "_", result.source.name, flags=re.ASCII).strip("_")
        prefix = plain if plain[:1].isalpha() else f"arm_{plain}".rstrip("_")
    if not ca.Function.check_name(f"{prefix}_pose"):
        raise CasacalError(
            f"'{prefix}' cannot begin the name of a C function", "Give a prefix of letters, digits and _"
        )
    functions = c_functions(result, prefix)
    generator = ca.CodeGenerator(f"{prefix}_code", {"with_header": False})
    for function in functions:
        generator.add(function)
    count, further = functions[0].numel_in(0), further_columns(result)
    values = {
        "prefix": prefix,
        "count": count,
        "size": 6 * count,
        "args": max(f.sz_arg() for f in functions),
        "results": max(f.sz_res() for f in functions),
        "lever": LEVER,
        "name": _comment(result.source.problem.robot.name),
        "also": f" const double told[{len(further)}]," if further else "",
        "means": "" if not further else f" told: {_comment(', '.join(further))}, as in the samples.\n *",
        "pass_on": ", told" if further else "",
        "remarks": "\n".join(f" * {_comment(line)}" for line in remark(result)),
    }
    return HEAD.format(**values) + generator.dump() + WRAPPERS.format(**values)


def c_functions(result: CalibratedArm, prefix: str) -> list[ca.Function]:
    """Functions behind the C code: q -> pose (16); q -> Jacobian (6 n); q, target, damping -> next (n), error (6)."""
    count = len(result.source.problem.robot.axes)
    q, target, damping = ca.SX.sym("q", count), ca.SX.sym("target", 16), ca.SX.sym("damping")
    known = list(inputs_of(result, q).values())
    pose = pose_at(result, *known)
    turn = pose[:3, :3]
    slopes = ca.jacobian(ca.vec(turn), q)
    crosses = (ca.mtimes(ca.reshape(slopes[:, i], 3, 3), turn.T) for i in range(count))  # dR/dq R' = [w]
    spins = [ca.vertcat(w[2, 1] - w[1, 2], w[0, 2] - w[2, 0], w[1, 0] - w[0, 1]) / 2 for w in crosses]
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
    return [row_function(name, arguments, made) for name, arguments, made in zip(names, inputs, outputs, strict=True)]


def _comment(text: str) -> str:
    """A text that cannot end a C comment."""
    return " ".join(text.replace("*/", "* /").split())
