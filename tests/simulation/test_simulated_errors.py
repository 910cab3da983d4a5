"""What a simulated cell does beside geometry and noise, each against its closed form, worked out with NumPy alone."""

import dataclasses
import json
import math
import re

import numpy as np
import pytest
from conftest import ROOT
from oracles import dh_chain
from scipy.spatial.distance import pdist

from casacal import Cell, DialOnPlane, Problem, TrackedPoint, bind, load_problem, simulate
from casacal.cli.main import main
from casacal.errors import SimulationError
from casacal.fit.bound_problem import SHARED
from casacal.simulation import Disturbances
from casacal.simulation.cell import form_error
from casacal.simulation.faults import gross_errors

WAVES = {1: 1e-4, 2: 5e-5, 100: 2e-5}


def made(source, samples=36, seed=3, **changes):
    """An arm that errs in nothing but what is asked for."""
    cell = dataclasses.replace(source.cell, repeatability=0.0, resolution=0.0, **changes)
    return simulate(source.problem, cell, samples=samples, seed=seed)


def readings(simulation):
    return simulation.samples.columns["reading"]


def tips(simulation, joints, shown):
    """Tips (N, 3) of the true HSR-JR680's geometry: readings lengthen d6."""
    nominal, last = simulation.problem.robot.parameters, np.array([0, 0, 0, 0, 0, 1.0])
    alpha, a, d, theta = (np.array(nominal[k].values) + simulation.local[k] for k in ("alpha", "a", "d", "theta"))
    rows = zip(joints, shown, strict=True)
    return np.array([dh_chain(alpha, a, d + r * last, theta + q)[:3, 3] for q, r in rows])


def levels(simulation, places):
    """Heights (N,) of places above the faces that the rows touch."""
    faces = {face.label: face for face in simulation.cell.faces}
    rows = zip(places, simulation.samples.labels["plane"], strict=True)
    return np.array([(place - faces[label].centre) @ faces[label].axes[0] for place, label in rows])


def wave_of(order, angles, errors):
    """Amplitude and phase of the sine that fits errors, and what it leaves."""
    basis = np.column_stack([np.sin(order * angles), np.cos(order * angles)])
    (s, c), *_ = np.linalg.lstsq(basis, errors, rcond=None)
    return math.hypot(s, c), math.atan2(c, s), np.abs(errors - basis @ (s, c)).max()


@pytest.mark.parametrize("folder", ["hsr_jr680", "ur5", "adept_cobra600"])
def test_a_cell_without_these_is_what_it_was(folder):
    """The samples beside the problems, which casacal made before it knew any of this.

    A few postures end elsewhere on another machine: the last bit decides which start of their search is the best.
    """
    source = load_problem(ROOT / "problems" / folder)
    command = re.search(
        rf"casacal simulate problems/{folder} (.*)", (ROOT / "problems" / folder / "README.md").read_text()
    )
    assert "--flat" not in command[1]
    count = re.search(r"--samples (\d+)", command[1])
    rows = source.problem.read(source.samples)
    again = simulate(source.problem, source.cell, samples=int(count[1]) if count else 120).samples
    same = np.abs(again.joints - rows.joints).max(axis=1) < 2e-7
    assert same.mean() > 0.9
    np.testing.assert_allclose(again.columns["reading"][same], rows.columns["reading"][same], atol=1.1e-3)


