"""Many faces: their planes are unknowns like any other, up to a limit that is said."""

import dataclasses

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT

from casacal import bind, calibrate, lm, load, load_problem, simulate
from casacal.calibration.check import _few_of_each_face
from casacal.calibration.verdict import verdict_of
from casacal.effects.selection import with_effects
from casacal.errors import ProblemError
from casacal.fit.arm_alone import arm_alone
from casacal.fit.ipopt import Objective
from casacal.linalg import determined
from casacal.planning.cures import cures
from casacal.uncertainty.figures import leverages, noise_interval


@pytest.fixture(scope="module")
def samples(hsr):
    """Seven touches of each of 40 faces."""
    return by_face(simulate(hsr.problem, hsr.cell, samples=7 * 40, seed=3).samples, 7)


@pytest.fixture(scope="module")
def more(hsr):
    """Five touches of each of 100 faces."""
    return by_face(simulate(hsr.problem, hsr.cell, samples=5 * 100, seed=3).samples, 5)


def by_face(samples, rows):
    """The touches of a few large faces as those of many: so many rows each."""
    number, labels = {}, []
    for label in samples.labels["plane"]:
        number[label] = number.get(label, -1) + 1
        labels.append(f"{label}{number[label] // rows}")
    kept = [i for i, label in enumerate(labels) if labels.count(label) == rows]
    return dataclasses.replace(samples.take(kept), labels={"plane": tuple(labels[i] for i in kept)})


@pytest.mark.long
def test_ipopt_agrees_and_the_verdict_is_one_of_calibrated(hsr, more, tmp_path):
    made = calibrate(hsr.problem, more, method="lm")
    assert made.fit.unknowns > 300
    assert made.reference.agrees
    assert made.metrics["after"]["fit"]["rmse_mm"] < 0.011
    made.save(tmp_path)
    kept = load(tmp_path)
    joints = np.full((3, 6), 0.4)
    np.testing.assert_array_equal(kept.predict(joints).positions, made.predict(joints).positions)
    np.testing.assert_allclose(kept.predict(joints, std=True).std, made.predict(joints, std=True).std, rtol=1e-9)


def test_the_references_hessian_is_that_of_its_gradient(hsr, samples):
    """Of the Lagrangian, entry by entry, against central differences of gradients; what is not held is zero."""
    bound = bind(hsr.problem, samples)
    objective, rng = Objective(bound.graph, bound), np.random.default_rng(5)
    n, constraints = bound.graph.start.size, bound.graph.constraints
    y, multipliers = 0.1 * rng.normal(size=n), rng.normal(size=constraints.numel_out(0))
    v = ca.SX.sym("v", n)
    pull = ca.Function("pull", [v], [ca.jtimes(constraints(v), v, ca.DM(multipliers), True)])

    def gradient(at):
        return 0.7 * objective(at)[1] + objective.scales * np.asarray(pull(objective.raw(at))).ravel()

    found = np.zeros((n, n))
    found[objective.rows, objective.columns] = objective.lagrangian(y, 0.7, multipliers)
    found += np.triu(found, 1).T
    for j in rng.choice(n, 25, replace=False):
        step = 1e-5 * np.eye(n)[j]
        slope = (gradient(y + step) - gradient(y - step)) / 2e-5
        np.testing.assert_allclose(found[:, j], slope, atol=1e-5 * np.abs(slope).max())


def test_a_hundred_faces_are_fitted(hsr, more):
    bound = bind(hsr.problem, more)
    found = lm(bound)
    assert bound.unknowns > 300
    assert found.converged
    assert found.kkt < 1e-3
    assert noise_interval(found)[1] < 1 < noise_interval(found)[2]
    assert {cure.words.split(maxsplit=1)[1] for cure in cures(bound, found.x)} == {
        "more samples of the same kind",
        "samples at half the noise",
    }
    assert leverages(bound, found).sum() == pytest.approx(determined(found.information, bound.prior_rows), rel=1e-6)


