"""Tests of effects beside the geometry: dense algebra, chances, clean and faulty arms, what an effect does to a tip."""

import dataclasses
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT
from scipy import stats
from scipy.sparse import csr_matrix

from casacal import Problem, bind, calibrate, check, dial_cycle, dial_gain, lm, load_problem, simulate
from casacal.calibration.result_json import calibration_document
from casacal.calibration.summary import summary
from casacal.calibration.verdict import verdict_of
from casacal.files import jsonable
from casacal.least_squares.losses import huber
from casacal.uncertainty.discrepancy import with_effects
from casacal.uncertainty.noise import found_noise
from casacal.uncertainty.quadratic_forms import chance_beyond, chance_of_ratio, holm, together
from casacal.uncertainty.row_forms import RowForm, alike, following, near_on_faces, whitened
from casacal.uncertainty.score_tests import leading_tests, score_tests
from casacal.uncertainty.scores import Ground, Score, ScoreTest
from casacal.uncertainty.workspace import tip_rms, without_rigid, workspace_joints

ROWS, FLAT = 26, 2


@pytest.fixture(scope="module")
def linear():
    """Rows J (N, 5) with two flat unknowns, columns B (N, 3), which rows err together W (N, N), and priors."""
    rng = np.random.default_rng(5)
    prior = np.array([np.inf, np.inf, 0.5, 2.0, 0.1])
    pairs = rng.random((ROWS, ROWS)) < 0.15
    form = np.triu(pairs, 1) + np.triu(pairs, 1).T + np.diag(rng.uniform(0, 1, ROWS))
    return rng.normal(size=(ROWS, 5)), rng.normal(size=(ROWS, 3)) * [1, 0.5, 0.2], form, prior


def inverse_without_flat(jacobian, prior):
    """V^-1 of V = I + J L^-1 J', what flat unknowns explain projected out, as it stands in the books: N x N."""
    flat = np.isinf(prior)
    others = np.linalg.svd(jacobian[:, flat])[0][:, flat.sum() :]
    known = jacobian[:, ~flat] * prior[~flat]
    inside = others.T @ (np.eye(len(jacobian)) + known @ known.T) @ others
    return others @ np.linalg.inv(inside) @ others.T


def about(jacobian, prior, r, away):
    return Ground.of(jacobian.T @ jacobian, jacobian.T @ r, float(r @ r), len(r), prior, away)


def drawn(rng, jacobian, prior, noise, count):
    """Rows (count, N) as they come by chance: noise, and errors of the unknowns from their priors, however far."""
    stds = noise * np.where(np.isinf(prior), 1e3, prior)
    return noise * rng.normal(size=(count, len(jacobian))) + (rng.normal(size=(count, len(prior))) * stds) @ jacobian.T


def test_scores_and_forms_are_those_of_the_dense_formula(linear):
    """Taken anywhere, not only at the minimum: the residual there is y - J x."""
    jacobian, columns, form, prior = linear
    rng = np.random.default_rng(1)
    y, x = rng.normal(size=ROWS), rng.normal(size=5)
    inverse = inverse_without_flat(jacobian, prior)
    r = y - jacobian @ x  # rows are r + J (step), and so the model is y - J x with slope -J
    ground = about(-jacobian, prior, r, x)
    assert ground.square == pytest.approx(y @ inverse @ y, rel=1e-9)
    assert ground.freedom == ROWS - FLAT
    score = Score.of(ground, columns.T @ columns, -jacobian.T @ columns, columns.T @ r)
    dense, s = columns.T @ inverse @ columns, columns.T @ inverse @ y
    np.testing.assert_allclose(score.values, np.linalg.eigvalsh(dense), rtol=1e-9)
    assert float(score.values @ score.squares) == pytest.approx(s @ s, rel=1e-9)
    assert float(score.squares.sum()) == pytest.approx(s @ np.linalg.solve(dense, s), rel=1e-9)
    assert score.rest == pytest.approx(y @ inverse @ y - s @ np.linalg.solve(dense, s), rel=1e-9)
    assert score.freedom == ROWS - FLAT - 3
    both = form @ inverse
    traces = [float(np.trace(np.linalg.matrix_power(both, k))) for k in (1, 2, 3)]
    observed, square = y @ inverse @ form @ inverse @ y, y @ inverse @ y
    found = RowForm.of(ground, -jacobian, r, csr_matrix(form))
    assert found.chance == pytest.approx(chance_of_ratio(traces, observed / square, ROWS - FLAT), rel=1e-8)
    excess = np.linalg.solve([[ROWS - FLAT, traces[0]], [traces[0], traces[1]]], [square, observed])[1]
    assert found.variance == pytest.approx(max(excess, 0), rel=1e-8)


