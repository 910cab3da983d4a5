"""What rows show beside the geometry: clean and faulty arms, errors of a dial, and what such an error does to a tip."""

import dataclasses
import json
import math

import numpy as np
import pytest
from scipy import stats

from casacal import Problem, bind, calibrate, check, dial_cycle, dial_gain, lm, simulate
from casacal.calibration.result_json import calibration_document
from casacal.calibration.summary import summary
from casacal.calibration.verdict import verdict_of
from casacal.effects import kit
from casacal.effects.selection import dial_errors, effect_sizes_of, with_effects
from casacal.effects.trusted import TrustedConstants, leverages
from casacal.files import jsonable
from casacal.kernels.losses import huber
from casacal.uncertainty.noise import found_noise
from casacal.uncertainty.tip_error import tip_rms, without_rigid, workspace_joints


def faulty(source, fault, seed):
    """120 touches of a simulated arm that does what its geometry does not say."""
    changes = {"play": {"backlash": 80e-6}, "form": {"flatness": 0.08}, "give": {"compliance": 1.5}}.get(fault, {})
    samples = simulate(source.problem, dataclasses.replace(source.cell, **changes), samples=120, seed=seed).samples
    reading = samples.columns["reading"]
    if fault.endswith("gain"):
        reading = reading / {"small gain": 1.0025, "large gain": 1.006}.get(fault, 1.004)
    if fault == "cycle":
        reading = reading - 0.012 * np.sin(2 * math.pi * reading + 1)
    if fault == "drift":
        reading = reading + np.linspace(0, 0.04, 120)
    return dataclasses.replace(samples, columns={"reading": reading})


def fitted(source, samples, problem=None):
    """Samples bound with noise and effects as found, and their fit."""
    problem = source.problem if problem is None else problem
    bound = bind(problem.without_terms, samples)
    bound = with_effects(bound.with_noise(found_noise(bound).scale), problem)
    result = lm(bound)
    assert result.converged
    return bound, result


@pytest.mark.long
def test_chances_of_clean_arms_lie_evenly(hsr):
    """Two tests of thirty arms: a test that is exact finds a tenth of them below a tenth."""
    chances = np.array(
        [error.chance for seed in range(30) for error in dial_errors(*_at(fitted(hsr, faulty(hsr, "", seed))))]
    )
    assert len(chances) == 60
    assert 0.35 < chances.mean() < 0.65
    assert (chances < 0.1).sum() <= 13


def _at(found):
    return found[0], found[1].x


@pytest.mark.parametrize("seed", [11, 12])
def test_clean_arms_show_nothing(hsr, seed):
    bound, result = fitted(hsr, faulty(hsr, "", seed))
    assert not [each.key for each in effect_sizes_of(bound, result.x) if each.shown]
    assert not [error.key for error in dial_errors(bound, result.x) if error.shown]


@pytest.mark.parametrize(
    ("fault", "size"), [("drift", 0.04 / math.sqrt(12)), ("play", 40e-6), ("form", None), ("give", None)]
)
def test_an_effect_of_the_arm_is_shown_and_no_error_of_the_dial(hsr, fault, size):
    bound, result = fitted(hsr, faulty(hsr, fault, 11))
    effects = effect_sizes_of(bound, result.x)
    assert [each.key for each in effects if each.shown] == [fault]
    assert effects[0].key == fault
    assert size is None or size / 3 < effects[0].size < 3 * size
    assert not [error.key for error in dial_errors(bound, result.x) if error.shown]


@pytest.mark.parametrize(("fault", "size"), [("gain", 0.4), ("cycle", 12.0)])
def test_an_error_of_the_dial_is_shown_with_its_size(hsr, fault, size):
    bound, result = fitted(hsr, faulty(hsr, fault, 11))
    shown = [error for error in dial_errors(bound, result.x) if error.shown]
    assert [error.key for error in shown] == [fault]
    assert shown[0].size == pytest.approx(size, rel=0.5)


def test_an_error_that_is_declared_is_not_tested(hsr):
    dial = dataclasses.replace(hsr.problem.instrument, gain=dial_gain(), cycle=dial_cycle())
    declared = Problem(hsr.problem.robot, dial)
    assert dial_errors(*_at(fitted(hsr, faulty(hsr, "", 1), declared))) == ()


def test_chance_and_size_are_those_of_a_second_fit(hsr):
    """The F test against its definition: one more unknown with a flat prior, and squares with and without."""
    bound, result = fitted(hsr, faulty(hsr, "small gain", 3))
    (found,) = [error for error in dial_errors(bound, result.x) if error.key == "gain"]
    samples = bound.block.samples
    reading, here = samples.columns["reading"], bound.plain_residual(result.x)
    slope = bound.on(_read(samples, reading + 1)).plain_residual(result.x) - here
    drawn = reading - bound.plain_residual(bound.x0) / slope
    column = slope * drawn / 100 / bound.noise
    prior = np.where(np.isfinite(bound.prior_std), 1 / bound.prior_std, 0.0)
    gain = bound.names.index("trusted_gain")  # which the test holds at zero, to ask for it without a prior
    slopes, away = bound.jacobian(result.x), result.x - bound.x0
    residual = bound.residual(result.x) - slopes[:, gain] * away[gain]
    slopes, prior, away = (np.delete(each, gain, axis=-1) for each in (slopes, prior, away))
    rows = np.vstack([slopes, np.diag(prior)])
    right = -np.concatenate([residual, prior * away])
    more = np.column_stack([rows, np.concatenate([column, np.zeros(len(prior))])])
    solution = np.linalg.lstsq(more, right, rcond=None)[0]
    without = float(((rows @ np.linalg.lstsq(rows, right, rcond=None)[0] - right) ** 2).sum())
    rest = float(((more @ solution - right) ** 2).sum())
    freedom = bound.rows - int((prior == 0).sum()) - 1
    assert found.size == pytest.approx(abs(solution[-1]), rel=1e-4)
    assert found.chance == pytest.approx(stats.f.sf((without - rest) / (rest / freedom), 1, freedom), rel=1e-3)


