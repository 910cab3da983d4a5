"""A dial that shows too much of every way, or errs with every turn: what geometry absorbs has to be declared."""

import dataclasses
import json
import math

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT
from robots_of_others import UR5_CSV

from casacal import (
    DialOnBody,
    DialOnPlane,
    Problem,
    bind,
    calibrate,
    dial_cycle,
    dial_gain,
    ipopt,
    lm,
    load,
    load_problem,
    simulate,
    tool_point,
    verify,
)
from casacal.calibration.verdict import verdict_of
from casacal.cli.main import main
from casacal.errors import ProblemError
from casacal.uncertainty.tip_error import tip_rms, without_rigid, workspace_joints


def declaring(problem, gain=None, cycle=None, turn=1.0):
    """The same arm, its dial declared to err."""
    return Problem(problem.robot, dataclasses.replace(problem.instrument, gain=gain, cycle=cycle, turn=turn))


def shown_by(samples, percent=0.0, micrometres=0.0, turn=1.0):
    """Samples of a perfect dial as one shows them that errs: reading r' with r' (1 + g) + c sin(2 pi r' / turn) = r."""
    true = samples.columns["reading"]
    shown = true.copy()
    for _ in range(50):
        wave = micrometres / 1000 * np.sin(2 * math.pi * shown / turn)
        shown = (true - wave) / (1 + percent / 100)
    return dataclasses.replace(samples, columns={"reading": shown})


def tip_error(calibration, simulated):
    """Of the calibrated arm over the workspace against the true one, mm RMS, apart from the pose of the base."""
    joints, bound = workspace_joints(simulated.problem.robot), bind(simulated.problem, simulated.samples)
    true = bound.tips(simulated.truth(bound), joints)
    return tip_rms(without_rigid((calibration.fit.tips(calibration.x, joints) - true).ravel(), true))


@pytest.mark.parametrize("folder", ["hsr_jr680", "ur5", "adept_cobra600"])
def test_a_declared_error_is_undone_by_its_truth(folder):
    """Residuals of what an erring dial shows, at its true gain and wave, are those of a perfect dial."""
    source = load_problem(ROOT / "problems" / folder)
    samples = source.problem.read(source.samples)
    errs = declaring(source.problem, dial_gain(0.2), dial_cycle(4.0), turn=0.5)
    bound, plain = bind(errs, shown_by(samples, 0.3, 5.0, 0.5)), bind(source.problem, samples)
    x = np.random.default_rng(0).normal(size=plain.unknowns) * np.minimum(plain.prior_std, 1e-3)
    own = {"gain": 0.3, "cycle_cos": 0.0, "cycle_sin": 5.0}
    values = dict(zip(plain.names, x, strict=True)) | own
    # planes are proposed anew from what the dial shows, so that a plane stands elsewhere at the same coordinates
    slots = {slot.name: slot.nominal for slot in plain.slots}
    moved = [dataclasses.replace(s, nominal=slots.get(s.name, s.nominal)) for s in bound.slots]
    there = type(bound)(errs, moved, bound.samples)
    at = np.array([values[name] for name in there.names])
    np.testing.assert_allclose(there.plain_residual(at), plain.plain_residual(x), atol=2e-9)


@pytest.mark.long
def test_a_gain_that_is_declared_no_longer_ruins_the_arm(hsr):
    """Half a percent, three times what was declared: trusted, it is absorbed without a trace; declared, it is found."""
    errors = {"trusting": [], "doubted": [], "declared": []}
    declared = declaring(hsr.problem, dial_gain(0.15))
    for seed in range(6):
        simulated = simulate(hsr.problem, hsr.cell, seed=seed)
        samples = shown_by(simulated.samples, 0.5 * (-1) ** seed)
        ways = (hsr.problem, "none"), (hsr.problem, "kit"), (declared, "kit")
        for name, (problem, way) in zip(errors, ways, strict=True):
            found = calibrate(problem, samples, reference=False, discrepancy=way)
            errors[name].append(tip_error(found, simulated) / found.unjudged.tip_std[1])
    assert np.sqrt(np.mean(np.square(errors["trusting"]))) > 4
    for name in ("doubted", "declared"):
        assert np.sqrt(np.mean(np.square(errors[name]))) < 1.3


