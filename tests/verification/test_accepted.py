"""`verify` with a tolerance: dial, tracker and length on simulated arms, the Motoman's tracker files, page, command."""

import dataclasses
import json
import math
import re
from functools import cache

import html5lib
import numpy as np
import pytest
from conftest import ROOT
from page_reader import REFERENCES, Page, tables
from scipy.stats import binom
from test_real_arm import SETS
from test_verification import drawn, fitted, halves, touched, true_arm

from casacal import (
    CasacalError,
    Distance,
    Problem,
    Samples,
    TrackedPoint,
    bind,
    calibrate,
    load_problem,
    tool_point,
    verify,
)
from casacal.cli.main import main

TOOL = np.array([20.0, 10.0, 60.0])
NOISE = 0.02
KINDS = {
    "tracker": TrackedPoint(noise_std=NOISE, tool=tool_point(*TOOL, free=False)),
    "length": Distance(noise_std=NOISE, tool=tool_point(*TOOL, free=False)),
}


@cache
def watched(name, kind):
    """An arm's problem with another instrument, postures drawn at random, and slopes of what it reads there."""
    source, bound, *_ = drawn(name)
    problem = Problem(source.problem.robot, KINDS[kind])
    joints = np.random.default_rng(3).uniform(-1.0, 1.0, (600, bound.block.samples.joints.shape[1]))
    there = bind(problem, readings(bound, bound.x0, joints, kind, np.random.default_rng(0), noise=0.0))
    arm = np.array([slot.key in source.problem.robot.parameters for slot in there.slots for _ in slot.columns])
    slopes = there.jacobian(there.x0) * NOISE
    return (
        problem,
        joints,
        slopes[:, arm],
        slopes[:, ~arm],
        [n for n, is_arm in zip(there.names, arm, strict=True) if is_arm],
    )


def readings(bound, x, joints, kind, rng, noise=NOISE):
    """What a tracker, or a wire from an anchor, reads of an arm x (n,); by hand."""
    frames = bound.poses(x, joints)
    points = frames[:, :3, 3] + frames[:, :3, :3] @ TOOL
    lines = tuple(range(1, len(joints) + 1))
    if kind == "tracker":
        points = points + rng.normal(size=points.shape) * noise
        return Samples(joints, dict(zip("xyz", points.T, strict=True)), {}, lines, {}, "rows", "watched")
    lengths = np.linalg.norm(points - [1500.0, -800.0, 100.0], axis=1) + rng.normal(size=len(points)) * noise
    return Samples(joints, {"length": lengths}, {"anchor": ["a"] * len(lines)}, lines, {}, "rows", "watched")


def estimate(arm):
    """Local coordinates of a calibration, by name."""
    rows = arm.document["parameters"]
    return {row["name"]: row["estimate"] - row["nominal"] for row in rows}


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["hsr_jr680", "ur5"])
def test_what_other_instruments_see_of_the_arm(name, kind):
    """The true error over 600 postures, from which 30 are measured: covered, accepted and rejected as it should be."""
    source, bound, *_ = drawn(name)
    problem, joints, slopes, own, names = watched(name, kind)
    rng, faces, parts = np.random.default_rng(21), np.linalg.pinv(own), 3 if kind == "tracker" else 1
    covered, wide, narrow, at, ratios, trials = 0, 0, 0, 0, [], 10
    where = [bound.names.index(each) for each in names]
    for _ in range(trials):
        x = true_arm(bound, rng)
        arm = fitted(source, halves(touched(name, x, rng))[0])
        known, here = estimate(arm), rng.choice(600, 30, replace=False)
        rows = readings(bound, x, joints[here], kind, rng)

        def true(moved, faces=faces):
            error = slopes @ moved
            return math.sqrt(((error - own @ (faces @ error)) ** 2).sum() / 600)

        drawn_mm, after_mm = true(x[where]), true(np.array([known[each] for each in names]) - x[where])
        found = verify(arm, rows, problem=problem, tolerance=after_mm)
        covered += found.overall.after.low_mm <= after_mm <= found.overall.after.high_mm
        covered += found.overall.before.low_mm <= drawn_mm <= found.overall.before.high_mm
        ratios.append(found.overall.after.mm / after_mm)
        wide += verify(arm, rows, problem=problem, tolerance=2 * after_mm).passed
        narrow += verify(arm, rows, problem=problem, tolerance=after_mm / 2).decision.verdict == "reject"
        at += found.decision.verdict != "undecided"
    assert covered >= binom.ppf(1e-6, 2 * trials, 0.94)
    assert at <= binom.ppf(1 - 1e-6, trials, 0.12)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.15)
    assert min(wide, narrow) > trials / 2
    assert found.accuracy == (kind == "tracker")
    assert found.noise_mm == pytest.approx(NOISE * math.sqrt(parts), rel=1e-6)


