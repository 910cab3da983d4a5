"""Robots, problems, samples, results and calibrations are values: they pickle, copy, compare and cannot be changed."""

import copy
import dataclasses
import math
import os
import pickle
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from conftest import ROOT
from own_instrument import SOURCES, written

from casacal import (
    DialOnPlane,
    Direction,
    Frame,
    Parameter,
    Plane,
    Problem,
    Robot,
    Samples,
    bind,
    calibrate,
    lm,
    load_problem,
    simulate,
)
from casacal.model.kinematics import chain, rotate_z, translate_x
from casacal.values import alike

FOLDERS = sorted(path.parent for path in (ROOT / "problems").glob("*/problem.py"))


@pytest.fixture(scope="module")
def found(hsr):
    return calibrate(hsr, method="lm", holdout=0.2)


@pytest.fixture(scope="module")
def values(hsr, found):
    return {
        "robot": hsr.problem.robot,
        "instrument": hsr.problem.instrument,
        "problem": hsr.problem,
        "file": hsr,
        "samples": found.samples,
        "bound": found.fit,
        "result": found.result,
        "calibration": found,
        "simulation": simulate(hsr.problem, hsr.cell, samples=12, seed=1),
        "prediction": found.predict([0.1, 0.2, 0.3, 0.1, 0.5, 0.2]),
        "compensation": found.compensate([[0.1, 0.2, 0.3, 0.1, 0.5, 0.2]]),
        "arm": found.arm,
    }


NAMES = ("robot", "instrument", "problem", "file", "samples", "bound", "result", "calibration")
NAMES += ("simulation", "prediction", "compensation", "arm")


@pytest.mark.parametrize("name", NAMES)
def test_what_is_pickled_comes_back_equal_and_read_only(values, name):
    value = values[name]
    back = pickle.loads(pickle.dumps(value))
    assert back is not value
    if name != "instrument":  # of a class that only its file knows: compared by its problem
        assert back == value
    for array in arrays(back):
        assert not array.flags.writeable
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    assert len(repr(back).splitlines()) <= 5
    assert len(repr(back)) < 600
    assert copy.deepcopy(value) == value
    assert copy.copy(value) == value


def arrays(value, depth=0):
    """All arrays in the fields of a value, at any depth of values, mappings and tuples."""
    if isinstance(value, np.ndarray):
        yield value
    elif dataclasses.is_dataclass(value) and depth < 6:
        for field in dataclasses.fields(value):
            yield from arrays(getattr(value, field.name), depth + 1)
    elif isinstance(value, dict) or hasattr(value, "items"):
        for item in value.values():
            yield from arrays(item, depth + 1)
    elif isinstance(value, tuple):
        for item in value:
            yield from arrays(item, depth + 1)
    elif hasattr(value, "codes"):
        yield value.codes


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_file_read_twice_gives_the_same_problem(folder):
    one, two = load_problem(folder), load_problem(folder)
    assert one.problem is not two.problem
    assert one == two
    assert one.problem.robot == two.problem.robot
    assert one.problem.digest == two.problem.digest
    assert pickle.loads(pickle.dumps(one)) == two


def test_what_differs_is_not_equal(hsr, found):
    problem = hsr.problem
    assert problem != problem.fix("a3")
    assert problem != problem.with_prior({"a": 0.1})
    assert problem.digest != problem.fix("a3").digest
    assert problem.robot != dataclasses.replace(problem.robot, name="another")
    bent = dataclasses.replace(problem.robot, pose=lambda p, q: problem.robot.pose(p, 1.000001 * q))
    assert bent != problem.robot
    same = dataclasses.replace(problem.robot, pose=lambda p, q: problem.robot.pose(p, q))
    assert same == problem.robot
    other = problem.robot
    assert Problem(other, DialOnPlane(noise_std=0.01)) != Problem(other, DialOnPlane(noise_std=0.02))
    assert Problem(other, DialOnPlane(noise_std=0.01)) == Problem(other, DialOnPlane(noise_std=0.01))
    # DialOnLastOffset computes another tip than the dial it derives from, with all fields alike
    assert problem != Problem(other, DialOnPlane(noise_std=0.01))
    moved = found.samples.joints.copy()
    moved[3, 2] += 1e-12
    assert dataclasses.replace(found.samples, joints=moved) != found.samples
    assert found.samples.take([0, 1]) != found.samples.take([1, 0])
    assert found.result != dataclasses.replace(found.result, x=found.result.x + 1e-9)
    assert (found.samples == 3) is False