def test_a_dial_shows_a_wrong_gain_and_a_wave_with_every_turn(hsr):
    """True ways are (1 + g) r + c sin(2 pi r + phase) of the readings r."""
    true = readings(made(hsr))
    erring = made(hsr, dial_gain=0.003, dial_cycle=0.005)
    r, dial = readings(erring), erring.dial_errors
    np.testing.assert_array_equal(erring.samples.joints, made(hsr).samples.joints)
    basis = np.column_stack([r, np.sin(2 * math.pi * r), np.cos(2 * math.pi * r)])
    fitted = np.linalg.lstsq(basis, true - r, rcond=None)[0]
    np.testing.assert_allclose(basis @ fitted, true - r, atol=1e-9)
    assert math.hypot(*fitted[1:]) == pytest.approx(0.005, rel=1e-6)
    assert fitted[0] == pytest.approx(dial.gain, abs=1e-9)
    gains, phases = [], []
    for seed in range(40):
        one = made(hsr, samples=1, seed=seed, dial_gain=0.003).dial_errors
        gains.append(one.gain / 0.003)
        phases.append(one.phase)
    assert 0.7 < np.std(gains) < 1.3
    assert abs(np.mean(gains)) < 0.5
    assert np.abs(np.exp(1j * np.array(phases)).mean()) < 0.4


@pytest.mark.parametrize("sign", [1, -1])
def test_a_dial_lags_behind_the_way_by_which_its_plunger_came(hsr, sign):
    """Pushed in, a dial of sign -1 reads more and more, so that it shows too little; let out, too much."""
    source = dataclasses.replace(hsr, problem=hsr.problem.with_settings({"sign": sign}))
    true = readings(made(source, samples=24))
    always = readings(made(source, samples=24, hysteresis=0.004)) - true
    np.testing.assert_allclose(always, sign * 0.002, atol=1e-12)
    either = readings(made(source, samples=24, hysteresis=0.004, approach="alternating")) - true
    face = np.arange(24) // 3  # how often its face was touched before
    np.testing.assert_allclose(either, sign * np.where(face % 2 == 0, 0.002, -0.002), atol=1e-12)
    random = readings(made(source, samples=24, hysteresis=0.004, approach="random")) - true
    np.testing.assert_allclose(np.abs(random), 0.002, atol=1e-12)
    assert 4 < (random > 0).sum() < 20


def test_readings_drift_from_the_first_row_to_the_last(hsr):
    drift = readings(made(hsr, samples=21, drift=0.02)) - readings(made(hsr, samples=21))
    np.testing.assert_allclose(drift, np.linspace(0, 0.02, 21), atol=1e-12)


@pytest.mark.parametrize("folder", ["hsr_jr680", "adept_cobra600"])
def test_gears_err_by_a_sine_of_what_the_controller_says(folder):
    source = load_problem(ROOT / "problems" / folder)
    turning = source.problem.robot.revolute
    for order, amplitude in WAVES.items():
        standing = made(source).samples.joints
        simulation = made(source, gear_waves={order: amplitude})
        said = simulation.samples.joints
        np.testing.assert_array_equal(said[:, ~turning], standing[:, ~turning])
        phases = []
        for j in np.flatnonzero(turning):
            found, phase, left = wave_of(order, said[:, j], standing[:, j] - said[:, j])
            assert found == pytest.approx(amplitude, rel=1e-7)
            assert left < 1e-12
            phases.append(phase)
        assert np.ptp(phases) > 0.5  # a phase for each joint
        (drawn,) = simulation.arm_errors.waves
        shift = np.array(drawn.phases)[turning] - phases
        np.testing.assert_allclose(np.exp(1j * shift), 1.0, atol=1e-6)


def test_controllers_say_whole_steps(hsr):
    step = 2e-4
    said, standing = made(hsr, samples=90, encoder_step=step).samples.joints, made(hsr, samples=90).samples.joints
    np.testing.assert_allclose(said / step, np.round(said / step), atol=1e-6)
    assert np.abs(said - standing).max() <= step / 2 + 1e-12
    assert (said - standing).std() == pytest.approx(step / math.sqrt(12), rel=0.1)


def test_joints_lag_behind_the_side_from_which_they_came(hsr):
    play = 60e-6
    standing = made(hsr, samples=24).samples.joints
    either = made(hsr, samples=24, backlash=play, approach="alternating").samples.joints - standing
    turn = np.arange(24) // 3
    expected = np.where(turn % 2 == 0, play / 2, -play / 2)[:, None]  # from below: sent further than it went
    np.testing.assert_allclose(either, np.broadcast_to(expected, either.shape), atol=1e-12)
    random = made(hsr, samples=24, backlash=play, approach="random").samples.joints - standing
    np.testing.assert_allclose(np.abs(random), play / 2, atol=1e-12)
    assert (np.ptp(random, axis=0) > play / 2).all()  # every joint from either side
    assert (np.ptp(random, axis=1) > play / 2).any()  # and not all from the same


