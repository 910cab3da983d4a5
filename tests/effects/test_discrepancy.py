"""What arm and cell do beside their geometry: effects, their sizes, and what they do to every figure."""

import dataclasses
import json
import math
import pickle
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.stats import chi2

from casacal import (
    CasacalError,
    Problem,
    bind,
    calibrate,
    dial_gain,
    huber,
    ipopt,
    lm,
    load,
    load_problem,
    sckf,
    sckf_lm,
    simulate,
    verify,
)
from casacal.cli.main import main
from casacal.effects import Backlash, Effect, FaceForm, JointField, ThermalGrowth, TransmissionError, kit, with_kit
from casacal.effects.effect import weighted
from casacal.files import sealed
from casacal.fit.arm_alone import arm_alone, moving
from casacal.fit.least_squares import LeastSquares
from casacal.uncertainty.evidence import _objective, effect_sizes, normal_equations
from casacal.uncertainty.tip_error import tip_rms, tip_stds, without_rigid, workspace_joints

ROOT = Path(__file__).parent.parent.parent
UR5 = ROOT / "problems" / "ur5"


@pytest.fixture(scope="module")
def clean(corner_simulation):
    return corner_simulation.samples


@pytest.fixture(scope="module")
def calibrated(corner_calibration):
    return corner_calibration


@pytest.fixture(scope="module")
def saved(calibrated, tmp_path_factory):
    """The folder of its files."""
    folder = tmp_path_factory.mktemp("saved")
    calibrated.save(folder)
    return folder


@pytest.fixture(scope="module")
def sagging():
    """A small arm that sags by 0.3 mm, seen with a step that says its size."""
    source = load_problem(UR5)
    made = simulate(source.problem, dataclasses.replace(source.cell, compliance=0.3), samples=120, seed=1)
    return source, made, calibrate(source, made.samples)


def put(bound, x, **values):
    """x with other values of some unknowns by name."""
    x = x.copy()
    for name, value in values.items():
        x[bound.names.index(name)] = value
    return x


def test_a_gear_wave_turns_each_joint_by_what_it_says(hsr, clean):
    bare = bind(hsr.problem, clean)
    bound = bind(hsr.problem.with_terms(TransmissionError(order=2)), clean)
    joints = workspace_joints(hsr.problem.robot)[:7]
    off = np.zeros_like(joints)
    off[:, 2] = 3e-3 * np.cos(2 * joints[:, 2]) - 2e-3 * np.sin(2 * joints[:, 2])
    names = [name for name, key in zip(bound.names, bound.beside, strict=True) if key == "wave2"]
    x = put(bound, bound.x0, **{names[4]: 3e-3, names[5]: -2e-3})
    np.testing.assert_allclose(bound.tips(x, joints), bare.tips(bare.x0, joints + off), atol=1e-9)


def test_backlash_lags_behind_the_way_by_which_a_joint_came(hsr, clean):
    bare = bind(hsr.problem, clean)
    bound = bind(hsr.problem.with_terms(Backlash()), clean)
    first = next(name for name, key in zip(bound.names, bound.beside, strict=True) if key == "play")
    lagging = clean.joints.copy()
    lagging[1:, 0] -= 1e-3 * np.sign(np.diff(clean.joints[:, 0]))
    other = bare.on(dataclasses.replace(clean, joints=lagging))
    x = put(bound, bound.x0, **{first: 1e-3})
    np.testing.assert_allclose(bound.plain_residual(x), other.plain_residual(bare.x0), atol=1e-9)


def test_an_arm_that_grows_stretches_its_flange(hsr, clean):
    bare = bind(hsr.problem, clean)
    bound = bind(hsr.problem.with_terms(ThermalGrowth()), clean)
    even = next(name for name, key in zip(bound.names, bound.beside, strict=True) if key == "growth")
    x = put(bound, bound.x0, **{even: 1e-3})
    joints = workspace_joints(hsr.problem.robot)[:5]
    flange = bare.poses(bare.x0, joints)[:, :3, 3]
    np.testing.assert_allclose(bound.tips(x, joints) - bare.tips(bare.x0, joints), 0.5e-3 * flange, atol=1e-8)