def _read(samples, reading):
    return dataclasses.replace(samples, columns={"reading": reading})


def test_what_a_wrong_gain_does_to_the_tip(hsr):
    """A fit to rows with another gain, by hand."""
    exact = hsr.problem.with_terms(*(each for each in kit() if not isinstance(each, TrustedConstants)))
    bound, result = fitted(hsr, faulty(hsr, "gain", 2), exact)
    samples, joints = bound.block.samples, workspace_joints(hsr.problem.robot)
    tips = bound.tips(result.x, joints)
    changed = bound.on(_read(samples, samples.columns["reading"] * 1.0001))
    moved = bound.tips(lm(changed, start=result.x).x, joints) - tips
    by_hand = tip_rms(without_rigid(moved.ravel(), tips)) / 0.01
    (found,) = [error for error in dial_errors(bound, result.x) if error.key == "gain"]
    assert found.tip_mm / found.size == pytest.approx(by_hand, rel=0.05)
    bound, result = fitted(hsr, faulty(hsr, "gain", 2))
    (doubted,) = [error for error in dial_errors(bound, result.x) if error.key == "gain"]
    assert doubted.size == pytest.approx(found.size, rel=0.05), "a prior in the fit does not hide it"
    (worth,) = [each for each in leverages(bound, result) if each.name == "gain"]
    assert worth.tip_mm == pytest.approx(0.15 * by_hand, rel=0.05)


@pytest.mark.long
def test_a_calibration_says_it(hsr, tmp_path):
    samples = faulty(hsr, "drift", 11)
    found = calibrate(hsr, samples, method="lm", reference=False)
    assert found.effect_sizes[0].key == "drift"
    listed = jsonable(calibration_document(found))["discrepancy"]["effects"]
    assert [each["key"] for each in listed] == [each.key for each in found.effect_sizes]
    assert listed[0]["shown"] is True
    dial = calibration_document(found)["dial_errors"]
    assert [(each["key"], each["shown"]) for each in dial] == [(each.key, each.shown) for each in found.dial_errors]
    assert dial
    assert json.dumps(listed, allow_nan=False)
    told = summary(found, "hsr").split("Errors beside the geometry")[1]
    assert "Drift" in told.splitlines()[2]
    found.report(tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count(">Drift<") == 1
    assert 'id="beside"' in page
    for options in ({"discrepancy": "none"}, {"loss": huber()}):
        without = calibrate(hsr, samples, method="lm", reference=False, **options)
        assert without.effect_sizes == without.dial_errors == ()
        assert calibration_document(without)["dial_errors"] == []


def test_a_calibration_warns_of_a_dial_that_is_off(hsr):
    small, large = (calibrate(hsr, faulty(hsr, f"{how} gain", 11), reference=False) for how in ("small", "large"))
    for found in (small, large):
        assert [error.key for error in found.dial_errors if error.shown] == ["gain"]
    assert any("gain of the dial" in reason for reason in verdict_of(large).reasons)
    assert verdict_of(small).level == "calibrated", "its prior covers it"


@pytest.mark.parametrize(("fault", "fix"), [("small gain", "dial_gain(0.15)"), ("form", "Clean the faces")])
def test_check_warns_of_it(hsr, fault, fix):
    found = [each for each in check(hsr.problem, faulty(hsr, fault, 11)) if fix in each.fix]
    assert len(found) == 1
    assert found[0].severity == "warning"
    assert "most likely size" in found[0].cause


def test_check_is_silent_of_clean_arms_and_beside_errors(hsr):
    assert {each.severity for each in check(hsr.problem, faulty(hsr, "", 11))} == {"remark"}
    wrong = faulty(hsr, "gain", 11)
    for more, said in ((1.002, "gain of the dial"), (1.006, "scale of the readings")):  # the latter moves lengths, too
        samples = dataclasses.replace(wrong, columns={"reading": wrong.columns["reading"] / more})
        assert [each.about for each in check(hsr.problem, samples) if each.severity != "remark"] == [said]


@pytest.mark.long_unless("0", "2")
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_touches_that_were_programmed_to_one_depth_show_no_gain(hsr, seed):
    """Where the drawn arm would read 5 mm everywhere, what is read is the arm's error, which a gain would explain."""
    cell = dataclasses.replace(hsr.cell, error_scale=0.0, repeatability=1e-9, travel=1e-6)
    made = simulate(hsr.problem, cell, samples=120, seed=seed).samples
    rng, level = np.random.default_rng(seed), np.full(120, 5.0)
    bound = bind(hsr.problem, _read(made, level))
    x = rng.normal(size=bound.unknowns) * np.where(np.isfinite(bound.prior_std), bound.prior_std, 0.0)
    here = bound.plain_residual(x)
    deeper = bound.on(_read(made, level + 1)).plain_residual(x)
    read = level - here / (deeper - here) + 0.01 * rng.normal(size=120)
    assert 0.05 < np.std(read) < 3
    samples = _read(made, read)
    gain = {error.key: error for error in dial_errors(*_at(fitted(hsr, samples)))}.get("gain")
    assert gain is None or not gain.shown
    found = calibrate(hsr, samples, reference=False)
    assert verdict_of(found).level == "calibrated"