def test_places_are_touched_again_and_only_what_differs_scatters(hsr):
    stays = made(hsr, repeats=3, flatness=0.02, compliance=0.3, gear_waves=WAVES)
    labels = list(stays.samples.labels["plane"])
    assert labels[:9] == ["floor"] * 3 + ["wall"] * 3 + ["side"] * 3
    assert len(np.unique(stays.samples.joints, axis=0)) == 12
    np.testing.assert_allclose(np.ptp(readings(stays).reshape(12, 3), axis=1), 0.0, atol=1e-9)
    cut = made(hsr, samples=35, repeats=3)
    assert len(cut.samples) == 35
    scattering = made(hsr, samples=240, repeats=3, joint_std=20e-6)
    said = scattering.samples.joints
    assert len(np.unique(said, axis=0)) == 80
    # what the readings scatter by: each joint's 20 urad times how far it moves the tip along the normal
    heights = levels(scattering, tips(scattering, said, readings(scattering)))
    size = np.zeros(240)
    for step in 1e-6 * np.eye(6):
        moved = tips(scattering, said + step, readings(scattering))
        size += ((levels(scattering, moved) - heights) / 1e-6 * 20e-6) ** 2
    scaled = heights / np.sqrt(size)
    assert np.mean(scaled**2) == pytest.approx(1.0, abs=0.3)
    groups = scaled.reshape(80, 3)
    assert np.mean(groups.var(axis=1, ddof=1)) == pytest.approx(1.0, abs=0.3)  # as much within a place as among places


def test_a_place_that_is_touched_from_either_side_tells_the_backlash(hsr):
    """A reading that comes after the other makes up for the whole play of every joint."""
    play = 60e-6
    simulation = made(hsr, repeats=2, backlash=play, approach="alternating")
    said, shown = simulation.samples.joints, readings(simulation)
    side = np.where(np.arange(36) % 2 == 0, 1.0, -1.0)
    there = tips(simulation, said - side[:, None] * play / 2, shown)
    np.testing.assert_allclose(levels(simulation, there), 0.0, atol=1e-7)
    assert np.abs(np.diff(shown.reshape(18, 2), axis=1)).max() > 0.02


def test_a_tool_that_simply_touches_moves_on_until_it_does(hsr):
    problem = Problem(hsr.problem.robot, DialOnPlane(noise_std=0.05, reading=False))
    source = dataclasses.replace(hsr, problem=problem)
    simulation = made(source, repeats=2, backlash=60e-6, approach="alternating", thermal=1e-4)
    side = np.where(np.arange(36) % 2 == 0, 1.0, -1.0)[:, None]
    there = tips(simulation, simulation.samples.joints - side * 30e-6, np.zeros(36))
    grown = 1 + 1e-4 * (1 - np.exp(-3 * np.arange(36) / 35)) / (1 - math.exp(-3))
    np.testing.assert_allclose(levels(simulation, there * grown[:, None]), 0.0, atol=1e-6)
    assert np.abs(np.diff(simulation.samples.joints[:2], axis=0)).max() > 1e-7


