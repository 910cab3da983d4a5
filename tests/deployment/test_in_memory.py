"""Everything from Python: fit, save, load elsewhere, predict, compensate, export, report, without a file in between."""

import inspect
import json
import logging
import os
import shutil
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from conftest import ROOT
from own_instrument import written

import casacal
from casacal import (
    CasacalError,
    Problem,
    Robot,
    Samples,
    TrackedPoint,
    calibrate,
    huber,
    lm,
    load,
    load_problem,
    simulate,
    tukey,
)
from casacal.cli.main import main
from casacal.deployment.as_data import problem_data, problem_from
from casacal.deployment.export import dh_text, export, ur_kinematics_text, urdf_text, zero_corrections, zeros_text
from casacal.deployment.functions import c_text, pose_function, tip_function, values_of
from casacal.deployment.predict import predict
from casacal.deployment.remark import remark
from casacal.deployment.result_file import read_result
from casacal.fit import Result
from casacal.fit.methods import METHODS, method_of, minimises

Q = np.array([[0.1, -0.4, 0.3, 0.2, 0.9, 0.1], [0.3, -0.2, 0.1, -0.5, 0.7, -0.2]])


@pytest.fixture(scope="module")
def found(hsr):
    return calibrate(hsr, method="lm")


@pytest.fixture(scope="module")
def by_command(tmp_path_factory, hsr):
    """The same by the command line, which works from files."""
    folder = tmp_path_factory.mktemp("command")
    assert main(["calibrate", str(hsr.path), "--method", "lm", "--out", str(folder)]) in (0, 1)
    header = ",".join(f"q{i}_rad" for i in range(1, 7))
    np.savetxt(folder / "q.csv", Q, delimiter=",", header=header, comments="")
    return folder


def test_samples_come_in_any_form(hsr, found, tmp_path):
    path = hsr.samples
    frame = pd.read_csv(path, comment="#")
    arrays = {name: frame[name].to_numpy() for name in frame}
    for given in (str(path), path, frame, arrays, hsr.problem.read(path), None):
        again = calibrate(hsr, given, method="lm", reference=False)
        np.testing.assert_array_equal(again.x, found.x)
    for problem in (hsr, hsr.problem, str(hsr.path), ROOT / "problems" / "hsr_jr680"):
        np.testing.assert_array_equal(calibrate(problem, frame, method="lm", reference=False).x, found.x)


def not_finite():
    joints = np.full((40, 6), np.nan)
    return Samples(joints, {"reading": np.zeros(40)}, {"plane": ["a"] * 40}, range(40), {}, "s", "")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((3, "s.csv"), "Got an int as the problem"),
        ((None, None), "Got nothing as the problem"),
        (("nowhere", None), "There is no problem at 'nowhere'"),
        (("P", 3.5), "Got a float as samples"),
        (("P", pd.DataFrame({f"q{i}_deg": [] for i in range(1, 7)} | {"reading_mm": []})), "no row"),
        (("P", None), "Got nothing as samples"),
        (("P", [1, 2]), "Got a list as samples"),
        (("P", {}), "the arrays have the shapes nothing"),
        (("P", {"q1_deg": [1.0, 2.0], "reading_mm": [1.0]}), r"q1_deg \(2,\), reading_mm \(1,\)"),
        (("P", {"q1_deg": np.ones((2, 2))}), "shapes"),
        (("P", "no.csv"), "there is no such file"),
        (("P", Samples.of_joints(np.zeros((3, 2)))), "joint values have the shape"),
        (("P", Samples.of_joints(np.zeros((40, 6)))), "no column 'reading'"),
        (("P", not_finite()), "finite"),
    ],
)  # fmt: skip
def test_the_door_says_what_it_takes(hsr, arguments, says):
    problem = hsr.problem if arguments[0] == "P" else arguments[0]
    with pytest.raises(CasacalError, match=says):
        calibrate(problem, arguments[1])


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"method": "newton"}, "There is no method named 'newton'"),
        ({"method": 3}, "Got an int as the method"),
        ({"method": lambda problem: "x"}, "Got a str from the method"),
        ({"method": lambda problem: problem.x0[:3]}, "has the shape"),
        ({"method": lambda problem: problem.x0 * np.nan}, "not finite"),
        ({"method": "sckf", "loss": huber()}, "takes no loss: it takes every row once"),
        ({"holdout": 1.5}, "held-out part"),
        ({"holdout": "a"}, "held-out part"),
        ({"seed": -1}, "seed is -1"),
        ({"seed": 1.5}, "seed is 1.5"),
        ({"loss": "huber"}, "Got a str as the loss"),
    ],
)
def test_options_that_make_no_sense_are_refused(hsr, options, says):
    with pytest.raises(CasacalError, match=says):
        calibrate(hsr, **options)


