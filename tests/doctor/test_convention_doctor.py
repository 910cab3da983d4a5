"""The convention doctor against arms whose conventions are known, their kinematics multiplied by NumPy alone."""

import math
import tomllib
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT
from oracles import dh_chain
from robots_of_others import PUMA_TOML
from scipy.spatial.transform import Rotation

from casacal import Conventions, Joint, Parameter, Robot, chain, deg, diagnose
from casacal.cli.main import main
from casacal.doctor import PendantRows, read_pendant_rows
from casacal.doctor.diagnosis import Meaning, further_pose
from casacal.doctor.search import Halves
from casacal.doctor.words import diagnosis_text
from casacal.errors import CasacalError, ProblemError, SamplesError
from casacal.model.axes import axes_of
from casacal.model.dh_file import dh_file_text, read_dh_file
from casacal.model.kinematics import rotate_x, rotate_z, translate_x, translate_z

HSR = (ROOT / "problems" / "hsr_jr680").as_posix()
QUARTER = math.pi / 2

TABLES = {  # alpha and theta in degrees, a and d in mm
    "hsr": (
        (-90, 0, 90, -90, 90, 0),
        (250, 900, -206, 0, 0, 0),
        (653.5, 0, 0, 1030, 0, 200.6),
        (0, -90, 180, 0, 90, 0),
    ),
    "ur": ((90, 0, 0, 90, -90, 0), (0, -425, -392.2, 0, 0, 0), (162.5, 0, 0, 133.3, 99.7, 99.6), (0,) * 6),
    "puma": ((90, 0, -90, 90, -90, 0), (0, 431.8, 20.3, 0, 0, 0), (671.8, 0, 150, 431.8, 0, 56.2), (0,) * 6),
    "meet": ((90, 0, -90, 90, -90, 0), (0, 431.8, 20.3, 0, 0, 0), (0, 0, 150, 431.8, 0, 0), (0,) * 6),
    "kuka": ((-90, 0, -90, 90, -90, 180), (260, 680, -35, 0, 0, 0), (-675, 0, 0, -670, 0, -158), (0, 0, -90, 0, 0, 0)),
}
ORIENTATIONS = ("quaternion", "xyz", "ZYX", "ZYZ", "XYZ", "vector")
NAMES = {
    "quaternion": ("quaternion", ""),
    "xyz": ("fixed-xyz", "deg"),
    "ZYX": ("zyx", "deg"),
    "ZYZ": ("zyz", "deg"),
    "XYZ": ("xyz", "deg"),
    "vector": ("rotation-vector", "rad"),
}
COUPLINGS = (
    (),
    ((3, 2, -1.0),),
    ((3, 2, 1.0),),
    ((5, 4, -1.0), (6, 5, 1.0)),
    ((3, 2, -1.0), (6, 5, -1.0)),
    ((6, 4, 1.0),),
    ((2, 3, -1.0),),
)


def poses(table, q):
    """Standard DH for many rows at once, (N, 4, 4), from sines and cosines written out."""
    alpha, a, d, theta = (np.array(column, dtype=float) for column in table)
    product = np.tile(np.eye(4), (len(q), 1, 1))
    for i in range(q.shape[1]):
        ct, st = np.cos(theta[i] + q[:, i]), np.sin(theta[i] + q[:, i])
        ca, sa = math.cos(alpha[i]), math.sin(alpha[i])
        o, one = np.zeros(len(q)), np.ones(len(q))
        rows = [
            [ct, -st * ca, st * sa, a[i] * ct],
            [st, ct * ca, -ct * sa, a[i] * st],
            [o, sa * one, ca * one, d[i] * one],
        ]
        link = np.array([*rows, [o, o, o, one]]).transpose(2, 0, 1)
        product = product @ link
    return product


def in_model(q, signs, quarters, coupling):
    """The controller's joint values in the model's terms, joint by joint."""
    model = np.empty_like(q)
    for i in range(q.shape[1]):
        mixed = q[:, i].copy()
        for one, other, factor in coupling:
            if one == i + 1:
                mixed += factor * q[:, other - 1]
        model[:, i] = signs[i] * mixed + quarters[i] * QUARTER
    return model


