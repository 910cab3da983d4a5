"""Poses that are read whole: rotations of SciPy as oracle, hand-eye calibration, quaternions written otherwise."""

import dataclasses

import casadi as ca
import numpy as np
import pytest
from instruments_on_ur5 import PROBLEMS, ROBOT, flanges
from scipy.spatial.transform import Rotation

from casacal import (
    CasacalError,
    Frame,
    Instrument,
    Parameter,
    Problem,
    TrackedPose,
    bind,
    calibrate,
    check,
    ipopt,
    lm,
    load,
    simulate,
)
from casacal.calibration.report_pictures import Touches
from casacal.calibration.verdict import verdict_of
from casacal.effects import Drift, with_kit
from casacal.errors import ProblemError, SimulationError
from casacal.model import ResidualBlock
from casacal.model.geometry import hand_eye
from casacal.model.kinematics import position
from casacal.model.tracked_pose import QUATERNION, chord
from casacal.simulation import Disturbances

problem = PROBLEMS["TrackedPose"]
SIX = Frame(np.eye(4), prior_std=(1e-3, 1.0))
STILL = Disturbances(resolution=0.0, repeatability=0.0, error_scale=0.0)


def quaternions(samples):
    """Of all rows (N, 4): w, x, y, z."""
    return np.column_stack([samples.columns[name] for name in QUATERNION])


def rewritten(samples, values):
    """The same with other quaternions (N, 4)."""
    return dataclasses.replace(samples, columns={**samples.columns, **dict(zip(QUATERNION, values.T, strict=True))})


@pytest.fixture(scope="module")
def rows():
    return simulate(problem, samples=60, seed=1).samples


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0, 3.0, 3.14, np.pi])
def test_the_chord_is_twice_the_sine_of_half_the_angle(angle):
    """Along the axis; not zero at half a turn, where the antisymmetric part of a rotation is."""
    axis = np.array([2.0, -1.0, 0.5]) / np.linalg.norm([2.0, -1.0, 0.5])
    turn = Rotation.from_rotvec(angle * axis).as_matrix()
    found = np.array(ca.DM(chord(ca.DM(turn)))).ravel()
    if angle < 3.1415:
        np.testing.assert_allclose(found, 2 * np.sin(angle / 2) * axis, atol=1e-8)
        assert found @ found == pytest.approx(np.linalg.norm(turn - np.eye(3)) ** 2 / 2, abs=1e-8)
    assert np.isfinite(found).all()


def test_rows_are_poses_of_one_body_seen_from_one_place():
    """The arm as drawn, its flanges multiplied out in NumPy: M = S T B with the same S and B in all rows."""
    samples = simulate(problem, STILL, samples=20, seed=3).samples
    slots = {slot.key: slot for slot in bind(problem, samples).slots}
    body, station = (
        np.array(slots[key].value(np.zeros(bind(problem, samples).unknowns))) for key in ("body", "station")
    )
    turns = Rotation.from_quat(np.roll(quaternions(samples), -1, axis=1)).as_matrix()
    for turn, flange, x, y, z in zip(
        turns, flanges(samples.joints), *(samples.columns[axis] for axis in "xyz"), strict=True
    ):
        seen = station @ flange @ body
        np.testing.assert_allclose(seen[:3, 3], [x, y, z], atol=1e-5)
        np.testing.assert_allclose(seen[:3, :3], turn, atol=1e-8)


def test_hand_eye_finds_what_was_made_from_any_start():
    rng = np.random.default_rng(5)
    for seed in range(20):
        station, body = Rotation.random(2, random_state=seed).as_matrix()
        turns = Rotation.random(12, random_state=seed + 100).as_matrix()
        shift, mount, places = rng.normal(size=3) * 2000, rng.normal(size=3) * 100, rng.normal(size=(12, 3)) * 600
        seen = Rotation.from_matrix(station @ turns @ body).as_quat()[:, [3, 0, 1, 2]]
        read = (turns @ mount + places) @ station.T + shift
        signs = rng.choice([-1.0, 1.0], size=(12, 1))  # a quaternion and its negative are one rotation
        found = hand_eye(turns, places, signs * seen, read)
        for matrix, turn, there in zip(found, (body, station), (mount, shift), strict=True):
            np.testing.assert_allclose(matrix[:3, :3], turn, atol=1e-9)
            np.testing.assert_allclose(matrix[:3, 3], there, atol=1e-6)


