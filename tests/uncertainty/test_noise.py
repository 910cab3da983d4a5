"""The noise in use is at least what was stated, and what the rows show; its interval means what it says."""

import dataclasses
import json
import math

import numpy as np
import pytest
from conftest import ROOT

from casacal import CasacalError, Problem, bind, calibrate, huber, lm, simulate
from casacal.calibration.brief import next_step
from casacal.calibration.summary import summary
from casacal.calibration.verdict import verdict_of
from casacal.cli.main import main
from casacal.data.columns import Labels
from casacal.data.repeats import copies_of
from casacal.data.samples import Samples, write_samples
from casacal.fit import LeastSquares
from casacal.linalg import determined
from casacal.uncertainty.figures import effective_unknowns, leverages, noise_interval
from casacal.uncertainty.noise import found_noise

HSR = ROOT / "problems" / "hsr_jr680"


def stating(problem, noise_std):
    return Problem(problem.robot, dataclasses.replace(problem.instrument, noise_std=noise_std))


def touched(hsr, seed, **changes):
    return simulate(hsr.problem, dataclasses.replace(hsr.cell, **changes), samples=240, seed=seed).samples


class Rows(LeastSquares):
    """y = A x + noise, whitened, with a prior of which some standard deviations may be infinite."""

    def __init__(self, matrix, seen, prior_std):
        self.matrix, self.seen = matrix, seen
        self.names = tuple(f"x{j}" for j in range(matrix.shape[1]))
        self.units = ("mm",) * matrix.shape[1]
        self.x0, self.prior_std = np.zeros(matrix.shape[1]), prior_std
        self.start_std, self.datum = np.where(np.isfinite(prior_std), prior_std, 1.0), np.zeros(matrix.shape[1], bool)

    @property
    def rows(self):
        return len(self.matrix)

    def residual(self, x):
        return self.matrix @ x - self.seen

    def jacobian(self, x):
        return self.matrix

    def row(self, k, states):
        return states @ self.matrix[k] - self.seen[k]

    def row_jacobian(self, k, x):
        return float(self.matrix[k] @ x - self.seen[k]), self.matrix[k]


def drawn(rng, *, dull=0):
    """A problem of 40 rows and 9 unknowns, drawn from its own prior; `dull` flat unknowns are seen by no row."""
    prior_std = np.where(rng.random(9) < 0.5, np.inf, 10.0 ** rng.uniform(-2, 2, 9))
    matrix = rng.normal(size=(40, 9)) * 10.0 ** rng.uniform(-1, 1, 9)
    matrix[:, :dull], prior_std[:dull] = 0.0, np.inf
    truth = np.where(np.isfinite(prior_std), prior_std, 100.0) * rng.normal(size=9)
    return Rows(matrix, matrix @ truth + rng.normal(size=40), prior_std)


@pytest.mark.long_unless("0")
@pytest.mark.parametrize("dull", [0, 2])
def test_the_interval_covers_one_in_95_of_100_under_any_mix_of_priors(dull):
    """1,000 draws: 95 % +- 2; beyond 1.4 % a nominal 95 % misses with a chance of 5 %."""
    rng = np.random.default_rng(7)
    intervals = np.array([noise_interval(lm(drawn(rng, dull=dull))) for _ in range(1000)])
    inside = float(((intervals[:, 1] <= 1) & (intervals[:, 2] >= 1)).mean())
    assert 0.93 <= inside <= 0.97
    assert float((intervals[:, 0] ** 2).mean()) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("seed", range(20))
def test_effective_unknowns_are_the_trace_of_the_hat_matrix(seed):
    rng = np.random.default_rng(seed)
    problem = drawn(rng, dull=seed % 3)
    information = problem.matrix.T @ problem.matrix
    hat = problem.matrix @ np.linalg.pinv(information + problem.prior_information, rcond=1e-14) @ problem.matrix.T
    assert effective_unknowns(problem, problem.x0) == pytest.approx(np.trace(hat), abs=1e-6)
    assert determined(information, problem.prior_rows) == pytest.approx(np.trace(hat), abs=1e-6)