def shown(found, kind):
    """Orientations as a pendant shows them, rounded."""
    turn = Rotation.from_matrix(found[:, :3, :3])
    if kind == "quaternion":
        return np.round(np.roll(turn.as_quat(), 1, axis=1), 5)
    if kind == "vector":
        return np.round(turn.as_rotvec(), 4)
    return np.round(turn.as_euler(kind, degrees=True), 2)


def radians(table):
    return (np.radians(table[0]), table[1], table[2], np.radians(table[3]))


def robot_of(table, name="arm"):
    return Robot.from_dh(name, alpha=tuple(table[0]), a=table[1], d=table[2], theta=tuple(table[3]))


def random_table(rng):
    """Six axes with quarter-turn twists, neighbours apart from each other, some offsets zero."""
    alpha = rng.choice([-90.0, 0.0, 90.0, 180.0], 6)
    a = rng.choice([0.0, 1.0], 6) * rng.uniform(-600, 600, 6).round(1)
    a = np.where((alpha % 180 == 0) & (np.abs(a) < 100), rng.choice([-1, 1], 6) * rng.uniform(150, 500, 6).round(1), a)
    d = rng.choice([0.0, 1.0], 6, p=[0.4, 0.6]) * rng.uniform(-500, 500, 6).round(1)
    return alpha, a, d, rng.choice([0.0, 90.0, -90.0, 180.0], 6)


def true_case(seed):
    rng = np.random.default_rng([20, seed])
    kinds = list(TABLES)
    table = TABLES[kinds[seed % 6]] if seed % 6 < 5 else random_table(rng)
    signs, quarters = rng.choice([1, -1], 6), rng.choice([-1, 0, 1, 2], 6)
    coupling = COUPLINGS[rng.integers(len(COUPLINGS))]
    return radians(table), (signs, quarters, coupling), ORIENTATIONS[rng.integers(6)], rng


def rows_of(table, truth, kind, q):
    q = np.round(np.degrees(q), 2)
    found = poses(table, in_model(np.radians(q), *truth))
    return PendantRows(q, np.round(found[:, :3, 3], 2), shown(found, kind), lines=tuple(range(2, 2 + len(q))))


def nearly(table, rng):
    """The table of a controller whose drawing differs a little."""
    stds = (2e-4, 0.1, 0.1, 2e-4)
    return tuple(np.array(column) + rng.normal(0, std, 6) for column, std in zip(table, stds, strict=True))


def largest_gap(table, truth, conventions, rng):
    q = rng.uniform(-np.pi, np.pi, (1000, 6))
    apart = poses(table, in_model(q, *truth)) - poses(table, conventions.to_model(q))
    return np.abs(apart).max()


@pytest.mark.long
def test_a_hundred_arms_from_three_rows_each():
    verdicts = Counter()
    for seed in range(100):
        table, truth, kind, rng = true_case(seed)
        q = rng.uniform(-2.9, 2.9, (3, 6))
        rows = rows_of(table if seed % 7 else nearly(table, rng), truth, kind, q)
        found = diagnose(robot_of(table), rows)
        gaps = [largest_gap(table, truth, meaning.simplest, rng) for meaning in found.meanings]
        assert min(gaps) < 1e-6, f"the truth of arm {seed} is not among what fits"
        assert NAMES[kind] in found.meanings[int(np.argmin(gaps))].rotations
        if not found.certain:
            verdicts["ambiguous"] += 1
            assert found.further is not None
            continue
        verdicts["certain"] += 1
        assert gaps[0] < 1e-6, f"arm {seed} is confidently wrong"
        for twin in found.meanings[0].conventions:
            assert largest_gap(table, truth, twin, rng) < 1e-6
        assert found.meanings[0].joint_unit == "deg"
        assert found.meanings[0].length_unit == "mm"
    assert verdicts["certain"] >= 95, verdicts