def test_chances_are_those_of_tables():
    """Imhof (1961), table 1; Fisher's F for one column; far out where nearly all weights are the same."""
    for x, chance in ((1, 0.9458), (7, 0.5064), (20, 0.1240)):
        assert chance_beyond(np.array([6.0, 3, 1]), np.array([x / 6, 0, 0]), 1e7, 1e7) == pytest.approx(
            chance, abs=2e-4
        )
    for z2 in (0.5, 4.0, 80.0):
        assert chance_beyond(np.array([0.3]), np.array([z2]), 80, 90) == pytest.approx(stats.f.sf(z2 / (8 / 9), 1, 90))
    nearly = 0.3 + 1e-6 * np.arange(5)
    for z2 in (4.0, 20.0):
        exact = stats.f.sf(z2 / (8 / 9), 5, 90)
        assert chance_beyond(nearly, np.full(5, z2), 80, 90) == pytest.approx(exact, rel=1e-3 if exact > 1e-8 else 0.1)
    assert stats.f.sf(20 / (8 / 9), 5, 90) < 1e-13, "the second is far out"


def test_a_ratio_of_forms_by_its_moments():
    """Against draws; its tails are those of a skew distribution."""
    rng = np.random.default_rng(2)
    values = np.concatenate([[5.0, 3.0, 2.0], np.zeros(20)])
    squares = rng.normal(size=(200_000, 23)) ** 2
    ratios = squares @ values / squares.sum(axis=1)
    traces = [float((values**k).sum()) for k in (1, 2, 3)]
    for part in (0.5, 0.95, 0.99):
        at = float(np.quantile(ratios, part))
        assert chance_of_ratio(traces, at, 23) == pytest.approx(1 - part, rel=0.06)