# ------------------------------------------------------------------------------------------------ touches


@pytest.fixture(scope="module")
def good(hsr):
    _, bound, *_ = drawn("hsr_jr680")
    rng = np.random.default_rng(9)
    x = true_arm(bound, rng)
    some, fresh = halves(touched("hsr_jr680", x, rng))
    return fitted(hsr, some), fresh, x


@pytest.mark.long_unless("hsr_jr680")
@pytest.mark.parametrize("name", ["hsr_jr680", "ur5"])
def test_touches_see_what_the_arm_errs_by(name):
    """Against the true error of the same arms on all 150 postures, by the slopes of the distances alone."""
    source, bound, *_ = drawn(name)
    rng, covered, wrong, quieter, trials = np.random.default_rng(22), 0, 0, 0, 20
    slopes = bound.jacobian(bound.x0) * bound.block.noise.ravel()[:, None]
    arm = np.array([not slot.datum for slot in bound.slots for _ in slot.columns])
    faces = np.linalg.pinv(slopes[:, ~arm])
    for _ in range(trials):
        x = true_arm(bound, rng)
        some, fresh = halves(touched(name, x, rng))
        one = fitted(source, some)
        known = estimate(one)
        moved = np.array([known.get(each, 0.0) for each in bound.names])[arm] - x[arm]
        error = slopes[:, arm] @ moved
        true = math.sqrt(((error - slopes[:, ~arm] @ (faces @ error)) ** 2).mean())
        found = verify(one, fresh, tolerance=true)
        covered += found.overall.after.low_mm <= true <= found.overall.after.high_mm
        wrong += found.decision.verdict != "undecided"
        quieter += found.noise_mm < 0.99 * found.noise_stated_mm
        assert found.overall.before.mm > 3 * found.overall.after.high_mm
    assert covered >= binom.ppf(1e-6, trials, 0.94)
    assert wrong <= binom.ppf(1 - 1e-6, trials, 0.12)
    assert quieter <= binom.ppf(1 - 1e-6, trials, 0.01)


def test_faces_and_regions_have_their_own(good):
    arm, fresh, _ = good
    found = verify(arm, fresh)
    kinds = [part.kind for part in found.errors]
    assert kinds[:4] == ["all", "face", "face", "face"]
    assert set(kinds[4:]) == {"region"}
    assert found.overall.rows == sum(part.rows for part in found.errors if part.kind == "face") == len(fresh)
    assert sum(part.rows for part in found.errors if part.kind == "region") == len(fresh)
    for part in found.errors:
        for each in (part.before, part.after):
            assert each.low_mm <= each.mm <= each.high_mm
        assert 0 < part.promised_mm < 0.05
    wall = np.flatnonzero(np.array(fresh.labels["plane"]) == "wall")
    alone = verify(arm, fresh.take(wall)).overall
    among = next(part for part in found.errors if part.label == "wall")
    assert (alone.before.mm, alone.promised_mm) == pytest.approx((among.before.mm, among.promised_mm), rel=1e-6)
    assert alone.after.high_mm == pytest.approx(among.after.high_mm, rel=1e-6)
    few = verify(arm, fresh.take(range(20)))
    assert [part.kind for part in few.errors] == ["all"]


def test_one_row_on_a_face_that_stands_says_next_to_nothing(good):
    arm, fresh, _ = good
    one = fresh.take([0])
    found = verify(arm, one, standing=[one.labels["plane"][0]], tolerance=0.05)
    assert found.overall.after.high_mm > 1.0
    assert found.decision.verdict == "undecided"


def test_an_error_in_distances_is_never_called_accuracy(good):
    arm, fresh, _ = good
    found = verify(arm, fresh, tolerance=0.05)
    assert found.passed
    words = found.summary()
    assert words.startswith("Promise kept, and accepted: 60 fresh rows")
    assert "This decides on what these planes see, not on the position of the tip." in words
    assert "could remain unseen" in words
    assert "tip" not in found.measurand
    assert "Accepted up to" in words
    assert "not on the position of the tip" in found.page()