def test_a_field_is_a_process_of_its_size(hsr, clean):
    """Among its own pivots the covariance of the columns is that of the process; nowhere is it more."""
    field = JointField(rank=24)
    bound = bind(hsr.problem.with_terms(field), clean)
    columns = bound.jacobian(bound.x0)[:, [key == "field" for key in bound.beside]] * bound.block.noise
    variance = (columns**2).sum(axis=1)
    assert variance.max() == pytest.approx(1.0, abs=1e-6)
    assert (variance < 1 + 1e-6).all()
    apart = clean.joints[:, None] - clean.joints
    true = np.exp(-(apart**2).sum(axis=2) / 2)
    pivots = np.flatnonzero(variance > 1 - 1e-6)
    assert len(pivots) >= 20
    np.testing.assert_allclose((columns @ columns.T)[pivots], true[pivots], atol=1e-6)


def test_the_form_of_a_face_is_a_process_over_its_half_widths(hsr, clean):
    """By the squared exponential itself, at places that plain NumPy finds; towards the edges the series has less."""
    bound = bind(hsr.problem.with_terms(FaceForm()), clean)
    of_form = np.array([key == "form" for key in bound.beside])
    columns = bound.jacobian(bound.x0)[:, of_form] * bound.block.noise * bound.prior_std[of_form] / FaceForm().size
    tips = bound.tips(bound.x0, clean.joints)
    for rows in clean.labels["plane"].rows().values():
        away = tips[rows] - tips[rows].mean(axis=0)
        flat = away @ np.linalg.svd(away, full_matrices=False)[2][:2].T
        places = (flat - (flat.max(axis=0) + flat.min(axis=0)) / 2) / (np.ptp(flat, axis=0) / 2)
        found, true = columns[rows] @ columns[rows].T, np.exp(-((places[:, None] - places) ** 2).sum(axis=2) / 2)
        middle = np.abs(places).max(axis=1) < 0.45
        assert middle.sum() > 3
        np.testing.assert_allclose(found[np.ix_(middle, middle)], true[np.ix_(middle, middle)], atol=0.2)
        assert np.diagonal(found).max() < 1.05


class Parallax(Effect):
    """A reader who stands on one side."""

    size, doubt, key, words = 0.01, 2.0, "parallax", "parallax"

    def unknowns(self, site):
        return {"parallax": weighted(np.ones(1), self.size, "mm")}

    def reading(self, here):
        return {"reading": here.p.parallax[0]}


def test_an_effect_may_add_to_what_was_read(hsr, clean):
    bare, bound = bind(hsr.problem, clean), bind(hsr.problem.with_terms(Parallax()), clean)
    more = bare.on(dataclasses.replace(clean, columns={"reading": clean.columns["reading"] + 0.02}))
    x = put(bound, bound.x0, parallax1=0.02)
    np.testing.assert_allclose(bound.plain_residual(x), more.plain_residual(bare.x0), atol=1e-10)


class Wobble(Effect):
    """A user's own: the first joint errs with the third."""

    size, doubt, moves, key, words = 1e-4, 2.0, True, "wobble", "wobble of the first joint"

    def unknowns(self, site):
        return {"wobble": weighted(np.ones(1), self.size, "rad")}

    def joints(self, here):
        return ca.vertcat(here.p.wobble[0] * ca.sin(3 * here.q[2]), ca.SX.zeros(here.q.numel() - 1))


@pytest.mark.long
def test_an_effect_of_ones_own_takes_a_few_lines(hsr, clean):
    problem = hsr.problem.with_terms(Wobble())
    wobbling = dataclasses.replace(
        clean, joints=clean.joints - np.outer(2e-3 * np.sin(3 * clean.joints[:, 2]), np.eye(6)[0])
    )
    found = calibrate(problem, wobbling)
    assert found.fit.problem.terms == problem.terms
    (value,) = (x for x, key in zip(found.result.x, found.fit.beside, strict=True) if key)
    assert 0.2e-3 < value < 2.2e-3
    assert found.tip_std[1] > calibrate(hsr.problem, clean, discrepancy="none", reference=False).tip_std[1]


def test_all_solvers_meet_at_one_minimum_with_the_kit(hsr, clean):
    bound = bind(with_kit(hsr.problem), clean)
    one, two, three = lm(bound), sckf_lm(bound), ipopt(bound)
    assert one.converged
    assert three.converged
    assert one.cost == pytest.approx(three.cost, rel=1e-8)
    assert one.cost == pytest.approx(two.cost, rel=1e-8)


