"""The answer of a program of one's own: judged, reported and exported as what `calibrate` finds."""

import casadi as ca
import numpy as np
import pytest

from casacal import CasacalError, bind, calibrate, load
from casacal.calibration import calibration_of
from casacal.calibration.verdict import verdict_of


@pytest.fixture(scope="module")
def bound(hsr, corner_simulation):
    return bind(hsr.problem, corner_simulation.samples)


def test_a_program_of_ones_own_is_judged_as_lm_is(bound, hsr, tmp_path):
    opti = ca.Opti()
    y = opti.variable(bound.unknowns)
    x = bound.symbolic.x0 + bound.symbolic.start_std * y
    opti.minimize(bound.symbolic.objective(x))
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
    found = calibration_of(bound, ca.DM(opti.solve().value(x)), method="opti")  # a column
    usual = calibrate(hsr, bound.samples[0], method="lm", noise="stated", outliers="keep", discrepancy="none")
    assert found.method == "opti"
    assert found.reference.agrees
    assert found.tip_std[1] == pytest.approx(usual.tip_std[1], rel=1e-5)
    assert verdict_of(found).level == verdict_of(usual).level
    found.save(tmp_path / "fit")
    found.report(tmp_path / "report.html")
    again = load(tmp_path / "fit")
    np.testing.assert_allclose(
        again.predict(bound.samples[0].joints).positions, usual.predict(bound.samples[0].joints).positions, atol=1e-5
    )


def test_a_wrong_answer_is_refused(bound):
    far = calibration_of(bound, bound.x0 + 3 * bound.start_std, method="guess")
    assert verdict_of(far).level == "do not use"
    assert np.isnan(far.tip_std[1])


def test_what_is_no_answer_is_said(bound):
    for x, sentence in (([1.0, 2.0], "has the shape"), (np.full(bound.unknowns, np.nan), "is not finite")):
        with pytest.raises(CasacalError, match=sentence):
            calibration_of(bound, x)
    with pytest.raises(CasacalError, match="Give what bind"):
        calibration_of(bound.problem, bound.x0)
