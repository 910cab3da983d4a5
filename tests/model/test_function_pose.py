"""A robot of a `casadi.Function`, whoever made it: forms, units, refusals, and all the way to C, against NumPy."""

import ctypes
import pickle
import shutil
import subprocess
import sys
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from oracles import dh_chain, rot_z, shift
from test_arms import xml_chain

from casacal import CasacalError, Joint, Parameter, Problem, Robot, TrackedPoint, calibrate, load
from casacal.cli.main import main
from casacal.errors import ProblemError

ALPHA = np.radians([90, 0, 0, 90, -90, 0])
A = np.array([0, -425, -392.25, 0, 0, 0])
D = np.array([89.159, 0, 0, 109.15, 94.65, 82.3])


def pose(p, q, per_mm=1.0):
    """The arm's pose as an expression of a (6), theta (6) and q, with lengths in another unit."""
    made = ca.MX.eye(4) if isinstance(q, ca.MX) else ca.SX.eye(4)
    for i in range(6):
        (c, s), (ca_, sa) = (ca.cos(p[6 + i] + q[i]), ca.sin(p[6 + i] + q[i])), (np.cos(ALPHA[i]), np.sin(ALPHA[i]))
        rows = [[c, -s * ca_, s * sa, p[i] * c], [s, c * ca_, -c * sa, p[i] * s], [0, sa, ca_, D[i] * per_mm]]
        made = ca.mtimes(made, ca.vertcat(*[ca.horzcat(*row) for row in rows], ca.horzcat(0, 0, 0, 1)))
    return made


def function(kind=ca.SX, form="4x4", per_mm=1e-3, inputs="one"):
    """A function as somebody's library might give it."""
    q, p = kind.sym("q", 6), kind.sym("p", 12)
    made = pose(p, q, per_mm)
    out = {
        "4x4": [made],
        "3x4": [made[:3, :]],
        "two": [made[:3, 3], made[:3, :3]],
        "turned": [made[:3, :3], made[:3, 3].T],
    }
    if inputs == "none":
        return ca.Function("fk", [q], ca.substitute(out[form], [p], [kind(ca.DM([*(A * per_mm), *np.zeros(6)]))]))
    whole = ca.Function("fk", [q, p], out[form])
    if inputs == "one":
        return whole
    base, q, a, theta = kind.sym("H", 4, 4), kind.sym("s", 6), kind.sym("a", 6), kind.sym("t", 1, 6)
    return ca.Function("fk", [base, q, a, theta], [ca.mtimes(base, whole(q, ca.vertcat(a, theta.T)))])


def lengths_and_zeros():
    return {"a": Parameter(A, unit="mm", prior_std=0.5), "theta": Parameter(np.zeros(6), unit="rad", prior_std=1e-3)}


def pose_of(robot, q, **values):
    return np.array(robot.pose(SimpleNamespace(**values), ca.DM(q)), dtype=float)


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
@pytest.mark.parametrize(
    ("form", "inputs", "length"),
    [("4x4", "one", "m"), ("3x4", "one", "mm"), ("two", "one", "m"), ("turned", "one", "m"), ("4x4", "base", "m")],
)
def test_every_form_is_the_same_arm(kind, form, inputs, length):
    made = function(kind, form, 1e-3 if length == "m" else 1.0, inputs)
    robot = Robot.from_function("arm", made, length=length, parameters=lengths_and_zeros())
    rng = np.random.default_rng(0)
    for _ in range(5):
        q, a, theta = rng.uniform(-3, 3, 6), A + rng.normal(size=6), 0.1 * rng.normal(size=6)
        found = pose_of(robot, q, a=ca.DM(a), theta=ca.DM(theta))
        np.testing.assert_allclose(found, dh_chain(ALPHA, a, D, theta + q), atol=1e-9)


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_without_parameters_the_zeros_are_unknown(kind):
    robot = Robot.from_function("arm", function(kind, inputs="none"), length="m", angle_std=2e-3)
    assert list(robot.parameters) == ["zero"]
    np.testing.assert_array_equal(robot.parameters["zero"].prior_stds, 2e-3)
    q, zero = np.linspace(-1, 1, 6), np.linspace(-0.1, 0.2, 6)
    found = pose_of(robot, q, zero=ca.DM(zero))
    np.testing.assert_allclose(found, dh_chain(ALPHA, A, D, zero + q), atol=1e-9)


