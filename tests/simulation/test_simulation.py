"""The simulated cell: the true tip touches, inside limits and travel; faults appear where and as large as asked."""

import dataclasses
import math

import numpy as np
import pytest
from conftest import ROOT
from oracles import dh_chain

from casacal import (
    CasacalError,
    Cell,
    DialOnPlane,
    Direction,
    Face,
    FixedPoint,
    Joint,
    Parameter,
    Plane,
    Problem,
    Robot,
    Samples,
    TrackedPoint,
    bind,
    chain,
    corner,
    deg,
    dial_gain,
    load_problem,
    plate,
    simulate,
    tool_point,
)
from casacal.errors import SimulationError
from casacal.model.kinematics import rotate_z, translate_x
from casacal.simulation import Disturbances
from casacal.simulation.bench import Bench
from casacal.simulation.cell import flatness_din_876, form_error
from casacal.simulation.places import default_cell


def true_tips(simulation, joints, readings, sign=1):
    """Tips (N, 3) and plunger directions of the true HSR-JR680 by NumPy alone."""
    nominal, last = simulation.problem.robot.parameters, np.array([0, 0, 0, 0, 0, 1.0])
    alpha, a, d, theta = (np.array(nominal[k].values) + simulation.local[k] for k in ("alpha", "a", "d", "theta"))
    poses = [dh_chain(alpha, a, d + sign * r * last, theta + q) for q, r in zip(joints, readings, strict=True)]
    return np.array([pose[:3, 3] for pose in poses]), np.array([pose[:3, 2] for pose in poses])


def exact(cell, **changes):
    return dataclasses.replace(cell, repeatability=0.0, resolution=0.0, **changes)


@pytest.mark.parametrize("sign", [1, -1])
def test_the_true_tip_touches_the_face(hsr, sign):
    problem = Problem(hsr.problem.robot, dataclasses.replace(hsr.problem.instruments[0], sign=sign))
    simulation = simulate(problem, exact(hsr.cell), samples=60, seed=4)
    rows = simulation.samples
    tips, directions = true_tips(simulation, rows.joints, rows.columns["reading"], sign)
    for label, face in {face.label: face for face in simulation.cell.faces}.items():
        here = np.array(rows.labels["plane"]) == label
        assert here.sum() == 20
        across = (tips[here] - face.centre) @ face.axes.T
        assert np.abs(across[:, 0]).max() < 1e-6
        assert np.abs(across[:, 1:]).max() <= 300 + 1e-6
        tilts = np.degrees(np.arccos(-directions[here] @ face.axes[0]))
        assert tilts.max() <= 30 + 1e-4
        assert tilts.max() > 20
    limits = np.array([[joint.lower, joint.upper] for joint in problem.robot.axes])
    assert ((rows.joints >= limits[:, 0]) & (rows.joints <= limits[:, 1])).all()
    assert (rows.columns["reading"] > 0).all()
    assert (rows.columns["reading"] < 10).all()


def test_the_truth_makes_the_residual_vanish(hsr):
    simulation = simulate(hsr.problem, exact(hsr.cell), seed=5)
    bound = bind(hsr.problem, simulation.samples)
    assert np.abs(bound.plain_residual(simulation.truth(bound))).max() < 1e-6
    assert np.abs(bound.plain_residual(bound.x0)).max() > 0.05


def test_the_same_seed_gives_the_same_samples_and_another_seed_does_not(hsr):
    one, two, other = (simulate(hsr.problem, hsr.cell, samples=12, seed=seed).samples for seed in (6, 6, 7))
    np.testing.assert_array_equal(one.joints, two.joints)
    np.testing.assert_array_equal(one.columns["reading"], two.columns["reading"])
    assert np.abs(one.joints - other.joints).max() > 0.01


def test_another_session_measures_the_same_arm_in_other_postures(hsr):
    for problem, cell in ((hsr.problem, hsr.cell), (Problem(hsr.problem.robot, TrackedPoint(noise_std=0.01)), None)):
        one, other = (simulate(problem, cell, samples=30, seed=5, session=k) for k in (0, 1))
        joints = one.samples.joints
        np.testing.assert_array_equal(one.true_tips(joints), other.true_tips(joints))
        assert np.abs(joints - other.samples.joints).max(axis=1).min() > 1e-3
        again = simulate(problem, cell, samples=30, seed=5, session=1).samples
        np.testing.assert_array_equal(again.joints, other.samples.joints)
    with pytest.raises(SimulationError, match="The session is -1"):
        simulate(hsr.problem, hsr.cell, session=-1)


