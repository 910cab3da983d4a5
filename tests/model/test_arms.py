"""Forward kinematics of DH with Hayati's turn, of screws, of URDFs and of controllers, each against NumPy by hand."""

import math
import xml.etree.ElementTree as ElementTree
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from oracles import dh_chain, modified_dh_chain, rot_x, rot_z, shift
from robots_of_others import IIWA, ODD_URDF, PUMA_TOML, UR5_CSV, UR5_URDF
from scipy.spatial.transform import Rotation

from casacal import Conventions, Joint, Parameter, Robot, deg
from casacal.errors import ProblemError
from casacal.model import kinematics as k

RNG_POSES = 30


def rot_y(angle):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("y", angle).as_matrix()
    return matrix


def nominal(robot):
    """The nominal values as a pose function gets them."""
    return SimpleNamespace(**{key: u.at(ca.DM(u.nominal), ca.DM.zeros(u.size)) for key, u in robot.parameters.items()})


def moved(robot, rng):
    """Values away from nominal, and their local coordinates by key."""
    local = {key: 0.1 * rng.normal(size=unknown.size) for key, unknown in robot.parameters.items()}
    values = {key: u.at(ca.DM(u.nominal), ca.DM(local[key])) for key, u in robot.parameters.items()}
    return SimpleNamespace(**values), {
        key: np.array(value, dtype=float).ravel(order="F") for key, value in values.items()
    }


def pose_of(robot, p, q):
    return np.array(robot.pose(p, q), dtype=float)


def joints_within(robot, rng):
    return rng.uniform([j.lower for j in robot.axes], [j.upper for j in robot.axes])


def test_hayatis_link_is_the_product_of_its_motions():
    rng = np.random.default_rng(0)
    for alpha, beta, a, theta in rng.uniform(-3, 3, (RNG_POSES, 4)):
        expected = rot_z(theta) @ shift(100 * a, 0, 0) @ rot_x(alpha) @ rot_y(beta)
        np.testing.assert_allclose(np.array(k.hayati(alpha, beta, 100 * a, theta)), expected, atol=1e-12)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_a_dh_table_with_parallel_rows(convention):
    rng = np.random.default_rng(1)
    alpha = deg(90, 0, 180, 90, -90, 0) if convention == "standard" else deg(0, 90, 0, 180, 90, -90)
    a, d, theta = rng.uniform(-500, 500, (3, 6))
    robot = Robot.from_dh(
        "r", alpha=alpha, a=a, d=d, theta=theta, parallel=(2, 3), convention=convention, joints="RRRPRR"
    )
    assert robot.parameters["beta"].names("beta") == ("beta2", "beta3")
    assert robot.parameters["d"].names("d") == ("d1", "d4", "d5", "d6")
    for _ in range(RNG_POSES):
        p, v = moved(robot, rng)
        q = joints_within(robot, rng)
        expected, beta = np.eye(4), dict(zip((2, 3), v["beta"], strict=True))
        for i in range(6):
            d_i, theta_i = v["d"][i] + q[i] * (i == 3), v["theta"][i] + q[i] * (i != 3)
            spin = rot_z(theta_i) @ shift(0, 0, d_i)
            if convention == "standard":
                expected = expected @ spin @ shift(v["a"][i], 0, 0) @ rot_x(v["alpha"][i]) @ rot_y(beta.get(i + 1, 0))
            else:  # the row holds what lies between axis i and axis i + 1, counted from 1
                expected = expected @ rot_x(v["alpha"][i]) @ shift(v["a"][i], 0, 0) @ rot_y(beta.get(i, 0)) @ spin
        np.testing.assert_allclose(pose_of(robot, p, q), expected, atol=1e-9)


def test_standard_and_modified_tables_of_one_arm_agree_on_what_beta_does():
    rng = np.random.default_rng(5)
    a, d = rng.uniform(100, 500, (2, 4))
    standard = Robot.from_dh("s", alpha=(0.3, 0, 0.5, 0), a=(*a[1:], 0), d=d, theta=(0,) * 4, parallel=(2,))
    modified = Robot.from_dh(
        "m", alpha=(0, 0.3, 0, 0.5), a=(0, *a[1:]), d=d, theta=(0,) * 4, parallel=(2,), convention="modified"
    )
    one, two = nominal(standard), nominal(modified)
    one.beta = two.beta = ca.DM([0.01])
    q = rng.uniform(-3, 3, 4)
    np.testing.assert_allclose(pose_of(standard, one, q), pose_of(modified, two, q), atol=1e-10)