def test_the_doors_below_say_it_too(hsr):
    samples = hsr.problem.read(hsr.samples)
    for call in (
        lambda: casacal.bind(hsr, samples),
        lambda: casacal.bind(hsr.problem, str(hsr.samples)),
        lambda: simulate(hsr, hsr.cell),
        lambda: simulate(hsr.problem, "corner"),
    ):
        with pytest.raises(CasacalError, match=r"^Got "):
            call()


def test_a_calibration_is_taken_where_its_arm_is(found):
    """What people hand over first: the calibration itself, and joint values as numbers."""
    joints = casacal.compensate(found, Q).joints
    np.testing.assert_array_equal(joints, found.compensate(Q).joints)
    np.testing.assert_array_equal(predict(found, Q).positions, found.predict(Q).positions)
    assert export(found, "zeros") == found.export("zeros")
    assert zeros_text(found) == found.export("zeros")


@pytest.mark.parametrize("wrong", [None, 5, "nowhere", [1, 2], np.zeros((1, 6)), {}], ids=lambda wrong: repr(wrong)[:8])
def test_wrong_types_are_refused_in_a_sentence(hsr, found, wrong):
    """Every public function that takes a calibrated arm, targets, joints or a path."""
    arm = found.arm
    takes_an_arm = (
        lambda: casacal.compensate(wrong, Q),
        lambda: predict(wrong, Q),
        lambda: export(wrong, "zeros"),
        *(lambda write=write: write(wrong) for write in (zeros_text, zero_corrections, c_text, remark)),
        *(lambda write=write: write(wrong) for write in (dh_text, urdf_text, ur_kinematics_text)),
        *(lambda make=make: make(wrong) for make in (pose_function, tip_function, values_of)),
    )
    for call in takes_an_arm:
        with pytest.raises(CasacalError, match="as the calibrated arm"):
            call()
    others = [lambda: found.export(wrong), lambda: casacal.deployment.read_targets(hsr.samples, wrong)]
    others += [lambda: casacal.check(wrong, Samples.of_joints(Q)), lambda: casacal.check(hsr.problem, wrong)]
    if not isinstance(wrong, np.ndarray):
        others += [lambda: casacal.compensate(arm, wrong), lambda: predict(arm, wrong)]
        others += [lambda: casacal.compensate(arm, Q, largest=wrong)] if wrong != 5 else []
    if not isinstance(wrong, str):
        others += [
            lambda: load(wrong),
            lambda: load_problem(wrong),
            lambda: casacal.deployment.read_targets(wrong, hsr),
        ]
        others += [lambda: found.export("zeros", wrong)] if wrong is not None else []
    for call in others:
        with pytest.raises(CasacalError):
            call()


def test_a_method_may_be_a_function(hsr, found):
    own = calibrate(hsr, method=lm)
    np.testing.assert_array_equal(own.x, found.x)
    assert own.method == "lm"

    def gauss_newton(problem):
        x = problem.x0
        for _ in range(8):
            normal = problem.normal(x)
            gradient = normal.gradient + problem.prior_information @ (x - problem.x0)
            x = x - np.linalg.solve(normal.information + problem.prior_information + 1e-9 * np.eye(x.size), gradient)
        return x

    mine = calibrate(hsr, method=gauss_newton)
    assert mine.method == "gauss-newton"
    assert mine.cost == pytest.approx(found.cost, rel=1e-8)
    assert isinstance(mine.result, Result)
    assert mine.summary()
    assert mine.to_dict()["method"] == "gauss-newton"
    with pytest.raises(KeyError):  # what a user's function raises is the user's to see
        calibrate(hsr, method=lambda problem: {}["x"])


def test_losses_are_public(hsr):
    for loss in (huber(), tukey(4.0)):
        assert isinstance(loss, casacal.kernels.Loss)
        assert calibrate(hsr, method="lm", loss=loss).result.loss == loss