def test_the_default_method_filters_the_geometry_and_starts_from_there(hsr, clean):
    """Small effects need no filter: `filter_x` is the path of the geometry alone, effects where they were."""
    bound, bare = bind(with_kit(hsr.problem), clean), bind(hsr.problem, clean)
    path, beside = sckf_lm(bound).trace["filter_x"], np.array(bound.beside, dtype=bool)
    assert not path[:, beside].any()
    np.testing.assert_allclose(path[:, ~beside], sckf(bare).trace["x"], rtol=1e-6, atol=1e-9)


def test_effects_taken_out_leave_the_information_of_the_dense_formula(hsr, clean):
    bound = bind(with_kit(hsr.problem), clean)
    j = bound.jacobian(bound.x0)
    effects = np.array([bool(key) for key in bound.beside])
    moves = {effect.key for effect in bound.problem.terms if effect.moves or effect.lasting}
    moving_too = np.array([key in moves for key in bound.beside])
    for view, out in ((arm_alone(bound, bound.x0)[0], effects), (moving(bound, bound.x0)[0], effects & ~moving_too)):
        b = j[:, out] * bound.prior_std[out]
        dense = j[:, ~out].T @ np.linalg.inv(np.eye(len(j)) + b @ b.T) @ j[:, ~out]
        np.testing.assert_allclose(view.information(view.x0), dense, rtol=1e-6, atol=1e-9 * np.abs(dense).max())


def test_the_likelihood_of_sizes_is_that_of_the_dense_covariance(hsr, clean):
    """Restricted: flat unknowns projected out of a covariance N x N. Differences, for constants have no meaning."""
    bound = bind(with_kit(hsr.problem), clean)
    x = lm(bound).x
    rows, j, r = normal_equations(bound, x), bound.jacobian(x), bound.residual(x)
    y = j @ x - r
    keys = [key for key in dict.fromkeys(bound.beside) if key]
    groups = [np.flatnonzero(np.array(bound.beside) == key) for key in keys]
    flat = ~np.isfinite(bound.prior_std)
    basis = np.linalg.svd(j[:, flat])[0][:, np.linalg.matrix_rank(j[:, flat]) :]

    def dense(logs):
        stds = np.where(flat, 0.0, bound.prior_std)
        for log, group in zip(logs[:-1], groups, strict=True):
            stds[group] = bound.prior_std[group] * math.exp(log)
        covariance = math.exp(2 * logs[-1]) * np.eye(len(j)) + (j * stds) @ (j * stds).T
        inside = basis.T @ covariance @ basis
        left = basis.T @ y
        return float(np.linalg.slogdet(inside)[1] + left @ np.linalg.solve(inside, left))

    spread, expected = np.zeros(len(keys) + 1), np.zeros(len(keys) + 1)
    rng = np.random.default_rng(0)
    zero = np.zeros(len(keys) + 1)
    for _ in range(3):
        logs = rng.normal(size=len(keys) + 1) * 0.5
        given = (rows, bound.rows, np.diagonal(bound.prior_information), None, groups, expected, spread)
        ours = _objective(logs, *given)[0] - _objective(zero, *given)[0]
        assert ours == pytest.approx(dense(logs) - dense(zero), rel=1e-5, abs=1e-4)
    slope = _objective(logs, *given)[1]
    for k in range(len(logs)):
        step = np.zeros(len(logs))
        step[k] = 1e-5
        by_hand = (_objective(logs + step, *given)[0] - _objective(logs - step, *given)[0]) / 2e-5
        assert slope[k] == pytest.approx(by_hand, rel=1e-4, abs=1e-3)

    # beforehand: 2.5 times larger or six times smaller is one standard deviation, and so is 1.2 or 1.44, 10 or 10
    doubts = np.resize([2.5, 1.2, 10.0], len(keys))
    below = np.resize([6.0, 1.44, 10.0], len(keys))
    spread, expected = np.append(np.log(doubts), math.log(3.0)), np.append(np.zeros(len(keys)), 0.1)
    hyper = (*given[:5], expected, spread)
    for sign in (-1, 1):
        logs = sign * rng.uniform(0.2, 0.9, len(keys) + 1)
        wide = np.append(np.log(below if sign < 0 else doubts), math.log(3.0))
        value, slope = _objective(logs, *hyper)
        bare, bare_slope = _objective(logs, *given)
        off = logs - expected
        assert value - bare == pytest.approx(float(np.sum((off / wide) ** 2)), rel=1e-9)
        np.testing.assert_allclose(slope - bare_slope, 2 * off / wide**2, rtol=1e-9, atol=1e-8)