def heights_over_faces(simulation, tips):
    """How far tips (N, 3) stand above the face that each row names, mm."""
    faces = {face.label: face for face in simulation.cell.faces}
    pairs = zip(tips, simulation.samples.labels["plane"], strict=True)
    return np.array([(tip - faces[label].centre) @ faces[label].axes[0] for tip, label in pairs])


def test_in_given_postures_joints_stay_and_the_plunger_reads(hsr):
    still = exact(hsr.cell)
    wanted = simulate(hsr.problem, dataclasses.replace(still, error_scale=0.0), samples=60, seed=1).samples
    wanted = wanted.take(np.random.default_rng(0).permutation(60))
    wanted = dataclasses.replace(wanted, lines=tuple(range(1, 61)))
    simulation = simulate(hsr.problem, still, samples=wanted, seed=4)
    rows = simulation.samples
    tips, _ = true_tips(simulation, rows.joints, rows.columns["reading"])
    assert np.abs(heights_over_faces(simulation, tips)).max() < 1e-6
    there, numbers = [], np.array(rows.lines) - 1
    for k, number in enumerate(numbers):
        there.append(np.array_equal(rows.joints[k], wanted.joints[number]))
        if not there[-1]:  # the dial would be at an end of its travel: its operator moves until it is not
            assert rows.columns["reading"][k] == wanted.columns["reading"][number]
    assert 10 < sum(there) < len(rows), "an arm that errs by millimetres is at the end of some of its 10 mm"
    assert np.abs(rows.joints - wanted.joints[numbers]).max() < 0.03
    assert list(rows.labels["plane"]) == [wanted.labels["plane"][k] for k in numbers]
    assert (rows.columns["reading"] >= 0).all()
    assert (rows.columns["reading"] <= 10).all()


