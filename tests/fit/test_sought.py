"""What has no nominal value, and no formula of its instrument, is found where residuals are least; of any kind."""

import math
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT

from casacal import (
    Direction,
    Frame,
    Instrument,
    Parameter,
    Plane,
    Problem,
    TrackedPoint,
    bind,
    calibrate,
    load,
    load_problem,
    simulate,
    verify,
)
from casacal.errors import ProblemError
from casacal.model.kinematics import position, rotation, transform_point
from casacal.model.unknown import Unknown
from casacal.simulation import Disturbances

POINT = ("_x", "_y", "_z")


class Wire(Instrument):
    """A draw wire from a post, which stands elsewhere in each session, with a zero."""

    columns = {"wire": "length"}  # noqa: RUF012
    column_stds = {"wire": 0.05}  # noqa: RUF012
    unknowns = {  # noqa: RUF012
        "post": Parameter((1500.0, 0.0, 200.0), prior_std=300.0, per="session", labels=POINT),
        "zero": Parameter(30.0, prior_std=50.0),
    }

    def residual(self, pose, p, row):
        return ca.norm_2(position(pose) - p.post) + p.zero - row.wire


class BlindWire(Wire):
    unknowns = {  # noqa: RUF012
        "post": Parameter(None, labels=POINT, per="session"),
        "zero": Parameter(None, start_std=10.0),
    }


def test_posts_of_sessions_and_a_zero_are_found_together(hsr):
    true = simulate(Problem(hsr.problem.robot, Wire()), samples=90, seed=2)
    blind = Problem(hsr.problem.robot, BlindWire())
    bound = bind(blind, true.samples)
    stands = {slot.name: slot.nominal for slot in bound.slots}
    for label in ("1", "2", "3"):
        there = np.array([1500.0, 0.0, 200.0]) + true.local[f"post.{label}"]
        assert np.linalg.norm(stands[f"post.{label}"] - there) < 30  # the drawn arm errs by millimetres
    found = calibrate(blind, true.samples)
    assert found.success
    said = found.parameters
    for label in ("1", "2", "3"):
        there = np.array([1500.0, 0.0, 200.0]) + true.local[f"post.{label}"]
        of_post = said.loc[[f"post.{label}{axis}" for axis in POINT]]
        assert (np.abs(of_post.estimate - there) < 4 * of_post["std"]).all(), label


def test_what_stands_already_stays_where_it_is_while_others_are_sought(hsr):
    class KnownPosts(Wire):
        unknowns = {"post": Wire.unknowns["post"].with_prior([1e-6] * 3), "zero": Parameter(None, start_std=10.0)}  # noqa: RUF012

    known = Problem(hsr.problem.robot, Wire()).with_prior({"post": 1e-6, "zero": 1e-6})
    rows = simulate(known, Disturbances(error_scale=0.0), samples=60, seed=9).samples
    zero = next(slot for slot in bind(Problem(hsr.problem.robot, KnownPosts()), rows).slots if slot.name == "zero")
    assert zero.nominal[0] == pytest.approx(30.0, abs=0.05)


def test_a_direction_is_found_whichever_way_it_looks(hsr):
    @dataclass(frozen=True)
    class Beam(Instrument):
        beam: Direction
        columns = {"range": "length"}  # noqa: RUF012
        column_stds = {"range": 0.05}  # noqa: RUF012

        def residual(self, pose, p, row):
            return ca.dot(position(pose), p.beam) - row.range

    for way in ((0.6, 0.0, 0.8), (-0.6, 0.0, -0.8), (0.0, -1.0, 0.0)):
        true = simulate(Problem(hsr.problem.robot, Beam(Direction(way, prior_std=1e-6))), samples=60, seed=3)
        slot = bind(Problem(hsr.problem.robot, Beam(Direction(None))), true.samples).slots[-1]
        assert math.acos(min(slot.nominal[:3] @ way, 1.0)) < 0.01


def test_a_frame_is_found_where_the_rigid_fit_of_its_points_has_it(hsr):
    """The same rows with the formula of the tracker: Arun, Huang and Blostein."""

    class Blind(Instrument):
        columns = TrackedPoint.columns
        residual_std = 0.05
        unknowns = {"station": Frame()}  # noqa: RUF012

        def residual(self, pose, p, row):
            return transform_point(p.station, position(pose)) - ca.vertcat(row.x, row.y, row.z)

    robot = hsr.problem.robot
    tracker = TrackedPoint(noise_std=0.05, tool=Parameter((0.0, 0.0, 0.0), free=False))
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    turned[:3, 3] = (3000.0, -500.0, 100.0)
    true = simulate(Problem(robot, replace(tracker, station=Frame(turned, prior_std=0.3))), samples=50, seed=4)
    fitted, sought = (bind(Problem(robot, each), true.samples).slots[-1] for each in (tracker, Blind()))
    np.testing.assert_allclose(sought.nominal, fitted.nominal, rtol=1e-6, atol=1e-4)


def test_a_plane_is_found_where_total_least_squares_have_it(hsr):
    class Blind(Instrument):
        residual_std = 0.1
        unknowns = {"face": Plane()}  # noqa: RUF012

        def residual(self, pose, p, row):
            return p.face.distance(position(pose))

    flat = simulate(Problem(hsr.problem.robot, Blind()), samples=40, seed=5).samples
    bound = bind(Problem(hsr.problem.robot, Blind()), flat)
    drawn = bound.tips(np.zeros(bound.unknowns), flat.joints)
    _, _, axes = np.linalg.svd(drawn - drawn.mean(axis=0))
    assert abs(bound.slots[-1].nominal[:3] @ axes[2]) > 1 - 1e-7