def test_sizes_follow_what_errs_and_stay_where_nothing_does(hsr, clean):
    known = {effect.key: (effect.doubt, effect.most) for effect in kit()}

    def times(samples):
        bare = bind(hsr.problem, samples)
        bound = bare.under(with_kit(hsr.problem))
        x = put(bound, bound.x0)
        x[[j for j, key in enumerate(bound.beside) if not key]] = lm(bare).x
        return effect_sizes(bound, x, bound.beside, known).times

    cell = dataclasses.replace(hsr.cell, backlash=160e-6)
    playing = times(simulate(hsr.problem, cell, samples=120, seed=3).samples)
    assert playing["play"] * 20e-6 == pytest.approx(80e-6, rel=0.4)  # half the play
    quiet = times(clean)
    assert quiet["play"] < 0.5
    assert max(quiet.values()) < 2.5


@pytest.mark.long
def test_tip_figures_count_what_is_not_corrected(sagging):
    _, made, found = sagging
    found = dataclasses.replace(found, tried=())
    motion, joints = found.motion, workspace_joints(found.fit.problem.robot)
    tips = motion.arm.tips(motion.x, joints)
    field = without_rigid(motion.arm.tip_jacobian(motion.x, joints), tips)
    variance = np.einsum("ij,jk,ik->i", field, motion.covariance, field) + (field @ motion.off) ** 2
    assert found.tip_std[1] == pytest.approx(math.sqrt(variance.sum() / len(tips)), rel=1e-6)
    true = made.true_tips(joints)
    error = without_rigid((tips - true).ravel(), true)
    inside = np.abs(error) < 1.96 * tip_stds(motion.covariance, field, motion.off).ravel()
    assert inside.mean() > 0.85
    assert 0.6 < tip_rms(error) / found.tip_std[1] < 1.6
    alone = calibrate(found.source, made.samples, discrepancy="none")
    assert tip_rms(error) > 1.6 * alone.tip_std[1]  # what geometry alone would have promised


@pytest.mark.long
@pytest.mark.parametrize("which", [0, 1])
def test_geometry_takes_over_what_it_can_of_what_is_not_corrected(sagging, calibrated, which):
    """The arm as used differs from the estimate by what no parameter can mimic, in the least squares of the tip."""
    found, mimicked = ((dataclasses.replace(sagging[2], tried=()), 0.999), (calibrated, 0.85))[which]
    motion, joints = found.motion, workspace_joints(found.fit.problem.robot)
    tips = motion.arm.tips(motion.x, joints)
    field = without_rigid(motion.arm.tip_jacobian(motion.x, joints), tips)
    effects = np.array([bool(found.fit.beside[j]) for j in motion.arm.free])
    geometry = ~effects & ~motion.arm.datum
    constants = np.array([found.fit.beside[j] == "trusted" for j in motion.arm.free])  # which stand where they are
    assert not motion.x[effects & ~constants].any()
    left, whole = field @ motion.off, field[:, effects] @ motion.off[effects]
    assert tip_rms(left) < mimicked * tip_rms(whole)
    columns = field[:, geometry] * motion.arm.start_std[geometry]
    sizes = np.linalg.norm(columns, axis=0)
    toward = np.abs(columns.T @ left) / np.maximum(sizes, 1e-12) / np.linalg.norm(left)
    assert toward[sizes > 0.1 * sizes.max()].max() < 0.02