def test_more_unknowns_than_one_problem_holds_are_refused_in_a_sentence(hsr):
    """Before their matrices are made: of 2,500 faces one alone would take half a gigabyte."""
    touches = simulate(hsr.problem, hsr.cell, samples=100, seed=3).samples.take(np.arange(10_000) % 100)
    labels = {"plane": tuple(f"face {k // 4}" for k in range(10_000))}
    with pytest.raises(ProblemError, match=r"^7,524 unknowns came, and a problem holds 2,000 at most\. Take .*--fix"):
        bind(hsr.problem, dataclasses.replace(touches, labels=labels))


def test_few_rows_of_many_faces_are_whole_faces(hsr):
    """The data check looks at 600 rows: of 300 faces of seven touches that is a dozen each, or none."""
    touches = by_face(simulate(hsr.problem, hsr.cell, samples=2100, seed=3).samples, 7)
    few = _few_of_each_face(hsr.problem, touches)
    counts = np.bincount(few.faces().codes)
    assert 300 <= len(few) <= 600
    assert set(counts.tolist()) == {7}
    one_face = dataclasses.replace(touches, labels={"plane": ("a",) * (len(touches) - 9) + ("b",) * 9})
    assert np.bincount(_few_of_each_face(hsr.problem, one_face).faces().codes).tolist() == [300, 9]


@pytest.mark.long
def test_dozens_of_faces_and_the_effects_of_any_arm():
    """60 faces have 204 unknowns, their forms 360 more: these decide nothing of how many there are."""
    source = load_problem(ROOT / "problems" / "hsr_jr680")
    faces = [dataclasses.replace(source.cell.faces[k % 3], label=f"face {k}", size=(200.0, 200.0)) for k in range(60)]
    samples = simulate(
        source.problem, dataclasses.replace(source.cell, faces=tuple(faces)), samples=420, seed=1
    ).samples
    found = calibrate(source.problem, samples, reference=False)
    assert any(found.fit.beside)
    assert found.fit.unknowns > 500
    assert verdict_of(found).level == "calibrated"
    assert found.tip_std[1] < 0.5 * found.tip_std[0]


def test_declared_effects_are_taken_out_with_their_own_priors(hsr, samples):
    """By the Schur complement; faces stand before effects, so that places among those kept are none in x."""
    from casacal.effects import GearRipple, GravitySag, kit

    effects = [each for each in kit() if not isinstance(each, (GearRipple, GravitySag))]
    bound = bind(hsr.problem.with_terms(*effects), samples)
    x = 0.1 * bound.start_std
    found = arm_alone(bound, x)[0]
    kept = found.free
    out = np.setdiff1d(np.arange(x.size), kept)
    scale = bound.start_std
    held = np.diag(np.where(np.isin(np.arange(x.size), out), np.diagonal(bound.prior_information), 0.0))
    dense = (bound.information(x) + held) * (scale[:, None] * scale)
    schur = dense[np.ix_(kept, kept)] - dense[np.ix_(kept, out)] @ np.linalg.solve(
        dense[np.ix_(out, out)], dense[np.ix_(out, kept)]
    )
    rows = found.compact_jacobian(x[kept]) * scale[kept]
    np.testing.assert_allclose(rows.T @ rows, schur, rtol=1e-6, atol=1e-6 * np.abs(schur).max())


def test_faces_that_are_held_are_not_given_forms_by_the_hundred(hsr):
    """200 faces have no unknown between them, and their forms would have 1,200."""
    touches = simulate(hsr.problem, hsr.cell, samples=100, seed=3).samples.take(np.arange(800) % 100)
    labels = {"plane": tuple(f"face {k // 4}" for k in range(800))}
    held = bind(hsr.problem.fix("plane"), dataclasses.replace(touches, labels=labels))
    assert held.unknowns == 24
    assert with_effects(held, held.problem) is held