def test_hand_eye_says_when_postures_do_not_fix_it():
    about_one = Rotation.from_rotvec(np.outer(np.linspace(0, 3, 10), [0, 0, 1.0])).as_matrix()
    seen = Rotation.from_matrix(about_one).as_quat()[:, [3, 0, 1, 2]]
    assert hand_eye(about_one, np.zeros((10, 3)), seen, np.zeros((10, 3))) is None
    assert hand_eye(about_one[:2], np.zeros((2, 3)), seen[:2], np.zeros((2, 3))) is None
    samples = simulate(problem, STILL, samples=12, seed=3).samples
    joints = np.tile(samples.joints[0], (12, 1))
    joints[:, 5] = np.linspace(0, 2, 12)
    with pytest.raises(ProblemError, match="turn the flange about one axis only"):
        bind(problem, dataclasses.replace(samples, joints=joints))


@pytest.mark.long
def test_the_minimum_is_that_of_ipopt_with_quaternions_of_either_sign(rows):
    bound = bind(problem, rows)
    mine, theirs = lm(bound), ipopt(bound)
    assert mine.cost == pytest.approx(theirs.cost, rel=1e-8)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(len(rows), 1))
    other = lm(bind(problem, rewritten(rows, 3.0 * signs * quaternions(rows))))
    assert other.cost == pytest.approx(mine.cost, rel=1e-9), "neither sign nor length of a quaternion says anything"
    np.testing.assert_allclose(other.x, mine.x, atol=1e-7)


def test_a_camera_is_calibrated_on_an_arm_that_is_held():
    """Hand-eye calibration: the arm right, body and board unknown; both recovered within their spreads.

    Where they truly are is known from how the poses were made, not from these rows.
    """
    held = problem.fix(*(key for key, unknown in ROBOT.parameters.items() if unknown.size))
    simulated = simulate(held, samples=25, seed=4)
    bound = bind(held, simulated.samples)
    result = lm(bound)
    assert result.problem.unknowns == 12
    true = simulated.truth(bound)
    for slot in bound.slots:
        if slot.key in ("body", "station"):
            np.testing.assert_allclose(np.array(slot.value(true)), simulated.frames[slot.key], atol=1e-9)
            np.testing.assert_allclose(np.array(slot.value(result.x)), simulated.frames[slot.key], atol=0.15)
    assert np.abs((result.x - true) / result.std).max() < 4.5


def test_the_tip_is_where_the_body_was_found(rows, tmp_path):
    """Predicted, compensated and as a function: the flange, times the body as it came out of the fit."""
    found = calibrate(problem, rows, reference=False, discrepancy="none")
    found.save(tmp_path)
    body = np.array(next(s for s in found.fit.slots if s.key == "body").value(found.result.x))
    joints = rows.joints[:4]
    wanted = (found.fit.poses(found.result.x, joints) @ body)[:, :3, 3]
    for arm in (found, load(tmp_path)):
        np.testing.assert_allclose(arm.predict(joints, frame="tip").positions, wanted, atol=1e-6)
        one = np.array(arm.tip_function()(joints[0])).ravel()
        np.testing.assert_allclose(one, wanted[0], atol=1e-6)
    assert np.isfinite(found.predict(joints, frame="tip", std=True).std).all()
    reached = found.compensate(joints, frame="tip")
    drawn = found.predict(joints, frame="tip", nominal=True).positions
    np.testing.assert_allclose(found.predict(reached.joints, frame="tip").positions, drawn, atol=2e-3)