@pytest.mark.long
def test_memory_says_what_files_say(found, by_command):
    """result.json, predictions, targets and exports from memory are those of the command line."""
    document = json.loads((by_command / "result.json").read_text())
    assert document.pop("written_by").startswith("casacal ")
    mine = json.loads(json.dumps(found.to_dict()))
    assert mine.keys() == document.keys()
    for one in (mine, document):  # the file's paths are relative to it
        one["data"].pop("file")
        for part in (one["problem"], *one["problem"]["files"]):
            assert part.pop("path").endswith("problems/hsr_jr680/problem.py")
    for key in mine.keys() - {"seconds", "seal"}:  # the seal is of the paths, too
        assert mine[key] == document[key], key
    saved = load(by_command)
    assert saved.success
    assert saved.tip_std == pytest.approx(found.tip_std)
    for q in (Q, Q.tolist(), by_command / "q.csv", pd.read_csv(by_command / "q.csv"), Samples.of_joints(Q)):
        for arm in (found, saved):
            prediction = arm.predict(q, frame="tip", std=True)
            np.testing.assert_allclose(prediction.positions, found.fit.tips(found.used_x, Q), atol=1e-9)
            assert (prediction.std > 0).all()
    assert found.predict(Q[0]).positions.shape == (1, 3)
    out = by_command / "p.csv"
    assert (
        main(["predict", str(by_command / "result.json"), str(by_command / "q.csv"), "--std", "--out", str(out)]) == 0
    )
    table, here = pd.read_csv(out, comment="#"), found.predict(Q, std=True)
    np.testing.assert_allclose(table[["x_mm", "y_mm", "z_mm"]], here.positions, atol=1e-6)
    np.testing.assert_allclose(table["std_mm"], here.std, atol=1e-6)
    np.testing.assert_allclose(here.poses[:, :3, 3], here.positions)
    for form in ("dh", "zeros", "c"):
        out = by_command / f"arm.{form}"
        assert main(["export", str(by_command / "result.json"), "--to", form, "--out", str(out)]) == 0
        ours, theirs = found.export(form), out.read_text()
        assert without_origin(ours) == without_origin(theirs)
        assert saved.export(form, by_command / "again") == (by_command / "again").read_text()


def without_origin(text):
    """The numbers of a file, without the lines that say where it came from."""
    return [line for line in text.splitlines() if "casacal" not in line and "result" not in line]


