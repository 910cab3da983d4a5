"""Several instruments on one arm: a few false rows of one that all others fit to are named, and right ones are not."""

import dataclasses
from pathlib import Path
from typing import ClassVar

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from casacal import Instrument, Problem, bind, calibrate, check, lm, load_problem, simulate
from casacal.calibration.agreement import UNWEIGHTED, _least_expected, _own_noise, disagreement
from casacal.calibration.set_aside import gross
from casacal.calibration.verdict import verdict_of
from casacal.data.samples import Measurements
from casacal.errors import ProblemError
from casacal.uncertainty.tip_error import workspace_joints
from tests.three_instruments import CELL, COUNTS, problem

ROOT = Path(__file__).parent.parent.parent


class Total(Instrument):
    """The sum of two link lengths, as a drawing has it: an instrument of very few rows."""

    columns: ClassVar = {"total": "length"}
    residual_std = 0.02

    def residual(self, pose, p, row):
        return p.a[1] + p.a[2] - row.total


@pytest.fixture(scope="module")
def ur5():
    """An arm that was touched with a dial, and whose two links were measured together."""
    source = load_problem(ROOT / "problems" / "ur5")
    touches = simulate(source.problem, source.cell, seed=2)
    both = Problem(source.problem.robot, {"dial": source.problem.instrument, "total": Total()})
    bound = bind(source.problem, touches.samples)
    moved = dict(zip(bound.names, touches.truth(bound), strict=True))
    return both, touches, -425.0 - 392.25 + moved["a2"] + moved["a3"]


def totals(value, count=3):
    joints = {f"q{i}_deg": np.linspace(0, 2, count) for i in range(1, 7)}
    return pd.DataFrame({**joints, "total_mm": np.full(count, value)})


@pytest.mark.long_unless("0.02", "0.0")
@pytest.mark.parametrize("off", [0.0, 0.02, -0.7, 0.5])
def test_three_false_rows_that_agree_are_named_and_nothing_is_promised(ur5, off):
    both, touches, total = ur5
    found = calibrate(both, {"dial": touches.samples, "total": totals(total + off)}, reference=False)
    verdict = verdict_of(found)
    if abs(off) < 0.1:
        assert verdict.level == "calibrated"
        return
    assert verdict.level == "do not use"
    (reason,) = verdict.reasons
    assert "3 rows of total are not where dial expects them (p < 1e-06)" in reason
    by = float(reason.partition("would move the tip by ")[2].partition(" mm")[0])
    joints = workspace_joints(both.robot)
    tips = touches.true_tips(joints), found.bare.tips(lm(found.bare).x, joints)
    _, apart = Rotation.align_vectors(*(each - each.mean(axis=0) for each in tips))  # sqrt of the sum of squares
    assert by == pytest.approx(apart / np.sqrt(len(joints)), rel=0.15)
    (named,) = (each for each in check(both, found.fit.measured) if each.severity == "error")
    assert named.about == "instruments contradict each other"


def test_the_chance_is_that_of_the_others_prediction():
    """A group's residuals where the others predict them, by a fit without it and NumPy, against chi-square."""
    samples = simulate(problem, CELL, samples=COUNTS, seed=4).measured
    bound = bind(problem, *samples.sets)
    spike = problem.number("spike")
    off = dataclasses.replace(samples.sets[spike], joints=samples.sets[spike].joints + 4e-5)
    sets = [off if i == spike else some for i, some in enumerate(samples.sets)]
    moved = bound.on(*sets)
    chance, which = _least_expected(moved, lm(moved).x)
    name = problem.names[which]
    others = lm(moved.with_noise({each: UNWEIGHTED if each == name else 1.0 for each in problem.names}))
    rows, jacobian = moved.sample_rows(which), moved.jacobian(others.x)
    rest = np.delete(jacobian, np.arange(rows.start, rows.stop), 0)
    lost = np.isinf(moved.prior_std) & (np.abs(rest).max(axis=0) == 0)  # what its own rows alone know
    spread = np.linalg.inv(rest.T @ rest + moved.prior_information + 1e-9 * np.diag(lost / moved.start_std**2))
    left = moved.residual(others.x)[rows]  # at another minimum, so that the two differ by what is not linear
    square = left @ np.linalg.solve(jacobian[rows] @ spread @ jacobian[rows].T + np.eye(len(left)), left)
    assert np.log(chance) == pytest.approx(chi2(len(left) - lost.sum()).logsf(square), rel=0.05)


@pytest.mark.parametrize("few", [6, 8])
def test_one_false_row_among_few_is_named_as_it_is_set_aside(few):
    """Which a tracker alone does not show: six of its rows place it, and the dial's say where the arm is."""
    source = load_problem(ROOT / "problems" / "ur5_three_instruments")
    every = source.problem
    sets = [every.read(source.samples_of(i), i) for i in range(len(every.names))]
    tracked = sets[1].take(np.arange(0, 2 * few, 2))
    columns = {**tracked.columns, "z": tracked.columns["z"] + 2.0 * (np.arange(few) == 1)}
    sets[1] = dataclasses.replace(tracked, columns=columns)
    found = check(every, Measurements(every.names, tuple(sets)))
    (wrong,) = [each for each in found if each.severity == "error"]
    assert (wrong.about, wrong.instrument, wrong.lines) == ("outliers", "tracker", (tracked.lines[1],))
    bad, aside = gross(bind(every, *sets))
    assert np.flatnonzero(bad).tolist() == [len(sets[0]) + 1]
    assert aside == (wrong,)


@pytest.mark.parametrize("seed", range(3))
def test_right_instruments_agree(seed):
    samples = simulate(problem, CELL, samples=COUNTS, seed=seed).measured
    assert disagreement(bind(problem, *samples.sets)) == []
    waves = dataclasses.replace(CELL, gear_waves={1: 2e-4})
    rough = simulate(problem, waves, samples=COUNTS, seed=seed).measured
    bound = bind(problem, *rough.sets)
    assert disagreement(bound) == []  # what each errs by alone is no contradiction
    assert max(_own_noise(bound).values()) > 1.5


def test_flat_priors_that_no_row_replaces_are_refused_before_any_search(ur5):
    source = load_problem(ROOT / "problems" / "hsr_jr680")
    keys = source.problem.robot.parameters
    flat = source.problem.free(*keys).with_prior(dict.fromkeys(keys, float("inf")))
    with pytest.raises(ProblemError, match="nor a prior hold 5 combinations of parameters, so no fit ends"):
        calibrate(flat, source.samples)
    assert calibrate(source.problem.with_prior({"d2": float("inf"), "d3": float("inf")}), source.samples).success