@pytest.mark.long_unless("names0", "names1", "names2")
@pytest.mark.parametrize("names", [(), ("d",), ("a", "d"), ("alpha", "a", "d", "theta")])
def test_leverages_sum_to_the_effective_unknowns_under_flat_priors(hsr, corner_simulation, names):
    """The clean samples; with all lengths flat, variances of 1e12 mm^2 stand in the covariance."""
    problem = hsr.problem.with_prior(dict.fromkeys(names, np.inf))
    bound = bind(problem, corner_simulation.samples)
    for loss in (None, huber()):
        result = lm(bound, loss=loss)
        pulled = leverages(bound, result)
        assert pulled.sum() == pytest.approx(effective_unknowns(bound, result.x, loss), abs=1e-6)
        assert 24 < pulled.sum() < 32
        assert noise_interval(result)[0] == pytest.approx(1.0, abs=0.15)


@pytest.mark.long_unless("0.002")
@pytest.mark.parametrize("stated", [0.002, 0.01, 0.03])
def test_what_is_used_does_not_depend_on_what_was_stated_if_that_was_too_little(hsr, stated):
    samples = touched(hsr, 4, repeatability=0.05)
    right = calibrate(stating(hsr.problem, 0.05), samples, reference=False, noise="stated")
    found = calibrate(stating(hsr.problem, stated), samples, reference=False)
    assert found.fit.block.noise == pytest.approx(right.fit.block.noise, rel=0.1)
    assert found.noise.ratio * stated == pytest.approx(0.05, rel=0.1)
    assert found.noise.low * stated < 0.05 < found.noise.high * stated
    assert np.abs((found.x - right.x) / right.result.std).max() < 0.15
    np.testing.assert_allclose(found.result.std, right.result.std, rtol=0.12)
    assert noise_interval(found.result)[0] == pytest.approx(1.0, abs=0.01)


def test_less_noise_than_stated_is_not_believed(hsr, corner_simulation):
    found = calibrate(stating(hsr.problem, 0.05), corner_simulation.samples, reference=False)
    assert dict(found.noise.scale) == {}
    assert found.noise.high < 0.5
    np.testing.assert_array_equal(found.fit.block.noise, found.fit.with_noise({}).block.noise)


@pytest.mark.long
def test_stated_noise_is_trusted_where_that_is_asked(hsr, capsys, tmp_path):
    samples = touched(hsr, 4, repeatability=0.05)
    trusted = calibrate(hsr.problem, samples, reference=False, noise="stated", discrepancy="none")
    np.testing.assert_array_equal(trusted.fit.block.noise, trusted.fit.with_noise({}).block.noise)
    assert trusted.noise.ratio > 3
    write_samples(tmp_path / "s.csv", hsr.problem.layout(), samples, [])
    told = {}
    for noise in ("stated", "found"):
        main(
            [
                "calibrate",
                str(HSR),
                str(tmp_path / "s.csv"),
                "--noise",
                noise,
                "--json",
                "--no-reference",
                "--discrepancy",
                "none",
            ]
        )
        told[noise] = json.loads(capsys.readouterr().out)
    used = {
        noise: [face["used_mm"] for face in document["noise"]["by_face"].values()] for noise, document in told.items()
    }
    assert max(used["stated"]) <= 0.01
    assert np.divide(used["found"], used["stated"]) == pytest.approx([5.0] * 3, rel=0.1)
    assert told["found"]["tip"]["expected_rms_mm"] > 1.5 * told["stated"]["tip"]["expected_rms_mm"]
    with pytest.raises(CasacalError, match="'found' or 'stated'"):
        calibrate(hsr.problem, samples, noise="low")