def test_holm_and_cauchy():
    """Holm (1979) by hand: 4, 3, 2, 1 times the chances in order, none less than the one before."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx((0.03, 0.06, 0.06, 0.02))
    assert holm([0.5, 0.9]) == (1.0, 1.0)
    assert holm([]) == ()
    for p in (0.3, 1e-3, 1e-12, 1e-40):
        assert together([p, p]) == pytest.approx(p, rel=1e-6)
        assert p == 0.3 or together([p, 1.0]) == pytest.approx(2 * p, rel=0.15)


def test_chances_are_even_where_there_is_nothing(linear):
    """Few rows, and noise three times as large as it was taken for: chi-square in the place of F would fail here."""
    jacobian, columns, form, prior = linear
    rng = np.random.default_rng(3)
    found = []
    for y in drawn(rng, jacobian, prior, 3.0, 500):
        ground = about(jacobian, prior, y, np.zeros(5))
        score = Score.of(ground, columns.T @ columns, jacobian.T @ columns, columns.T @ y)
        found.append((score.chance, RowForm.of(ground, jacobian, y, csr_matrix(form)).chance))
    for chances in np.array(found).T:
        assert stats.kstest(chances, "uniform").pvalue > 1e-3
        assert 10 <= (chances < 0.05).sum() <= 43  # 25 +- 3.7 standard deviations


def test_sizes_are_found(linear):
    """Of many columns and rows, the likeliest size is near the true one, in whatever noise."""
    rng = np.random.default_rng(4)
    jacobian, columns, prior = rng.normal(size=(600, 5)), rng.normal(size=(600, 60)), linear[3]
    y = 2 * rng.normal(size=600) + columns @ (3 * rng.normal(size=60))
    score = Score.of(about(jacobian, prior, y, np.zeros(5)), columns.T @ columns, jacobian.T @ columns, columns.T @ y)
    assert score.size == pytest.approx(3, rel=0.3)
    form = csr_matrix(np.kron(np.eye(120), np.ones((5, 5))))
    y = rng.normal(size=600) + np.repeat(1.5 * rng.normal(size=120), 5)
    assert RowForm.of(about(jacobian, prior, y, np.zeros(5)), jacobian, y, form).size == pytest.approx(1.5, rel=0.25)


@pytest.mark.parametrize(
    ("p", "p_holm", "leads", "shown"),
    [
        (1e-9, 1e-8, True, "yes"),
        (1e-4, 5e-3, False, "explained"),
        (1e-3, 0.02, False, "perhaps"),
        (0.06, 0.6, False, "no"),
    ],
)
def test_how_an_effect_shows(p, p_holm, leads, shown):
    assert ScoreTest("give", "gravity sag", p, p_holm, 0.3, 0.15, "mm", 0.2, leads).shown == shown


def test_which_rows_err_together():
    """Two faces of five touches in a row, the last place of the first touched twice."""
    tips = np.array([[10.0 * k, 0, 0] for k in (0, 1, 2, 3, 4, 4, 0, 1, 2)])
    faces, places = np.array([0] * 6 + [1] * 3), np.array([0, 1, 2, 3, 4, 4, 5, 6, 7])
    near = near_on_faces(tips, faces, places).toarray()
    assert (near == near.T).all()
    assert near.diagonal().sum() == 0
    assert near[:6, 6:].sum() == 0, "faces are apart"
    assert near[4, 5] == 0, "repeats are no neighbours"
    assert near[4, 3] == near[5, 3] == 1
    after = following((3, 1, 2, 4, 5, 6, 7, 8, 9), places).toarray()
    assert sorted(np.argwhere(np.triu(after))[:4].tolist()) == [[0, 2], [0, 3], [1, 2], [3, 4]]
    assert after[4, 5] == 0
    np.testing.assert_array_equal(alike(places).toarray(), places[:, None] == places)
    rows = SimpleNamespace(
        noise=np.array([1.0, 2.0, 4.0, 5.0, 8.0]),
        components=np.array([2, 2, 1]),
        sample_of=np.array([0, 0, 1, 1, 2]),
        component_of=np.array([0, 1, 0, 1, 0]),
    )
    scaled = whitened(csr_matrix(np.array([[0.0, 1, 1], [1, 0, 0], [1, 0, 0]])), rows).toarray()
    np.testing.assert_allclose(scaled[0], [0, 0, 1 / 4, 0, 1 / 8])
    np.testing.assert_allclose(scaled[3], [0, 1 / 10, 0, 0, 0], err_msg="a sample of one residual has no second one")
    apart = following((1, 2, 1, 2), np.arange(4), np.array([0, 0, 1, 1])).toarray()
    assert np.argwhere(np.triu(apart)).tolist() == [[0, 1], [2, 3]], "instruments follow only themselves"


def faulty(source, fault, seed):
    """120 touches of a simulated arm that does what its geometry does not say."""
    changes = {"play": {"backlash": 80e-6}, "form": {"flatness": 0.08}, "give": {"compliance": 1.5}}.get(fault, {})
    samples = simulate(source.problem, dataclasses.replace(source.cell, **changes), samples=120, seed=seed).samples
    reading = samples.columns["reading"]
    if fault.endswith("gain"):
        reading = reading / (1.0025 if fault.startswith("small") else 1.004)
    if fault == "cycle":
        reading = reading - 0.012 * np.sin(2 * math.pi * reading + 1)
    if fault == "drift":
        reading = reading + np.linspace(0, 0.04, 120)
    return dataclasses.replace(samples, columns={"reading": reading})


def ready(source, samples):
    bound = bind(source.problem, samples)
    bound = bound.with_noise(found_noise(bound).scale)
    return bound.with_noise(with_effects(bound, source.problem).scale)


@pytest.mark.long
def test_clean_arms_show_nothing(hsr):
    """Thirteen tests of eight arms: chances below 5 % are few, and they lie evenly about a half."""
    found = [score_tests(ready(hsr, faulty(hsr, "", seed)), hsr.problem) for seed in range(8)]
    chances = np.array([[test.p for test in tests] for tests in found])
    assert chances.shape == (8, 13)
    assert 0.4 < chances.mean() < 0.6
    assert (chances < 0.05).sum() <= 14  # 5 expected
    assert not any(test.leads for tests in found for test in tests)


@pytest.mark.parametrize(
    ("fault", "size"),
    [("gain", 0.4), ("cycle", 12 / math.sqrt(2)), ("drift", 0.04), ("play", 40e-6), ("form", None), ("give", None)],
)
def test_a_fault_is_named_and_no_other(hsr, fault, size):
    bound = ready(hsr, faulty(hsr, fault, 11))
    tests = score_tests(bound, hsr.problem)
    also = {"neighbours"} if fault == "form" else set()  # what a smooth series leaves of it
    assert {test.key for test in tests if test.leads} - also == {fault}
    first = tests[0]
    assert (first.key, first.shown) == (fault, "yes")
    assert first.p_holm == pytest.approx(min(13 * first.p, 1))
    assert size is None or size / 3 < first.size < 3 * size
    assert [test.key for test in leading_tests(bound, hsr.problem, 0.01) if test.key not in also] == [fault]


def test_what_an_effect_does_to_the_tip(hsr):
    """A fit of the geometry alone to rows with a wrong gain, and with waves of the gears, by hand."""
    samples = faulty(hsr, "gain", 2)
    bound = bind(hsr.problem, dataclasses.replace(samples, joints=samples.joints + 5e-4 * np.sin(samples.joints)))
    samples, joints = bound.block.samples, workspace_joints(hsr.problem.robot)
    x = lm(bound).x
    tips = bound.tips(x, joints)

    def moved(changed, where):
        field = bound.tips(lm(bound.on(changed), start=x).x, where) - tips
        return tip_rms(without_rigid(field.ravel(), tips))

    gained = {"reading": samples.columns["reading"] * 1.0001}
    by_gain = moved(dataclasses.replace(samples, columns=gained), joints) / 0.01
    squares = 0.0
    for joint in range(6):
        for wave in (np.cos, np.sin):
            step = np.eye(6)[joint] * 1e-5
            there = dataclasses.replace(samples, joints=samples.joints + step * wave(samples.joints))
            squares += moved(there, joints + step * wave(joints)) ** 2
    tests = {test.key: test for test in score_tests(bound, hsr.problem)}
    for key, by_hand in {"gain": by_gain, "wave1": math.sqrt(squares) / 1e-5}.items():
        assert tests[key].size > 0
        assert tests[key].tip_mm / tests[key].size == pytest.approx(by_hand, rel=0.02)


def test_joints_that_do_not_repeat(hsr):
    """Their size, and what they do to the tip: by moving one joint after the other, without a formula."""
    cell = dataclasses.replace(hsr.cell, joint_std=50e-6)
    bound = bind(hsr.problem, simulate(hsr.problem, cell, samples=240, seed=3).samples)
    samples = bound.block.samples
    apart = ready(hsr, samples)
    assert len(apart.scale) > 1, "faces seem to differ in noise, as the joints see more of some"
    assert [each.key for each in leading_tests(apart, hsr.problem, 0.01)] == ["repeatability"]
    bound = bound.with_noise({"": 6.0})
    test = {each.key: each for each in score_tests(bound, hsr.problem)}["repeatability"]
    assert test.p < 0.01
    assert 25e-6 < test.size < 100e-6
    joints, x = workspace_joints(hsr.problem.robot), lm(bound).x
    tips, r = bound.tips(x, joints), bound.residual(x)
    stacked = np.vstack([bound.jacobian(x), np.diag(bound.prior_information**0.5)])
    answers = without_rigid(bound.tip_jacobian(x, joints), tips) @ np.linalg.pinv(stacked)[:, : len(r)]
    squares = 0.0
    for step in 1e-6 * np.eye(6):
        slope = bound.on(dataclasses.replace(samples, joints=samples.joints + step)).residual(x) - r
        squares += tip_rms(bound.tips(x, joints + step) - tips) ** 2 + ((answers * slope) ** 2).sum() / len(tips)
    assert test.tip_mm / test.size == pytest.approx(math.sqrt(squares) / 1e-6, rel=2e-3)


@pytest.mark.long
def test_repeats_and_declared_errors():
    """Places that are touched three times are tested; what a dial declares is not."""
    source = load_problem(ROOT / "problems" / "hsr_jr680")
    samples = faulty(source, "", 1)
    thrice = samples.take(np.repeat(np.arange(60), 3))
    reading = thrice.columns["reading"] + np.random.default_rng(0).normal(size=180) * 0.01
    thrice = dataclasses.replace(thrice, columns={"reading": reading}, lines=tuple(range(1, 181)))
    tests = {test.key: test for test in score_tests(bind(source.problem, thrice), source.problem)}
    assert tests["repeats"].p < 0.01, "what touches share of the first reading's error"
    assert 0.005 < tests["repeats"].size < 0.02
    assert {"gain", "cycle", "repeats"} < set(tests)
    dial = dataclasses.replace(source.problem.instrument, gain=dial_gain(), cycle=dial_cycle())
    declared = Problem(source.problem.robot, dial)
    keys = {test.key for test in score_tests(bind(declared, samples), declared)}
    assert not {"gain", "cycle", "repeats"} & keys
    assert "wave1" in keys


def test_a_calibration_says_it(hsr, tmp_path):
    samples = faulty(hsr, "drift", 11)
    found = calibrate(hsr, samples, method="lm", reference=False)
    assert found.score_tests[0].key == "drift"
    document = jsonable(calibration_document(found))
    listed = document["score_tests"]
    assert [each["key"] for each in listed] == [test.key for test in found.score_tests]
    assert listed[0]["tip_mm"] == found.score_tests[0].tip_mm
    assert listed[0]["shown"] == "yes"
    assert {each["expected_size"] for each in listed if each["key"] == "neighbours"} == {None}
    assert json.dumps(listed, allow_nan=False)
    told = summary(found, "hsr").split("Errors beside the geometry")[1]
    assert "Drift" in told.splitlines()[2]
    found.report(tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count(">Drift<") == 1
    assert 'id="beside"' in page
    for options in ({"discrepancy": "none"}, {"loss": huber()}):
        without = calibrate(hsr, samples, method="lm", reference=False, **options)
        assert without.score_tests == ()
        assert calibration_document(without)["score_tests"] == []


@pytest.mark.parametrize(("fault", "fix"), [("small gain", "dial_gain(0.15)"), ("form", "Clean the faces")])
def test_check_warns_of_it(hsr, fault, fix):
    found = [each for each in check(hsr.problem, faulty(hsr, fault, 11)) if fix in each.fix]
    assert len(found) == 1
    assert found[0].severity == "warning"
    assert "moves the tip by" in found[0].cause


def test_check_is_silent_of_clean_arms_and_beside_errors(hsr):
    assert {each.severity for each in check(hsr.problem, faulty(hsr, "", 11))} == {"remark"}
    wrong = faulty(hsr, "gain", 11)  # and so much that a length of the arm seems to be another
    wrong = dataclasses.replace(wrong, columns={"reading": wrong.columns["reading"] / 1.002})
    found = check(hsr.problem, wrong)
    assert [each.about for each in found if each.severity != "remark"] == ["scale of the readings"]


@pytest.mark.long
def test_a_rough_face_is_no_effect(hsr):
    """One face four times as rough as stated: with noise as stated, a test in five would see an effect in it."""
    chances = []
    for seed in range(6):
        samples = faulty(hsr, "", seed)
        rough = np.random.default_rng(seed).normal(size=120) * 0.04 * (samples.labels["plane"].codes == seed % 3)
        samples = dataclasses.replace(samples, columns={"reading": samples.columns["reading"] + rough})
        chances += [test.p for test in score_tests(ready(hsr, samples), hsr.problem)]
    assert (np.array(chances) < 0.05).sum() <= 7  # 4 expected of 78; ten with noise as stated


@pytest.mark.long_unless("0", "2")
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_touches_that_were_programmed_to_one_depth_show_no_gain(hsr, seed):
    """Where the drawn arm would read 5 mm everywhere, what is read is the arm's error, which a gain would explain."""
    cell = dataclasses.replace(hsr.cell, error_scale=0.0, repeatability=1e-9, travel=1e-6)
    made = simulate(hsr.problem, cell, samples=120, seed=seed).samples
    rng, level = np.random.default_rng(seed), np.full(120, 5.0)
    bound = bind(hsr.problem, dataclasses.replace(made, columns={"reading": level}))
    x = rng.normal(size=bound.unknowns) * np.where(np.isfinite(bound.prior_std), bound.prior_std, 0.0)
    here = bound.plain_residual(x)
    deeper = bound.on(dataclasses.replace(made, columns={"reading": level + 1})).plain_residual(x)
    read = level - here / (deeper - here) + 0.01 * rng.normal(size=120)
    assert 0.05 < np.std(read) < 3
    samples = dataclasses.replace(made, columns={"reading": read})
    gain = {test.key: test for test in score_tests(ready(hsr, samples), hsr.problem)}.get("gain")
    assert gain is None or not gain.leads
    found = calibrate(hsr, samples, reference=False)
    assert verdict_of(found).level == "calibrated"