@pytest.mark.long
def test_the_file_says_what_memory_says(calibrated, saved):
    document = json.loads((saved / "result.json").read_text(encoding="utf-8"))
    part = document["discrepancy"]
    other = {"ripple", "trusted", "roundness", "bow", "focal"}  # no ratios; told elsewhere; of other instruments
    expected = {effect.key for effect in kit()} - other
    assert {effect["key"] for effect in part["effects"]} == expected
    assert all(effect["size"] > 0 for effect in part["effects"])
    assert not any(row["name"].startswith("wave1") for row in document["parameters"] + document["unknowns"])
    joints = workspace_joints(calibrated.fit.problem.robot)
    motion = calibrated.motion
    tips = motion.arm.tips(motion.x, joints)
    field = without_rigid(motion.arm.tip_jacobian(motion.x, joints), tips)
    stds = np.linalg.norm(tip_stds(motion.covariance, field, motion.off), axis=1)
    told = load(saved).predict(joints, frame="tip", std=True)
    np.testing.assert_allclose(told.std, stds, rtol=1e-6)
    np.testing.assert_allclose(told.positions, tips, atol=1e-6)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda part: part.update(effects=5),
        lambda part: part["effects"][0].update(times="much"),
        lambda part: part["covariance"].pop(),
        lambda part: part.update(off=[1.0]),
        lambda part: part["unknowns"][0].pop("value"),
    ],
)
def test_a_damaged_part_is_refused_in_a_sentence(saved, tmp_path, spoil):
    document = json.loads((saved / "result.json").read_text(encoding="utf-8"))
    spoil(document["discrepancy"])
    document.pop("seal")
    (tmp_path / "result.json").write_text(json.dumps(sealed(document)), encoding="utf-8")
    with pytest.raises(CasacalError, match=r"discrepancy|effects|covariance|wave"):
        load(tmp_path)


def test_a_promise_is_kept_by_an_arm_with_waves_and_broken_by_a_dial(hsr):
    cell = dataclasses.replace(hsr.cell, gear_waves=((1, 1e-4), (2, 1e-4)))
    some = simulate(hsr.problem, cell, samples=200, seed=8).samples
    found = calibrate(hsr, some.take(np.arange(120)), reference=False)
    fresh = some.take(np.arange(120, 200))
    assert verify(found, fresh).kept
    off = dataclasses.replace(fresh, columns={"reading": fresh.columns["reading"] + 0.1 * (np.arange(80) % 2)})
    assert not verify(found, off).kept


@pytest.mark.long
def test_what_errs_beside_the_geometry_is_expected_of_fresh_rows(hsr, calibrated, tmp_path):
    """Their residuals hold it anew: the prediction grows with the sizes, up to what geometry and faces absorb."""
    fresh = simulate(hsr.problem, hsr.cell, samples=60, seed=77).samples
    calibrated.save(tmp_path)
    document = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    plain = verify(tmp_path, fresh).predicted_mm
    for effect in document["discrepancy"]["effects"]:
        effect["times"] *= 20
    document.pop("seal")
    (tmp_path / "result.json").write_text(json.dumps(sealed(document)), encoding="utf-8")
    assert verify(tmp_path, fresh).predicted_mm > 3 * plain


def test_geometry_alone_is_to_be_had(hsr, clean, tmp_path, capsys):
    alone = calibrate(hsr, clean, discrepancy="none", reference=False)
    assert alone.fit.unknowns == bind(hsr.problem, clean).unknowns
    assert json.loads(json.dumps(alone.to_dict()))["discrepancy"] is None
    assert alone.x is alone.result.x
    with pytest.raises(CasacalError, match="Give 'kit' or 'none'"):
        calibrate(hsr, clean, discrepancy="some")
    assert main(["calibrate", str(hsr.path), "--discrepancy", "none", "--out", str(tmp_path)]) == 0
    assert json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))["discrepancy"] is None
    capsys.readouterr()


@pytest.mark.long_unless("plane-only")
@pytest.mark.parametrize(
    "way", [{"loss": huber()}, {"method": "plane-only"}, {"method": "swarm"}], ids=["huber", "plane-only", "swarm"]
)
def test_who_cannot_take_effects_has_geometry_alone(hsr, clean, way):
    found = calibrate(hsr, clean, reference=False, **way)
    assert not found.counts_effects
    assert set(found.fit.beside) == ({"", "trusted"} if "loss" in way else {""}), "no loss makes a dial perfect"


def test_other_priors_share_the_kit(hsr):
    problem = load_problem(hsr.path).problem
    compiled = with_kit(problem).models[0]
    changed = problem.with_prior({"a": 0.5})
    assert with_kit(changed).models[0].jacobian is compiled.jacobian
    assert set(with_kit(changed).robot.parameters["a"].prior_stds) == {0.5}


def test_a_calibration_with_effects_travels(calibrated):
    again = pickle.loads(pickle.dumps(calibrated))
    assert again == calibrated
    np.testing.assert_array_equal(again.x, calibrated.x)
    assert again.tip_std == calibrated.tip_std