@pytest.mark.parametrize(
    "changes",
    [
        {"flatness": 0.05, "flatness_reach": 0.4},
        {"gear_waves": ((1, 2e-4),), "joint_std": 2e-5, "outliers": 0.1, "outlier_size": 0.5},
        {"thermal": 5e-5, "backlash": 1e-4, "hysteresis": 0.02, "approach": "alternating"},
        {"compliance": 0.05, "repeatability": 0.004},
        {"backlash": 1e-3, "hysteresis": 0.02},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_the_postures_of_a_simulation_give_its_readings_once_more(hsr, changes):
    """All that is drawn is the same, so that both ways to the readings must end at the same ones."""
    cell = dataclasses.replace(exact(hsr.cell), **changes)
    first = simulate(hsr.problem, cell, samples=45, seed=4).samples
    again = simulate(hsr.problem, cell, samples=first, seed=4).samples
    assert again.lines == first.lines
    np.testing.assert_array_equal(again.joints, first.joints)
    np.testing.assert_allclose(again.columns["reading"], first.columns["reading"], rtol=0, atol=1e-4)
    repeated = simulate(hsr.problem, dataclasses.replace(cell, repeats=3), samples=first, seed=4).samples
    np.testing.assert_array_equal(repeated.joints, first.joints)
    np.testing.assert_allclose(repeated.columns["reading"], first.columns["reading"], rtol=0, atol=1e-4)
    other = simulate(hsr.problem, cell, samples=first, seed=4, session=1).samples
    away = np.abs(other.columns["reading"] - first.columns["reading"])
    assert (away.max() > 1e-4) == bool({"joint_std", "repeatability"} & changes.keys()), "noise is new, faces are not"


def test_a_face_is_touched_with_the_noise_of_touching_and_a_spike_is_met_in_given_postures(hsr):
    touching = Problem(hsr.problem.robot, DialOnPlane(noise_std=0.01, reading=False, plane=Plane(per="plane")))
    wanted = simulate(touching, dataclasses.replace(exact(hsr.cell), error_scale=0.0), samples=90, seed=1).samples
    simulation = simulate(touching, dataclasses.replace(hsr.cell, repeatability=0.02, resolution=0.0), samples=wanted)
    tips, _ = true_tips(simulation, simulation.samples.joints, np.zeros(len(simulation.samples)))
    assert heights_over_faces(simulation, tips).std() == pytest.approx(0.02, rel=0.25)
    spike = Problem(hsr.problem.robot, FixedPoint(noise_std=1e-9))
    wanted = simulate(spike, Disturbances(error_scale=0.0), samples=20, seed=1).samples
    met = simulate(spike, Disturbances(backlash=1e-3), samples=wanted, seed=4)
    bound = bind(spike, met.samples)
    moved = np.abs(met.samples.joints - wanted.joints[np.array(met.samples.lines) - 1])
    assert 1e-5 < moved.max() < 0.2
    lag = np.sign(np.diff(wanted.joints, axis=0, prepend=np.zeros((1, 6))))[np.array(met.samples.lines) - 1] * 5e-4
    standing = dataclasses.replace(met.samples, joints=met.samples.joints - lag)
    assert np.abs(bound.on(standing).plain_residual(met.truth(bound.on(standing)))).max() < 1e-5


def test_a_tracker_sees_given_postures_and_a_tool_without_a_dial_moves_until_it_touches(hsr):
    tracked = Problem(hsr.problem.robot, TrackedPoint(noise_std=1e-9))
    joints = simulate(tracked, samples=20, seed=3).samples.joints
    seen = simulate(tracked, samples=Samples.of_joints(joints), seed=5)
    np.testing.assert_array_equal(seen.samples.joints, joints)
    points = np.column_stack(list(seen.samples.columns.values()))
    apart = [np.linalg.norm(each[:, None] - each, axis=2) for each in (points, seen.true_tips(joints))]
    np.testing.assert_allclose(*apart, rtol=0, atol=3e-3)  # the simulated resolution is 1 um
    touching = Problem(hsr.problem.robot, DialOnPlane(noise_std=0.01, reading=False, plane=Plane(per="plane")))
    wanted = simulate(touching, dataclasses.replace(exact(hsr.cell), error_scale=0.0), samples=30, seed=1).samples
    simulation = simulate(touching, exact(hsr.cell), samples=wanted, seed=4)
    rows = simulation.samples
    assert len(rows) > 25
    assert np.abs(rows.joints - wanted.joints[np.array(rows.lines) - 1]).max(axis=1).min() > 1e-4
    tips, _ = true_tips(simulation, rows.joints, np.zeros(len(rows)))
    assert np.abs(heights_over_faces(simulation, tips)).max() < 1e-6


def test_postures_that_fit_no_problem_are_refused(hsr):
    wanted = simulate(hsr.problem, hsr.cell, samples=6).samples
    elsewhere = dataclasses.replace(hsr.cell, faces=hsr.cell.faces[:1])
    with pytest.raises(SimulationError, match="which is no face of the cell"):
        simulate(hsr.problem, elsewhere, samples=wanted)
    with pytest.raises(CasacalError, match="no label 'plane'"):
        simulate(hsr.problem, hsr.cell, samples=Samples.of_joints(wanted.joints))
    with pytest.raises(CasacalError, match="Give 6 per row"):
        simulate(hsr.problem, hsr.cell, samples=Samples.of_joints(wanted.joints[:, :5]))
    beyond = wanted.joints.copy()
    beyond[3, 0] = math.radians(357)
    with pytest.raises(CasacalError, match=r"line 4: joint 1 stands at 357 degrees, outside its limits -160 to 160"):
        simulate(hsr.problem, hsr.cell, samples=dataclasses.replace(wanted, joints=beyond))
    away = [dataclasses.replace(face, centre=(*face.centre[:2], face.centre[2] - 9000)) for face in hsr.cell.faces[:1]]
    floor = wanted.take([k for k, label in enumerate(wanted.labels["plane"]) if label == away[0].label])
    with pytest.raises(SimulationError, match="In none of the 2 postures"):
        simulate(hsr.problem, dataclasses.replace(hsr.cell, faces=tuple(away)), samples=floor)
    for given, words in ((floor.joints, "a ndarray"), ("plan.csv", "a str"), (None, "nothing")):
        with pytest.raises(SimulationError, match=f"Got {words} as the samples"):
            simulate(hsr.problem, hsr.cell, samples=given)


def test_no_joint_is_moved_out_of_its_limits(hsr):
    """A tool without a dial moves on until it touches; those at the ends of their joints cannot, half of the time."""
    touching = Problem(hsr.problem.robot, DialOnPlane(noise_std=0.01, reading=False, plane=Plane(per="plane")))
    wanted = simulate(touching, dataclasses.replace(exact(hsr.cell), error_scale=0.0), samples=60, seed=1).samples
    ends = np.array([wanted.joints.min(axis=0), wanted.joints.max(axis=0)])
    axes = [
        dataclasses.replace(joint, lower=low, upper=high)
        for joint, low, high in zip(hsr.problem.robot.axes, *ends.tolist(), strict=True)
    ]
    tight = Problem(dataclasses.replace(hsr.problem.robot, joints=tuple(axes)), touching.instrument)
    found = simulate(tight, exact(hsr.cell), samples=wanted, seed=4).samples
    assert 40 < len(found) < 60
    assert ((found.joints >= ends[0] - 1e-9) & (found.joints <= ends[1] + 1e-9)).all()


def test_no_reading_of_given_postures_is_outside_the_travel(hsr):
    wanted = simulate(hsr.problem, dataclasses.replace(exact(hsr.cell), error_scale=0.0), samples=45, seed=1).samples
    for travel, low, high in ((2.0, 0, 2), ((-5.0, 5.0), -5, 5)):
        cell = dataclasses.replace(hsr.cell, travel=travel)
        found = simulate(hsr.problem, cell, samples=wanted, seed=4).samples.columns["reading"]
        assert low <= found.min()
        assert found.max() <= high


def test_a_label_stands_for_the_same_thing_in_whatever_order_rows_name_them():
    spike = load_problem(ROOT / "problems" / "instruments" / "spike").problem
    wanted = simulate(spike, Disturbances(error_scale=0.0), samples=30, seed=1).samples
    (column,) = spike.layout().labels
    order = np.argsort([-ord(label[0]) for label in wanted.labels[column]], kind="stable")
    ways = [simulate(spike, samples=rows, seed=5).samples for rows in (wanted, wanted.take(order))]
    for rows, lines in ((ways[0], np.arange(30)), (ways[1], order)):
        planned = wanted.joints[lines[np.array(rows.lines) - 1]]
        assert np.abs(rows.joints - planned).max() < 0.3, "no place of another label is touched"


@pytest.mark.long_unless("camera")
@pytest.mark.parametrize("name", ["camera", "spheres", "two_arms"])
def test_rounding_chooses_no_posture(name, monkeypatch):
    """Residuals that differ by rounding, as another machine's do, lead to the same rows."""
    source = load_problem(ROOT / "problems" / "instruments" / name)
    plain = simulate(source.problem, source.cell, samples=60, seed=1).samples
    exact, rng = Bench.residual, np.random.default_rng(0)

    def rounded(bench, free, rows):
        return tuple(each * (1 + 1e-15 * rng.normal(size=each.shape)) for each in exact(bench, free, rows))

    monkeypatch.setattr(Bench, "residual", rounded)
    other = simulate(source.problem, source.cell, samples=60, seed=1).samples
    assert not np.array_equal(other.joints, plain.joints)
    np.testing.assert_allclose(other.joints, plain.joints, atol=1e-7)


def test_a_camera_sees_every_posture_however_far_it_turns():
    """Readings are found from no turn on, where the first step may lead away."""
    camera = load_problem(ROOT / "problems" / "instruments" / "camera").problem
    postures = simulate(camera, samples=120, seed=2).samples
    assert len(simulate(camera, samples=postures, seed=2).samples) == 120


def test_noise_resolution_and_outliers_are_as_asked(hsr):
    cell = dataclasses.replace(hsr.cell, repeatability=0.02, resolution=0.05)
    rows = simulate(hsr.problem, cell, samples=600, seed=8)
    readings = rows.samples.columns["reading"]
    np.testing.assert_allclose(readings / 0.05, np.round(readings / 0.05), atol=1e-9)
    bound = bind(hsr.problem, rows.samples)
    whitened = bound.residual(rows.truth(bound)) * 0.01
    assert whitened.std() == pytest.approx(math.sqrt(0.02**2 + 0.05**2 / 12), rel=0.1)
    gross = simulate(hsr.problem, exact(hsr.cell, outliers=0.1, outlier_size=0.5), samples=300, seed=9)
    bound = bind(hsr.problem, gross.samples)
    off = np.abs(bound.residual(gross.truth(bound)) * 0.01) > 0.4
    assert 15 <= off.sum() <= 45


def test_what_the_model_lacks_leaves_a_residual_of_its_size(hsr):
    for change, low, high in (
        ({"compliance": 0.2}, 0.02, 0.3),
        ({"flatness": 0.05}, 0.005, 0.05),
        ({"joint_std": 30e-6}, 0.01, 0.1),
    ):
        simulation = simulate(hsr.problem, exact(hsr.cell, **change), seed=10)
        bound = bind(hsr.problem, simulation.samples)
        size = float(np.sqrt(np.mean(bound.plain_residual(simulation.truth(bound)) ** 2)))
        assert low < size < high, (change, size)


def test_the_tip_sags_down_by_as_much_as_asked(hsr):
    """What is recorded are joints without sag: with these the tip stands above where it touched."""
    touched = simulate(hsr.problem, exact(hsr.cell), seed=10)
    recorded = simulate(hsr.problem, exact(hsr.cell, compliance=0.2), seed=10)
    readings = touched.samples.columns["reading"]
    np.testing.assert_array_equal(recorded.samples.columns["reading"], readings)
    (low, _), (high, _) = (true_tips(made, made.samples.joints, readings) for made in (touched, recorded))
    assert ((high - low)[:, 2] > 0).all()
    assert math.sqrt(((high - low) ** 2).sum(axis=1).mean()) == pytest.approx(0.2, rel=0.01)


def test_backlash_lags_half_of_itself_behind_the_last_move(hsr):
    play = 40e-6
    straight = simulate(hsr.problem, exact(hsr.cell), samples=30, seed=8).samples
    loose = simulate(hsr.problem, exact(hsr.cell, backlash=play), samples=30, seed=8).samples
    np.testing.assert_array_equal(loose.columns["reading"], straight.columns["reading"])
    came_from = np.vstack([np.zeros(6), straight.joints[:-1]])
    forward = straight.joints > came_from  # sent further than it went
    np.testing.assert_allclose(loose.joints - straight.joints, np.where(forward, play / 2, -play / 2), atol=1e-12)


def test_contact_without_a_dial_and_an_arm_without_a_cell(hsr):
    problem = Problem(hsr.problem.robot, DialOnPlane(noise_std=0.05, reading=False))
    simulation = simulate(problem, default_cell(problem), samples=90, seed=11)
    assert simulation.samples.columns == {}
    bound = bind(problem, simulation.samples)
    assert bound.plain_residual(simulation.truth(bound)).std() == pytest.approx(0.05, rel=0.3)


@pytest.mark.parametrize("normal", [(1, 0, 0), (-2, 0, 0)])
def test_a_problem_with_one_plane_is_touched_where_it_declares_it(normal):
    def pose(p, q):
        return chain(rotate_z(q[0]), translate_x(p.l1), rotate_z(q[1]), translate_x(p.l2))

    lengths = {name: Parameter(value, unit="mm", prior_std=1.0) for name, value in (("l1", 400.0), ("l2", 300.0))}
    robot, plane = Robot("two-link", joints=2, pose=pose, parameters=lengths), Plane(normal=normal, point=(500, 50, 0))
    problem = Problem(robot, DialOnPlane(reading=False, noise_std=0.01, plunger=Direction((1, 0, 0)), plane=plane))
    one, two = simulate(problem, exact(default_cell(problem), error_scale=0.0), samples=20, seed=3).samples.joints.T
    np.testing.assert_allclose(400 * np.cos(one) + 300 * np.cos(one + two), 500, atol=1e-6)
    assert (np.abs(400 * np.sin(one) + 300 * np.sin(one + two) - 50) < 150).all()
    upwards = Problem(robot, DialOnPlane(reading=False, noise_std=0.01, plane=plane))
    with pytest.raises(SimulationError, match="can touch one face"):
        default_cell(upwards)


def test_a_problem_with_one_plane_that_it_does_not_declare_is_touched_on_a_floor(hsr):
    problem = Problem(hsr.problem.robot, DialOnPlane(noise_std=0.01, plane=Plane()))
    (face,) = default_cell(problem).faces
    assert face.normal == (0.0, 0.0, 1.0)
    assert len(simulate(problem, samples=12, seed=1).samples) == 12


def test_faces_that_cannot_be_touched_are_refused(hsr):
    with pytest.raises(SimulationError, match="'far'"):
        simulate(hsr.problem, Cell(faces=(Face("far", (9000, 0, 0), (0, 0, 1)),)), samples=3)
    with pytest.raises(SimulationError, match="no face"):
        Cell(faces=())
    with pytest.raises(SimulationError, match="share a label"):
        Cell(faces=(*plate((1, 2, 3)), *plate((4, 5, 6))))
    with pytest.raises(SimulationError, match="tilt"):
        Cell(faces=plate((1, 2, 3)), tilt=2.0)


def test_a_corner_looks_at_its_centre():
    faces = corner((1000, 0, 500), size=400)
    for face in faces:
        assert np.dot(face.normal, np.array([1000, 0, 500]) - face.centre) == pytest.approx(200)
    normals = np.array([face.normal for face in faces])
    np.testing.assert_allclose(normals @ normals.T, np.eye(3), atol=1e-12)


def test_form_errors_are_smooth_and_of_the_asked_height():
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41)), axis=-1).reshape(-1, 2)
    field = form_error(np.random.default_rng(0), 0.02, grid)
    assert np.ptp(field) == pytest.approx(0.02, rel=0.1)
    assert np.abs(np.diff(field.reshape(41, 41), axis=1)).max() < 0.003
    # DIN 876, grade I, 630 mm: 10 + 6.3 um
    # DIN 876: 4, 10 and 20 micrometres times (1 + L / m)
    for grade, micrometres in (("0", 4.0), ("I", 10.0), ("II", 20.0)):
        assert flatness_din_876(grade, 630) == pytest.approx(micrometres * 1.63e-3)