def test_the_twin_of_a_spherical_wrist_is_equivalent_and_the_simplest_is_given():
    table = radians(TABLES["hsr"])
    plain = (np.ones(6, dtype=int), np.zeros(6, dtype=int), ())
    rows = rows_of(table, plain, "ZYX", np.random.default_rng(1).uniform(-2, 2, (3, 6)))
    found = diagnose(robot_of(table), rows)
    assert found.certain
    assert found.meanings[0].simplest == Conventions.plain(6)
    # theta5 has 90 degrees in this table: -(q5 + 90) = -q5 - 180 + 90
    twin = Conventions((1, 1, 1, 1, -1, 1), (0.0, 0.0, 0.0, math.pi, math.pi, math.pi))
    assert twin in found.meanings[0].conventions
    assert len(found.meanings[0].conventions) == 2


def test_a_quarter_turn_back_is_not_called_three_forward():
    table = radians(TABLES["hsr"])
    back = (np.ones(6, dtype=int), np.array([0, -1, 0, 0, 0, 0]), ())
    rows = rows_of(table, back, "ZYX", np.random.default_rng(1).uniform(-2, 2, (3, 6)))
    assert diagnose(robot_of(table), rows).meanings[0].simplest.offsets == (0.0, -math.pi / 2, 0.0, 0.0, 0.0, 0.0)


def test_conventions_that_hardly_differ_are_not_called_certain():
    alpha, a, d, theta = radians(TABLES["hsr"])
    table = (alpha, (*a[:4], 0.05, 0.0), d, theta)  # a wrist that is nearly spherical: its twin is nearly the same
    plain = (np.ones(6, dtype=int), np.zeros(6, dtype=int), ())
    rows = rows_of(table, plain, "ZYX", np.random.default_rng(1).uniform(-2, 2, (3, 6)))
    found = diagnose(robot_of(table), rows)
    assert len(found.meanings) == 2
    assert not found.certain
    assert found.further.least_mm == pytest.approx(0.1, abs=0.02)
    assert "No posture distinguishes them" in diagnosis_text(found)


def test_units_are_found_and_wrong_names_are_said():
    table, truth, _, rng = true_case(3)
    rows = rows_of(table, truth, "ZYX", rng.uniform(-2.9, 2.9, (3, 6)))
    odd = PendantRows(
        np.round(np.radians(rows.joints), 5), np.round(rows.positions / 1000, 5), rows.orientations, "deg", "mm", "rad"
    )
    found = diagnose(robot_of(table), odd)
    assert found.certain
    assert (found.meanings[0].joint_unit, found.meanings[0].length_unit) == ("rad", "m")
    assert set(found.meanings[0].rotations) == {("zyx", "deg")}
    assert "say deg for joints, mm for lengths, rad for orientations, which is wrong" in diagnosis_text(found)
    assert largest_gap(table, truth, found.meanings[0].simplest, rng) < 1e-6


def test_base_and_tool_are_taken_into_account():
    table, truth, _, rng = true_case(2)
    q = np.round(np.degrees(rng.uniform(-2.9, 2.9, (3, 6))), 2)
    base, tool = np.eye(4), np.eye(4)
    base[:3, :3], base[:3, 3] = Rotation.from_euler("z", 30, degrees=True).as_matrix(), (100, 200, 300)
    tool[:3, :3], tool[:3, 3] = Rotation.from_euler("y", 45, degrees=True).as_matrix(), (10, 20, 150)
    found = base @ poses(table, in_model(np.radians(q), *truth)) @ tool
    rows = PendantRows(q, np.round(found[:, :3, 3], 2), shown(found, "xyz"))
    robot = robot_of(table)
    told = diagnose(robot, rows, base=base, tool=tool)
    assert told.certain
    assert largest_gap(table, truth, told.meanings[0].simplest, rng) < 1e-6
    untold = diagnose(robot, rows)
    assert untold.meanings == ()
    assert untold.nearest.mm > 10
    assert "no convention fits" in diagnosis_text(untold)