def test_an_arm_grows_about_its_base_as_it_warms_up(hsr):
    for repeats in (1, 3):
        simulation = made(hsr, samples=31, thermal=3e-5, repeats=repeats)
        geometric = tips(simulation, simulation.samples.joints, readings(simulation))
        grown = 1 + 3e-5 * (1 - np.exp(-3 * np.arange(31) / 30)) / (1 - math.exp(-3))
        np.testing.assert_allclose(levels(simulation, geometric * grown[:, None]), 0.0, atol=1e-6)
        assert np.abs(levels(simulation, geometric)).max() > 0.01
    cold, warm = (simulation.true_tips(np.zeros((1, 6)), when=when) for when in (0.0, 1.0))
    np.testing.assert_allclose(warm, cold * (1 + 3e-5), rtol=1e-12)
    half = (1 - math.exp(-1.5)) / (1 - math.exp(-3))
    np.testing.assert_allclose(simulation.true_tips(np.zeros((1, 6))), cold * (1 + 3e-5 * half), rtol=1e-12)


def test_the_true_tip_is_where_gears_gravity_and_warmth_put_it(hsr):
    """At the touches it lies on the faces, at other joints where NumPy says."""
    simulation = made(hsr, gear_waves=WAVES, compliance=0.3, thermal=1e-4, backlash=0.0)
    rows = simulation.samples
    touched = simulation.true_tips(rows.joints, readings=readings(simulation), when=np.arange(36) / 35)
    np.testing.assert_allclose(levels(simulation, touched), 0.0, atol=1e-6)
    assert np.abs(levels(simulation, tips(simulation, rows.joints, readings(simulation)))).max() > 0.1
    joints = np.random.default_rng(0).uniform(-1, 1, size=(20, 6))
    waving = made(hsr, gear_waves=WAVES, joint_std=1e-4, backlash=1e-4)  # which have no value at a posture
    standing = joints.copy()
    for wave in waving.arm_errors.waves:
        standing += WAVES[wave.order] * np.sin(wave.order * joints + wave.phases)
    np.testing.assert_allclose(waving.true_tips(joints), tips(waving, standing, np.zeros(20)), atol=1e-8)


@pytest.mark.parametrize("folder", ["hsr_jr680", "ur5"])
def test_the_true_tip_hangs_by_as_much_as_asked(folder):
    arm = load_problem(ROOT / "problems" / folder)
    simulation = made(arm, samples=120, compliance=0.3)
    joints, shown = simulation.samples.joints, readings(simulation)
    sag = simulation.true_tips(joints, readings=shown) - made(arm).true_tips(joints, readings=shown)
    assert (sag[:, 2] < 0).all()
    assert math.sqrt((sag**2).sum(axis=1).mean()) == pytest.approx(0.3, rel=0.01)
    cell = dataclasses.replace(arm.cell, repeatability=0.0, resolution=0.0, compliance=0.3)
    for samples in (12, simulation.samples.take(range(9))):  # the same arm, whatever is touched
        again = simulate(arm.problem, cell, samples=samples, seed=3, session=2)
        there = again.true_tips(joints, readings=shown)
        assert there == pytest.approx(simulation.true_tips(joints, readings=shown), abs=1e-9)


def test_the_true_tip_of_an_arm_without_errors_is_that_of_its_chain(hsr):
    simulation = made(hsr)
    joints, shown = simulation.samples.joints, readings(simulation)
    np.testing.assert_allclose(simulation.true_tips(joints, readings=shown), tips(simulation, joints, shown), atol=1e-8)


@pytest.mark.parametrize("scale", [0.0, 1.0, 3.0])
def test_no_joint_of_an_upright_scara_gives_under_gravity(scale):
    cobra = load_problem(ROOT / "problems" / "adept_cobra600")
    with pytest.raises(SimulationError, match="no joint of this robot carries a weight"):
        made(cobra, compliance=0.3, error_scale=scale)


def test_a_tracker_sees_the_true_tip(hsr):
    problem = Problem(hsr.problem.robot, TrackedPoint(noise_std=0.02))
    still = Disturbances(repeatability=0.0, resolution=0.0, gear_waves=WAVES)
    simulation = simulate(problem, still, samples=20, seed=2)
    seen = np.column_stack([simulation.samples.columns[axis] for axis in "xyz"])
    true = simulation.true_tips(simulation.samples.joints)
    np.testing.assert_allclose(pdist(true), pdist(seen), atol=1e-6)
    plain = simulate(problem, dataclasses.replace(still, gear_waves=()), samples=20, seed=2)
    assert np.abs(pdist(plain.true_tips(simulation.samples.joints)) - pdist(seen)).max() > 0.05
    with pytest.raises(SimulationError, match="no plunger"):
        simulation.true_tips(simulation.samples.joints, readings=np.zeros(20))
    with pytest.raises(SimulationError, match=r"\(20, 5\)"):
        simulation.true_tips(np.zeros((20, 5)))


