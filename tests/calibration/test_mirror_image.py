"""An arm and its mirror image fit faces alike: that is found, said wherever Cartesian things are, and settled once."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT
from measured_world import World, at_one_reading
from scipy.spatial.transform import Rotation

from casacal import (
    DialOnPlane,
    FixedPoint,
    Joint,
    Problem,
    Robot,
    TrackedPoint,
    TrackedPose,
    bind,
    calibrate,
    check,
    deg,
    lm,
    load,
    load_problem,
    plan,
    simulate,
    tool_point,
)
from casacal.calibration.brief import next_step
from casacal.calibration.mirror import either_way, mirror_image, mirrors, misfits
from casacal.calibration.result_json import image_words
from casacal.cli.main import main
from casacal.data.samples import Measurements, joined
from casacal.errors import ProblemError

TOOL = tool_point(0, 0, 120, prior_std=0.3)
TABLE = {
    "alpha": deg(-90, 0, -90, 90, -90, 0),
    "a": (150.0, 600.0, 120.0, 0.0, 0.0, 0.0),
    "d": (450.0, 0.0, 0.0, 640.0, 0.0, 100.0),
    "theta": deg(0, -90, 0, 0, 0, 0),
}


def bound(problem, seed=1):
    samples = simulate(problem, samples=80, seed=seed).samples
    return bind(problem, *Measurements.of(samples).sets)


def six(instrument=None, **changed):
    return Problem(Robot.from_dh("six", **{**TABLE, **changed}), instrument or DialOnPlane(noise_std=0.01, tool=TOOL))


def rotated(axis, angle):
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(angle * np.eye(3)[axis]).as_matrix()
    return turn


def flange(q, table=TABLE):
    """The standard DH product, written here with SciPy."""
    pose = np.eye(4)
    for theta, alpha, a, d, turned in zip(table["theta"], table["alpha"], table["a"], table["d"], q, strict=True):
        shift = np.eye(4)
        shift[:3, 3] = (a, 0, d)
        pose = pose @ rotated(2, theta + turned) @ shift @ rotated(0, alpha)
    return pose


def test_the_image_of_a_six_axis_arm_is_found_and_is_one():
    found = mirror_image(bound(six()))
    assert (found.reversed, found.half_turned) == ((1, 4, 6), ())
    signs = np.array([-1, 1, 1, -1, 1, -1])
    reflection = np.diag([1.0, -1.0, 1.0, 1.0])
    for q in np.random.default_rng(0).uniform(-2, 2, (5, 6)):  # by a product of transforms that shares no code with it
        np.testing.assert_allclose(flange(signs * q), reflection @ flange(q) @ reflection, atol=1e-9)
    assert found.off_mm > 200


@pytest.mark.parametrize(
    ("problem", "joints", "halves"),
    [("kuka_iiwa14", (1, 3, 5, 7), ()), ("hsr_jr680", (1, 4, 6), ()), ("ur5", (1, 2, 3, 4, 5, 6), (2, 4))],
)
def test_rows_of_the_image_fit_to_the_same_cost(problem, joints, halves):
    fit = bind(source := load_problem(ROOT / "problems" / problem).problem, samples := source.read(
        ROOT / "problems" / problem / "samples.csv"))  # fmt: skip
    found = mirror_image(fit)
    assert (found.reversed, found.half_turned) == (joints, halves)
    count = np.arange(1, len(source.robot.axes) + 1)
    turned = samples.joints * np.where(np.isin(count, joints), -1, 1) + np.pi * np.isin(count, halves)
    assert abs(lm(bind(source, replace(samples, joints=turned))).cost - lm(fit).cost) < 1.0
    wrong = samples.joints * np.where(count == 1, -1, 1)
    assert lm(bind(source, replace(samples, joints=wrong))).cost > 1000


def test_what_sees_poses_or_an_arm_with_an_elbow_aside_has_no_image():
    pose = TrackedPose(position_std=0.05, angle_std=1e-4)
    assert mirror_image(bound(six(pose))) is None
    assert mirror_image(bound(six(TrackedPoint(noise_std=0.05, tool=TOOL)))) is None
    aside = six(d=(450.0, 0.0, 70.0, 640.0, 35.0, 100.0))
    assert mirror_image(bound(aside)) is None


def test_limits_may_tell_the_image_apart():
    fit = bound(six())
    least = float(fit.measured.sets[0].joints[:, 0].min())
    one_side = [Joint("revolute", least - 0.01, np.pi), *[Joint()] * 5]
    assert least > -0.9 * np.pi
    assert mirror_image(bind(six(joints=one_side), *fit.measured.sets)) is None
    assert mirror_image(bind(six(joints=[Joint()] * 6), *fit.measured.sets)) is not None


def test_patterns_and_misfits():
    robot = six().robot
    signs, offsets = mirrors(robot)
    assert signs.shape == offsets.shape == (64 * 16, 6)
    assert set(np.unique(signs)) == {-1.0, 1.0}
    assert not offsets[:, [0, 5]].any()
    rng = np.random.default_rng(2)
    drawn = rng.normal(size=(8, 3))
    turn = Rotation.random(random_state=3).as_matrix()
    tips = np.stack([drawn @ turn + 5, drawn * (1, -1, 1), drawn + 0.1 * rng.normal(size=(8, 3))])
    alike, moved = misfits(tips, drawn)
    np.testing.assert_allclose(alike[:2], 0, atol=1e-7)
    assert moved[0] < 1e-7 < 0.1 < moved[1]
    aligned, size = Rotation.align_vectors(drawn - drawn.mean(axis=0), tips[1] - tips[1].mean(axis=0))
    assert moved[1] == pytest.approx(size / np.sqrt(8))
    assert aligned is not None
    assert alike[2] == pytest.approx(moved[2])


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("image")
    shutil.copytree(ROOT / "problems" / "hsr_jr680", folder / "six")
    assert main(["simulate", str(folder / "six"), "--out", str(folder / "s.csv"), "--samples", "90"]) == 0
    fresh = ["--samples", "40", "--session", "1"]
    assert main(["simulate", str(folder / "six"), "--out", str(folder / "fresh.csv"), *fresh]) == 0
    rng, robot = np.random.default_rng(4), load_problem(folder / "six").problem.robot
    for name, signs in (("as_drawn", np.ones(6)), ("image", np.array([-1, 1, 1, -1, 1, -1]))):
        rows = ["q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm,qw,qx,qy,qz"]
        for q in rng.uniform(-1.0, 1.0, (6, 6)):
            pose = np.array(robot.traced.at_drawn(q))
            turn = Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]
            rows.append(",".join(f"{number:.6f}" for number in (*np.degrees(signs * q), *pose[:3, 3], *turn)))
        (folder / f"{name}.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return folder


SAID = r"with joints 1, 4 and 6 counted the other way the samples fit as well.* mm off"


@pytest.mark.long
def test_it_is_said_until_poses_off_the_pendant_settle_it(place, capsys):
    problem, samples, out = str(place / "six"), str(place / "s.csv"), place / "out"
    targets = place / "targets.csv"
    targets.write_text("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n10,20,30,40,50,60\n", encoding="utf-8")
    poses = place / "poses.csv"
    poses.write_text((place / "as_drawn.csv").read_text(encoding="utf-8"), encoding="utf-8")

    def said(*words, code=0):
        assert main([*words]) == code
        shown = capsys.readouterr()
        return " ".join((shown.out + shown.err).split())

    where = [
        ["check", problem, samples],
        ["calibrate", problem, samples, "--out", str(out)],
        ["predict", str(out), str(targets), "--out", str(place / "p.csv")],
        ["export", str(out), "--to", "dh", "--out", str(place / "dh.csv")],
        ["verify", str(out), str(place / "fresh.csv")],
    ]
    for words in where:
        assert re.search(SAID, said(*words), re.I), words
    assert re.search(SAID, (place / "p.csv").read_text(encoding="utf-8"), re.I)
    assert re.search(SAID, (out / "report.html").read_text(encoding="utf-8"), re.I)
    document = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert document["mirror_image"]["reversed"] == [1, 4, 6]
    for file, there in ((targets, False), (poses, True)):  # corrected joint targets are right either way
        said("compensate", str(out), str(file), "--out", str(place / "c.csv"))
        assert bool(re.search(SAID, (place / "c.csv").read_text(encoding="utf-8"), re.I)) == there
    assert load(out).arm.mirror_words is not None
    assert not re.search(
        SAID, said("predict", str(out), str(targets), "--nominal", "--out", str(place / "p.csv")), re.I
    )

    refused = said("doctor", problem, str(place / "image.csv"), "--keep", code=2)
    assert "Nothing is kept: the conventions differ from the problem's" in refused
    few = place / "few.csv"
    few.write_text("\n".join((place / "as_drawn.csv").read_text(encoding="utf-8").splitlines()[:2]), encoding="utf-8")
    assert "Nothing is kept" in said("doctor", problem, str(few), "--keep", code=2)
    assert not (place / "six" / "conventions.json").exists()
    assert "Kept: " in said("doctor", problem, str(place / "as_drawn.csv"), "--keep")
    assert load_problem(problem).confirmed
    for words in where[:2]:
        assert not re.search(SAID, said(*words), re.I), words
    assert json.loads((out / "result.json").read_text(encoding="utf-8"))["mirror_image"] is None

    kept = place / "six" / "conventions.json"
    other = json.loads(kept.read_text(encoding="utf-8"))
    kept.write_text(json.dumps({**other, "flange_mm": (-np.array(other["flange_mm"])).tolist()}), encoding="utf-8")
    assert not load_problem(problem).confirmed
    for text in ("{", "[]", '{"joints": [1], "flange_mm": 3}', json.dumps({**other, "joints": "q"})):
        kept.write_text(text, encoding="utf-8")
        with pytest.raises(ProblemError, match=r"is not what casacal doctor keeps\. Delete it"):
            _ = load_problem(problem).confirmed
    kept.unlink()


@pytest.mark.long
def test_an_image_that_one_of_several_instruments_excludes_is_none():
    """The dial alone would fit the image; the tracker on the same arm does not."""
    source = load_problem(ROOT / "problems" / "ur5_three_instruments")
    names = source.problem.names
    sets = tuple(source.problem.read(source.samples_of(k), k) for k in range(len(names)))
    samples = Measurements(names, sets)
    assert "mirror image" not in [found.about for found in check(source.problem, samples)]
    both = Problem(six().robot, {"dial": six().instrument, "spike": FixedPoint(noise_std=0.05, tool=TOOL)})
    rows = simulate(both, samples=60, seed=2).measured
    assert "mirror image" in [found.about for found in check(both, rows)]
    assert "mirror image" not in [found.about for found in check(both, rows, confirmed=True)]
    dial = source.problem.measured_by("dial")
    assert "mirror image" in [found.about for found in check(dial, sets[names.index("dial")])]


@pytest.mark.long
def test_of_a_result_that_must_not_be_used_nothing_is_said(tmp_path, capsys):
    words = ["calibrate", str(ROOT / "problems" / "hsr_jr680"), "--set", "sign=-1", "--out", str(tmp_path / "out")]
    assert main(words) == 1
    assert main([*words[:-2], "--verbose"]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "Do not use" in said
    assert not re.search(SAID, said, re.I)
    assert not re.search(SAID, (tmp_path / "out" / "report.html").read_text(encoding="utf-8"), re.I)
    assert json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))["mirror_image"] is None
    source = load_problem(ROOT / "problems" / "hsr_jr680")
    wrong = source.problem.with_settings({"sign": -1})
    assert mirror_image(bind(wrong, wrong.read(source.samples))) is not None  # so there would be something to say


def test_in_python_the_question_is_answered_by_an_argument():
    source = load_problem(ROOT / "problems" / "hsr_jr680")
    samples = source.problem.read(source.samples)
    abouts = [each.about for each in check(source.problem, samples)]
    assert "mirror image" in abouts
    assert "mirror image" not in [each.about for each in check(source.problem, samples, confirmed=True)]
    earlier = calibrate(source.problem, samples.take(np.arange(60)), reference=False)
    assert earlier.mirror_image.reversed == (1, 4, 6)
    assert image_words(earlier, earlier.verdict) == [earlier.mirror_image.words]
    assert image_words(earlier, replace(earlier.verdict, level="do not use")) == []
    later = calibrate(source.problem, samples.take(np.arange(60, 120)), prior=earlier, reference=False)
    assert later.mirror_image == earlier.mirror_image


def test_an_image_that_fits_better_is_named_too():
    """Rows of an arm whose elbow is a little aside, with the joints counted otherwise than the problem has them."""
    fit = bound(six(d=(450.0, 0.0, 4.0, 640.0, 0.0, 100.0)))
    signs = np.array([-1, 1, 1, -1, 1, -1])
    turned = fit.on(*(replace(some, joints=some.joints * signs) for some in fit.measured.sets))
    assert lm(turned).cost > lm(fit).cost + 12
    assert mirror_image(fit) is None
    assert mirror_image(turned).reversed == (1, 4, 6)


@pytest.fixture(scope="module")
def read_alike(hsr):
    """A true arm that was driven to where the drawn one reads 5 mm everywhere, its touches, and three 1 mm nearer."""
    route = plan(hsr.problem, hsr.cell, touches=60, pool=400, starts=1, check=0.0, seed=3)
    route = replace(route, samples=at_one_reading(hsr.problem, route.samples, 5.0))
    world = World(hsr.problem, route, seed=2, faces=(1e-3, 1e-6))
    near = at_one_reading(hsr.problem, world.samples, 4.0).joints[:3] - route.samples.joints[:3]
    samples = world.samples.take(np.arange(3))
    joints = samples.joints + near

    def off(reading):
        return world.bound.on(replace(samples, joints=joints, columns={"reading": reading})).plain_residual(world.x)

    at_zero, at_one = off(np.zeros(3)), off(np.ones(3))
    nearer = replace(samples, joints=joints, columns={"reading": np.round(-at_zero / (at_one - at_zero), 3)})
    return world.samples, joined(world.samples, nearer)


def test_a_sign_of_the_dial_that_no_reading_shows_is_said_and_settled_by_three_touches(hsr, read_alike):
    """Right or wrong, every row fits; the touches that the verdict asks for tell, and nothing passes for calibrated."""
    touches, and_nearer = read_alike
    wrong = [replace(some, columns={"reading": 10 - some.columns["reading"]}) for some in read_alike]
    for some in (touches, wrong[0]):
        made = calibrate(hsr, some, reference=False)
        assert made.verdict.level == "use with care"
        assert "do not tell in which direction the dial counts" in made.verdict.words
        assert "the dial's sign" in made.verdict.words.partition("But")[0]
        assert next_step(made, made.verdict).startswith("touch three places again with the arm 1 mm nearer")
        warned = [each.about for each in check(hsr.problem, some) if each.severity == "warning"]
        assert warned == ["direction of the dial"]
    assert calibrate(hsr, and_nearer, reference=False).verdict.level == "calibrated"
    settled = calibrate(hsr, wrong[1], reference=False)
    assert settled.verdict.level == "do not use"
    assert "The dial counts the other way" in settled.verdict.reasons[0]
    assert next_step(settled, settled.verdict).startswith("reverse the sign of the dial")
    named = [each.about for each in check(hsr.problem, wrong[1]) if each.severity == "error"]
    assert named == ["wrong dial sign"]


def test_one_stray_row_blames_no_sign_that_explains_it_no_better(hsr, read_alike):
    """A row that is just far enough off to be set aside fits the other way round as badly."""
    touches, bad = read_alike[0], np.arange(60) == 20
    for off in np.arange(0.05, 0.1, 0.005):
        made = calibrate(
            hsr, replace(touches, columns={"reading": touches.columns["reading"] + off * bad}), reference=False
        )
        if made.aside:
            break
    assert made.aside_lines == (touches.lines[20],)
    assert made.verdict.level == "use with care"
    assert "do not tell in which direction the dial counts" in " ".join((made.verdict.words, *made.verdict.reasons))


def test_a_gauge_that_stood_still_is_asked_about_before_any_prior(hsr, read_alike):
    """Every posture as planned and every reading the same: the arm as drawn, and nothing measured."""
    for size in (0.0, 0.003):  # of what the gauge flickers by
        reading = np.full(60, 5.0) + size * np.sin(np.arange(60.0) ** 2)
        made = calibrate(hsr, replace(read_alike[0], columns={"reading": reading}), reference=False)
        assert made.verdict.level == "do not use"
        assert "unless a gauge stood still, or they are a plan's" in made.verdict.words
        assert next_step(made, made.verdict).startswith("look whether these readings were measured")


@pytest.mark.parametrize("name", ["ur5", "hsr_jr680"])
def test_touches_of_a_plan_tell_the_direction_of_the_dial(name):
    source = load_problem(ROOT / "problems" / name)
    route = plan(source.problem, source.cell, touches=50, pool=300, starts=1, check=0.0, seed=1)
    world = World(source.problem, route, seed=4, faces=(1e-3, 1e-6))
    assert not either_way(bind(source.problem, world.samples))
    assert not either_way(bind(source.problem, simulate(source.problem, source.cell, samples=60, seed=2).samples))
