"""The public symbols of one row: names, shapes and values against hand-multiplied arms, and the same as C."""

import copy
import ctypes
import dataclasses
import pickle
import shutil
import subprocess

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT
from oracles import central_difference, dh_chain, rot_x, rot_z, shift

from casacal import CasacalError, DialOnPlane, Parameter, Problem, Robot, TrackedPoint, calibrate, load_problem
from casacal.errors import ProblemError
from casacal.model import Symbols
from casacal.model.kinematics import translate_x

HSR = {
    "alpha": np.radians([-90, 0, 90, -90, 90, 0]),
    "a": np.array([249.85003, 900.32123, -206.14449, 0, 0, 0]),
    "d": np.array([653.5, 0, 0, 1030.37534, 0, 200.6]),
    "theta": np.radians([0, -90, 180, 0, 90, 0]),
}
UR5 = {
    "alpha": np.radians([90, 0, 0, 90, -90, 0]),
    "a": np.array([0, -425, -392.25, 0, 0, 0]),
    "d": np.array([89.159, 0, 0, 109.15, 94.65, 82.3]),
    "theta": np.zeros(6),
    "beta": np.zeros(2),
    "tool": np.array([0, 0, 120.0]),
}
needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")


def rot_y(angle):
    return rot_x(-np.pi / 2) @ rot_z(angle) @ rot_x(np.pi / 2)


def hsr_values(z):
    """Values by name at z (24 of the arm)."""
    return {key: nominal + z[6 * i : 6 * i + 6] for i, (key, nominal) in enumerate(HSR.items())}


def ur5_values(z):
    """The same, where d2 and d3 are held and beta2 and beta3 are free."""
    d = UR5["d"].copy()
    d[[0, 3, 4, 5]] += z[12:16]
    parts = {"alpha": z[:6], "a": z[6:12], "theta": z[16:22], "beta": z[22:24], "tool": z[24:27]}
    return {key: UR5[key] + part for key, part in parts.items()} | {"d": d, "step": z[30]}


def hsr_pose(v, q, reading=0.0):
    """The paper's arm: the reading lengthens d6."""
    return dh_chain(v["alpha"], v["a"], v["d"] + [0, 0, 0, 0, 0, reading], v["theta"] + q)


def ur5_pose(v, q):
    pose = np.eye(4)
    for i in range(6):
        pose = pose @ rot_z(v["theta"][i] + q[i])
        if i in (1, 2):
            pose = pose @ shift(v["a"][i], 0, 0) @ rot_x(v["alpha"][i]) @ rot_y(v["beta"][i - 1])
        else:
            pose = pose @ shift(0, 0, v["d"][i]) @ shift(v["a"][i], 0, 0) @ rot_x(v["alpha"][i])
    return pose


def off_plane(point, z, c):
    """Distance from a plane with tilts and offset z (3) about the nominal of c (12): a point of the unit sphere."""
    s = (z[:2] @ z[:2]) / 4
    normal = ((1 - s) * c[:3] + z[0] * c[3:6] + z[1] * c[6:9]) / (1 + s)
    return normal @ (point - c[9:12]) - z[2]


def hsr_row(z, c, d):
    """Pose, tip and residual by hand."""
    v, q, reading = hsr_values(z), d[:6], d[6]
    tip = hsr_pose(v, q, reading)[:3, 3]
    return hsr_pose(v, q), tip, np.array([off_plane(tip, z[24:], c)])


def ur5_row(z, c, d):
    v, q, (reading, height, on_step) = ur5_values(z), d[:6], d[6:]
    pose = ur5_pose(v, q)
    tip = (pose @ [*(v["tool"] - [0, 0, reading]), 1])[:3]
    return pose, tip, np.array([off_plane(tip, z[27:30], c) - height - on_step * v["step"]])