@pytest.mark.long
def test_heights_of_a_face_are_alike_over_the_reach_that_is_asked_for():
    """Their correlation over a distance r is exp(-r^2 / (2 reach^2)), and no plane is left in them."""
    rng = np.random.default_rng(5)
    places, angles = rng.uniform(-0.7, 0.7, size=(100, 2)), rng.uniform(0, 2 * math.pi, 100)
    aside = np.column_stack([np.cos(angles), np.sin(angles)])
    for reach in (0.05, 0.1):  # far below the face's width, so that the plane takes little
        points = np.vstack([places, places + reach * aside, places + 2 * reach * aside])
        drawn = [form_error(np.random.default_rng(k), 1.0, points, reach=reach) for k in range(60)]
        heights = np.array(drawn).reshape(60, 3, 100).transpose(1, 0, 2).reshape(3, -1)
        found = np.corrcoef(heights)[0, 1:]
        np.testing.assert_allclose(found, [math.exp(-0.5), math.exp(-2)], atol=0.06)
    side = np.linspace(-1, 1, 61)
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    field = form_error(np.random.default_rng(1), 0.02, grid, reach=0.4)
    assert np.ptp(field) == pytest.approx(0.02, rel=0.05)
    plane = np.linalg.lstsq(np.column_stack([np.ones(len(grid)), grid]), field, rcond=None)[0]
    assert np.abs(plane).max() < 0.02 * 0.02


def test_a_face_of_short_reach_lifts_neighbours_apart(hsr):
    smooth, rough = (made(hsr, samples=90, flatness=0.05, flatness_reach=reach) for reach in (5.0, 0.05))
    lifts = []
    for simulation in (smooth, rough):
        there = tips(simulation, simulation.samples.joints, readings(simulation))
        heights = levels(simulation, there)
        here = np.array(simulation.samples.labels["plane"]) == "floor"
        design = np.column_stack([np.ones(here.sum()), *((there[here, :2] - (1350, 0)).T / 300)])
        design = np.column_stack([design, design[:, 1] ** 2, design[:, 2] ** 2, design[:, 1] * design[:, 2]])
        fit = np.linalg.lstsq(design, heights[here], rcond=None)[0]
        lifts.append((heights[here] - design @ fit).std() / heights[here].std())
    assert lifts[0] < 0.3  # nearly a bowl or a saddle
    assert lifts[1] > 0.7


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"dial_gain": 0.5}, "dial_gain"),
        ({"dial_cycle": -1e-3}, "dial_cycle"),
        ({"thermal": 1.0}, "thermal"),
        ({"encoder_step": math.nan}, "encoder_step"),
        ({"flatness_reach": 50.0}, "flatness_reach"),
        ({"repeats": 0}, "0 times"),
        ({"repeats": 1.5}, "1.5 times"),
        ({"approach": "left"}, "'left'"),
        ({"gear_waves": 3}, "gear_waves"),
        ({"gear_waves": {1.5: 1e-4}}, "order 1.5"),
        ({"gear_waves": {1: -1e-4}}, "amplitude"),
        ({"gear_waves": {100: 0.01}}, "below 0.005"),
    ],
)
def test_what_means_nothing_is_refused(hsr, changes, words):
    with pytest.raises(SimulationError, match=re.escape(words)):
        dataclasses.replace(hsr.cell, **changes)