def test_a_tolerance_that_the_drawing_meets_is_asked_about(good):
    arm, fresh, _ = good
    assert "Is the tolerance in mm?" in verify(arm, fresh, tolerance=50).summary()
    assert "Is the tolerance in mm?" not in verify(arm, fresh, tolerance=0.05).summary()


def test_what_is_not_kept_is_not_accepted(good):
    arm, _, x = good
    _, bound, *_ = drawn("hsr_jr680")
    worse = x.copy()
    worse[bound.names.index("a2")] += 0.6
    found = verify(arm, halves(touched("hsr_jr680", worse, np.random.default_rng(4)))[1], tolerance=5.0)
    assert not found.kept
    assert found.decision.verdict == "accept"
    assert not found.passed
    assert "Accepted:" not in found.summary()
    assert "but the promise was not kept" in found.summary()
    assert "verdict bad" in found.page()


def test_a_result_that_must_not_be_used_is_not_accepted(good):
    arm, fresh, _ = good
    denied = {"level": "do not use", "words": "Do not use this result: it is spoiled.", "reasons": []}
    spoiled = dataclasses.replace(arm, document={**arm.document, "verdict": denied})
    found = verify(spoiled, fresh, tolerance=0.05)
    assert found.kept
    assert not found.passed
    assert found.summary().startswith("Promise kept, but the result must not be used")
    assert "but the result must not be used" in found.summary()
    assert "Accepted:" not in found.summary()
    assert "verdict bad" in found.page()


def test_a_gross_row_does_not_decide(good):
    arm, fresh, _ = good
    reading = fresh.columns["reading"].copy()
    reading[4] += 0.5
    found = verify(arm, dataclasses.replace(fresh, columns={"reading": reading}), tolerance=0.03)
    assert found.gross_lines == (fresh.lines[4],)
    assert found.decision.verdict == "undecided"
    assert found.decision.hangs_on_gross
    assert "The decision depends on the rows named above" in found.summary()
    assert "The rows named above are included." in found.summary()
    assert "count in it" not in verify(arm, fresh).summary()
    assert verify(arm, fresh, tolerance=0.03).passed


def test_noise_that_was_stated_too_large_does_not_hide_an_error(good):
    """With 0.03 mm stated for a dial of 0.01 the touches of an arm that errs by 0.02 mm look like noise alone."""
    arm, fresh, _ = good
    found = verify(arm, fresh, tolerance=0.02)
    document = {**arm.document, "noise": {"ratio": 0.33, "low": 0.29, "high": 0.4}}
    loud = dataclasses.replace(arm, document=document)
    assert verify(loud, fresh).noise_mm == pytest.approx(0.29 * found.noise_mm, rel=1e-6)
    assert verify(loud, fresh).overall.after.high_mm > found.overall.after.high_mm
    assert "the residuals are too small for that much" in verify(loud, fresh).summary()
    near = dataclasses.replace(arm, document={**arm.document, "noise": {"ratio": 0.93, "low": 0.8, "high": 1.1}})
    assert verify(near, fresh).noise_mm == found.noise_mm
    assert verify(near, fresh).overall == found.overall
    # another instrument's noise is its own, and its rows say themselves what they scatter by
    _, bound, *_ = drawn("hsr_jr680")
    problem, joints, *_ = watched("hsr_jr680", "tracker")
    rows = readings(bound, good[2], joints[:60], "tracker", np.random.default_rng(5))
    loud_one = Problem(problem.robot, dataclasses.replace(KINDS["tracker"], noise_std=0.1))
    right, wrong = (verify(loud, rows, problem=each) for each in (problem, loud_one))
    assert right.noise_mm == pytest.approx(NOISE * math.sqrt(3), rel=1e-6)
    assert wrong.noise_mm < 1.2 * right.noise_mm
    by_half = Problem(problem.robot, dataclasses.replace(KINDS["tracker"], noise_std=1.5 * NOISE))
    assert verify(loud, rows.take(range(25)), problem=by_half).noise_mm < 1.4 * right.noise_mm


