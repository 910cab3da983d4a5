"""Shapes of links, as a URDF has them: where they are, whether they meet, and plans that keep them apart."""

import json
import math
import pickle
from xml.etree import ElementTree

import numpy as np
import pytest
from conftest import ROOT
from robots_of_others import UR5_URDF
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from casacal import Cell, Face, Problem, Robot, load_problem, plan
from casacal.cli.main import main
from casacal.errors import ProblemError
from casacal.planning.clearance import Clearance
from casacal.planning.link_shapes import FREE, Body, LinkShapes, gap

SHAPES = {
    "base_link": '<box size="0.12 0.14 0.02"/>|0 0 0.01|0 0 0',
    "upper": '<box size="0.4 0.11 0.11"/>|-0.2125 0 0.13|0 0 0',
    "fore": '<cylinder radius="0.045" length="0.3"/>|-0.17 0 0.02|0 1.5707963 0',
    "w1": '<sphere radius="0.045"/>|0 -0.02 0|0 0 0',
    "w2": '<box size="0.08 0.09 0.08"/>|0 0.01 0|0 0 0',
    "w3": '<cylinder radius="0.04" length="0.03"/>|0 0 -0.02|0 0 0',
}


def with_shapes(shapes):
    text = UR5_URDF
    for link, said in shapes.items():
        shape, xyz, rpy = said.split("|")
        inside = f'<collision><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{shape}</geometry></collision>'
        assert f'<link name="{link}"/>' in text
        text = text.replace(f'<link name="{link}"/>', f'<link name="{link}">{inside}</link>')
    return text


@pytest.fixture
def urdf(tmp_path):
    path = tmp_path / "ur5.urdf"
    path.write_text(with_shapes(SHAPES))
    return path


def random_pose(rng, reach):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng.integers(2**31)).as_matrix()
    pose[:3, 3] = rng.uniform(-reach, reach, 3)
    return pose


def met(one, other):
    """Whether two convex hulls (v, 3) have a point in common: a linear programme."""
    a, b = len(one), len(other)
    rows = np.vstack([np.hstack([one.T, -other.T]), [[1.0] * a + [0.0] * b], [[0.0] * a + [1.0] * b]])
    return linprog(np.zeros(a + b), A_eq=rows, b_eq=[0, 0, 0, 1, 1], bounds=(0, None)).status == 0


def test_bodies_meet_where_their_hulls_have_a_point_in_common():
    rng = np.random.default_rng(0)
    found = []
    for _ in range(150):
        box = Body.box(random_pose(rng, 40.0), rng.uniform(10, 80, 3))
        other = (
            Body.cylinder(random_pose(rng, 40.0), rng.uniform(5, 30), rng.uniform(10, 80))
            if rng.random() < 0.6
            else Body.box(random_pose(rng, 40.0), rng.uniform(10, 80, 3))
        )
        apart = float(gap(box, other)[0])
        assert apart == pytest.approx(float(gap(other, box)[0]), abs=1e-9)
        assert (apart <= 0) == met(box.corners[0], other.corners[0])
        found.append(apart)
    assert 30 < sum(each > 0 for each in found) < 120


def test_a_prism_holds_its_cylinder_and_little_more():
    rng = np.random.default_rng(1)
    pose = random_pose(rng, 100.0)
    prism = Body.cylinder(pose, 30.0, 80.0)
    turn, z = rng.uniform(0, 2 * math.pi, 400), rng.uniform(-40, 40, 400)

    def away(radius):
        local = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), z])
        return gap(prism, Body.ball(local @ pose[:3, :3].T + pose[:3, 3], 0.0))

    assert (away(29.99) <= 1e-9).all()
    assert (away(30.0 / math.cos(math.pi / 8) + 0.5) > 0).all()
    ends = pose[:3, 3] + np.array([[41.0], [-41.0]]) * pose[:3, 2]
    assert gap(prism, Body.ball(ends, 0.5)) == pytest.approx(0.5)


