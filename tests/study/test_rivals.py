"""Other packages in `casacal bench`: what they are given against oracles, what they find against casacal's own fit."""

import dataclasses

import numpy as np
import pytest
from conftest import ROOT
from instruments_on_ur5 import PROBLEMS
from oracles import modified_dh_chain

from casacal import CasacalError, Problem, Robot, TrackedPoint, bind, deg, load_problem, simulate, tool_point
from casacal.study.benchmark import squares_of
from studies.bench import methods, packages
from studies.bench.packages import lines_of

UR5 = PROBLEMS["TrackedPoint"]
PANDA = Problem(
    Robot.from_dh(
        "Panda",
        convention="modified",
        alpha=deg(0, -90, 90, 90, -90, 90, 90),
        a=(0, 0, 0, 82.5, -82.5, 0, 88),
        d=(333, 0, 316, 0, 384, 0, 107),
        theta=(0.0,) * 7,
    ),
    TrackedPoint(noise_std=0.05, tool=tool_point(20, -30, 100, prior_std=5.0)),
)
IIWA = Problem(load_problem(ROOT / "problems" / "kuka_iiwa14").problem.robot, PANDA.instrument)


def rows(problem, seed=2):
    samples = simulate(problem, samples=70, seed=seed).samples
    return samples.take(range(45)), samples.take(range(45, 70))


def rms(residuals):
    return float(np.sqrt(squares_of(np.asarray(residuals), "distance").mean()))


@pytest.mark.long_unless("Panda")
@pytest.mark.parametrize("problem", [UR5, PANDA, IIWA], ids=lambda problem: problem.robot.name)
def test_the_arm_that_packages_are_given_is_the_arm_as_drawn(problem, tmp_path):
    """As modified DH by the oracle's chain, and as a URDF read back: the tips of casacal, at postures of the rows."""
    fitted, _ = rows(problem)
    bound = bind(problem.without_terms, fitted)
    tips, lines = bound.tips(bound.x0, fitted.joints), lines_of(problem, fitted, "a package")
    first, *moves, tool = lines.moves
    alpha, a, theta, d = np.array([np.zeros(4), *map(packages._modified_dh, moves)]).T
    for q, tip in zip(fitted.joints, tips, strict=True):
        found = first @ modified_dh_chain(alpha, a, d, theta + q) @ tool
        np.testing.assert_allclose(found[:3, 3], tip, atol=1e-9)
    names = [f"joint{k}" for k in range(len(lines.axes))]
    (tmp_path / "arm.urdf").write_text(packages._urdf(lines, names))
    again = Problem(Robot.from_urdf(tmp_path / "arm.urdf", base="link0", tip="tip"), TrackedPoint(noise_std=0.1))
    other = bind(again, fitted)
    flange = other.poses(other.x0, fitted.joints)[:, :3, 3]
    np.testing.assert_allclose(flange, tips, atol=1e-6)


def test_the_station_they_start_from_is_that_of_the_other_methods():
    fitted, _ = rows(UR5)
    bound, lines = bind(UR5.without_terms, fitted), lines_of(UR5, fitted, "a package")
    there = lines.station[:3, :3] @ bound.tips(bound.x0, fitted.joints).T + lines.station[:3, 3:]
    np.testing.assert_allclose(there.T - lines.read, bound.plain_residual(bound.x0).reshape(-1, 3), atol=1e-8)
    assert lines.noise == pytest.approx(0.05)


@pytest.mark.parametrize("package", ["robotkinecal", "figaroh"])
def test_a_package_finds_the_arm_of_casacals_own_fit(package, capsys):
    pytest.importorskip(package)
    problem, (fitted, unseen) = UR5, rows(UR5)
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    theirs = np.asarray(packages.methods[package](problem, fitted, unseen))
    assert (np.random.get_state()[1] == before).all()  # noqa: NPY002
    assert capsys.readouterr().out == ""
    mine = np.asarray(methods.methods["geometry (SciPy)"](problem, fitted, unseen))
    assert rms(theirs) == pytest.approx(rms(mine), rel=0.1)
    assert rms(mine) < 0.1 * rms(methods.methods["as drawn"](problem, fitted, unseen))
    np.random.random(3)  # noqa: NPY002
    again = np.asarray(packages.methods[package](problem, fitted, unseen))
    np.testing.assert_array_equal(theirs, again)


def test_pybotics_starts_at_the_drawing_and_ends_nearer(monkeypatch):
    pytest.importorskip("pybotics")
    fitted, unseen = rows(PANDA)
    bound = bind(PANDA.without_terms, fitted)
    still = lambda function, start, args: dataclasses.make_dataclass("Found", ["x"])(start)  # noqa: E731
    drawn = bound.plain_residual(bound.x0).reshape(-1, 3)
    with monkeypatch.context() as patch:
        patch.setattr(packages, "least_squares", still)
        np.testing.assert_allclose(packages.by_pybotics(PANDA, fitted, fitted), drawn, atol=1e-6)
    found = rms(packages.by_pybotics(PANDA, fitted, unseen))
    assert found < 0.5 * rms(methods.methods["as drawn"](PANDA, fitted, unseen))


@pytest.mark.parametrize("package", packages.methods)
def test_what_no_package_takes_is_said(package):
    wire = PROBLEMS["Distance"]
    some = simulate(wire, samples=60, seed=1).samples
    with pytest.raises(CasacalError, match=f"{package} fits points read in one frame.*measured by Distance. Leave"):
        packages.methods[package](wire, some, some)
    sliding = Robot.from_dh(
        "slider", alpha=deg(90, 0, 90), a=(0, 300, 0), d=(100, 0, 50), theta=(0, 0, 0), joints="PRR"
    )
    arm = Problem(sliding, TrackedPoint(noise_std=0.1))
    with pytest.raises(CasacalError, match="arms of revolute joints"):
        packages.methods[package](arm, some, some)


@pytest.mark.parametrize("package", packages.methods)
def test_a_package_that_is_absent_says_so(package, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(CasacalError, match=rf"{package} is not installed\. Install .* 'casacal\[{package}\]'"):
        packages.methods[package](UR5, *rows(UR5))