def test_a_face_that_is_worse_than_others_gets_its_own_noise(hsr):
    samples = touched(hsr, 5)
    worse = samples.faces().rows()["wall"]
    rng, ((name, readings),) = np.random.default_rng(0), samples.columns.items()
    shaken = np.array(readings)
    shaken[worse] += 0.08 * rng.normal(size=len(worse))
    samples = dataclasses.replace(samples, columns={name: shaken})
    noise = found_noise(bind(hsr.problem, samples))
    assert noise.scale["wall"] == pytest.approx(8.0, rel=0.15)
    assert max(noise.scale["floor"], noise.scale["side"]) < 1.2
    # and is what residuals of its rows say, over their number less what the fit took up, by dense matrices
    again = bind(hsr.problem, samples).with_noise(noise.scale)
    x = lm(again).x
    jacobian, prior = again.jacobian(x), 1 / again.prior_std**2
    taken = np.einsum("ij,ji->i", jacobian, np.linalg.solve(jacobian.T @ jacobian + np.diag(prior), jacobian.T))
    square = (again.residual(x)[worse] ** 2).sum() / (len(worse) - taken[worse].sum())
    assert square == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("seed", range(8))
def test_faces_alike_have_their_noise_in_common(hsr, seed):
    noise = found_noise(bind(hsr.problem, touched(hsr, seed, repeatability=0.03)))
    assert list(noise.scale) == [""]
    assert noise.scale[""] == pytest.approx(3.0, rel=0.15)


def test_held_out_rows_are_judged_by_the_same_noise(hsr):
    found = calibrate(hsr.problem, touched(hsr, 6, repeatability=0.05), holdout=0.3, reference=False)
    plain = found.heldout.with_noise({}).block.noise
    np.testing.assert_allclose(found.heldout.block.noise, found.noise.scale[""] * plain)
    white = found.heldout.residual(found.x)
    assert math.sqrt(float((white**2).mean())) == pytest.approx(1.1, abs=0.25)


def test_a_robust_fit_does_not_take_gross_rows_for_noise(hsr):
    samples = touched(hsr, 7)
    ((name, readings),) = samples.columns.items()
    gross = np.array(readings)
    gross[::20] += 1.0
    noise = found_noise(bind(hsr.problem, dataclasses.replace(samples, columns={name: gross})), huber())
    assert noise.ratio < 1.6
    assert found_noise(bind(hsr.problem, dataclasses.replace(samples, columns={name: gross}))).ratio > 10


def test_no_alarm_over_flat_and_finite_priors(hsr, corner_simulation):
    """Clean samples under 25 random mixes: none is said to hold more noise than stated."""
    rng, lengths = np.random.default_rng(1), [f"{key}{k}" for key in "ad" for k in range(1, 7)]
    angles = [f"{key}{k}" for key in ("alpha", "theta") for k in range(1, 7)]
    for _ in range(25):
        some = rng.choice(lengths + angles, rng.integers(1, 12), replace=False)
        noise = found_noise(bind(hsr.problem.with_prior(dict.fromkeys(some, np.inf)), corner_simulation.samples))
        assert noise.low < 1.1
        assert noise.ratio < 1.2


def repeated(hsr, seed, *, times, shared, own):
    """Each of 120 postures touched several times: an error that repeats share, one of each touch, mm."""
    cell = dataclasses.replace(hsr.cell, repeatability=0.0, resolution=0.0)
    simulation = simulate(hsr.problem, cell, seed=seed)
    rng, rows = np.random.default_rng(seed), np.repeat(np.arange(120), times)
    touches = simulation.samples.take(rows)
    errors = np.repeat(rng.normal(0, shared, 120), times) + rng.normal(0, own, 120 * times)
    columns = {**touches.columns, "reading": touches.columns["reading"] + errors}
    return simulation, dataclasses.replace(touches, columns=columns, lines=tuple(range(2, 2 + len(rows))))