@pytest.mark.long
def test_what_is_written_otherwise_is_named(rows):
    values = quaternions(rows)
    for wrong, about in (
        (rewritten(rows, np.roll(values, -1, axis=1)), "order of the quaternions"),
        (rewritten(rows, values * [1, -1, -1, -1]), "sense of the quaternions"),
        (dataclasses.replace(rows, columns={**rows.columns, "z": -rows.columns["z"]}), "left-handed frame"),
        (
            dataclasses.replace(rows, columns={k: v / 1000 if k in "xyz" else v for k, v in rows.columns.items()}),
            "unit of the readings",
        ),
    ):
        errors = [finding for finding in check(problem, wrong) if finding.severity == "error"]
        assert [finding.about for finding in errors] == [about]
    assert not [finding for finding in check(problem, rows) if finding.severity == "error"]


def test_figures_are_by_block_and_in_its_unit(rows):
    found = calibrate(problem, rows, reference=False, discrepancy="none")
    parts = found.metrics_by_instrument
    assert set(parts) == {"position", "orientation"}
    e = found.fit.plain_residual(found.result.x).reshape(-1, 6)
    for name, own in (("position", e[:, :3]), ("orientation", e[:, 3:])):
        assert parts[name]["after"]["fit"]["rmse_mm"] == pytest.approx(np.sqrt((own**2).mean()))
    assert found.metrics["after"]["fit"]["rmse_mm"] == parts["position"]["after"]["fit"]["rmse_mm"], "in mm alone"
    assert "orientation (rad, not mm): after" in found.summary()


def test_noise_is_found_block_by_block(rows):
    """Orientation stated at a quarter of what it is: its noise grows, the position's does not."""
    bold = Problem(ROBOT, TrackedPose(position_std=0.05, angle_std=5e-5))
    scale = calibrate(bold, rows, reference=False, discrepancy="none").fit.scale
    assert 3.2 < scale["orientation"] < 5
    assert scale["position"] < 1.3


def test_noise_may_stand_in_a_column(rows):
    """The same answer as with numbers where the column holds them, and rows weighed by it where it differs."""
    instrument = TrackedPose(position_std="std_mm", angle_std="std_rad")
    stds = {"std_mm": np.full(len(rows), 0.05), "std_rad": np.full(len(rows), 2e-4)}
    stated = Problem(ROBOT, instrument)
    samples = dataclasses.replace(rows, columns={**rows.columns, **stds})
    np.testing.assert_allclose(lm(bind(stated, samples)).x, lm(bind(problem, rows)).x, atol=1e-9)
    stds["std_mm"] = np.linspace(0.05, 5.0, len(rows))
    bound = bind(stated, dataclasses.replace(rows, columns={**rows.columns, **stds}))
    np.testing.assert_allclose(bound.noise.reshape(-1, 6)[:, :3], stds["std_mm"][:, None] * np.ones(3))
    np.testing.assert_allclose(bound.noise.reshape(-1, 6)[:, 3:], 2e-4)
    with pytest.raises(SimulationError, match="comes from a column"):
        simulate(stated, samples=5)
    for wrong in (0.0, -0.05, np.nan):
        stds["std_mm"] = np.where(np.arange(len(rows)) == 7, wrong, 0.05)
        with pytest.raises(ProblemError, match=f"line {rows.lines[7]}: the noise in the column 'std_mm' is"):
            bind(stated, dataclasses.replace(rows, columns={**rows.columns, **stds}))
    for clash in ({"position_std": "x"}, {"position_std": ""}, {"position_std": "s", "angle_std": "s"}):
        with pytest.raises(ProblemError, match="Name a column of its own for each"):
            TrackedPose(**{"position_std": 0.1, "angle_std": 1e-3, **clash})


class Blocks(Instrument):
    """Reads one length in blocks that a test chooses."""

    columns = {"x": "length"}  # noqa: RUF012
    unknowns = {"mark": Parameter(0.0, prior_std=1.0)}  # noqa: RUF012

    def __init__(self, *blocks):
        object.__setattr__(self, "blocks", blocks)

    blocks = ()

    def residual(self, pose, p, row):
        return ca.vertcat(position(pose)[0] - p.mark - row.x, p.mark)


