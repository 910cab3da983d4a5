"""Frames of work objects: against planes and points by hand, in each controller's words, with an honest spread."""

import dataclasses
import json
import re

import numpy as np
import pytest
from conftest import ROOT
from instruments_on_ur5 import PROBLEMS
from scipy.spatial.transform import Rotation

from casacal import CasacalError, FixedPoint, Problem, calibrate, load_problem, simulate, tool_point
from casacal.cli.main import main
from casacal.deployment.result_file import read_result
from casacal.deployment.work_frame import frame_text, work_frame
from casacal.model import facing, turntable
from casacal.uncertainty.tip_error import workspace_joints

FACES = ("floor", "wall", "side")


@pytest.fixture(scope="module")
def cornered():
    """The arm of a cell with three faces, as calibrated."""
    return calibrate(load_problem(ROOT / "problems" / "hsr_jr680"), reference=False)


def by_hand(planes, labels):
    """x, y, z and origin (3) of three planes, step by step."""
    first, second, third = (planes[label] for label in labels)
    z, other, last = (np.array(each["normal"]) for each in (first, second, third))
    x = np.cross(np.cross(z, other), z)
    x /= np.linalg.norm(x)
    # along the line where the first two meet, until the third
    line = np.cross(z, other)
    p = np.linalg.lstsq([z, other], [z @ first["point_mm"], other @ second["point_mm"]], rcond=None)[0]
    origin = p + line * (last @ third["point_mm"] - last @ p) / (last @ line)
    return x, np.cross(z, x), z, origin


@pytest.mark.parametrize("labels", [FACES, ("side", "floor", "wall")])
def test_three_faces_make_a_frame(cornered, labels):
    found = work_frame(cornered, faces=labels)
    x, y, z, origin = by_hand(cornered.to_dict()["planes"], labels)
    np.testing.assert_allclose(found.matrix[:3], np.column_stack([x, y, z, origin]), atol=1e-6)
    assert 0.01 < found.origin_std < 3


def test_each_controller_reads_the_same_frame(cornered):
    text, matrix = frame_text(cornered, faces=FACES), work_frame(cornered, faces=FACES).matrix
    line = {each.split(",")[0]: each for each in text.splitlines() if not each.startswith("#")}

    def numbers(maker, count):
        return [float(value) for value in re.findall(r"-?\d+\.\d+", line[maker])][:count]

    abb, fanuc, kuka, ur = (numbers(maker, 7) for maker in ("ABB", "FANUC", "KUKA", "Universal Robots"))
    turns = {
        "ABB": Rotation.from_quat([*abb[4:7], abb[3]]),
        "FANUC": Rotation.from_euler("xyz", fanuc[3:6], degrees=True),
        "KUKA": Rotation.from_euler("ZYX", kuka[3:6], degrees=True),
        "UR": Rotation.from_rotvec(ur[3:6]),
    }
    for turn in turns.values():
        np.testing.assert_allclose(turn.as_matrix(), matrix[:3, :3], atol=1e-6)
    for place in (abb, fanuc, kuka, 1000 * np.array(ur)):
        np.testing.assert_allclose(place[:3], matrix[:3, 3], atol=1e-3)


@pytest.mark.long
def test_its_spread_is_that_of_many_arms():
    """Origin and turn over 20 simulated arms, each base moved to where its own tips fit best, over what is promised."""
    source = load_problem(ROOT / "problems" / "hsr_jr680")
    joints = workspace_joints(source.problem.robot)
    ratios = []
    for seed in range(20):
        made = simulate(source.problem, source.cell, samples=60, seed=seed)
        found = calibrate(source.problem, made.samples, reference=False, discrepancy="none")
        frame, x = work_frame(found, faces=FACES), made.truth(found.fit)
        planes = {slot.label: slot.value(x) for slot in found.fit.slots if slot.key == "plane"}
        flat = {
            k: {"normal": np.array(v.normal).ravel(), "point_mm": np.array(v.point).ravel()} for k, v in planes.items()
        }
        *axes, corner = by_hand(flat, FACES)
        mine, theirs = found.predict(joints, frame="tip").positions, made.true_tips(joints)
        turn, _ = Rotation.align_vectors(theirs - theirs.mean(axis=0), mine - mine.mean(axis=0))
        origin = turn.apply(frame.matrix[:3, 3] - mine.mean(axis=0)) + theirs.mean(axis=0) - corner
        spin = turn * Rotation.from_matrix(frame.matrix[:3, :3]) * Rotation.from_matrix(np.column_stack(axes)).inv()
        ratios.append([np.sum(origin**2) / frame.origin_std**2, spin.magnitude() ** 2 / frame.turn_std**2])
    assert (np.abs(np.sqrt(np.mean(ratios, axis=0)) - 1) < 0.4).all()