@pytest.mark.long
def test_repeats_tell_pure_error_and_count_as_little_more_than_one_touch(hsr):
    """As much is known as from one touch of each posture with the noise of a mean, which a fit of these says."""
    found, told = [], []
    for seed in range(4):
        simulation, samples = repeated(hsr, seed, times=3, shared=0.03, own=0.01)
        calibration = calibrate(hsr.problem, samples, method="lm", reference=False, discrepancy="none")
        again = calibration.noise.repeats
        assert (again.places, again.chance < 1e-6) == (120, True)
        assert again.low < 1 < again.high
        found.append((again.ratio, again.shared, calibration.noise.ratio))
        once = calibrate(stating(hsr.problem, math.sqrt(0.03**2 + 0.01**2 / 3)), simulation.samples, noise="stated",
                         method="lm", reference=False, discrepancy="none")  # fmt: skip
        told.append(calibration.tip_std[1] / once.tip_std[1])
        verdict = verdict_of(calibration)
        assert verdict.level == "use with care"
        assert any("Repeated touches at 120 places" in reason for reason in verdict.reasons)
    np.testing.assert_allclose(np.mean(found, axis=0), [1.0, 0.9, math.sqrt(10)], rtol=0.05)
    assert np.mean(told) == pytest.approx(1.0, rel=0.03)


def test_repeats_of_an_arm_that_is_as_modelled_count_in_full(hsr):
    chances = []
    for seed in range(12):
        _, samples = repeated(hsr, seed, times=2, shared=0.0, own=0.01)
        found = found_noise(bind(hsr.problem, samples))
        chances.append(found.repeats.chance)
        assert found.repeats.shared == 0 or found.repeats.chance < 0.01
    ranks = np.sort(chances) - (np.arange(12) + 0.5) / 12
    assert np.abs(ranks).max() < 1.63 / math.sqrt(12)  # Kolmogorov and Smirnov, 1 %


@pytest.mark.long_unless("rows1")
@pytest.mark.parametrize("rows", [np.repeat(np.arange(120), 3), np.append(np.arange(120), [5, 17, 17, 90])])
def test_copied_rows_count_once(hsr, corner_simulation, rows):
    """Nothing depends on how often rows were pasted, and they are no pure error: no F, and no cause of one."""
    samples = corner_simulation.samples.take(rows)
    copied = dataclasses.replace(samples, lines=tuple(range(2, 2 + len(rows))))
    once, often = (calibrate(hsr.problem, some, reference=False) for some in (corner_simulation.samples, copied))
    assert (once.copies, often.copies) == (0, len(rows) - 120)
    np.testing.assert_array_equal(often.x, once.x)
    assert often.tip_std == once.tip_std
    assert (often.noise.ratio, often.noise.repeats) == (once.noise.ratio, None)
    verdict = verdict_of(often)
    (reason,) = verdict.reasons
    assert "the same joints and readings" in reason
    assert verdict.level == "use with care"
    if len(rows) == 124:
        assert "(lines 122, 123, 124, 125)" in reason
        assert next_step(often, verdict).startswith("remove the copies")
        assert "124 samples of" in summary(often, "")
        assert "120 fitted, none held out, 4 copies left out" in summary(often, "")


def test_copies_of_repeats_are_no_pure_error(hsr):
    """Touches that were repeated scatter as they do, however many of their rows were pasted besides."""
    _, samples = repeated(hsr, 0, times=2, shared=0.03, own=0.01)
    pasted = samples.take(np.append(np.arange(240), np.arange(0, 240, 3)))
    pasted = dataclasses.replace(pasted, lines=tuple(range(2, 2 + len(pasted))))
    told = [calibrate(hsr.problem, some, method="lm", reference=False).noise.repeats for some in (samples, pasted)]
    assert told[0] == told[1]
    assert told[0].low < 1 < told[0].high


def test_repeats_that_do_not_scatter_tell_nothing_of_scatter(hsr, corner_simulation):
    copied = corner_simulation.samples.take(np.repeat(np.arange(120), 2))
    assert found_noise(bind(hsr.problem, copied)).repeats is None