def tracked_row(z, c, d):
    """HSR with a reflector: the station turns about its nominal by a unit quaternion at (w, xyz)."""
    pose = hsr_pose(hsr_values(z), d[:6])
    tip = (pose @ [*z[24:27], 1])[:3]
    u = z[27:30] / 2
    s = (u @ u) / 4
    w, (x, y, k) = (1 - s) / (1 + s), u / (1 + s)
    cross = np.array([[0, -k, y], [k, 0, -x], [-y, x, 0]])
    turn = c[:9].reshape(3, 3).T @ (np.eye(3) + 2 * w * cross + 2 * cross @ cross)
    return pose, tip, turn @ tip + c[9:12] + z[30:33] - d[6:9]


def tracked():
    robot = load_problem(ROOT / "problems" / "hsr_jr680").problem.robot
    return Problem(robot, TrackedPoint(noise_std=0.05))


CASES = {
    "hsr": (lambda: load_problem(ROOT / "problems" / "hsr_jr680").problem, hsr_row),
    "ur5": (lambda: load_problem(ROOT / "problems" / "ur5").problem, ur5_row),
    "tracked": (tracked, tracked_row),
}


@pytest.fixture(scope="module", params=CASES)
def case(request):
    """A problem, and its rows by hand."""
    made, by_hand = CASES[request.param]
    return made(), by_hand


def row_at(problem, seed=0):
    """Random z, c and d of one row, c of a rigid nominal."""
    rng, symbols = np.random.default_rng(seed), problem.symbols
    scale = np.array([unit == "mm" for unit in symbols.units]) * 2.0 + 0.02
    z = scale * rng.normal(size=len(symbols.names))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    c = np.concatenate([(turn * np.linalg.det(turn)).ravel(), rng.uniform(-500, 500, 3)])
    d = np.concatenate([rng.uniform(-2, 2, 6), rng.uniform(0, 9, len(symbols.columns))])
    return z, c, d


def test_names_and_shapes(case):
    symbols = case[0].symbols
    n, m = len(symbols.names), symbols.residual.numel()
    assert isinstance(symbols, Symbols)
    assert symbols.z.shape == (n, 1)
    assert symbols.q.shape == (6, 1)
    assert symbols.c.shape == (12, 1)
    assert sum(symbols.constants.values()) == 12
    assert symbols.d.shape == (6 + len(symbols.columns), 1)
    assert (symbols.pose.shape, symbols.tip.shape) == ((4, 4), (3, 1))
    assert (symbols.jacobian.shape, symbols.noise.shape) == ((m, n), (m, 1))
    assert len(symbols.units) == n
    assert set(symbols.functions) == {"residual", "jacobian", "noise", "tip", "pose"}
    for name, function in symbols.functions.items():
        assert (function.name_in(), function.name_out()) == (["z", "c", "d"], [name])
        assert function.size_out(0) == getattr(symbols, name).shape
    assert symbols.p.alpha.shape == (6, 1)
    assert case[0].symbols is symbols


def test_what_the_names_are():
    hsr, ur5, seen = (made().symbols for made, _ in CASES.values())
    assert hsr.names == (*(f"{key}{i}" for key in HSR for i in range(1, 7)),
                         "plane.tilt1", "plane.tilt2", "plane.offset")  # fmt: skip
    assert list(hsr.columns) == ["reading"]
    assert dict(hsr.constants) == {"plane": 12}
    assert list(ur5.columns) == ["reading", "height", "on_step_1"]
    assert ur5.names[22:27] == ("beta2", "beta3", "tool_x", "tool_y", "tool_z") or ur5.names[22:24] == (
        "beta1",
        "beta2",
    )
    assert seen.residual.numel() == 3
    assert dict(seen.constants) == {"station": 12}
    assert hsr.units == ("rad",) * 6 + ("mm",) * 12 + ("rad",) * 8 + ("mm",)


def test_values_equal_the_arm_by_hand(case):
    problem, by_hand = case
    for seed in range(5):
        row = row_at(problem, seed)
        for name, expected in zip(("pose", "tip", "residual"), by_hand(*row), strict=True):
            found = np.array(problem.symbols.functions[name](*row))
            np.testing.assert_allclose(found.reshape(expected.shape), expected, rtol=0, atol=1e-9, err_msg=name)