def link_poses(text, joints):
    """Pose (4, 4; mm) of each link of a URDF by its name: every joint multiplied out with SciPy's rotations."""
    tree = ElementTree.fromstring(text.split("?>")[1])
    values, poses = iter(joints), {"base_link": np.eye(4)}
    for joint in tree.findall("joint"):
        origin, axis = joint.find("origin"), joint.find("axis")
        said = {} if origin is None else origin.attrib
        xyz, rpy = (np.array([float(v) for v in said.get(key, "0 0 0").split()]) for key in ("xyz", "rpy"))
        step = np.eye(4)
        step[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
        step[:3, 3] = xyz * 1000
        if joint.get("type") == "revolute":
            along = np.array([float(v) for v in axis.get("xyz").split()])
            step[:3, :3] = step[:3, :3] @ Rotation.from_rotvec(along * next(values)).as_matrix()
        poses[joint.find("child").get("link")] = poses[joint.find("parent").get("link")] @ step
    return poses


def test_shapes_are_where_the_links_are(urdf):
    robot = Robot.from_urdf(urdf, tip="tool0")
    shapes = LinkShapes.of(robot)
    joints = np.random.default_rng(2).uniform(-3, 3, (5, 6))
    assert [shape.link for shape in shapes.shapes] == list(SHAPES)
    assert [shape.carrier for shape in shapes.shapes] == [-1, 1, 2, 3, 4, 5]
    placed = shapes.at(joints)
    for k, row in enumerate(joints):
        poses = link_poses(urdf.read_text(), row)
        for shape, body in zip(shapes.shapes, placed, strict=True):
            _, xyz, rpy = SHAPES[shape.link].split("|")
            inside = np.eye(4)
            inside[:3, :3] = Rotation.from_euler("xyz", [float(v) for v in rpy.split()]).as_matrix()
            inside[:3, 3] = np.array([float(v) for v in xyz.split()]) * 1000
            pose = poses[shape.link] @ inside
            corners = body.corners[k if len(body.corners) > 1 else 0]
            local = (corners - pose[:3, 3]) @ pose[:3, :3]
            extent = {"box": np.array(shape.size) / 2, "sphere": np.zeros(3)}.get(shape.kind)
            if extent is None:
                wide = shape.size[0] / math.cos(math.pi / 8)
                assert np.hypot(local[:, 0], local[:, 1]) == pytest.approx(wide, abs=1e-6)
                extent = [np.abs(local[:, 0]).max(), np.abs(local[:, 1]).max(), shape.size[1] / 2]
            assert np.abs(local).max(axis=0) == pytest.approx(np.array(extent), abs=1e-5)
    again = pickle.loads(pickle.dumps(shapes))
    assert again == shapes


def test_postures_are_clear_or_not_as_their_hulls_say(urdf):
    """Boxes, plates and links against one another by linear programmes; neighbours may meet."""
    robot = Robot.from_urdf(urdf, tip="tool0")
    shapes = LinkShapes.of(robot)
    joints = np.random.default_rng(5).uniform(-2.5, 2.5, (60, 6))
    placed = shapes.at(joints)
    ranges = ((250.0, 450.0), (-300.0, 300.0), (100.0, 900.0))
    face = Face("floor", (0.0, 0.0, -150.0), (0.0, 0.0, 1.0), (3000.0, 3000.0))
    box = np.array([[x, y, z] for x in ranges[0] for y in ranges[1] for z in ranges[2]])
    plate = np.array([[x, y, z] for x in (-1500.0, 1500.0) for y in (-1500.0, 1500.0) for z in (-190.0, -150.0)])
    far = np.full((60, 3), 1e5)  # no tip near any link: the last one counts too
    found = Clearance((ranges,), shapes=shapes).clear(robot, Cell(faces=(face,), table=-math.inf), joints, far)
    hulls = [k for k, shape in enumerate(shapes.shapes) if shape.kind != "sphere"]
    carriers = [shape.carrier for shape in shapes.shapes]
    for k in range(60):
        bodies = {i: placed[i].corners[k if len(placed[i].corners) > 1 else 0] for i in hulls}
        meet = any(met(bodies[i], box) or met(bodies[i], plate) for i in hulls if carriers[i] >= 0)
        meet |= any(met(bodies[i], bodies[j]) for i in hulls for j in hulls if carriers[j] - carriers[i] > 1)
        if meet:
            assert not found[k], k
        near = min(float(shapes_gap(shapes, placed, k, box, plate)), 1e9)
        assert found[k] == (near > FREE)
    assert 5 < found.sum() < 55


def test_shapes_stay_above_the_table(urdf):
    """Corners of boxes and cylinders, and spheres, are held up; the base and what turns upon it are not asked."""
    robot = Robot.from_urdf(urdf, tip="tool0")
    shapes, joints = LinkShapes.of(robot), np.random.default_rng(6).uniform(-2.5, 2.5, (80, 6))
    placed = shapes.at(joints)
    moving = [body for shape, body in zip(shapes.shapes, placed, strict=True) if shape.carrier > 0]
    counts = []
    for table in (-400.0, 0.0, 100.0):
        expected = [all(body.corners[k, :, 2].min() - body.radius >= table for body in moving) for k in range(80)]
        assert shapes.above(table, joints).tolist() == expected
        counts.append(sum(expected))
    made = plan(
        Problem(robot, load_problem(ROOT / "problems" / "ur5").problem.instrument),
        cell_of_ur5(), touches=30, pool=150, starts=1, clearance=Clearance(shapes=shapes),
    )  # fmt: skip
    assert counts[0] > counts[1] > counts[2]
    assert shapes.above(0.0, made.samples.joints).all()


def shapes_gap(shapes, placed, k, box, plate):
    """Least gap of one posture, each pair by itself."""
    sides = {"box": box, "plate": plate}
    solids = []
    for corners in sides.values():
        pose = np.eye(4)
        pose[:3, 3] = corners.mean(axis=0)
        solids.append(Body.box(pose, np.ptp(corners, axis=0)))
    one = [
        Body(
            body.corners[min(k, len(body.corners) - 1)][None],
            body.normals[min(k, len(body.normals) - 1)][None],
            body.edges[min(k, len(body.edges) - 1)][None],
            body.radius,
        )
        for body in placed
    ]
    moving = [i for i, shape in enumerate(shapes.shapes) if shape.carrier >= 0]
    gaps = [float(gap(one[i], solid)[0]) for i in moving for solid in solids]
    gaps += [
        float(gap(one[i], one[j])[0])
        for i in range(len(one))
        for j in range(len(one))
        if shapes.shapes[j].carrier - shapes.shapes[i].carrier > 1
    ]
    return min(gaps)


def test_what_meets_wherever_the_arm_is_counts_as_a_neighbour(tmp_path):
    """A shoulder drawn so large that it holds the forearm's end would bar every posture."""
    path = tmp_path / "arm.urdf"
    path.write_text(with_shapes({**SHAPES, "shoulder": '<sphere radius="0.7"/>|0 0 0|0 0 0'}))
    shapes = LinkShapes.of(Robot.from_urdf(path, tip="tool0"))
    names = [shape.link for shape in shapes.shapes]
    pairs = {(names[i], names[j]) for i, j in shapes.pairs}
    assert ("shoulder", "fore") not in pairs
    assert ("upper", "w1") in pairs
    assert ("upper", "fore") not in pairs
    assert ("shoulder", "fore") in shapes.let_be
    assert "Not checked against each other, because they touch in every posture: shoulder and fore" in shapes.words


def test_shapes_that_are_seldom_apart_are_held_against_each_other(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(with_shapes({**SHAPES, "shoulder": '<sphere radius="0.43"/>|0 0 0|0 0 0'}))
    robot = Robot.from_urdf(path, tip="tool0")
    shapes = LinkShapes.of(robot)
    joints = np.random.default_rng(7).uniform(-3, 3, (300, 6))
    names = [shape.link for shape in shapes.shapes]
    one, other = (shapes.at(joints)[names.index(name)] for name in ("shoulder", "fore"))
    apart = gap(one, other)
    assert 0.8 < (apart <= 0).mean() < 1
    clear = shapes.clear((), (), joints, np.full((300, 3), 1e5))
    assert not clear[apart <= 0].any()
    assert clear.any()


def test_what_stands_with_the_base_counts_though_the_arm_begins_above_it(tmp_path):
    """A table at the root, the arm's base fixed to it; and with a rail between, which is no joint of the arm."""
    path = tmp_path / "arm.urdf"
    table = (
        '<link name="floor"><collision><origin xyz="0.5 0 0.1"/><geometry><box size="0.6 0.8 0.1"/></geometry>'
        '</collision></link><joint name="stand" type="fixed"><origin xyz="0 0 -0.3" rpy="0 0 0.5"/>'
        '<parent link="floor"/><child link="base_link"/></joint>'
    )
    text = with_shapes(SHAPES)
    path.write_text(text.replace("</robot>", f"{table}</robot>"))
    shapes = LinkShapes.of(Robot.from_urdf(path, tip="tool0", base="base_link"))
    (k,) = (k for k, shape in enumerate(shapes.shapes) if shape.link == "floor")
    assert shapes.shapes[k].carrier == -1
    back = Rotation.from_euler("z", -0.5).as_matrix()
    np.testing.assert_allclose(shapes.shapes[k].pose[:3, 3], back @ [500.0, 0, 400.0], atol=1e-9)
    assert {(shapes.shapes[i].link, shapes.shapes[j].link) for i, j in shapes.pairs} >= {("fore", "floor")}
    moving = table.replace('type="fixed"', 'type="prismatic"').replace(
        "<parent", '<axis xyz="1 0 0"/><limit lower="0" upper="1"/><parent'
    )
    path.write_text(text.replace("</robot>", f"{moving}</robot>"))
    shapes = LinkShapes.of(Robot.from_urdf(path, tip="tool0", base="base_link"))
    assert "floor" not in [shape.link for shape in shapes.shapes]
    assert shapes.unread == ("floor",)


def cell_of_ur5():
    return load_problem(ROOT / "problems" / "ur5").cell


@pytest.mark.long
def test_a_plan_keeps_shapes_clear(urdf):
    problem = Problem(Robot.from_urdf(urdf, tip="tool0"), load_problem(ROOT / "problems" / "ur5").problem.instrument)
    shapes, cell = LinkShapes.of(problem.robot), cell_of_ur5()
    free = plan(problem, cell, touches=60, pool=400, starts=1)
    kept = plan(problem, cell, touches=60, pool=400, starts=1, clearance=Clearance(shapes=shapes))

    def meet(made):
        placed = shapes.at(made.samples.joints)
        return np.array(
            [
                any(met(placed[i].corners[k], placed[j].corners[k]) for i, j in ((1, 4), (1, 5), (2, 5)))
                or any(met(placed[i].corners[k], plate_of(face)) for i in (1, 2) for face in cell.faces)
                for k in range(len(made))
            ]
        )

    assert meet(free).any()
    assert not meet(kept).any()
    assert len(kept) == 60


def plate_of(face):
    normal, u, v = face.axes
    half = np.array(face.size) / 2
    return np.array(
        [
            np.asarray(face.centre) + a * half[0] * u + b * half[1] * v - depth * normal
            for a in (-1, 1)
            for b in (-1, 1)
            for depth in (0.0, 30.0)
        ]
    )


def test_the_tool_may_come_near_a_face_and_the_wrist_may_not(tmp_path):
    """The last link's shapes are looked at but for the one that holds the tip."""
    path = tmp_path / "arm.urdf"
    path.write_text(with_shapes({"w3": '<cylinder radius="0.04" length="0.03"/>|0 0 -0.02|0 0 0'}))
    text = path.read_text().replace(
        '<link name="tool0"/>',
        '<link name="tool0"><collision><origin xyz="0 0 0.06"/><geometry><cylinder radius="0.008" length="0.12"/>'
        "</geometry></collision></link>",
    )
    path.write_text(text)
    robot = Robot.from_urdf(path, tip="tool0")
    shapes = LinkShapes.of(robot)
    assert [shape.carrier for shape in shapes.shapes] == [5, 5]
    joints = np.array([[0.3, -1.2, 1.4, -1.7, -1.5, 0.2]])
    tool = link_poses(text, joints[0])["tool0"]
    down = tool[:3, 2]
    tip = tool[:3, 3] + 120 * down

    def clear(centre):
        cell = Cell(faces=(Face("plate", tuple(centre), tuple(-down), (300.0, 300.0)),))
        return bool(Clearance(shapes=shapes).clear(robot, cell, joints, tip[None])[0])

    assert clear(tip)
    assert clear(tip - 10 * down)  # the plunger is pushed in
    assert not clear(tip - 130 * down)  # the wrist itself would be in the plate


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ('<box size="500 110 110"/>|0 0 0|0 0 0', "measures 500 110 110"),
        ('<box size="0.5 0.1"/>|0 0 0|0 0 0', "size of a collision of link 'upper' is '0.5 0.1'"),
        ('<cylinder radius="0.05"/>|0 0 0|0 0 0', "length of a collision of link 'upper' is ''"),
        ('<sphere radius="-0.05"/>|0 0 0|0 0 0', "measures -0.05"),
        ('<sphere radius="nan"/>|0 0 0|0 0 0', "is 'nan'"),
        ('<sphere radius="0.05"/>|0 0|0 0 0', "xyz of a collision of link 'upper' is '0 0'"),
    ],
)
def test_shapes_that_are_none_are_refused(tmp_path, shape, said):
    path = tmp_path / "arm.urdf"
    path.write_text(with_shapes({"upper": shape}))
    with pytest.raises(ProblemError) as error:
        LinkShapes.of(Robot.from_urdf(path, tip="tool0"))
    assert said in str(error.value)
    assert str(path) in str(error.value)