def test_what_the_instrument_cannot_show_is_refused(hsr):
    touching = Problem(hsr.problem.robot, DialOnPlane(noise_std=0.05, reading=False))
    for name in ("dial_gain", "dial_cycle", "hysteresis", "drift"):
        with pytest.raises(SimulationError, match=name):
            simulate(touching, dataclasses.replace(hsr.cell, **{name: 1e-3}), samples=3)
    tracked = Problem(hsr.problem.robot, TrackedPoint(noise_std=0.02))
    for changes in ({"drift": 0.01}, {"repeats": 2}, {"approach": "random"}, {"thermal": 1e-5}):
        with pytest.raises(SimulationError, match=next(iter(changes))):
            simulate(tracked, dataclasses.replace(hsr.cell, **changes), samples=3)


def test_the_command_line_knows_them(hsr, tmp_path, capsys):
    options = {
        "gear-wave": "2=1e-4", "repeats": "2", "approach": "random", "dial-gain": "0.0015", "dial-cycle": "0.005",
        "hysteresis": "0.002", "drift": "0.02", "thermal": "3e-5", "encoder-step": "1e-4", "flatness": "0.02",
        "flatness-reach": "0.5",
    }  # fmt: skip
    out = tmp_path / "x.csv"
    words = [word for name, value in options.items() for word in (f"--{name}", value)]
    assert main(["simulate", str(ROOT / "problems/hsr_jr680"), "--out", str(out), "--samples", "12", *words]) == 0
    cell = dataclasses.replace(
        hsr.cell, gear_waves={2: 1e-4}, repeats=2, approach="random", dial_gain=0.0015, dial_cycle=0.005,
        hysteresis=0.002, drift=0.02, thermal=3e-5, encoder_step=1e-4, flatness=0.02, flatness_reach=0.5,
    )  # fmt: skip
    expected, rows = simulate(hsr.problem, cell, samples=12).samples, hsr.problem.read(out)
    np.testing.assert_allclose(rows.joints, expected.joints, atol=1e-8)
    np.testing.assert_allclose(rows.columns["reading"], expected.columns["reading"], atol=1e-9)
    capsys.readouterr()
    assert main(["simulate", str(ROOT / "problems/hsr_jr680"), "--out", str(out), "--gear-wave", "2:1"]) == 2
    assert "ORDER=RAD" in capsys.readouterr().err


def test_a_cell_is_compared_and_written_as_before():
    faces = Cell(faces=load_problem(ROOT / "problems" / "hsr_jr680").cell.faces).faces
    assert Cell(faces=faces, gear_waves={1: 1e-4}) == Cell(faces=faces, gear_waves=[(1, 1e-4)])
    assert hash(Cell(faces=faces, gear_waves={1: 1e-4}))
    assert json.dumps(dataclasses.asdict(Cell(faces=faces, gear_waves={1: 1e-4}))["gear_waves"]) == "[[1, 0.0001]]"


def test_repeats_that_share_noise_weigh_like_a_cluster(hsr):
    """Kish: m rows whose errors correlate by c have a mean of variance (1 + (m - 1) c) / m."""
    bound = bind(hsr.problem, made(hsr, repeats=3).samples)
    stated, shared = bound.block.noise, bound.with_noise({SHARED: 0.4}).block.noise
    correlated = np.full((3, 3), 0.4) + 0.6 * np.eye(3)
    np.testing.assert_allclose((shared / stated) ** 2 / 3, correlated.mean(), rtol=1e-12)


def test_gross_errors_are_once_to_twice_the_size_of_an_outlier():
    sizes = np.abs(gross_errors(Disturbances(outliers=0.99, outlier_size=0.5), 4000, np.random.default_rng(0)))
    sizes = sizes[sizes > 0]
    assert 0.5 <= sizes.min() < 0.51
    assert 0.99 < sizes.max() <= 1.0
    some = gross_errors(Disturbances(outliers=0.25, outlier_size=0.5), 4000, np.random.default_rng(0))
    assert 0.2 < (some > 0).mean() + (some < 0).mean() < 0.3
    assert min((some > 0).sum(), (some < 0).sum()) > 400