def test_three_points_make_a_frame():
    problem = PROBLEMS["FixedPoint"]
    samples = simulate(problem, samples=60, seed=2).samples
    found = calibrate(problem, samples, reference=False)
    places = {row["name"]: row["estimate"] for row in found.to_dict()["parameters"]}
    a, b, c = (np.array([places[f"point.{k}_{axis}"] for axis in "xyz"]) for k in "123")
    frame = work_frame(found, points=("1", "2", "3"))
    np.testing.assert_allclose(frame.matrix[:3, 3], a)
    np.testing.assert_allclose(frame.matrix[:3, 0], (b - a) / np.linalg.norm(b - a))
    assert abs(frame.matrix[:3, 2] @ (c - a)) < 1e-9
    assert frame.matrix[:3, 1] @ (c - a) > 0
    assert np.linalg.det(frame.matrix[:3, :3]) == pytest.approx(1)
    assert 0.05 < frame.origin_std < 2, "a spike alone says little of how large the arm is"


@pytest.mark.long
def test_work_on_a_table_is_in_the_table_s_frame():
    robot = load_problem(ROOT / "problems" / "ur5").problem.robot
    turning = facing(robot, turntable(-3, 3, point=(600, 0, 0)))
    problem = Problem(turning, FixedPoint(noise_std=0.05, tool=tool_point(0, 0, 100, prior_std=1.0)))
    found = calibrate(problem, simulate(problem, samples=60, seed=1).samples, reference=False)
    text = frame_text(found, points=("1", "2", "3"))
    assert "in the frame of what faces the arm and moves with it" in text
    assert "base frame" not in text


def test_what_fixes_no_frame_is_said(cornered):
    for given, said in (
        ({}, "from three faces or from three points"),
        ({"faces": FACES[:2]}, "from three faces or from three points"),
        ({"faces": FACES, "points": ("1", "2", "3")}, "from three faces or from three points"),
        ({"faces": ("floor", "floor", "wall")}, "'floor' is named twice"),
        ({"faces": set(FACES)}, "from three faces or from three points"),
        ({"points": "123"}, "from three faces or from three points"),
        ({"points": (1, 2, 3)}, "from three faces or from three points"),
        ({"faces": ("floor", "wall", "roof")}, "roof"),
        ({"points": ("1", "2", "3")}, "'1'"),
    ):
        with pytest.raises(CasacalError, match=said):
            work_frame(cornered, **given)
    flat = load_problem(ROOT / "problems" / "ur5")
    stepped = calibrate(flat, reference=False)
    labels = list(stepped.to_dict()["planes"])[:3]
    parallel = dataclasses.replace(read_result_of(stepped), document=all_alike(stepped, labels))
    with pytest.raises(CasacalError, match="do not meet in one point"):
        work_frame(parallel, faces=labels)


def read_result_of(calibration):
    return calibration.arm


def all_alike(calibration, labels):
    """The document with three faces that are one above the other."""
    document = json.loads(json.dumps(calibration.to_dict()))
    first = document["proposed"][f"plane.{labels[0]}"]
    for k, label in enumerate(labels):
        document["proposed"][f"plane.{label}"] = [*first[:9], *(np.array(first[9:]) + 10.0 * k)]
    document["unknowns"] = [row for row in document["unknowns"] if not row["name"].startswith("plane")]
    return document


@pytest.mark.long
def test_the_command_line_writes_it(tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["calibrate", str(ROOT / "problems" / "hsr_jr680"), "--out", str(out)]) == 0
    place = tmp_path / "work.txt"
    command = ["export", str(out / "result.json"), "--to", "frame", "--out", str(place)]
    assert main([*command, "--faces", "floor, wall,side"]) == 0
    assert place.read_text() == frame_text(read_result(out / "result.json"), faces=FACES)
    capsys.readouterr()
    for wrong, said in (
        ([], "Name three of either"),
        (["--faces", "floor,wall,roof"], "roof"),
        (["--faces", "floor,wall,wall"], "'wall' is named twice"),
    ):
        place.unlink(missing_ok=True)
        assert main([*command, *wrong]) == 2
        assert said in capsys.readouterr().err
        assert not place.exists()
    assert main([*command[:2], "--to", "c", "--out", str(tmp_path / "a.c"), "--faces", "a,b,c"]) == 2
    assert "has no work object" in capsys.readouterr().err