def test_a_robot_by_a_lambda_pickles_as_its_graph():
    def last(p):
        return p.wall.offset

    def pose(p, q):
        return chain(rotate_z(q[0] + p.zero), translate_x(p.l1), p.foot, translate_x(300 * p.axis[0] + last(p)))

    parameters = {
        "zero": Parameter(0.0, unit="rad"),
        "l1": Parameter(400.0),
        "foot": Frame(np.eye(4)),
        "axis": Direction((1, 1, 0)),
        "wall": Plane((0, 0, 1), (0, 0, 5)),
    }
    robot = Robot("closure", 1, pose, parameters)
    back = pickle.loads(pickle.dumps(robot))
    assert back == robot
    problem = Problem(robot, DialOnPlane(noise_std=0.01, reading=False, plane=Plane((1, 0, 0), (500, 0, 0))))
    again = pickle.loads(pickle.dumps(problem))
    rows = Samples.of_joints(np.linspace(-1, 1, 40)[:, None])
    one, two = bind(problem, rows), bind(again, rows)
    x = 0.1 * np.random.default_rng(0).normal(size=one.unknowns)
    np.testing.assert_allclose(two.residual(x), one.residual(x), rtol=0, atol=1e-9)
    np.testing.assert_allclose(two.jacobian(x), one.jacobian(x), rtol=0, atol=1e-9)


@pytest.mark.long_unless("held")
@pytest.mark.parametrize("name", SOURCES)
def test_what_a_problem_file_defines_travels_to_a_process_that_never_saw_it(tmp_path, name):
    """Results there are those here, bit by bit; the file may be gone by then."""
    place = written(tmp_path, name)
    source = load_problem(place)
    samples = simulate(source.problem, samples=60, seed=3).samples
    here = calibrate(source, samples, method="lm")
    (tmp_path / "all.pickle").write_bytes(pickle.dumps((source, samples, here)))
    if name != "wire":  # whose module beside it is needed
        (place / "problem.py").unlink()
    script = textwrap.dedent("""
        import pickle, sys
        import numpy as np
        from casacal import calibrate
        source, samples, there = pickle.loads(open(sys.argv[1], "rb").read())
        again = calibrate(source, samples, method="lm")
        assert again.fit == there.fit
        assert np.array_equal(again.x, there.x), again.x - there.x
        print("x" + there.x.tobytes().hex(), repr(there))
    """)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script, str(tmp_path / "all.pickle")],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[0] == "x" + here.x.tobytes().hex()


def test_a_class_without_a_file_says_why_it_does_not_pickle(hsr):
    class Local(DialOnPlane):
        pass

    with pytest.raises(pickle.PicklingError, match="file of its own"):
        pickle.dumps(Problem(hsr.problem.robot, Local(noise_std=0.1)))


def test_mappings_and_lists_that_were_passed_in_do_not_leak_in(hsr):
    parameters = {"l": Parameter([1.0, 2.0])}
    robot = Robot("r", 1, lambda p, q: rotate_z(q[0] + p.l[0]), parameters)
    parameters["m"] = Parameter(1.0)
    assert list(robot.parameters) == ["l"]
    with pytest.raises(AttributeError):
        robot.parameters.x = 1
    numbers = np.array([1.0, 2.0])
    given = Parameter(numbers)
    numbers[0] = 9.0
    assert given.values == (1.0, 2.0)
    steps = {}
    dial = DialOnPlane(noise_std=0.1, steps=steps)
    steps["a"] = None
    assert not dial.steps


def test_a_result_does_not_share_memory_with_what_made_it(hsr, found):
    x = found.x.copy()
    started = lm(found.fit, start=x)
    x[:] = 0
    assert np.abs(started.x).max() > 0


@pytest.mark.long
def test_types_hold_for_a_user_of_the_package(tmp_path):
    """py.typed: a user's strict mypy sees casacal's types; a wrong one is an error."""
    pytest.importorskip("mypy")
    wrong = tmp_path / "wrong.py"
    wrong.write_text("import casacal\nunknowns: str = casacal.calibrate('p').fit.unknowns\n")
    command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path / "cache"), "--no-error-summary"]
    good = subprocess.run(
        [*command, str(ROOT / "tests" / "typed_user.py")], capture_output=True, text=True, cwd=tmp_path
    )
    assert good.returncode == 0, good.stdout
    bad = subprocess.run([*command, str(wrong)], capture_output=True, text=True, cwd=tmp_path)
    assert bad.returncode == 1
    assert 'has type "int", variable has type "str"' in bad.stdout


@pytest.mark.long
def test_a_study_of_values_needs_no_file_for_its_workers(hsr, tmp_path):
    from casacal.errors import StudyError
    from casacal.simulation import Simulated
    from casacal.study import Study, run

    setting = Simulated(hsr.problem, hsr.cell, samples=60, heldout=15)
    study = Study("memory", {"corner": setting}, {"LM": lm}, trials=4)
    here = run(study, tmp_path / "here")
    there = run(study, tmp_path / "there", workers=2)
    assert there.digest == here.digest
    assert not here.failures("corner", "LM")
    closure = Study("closure", {"corner": setting}, {"LM": lambda problem: lm(problem)}, trials=2)
    with pytest.raises(StudyError, match="Write it to a file"):
        run(closure, tmp_path / "closure", workers=2)


def test_what_is_not_known_is_alike():
    assert alike({"a": (math.nan, 1)}, {"a": (float("nan"), 1)})
    assert not alike({"a": (math.nan, 1)}, {"a": (0.0, 1)})
