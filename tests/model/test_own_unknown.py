"""An unknown of one's own kind from four declarations: the axis of a post that a tip touches all around."""

import dataclasses
import math
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from casacal import Frame, Instrument, Parameter, Problem, bind, calibrate, ipopt, lm, load_problem, simulate
from casacal.errors import ProblemError
from casacal.model import Unknown
from casacal.model.kinematics import transform_point

ROBOT = load_problem(ROOT / "problems" / "ur5").problem.robot


@dataclass(frozen=True)
class Axis(Unknown):
    """A line that is nearly parallel to z: where it crosses z = 0, and its slopes."""

    x: float
    y: float
    prior_std: tuple[float, ...] = (math.inf,) * 4
    units = ("mm", "mm", "rad", "rad")

    @property
    def prior_stds(self):
        return np.array(self.prior_std)

    @property
    def nominal(self):
        return np.array([self.x, self.y, 0.0, 0.0])

    def at(self, nominal, local):
        return nominal + local


class Post(Instrument):
    """A ball on the flange runs around a post of 80 mm."""

    residual_std = 0.01
    unknowns: ClassVar = {"axis": Axis(480.0, 60.0), "tool": Parameter((0.0, 20.0, 90.0), prior_std=0.2)}

    def residual(self, pose, p, row):
        apart = transform_point(pose, p.tool) - ca.vertcat(p.axis[0], p.axis[1], 0)
        way = ca.vertcat(p.axis[2], p.axis[3], 1)
        return ca.norm_2(apart - way * ca.dot(apart, way) / ca.dot(way, way)) - 80.0


@pytest.fixture(scope="module")
def made():
    return simulate(Problem(ROBOT, Post()), samples=90, seed=3)


def test_it_is_estimated_as_scipy_estimates_it(made):
    """The distance from a line by a cross product, and poses of the arm at what lm found: the axis alone is asked."""
    bound = bind(made.problem, made.samples)
    found, checked = lm(bound), ipopt(bound)
    assert found.converged
    assert checked.cost == pytest.approx(found.cost, rel=1e-9)
    own = [bound.names.index(f"axis{k}") for k in range(1, 5)]
    tips = (bound.poses(found.x, made.samples.joints) @ [*_tool(bound, found.x), 1.0])[:, :3]

    def missed(u):
        way = np.array([u[2], u[3], 1.0])
        return np.linalg.norm(np.cross(tips - [u[0], u[1], 0.0], way / np.linalg.norm(way)), axis=1) - 80.0

    theirs = least_squares(missed, [480.0, 60.0, 0.0, 0.0], x_scale=[1, 1, 1e-3, 1e-3], xtol=1e-15, ftol=1e-15)
    np.testing.assert_allclose(found.x[own] + [480.0, 60.0, 0.0, 0.0], theirs.x, atol=1e-5)


def _tool(bound, x):
    return np.array([0.0, 20.0, 90.0]) + x[[bound.names.index(f"tool{k}") for k in (1, 2, 3)]]


def test_it_has_priors_names_and_a_result(made, tmp_path):
    problem = made.problem.with_prior({"axis3": 1e-4})
    assert problem.instrument.unknowns["axis"].prior_std == (math.inf, math.inf, 1e-4, math.inf)
    found = calibrate(made.problem, made.samples, reference=False)
    assert found.success
    found.save(tmp_path / "fit")
    assert (tmp_path / "fit" / "result.json").is_file()
    with pytest.raises(ProblemError, match="A Axis cannot be held"):
        made.problem.fix("axis")


def test_what_it_does_not_say_is_asked_for():
    class Loose(Axis):
        nominal = None

    assert (Loose(0, 0).size, Loose(0, 0).nominal_size) == (4, 4)
    with pytest.raises(ProblemError, match="does not say where a simulation places it"):
        Loose(0, 0).placed(np.zeros(3), np.zeros(3))

    class Bare(Unknown):
        units = ("mm",)
        prior_stds = np.array([1.0])
        nominal = np.zeros(1)

        def at(self, nominal, local):
            return nominal + local

    assert Bare().names("k") == ("k",)
    with pytest.raises(ProblemError, match="The prior of a Bare cannot be replaced"):
        Bare().with_prior([1.0])


