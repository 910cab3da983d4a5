"""Instruments beside the dial: residuals by hand, starts without a guess, the whole way of a user, honest figures."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pandas as pd
import pytest
from instruments_on_ur5 import BAR, INSTRUMENTS, PLATE, PROBLEMS, RADII, ROBOT, flanges, tips
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from casacal import (
    DialOnPlane,
    FixedPoint,
    KnownPoint,
    Parameter,
    Problem,
    Samples,
    Sockets,
    bind,
    check,
    lm,
    simulate,
    tool_point,
)
from casacal.cli.main import main
from casacal.data.columns import Labels
from casacal.deployment.as_data import problem_from
from casacal.errors import ProblemError
from casacal.model import Sight
from casacal.model.dial import dial_cycle, dial_gain
from casacal.model.geometry import rigid_fit
from casacal.simulation import Disturbances
from casacal.uncertainty.figures import nees
from casacal.uncertainty.tip_error import bayesian_bound, tip_rms, without_rigid, workspace_joints

STILL = Disturbances(resolution=0.0, repeatability=0.0, error_scale=0.0)
JOINTS = workspace_joints(ROBOT)

every = pytest.mark.parametrize("name", INSTRUMENTS)


def drawn(name, samples=60):
    """Rows without any error, of the arm as drawn."""
    return simulate(PROBLEMS[name], STILL, samples=samples, seed=3).samples


def labelled(samples, column, label):
    """Rows (N,) of a label."""
    labels = samples.labels[column]
    return np.array(labels.names)[labels.codes] == label


def trilaterated(points, distances):
    """The point at these distances, by a solver that shares no code with the proposal."""

    def misses(centre):
        return np.linalg.norm(points - centre, axis=1) - distances

    return least_squares(misses, points.mean(axis=0) + 30.0, xtol=1e-15, ftol=1e-15).x


def test_a_fixed_point_is_where_the_tip_comes_again_and_again():
    samples = drawn("FixedPoint")
    for label in samples.labels["point"].names:
        assert np.ptp(tips(samples.joints[labelled(samples, "point", label)]), axis=0).max() < 1e-6


def test_sockets_stand_as_far_apart_as_was_said():
    samples = drawn("Sockets")
    for place in samples.labels["place"].names:
        here = labelled(samples, "place", place)
        seen = {name: tips(samples.joints[here & labelled(samples, "socket", name)]) for name in BAR}
        assert all(len(some) > 5 and np.ptp(some, axis=0).max() < 1e-6 for some in seen.values())
        apart = np.linalg.norm(seen["far"].mean(axis=0) - seen["near"].mean(axis=0))
        assert apart == pytest.approx(BAR["far"], abs=1e-6)


def test_lengths_are_those_from_one_anchor():
    samples = drawn("Distance")
    for label in samples.labels["anchor"].names:
        here = labelled(samples, "anchor", label)
        seen, read = tips(samples.joints[here]), samples.columns["length"][here]
        anchor = trilaterated(seen, read)
        np.testing.assert_allclose(np.linalg.norm(seen - anchor, axis=1), read, atol=1e-6)


def test_spheres_are_touched_all_around():
    samples = drawn("SphereTouch")
    slots = {slot.name: slot for slot in bind(PROBLEMS["SphereTouch"], samples).slots}
    for label in samples.labels["sphere"].names:
        seen = tips(samples.joints[labelled(samples, "sphere", label)])
        centre = trilaterated(seen, np.full(len(seen), RADII))
        np.testing.assert_allclose(np.linalg.norm(seen - centre, axis=1), RADII, atol=1e-6)
        np.testing.assert_allclose(slots[f"centre.{label}"].nominal, centre, atol=1e-5)


def test_the_zero_of_a_wire_is_what_it_reads_too_much():
    """Lengths 30 mm too long: anchors are proposed where they are all the same, and the zero comes out as +30."""
    samples = drawn("Distance")
    longer = replace(samples, columns={"length": samples.columns["length"] + 30.0})
    places = [
        np.concatenate([slot.nominal for slot in bind(PROBLEMS["Distance"], rows).slots if slot.key == "anchor"])
        for rows in (samples, longer)
    ]
    np.testing.assert_allclose(places[0], places[1], atol=1e-4)
    result = lm(bind(PROBLEMS["Distance"], longer))
    assert result.x[result.problem.names.index("zero")] == pytest.approx(30.0, abs=1e-3)


def test_every_socket_is_simulated_at_every_place():
    bar = Sockets(noise_std=0.05, along={"a": 0.0, "b": 50.0, "c": 90.0}, tool=tool_point(0, 0, 100, prior_std=1.0))
    samples = simulate(Problem(ROBOT, bar), samples=27, seed=1).samples
    pairs = set(zip(samples.labels["place"].codes.tolist(), samples.labels["socket"].codes.tolist(), strict=True))
    assert len(pairs) == 9


def test_a_bar_is_proposed_where_the_tips_show_its_zero():
    bar = Sockets(noise_std=0.05, along={"a": 0.0, "b": 50.0, "c": 90.0}, tool=tool_point(0, 0, 100, prior_std=1.0))
    along, way, start = np.array([50.0, 90.0, 90.0, 0.0]), np.array([0.6, 0.0, -0.8]), np.array([300.0, -100.0, 40.0])
    sight = Sight(np.zeros((4, 4, 4)), start + along[:, None] * way, {"along": along}, None)
    np.testing.assert_allclose(bar.propose("start", sight), start, atol=1e-9)


def test_a_rigid_fit_finds_the_motion_that_was_made():
    rng = np.random.default_rng(4)
    points, turn, shift = rng.normal(size=(7, 3)), Rotation.from_rotvec([0.4, -2.0, 0.7]).as_matrix(), [50.0, -7.0, 3.0]
    found = rigid_fit(points, points @ turn.T + shift)
    np.testing.assert_allclose(found[:3, :3], turn, atol=1e-12)
    np.testing.assert_allclose(found[:3, 3], shift, atol=1e-12)
    assert rigid_fit(points[:2], points[:2]) is None
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    assert rigid_fit(line, line) is None


def test_tips_on_a_plate_are_as_far_from_one_another_as_its_points():
    samples = drawn("KnownPoint")
    points = samples.labels["point"]
    holes, seen = np.array([PLATE[name] for name in points.names])[points.codes], tips(samples.joints)
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(seen, axis=0), axis=1), np.linalg.norm(np.diff(holes, axis=0), axis=1), atol=1e-6
    )


@pytest.mark.long_unless("FixedPoint")
@every
def test_starts_are_proposed_without_a_guess(name):
    """Without any error nothing is left at the proposed places."""
    bound = bind(PROBLEMS[name], drawn(name))
    assert np.abs(bound.plain_residual(bound.x0)).max() < 1e-5


@pytest.mark.long_unless("TrackedPoint")
@every
def test_estimates_reach_their_bound_and_know_it(name):
    """Over 50 true arms: tip errors as large as the Bayesian bound says, errors as large as covariances say."""
    problem, ratios, total, freedom = PROBLEMS[name], [], 0.0, 0
    for seed in range(50):
        simulated = simulate(problem, Disturbances(resolution=0.0), samples=60, seed=seed)
        bound = bind(problem, simulated.samples)
        truth, result = simulated.truth(bound), lm(bound)
        assert result.converged
        seen = bound.tips(truth, JOINTS)
        best = bayesian_bound(
            bound.normal(truth).information, bound.prior_information, bound.tip_jacobian(truth, JOINTS), seen
        )
        ratios.append(tip_rms(without_rigid((bound.tips(result.x, JOINTS) - seen).ravel(), seen)) / best)
        arm = np.flatnonzero(np.isfinite(bound.prior_std))
        total += nees((result.x - truth)[arm], result.covariance[np.ix_(arm, arm)])
        freedom += arm.size
    slopes = without_rigid(bound.tip_jacobian(truth, JOINTS), seen)
    parts = np.linalg.eigvals(result.covariance @ slopes.T @ slopes).real
    chance = 3.3 * np.sqrt(2 / 50 * (parts**2).sum()) / parts.sum()  # few directions hold most of the error
    assert abs(np.mean(np.square(ratios)) - 1) < chance
    low, high = chi2.ppf([0.0005, 0.9995], freedom)
    assert low < total < high


@pytest.mark.long
@every
def test_the_whole_way_of_a_user(name, tmp_path, capsys):
    """Simulate, check, calibrate, verify with rows that the fit has not seen, report: all by the command line."""
    place, out = tmp_path / "cell", tmp_path / "out"
    place.mkdir()
    source = f"from instruments_on_ur5 import PROBLEMS\n\nproblem = PROBLEMS[{name!r}]\n"
    (place / "problem.py").write_text(source, encoding="utf-8")
    rows, fitted, fresh = (tmp_path / f"{kind}.csv" for kind in ("rows", "fitted", "fresh"))
    assert main(["simulate", str(place), "--out", str(rows), "--samples", "150", "--seed", "5"]) == 0
    header, lines = [], []
    for line in rows.read_text(encoding="utf-8").splitlines(keepends=True):
        (lines if line[0].isdigit() or line[0] == "-" else header).append(line)
    fitted.write_text("".join(header + lines[:110]), encoding="utf-8")
    fresh.write_text("".join(header + lines[110:]), encoding="utf-8")
    assert main(["check", str(place), str(fitted)]) == 0
    assert main(["calibrate", str(place), str(fitted), "--out", str(out)]) == 0
    document = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert document["converged"]
    assert document["verdict"]["level"] == "calibrated"
    assert abs(document["reference"]["relative_gap"]) < 1e-8
    assert problem_from(document["arm"]) == PROBLEMS[name]
    page = (out / "report.html").read_text(encoding="utf-8")
    words = INSTRUMENTS[name].words
    assert words.before in page
    if PROBLEMS[name].layout().labels:
        assert f"Rows of each {words.group}" in page
        assert f"Each {words.group} in turn was left out" in page
    assert "face" not in re.sub("surface|face-map|typeface|font-face|[^>]*>", "", page.replace("<", "\n<"))
    capsys.readouterr()
    assert main(["verify", str(out / "result.json"), str(fresh)]) == 0, capsys.readouterr().out


def test_four_touches_of_a_spike_give_the_tool_and_its_uncertainty():
    """With the arm held, tool and standard deviations are those of linear least squares, solved here by hand."""
    spike = FixedPoint(noise_std=0.1, tool=tool_point(0.0, 0.0, 100.0))
    problem = Problem(ROBOT, spike).fix(*(key for key, unknown in ROBOT.parameters.items() if unknown.size))
    joints = np.radians([0, -90, 90, -90, -90, 0]) + np.random.default_rng(0).uniform(-0.4, 0.4, (4, 6))
    turns, origins = flanges(joints)[:, :3, :3], flanges(joints)[:, :3, 3]
    design = np.vstack([np.hstack([turn, -np.eye(3)]) for turn in turns])
    solved, *_ = np.linalg.lstsq(design, -origins.ravel(), rcond=None)
    covariance = 0.1**2 * np.linalg.inv(design.T @ design)[:3, :3]
    frame = pd.DataFrame(joints, columns=[f"q{i + 1}_rad" for i in range(6)])
    result = lm(bind(problem, Samples.from_frame(frame, problem.layout())))
    tool = [result.problem.names.index(f"tool_{axis}") for axis in "xyz"]
    np.testing.assert_allclose(result.x[tool] + [0, 0, 100.0], solved[:3], atol=1e-6)
    np.testing.assert_allclose(result.covariance[np.ix_(tool, tool)], covariance, rtol=1e-5, atol=1e-9)


def seen_by(name, seed=7, samples=90):
    return simulate(PROBLEMS[name], samples=samples, seed=seed).samples


@pytest.mark.long
def test_metres_for_millimetres_are_named():
    for name in ("Distance", "TrackedPoint"):
        samples = seen_by(name)
        metres = replace(samples, columns={key: values / 1000 for key, values in samples.columns.items()})
        worst = check(PROBLEMS[name], metres)[0]
        assert worst.about == "unit of the readings"
        assert "metres" in worst.cause


@pytest.mark.long
@pytest.mark.parametrize("axis", "xyz")
def test_a_left_handed_frame_is_named(axis):
    samples = seen_by("TrackedPoint")
    mirrored = replace(samples, columns={**samples.columns, axis: -samples.columns[axis]})
    assert check(PROBLEMS["TrackedPoint"], mirrored)[0].about == "left-handed frame"


@pytest.mark.long
def test_exchanged_axes_are_a_left_handed_frame_and_right_ones_are_none():
    samples = seen_by("TrackedPoint")
    exchanged = replace(samples, columns={**samples.columns, "x": samples.columns["y"], "y": samples.columns["x"]})
    assert check(PROBLEMS["TrackedPoint"], exchanged)[0].about == "left-handed frame"
    assert all(finding.about != "left-handed frame" for finding in check(PROBLEMS["TrackedPoint"], samples))


@every
def test_a_row_that_is_far_off_is_named_by_its_line(name):
    samples = seen_by(name)
    joints = samples.joints.copy()
    joints[17, 1] += np.radians(0.5)
    findings = check(PROBLEMS[name], replace(samples, joints=joints))
    assert any(samples.lines[17] in finding.lines and len(finding.lines) < 4 for finding in findings)


@pytest.mark.parametrize(("name", "column"), [("Sockets", "socket"), ("KnownPoint", "point")])
def test_a_label_that_is_not_listed_is_refused(name, column):
    samples = seen_by(name)
    was = samples.labels[column]
    renamed = Labels(("elsewhere", *was.names[1:]), was.codes)
    other = replace(samples, labels={**samples.labels, column: renamed})
    with pytest.raises(ProblemError, match=r"'elsewhere', which .* does not list"):
        bind(PROBLEMS[name], other)
    assert "elsewhere" in check(PROBLEMS[name], other)[0].cause


@pytest.mark.parametrize(("name", "column"), [("Sockets", "socket"), ("KnownPoint", "point")])
def test_rows_that_do_not_say_which_point_they_are_of_are_refused(name, column):
    samples = seen_by(name)
    without = {key: labels for key, labels in samples.labels.items() if key != column}
    unsaid = replace(samples, labels={**without, column: Labels((column,), np.zeros(len(samples), dtype=np.int32))})
    with pytest.raises(ProblemError, match=f"has no column '{column}'"):
        bind(PROBLEMS[name], unsaid)


@pytest.mark.parametrize("name", ["KnownPoint", "TrackedPoint"])
def test_points_on_a_line_are_refused(name):
    """Two places of the plate, or of the tip: what turns about their line is open."""
    samples = drawn(name)
    first = samples.labels["point"].codes < 2 if name == "KnownPoint" else np.arange(len(samples)) < 2
    rows = samples.take(np.flatnonzero(first)[[0, 1] * 4])
    with pytest.raises(ProblemError, match=rf"The points of {name} lie on a line\. Measure at least three"):
        bind(PROBLEMS[name], rows)


def test_an_anchor_of_too_few_lengths_is_refused():
    samples = seen_by("Distance")
    few = np.flatnonzero(samples.labels["anchor"].codes == 0)[4:]
    with pytest.raises(ProblemError, match=r"An anchor has 4 lengths\. Take 5 or more"):
        bind(PROBLEMS["Distance"], samples.take(np.setdiff1d(np.arange(len(samples)), few)))


@pytest.mark.long
def test_a_wire_that_counts_down_is_named():
    samples = seen_by("Distance")
    down = replace(samples, columns={"length": 1500.0 - samples.columns["length"]})
    assert check(PROBLEMS["Distance"], down)[0].about == "sign of the lengths"


def test_a_place_with_one_socket_alone_is_refused():
    samples = seen_by("Sockets")
    one = labelled(samples, "place", "1") & labelled(samples, "socket", "far")
    with pytest.raises(ProblemError, match="one socket alone"):
        bind(PROBLEMS["Sockets"], samples.take(np.flatnonzero(~one)))


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: Sockets(noise_std=0.1, along={"0": 0.0}), "stand at .* along the bar"),
        (lambda: Sockets(noise_std=0.1, along={"0": 5.0, "1": 5.0}), "stand at .* along the bar"),
        (lambda: KnownPoint(noise_std=0.1, points={"a": (0, 0, 0), "b": (1, 0, 0), "c": (2, 0, 0)}), "how it lies"),
        (lambda: KnownPoint(noise_std=0.1, points={"a": (0, 0), "b": (1, 0, 0)}), "Point 'a' of the plate is"),
        (lambda: KnownPoint(noise_std=0.1, points=[(0, 0, 0)]), "Point '' of the plate is"),
        (lambda: KnownPoint(noise_std=0.1, points={"a": ("x", "y", "z")}), "Point 'a' of the plate is"),
        (lambda: Sockets(noise_std=0.1, along=[0, 50]), "stand at .* along the bar"),
        (lambda: Sockets(noise_std=0.1, along={"a": "x", "b": 2.0, "c": 3.0}), "stand at .* along the bar"),
        (lambda: FixedPoint(noise_std="0.1"), "noise_std of FixedPoint is '0.1'"),
        (lambda: FixedPoint(noise_std=0.0), "noise_std of FixedPoint is 0.0"),
        (lambda: Parameter(None, unit="mm", free=False, labels=("_x", "_y", "_z")), "held but has no value"),
    ],
)
def test_declarations_that_cannot_be_are_refused(make, match):
    with pytest.raises(ProblemError, match=match):
        make()


def test_the_way_of_a_dial_is_one_formula_for_numbers_and_symbols():
    dial = DialOnPlane(noise_std=0.01, gain=dial_gain(), cycle=dial_cycle())
    shown = np.array([1.0, 2.25])
    for reading in (shown.copy(), ca.DM(shown)):
        row, p = SimpleNamespace(reading=reading), SimpleNamespace(gain=1.0, cycle=(0.0, 3.0))
        expected = 1.01 * shown + 3e-3 * np.sin(2 * np.pi * shown)
        np.testing.assert_allclose(np.array(dial.reach(p, row)).ravel(), expected, rtol=1e-12)
        np.testing.assert_array_equal(np.array(row.reading).ravel(), shown)
