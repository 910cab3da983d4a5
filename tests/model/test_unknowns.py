"""Kinds of unknown: their maps are smooth, keep their constraint, and invert."""

import math

import casadi as ca
import numpy as np
import pytest
from oracles import central_difference
from scipy.spatial.transform import Rotation

from casacal import CasacalError, Direction, Frame, Parameter, Plane
from casacal.model.geometry import fitted_plane, rotation_between

SOME = [
    Parameter((1.0, 2.0, 3.0), unit="mm", prior_std=0.5),
    Parameter(4.0, unit="rad", prior_std=0.1),
    Direction((1, 2, -2)),
    Plane((0.1, -0.4, 1.0), (10, 20, 30)),
    Frame(((0, -1, 0, 5), (1, 0, 0, 6), (0, 0, 1, 7), (0, 0, 0, 1))),
]


def flat(value):
    """Numbers of a value, whatever its kind."""
    if hasattr(value, "normal"):
        return np.concatenate([np.array(value.normal).ravel(), np.array(ca.DM(value.point)).ravel()])
    return np.array(ca.DM(value)).ravel()


@pytest.mark.parametrize("unknown", SOME, ids=lambda u: type(u).__name__)
def test_raw_and_local_coordinates_describe_the_same_value(unknown):
    rng = np.random.default_rng(0)
    nominal = ca.DM(unknown.nominal)
    assert unknown.raw_start(unknown.nominal).size == unknown.raw_size
    raw = unknown.raw_start(unknown.nominal) + 0.2 * rng.normal(size=unknown.raw_size)
    if isinstance(unknown, Direction | Plane):
        raw[:3] /= np.linalg.norm(raw[:3])
    if isinstance(unknown, Frame):
        raw[:4] /= np.linalg.norm(raw[:4])
    assert all(abs(float(g)) < 1e-12 for g in unknown.raw_constraints(ca.DM(raw)))
    local = unknown.raw_local(nominal, ca.DM(raw))
    np.testing.assert_allclose(
        flat(unknown.at(nominal, local)), flat(unknown.raw_value(nominal, ca.DM(raw))), atol=1e-9
    )


@pytest.mark.parametrize("unknown", SOME, ids=lambda u: type(u).__name__)
def test_zero_is_the_nominal_and_every_coordinate_matters(unknown):
    nominal = ca.DM(unknown.nominal)
    start = unknown.raw_value(nominal, ca.DM(unknown.raw_start(unknown.nominal)))
    np.testing.assert_allclose(flat(unknown.at(nominal, ca.DM.zeros(unknown.size))), flat(start), atol=1e-12)
    slopes = central_difference(
        lambda x: flat(unknown.at(nominal, ca.DM(x))), np.zeros(unknown.size), [1e-5] * unknown.size
    )
    assert np.linalg.matrix_rank(slopes, tol=1e-6) == unknown.size


def test_tilts_are_angles():
    direction = Direction((0, 0, 1))
    tilted = np.array(direction.at(ca.DM(direction.nominal), ca.DM([3e-3, 4e-3]))).ravel()
    assert np.linalg.norm(tilted) == pytest.approx(1, abs=1e-15)
    assert math.acos(tilted[2]) == pytest.approx(5e-3, rel=1e-5)


def test_rotations_of_a_frame_are_rotation_vectors_to_second_order():
    frame = Frame(np.eye(4).tolist())
    small = np.array([1e-3, -2e-3, 3e-3])
    turned = np.array(frame.at(ca.DM(frame.nominal), ca.DM([*small, 0, 0, 0])))[:3, :3]
    np.testing.assert_allclose(turned, Rotation.from_rotvec(small).as_matrix(), atol=1e-8)
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-14)


def test_a_held_component_stays_and_the_others_keep_their_names():
    parameter = Parameter((1.0, 2.0, 3.0), prior_std=(0.1, 0.2, 0.3), free=(True, False, True))
    assert parameter.names("a") == ("a1", "a3")
    np.testing.assert_allclose(parameter.prior_stds, [0.1, 0.3])
    np.testing.assert_allclose(flat(parameter.at(parameter.nominal, np.array([0.5, -0.5]))), [1.5, 2.0, 2.5])
    assert parameter.with_free([False, True]).names("a") == ("a3",)
    np.testing.assert_allclose(parameter.with_prior([9, 8]).prior_stds, [9, 8])