def test_a_sliding_joint_slides_in_the_functions_unit_and_has_no_zero_angle():
    q = ca.SX.sym("q", 1, 2)
    place = ca.vertcat(0.3 * ca.cos(q[0]), 0.3 * ca.sin(q[0]), q[1])
    turn = ca.blockcat([[ca.cos(q[0]), -ca.sin(q[0]), 0], [ca.sin(q[0]), ca.cos(q[0]), 0], [0, 0, 1]])
    made = ca.Function("fk", [q], [place, turn])
    robot = Robot.from_function("arm", made, length="m", joints=[Joint(), Joint("prismatic", 0, 250)])
    assert robot.parameters["zero"].names("zero") == ("zero1",)
    found = pose_of(robot, [0.4, 120.0], zero=ca.DM([0.1]))
    np.testing.assert_allclose(found, rot_z(0.5) @ shift(300, 0, 120), atol=1e-12)
    slide = Robot.from_function("slide", ca.Function("fk", [q], [ca.SX.eye(4)]), length="mm", joints="PP")
    assert not slide.parameters


q6 = ca.SX.sym("q", 6)


@pytest.mark.parametrize(
    ("made", "options", "says"),
    [
        (lambda: pose, {}, "Got a function as the function of a robot. Give a casadi.Function of q"),
        (lambda: ca.Function("fk", [q6], [q6]), {}, "The function 'fk' gives 6x1. Let it give the flange's pose"),
        (lambda: ca.Function("fk", [q6], [q6[:3], q6[:4]]), {}, "gives 3x1 and 4x1"),
        (lambda: ca.Function("fk", [], [ca.SX.eye(4)]), {}, "takes no joint values"),
        (lambda: ca.Function("fk", [ca.SX.sym("q", 2, 3)], [ca.SX.eye(4)]), {}, "takes no joint values"),
        (function, {}, "takes 12 numbers besides q, and the parameters are 0"),
        (lambda: function(inputs="none"), {"parameters": {"a": Parameter(1.0)}}, "takes 0 numbers besides q"),
        (lambda: function(inputs="none"), {"joints": 5}, "takes 6 joint values, and 5 joints came"),
        (lambda: function(inputs="none"), {"length": "cm"}, "The length of a function is in 'cm'"),
        (lambda: ca.Function("fk", [q6], [2 * ca.SX.eye(4)]), {}, "gives no rigid pose at the nominal values"),
        (lambda: ca.Function("fk", [q6], [ca.diag(ca.SX([1, 1, -1, 1]))]), {}, "gives no rigid pose"),
        (lambda: ca.Function("fk", [q6], [ca.SX.eye(4) / (q6[0] - q6[0])]), {}, "gives no rigid pose"),
    ],
)
def test_what_is_no_arm_is_refused_in_a_sentence(made, options, says):
    with pytest.raises(ProblemError) as refused:
        Robot.from_function("arm", made(), **{"length": "m", **options})
    assert says in str(refused.value)


def test_other_unknowns_and_what_is_no_graph_are_refused():
    from casacal import Frame

    with pytest.raises(ProblemError, match=r"'tool' of a function is a Frame. Give numbers"):
        Robot.from_function("arm", function(inputs="none"), length="m", parameters={"tool": Frame()})
    q = ca.MX.sym("q", 6)
    called = ca.interpolant("table", "linear", [[-3.0, 3.0]], [0.0, 1.0])
    turned = ca.vertcat(ca.horzcat(ca.MX.eye(3), ca.vertcat(called(q[0]), 0, 0)), ca.DM([[0, 0, 0, 1]]))
    with pytest.raises(ProblemError, match=r"cannot be written out in elementary operations \(SX\)"):
        Robot.from_function("arm", ca.Function("fk", [q], [turned]), length="m")


# --- all the way

TRUE_A, TRUE_ZERO = A + np.array([0.3, -0.6, 0.4, 0.2, -0.1, 0.1]), 1e-3 * np.array([0, 0.7, -1.2, 0.4, 0.9, 0])
TOOL = np.array([0.0, 0, 120])