def test_targets_come_in_any_form(found):
    drawn = found.predict(Q, nominal=True)
    by_joints = found.compensate(Q)
    assert by_joints.reached.all()
    reached = found.predict(by_joints.joints)
    np.testing.assert_allclose(reached.positions, drawn.positions, atol=2e-3)
    by_poses = found.compensate(drawn.poses)
    np.testing.assert_allclose(found.predict(by_poses.joints).positions, drawn.positions, atol=2e-3)
    frame = pd.DataFrame(np.degrees(Q), columns=[f"q{i}_deg" for i in range(1, 7)])
    np.testing.assert_allclose(found.compensate(frame).joints, by_joints.joints, atol=1e-9)
    assert "movej" in found.program(Q, "urscript")


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda c: c.predict([1.0, 2.0]), "shape"),
        (lambda c: c.predict("nowhere.csv"), "no such file"),
        (lambda c: c.predict([[np.inf] * 6]), "not finite"),
        (lambda c: c.predict(object()), "Got an object as joint values"),
        (lambda c: c.predict(pd.DataFrame({"q1": [1.0]})), "no unit"),
        (lambda c: c.predict(Q, nominal=True, std=True), "no standard deviation"),
        (lambda c: c.compensate(np.ones((2, 4, 4))), "rotation matrix is not orthonormal and right-handed"),
        (lambda c: c.compensate(np.ones((2, 3, 3))), "shape"),
        (lambda c: c.compensate(np.diag([1.0, 1.0, -1.0, 1.0])), "rotation matrix is not orthonormal and right-handed"),
        (lambda c: c.predict(Q, frame="Tip"), "no frame named 'Tip'"),
        (lambda c: c.compensate(Q, frame="zz"), "no frame named 'zz'"),
        (lambda c: c.export("stl"), "no form named 'stl'"),
        (lambda c: c.export("c", source="x"), "writes no file back"),
        (lambda c: c.export("dh", prefix="x"), "no prefix"),
        (lambda c: c.export("urdf"), "not built from a URDF"),
        (lambda c: c.program(Q, "basic"), "no form of targets named 'basic'"),
        (lambda c: c.report("/proc/nowhere/report.html"), "cannot be written"),
        (lambda c: load("/nowhere"), "no such file"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_sentence(found, call, says):
    with pytest.raises(CasacalError, match=says):
        call(found)


@pytest.mark.long
def test_a_saved_folder_can_go_elsewhere(tmp_path):
    """Another process, another folder, and the problem's own file gone: the saved folder is enough."""
    place = written(tmp_path / "here", "stylus")
    source = load_problem(place)
    found = calibrate(source, simulate(source.problem, samples=80, seed=1).samples)
    found.save(tmp_path / "saved")
    expected = found.predict(Q, std=True)
    shutil.rmtree(tmp_path / "here")
    (tmp_path / "saved").rename(tmp_path / "elsewhere")
    script = (
        "import sys, json, casacal; c = casacal.load(sys.argv[1]); q = json.loads(sys.argv[2]); "
        "p = c.predict(q, std=True); "
        "print(json.dumps([p.positions.tolist(), p.std.tolist(), bool(c.compensate(q).reached.all()), "
        "c.success, len(c.export('c')) > 1000, len(c.parameters)]))"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script, "elsewhere", json.dumps(Q.tolist())],
        capture_output=True, text=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    positions, std, reached, success, exported, parameters = json.loads(done.stdout)
    np.testing.assert_allclose(positions, expected.positions, atol=1e-6)
    np.testing.assert_allclose(std, expected.std, rtol=1e-6)
    assert (reached, success, exported, parameters) == (True, True, True, 24)
    assert main(["predict", str(tmp_path / "elsewhere"), "no.csv", "--out", str(tmp_path / "x")]) == 2


@pytest.mark.long
def test_a_problem_made_in_python_is_saved_with_its_result(hsr, tmp_path):
    problem = Problem(hsr.problem.robot, casacal.DialOnPlane(noise_std=0.01))
    found = calibrate(problem, hsr.samples, method="lm")
    paths = found.save(tmp_path / "a")
    assert sorted(path.name for path in paths) == sorted(path.name for path in (tmp_path / "a").iterdir())
    document = json.loads((tmp_path / "a" / "result.json").read_text())
    assert (document["problem"]["path"], document["problem"]["sha256"]) == ("", problem.digest)
    assert load(tmp_path / "a").arm.source.problem == problem
    back = load(tmp_path / "a", problem=problem)
    np.testing.assert_allclose(back.predict(Q).positions, found.predict(Q).positions, atol=1e-9)
    with pytest.raises(CasacalError, match="its arm has changed"):
        load(tmp_path / "a", problem=load_problem(ROOT / "problems" / "ur5").problem)


@pytest.mark.long
def test_the_same_calibration_gives_the_same_files(found, hsr, tmp_path):
    found.save(tmp_path / "a")
    calibrate(hsr, method="lm").save(tmp_path / "b")
    for path in (tmp_path / "a").iterdir():
        one, two = path.read_bytes(), (tmp_path / "b" / path.name).read_bytes()
        if path.name in ("result.json", "report.html"):  # seconds differ
            one, two = (b"\n".join(x for x in t.splitlines() if not clocked(x)) for t in (one, two))
        assert one == two, path.name


def clocked(line):
    return any(word in line for word in (b'"build"', b'"solve"', b'"total"', b"Time taken"))


def test_the_same_call_gives_an_equal_value(found, hsr):
    assert calibrate(hsr, method="lm") == found
    assert calibrate(hsr, method="lm", seed=1) != found


def test_the_report_needs_no_folder(found, tmp_path):
    path = found.report(tmp_path / "r.html", box=((1000, 1700), (-400, 400), (400, 1000)))
    assert path.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert [entry.name for entry in tmp_path.iterdir()] == ["r.html"]


def test_the_library_logs_and_stays_silent_unless_asked(hsr, caplog, capsys):
    with caplog.at_level(logging.INFO, logger="casacal"):
        calibrate(hsr, method="lm")
    said = " ".join(record.getMessage() for record in caplog.records)
    assert "120 rows bound, 33 unknowns" in said
    assert "Converged" in said
    captured = capsys.readouterr()
    assert captured.out == captured.err == ""


def test_every_method_takes_what_the_list_of_methods_says():
    for name, listed in METHODS.items():
        takes = inspect.signature(method_of(name)).parameters
        assert ("seed" in takes) == listed.random, name
        assert ("loss" in takes) == (not listed.no_loss), name
        assert ("progress" in takes) == (not listed.quiet), name
    for name in ("gauss-newton", "nominal", "Result"):
        assert method_of(name) is None
        assert not minimises(name)


def test_every_method_by_name_is_also_a_function():
    for name in METHODS:
        home = casacal if name != "plane-only" else casacal.fit
        assert getattr(home, name.replace("-", "_")) is method_of(name)


def test_parts_of_another_kind_are_refused_in_a_sentence(hsr):
    robot, dial = hsr.problem.robot, hsr.problem.instrument
    with pytest.raises(CasacalError, match="Got an int as the robot"):
        Problem(5, dial)
    with pytest.raises(CasacalError, match="Got an int as an instrument"):
        Problem(robot, 5)
    with pytest.raises(CasacalError, match="Got a str as a term"):
        Problem(robot, dial, terms=("waves",))
    with pytest.raises(CasacalError, match="Got an int as a result"):
        read_result(5)


def test_whole_numbers_of_numpy_are_held_by_a_result():
    table = {"a": [0, -425, -392, 0, 0, 0], "d": [89, 0, 0, 109, 94, 82]}
    turns = np.radians([90, 0, 0, 90, -90, 0])
    parts = {name: np.array(values) for name, values in table.items()}
    robot = Robot.from_dh("arm", **parts, alpha=turns, theta=np.zeros(6))
    problem = Problem(robot, TrackedPoint(noise_std=0.05))
    assert problem_from(json.loads(json.dumps(problem_data(problem)))) == problem