@dataclass(frozen=True)
class OnRail(Unknown):
    """A point somewhere along a rail through (1500, 0, 200) in y: a kind of unknown of one's own."""

    along: float | None
    units = ("mm",)
    prior_stds = np.array([math.inf])

    @property
    def nominal(self):
        return None if self.along is None else np.array([self.along])

    def at(self, nominal, local):
        return ca.vertcat(1500.0, nominal[0] + local[0], 200.0)

    def placed(self, near, normal):
        return np.array([near[1]])

    def recentred(self, nominal, local):
        return nominal + local


class RailWire(Wire):
    unknowns = {"post": OnRail(None)}  # noqa: RUF012

    def residual(self, pose, p, row):
        return ca.norm_2(position(pose) - p.post) - row.wire


def test_an_unknown_of_ones_own_kind_is_found_and_estimated(hsr):
    class Known(RailWire):
        unknowns = {"post": OnRail(-420.0)}  # noqa: RUF012

    true = simulate(Problem(hsr.problem.robot, Known()), samples=70, seed=6)
    there = -420.0 + float(true.local["post"][0])
    problem = Problem(hsr.problem.robot, RailWire())
    bound = bind(problem, true.samples)
    assert abs(bound.slots[-1].nominal[0] - there) < 20
    found = calibrate(problem, true.samples)
    assert found.success
    slot = next(slot for slot in found.fit.slots if slot.name == "post")
    estimate = float(slot.value(found.x)[1])
    assert abs(estimate - there) < abs(bound.slots[-1].nominal[0] - there)


@pytest.mark.long
def test_what_was_sought_serves_where_the_class_cannot_travel(hsr, tmp_path):
    """A result that is read has its instrument as a graph, without a formula; it judges fresh rows all the same."""
    true = Problem(hsr.problem.robot, Wire())
    blind = Problem(hsr.problem.robot, BlindWire())
    found = calibrate(blind, simulate(true, samples=120, seed=7).samples)
    fresh = simulate(true, samples=40, seed=7, session=1).samples
    found.save(tmp_path / "fit")
    here, there = verify(found, fresh), verify(load(tmp_path / "fit"), fresh)
    assert here.kept
    assert there.kept
    assert there.after_mm == pytest.approx(here.after_mm, rel=1e-6)
    assert there.chi_square == pytest.approx(here.chi_square, rel=1e-6)


def test_what_no_place_makes_finite_is_asked_for(hsr):
    class Nowhere(BlindWire):
        def residual(self, pose, p, row):
            return super().residual(pose, p, row) + ca.sqrt(-1 - p.zero**2) + rotation(pose)[0, 0]

    rows = simulate(Problem(hsr.problem.robot, Wire()), samples=30, seed=8).samples
    with pytest.raises(ProblemError, match=r"no nominal value, and residuals are not finite .*override `propose`"):
        bind(Problem(hsr.problem.robot, Nowhere()), rows)


def test_an_unknown_that_no_row_depends_on_is_refused(hsr):
    class Ghost(BlindWire):
        unknowns = {**BlindWire.unknowns, "ghost": Parameter(None, labels=POINT)}  # noqa: RUF012

    rows = simulate(Problem(hsr.problem.robot, Wire()), samples=30, seed=8).samples
    with pytest.raises(ProblemError, match="No row depends on 'ghost' of Ghost, which has no nominal value"):
        bind(Problem(hsr.problem.robot, Ghost()), rows)


def test_what_rows_do_not_see_stays_within_the_workspace():
    """The arm is a SCARA: post and eye of a wire move along z together, and no row tells."""

    class Eyed(Wire):
        unknowns = {"post": Parameter((700.0, 300.0, 200.0)), "eye": Parameter((0.0, 0.0, 50.0), labels=POINT)}  # noqa: RUF012

        def residual(self, pose, p, row):
            return ca.norm_2(transform_point(pose, p.eye) - p.post) - row.wire

    class Blind(Eyed):
        unknowns = {"post": Parameter(None, labels=POINT), "eye": Parameter(None, labels=POINT)}  # noqa: RUF012

    robot = load_problem(ROOT / "problems" / "adept_cobra600").problem.robot
    for seed in range(3):
        rows = simulate(Problem(robot, Eyed()), samples=50, seed=seed).samples
        post, eye = (slot.nominal for slot in bind(Problem(robot, Blind()), rows).slots[-2:])
        assert np.abs([post, eye]).max() < 1e4
        assert post[2] + eye[2] == pytest.approx(250.0, abs=30.0)  # all that rows see of heights: the flange looks down


@pytest.mark.long
def test_rows_of_one_posture_count_once_and_are_too_few(hsr):
    rows = simulate(Problem(hsr.problem.robot, Wire()), samples=3, seed=8).samples.take(np.zeros(40, dtype=int))
    read = rows.columns["wire"] + np.random.default_rng(0).normal(size=40) * 0.05
    rows = replace(rows, columns={"wire": read})
    with pytest.raises(ProblemError, match="'zero' has 1 row for 1 unknown of its own"):
        calibrate(Problem(hsr.problem.robot, BlindWire()), rows, reference=False)