def test_an_arm_that_seldom_reaches_a_face_squarely_touches_it_all_the_same():
    """Five axes: one posture of some twenty stands within 30 degrees; of 120 touches sixty rounds miss a few."""
    robot = Robot.from_dh(
        "five",
        alpha=deg(-90, 0, 0, -90, 0),
        a=(0, 350, 270, 0, 0),
        d=(275, 0, 0, 0, 195),
        theta=deg(0, -90, 0, -90, 0),
        parallel=(2, 3),
        joints=[
            Joint("revolute", *deg(*each)) for each in ((-180, 180), (-80, 140), (-80, 140), (-95, 95), (-180, 180))
        ],
    )
    problem = Problem(
        robot, DialOnPlane(noise_std=0.01, sign=1, travel=(-5, 5), tool=tool_point(30, 0, 60), gain=dial_gain(0.15))
    )
    simulation = simulate(problem, samples=120, seed=0)
    assert np.bincount(simulation.samples.labels["plane"].codes).tolist() == [40, 40, 40]
    bound = bind(problem, simulation.samples)
    assert np.abs(bound.residual(simulation.truth(bound))).max() < 5  # standard deviations of the noise


def test_what_is_no_cell_is_refused_and_lists_are_taken():
    face = Face("a", [500, 0, 0], np.array([0.0, 0, 1]), [300, 300])
    assert Cell(faces=[face]) == Cell(faces=(Face("a", (500, 0, 0), (0, 0, 1), (300, 300)),))
    assert hash(Cell(faces=[face]))
    for make in (
        lambda: Face("a", (500, 0), (0, 0, 1)),
        lambda: Face("a", (500, 0, math.nan), (0, 0, 1)),
        lambda: Face("a", (500, 0, 0), (0, 0, 1), 600.0),
        lambda: Cell(faces=face),
        lambda: Cell(faces=(face,), flatness="0.1"),
        lambda: Cell(faces=(face,), tilt=None),
        lambda: Cell(faces=(face,), backlash=10**400),
        lambda: Cell(faces=(face,), gear_waves={1: 10**400}),
    ):
        with pytest.raises(CasacalError):
            make()