def test_small_changes_reach_every_axis_near_a_parallel_one():
    """Third axis of three, met in the origin of the last row: two tilts and two places, each from one parameter."""
    robot = Robot.from_dh("r", alpha=deg(90, 0, 0), a=(0, 400, 0), d=(100, 0, 0), theta=(0,) * 3, parallel=(2,))

    def axis(key, i, step):
        p = nominal(robot)
        values = np.array(getattr(p, key), dtype=float).ravel()
        values[i] += step
        setattr(p, key, values)
        pose = pose_of(robot, p, [0, 0, 0])
        return np.array([pose[0, 2], pose[2, 2], pose[0, 3], pose[2, 3]])

    moves = [
        (axis(key, i, 1e-6) - axis(key, i, -1e-6)) / 2e-6 / scale
        for key, i, scale in (("beta", 0, 1), ("alpha", 1, 1), ("a", 1, 1), ("theta", 1, 400))
    ]
    np.testing.assert_allclose(np.linalg.svd(moves, compute_uv=False), 1, atol=1e-6)


def test_controller_conventions_come_first():
    rng = np.random.default_rng(2)
    conventions = Conventions((1, -1, 1), (0.1, 0.2, 0.3), ((3, 2, -1.0),))
    table = {"alpha": (1.2, 0.3, -0.4), "a": (100, 200, 300), "d": (10, 20, 30), "theta": (0.5, 0.6, 0.7)}
    robot = Robot.from_dh("r", **table, conventions=conventions)
    for q in rng.uniform(-3, 3, (RNG_POSES, 3)):
        model = [q[0] + 0.1, -q[1] + 0.2, q[2] - q[1] + 0.3]
        expected = dh_chain(table["alpha"], table["a"], table["d"], np.add(table["theta"], model))
        np.testing.assert_allclose(pose_of(robot, nominal(robot), q), expected, atol=1e-9)
        symbol = ca.SX.sym("q", 3)
        compiled = ca.Function("pose", [symbol], [ca.SX(robot.pose(nominal(robot), symbol))])
        np.testing.assert_allclose(np.array(compiled(q)), expected, atol=1e-9)