def test_the_jacobian_equals_differences_of_the_arm_by_hand(case):
    problem, by_hand = case
    z, c, d = row_at(problem)
    steps = np.array([1e-3 if unit == "mm" else 1e-6 for unit in problem.symbols.units])
    expected = central_difference(lambda some: by_hand(some, c, d)[2], z, steps)
    found = np.array(problem.symbols.functions["jacobian"](z, c, d))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-5)


def test_noise_is_what_the_instrument_states():
    # the dial moves the tip along joint 6: its noise counts by the cosine between plunger and normal
    hsr, _, seen = (made() for made, _ in CASES.values())
    z, c, d = row_at(hsr)
    axis = dh_chain(*(hsr_values(z)[k][:5] for k in ("alpha", "a", "d")), hsr_values(z)["theta"][:5] + d[:5])[:3, 2]
    s = (z[24:26] @ z[24:26]) / 4
    normal = ((1 - s) * c[:3] + z[24] * c[3:6] + z[25] * c[6:9]) / (1 + s)
    assert float(hsr.symbols.functions["noise"](z, c, d)) == pytest.approx(0.01 * abs(axis @ normal), rel=1e-9)
    np.testing.assert_allclose(np.array(seen.symbols.functions["noise"](*row_at(seen))).ravel(), 0.05)


def test_functions_serve_sx_mx_and_numbers(case):
    problem, _ = case
    z, c, d = row_at(problem)
    jacobian = problem.symbols.functions["jacobian"]
    for kind in (ca.SX, ca.MX):
        symbol = kind.sym("z", z.size)
        again = ca.Function(
            "again", [symbol], [ca.jacobian(problem.symbols.functions["residual"](symbol, c, d), symbol)]
        )
        np.testing.assert_allclose(np.array(again(z)), np.array(jacobian(z, c, d)), rtol=1e-12, atol=1e-9)


def test_estimators_see_the_same_trace(case):
    problem, _ = case
    assert problem.models[0] is problem.symbols.model
    row = row_at(problem)
    e, slopes = problem.models[0].jacobian(*row)
    np.testing.assert_array_equal(np.array(e), np.array(problem.symbols.functions["residual"](*row)))
    np.testing.assert_array_equal(np.array(slopes).T, np.array(problem.symbols.functions["jacobian"](*row)))


def test_values_as_inputs():
    hsr, ur5, seen = (made() for made, _ in CASES.values())
    z, c, d = row_at(hsr)
    v, functions = hsr_values(z), hsr.symbols.value_functions
    pose = functions["pose"](**v, q=d[:6])["pose"]
    np.testing.assert_allclose(np.array(pose), hsr_pose(v, d[:6]), rtol=0, atol=1e-9)
    assert functions["tip"].name_in() == ["alpha", "a", "d", "theta", "tool", "plunger", "q", "reading"]
    tip = functions["tip"](**v, plunger=[0, 0, 1], q=d[:6], reading=d[6])["tip"]
    np.testing.assert_allclose(np.array(tip).ravel(), hsr_pose(v, d[:6], d[6])[:3, 3], rtol=0, atol=1e-9)
    plane = [*c[:3], *c[9:12], 0.0]
    e = functions["residual"](**v, plunger=[0, 0, 1], plane=plane, q=d[:6], reading=d[6])["residual"]
    assert float(e) == pytest.approx(c[:3] @ (hsr_pose(v, d[:6], d[6])[:3, 3] - c[9:12]), abs=1e-9)
    assert ur5.symbols.value_functions["pose"].name_in() == ["alpha", "a", "d", "theta", "beta", "q"]
    assert seen.symbols.value_functions["residual"].size_in("station") == (4, 4)


def test_a_value_that_does_not_change_or_depend_on_what_is_remembered(case):
    problem, _ = case
    symbols = problem.symbols
    assert copy.deepcopy(symbols) is symbols
    with pytest.raises(dataclasses.FrozenInstanceError):
        symbols.robot = None
    again = pickle.loads(pickle.dumps(symbols))
    assert again == symbols
    row = row_at(problem)
    np.testing.assert_array_equal(*(np.array(each.functions["residual"](*row)) for each in (symbols, again)))


