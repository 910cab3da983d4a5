"""Effects of the kit beside a problem of one's own: names that both use, and instruments whose unit is not mm."""

from dataclasses import dataclass
from typing import ClassVar

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT

import casacal
from casacal import (
    DialOnPlane,
    Frame,
    Instrument,
    Joint,
    Parameter,
    Plane,
    Problem,
    Robot,
    calibrate,
    load_problem,
    simulate,
    verify,
)
from casacal.effects import Effect, with_kit
from casacal.effects.effect import weighted
from casacal.errors import CasacalError, ProblemError
from casacal.model import ResidualBlock, Trusted
from casacal.model.dial import dial_zero
from casacal.model.instrument import Words
from casacal.model.kinematics import chain, position, rotate_z, rotation, transform_point, translate_x
from casacal.model.traced_instrument import TracedInstrument


@pytest.fixture(scope="module")
def ur5():
    return load_problem(ROOT / "problems" / "ur5").problem.robot


class RangeToWall(Instrument):
    columns: ClassVar = {"range": "length"}
    column_stds: ClassVar = {"range": 0.05}
    reading_limits: ClassVar = {"range": (50.0, 1500.0)}
    unknowns: ClassVar = {"wall": Plane(normal=(1, 0, 0), point=(1200, 0, 0), prior_std=(0.01, 5.0))}

    def residual(self, pose, p, row):
        return p.wall.distance(position(pose) + row.range * rotation(pose)[:, 0])


def test_a_parameter_called_as_an_effect_is_refused_by_name():
    def pose(p, q):
        joints = (q[0], q[1] + p.coupling[0] * q[0], q[2] + p.coupling[1] * q[1])
        return chain(*(step for k in range(3) for step in (rotate_z(joints[k]), translate_x(p.length[k]))))

    parameters = {
        "length": Parameter((400.0, 300.0, 200.0), unit="mm", prior_std=1.0),
        "coupling": Parameter((0.0, 0.0), unit="rad", prior_std=0.01),
    }
    robot = Robot("three", joints=[Joint("revolute", -0.7, 0.7)] * 3, pose=pose, parameters=parameters)
    problem = Problem(robot, RangeToWall())
    rows = simulate(problem, samples=60, seed=1).samples
    assert calibrate(problem, rows, reference=False, discrepancy="none").fit.unknowns == 8
    with pytest.raises(ProblemError, match=r"'coupling' is an unknown of 'joint coupling', and one of 'three'"):
        calibrate(problem, rows, reference=False)


def test_an_unknown_and_a_column_of_an_instrument_as_well(ur5):
    class Wire(Instrument):
        columns: ClassVar = {"first": "length"}
        column_stds: ClassVar = {"first": 0.05}
        unknowns: ClassVar = {"post": Parameter((1500.0, 0.0, 200.0), prior_std=5.0)}

        def residual(self, pose, p, row):
            return ca.norm_2(position(pose) - p.post) - row.first

    class Drifting(Wire):
        columns: ClassVar = {"wire": "length"}
        column_stds: ClassVar = {"wire": 0.05}
        unknowns: ClassVar = {**Wire.unknowns, "drift": Parameter(0.0, unit="mm", prior_std=1.0)}

        def residual(self, pose, p, row):
            return ca.norm_2(position(pose) - p.post) + p.drift - row.wire

    with pytest.raises(ProblemError, match="'first' is a column of the instrument"):
        _ = with_kit(Problem(ur5, Wire())).models
    with pytest.raises(ProblemError, match="'drift' is an unknown of"):
        _ = with_kit(Problem(ur5, Drifting())).models


def test_an_effect_of_the_joints_gives_one_number_a_joint(ur5):
    @dataclass(frozen=True, kw_only=True)
    class Bent(Effect):
        size: float = 1e-4
        doubt: float = 2.0
        key = "bent"
        words = "a bent joint"
        moves = True

        def unknowns(self, site):
            return {"bent": weighted(np.ones(1), self.size, "rad")}

        def joints(self, here):
            return here.p.bent[0] * ca.sin(here.q[1])

    with pytest.raises(ProblemError, match="joints of 'a bent joint' has 1 numbers, and the arm 6 joints"):
        _ = Problem(ur5, RangeToWall(), terms=[Bent()]).models


class Camera(Instrument):
    """Pixels of a spot on the flange, in a picture of a camera that stands."""

    columns: ClassVar = {"u": "number", "v": "number"}
    unknowns: ClassVar = {"camera": Frame.of((0.0, 0.0, 3000.0), (np.pi, 0.0, 0.0), prior_std=(0.01, 5.0))}
    blocks = (ResidualBlock("pixels", 2, "px", 0.05),)

    def residual(self, pose, p, row):
        x = transform_point(p.camera, position(pose))
        return ca.vertcat(2000 * x[0] / x[2] - row.u, 2000 * x[1] / x[2] - row.v)


class SpokenCamera(Camera):
    words = Words("distance in the picture", "px", "spots", "camera fitted alone", accuracy=True)


def test_blocks_in_another_unit_are_fitted_and_spoken_of_in_it(ur5, tmp_path):
    problem = Problem(ur5, Camera())
    found = calibrate(problem, simulate(problem, samples=60, seed=1).samples, method="lm", reference=False)
    assert found.verdict.level != "do not use", found.verdict.words
    assert "px" in found.summary()
    found.save(tmp_path)
    page = (tmp_path / "report.html").read_text()
    for words in ("residual, px", "Residual, px", " px, 0 of them beyond", "RMS of the fitted rows; before "):
        assert words in page
    assert "residual, mm" not in page.lower()

    class Inches(Camera):
        words = Words("distance in the picture", "in")

    with pytest.raises(ProblemError, match="Inches speaks of in, and its blocks are in px"):
        Problem(ur5, Inches())


def test_a_result_keeps_in_which_words_and_unit_an_instrument_speaks(ur5, tmp_path):
    problem = Problem(ur5, SpokenCamera())
    rows, fresh = (simulate(problem, samples=count, seed=1, session=k).samples for k, count in enumerate((80, 30)))
    made = calibrate(problem, rows, method="lm", reference=False)
    made.save(tmp_path)
    kept = casacal.load(tmp_path)
    assert verify(kept, fresh).p == pytest.approx(verify(made, fresh).p)
    for each in (made, kept):
        with pytest.raises(CasacalError, match="px"):
            verify(each, fresh, tolerance=0.5)
    dial = DialOnPlane(noise_std=0.01, zero_shift=dial_zero())
    for each in (SpokenCamera(), dial):
        traced = TracedInstrument.of(each, ur5.parameters)
        assert (traced.words, traced.groups) == (each.words, each.groups)


def test_what_shifts_an_unknown_of_several_units_by_one_size_is_refused(ur5):
    class Wall(RangeToWall):
        unknowns: ClassVar = {"wall": Plane(normal=(1, 0, 0), point=(1200, 0, 0), free=False)}
        trusted: ClassVar = {
            "wall": Trusted(words="the wall", std=0.001, unit="rad", shifts="wall", count=3, cure="a tracker")
        }

    with pytest.raises(ProblemError, match="shifts 'wall' by one size in mm and rad"):
        Problem(ur5, Wall())