@pytest.mark.long
def test_the_price_where_nothing_errs_is_small(hsr):
    """Over ten arms the tip with the kit is no worse than ten per cent beyond that of geometry alone.

    Of a dial whose gain is certified; who knows nothing of it pays for that, however good it is.
    """
    dial = dataclasses.replace(hsr.problem.instrument, gain=dial_gain(1e-3))
    certified = Problem(hsr.problem.robot, dial)
    joints = workspace_joints(hsr.problem.robot)
    errors = {"kit": [], "none": []}
    for seed in range(10):
        made = simulate(hsr.problem, hsr.cell, samples=120, seed=seed)
        true = made.true_tips(joints)
        for way, found in errors.items():
            motion = calibrate(certified, made.samples, discrepancy=way, method="lm", reference=False).unjudged.motion
            found.append(tip_rms(without_rigid((motion.arm.tips(motion.x, joints) - true).ravel(), true)))
    kit_rms, alone = (math.sqrt(np.mean(np.square(errors[way]))) for way in ("kit", "none"))
    assert kit_rms < 1.1 * alone


@pytest.mark.long
def test_backlash_costs_less_with_the_kit(hsr):
    joints, cell = workspace_joints(hsr.problem.robot), dataclasses.replace(hsr.cell, backlash=60e-6)
    errors = {"kit": [], "none": []}
    for seed in range(8):
        made = simulate(hsr.problem, cell, samples=120, seed=seed)
        true = made.true_tips(joints)
        for way, found in errors.items():
            motion = calibrate(hsr, made.samples, discrepancy=way, method="lm", reference=False).unjudged.motion
            found.append(tip_rms(without_rigid((motion.arm.tips(motion.x, joints) - true).ravel(), true)))
    kit_rms, alone = (math.sqrt(np.mean(np.square(errors[way]))) for way in ("kit", "none"))
    assert kit_rms < 0.8 * alone


class Shifted(LeastSquares):
    """Rows of which x is the truth, with an error each, under priors a part as wide."""

    def __init__(self, bound, x, errors, part):
        self.bound, self.shift = bound, errors - bound.residual(x)
        self.names, self.units, self.datum = bound.names, bound.units, bound.datum
        self.x0, self.prior_std, self.start_std = bound.x0, bound.prior_std * part, bound.start_std * part

    rows = property(lambda self: self.bound.rows)

    def residual(self, x):
        return self.bound.residual(x) + self.shift

    def jacobian(self, x):
        return self.bound.jacobian(x)

    def row(self, k, states):
        return self.bound.row(k, states) + self.shift[k]

    def row_jacobian(self, k, x):
        r, slope = self.bound.row_jacobian(k, x)
        return r + self.shift[k], slope


def test_geometry_and_effects_err_by_what_their_covariance_says(hsr, clean):
    """NEES: arms and effects drawn from what is expected of them, rows with noise, fitted again; 95 % for all three."""
    bound, rng = bind(with_kit(hsr.problem), clean), np.random.default_rng(5)
    firm = np.isfinite(bound.prior_std)
    beside = np.array(bound.beside, dtype=bool)
    draws, found = 60, {"geometry": 0.0, "effects": 0.0, "all": 0.0}
    freedom = dict.fromkeys(found, 0)
    for _ in range(draws):
        x = np.where(firm, rng.normal(size=bound.unknowns) * np.where(firm, bound.prior_std, 0.0) * 0.3, 0.0)
        # a third of the sizes: tangents stay good, and what is known beforehand says a third as well
        drawn = Shifted(bound, x, rng.normal(size=bound.rows), 0.3)
        result = lm(drawn)
        assert result.converged
        error, covariance = result.x - x, result.covariance
        for name, some in (("geometry", firm & ~beside), ("effects", beside), ("all", firm)):
            part = np.flatnonzero(some)
            found[name] += error[part] @ np.linalg.solve(covariance[np.ix_(part, part)], error[part])
            freedom[name] += part.size
    for name, total in found.items():
        low, high = chi2.ppf([0.025 / 3, 1 - 0.025 / 3], freedom[name])
        assert low < total < high, name


def test_backlash_goes_by_the_lines_of_the_file_whatever_the_order_of_rows(hsr, corner_simulation):
    rows = corner_simulation.samples
    shuffled = rows.take(np.random.default_rng(0).permutation(len(rows)))
    one, other = (bind(hsr.problem.with_terms(Backlash()), each) for each in (rows, shuffled))
    x = one.x0 + 0.5 * one.start_std
    assert np.sort(other.residual(x)) == pytest.approx(np.sort(one.residual(x)))