def test_meshes_are_named_and_other_arms_have_no_shapes(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(with_shapes({**SHAPES, "fore": '<mesh filename="package://ur/fore.stl"/>|0 0 0|0 0 0'}))
    shapes = LinkShapes.of(Robot.from_urdf(path, tip="tool0"))
    assert shapes.unread == ("fore",)
    assert "Not checked: shapes of fore that are not boxes, cylinders or spheres" in shapes.words
    path.write_text(with_shapes({}))
    assert LinkShapes.of(Robot.from_urdf(path, tip="tool0")).words == ""
    with pytest.raises(ProblemError, match="does not come from a URDF"):
        LinkShapes.of(load_problem(ROOT / "problems" / "ur5").problem.robot)


@pytest.mark.long
def test_the_command_line_looks_at_shapes(tmp_path, urdf, capsys):
    folder = tmp_path / "cell"
    folder.mkdir()
    (folder / "ur5.urdf").write_text(urdf.read_text())
    (folder / "problem.py").write_text(
        "from pathlib import Path\n"
        "from casacal import Cell, DialOnPlane, Problem, Robot, corner, tool_point\n"
        "robot = Robot.from_urdf(Path(__file__).with_name('ur5.urdf'), tip='tool0')\n"
        "problem = Problem(robot, DialOnPlane(noise_std=0.01, sign=-1, tool=tool_point(0, 0, 120, prior_std=1.0)))\n"
        "cell = Cell(faces=corner((450.0, 0.0, 250.0), size=300.0))\n"
    )
    out = tmp_path / "plan.csv"
    common = ["plan", str(folder), "--touches", "60", "--pool", "300", "--out", str(out)]
    assert main(common) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "Kept 5 mm clear: 6 shapes of 6 links, as the URDF has them." in told
    looked = out.read_text()
    assert main([*common, "--ignore-shapes"]) == 0
    assert "6 shapes of 6 links" not in capsys.readouterr().out
    assert out.read_text() != looked
    assert main([*common, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["shapes"] == {
        "looked_at": list(SHAPES),
        "not_looked_at": [],
        "let_be": [],
    }