def test_blocks_that_cannot_be_are_refused():
    for blocks, said in (
        ((ResidualBlock("far", 1, "mm", 0.1),), "The blocks of Blocks hold 1 residuals, and it has 2"),
        ((ResidualBlock("far", 2, "mm", "std"),), "declared to be in the column 'std', which it does not read"),
    ):
        with pytest.raises(CasacalError, match=said):
            _ = Problem(ROBOT, Blocks(*blocks)).models
    for make in (
        lambda: TrackedPose(position_std=0.0, angle_std=1e-4),
        lambda: TrackedPose(position_std=1, angle_std=-1),
    ):
        with pytest.raises(ProblemError, match="of TrackedPose is"):
            make()
    held = TrackedPose(position_std=0.1, angle_std=1e-3, body=Frame(np.eye(4).tolist(), free=False))
    assert held.datum == ("station",)


def test_a_body_that_was_lost_is_said(rows):
    values = quaternions(rows)
    values[[3, 8]] = 0.0
    with pytest.raises(ProblemError, match=r"2 rows hold a quaternion of zeros.*\. Remove those rows"):
        bind(problem, rewritten(rows, values))
    assert "quaternion of zeros" in check(problem, rewritten(rows, values))[0].cause


@pytest.mark.parametrize("seed", range(6))
def test_three_poses_fix_a_camera(seed):
    """Any three that turn about two axes."""
    held = problem.fix(*(key for key, unknown in ROBOT.parameters.items() if unknown.size))
    simulated = simulate(held, samples=3, seed=seed)
    bound = bind(held, simulated.samples)
    body = next(slot for slot in bound.slots if slot.key == "body")
    np.testing.assert_allclose(np.array(body.value(lm(bound).x)), simulated.frames["body"], atol=1.0)


def test_orientations_are_not_called_millimetres(rows, tmp_path):
    found = calibrate(problem, rows, reference=False, discrepancy="none")
    assert "orientation (rad, not mm): after" in found.summary()
    page = found.report(tmp_path / "report.html").read_text(encoding="utf-8")
    assert "orientation (rad, not mm): after" in page
    assert "stated 0.0500 mm" in page or "noise as stated" in page
    by_face = found.to_dict()["noise"]["by_face"]
    assert by_face["orientation"]["unit"] == "rad"
    assert "unit" not in by_face["position"]
    touches = Touches.of(found.unjudged)
    e = found.fit.plain_residual(found.used_x).reshape(-1, 6)
    np.testing.assert_array_equal(touches.parts[0].after, e[:, :3])


@pytest.mark.long
def test_effects_along_the_residual_are_of_its_unit(rows):
    """A field of a millimetre moves positions by millimetres, and no orientation by a radian."""
    bound = bind(with_kit(problem), rows)
    x = bound.x0.copy()
    x[[j for j, key in enumerate(bound.beside) if key in ("field", "drift")]] = 1.0
    moved = (bound.plain_residual(x) - bound.plain_residual(bound.x0)).reshape(-1, 6)
    assert np.abs(moved[:, :3]).max() > 0.5
    assert np.abs(moved[:, 3:]).max() == 0.0


@pytest.mark.long
@dataclasses.dataclass(frozen=True, kw_only=True)
class Shift(Drift):
    """The same for each component."""

    def residual(self, here):
        return super().residual(here)[0]


@pytest.mark.long
def test_an_effect_of_one_component_moves_all_of_its_unit_alike(rows):
    bound = bind(problem.with_terms(Shift()), rows)
    x = bound.x0.copy()
    x[[j for j, key in enumerate(bound.beside) if key == "drift"]] = 1.0
    moved = (bound.plain_residual(x) - bound.plain_residual(bound.x0)).reshape(-1, 6)
    np.testing.assert_allclose(moved[:, :3], moved[:, :1] * np.ones(3), atol=1e-12)
    assert np.abs(moved[:, :3]).max() > 0.5
    assert np.abs(moved[:, 3:]).max() == 0.0


WAYS = ("rotation vector", "ZYX", "xyz", "ZYZ")