def test_estimators_and_the_reference_agree_on_it(hsr):
    samples = shown_by(simulate(hsr.problem, hsr.cell, seed=3).samples, 0.1, 3.0)
    bound = bind(declaring(hsr.problem, dial_gain(), dial_cycle()), samples)
    one, other = lm(bound), ipopt(bound)
    assert one.cost == pytest.approx(other.cost, rel=1e-9)
    spread = np.sqrt(np.diagonal(one.covariance))
    assert np.abs((one.x - other.x) / np.where(np.isfinite(spread), spread, 1)).max() < 1e-4
    sine = bound.names.index("cycle_sin")
    assert abs(one.x[sine] - 3.0) < 3 * spread[sine]
    assert spread[sine] < 2.0


def test_a_simulated_cell_draws_what_the_dial_gets_wrong(hsr):
    """Its truth holds gain and wave, drawn from their priors, and the tip it lands with has them."""
    errs = declaring(hsr.problem, dial_gain(0.15), dial_cycle(3.0))
    drawn = []
    for seed in range(30):
        simulated = simulate(errs, hsr.cell, samples=4 if seed else 120, seed=seed)
        drawn.append(np.concatenate([simulated.local["gain"], simulated.local["cycle"]]))
        if not seed:
            bound = bind(errs, simulated.samples)
            assert np.sqrt(np.mean(bound.residual(simulated.truth(bound)) ** 2)) == pytest.approx(1, abs=0.2)
    sizes = np.sqrt(np.mean(np.square(drawn), axis=0)) / [0.15, 3.0, 3.0]
    assert (np.abs(np.log(sizes)) < 0.45).all()


@pytest.mark.long
def test_a_result_remembers_it_and_fresh_rows_of_that_dial_are_expected(tmp_path):
    source = load_problem(ROOT / "problems" / "ur5")
    errs = declaring(source.problem, dial_gain(0.15), dial_cycle())
    simulated = simulate(errs, source.cell, samples=200, seed=4)
    fitted, fresh = (simulated.samples.take(rows) for rows in (range(120), range(120, 200)))
    calibrate(errs, fitted, reference=False).save(tmp_path)
    assert load(tmp_path).arm.source.problem == errs
    kept = json.loads((tmp_path / "result.json").read_text())["parameters"]
    (row,) = (row for row in kept if row["name"] == "gain")
    assert (row["unit"], row["nominal"]) == ("%", 0.0)
    assert 0 < row["std"] < 0.15
    assert verify(tmp_path / "result.json", fresh).kept


@pytest.mark.long
def test_figures_say_whom_they_trust(hsr, corner_simulation):
    trusting = verdict_of(calibrate(hsr.problem, corner_simulation.samples, reference=False))
    assert "priors and the dial's gain within 0.15 % are right" in trusting.words
    declared = calibrate(declaring(hsr.problem, dial_gain()), corner_simulation.samples, reference=False)
    assert "the dial's gain" not in verdict_of(declared).words
    assert "the dial's gain" not in declared.summary()


def test_what_is_no_such_error_is_refused(hsr):
    with pytest.raises(ProblemError, match="without a dial"):
        DialOnPlane(noise_std=0.01, reading=False, gain=dial_gain())
    for turn in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ProblemError, match="turn of the pointer"):
            DialOnPlane(noise_std=0.01, turn=turn)
    for std in (0.0, -0.1, math.nan):
        with pytest.raises(ProblemError):
            dial_gain(std)


def test_a_body_with_certified_angles_has_a_dial_too():
    dial = DialOnBody(
        noise_std=0.01, gain=dial_gain(), normals={"floor": (0, 0, 1), "wall": (-1, 0, 0)}, tool=tool_point()
    )
    assert "gain" in dial.unknowns
    held = Problem(load_problem(ROOT / "problems" / "hsr_jr680").problem.robot, dial).fix("gain")
    assert held.instrument.unknowns["gain"].size == 0
    tip = dial.tip(ca.SX.eye(4), type("P", (), {"tool": ca.DM.zeros(3), "plunger": ca.DM([0, 0, 1]), "gain": 1.0}),
                   type("Row", (), {"reading": 5.0}))  # fmt: skip
    assert float(ca.DM(tip)[2]) == pytest.approx(5.05)


def test_a_new_problem_does_not_trust_its_dial(tmp_path, capsys):
    """Who says nothing of the dial gets one of its class; the file runs, and says so."""
    (tmp_path / "arm.csv").write_text(UR5_CSV)
    assert main(["new", "mine", "--dh", str(tmp_path / "arm.csv"), "--out", str(tmp_path)]) == 0
    capsys.readouterr()
    text = (tmp_path / "mine" / "problem.py").read_text()
    assert "gain=dial_gain(0.15)" in text
    assert "0.15 % too much or too little" in text
    gain = load_problem(tmp_path / "mine").problem.instrument.unknowns["gain"]
    assert gain.prior_stds.tolist() == [0.15]