@pytest.mark.long_unless("0")
@pytest.mark.parametrize("seed", range(4))
def test_rows_of_another_robot_are_not_explained(seed):
    table, truth, kind, rng = true_case(seed)
    longer = (table[0], np.array(table[1]) + 40 * (np.array(table[1]) != 0), table[2], table[3])
    rows = rows_of(longer, truth, kind, rng.uniform(-2.9, 2.9, (3, 6)))
    found = diagnose(robot_of(table), rows)
    assert found.meanings == ()
    assert found.nearest.mm > 3
    assert not found.certain


def test_the_other_convention_of_a_table_is_tried_too():
    """Rows of a standard table (NumPy's, above) and a file that says modified."""
    table, truth, kind, rng = true_case(1)
    rows = rows_of(table, truth, kind, rng.uniform(-2.9, 2.9, (4, 6)))
    columns = dict(zip(("alpha", "a", "d", "theta"), map(tuple, table), strict=True))
    found = diagnose(Robot.from_dh("arm", **columns, convention="modified"), rows)
    assert (found.meanings, found.convention) == ((), "standard")
    assert "They fit with the DH table read as standard" in diagnosis_text(found)
    assert diagnose(robot_of(table), rows).convention == ""


def test_a_slip_of_the_pen_is_found():
    table, truth, _, rng = true_case(0)
    rows = rows_of(table, truth, "ZYX", rng.uniform(-2.9, 2.9, (5, 6)))
    rows.positions[2, 0] += 30
    found = diagnose(robot_of(table), rows)
    assert found.odd_lines == (4,)
    assert found.nearest.mm == pytest.approx(30, abs=1)
    assert found.nearest.rad < 3e-3


def settle(table, truth, found, rows, kind):
    """Add the proposed pose as the pendant would show it."""
    q = np.vstack([rows.joints, found.further.joints])
    return rows_of(table, truth, kind, np.radians(q))


@pytest.mark.long_unless("zeros", "wrist", "two")
@pytest.mark.parametrize("poor", ["zeros", "alike", "wrist", "two"])
def test_poor_rows_are_ambiguous_and_the_proposed_pose_settles_them(poor):
    table, truth, _, rng = true_case(0)
    q = {
        "zeros": np.zeros((3, 6)),
        "alike": np.tile(rng.uniform(-2, 2, 6), (3, 1)),
        "wrist": rng.uniform(-2, 2, (3, 6)) * [1, 1, 1, 0, 1, 0],
        "two": rng.uniform(-2, 2, (2, 6)),
    }[poor]
    rows = rows_of(table, truth, "ZYX", q)
    found = diagnose(robot_of(table), rows)
    assert not found.certain
    assert found.further is not None
    text = diagnosis_text(found)
    assert "To settle it, move to q1 = " in text
    assert "# not certain" in text
    for _ in range(4):  # few rows stay too few, and one pose may not settle all
        if found.certain:
            break
        rows = settle(table, truth, found, rows, "ZYX")
        found = diagnose(robot_of(table), rows)
    assert found.certain
    assert largest_gap(table, truth, found.meanings[0].simplest, rng) < 1e-6


def test_rows_too_poor_to_look_at_all_that_fits_are_not_called_inexplicable(monkeypatch):
    table = radians(TABLES["hsr"])
    truth = (np.ones(6, dtype=int), np.zeros(6, dtype=int), ((5, 4, -1.0),))
    q = np.zeros((3, 6))
    q[:, 3] = 0.3, 0.9, -0.4
    rows = rows_of(table, truth, "ZYX", q)
    found = diagnose(robot_of(table), rows)
    assert found.more
    assert not found.certain
    assert "Ambiguous: at least 48 conventions fit" in diagnosis_text(found)
    monkeypatch.setattr("casacal.doctor.search.MOST", 10)
    found = diagnose(robot_of(table), rows)  # now only readings without coupling are looked at, and none of them fits
    assert (found.meanings, found.more) == ((), True)
    text = diagnosis_text(found)
    assert "too many conventions fit" in text
    assert "no convention fits" not in text