@pytest.mark.parametrize("collide", [False, True])
def test_copies_are_the_same_to_the_last_digit_and_on_the_same_face(corner_simulation, collide, monkeypatch):
    if collide:  # one number for all rows: then values alone tell, of copies of the first row
        monkeypatch.setattr("casacal.data.repeats._keys", lambda count, _: np.zeros(count, dtype=np.int64))
    samples = corner_simulation.samples.take([0, 1, 0, 0, 0, 1, 0])
    joints, reading = samples.joints.copy(), samples.columns["reading"].copy()
    joints[3, 5] = np.nextafter(joints[3, 5], 9)
    reading[4] = np.nextafter(reading[4], 9)
    faces = [*list(samples.labels["plane"])[:6], "elsewhere"]
    rows = dataclasses.replace(samples, joints=joints, columns={"reading": reading}, labels={"plane": Labels.of(faces)})
    np.testing.assert_array_equal(copies_of(rows), [False, False, True, False, False, not collide, False])
    again = dataclasses.replace(rows, extra={"purpose": ("fit", "fit", "again", "fit", "fit", "fit", "fit")})
    assert not copies_of(again)[2], "a plan asked for it once more"
    for own in (tuple("abcdefg"), np.arange(7.0)):  # somebody's own column of that name hides no copy
        assert copies_of(dataclasses.replace(rows, extra={"purpose": own}))[2]
    joints, signed = np.zeros((2, 3)), -np.zeros((2, 3))
    np.testing.assert_array_equal(copies_of(Samples.of_joints(np.vstack([joints[:1], signed[:1]]))), [False, True])


def test_a_face_of_its_own_noise_is_told_from_an_arm_that_errs_smoothly(hsr):
    """Errors of one face, white or alike from row to row, of the same size: only the first are that face's noise."""
    samples = touched(hsr, 4)
    rows = np.flatnonzero(samples.faces().codes == 1)
    rng = np.random.default_rng(0)
    white, smooth = rng.normal(0, 0.05, rows.size), np.zeros(rows.size)
    for k in range(1, rows.size):
        smooth[k] = 0.9 * smooth[k - 1] + rng.normal(0, 0.05 * math.sqrt(1 - 0.81))
    named = []
    for errors in (white, smooth):
        reading = samples.columns["reading"].copy()
        reading[rows] += errors
        rough = dataclasses.replace(samples, columns={**samples.columns, "reading": reading})
        named.append(set(found_noise(bind(hsr.problem, rough)).scale))
    assert len(named[0]) == 3
    assert named[1] == {""}


@pytest.mark.long
def test_moves_against_priors_are_as_large_as_these_allow(hsr):
    """Over drawn arms their root mean square is one, and chances are uniform; of others it says how far they are."""
    found = [calibrate(hsr.problem, simulate(hsr.problem, hsr.cell, seed=seed).samples, method="lm", reference=False)
             for seed in range(24)]  # fmt: skip
    moved = [each.prior_moves for each in found]
    assert math.sqrt(np.mean([each.factor**2 for each in moved])) == pytest.approx(1.0, abs=0.09)
    ranks = np.sort([each.chance for each in moved]) - (np.arange(24) + 0.5) / 24
    assert np.abs(ranks).max() < 1.63 / math.sqrt(24)  # Kolmogorov and Smirnov, 1 %
    far = dataclasses.replace(hsr.cell, error_scale=3.0)
    beyond = [calibrate(hsr.problem, simulate(hsr.problem, far, seed=seed).samples, method="lm", reference=False)
              for seed in range(6)]  # fmt: skip
    assert math.sqrt(np.mean([each.prior_moves.factor**2 for each in beyond])) == pytest.approx(3.0, rel=0.25)
    assert max(each.prior_moves.chance for each in beyond) < 1e-4