def test_the_table_of_names_and_shapes():
    shown = repr(CASES["ur5"][0]().symbols).splitlines()
    assert shown[0] == "Symbols of UR5, measured by DialOnPlane"
    assert [line.split()[0] for line in shown[1:]] == [
        "z", "c", "q", "columns", "p", "pose", "tip", "residual", "jacobian", "noise"]  # fmt: skip
    assert shown[1].split()[1] == "31"
    assert "1x31" in shown[9]
    assert max(map(len, shown)) <= 120


def test_several_instruments_are_asked_one_by_one():
    seen = tracked()
    both = Problem(seen.robot, DialOnPlane(noise_std=0.01), *seen.instruments)
    with pytest.raises(ProblemError, match="2 instruments"):
        _ = both.symbols
    assert [both.symbols_of(i).residual.numel() for i in (0, 1)] == [1, 3]
    with pytest.raises(ProblemError, match=r"no instrument 2.*Give 0 to 1"):
        both.symbols_of(2)


def test_names_that_casadi_does_not_take_are_refused_where_they_are_inputs():
    for name in ("l__1", "q", "jac"):
        robot = Robot("odd", 1, lambda p, q, name=name: translate_x(getattr(p, name) + q[0]), {name: Parameter(1.0)})
        symbols = Problem(robot, TrackedPoint(noise_std=0.1)).symbols
        assert symbols.functions["pose"].size_out(0) == (4, 4)
        with pytest.raises(ProblemError, match=f"'{name}' cannot name an input"):
            _ = symbols.value_functions


# --- C ---------------------------------------------------------------------------------------------------------------


def compiled(text, folder):
    (folder / "row.c").write_text(text)
    command = ["cc", "-std=c99", "-Wall", "-Werror", "-Wno-unused", "-O1", "-shared", "-fPIC", "row.c", "-o", "row.so"]
    subprocess.run([*command, "-lm"], cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "row.so"))


def call(function, size, *inputs):
    out = np.empty(size)
    arrays = [np.ascontiguousarray(each, dtype=np.float64) for each in inputs]
    function(*(each.ctypes.data_as(ctypes.c_void_p) for each in (*arrays, out)))
    return out


@needs_compiler
def test_c_with_parameters_free_equals_the_arm_by_hand(case, tmp_path):
    problem, by_hand = case
    z, c, d = row_at(problem)
    text = problem.symbols.c_code(prefix="arm")
    assert "void arm_pose(const double p[" in text
    library, symbols = compiled(text, tmp_path), problem.symbols
    count = sum(symbol.numel() for symbol in symbols.free[0].values())
    p = call(library.arm_values, count, z, c)
    pose, tip, residual = by_hand(z, c, d)
    np.testing.assert_allclose(call(library.arm_pose, 16, p, d[:6]).reshape(4, 4), pose, rtol=0, atol=1e-9)
    np.testing.assert_allclose(call(library.arm_tip, 3, p, d[:6], d[6:]), tip, rtol=0, atol=1e-9)
    np.testing.assert_allclose(call(library.arm_residual, residual.size, p, d[:6], d[6:]), residual, rtol=0, atol=1e-9)
    noise = call(library.arm_noise, residual.size, z, c, d[:6], d[6:])
    np.testing.assert_allclose(noise, np.array(symbols.functions["noise"](z, c, d)).ravel(), rtol=1e-12)
    e, slopes = np.empty(residual.size), np.empty((residual.size, z.size))
    inputs = [np.ascontiguousarray(each) for each in (z, c, d[:6], d[6:])]
    library.arm_jacobian(*(each.ctypes.data_as(ctypes.c_void_p) for each in (*inputs, e, slopes)))
    np.testing.assert_allclose(e, residual, rtol=0, atol=1e-9)
    np.testing.assert_allclose(slopes, np.array(symbols.functions["jacobian"](z, c, d)), rtol=1e-12, atol=1e-9)