def test_what_is_open_is_told_from_what_is_certain():
    table = radians(TABLES["ur"])
    truth = (np.ones(6, dtype=int), np.zeros(6, dtype=int), ((3, 2, -1.0),))
    q = np.random.default_rng(5).uniform(-2, 2, (3, 6)) * [1, 1, 1, 1, 1, 0]
    text = diagnosis_text(diagnose(robot_of(table), rows_of(table, truth, "vector", q)))
    assert "joint 1: sign +1, offset 0 deg (certain)" in text
    assert "joint 6: open: [sign +1, offset 0 deg] or [sign -1, offset 0 deg]" in text
    assert "orientation: rotation-vector in rad (certain)" in text


def test_robots_of_other_shapes():
    joints = [Joint(), Joint(), Joint("prismatic", 0.0, 300.0), Joint()]
    scara = Robot.from_dh(
        "scara", alpha=deg(0, 180, 0, 0), a=(350, 300, 0, 0), d=(400, 0, 0, 50), theta=(0,) * 4, joints=joints
    )
    rng = np.random.default_rng(4)
    q = np.column_stack([rng.uniform(-120, 120, (3, 2)), rng.uniform(0, 250, 3), rng.uniform(-120, 120, 3)]).round(2)
    model = np.radians(q * [1, -1, 0, 1]) + np.array([QUARTER, 0, 0, 0])
    slide = -q[:, 2]
    found = np.array(
        [
            dh_chain(np.radians([0, 180, 0, 0]), (350, 300, 0, 0), (400, 0, s, 50), m)
            for m, s in zip(model, slide, strict=True)
        ]
    )
    told = diagnose(scara, PendantRows(q, np.round(found[:, :3, 3], 2), shown(found, "ZYX")))
    assert told.meanings[0].simplest == Conventions((1, -1, -1, 1), (QUARTER, 0.0, 0.0, 0.0))
    assert told.certain
    with pytest.raises(CasacalError, match="The rows have 4 joints and 'arm' has 6"):
        diagnose(robot_of(radians(TABLES["ur"])), PendantRows(q, q[:, :3], q[:, :3]))


def test_a_pose_that_holds_conventions_already_needs_no_others():
    table = radians(TABLES["hsr"])
    held = Conventions((1, -1, 1, 1, -1, 1), (0.0, QUARTER, 0.0, 0.0, 0.0, math.pi), ((3, 2, -1.0),))
    plain = robot_of(table)
    coupled = Robot("coupled", 6, lambda p, q: plain.pose(p, held.to_model(q)), plain.parameters)
    truth = (np.array(held.signs), np.round(np.array(held.offsets) / QUARTER).astype(int), held.coupling)
    rng = np.random.default_rng(6)
    rows = rows_of(table, truth, "ZYX", rng.uniform(-2.5, 2.5, (3, 6)))
    found = diagnose(coupled, rows)
    assert found.certain
    assert found.meanings[0].simplest == Conventions.plain(6)
    assert "nothing to change" in diagnosis_text(found)
    # and a controller that does not couple, before a pose that does
    free = (truth[0], truth[1], ())
    found = diagnose(coupled, rows_of(table, free, "ZYX", rng.uniform(-2.5, 2.5, (3, 6))))
    assert found.certain
    q = rng.uniform(-3, 3, (200, 6))
    mine = in_model(found.meanings[0].simplest.to_model(q), *truth)
    assert np.abs(poses(table, mine) - poses(table, in_model(q, *free))).max() < 1e-6