def test_coordinates_that_share_a_prior_change_together(hsr):
    np.testing.assert_allclose(Direction((0, 0, 1)).with_prior([0.01, math.inf]).prior_stds, [0.01, 0.01])
    plane = Plane(per="plane").with_prior([0.01, math.inf, math.inf])
    np.testing.assert_allclose(plane.prior_stds, [0.01, 0.01, math.inf])
    np.testing.assert_allclose(plane.with_prior([0.01, 0.02, 3.0]).prior_stds, [0.02, 0.02, 3.0])
    frame = Frame(prior_std=(0.1, 5.0)).with_prior([0.1, 0.1, 0.1, 5.0, 2.0, 5.0])
    np.testing.assert_allclose(frame.prior_stds, [0.1] * 3 + [2.0] * 3)
    changed = hsr.problem.with_prior({"plane.tilt1": 0.001, "plane.offset": 0.5})
    np.testing.assert_allclose(changed.instruments[0].plane.prior_stds, [0.001, 0.001, 0.5])


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Parameter((1.0, math.nan)), "nominal value"),
        (lambda: Parameter((1.0, 2.0), prior_std=(1.0,)), "1 values for 2 components"),
        (lambda: Parameter(1.0, prior_std=0.0), "positive"),
        (lambda: Parameter(1.0, unit="volt", prior_std=math.inf), "start_std"),
        (lambda: Direction((0, 0, 0)), "not all zero"),
        (lambda: Direction((0, 0, 1), prior_std=(0.1, 0.2)), "Give one number of rad"),
        (lambda: Plane(normal=(0, 0, 1)), "Give both"),
        (lambda: Plane(free=False), "Say where it is"),
        (lambda: Frame(((2, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))), "rigid"),
        (lambda: Frame(((-1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))), "mirrors"),
    ],
)
def test_what_is_not_well_formed_is_refused_with_a_fix(make, says):
    with pytest.raises(CasacalError, match=says):
        make()


def test_planes_and_rotations_fitted_to_points():
    """Against planes and rotations that made the points; a mirrored set has no rotation that fits."""
    rng = np.random.default_rng(5)
    normal = np.array([2.0, -1.0, 2.0]) / 3
    points = rng.normal(size=(30, 3)) * 100
    points -= np.outer((points - [10.0, 20.0, 30.0]) @ normal, normal)
    plane = fitted_plane(points)
    assert plane.flat
    assert abs(plane.normal @ normal) == pytest.approx(1.0, abs=1e-12)
    assert np.abs((points - plane.centre) @ plane.normal).max() < 1e-11
    np.testing.assert_allclose(plane.across @ plane.normal, 0.0, atol=1e-12)
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    assert not fitted_plane(line).flat
    assert not fitted_plane(points[:2]).flat
    turn = Rotation.from_rotvec([0.3, -2.0, 1.0]).as_matrix()
    found, fixed = rotation_between(points, points @ turn.T)
    assert fixed
    np.testing.assert_allclose(found, turn, atol=1e-12)
    mirrored, _ = rotation_between(points[:3], points[:3] @ np.diag([1.0, 1.0, -1.0]) + 1e-3)
    assert np.linalg.det(mirrored) == pytest.approx(1.0)
    assert not rotation_between(line, line)[1]


@pytest.mark.parametrize("whole", [Direction((0, 0, 1)), Plane((0, 0, 1), (0, 0, 5)), Frame()])
def test_what_cannot_be_split_is_held_as_a_whole(whole):
    what = type(whole).__name__.lower()
    with pytest.raises(CasacalError, match=f"Only a part of a {what} would be held"):
        whole.with_free([True] + [False] * (whole.size - 1))
    held = whole.with_free([False] * whole.size)
    assert (held.size, held.raw_size, held.names("k"), held.units) == (0, 0, (), ())


def test_freeing_one_component_or_what_is_free_already(hsr):
    held = hsr.problem.fix("a")
    assert [name for name in held.free("a2").free_names() if name in ("a1", "a2")] == ["a2"]
    assert set(hsr.problem.free_names()) == set(held.free("a").free_names())
    again = hsr.problem.free("a", "theta3")
    assert again is hsr.problem, "so that nothing is compiled twice"
