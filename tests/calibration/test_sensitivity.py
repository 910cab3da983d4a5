"""How the estimate follows readings and priors, against fits of moved data by SciPy, and what is said of it."""

import dataclasses

import numpy as np
import pytest
from conftest import ROOT
from scipy.optimize import least_squares

from casacal import CasacalError, calibrate, huber, load_problem
from casacal.calibration.summary import _most
from casacal.uncertainty.tip_error import tip_rms, without_rigid


def refitted(fit, start, *, prior=None, added=None, rows=None):
    """The minimum as SciPy finds it: with the prior's mean elsewhere, residuals added to, or other rows."""
    held = np.isfinite(fit.prior_std)
    mean, added = fit.x0 if prior is None else prior, 0.0 if added is None else added
    rows, scale = fit if rows is None else rows, fit.start_std

    def whole(u):
        x = start + scale * u
        return np.concatenate([rows.residual(x) + added, ((x - mean) / fit.prior_std)[held]])

    def slopes(u):
        own = np.diag(1 / fit.prior_std)[held]
        return np.vstack([rows.jacobian(start + scale * u), own]) * scale

    u = least_squares(whole, np.zeros(start.size), slopes, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    for _ in range(4):  # SciPy ends where its cost no longer falls, which is short of the last digits of x
        u = u - np.linalg.lstsq(slopes(u), whole(u), rcond=None)[0]
    return start + scale * u


@pytest.fixture(scope="module", params=["hsr_jr680", "ur5_three_instruments"])
def made(request):
    source = load_problem(ROOT / "problems" / request.param)
    calibration = calibrate(source, discrepancy="none", reference=False)
    # from the very minimum, so that differences show no leftover of the fit
    return calibration, refitted(calibration.fit, calibration.result.x)


def moved_rows(calibration, instrument, sample, column, by):
    """The fitted rows with one number of one row moved."""
    fit = calibration.fit
    sets = list(fit.samples)
    values = {name: np.array(each) for name, each in sets[instrument].columns.items()}
    values[column][sample] += by
    sets[instrument] = dataclasses.replace(sets[instrument], columns=values)
    return fit.on(*sets)


@pytest.mark.parametrize("which", [0.0, 0.4, 1.0])
def test_a_reading_moves_the_estimate_as_a_refit_does(made, which):
    calibration, x = made
    found, fit = calibration.sensitivity, calibration.fit
    k = round(which * (len(found.readings) - 1))
    place, column = found.readings[k]
    row = [fit.measured.place(j) for j in range(len(fit.measured))].index(place)
    instrument = int(np.searchsorted(fit.measured.starts, row, side="right")) - 1
    sample = row - int(fit.measured.starts[instrument])
    shift = 0.02
    ends = [refitted(fit, x, rows=moved_rows(calibration, instrument, sample, column, by)) for by in (shift, -shift)]
    expected = (ends[0] - ends[1]) / (2 * shift)
    assert np.abs(expected).max() > 0
    np.testing.assert_allclose(
        found.by_reading[:, k] / fit.start_std,
        expected / fit.start_std,
        rtol=0,
        atol=1e-4 * np.abs(expected / fit.start_std).max(),
    )


def test_readings_stand_as_in_the_file(made):
    calibration, _ = made
    places = [calibration.fit.measured.place(j) for j in range(len(calibration.fit.measured))]
    rows = [places.index(place) for place, _ in calibration.sensitivity.readings]
    assert rows == sorted(rows)


def test_a_priors_mean_moves_the_estimate_as_a_refit_does(made):
    calibration, x = made
    found, fit = calibration.sensitivity, calibration.fit
    assert found.names == fit.names
    for j in np.flatnonzero(np.isfinite(fit.prior_std))[::5]:
        away = fit.prior_std[j] * np.eye(fit.unknowns)[j]
        expected = (refitted(fit, x, prior=fit.x0 + away) - refitted(fit, x, prior=fit.x0 - away)) / (2 * away[j])
        scaled = expected * fit.start_std[j] / fit.start_std
        mine = found.by_prior[:, j] * fit.start_std[j] / fit.start_std
        np.testing.assert_allclose(mine, scaled, rtol=0, atol=1e-4 * np.abs(scaled).max())
    np.testing.assert_array_equal(found.by_prior[:, ~np.isfinite(fit.prior_std)], 0)


def test_the_tip_moves_as_a_refit_moves_it(made):
    calibration, x = made
    found, fit = calibration.sensitivity, calibration.fit
    joints, tips, _ = calibration.workspace

    def moved(one, other):
        return tip_rms(without_rigid((fit.tips(one, joints) - fit.tips(other, joints)).ravel(), tips))

    (line, tip), *_ = found.most(1)[0]
    row = found.rows.index(line)
    assert tip == found.tip_by_row.max() == found.tip_by_row[row]
    squares = 0.0
    for k in np.flatnonzero(fit.sample_of == row):
        added = 0.1 * np.eye(fit.rows)[k]
        squares += (moved(refitted(fit, x, added=added), refitted(fit, x, added=-added)) / 0.2) ** 2
    assert tip == pytest.approx(np.sqrt(squares), rel=1e-3)
    (name, tip), *_ = found.most(1)[1]
    j = fit.names.index(name)
    away = 0.1 * fit.prior_std[j] * np.eye(fit.unknowns)[j]
    ends = [refitted(fit, x, prior=fit.x0 + sign * away) for sign in (1, -1)]
    assert tip == pytest.approx(moved(*ends) / 0.2, rel=1e-3)


def test_squares_add_up_to_the_expected_tip_error(made):
    """Of the posterior covariance, which is worked out elsewhere and with Gauss and Newton's Hessian."""
    found = made[0].sensitivity
    total = np.sqrt((found.tip_by_row**2).sum() + (found.tip_by_prior**2).sum())
    assert total == pytest.approx(made[0].tip_std[1], rel=0.01)


def test_it_is_said_at_length(made):
    rows, priors = made[0].sensitivity.most()
    said = made[0].summary() if len(made[0].fit.samples) == 1 else _most(made[0])
    assert "What moves the tip most, by one standard deviation each:" in said
    assert f"rows: line {rows[0][0]} (" in said
    assert f"priors: {priors[0][0]} (" in said


def test_where_there_is_no_minimum_there_is_no_sensitivity(hsr):
    for options in ({"loss": huber()}, {"method": "plane-only"}, {"method": "ekf"}):
        made = calibrate(hsr.problem, hsr.samples, reference=False, discrepancy="none", **options)
        with pytest.raises(CasacalError, match=r"no minimum of the plain objective. Use lm or sckf-lm without a loss"):
            _ = made.unjudged.sensitivity
        assert _most(made.unjudged) == ""


def test_contacts_without_a_reading_have_rows_alone(hsr):
    from casacal import DialOnPlane, Problem, simulate

    contact = Problem(hsr.problem.robot, DialOnPlane(reading=False, noise_std=0.01))
    rows = simulate(contact, hsr.cell, samples=60, seed=1).samples
    found = calibrate(contact, rows, reference=False, discrepancy="none").unjudged.sensitivity
    assert (found.readings, found.by_reading.shape[1]) == ((), 0)
    assert (found.tip_by_row > 0).sum() > 50


def test_the_bound_on_rows_is_a_sentence(made, monkeypatch):
    from casacal.calibration import motion

    monkeypatch.setattr(motion, "MOST_EXACT", 100)
    calibration = made[0]
    with pytest.raises(CasacalError, match=r"rows with \d+ unknowns are too many for the sensitivity"):
        motion.sensitivity(calibration.fit, calibration.result, np.zeros((3, calibration.fit.unknowns)))