@pytest.fixture(scope="module")
def calibrated():
    """An MX function calibrated from a tracker's points that NumPy made of the true arm, and the arm's own joints."""
    made = function(ca.MX, "two")
    robot = Robot.from_function("arm", made, length="m", parameters=lengths_and_zeros())
    tracker = TrackedPoint(noise_std=0.005, tool=Parameter(TOOL, unit="mm", prior_std=1.0, labels=("_x", "_y", "_z")))
    rng = np.random.default_rng(4)
    joints = rng.uniform(-2.5, 2.5, (80, 6))
    tips = np.array([(dh_chain(ALPHA, TRUE_A, D, TRUE_ZERO + q) @ [*TOOL, 1])[:3] for q in joints])
    tips += 0.005 * rng.normal(size=tips.shape)
    columns = {f"q{i + 1}_rad": joints[:, i] for i in range(6)}
    columns |= {f"{axis}_mm": tips[:, i] for i, axis in enumerate("xyz")}
    return calibrate(Problem(robot, tracker), columns, discrepancy="none")


JOINTS = np.random.default_rng(5).uniform(-2.5, 2.5, (30, 6))


def test_it_calibrates_and_predicts_the_true_arm(calibrated):
    assert calibrated.success
    truth = np.array([dh_chain(ALPHA, TRUE_A, D, TRUE_ZERO + q) @ [*TOOL, 1] for q in JOINTS])[:, :3]
    off, drawn = (
        np.linalg.norm(np.diff(calibrated.predict(JOINTS, frame="tip", nominal=nominal).positions, axis=0), axis=1)
        - np.linalg.norm(np.diff(truth, axis=0), axis=1)
        for nominal in (False, True)
    )  # distances, because where the base stands is the tracker's to say
    assert np.sqrt((off**2).mean()) < 0.02 < 0.5 < np.sqrt((drawn**2).mean())


def test_it_is_pickled_saved_and_read_back_without_the_function(calibrated, tmp_path):
    robot = calibrated.fit.problem.robot
    assert pickle.loads(pickle.dumps(robot)) == robot
    calibrated.save(tmp_path)
    again = load(tmp_path)
    np.testing.assert_array_equal(again.predict(JOINTS).positions, calibrated.predict(JOINTS).positions)
    with pytest.raises(CasacalError, match="was not built from a URDF"):
        again.export("urdf")


def test_the_file_for_casadi_gives_what_predict_gives(calibrated, tmp_path, capsys):
    calibrated.save(tmp_path / "out")
    assert main(["export", str(tmp_path / "out"), "--to", "casadi", "--out", str(tmp_path / "arm.casadi")]) == 0
    assert "expected tip error" in capsys.readouterr().out
    loaded = ca.Function.load(str(tmp_path / "arm.casadi"))
    assert (loaded.name(), loaded.name_in(), loaded.name_out()) == ("pose", ["q"], ["pose"])
    assert (tmp_path / "arm.casadi").read_text() == calibrated.export("casadi")
    predicted = calibrated.predict(JOINTS)
    for q, place in zip(JOINTS, predicted.positions, strict=True):
        found = np.array(loaded(q))
        np.testing.assert_allclose(found[:3, 3], place, atol=1e-10)
        np.testing.assert_allclose(found[3], [0, 0, 0, 1])
    assert loaded(ca.MX.sym("q", 6)).shape == (4, 4)
    # in a process that knows nothing of casacal
    code = "import casadi, sys; print(repr(casadi.Function.load(sys.argv[1])([.1] * 6)[0, 3].__float__()))"
    command = [sys.executable, "-c", code, str(tmp_path / "arm.casadi")]
    told = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path).stdout
    assert abs(float(told) - calibrated.predict([[0.1] * 6]).positions[0, 0]) < 1e-10


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_its_c_gives_what_predict_gives(calibrated, tmp_path):
    calibrated.export("c", tmp_path / "arm.c", prefix="arm")
    command = ["cc", "-std=c99", "-O1", "-fPIC", "-shared", "arm.c", "-o", "arm.so", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True)
    library, out = ctypes.CDLL(str(tmp_path / "arm.so")), (ctypes.c_double * 16)()
    for q, place in zip(JOINTS, calibrated.predict(JOINTS).positions, strict=True):
        library.arm_pose((ctypes.c_double * 6)(*q), out)
        np.testing.assert_allclose(np.array(out).reshape(4, 4)[:3, 3], place, atol=1e-10)