def test_a_frame_from_a_translation_and_a_rotation():
    turn = Rotation.from_rotvec([0.4, -1.2, 2.0])
    expected = np.vstack([np.column_stack([turn.as_matrix(), [1.0, 2.0, 3.0]]), [0, 0, 0, 1]])
    for rotation in (turn.as_matrix(), turn.as_rotvec()):
        frame = Frame.of((1, 2, 3), rotation, prior_std=(1e-3, 0.5))
        np.testing.assert_allclose(np.array(frame.matrix), expected, atol=1e-12)
        assert frame.prior_std == (1e-3, 0.5)
    np.testing.assert_array_equal(np.array(Frame.of((1, 2, 3)).matrix)[:3, :3], np.eye(3))
    assert Frame.of((1, 2, 3), free=False).size == 0
    for wrong in (((1, 2), None), ((1, 2, 3), (1, 2)), ((1, 2, 3), np.diag([1.0, 1.0, -1.0]))):
        with pytest.raises(ProblemError, match=r"translation|mirrors"):
            Frame.of(*wrong)


class Laser(Instrument):
    columns: ClassVar = {"range": "length"}

    def residual(self, pose, p, row):
        return pose[2, 3] - row.range


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        ({"resdual_std": 0.1}, "has 'resdual_std', which nobody asks for. Call it 'residual_std'"),
        ({"residual_std": 0.1, "reading_limit": {}}, "Call it 'reading_limits'"),
        ({}, "declares no noise. Give it a residual_std, or column_stds"),
    ],
)
def test_a_slip_in_a_declaration_is_said(more, sentence):
    with pytest.raises(ProblemError, match=sentence):
        Problem(ROBOT, type("Own", (Laser,), more)())


def test_helpers_of_ones_own_are_left_alone():
    Problem(ROBOT, type("Own", (Laser,), {"residual_std": 0.1, "offset": 3.0, "to_mm": lambda self, v: v})())


def test_a_name_that_does_not_exist_is_named_with_those_that_do():
    class Slip(Laser):
        residual_std = 0.1

        def residual(self, pose, p, row):
            return pose[2, 3] - row.rnage

    with pytest.raises(ProblemError, match="there is no 'rnage', but range"):
        _ = Problem(ROBOT, Slip()).symbols.residual
    wrong = dataclasses.replace(ROBOT, pose=lambda p, q: ca.SX.eye(4) * p.len)
    with pytest.raises(ProblemError, match="there is no 'len', but alpha, a, d"):
        _ = Problem(wrong, Slip()).symbols.pose


def test_a_kind_of_ones_own_may_be_held_by_its_own_flag(hsr):
    """Then it has no units."""
    held = type("Held", (Broken,), {"units": (), "prior_stds": np.zeros(0), "at": lambda self, nominal, local: nominal})

    class Post(Instrument):
        residual_std = 0.01
        unknowns = MappingProxyType({"axis": held()})

        def residual(self, pose, p, row):
            return pose[0, 3] - p.axis[0] - p.axis[1]

    assert Problem(hsr.problem.robot, Post()).instrument.unknowns["axis"].size == 0


class Broken(Unknown):
    """An unknown of one's own with one slip."""

    units = ("mm", "rad")
    prior_stds = np.array([1.0, 0.01])
    nominal = np.array([3.0, 0.0])

    def at(self, nominal, local):
        return nominal + local


@pytest.mark.parametrize(
    ("slip", "words"),
    [
        ({"prior_stds": np.array([1.0])}, r"prior_stds of unknown 'axis' of Post, a Broken, are \[1.0\]. Give 2"),
        ({"prior_stds": np.array([1.0, -1.0])}, "Give 2 positive numbers"),
        ({"prior_stds": None}, "prior_stds"),
        ({"prior_stds": ("a", "b")}, "are no numbers"),
        ({"units": ["mm", "rad"]}, "Give a tuple such as"),
        ({"units": ("mm", 3)}, "Give a tuple such as"),
        ({"nominal": np.array([np.nan, 0.0])}, "Give finite numbers, or None"),
        ({"at": lambda self, nominal: nominal}, "`at` of unknown 'axis' of Post, a Broken, failed"),
        ({"at": lambda self, nominal, local: nominal + local[0]}, r"does not use number 2 of local \(rad\)"),
        ({"nominal": np.array([1.0, 2.0, 3.0])}, "`at` of .* failed"),
    ],
)
def test_slips_in_a_kind_of_ones_own_are_named(slip, words, hsr):
    kind = type("Broken", (Broken,), slip)

    class Post(Instrument):
        residual_std = 0.01
        unknowns = MappingProxyType({"axis": kind()})

        def residual(self, pose, p, row):
            return pose[0, 3] - p.axis[0] - p.axis[1]

    with pytest.raises(ProblemError, match=words):
        Problem(hsr.problem.robot, Post())
