"""The paper's fatal errata in pairs: as printed it fails, corrected it passes."""

import numpy as np
import pytest

from casacal.uncertainty.figures import residual_figures
from studies import as_printed


@pytest.fixture(scope="module")
def at():
    return as_printed.touches()


def test_e1_a3_in_metres(at):
    printed, corrected = as_printed.e1()
    assert printed > 5 * corrected
    assert corrected < 2


def test_e7_a_free_normal_is_an_exact_null_direction(at):
    printed, corrected = as_printed.e7(at)
    assert printed < 1e-14
    assert corrected > 1e-3


def test_e10_the_root_is_the_transpose():
    printed, corrected = as_printed.e10()
    assert printed > 0.1
    assert corrected < 1e-14


def test_e11_nobody_measures_the_parameters(at):
    printed, corrected = as_printed.e11(at)
    assert abs(printed) < 1
    assert abs(corrected - 900.32123) < 3


def test_e14_the_plus_sign_ascends(at):
    printed = np.array(as_printed.block_steps(at, 1.0, sign=1.0, joint=True, unit=True, iterations=20))[:, 1]
    corrected = np.array(as_printed.block_steps(at, 1.0, sign=-1.0, joint=True, unit=True, iterations=20))[:, 1]
    assert printed[-1] > 10 * printed[0]
    assert corrected[-1] < 0.5 * corrected[0]


@pytest.mark.parametrize("damping", [0.01, 0.1])
def test_e15_three_separate_steps_over_correct(at, damping):
    apart = as_printed.block_steps(at, damping, sign=-1.0, unit=True, iterations=50)
    together = as_printed.block_steps(at, damping, sign=-1.0, joint=True, unit=True, iterations=50)
    assert apart[-1][1] > apart[0][1]
    assert together[-1][1] < 0.5 * together[0][1]


def test_e16_the_normal_vanishes_and_the_distance_stays(at):
    path = as_printed.block_steps(at, 1.0, sign=-1.0, blocks=(2,), iterations=as_printed.VANISHING)
    assert path[-1][0] < 1e-20
    assert path[-1][1] > 0.9 * path[0][1]


def test_e17_and_e18_the_printed_figures_are_not_what_they_say():
    e = np.random.default_rng(0).normal(size=120)
    right = residual_figures(e)
    assert as_printed.printed_rmse(e) == pytest.approx(np.sqrt(120) * right["mae_mm"])
    assert right["rmse_mm"] == pytest.approx(np.sqrt(np.mean(e**2)))
    assert right["std_mm"] == pytest.approx(np.std(e))
    assert right["std_mm"] != pytest.approx(right["mae_mm"], rel=0.1)