def test_c_says_what_it_takes_and_refuses_other_names():
    text = CASES["ur5"][0]().symbols.c_code()
    head = text.split("*/")[0]
    assert "p    values: alpha 6, a 6, d 6, theta 6, beta 2, tool 3, plunger 3, plane 7, step_1 1" in head
    assert "ur5_values(const double z[31]" in head
    for prefix in ("6axis", "a b", "", "a__b"):
        with pytest.raises(ProblemError, match="cannot begin the name of a C function"):
            CASES["ur5"][0]().symbols.c_code(prefix=prefix)


# --- the calibrated arm ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def calibration():
    source = load_problem(ROOT / "problems" / "ur5")
    return calibrate(source.problem, source.problem.read(source.samples), method="lm", reference=False)


def calibrated_values(calibration):
    """The calibrated UR5 by hand, from the parameter table alone."""
    table = calibration.parameters["estimate"]
    v = {key: np.array([table[f"{key}{i}"] for i in range(1, 7)]) for key in ("alpha", "a", "d", "theta")}
    return v | {"beta": table.filter(like="beta").to_numpy(), "tool": table[["tool_x", "tool_y", "tool_z"]].to_numpy()}


@pytest.mark.long
def test_the_calibrated_arm_as_functions(calibration):
    v = calibrated_values(calibration)
    pose, tip = calibration.pose_function(), calibration.tip_function()
    for q in np.random.default_rng(0).uniform(-2, 2, (5, 6)):
        expected = ur5_pose(v, q)
        np.testing.assert_allclose(np.array(pose(q)), expected, rtol=0, atol=1e-9)
        np.testing.assert_allclose(np.array(tip(q)).ravel(), (expected @ [*v["tool"], 1])[:3], rtol=0, atol=1e-9)
        slopes = central_difference(lambda q: (ur5_pose(v, q) @ [*v["tool"], 1])[:3], q, np.full(6, 1e-6))
        np.testing.assert_allclose(np.array(tip.jacobian()(q, 0)), slopes, rtol=0, atol=1e-5)
        np.testing.assert_allclose(np.array(calibration.pose_function(nominal=True)(q)), ur5_pose(UR5, q), atol=1e-9)


def test_the_calibrated_arm_with_its_parameters_free(calibration):
    v, q = calibrated_values(calibration), np.array([0.3, -1.0, 1.2, -1.0, -1.5, 0.1])
    values = calibration.values()
    for key in ("alpha", "a", "d", "theta", "beta"):
        np.testing.assert_allclose(values[key], v[key], rtol=1e-12)
    pose = calibration.pose_function(free=True)
    np.testing.assert_allclose(np.array(pose(**values, q=q)["pose"]), ur5_pose(v, q), rtol=0, atol=1e-9)
    longer = values | {"a": values["a"] + [0, 5, 0, 0, 0, 0]}
    expected = ur5_pose(v | {"a": longer["a"]}, q)
    np.testing.assert_allclose(np.array(pose(**longer, q=q)["pose"]), expected, rtol=0, atol=1e-9)
    tip = calibration.tip_function(free=True)(**calibration.values(frame="tip"), q=q, reading=2.0)["tip"]
    expected = (ur5_pose(v, q) @ [*(v["tool"] - [0, 0, 2.0]), 1])[:3]
    np.testing.assert_allclose(np.array(tip).ravel(), expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(calibration.values(nominal=True)["a"], UR5["a"])
    with pytest.raises(CasacalError, match="neither nominal nor calibrated"):
        calibration.pose_function(nominal=True, free=True)


def test_the_calibrated_arm_in_opti(calibration):
    tip, meant = calibration.tip_function(), np.array([0.3, -1.0, 1.2, -1.0, -1.5, 0.1])
    target = np.array(tip(meant)).ravel() + np.array([20.0, -10.0, 5.0])
    opti = ca.Opti()
    q = opti.variable(6)
    opti.minimize(ca.sumsqr(q - meant))
    opti.subject_to(tip(q) == target)
    opti.set_initial(q, meant)
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
    found = opti.solve().value(q)
    v = calibrated_values(calibration)
    np.testing.assert_allclose((ur5_pose(v, found) @ [*v["tool"], 1])[:3], target, rtol=0, atol=1e-5)