def other_way(rows, orientation):
    """The same rows with orientations written as SciPy writes them."""
    turns = Rotation.from_quat(np.roll(quaternions(rows), -1, axis=1))
    told = turns.as_rotvec() if orientation == "rotation vector" else turns.as_euler(orientation)
    columns = {name: column for name, column in rows.columns.items() if name not in QUATERNION}
    names = instrument(orientation).turn_columns
    return dataclasses.replace(rows, columns={**columns, **dict(zip(names, told.T, strict=True))})


def instrument(orientation):
    return dataclasses.replace(problem.instrument, orientation=orientation)


@pytest.mark.long_unless("rotation vector")
@pytest.mark.parametrize("orientation", WAYS)
def test_however_an_orientation_is_written_the_fit_is_the_same(rows, orientation):
    other = other_way(rows, orientation)
    mine = bind(Problem(ROBOT, instrument(orientation)), other)
    plain = bind(problem, rows)
    one, two = lm(mine), lm(plain)
    assert one.cost == pytest.approx(two.cost, rel=1e-9)
    np.testing.assert_allclose(one.x, two.x, atol=1e-7)


@pytest.mark.long
@pytest.mark.parametrize("orientation", ["rotation vector", "ZYX"])
def test_rows_are_simulated_so_written(orientation):
    made = Problem(ROBOT, instrument(orientation))
    found = calibrate(made, simulate(made, samples=60, seed=3).samples)
    assert found.reference.relative_gap < 1e-8
    assert verdict_of(found).level == "calibrated"


@pytest.mark.long
def test_a_turn_of_nothing_is_one(rows):
    for orientation in WAYS[:3]:
        names = instrument(orientation).turn_columns
        still = other_way(rows, orientation)
        still = dataclasses.replace(still, columns={**still.columns, **dict.fromkeys(names, np.zeros(60))})
        bound = bind(Problem(ROBOT, dataclasses.replace(instrument(orientation), body=SIX, station=SIX)), still)
        assert np.isfinite(bound.residual(bound.x0)).all()
        assert np.isfinite(bound.jacobian(bound.x0)).all()


@pytest.mark.long_unless("xyz-<lambda>-order of the turns")
@pytest.mark.parametrize(
    ("orientation", "spoiled", "about"),
    [
        ("rotation vector", lambda told: -told, "sense of the rotation vectors"),
        ("rotation vector", lambda told: told * np.pi / 180, "unit of the turns"),
        ("ZYX", lambda told: told * np.pi / 180, "unit of the turns"),
        ("ZYX", lambda told: told[:, ::-1], "order of the turns"),
        ("xyz", lambda told: told[:, ::-1], "order of the turns"),
    ],
)
def test_turns_written_otherwise_are_named(rows, orientation, spoiled, about):
    made, names = Problem(ROBOT, instrument(orientation)), instrument(orientation).turn_columns
    told = other_way(rows, orientation)
    wrong = spoiled(np.column_stack([told.columns[name] for name in names]))
    found = check(made, dataclasses.replace(told, columns={**told.columns, **dict(zip(names, wrong.T, strict=True))}))
    assert about in [finding.about for finding in found if finding.severity == "error"]
    if about == "order of the turns":
        said = next(finding for finding in found if finding.about == about)
        declared = Problem(ROBOT, instrument(orientation[::-1].swapcase()))
        assert f'orientation="{orientation[::-1].swapcase()}"' in said.fix
        swapped = dataclasses.replace(told, columns={**told.columns, **dict(zip(names, wrong.T, strict=True))})
        assert lm(bind(declared, swapped)).cost == pytest.approx(lm(bind(problem, rows)).cost, rel=1e-9)


@pytest.mark.parametrize("wrong", ["euler", "ZYx", "ZZX", "ABC", "", 5, None])
def test_an_orientation_of_no_such_name_is_refused(wrong):
    with pytest.raises(ProblemError, match="Give 'quaternion', 'rotation vector'"):
        TrackedPose(position_std=0.1, angle_std=1e-3, orientation=wrong)