# --- of other libraries

# limits, axes and origins as all of them take them
URDF = """<robot name="arm">
 <link name="base"/><link name="a"/><link name="b"/><link name="c"/><link name="flange"/>
 <joint name="turn" type="revolute"><parent link="base"/><child link="a"/>
  <origin xyz="0.1 -0.2 0.3" rpy="0.1 1.2 -0.4"/><axis xyz="0 0.6 -0.8"/>
  <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
 <joint name="slide" type="prismatic"><parent link="a"/><child link="b"/><origin xyz="0 0.05 0.6" rpy="0 0 0"/>
  <axis xyz="1 0 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
 <joint name="swing" type="revolute"><parent link="b"/><child link="c"/><origin xyz="0.4 0 0" rpy="-2 0.5 3"/>
  <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
 <joint name="end" type="fixed"><parent link="c"/><child link="flange"/>
  <origin xyz="0.2 0 0.01" rpy="0.3 0.2 0.1"/></joint>
</robot>
"""
MOVING = ("turn", "slide", "swing")


def of_pinocchio(path):
    pinocchio = pytest.importorskip("pinocchio", reason="pinocchio is not installed")
    cpin = pytest.importorskip("pinocchio.casadi", reason="this pinocchio has no CasADi: PyPI's is built without")
    model = pinocchio.buildModelFromUrdf(str(path))
    symbolic = cpin.Model(model)
    data, q = symbolic.createData(), ca.SX.sym("q", model.nq)
    cpin.forwardKinematics(symbolic, data, q)
    cpin.updateFramePlacements(symbolic, data)
    place = data.oMf[model.getFrameId("flange")]
    return ca.Function("fk", [q], [place.translation, place.rotation])


def of_adam(path):
    adam = pytest.importorskip("adam.casadi", reason="adam-robotics and liecasadi are not installed")
    return adam.KinDynComputations(str(path), list(MOVING)).forward_kinematics_fun("flange")


def of_urdf2casadi(path):
    parser = pytest.importorskip("urdf2casadi.urdfparser", reason="urdf2casadi is not installed").URDFparser()
    parser.from_file(str(path))
    return parser.get_forward_kinematics("base", "flange")["T_fk"]


@pytest.mark.parametrize("library", [of_pinocchio, of_adam, of_urdf2casadi])
@pytest.mark.filterwarnings("default")  # theirs
def test_functions_of_other_libraries(library, tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF, encoding="utf-8")
    robot = Robot.from_function("arm", library(tmp_path / "arm.urdf"), length="m", joints="RPR")
    for q in JOINTS[:5, :3]:
        expected = xml_chain(URDF, [*MOVING, "end"], q)
        found = pose_of(robot, q * [1, 1000, 1], zero=ca.DM.zeros(2))
        np.testing.assert_allclose(found[:3, :3], expected[:3, :3], atol=1e-9)
        np.testing.assert_allclose(found[:3, 3], 1000 * expected[:3, 3], atol=1e-6)


def test_a_transposed_pose_is_refused():
    """Its rotation is one, and its place is where nobody looks."""
    q = ca.SX.sym("q", 2)
    turn = ca.vertcat(
        ca.horzcat(ca.cos(q[0]), -ca.sin(q[0]), 0, 0.4 * ca.cos(q[1])),
        ca.horzcat(ca.sin(q[0]), ca.cos(q[0]), 0, 0.2),
        ca.horzcat(0, 0, 1, 0.1),
        ca.DM([[0, 0, 0, 1]]),
    )
    assert Robot.from_function("arm", ca.Function("f", [q], [turn]), length="m").axes
    with pytest.raises(ProblemError, match="last row is not 0, 0, 0, 1"):
        Robot.from_function("arm", ca.Function("f", [q], [turn.T]), length="m")