def test_axes_reproduce_poses_and_refuse_what_is_none():
    table = radians(TABLES["kuka"])
    q = np.random.default_rng(7).uniform(-3, 3, (50, 6))
    turn, place = axes_of(robot_of(table)).poses(q)
    wanted = poses(table, q)
    np.testing.assert_allclose(place, wanted[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(turn, wanted[:, :3, :3], atol=1e-12)
    length = {"l": Parameter(100.0, unit="mm")}
    geared = Robot("geared", 2, lambda p, q: chain(rotate_z(3 * q[0]), translate_x(p.l), rotate_x(q[1])), length)
    with pytest.raises(ProblemError, match="not one turn or slide per joint"):
        axes_of(geared)
    screw = Robot("screw", 1, lambda p, q: chain(rotate_z(q[0]), translate_z(p.l * q[0])), length)
    with pytest.raises(ProblemError, match="not one turn or slide per joint"):
        axes_of(screw)


def write_rows(path, header, rows):
    numbers = np.column_stack([rows.joints, rows.positions, rows.orientations])
    path.write_text("\n".join([header, *(",".join(f"{v:.5f}" for v in row) for row in numbers)]))


def test_the_command_prints_a_block_that_composes(tmp_path, capsys):
    table = radians((TABLES["hsr"][0], (249.85003, 900.32123, -206.14449, 0, 0, 0), (653.5, 0, 0, 1030.37534, 0, 200.6),
                     TABLES["hsr"][3]))  # fmt: skip
    truth = (np.array([1, -1, 1, 1, -1, 1]), np.array([0, 1, 0, 0, 0, 2]), ((3, 2, -1.0),))
    rng = np.random.default_rng(8)
    rows = rows_of(table, truth, "ZYX", rng.uniform(-2, 2, (3, 6)))
    write_rows(tmp_path / "p.csv", "q1,q2,q3,q4,q5,q6,x_mm,y_mm,z_mm,a_deg,b_deg,c_deg", rows)
    assert main(["doctor", HSR, str(tmp_path / "p.csv")]) == 0
    said = capsys.readouterr().out
    assert "Certain: one convention fits" in said
    assert "# the pendant shows joints in deg, lengths in mm, orientations zyx in deg" in said
    block = tomllib.loads(said[said.index("[conventions]") :])["conventions"]
    offsets = tuple(math.radians(offset) for offset in block["offsets_deg"])
    read = Conventions(tuple(block["signs"]), offsets, tuple((i, j, f) for i, j, f in block["coupling"]))
    assert largest_gap(table, truth, read, rng) < 1e-6
    line = next(each for each in said.splitlines() if "into problem.py: " in each)
    assert eval(line.partition("conventions=")[2], {"Conventions": Conventions, "deg": deg}) == read
    assert "sign * (limit - offset) of the problem's, which turn round where the sign is -1" in said
    (tmp_path / "c.toml").write_text(PUMA_TOML)
    bare = dh_file_text(replace(read_dh_file(tmp_path / "c.toml"), conventions=None), "c.toml")
    (tmp_path / "c.toml").write_text(bare + "\n" + said[said.index("# the pendant") :])
    assert read_dh_file(tmp_path / "c.toml").conventions == read
    assert main(["doctor", HSR, str(tmp_path / "p.csv"), "--tool", "0,0,120"]) == 1
    assert "no convention fits" in capsys.readouterr().out
    write_rows(tmp_path / "p.csv", "q1,q2,q3,q4,q5,q6,x_mm,y_mm,z_mm,a_deg,b_deg,c_deg", rows.without(0))
    assert main(["doctor", HSR, str(tmp_path / "p.csv")]) == 1
    assert "Not certain: one convention fits" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("header", "cells", "options", "says"),
    [
        ("q1,q2,q3,q4,q5,x,y,z,a,b,c", "1,2,3,4,5,1,2,3,4,5,6", [], "there is no column for q6"),
        ("q1,q2,q3,q4,q5,q6,q7,x,y,z,a,b,c", "1,2,3,4,5,6,7,1,2,3,4,5,6", [], "the robot has 6 joints"),
        ("q1,q2,q3,q4,q5,q6,x,y,z,a,b", "1,2,3,4,5,6,1,2,3,4,5", [], "there is no orientation"),
        ("q1,q2,q3,q4,q5,q6,x,y,z,qw,qx,qy,qz", "1,2,3,4,5,6,1,2,3,2,0,0,0", [], "the quaternion has the length 2"),
        ("q1,q2,q3,q4,q5,q6,x,y,z,qw,qx,qy,qz", "1,2,3,4,5,6,1,2,3,.5,0,0,0", [], "the quaternion has the length 0.5"),
        ("q1_deg,q2_rad,q3,q4,q5,q6,x,y,z,a,b,c", "1,2,3,4,5,6,1,2,3,4,5,6", [], "state different units"),
        ("q1,q1_deg,q2,q3,q4,q5,q6,x,y,z,a,b,c", "1,1,2,3,4,5,6,1,2,3,4,5,6", [], "'q1' and 'q1_deg' both give q1"),
        ("q1,q2,q3,q4,q5,q6,x,y,z,a,b,c", "1,2,3,4,5,6,1,2,3,4,5,x", [], "'x' is not a finite number"),
        ("q1,q2,q3,q4,q5,q6,x,y,z,a,b,c", "1,2,3,4,5,6,1,2,3,4,5,6", ["--tool", "1,2"], "--tool 1,2 is not a pose"),
        ("q1,q2,q3,q4,q5,q6,x,y,z,a,b,c", "1,2,3,4,5,6,1,2,3,4,5,6", ["--tolerance", "0"], "The tolerance is 0 mm"),
        ("q1,q2,q3,q4,q5,q6,x,y,z,a,b,c", "1,2,3,4,5,6,1,2,3,4,5,6", ["--tolerance", "inf"], "The tolerance is inf mm"),
    ],
)  # fmt: skip
def test_bad_rows_are_refused_in_one_line(tmp_path, capsys, header, cells, options, says):
    (tmp_path / "p.csv").write_text(f"{header}\n{cells}\n")
    assert main(["doctor", HSR, str(tmp_path / "p.csv"), *options]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


def test_sliding_joints_and_quaternions_are_read(tmp_path):
    (tmp_path / "p.csv").write_text("q1_deg,q2_m,x_m,y_m,z_m,qw,qx,qy,qz\n10,0.2,1,2,3,1,0,0,0\n")
    rows = read_pendant_rows(tmp_path / "p.csv", [True, False])
    assert (rows.joint_unit, rows.length_unit, rows.angle_unit) == ("deg", "m", "")
    assert rows.joints.tolist() == [[10, 0.2]]
    (tmp_path / "p.csv").write_text("q1_deg,q2_mm,x_m,y_m,z_m,qw,qx,qy,qz\n10,0.2,1,2,3,1,0,0,0\n")
    with pytest.raises(SamplesError, match="state different units"):
        read_pendant_rows(tmp_path / "p.csv", [True, False])


def test_a_coupling_of_distant_joints_stands_alone():
    """All readings of a small arm, one by one."""
    halves = Halves.of(axes_of(robot_of(tuple(column[:3] for column in radians(TABLES["ur"])))))
    left, right = halves.left.options, halves.right.options
    pairs = np.stack(np.meshgrid(np.arange(len(left)), np.arange(len(right)), indexing="ij"), axis=-1).reshape(-1, 2)
    found = halves._checked(pairs, np.zeros((1, 3)), np.zeros((1, 3)), math.inf)
    partner = np.concatenate([left[pairs[:, 0]], right[pairs[:, 1]]], axis=1)[..., 2]
    couplings = (partner >= 0).sum(axis=1)
    distant = ((partner >= 0) & (partner != np.arange(3) - 1)).any(axis=1)
    assert len(found) == int((~distant | (couplings == 1)).sum()) < len(pairs)
    assert distant[couplings == 1].any()


def test_what_no_posture_tells_apart_is_no_reason_against_one():
    """The last joint does not move, so that its sign is nobody's business."""
    robot = robot_of(radians(TABLES["ur"]))
    still = replace(robot, joints=[*robot.axes[:5], replace(robot.axes[5], lower=-1e-9, upper=1e-9)])
    axes = axes_of(still)
    reading = np.tile(np.array([1, 0, -1, 0], dtype=np.int8), (6, 1))
    meaning = Meaning((Conventions.plain(6),), reading, "deg", "mm", {}, 0.0)
    found = further_pose(axes, still, [meaning], 1.0)
    assert found.least_mm > 1 or found.least_rad > 1e-3