def test_noise_that_was_found_larger_counts_for_neither_verdict(good):
    arm, fresh, _ = good
    sizes = {name: {"stated_mm": 0.01, "used_mm": 0.03} for name in ("floor", "wall", "side")}
    noise = {"ratio": 3.0, "low": 2.6, "high": 3.5, "by_face": sizes}
    louder = dataclasses.replace(arm, document={**arm.document, "noise": noise})
    plain, found = verify(arm, fresh), verify(louder, fresh, tolerance=0.012)
    assert found.noise_mm == pytest.approx(plain.noise_mm, rel=0.01)
    assert found.noise_most_mm == pytest.approx(3 * plain.noise_mm, rel=0.01)
    assert found.overall.after.low_mm == 0.0
    assert found.overall.after.high_mm > 0.9 * plain.overall.after.high_mm
    assert "the rows cannot tell whether the difference is noise or the arm's error" in found.summary()
    assert (
        verify(arm, fresh, tolerance=1e-4).decision.reject_above_mm
        < 0.3 * verify(louder, fresh, tolerance=1e-4).decision.reject_above_mm
    )


def test_tolerance_and_risk_are_refused_where_they_are_none(good):
    arm, fresh, _ = good
    for risk in (0, -0.1, 0.5, 5, math.nan, True, "0.05"):
        with pytest.raises(CasacalError, match="The risk is"):
            verify(arm, fresh, tolerance=0.05, risk=risk)
    for tolerance in (True, math.inf, math.nan, "1"):
        with pytest.raises(CasacalError, match="The tolerance is"):
            verify(arm, fresh, tolerance=tolerance)
    strict, loose = (verify(arm, fresh, tolerance=0.05, risk=risk).decision for risk in (0.001, 0.2))
    assert strict.accept_below_mm < loose.accept_below_mm < 0.05 < loose.reject_above_mm < strict.reject_above_mm


# ------------------------------------------------------------------------------------------------ a real arm


@pytest.mark.long
def test_the_tracker_files_of_the_motoman_verify_it(motoman_data):
    """Both sets: as drawn what the paper's authors say, less noise; better after; accepted, undecided, rejected."""
    source = load_problem(ROOT / "problems" / "motoman_ma1400")
    problem = Problem(source.problem.robot, TrackedPoint(noise_std=0.02))
    contacts = source.problem.read(motoman_data / "contacts.csv")
    found = calibrate(source, contacts, method="lm", reference=False, discrepancy="none")
    published = {"tracker_free.csv": 0.246, "tracker_wall.csv": 0.224}
    for name in SETS:
        rows = problem.read(motoman_data / name)
        one = verify(found, rows, problem=problem)
        before, after, count = one.overall.before, one.overall.after, len(rows)
        plain = math.sqrt(published[name] ** 2 * 3 * count / (3 * count - 9) - 3 * 0.02**2)
        assert before.mm == pytest.approx(plain, rel=0.01)
        assert after.mm < before.low_mm
        assert after.mm == pytest.approx(0.175, abs=0.02)
        verdicts = [verify(found, rows, problem=problem, tolerance=t).decision.verdict for t in (0.3, after.mm, 0.1)]
        assert verdicts == ["accept", "undecided", "reject"]
        assert one.accuracy
        assert len([part for part in one.errors if part.kind == "region"]) == (4 if count > 48 else 0)