def rodrigues(axis, point, angle):
    """Rotation about an axis through a point, by SciPy's rotation vectors."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(angle * np.asarray(axis)).as_matrix()
    matrix[:3, 3] = point - matrix[:3, :3] @ point
    return matrix


def test_screws_against_scipy():
    rng = np.random.default_rng(3)
    axes, points, home = rng.normal(size=(4, 3)), rng.uniform(-500, 500, (4, 3)), np.eye(4)
    home[:3, :3], home[:3, 3] = Rotation.random(random_state=1).as_matrix(), (700, -20, 300)
    robot = Robot.from_screws("r", axes=axes, points=points, home=home, joints="RRPR")
    assert "point3" not in robot.parameters
    assert robot.parameters["zero"].names("zero") == ("zero1", "zero2", "zero4")
    for _ in range(RNG_POSES):
        p, v = moved(robot, rng)
        q = joints_within(robot, rng)
        units = [v[f"axis{i}"] for i in (1, 2, 3, 4)]
        for unit in units:
            assert np.linalg.norm(unit) == pytest.approx(1)
        expected = rodrigues(units[0], v["point1"], q[0] + v["zero"][0])
        expected = expected @ rodrigues(units[1], v["point2"], q[1] + v["zero"][1])
        expected = expected @ shift(*(q[2] * units[2]))
        expected = expected @ rodrigues(units[3], v["point4"], q[3] + v["zero"][2]) @ v["home"].reshape(4, 4, order="F")
        np.testing.assert_allclose(pose_of(robot, p, q), expected, atol=1e-9)


def test_screws_of_the_ur5_meet_its_dh_table(tmp_path):
    # Lynch & Park, Modern Robotics, example 4.5: the UR5's own zero position and screws, m
    w1, w2, h1, h2, l1, l2 = 109, 82, 89, 95, 425, 392
    axes = [(0, 0, 1), (0, 1, 0), (0, 1, 0), (0, 1, 0), (0, 0, -1), (0, 1, 0)]
    points = [(0, 0, 0), (0, 0, h1), (l1, 0, h1), (l1 + l2, 0, h1), (l1 + l2, w1, 0), (l1 + l2, 0, h1 - h2)]
    home = [[-1, 0, 0, l1 + l2], [0, 0, 1, w1 + w2], [0, 1, 0, h1 - h2], [0, 0, 0, 1]]
    robot = Robot.from_screws("UR5", axes=axes, points=points, home=home)
    # the book: with theta2 = -90 and theta5 = 90 degrees, all others 0
    pose = pose_of(robot, nominal(robot), [0, -math.pi / 2, 0, 0, math.pi / 2, 0])
    expected = [[0, -1, 0, 95], [1, 0, 0, 109], [0, 0, 1, 988], [0, 0, 0, 1]]
    np.testing.assert_allclose(pose, expected, atol=1e-9)


@pytest.fixture
def urdf(tmp_path):
    def write(text, name="arm.urdf"):
        (tmp_path / name).write_text(text, encoding="utf-8")
        return tmp_path / name

    return write


def xml_chain(text, names, q, origin=None):
    """Forward kinematics (m) of the named joints straight from the XML, by ElementTree and SciPy."""
    joints = {joint.get("name"): joint for joint in ElementTree.fromstring(text).findall("joint")}
    pose, values = np.eye(4), iter(q)

    def numbers(element, key, default="0 0 0"):
        return np.array((element.get(key, default) if element is not None else default).split(), dtype=float)

    for name in names:
        joint = joints[name]
        place, move = np.eye(4), np.eye(4)
        place[:3, 3] = numbers(joint.find("origin"), "xyz")
        place[:3, :3] = Rotation.from_euler("xyz", numbers(joint.find("origin"), "rpy")).as_matrix()
        if origin is not None and name in origin:
            place = origin[name](place)
        if joint.get("type") != "fixed":
            axis = numbers(joint.find("axis"), "xyz", "1 0 0")
            axis, value = axis / np.linalg.norm(axis), next(values)
            if joint.get("type") == "prismatic":
                move[:3, 3] = axis * value
            else:
                move[:3, :3] = Rotation.from_rotvec(axis * value).as_matrix()
        pose = pose @ place @ move
    return pose


UR5_JOINTS = ["base_fixed", "shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
ODD_JOINTS = ["rail", "plate", "spin", "swing", "end"]


@pytest.mark.parametrize(
    ("text", "tip", "names"),
    [(UR5_URDF, "tool0", [*UR5_JOINTS, "to_flange", "to_tool0"]), (ODD_URDF, None, ODD_JOINTS)],
    ids=["ur5", "odd"],
)
def test_a_urdf_against_its_xml(urdf, text, tip, names):
    robot = Robot.from_urdf(urdf(text), tip=tip)
    rng = np.random.default_rng(4)
    scale = np.array([1000.0 if joint.kind == "prismatic" else 1.0 for joint in robot.axes])
    for _ in range(RNG_POSES):
        q = joints_within(robot, rng)
        expected = xml_chain(text, names, q / scale)
        pose = pose_of(robot, nominal(robot), q)
        np.testing.assert_allclose(pose[:3, :3], expected[:3, :3], atol=1e-12)
        np.testing.assert_allclose(pose[:3, 3], 1000 * expected[:3, 3], atol=1e-9)


def test_calibrated_origins_turn_about_their_own_axes(urdf):
    robot = Robot.from_urdf(urdf(ODD_URDF))
    rng = np.random.default_rng(6)
    assert robot.parameters["ry"].names("ry") == ("ry1", "ry2", "ry3")
    p, v = moved(robot, rng)

    def replaced(i):
        def origin(place):
            new = place.copy()
            new[:3, 3] = np.array([v["x"][i], v["y"][i], v["z"][i]]) / 1000
            small = Rotation.from_euler("XYZ", [v["rx"][i], v["ry"][i], v["rz"][i]])
            new[:3, :3] = place[:3, :3] @ small.as_matrix()
            return new

        return origin

    q = joints_within(robot, rng)
    origin = {name: replaced(i) for i, name in enumerate(("rail", "spin", "swing"))}
    expected = xml_chain(ODD_URDF, ODD_JOINTS, q / np.array([1000, 1, 1]), origin)
    np.testing.assert_allclose(pose_of(robot, p, q)[:3, 3], 1000 * expected[:3, 3], atol=1e-9)


def test_limits_of_a_urdf_in_rad_and_mm(urdf):
    joints = Robot.from_urdf(urdf(ODD_URDF)).axes
    assert joints[0] == Joint("prismatic", -500.0, 1500.0)
    assert joints[1] == Joint("revolute", -math.pi, math.pi)
    assert joints[2] == Joint("revolute", -1.0, 2.0)


def test_a_urdf_behind_a_controller(urdf):
    conventions = Conventions((1, -1, 1), (0.0, 0.0, 0.5))
    plain = Robot.from_urdf(urdf(ODD_URDF))
    robot = Robot.from_urdf(urdf(ODD_URDF), conventions=conventions)
    np.testing.assert_allclose((robot.axes[2].lower, robot.axes[2].upper), (-1.5, 1.5))
    q = np.array([100.0, 0.3, 0.7])
    np.testing.assert_allclose(
        pose_of(robot, nominal(robot), q), pose_of(plain, nominal(plain), [100.0, -0.3, 1.2]), atol=1e-10
    )


def test_part_of_a_urdf_may_be_named(urdf):
    robot = Robot.from_urdf(urdf(UR5_URDF), base="shoulder", tip="w1", name="part")
    assert (robot.name, len(robot.axes)) == ("part", 3)


def test_published_poses_of_well_known_arms(tmp_path):
    (tmp_path / "ur5.csv").write_text(UR5_CSV)
    (tmp_path / "puma.toml").write_text(PUMA_TOML)
    ur5, puma = (Robot.from_dh_file(tmp_path / name) for name in ("ur5.csv", "puma.toml"))
    # Corke's toolbox, mdl_ur5 at zero: x = a2 + a3, y = -(d4 + d6), z = d1 - d5
    np.testing.assert_allclose(pose_of(ur5, nominal(ur5), [0] * 6)[:3, 3], (-817.25, -191.45, -5.491), atol=1e-9)
    # the Puma at its model's zero, p560.fkine(qz), where the controller's conventions put it
    shown = puma.arm.conventions.to_controller(np.zeros(6))
    pose = pose_of(puma, nominal(puma), shown)
    np.testing.assert_allclose(pose[:3, 3], [452.1, -150.05, 431.8], atol=1e-6)
    np.testing.assert_allclose(pose[:3, :3], np.eye(3), atol=1e-12)
    # the iiwa stands upright at zero, 360 + 420 + 400 + 126 mm high
    angles = {key: deg(*IIWA[key]) for key in ("alpha", "theta")}
    iiwa = Robot.from_dh("iiwa", a=IIWA["a"], d=IIWA["d"], **angles, convention="modified")
    np.testing.assert_allclose(pose_of(iiwa, nominal(iiwa), [0] * 7), shift(0, 0, 1306), atol=1e-9)
    q = np.random.default_rng(7).uniform(-2, 2, 7)
    expected = modified_dh_chain(angles["alpha"], IIWA["a"], IIWA["d"], q)
    np.testing.assert_allclose(pose_of(iiwa, nominal(iiwa), q), expected, atol=1e-9)


TABLE = {"alpha": (1.5, 0.0), "a": (100, 200), "d": (10, 20), "theta": (0, 0)}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"parallel": (1,)}, "make 85.9437 degrees"),
        ({"parallel": (2,)}, "rows of 1 to 1 in order"),
        ({"parallel": (0,)}, "rows of 1 to 1"),
        ({"beta": (0.1,)}, "1 beta for 0 parallel rows"),
        ({"conventions": Conventions.plain(3)}, "2 joints and conventions for 3"),
        ({"convention": "classic"}, "Use 'standard' or 'modified'"),
    ],
)
def test_bad_tables_are_refused(options, words):
    with pytest.raises(ProblemError, match=words):
        Robot.from_dh("r", **{**TABLE, **options})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"axes": [(0, 0, 0)] * 2}, "not all zero"),
        ({"points": [(0, 0)] * 2}, "point of joint 1"),
        ({"points": [(0, 0, 0)]}, "1 points for 2 joints"),
        ({"home": np.ones((4, 4))}, "rigid"),
    ],
)
def test_bad_screws_are_refused(change, words):
    good = {"axes": [(0, 0, 1)] * 2, "points": [(0, 0, 0)] * 2, "home": np.eye(4)}
    with pytest.raises(ProblemError, match=words):
        Robot.from_screws("r", **{**good, **change})


def test_an_arm_without_a_nominal_length_is_refused_at_once():
    """What is measured against may be found from the rows, an arm's own numbers not."""
    with pytest.raises(ProblemError, match=r"parameter 'l' has no nominal value\. Give it the drawing's"):
        Robot("r", 1, lambda p, q: k.chain(k.rotate_z(q[0]), k.translate_x(p.l)), {"l": Parameter(None, unit="mm")})


@pytest.mark.parametrize(("convention", "beside"), [("standard", (0.2, 0.3)), ("modified", (0.3, 0.4))])
def test_the_second_angle_of_a_parallel_row_is_as_uncertain_as_the_twist_between_the_same_axes(convention, beside):
    alpha = deg(90, 0, 0, 90) if convention == "standard" else deg(90, 90, 0, 0)
    robot = Robot.from_dh(
        "r", alpha=alpha, a=(100,) * 4, d=(50,) * 4, theta=(0,) * 4, parallel=(2, 3), convention=convention,
        twist_std=(0.1, 0.2, 0.3, 0.4),
    )  # fmt: skip
    np.testing.assert_allclose(robot.parameters["beta"].prior_stds, beside)