# ------------------------------------------------------------------------------------------------ page and command


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A calibration and fresh rows, in files."""
    folder, hsr = tmp_path_factory.mktemp("accepted"), str(ROOT / "problems" / "hsr_jr680")
    assert main(["simulate", hsr, "--out", str(folder / "all.csv"), "--samples", "150", "--seed", "21"]) == 0
    lines = (folder / "all.csv").read_text(encoding="utf-8").splitlines()
    start = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    for name, rows in (("fit", lines[start + 1 : start + 101]), ("fresh", lines[start + 101 :])):
        (folder / f"{name}.csv").write_text("\n".join([lines[start], *rows]) + "\n", encoding="utf-8")
    found = calibrate(hsr, folder / "fit.csv", method="lm", reference=False, discrepancy="none")
    found.save(folder / "out")
    return folder


def run(capsys, *arguments):
    code = main(["verify", *map(str, arguments)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_the_command_accepts_rejects_and_leaves_undecided(written, capsys):
    result, fresh = written / "out", written / "fresh.csv"
    measured = verify(result, fresh).overall.after.mm
    code, out, _ = run(capsys, result, fresh, "--tolerance", "0.05")
    assert (code, out.startswith("Promise kept, and accepted")) == (0, True)
    code, out, _ = run(capsys, result, fresh, "--tolerance", f"{measured:.6f}")
    assert (code, out.startswith("Promise kept, but undecided")) == (1, True)
    code, out, _ = run(capsys, result, fresh, "--tolerance", "0.05", "--risk", "0.01", "--json")
    document = json.loads(out)
    assert code == 0
    decision = document["decision"]
    assert (decision["verdict"], decision["risk"], decision["tolerance_mm"]) == ("accept", 0.01, 0.05)
    assert decision["guard_mm"] == pytest.approx(0.05 - decision["accept_below_mm"])
    assert document["errors"][0]["after"]["mm"] == pytest.approx(measured)
    assert {each["kind"] for each in document["errors"]} == {"all", "face", "region"}
    for arguments, says in (
        (("--risk", "0.1"), "Got --risk without --tolerance"),
        (("--tolerance", "0.05", "--risk", "5"), "The risk is 5.0"),
        (("--tolerance", "nan"), "The tolerance is nan"),
    ):
        code, out, err = run(capsys, result, fresh, *arguments)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert says in err


def test_the_page_is_whole_valid_and_says_what_the_command_says(written, capsys, tmp_path):
    place = tmp_path / "deeper" / "verified.html"
    code, *_ = run(capsys, written / "out", written / "fresh.csv", "--tolerance", "0.05", "--report", place)
    assert code == 0
    text = place.read_text(encoding="utf-8")
    page = Page(text)
    assert page.faults == []
    html5lib.HTMLParser(strict=True).parse(text)
    for name, attributes, _ in page.elements:
        assert not REFERENCES & set(attributes), name
    assert "<script" not in text
    found = verify(written / "out", written / "fresh.csv", tolerance=0.05)
    told = " ".join(page.text_of("words").split())
    assert told.removeprefix("In words ").startswith(" ".join(found.summary().split())[:60])
    heading, *rows = tables(text)["verified-errors"]
    assert heading[2:6] == ["As drawn, mm", "95 %", "As calibrated, mm", "95 %"]
    for row, part in zip(rows, found.errors, strict=True):
        each = (f"{error.mm:.4f} {error.low_mm:.4f} to {error.high_mm:.4f}" for error in (part.before, part.after))
        assert " ".join(row[1:]) == f"{part.rows} {' '.join(each)} {part.promised_mm:.4f}"
        assert row[0].endswith(part.label)
    places = picture_of(text)
    assert len(places) == 2 * len(found.errors)
    assert places == sorted_by_size(found)
    assert "Verified by fresh rows" in page.text_of("verified")
    assert "verdict good" in text
    assert list(place.parent.iterdir()) == [place]


def picture_of(text):
    """Order by size of the dots of the picture, before and after of each part."""
    drawing = text.partition('id="errors-picture"')[2].partition("</svg>")[0]
    across = [float(x) for x in re.findall(r'd="M([\d.]+) [\d.]+h\.1"', drawing)]
    return np.argsort(across, kind="stable").tolist()


def sorted_by_size(found):
    sizes = [error.mm for part in found.errors for error in (part.before, part.after)]
    return np.argsort(sizes, kind="stable").tolist()


def test_a_page_takes_the_place_of_nothing_that_is_needed(written, capsys):
    result, fresh = written / "out", written / "fresh.csv"
    before = {path: path.read_bytes() for path in [fresh, written / "fit.csv", *result.iterdir()]}
    for report in (fresh, written / "fit.csv", result / "result.json", result / "report.html", result, " "):
        code, out, err = run(capsys, result, fresh, "--report", report)
        assert (code, out, err.count("\n")) == (2, "", 1), report
    assert {path: path.read_bytes() for path in before} == before
    code, _, err = run(capsys, result, written / "fit.csv", "--report", written / "none.html")
    assert code == 2
    assert not (written / "none.html").exists()
    again = written / "again.html"
    assert [run(capsys, result, fresh, "--report", again)[0] for _ in range(2)] == [0, 0]


def test_what_names_hold_is_text_on_the_page(written):
    found = verify(written / "out", written / "fresh.csv", tolerance=0.05)
    names = dataclasses.replace(found.judged, samples="<script>alert(1)</script>&.csv", robot='"><b>arm')
    odd = dataclasses.replace(found, judged=names)
    page = Page(odd.page())
    assert page.faults == []
    assert page.all("script") == page.all("b") == []
    bare = dataclasses.replace(found, errors=(), decision=None)
    assert Page(bare.page()).faults == []
    assert "verified" not in [attributes.get("id") for _, attributes, _ in Page(bare.page()).elements]
