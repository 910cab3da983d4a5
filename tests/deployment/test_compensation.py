"""Compensation: against the true arm, hand-multiplied kinematics, SciPy's optimisers, and the texts parsed back."""

import csv
import json
import math
import re
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT
from oracles import dh_chain
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from seals import resealed

from casacal import DialOnPlane, Joint, Parameter, Problem, Robot, calibrate, deg, lm, load_problem, simulate
from casacal.calibration.result_json import calibration_document
from casacal.calibration.truth import write_simulation
from casacal.cli.main import main
from casacal.data.samples import Samples
from casacal.deployment.arm import CalibratedArm
from casacal.deployment.compensate import Outcome, Rounding, Targets, compensate, read_targets
from casacal.deployment.inverse_kinematics import PosedArm
from casacal.deployment.predict import predict, write_prediction
from casacal.deployment.programs import KRL, RAPID, URSCRIPT, notes, text_of
from casacal.deployment.result_file import read_result
from casacal.errors import CasacalError
from casacal.files import write_json
from casacal.model.kinematics import chain, rotate_z, translate_x
from casacal.model.problem_file import ProblemFile

SEEDS = range(6)


def rows_of(joints):
    joints = np.asarray(joints, dtype=float)
    return Samples(joints, {}, {}, tuple(range(2, len(joints) + 2)), {}, "targets", "")


def targets_of(joints):
    return Targets.of(rows_of(joints))


def random_targets(robot, count, seed, within=0.9):
    lower, upper = (np.array([getattr(joint, side) for joint in robot.axes]) for side in ("lower", "upper"))
    return np.random.default_rng(seed).uniform(within * lower, within * upper, (count, len(lower)))


def table_of(document, kind):
    value = {row["name"]: row[kind] for row in document["parameters"]}
    return {key: np.array([value[f"{key}{i}"] for i in range(1, 7)]) for key in ("alpha", "a", "d", "theta")}


def poses_by_hand(table, joints):
    return np.array([dh_chain(table["alpha"], table["a"], table["d"], table["theta"] + q) for q in joints])


def up_to_base(reached, meant):
    """Distances (N,) once the best rigid motion is taken out (Kabsch)."""
    a, b = reached - reached.mean(axis=0), meant - meant.mean(axis=0)
    turn, _ = Rotation.align_vectors(b, a)
    return np.linalg.norm(turn.apply(a) - b, axis=1)


@pytest.fixture(scope="module")
def cell(hsr, tmp_path_factory):
    """Simulated, calibrated where first asked for: path of the result and of the truth by seed."""
    folder = tmp_path_factory.mktemp("cells")

    @cache
    def made(seed):
        samples, truth = write_simulation(simulate(hsr.problem, hsr.cell, seed=seed), hsr, folder / f"{seed}.csv")
        fitted = calibrate(hsr.problem, hsr.problem.read(samples), method="lm", reference=False)
        write_json(folder / f"{seed}.json", calibration_document(fitted, hsr))
        return folder / f"{seed}.json", truth

    return made


@pytest.fixture(scope="module")
def result(cell):
    return read_result(cell(0)[0])


def arm_result(robot, changes):
    """A result of a robot whose parameters differ from nominal by given numbers, all of them known exactly."""
    problem = Problem(robot, DialOnPlane(noise_std=0.01))
    names = [name for key, u in robot.parameters.items() for name in u.names(key)]
    nominal = np.concatenate([np.atleast_1d(u.nominal) for u in robot.parameters.values()])
    rows = [
        {"name": n, "unit": "", "nominal": float(v), "estimate": float(v + c), "std": 0.0, "known_from": "samples"}
        for n, v, c in zip(names, nominal, changes, strict=True)
    ]
    rows += [{"name": f"tool_{axis}", "nominal": 0.0, "estimate": 0.0, "known_from": "prior alone"} for axis in "xyz"]
    document = {
        "converged": True,
        "parameters": rows,
        "unknowns": [{"name": n, "value": float(c)} for n, c in zip(names, changes, strict=True)],
        "covariance": np.zeros((len(names), len(names))).tolist(),
    }
    return CalibratedArm("made.json", ProblemFile("made", "problem.py", "", problem, None), document)


@pytest.mark.long
def test_the_true_arm_misses_by_what_the_bound_predicts(cell, hsr):
    ratios = []
    for seed in SEEDS:
        file, truth_file = cell(seed)
        joints = random_targets(hsr.problem.robot, 200, seed)
        found = compensate(read_result(file), targets_of(joints))
        truth = json.loads(truth_file.read_text())
        expected = json.loads(file.read_text())["tip"]["expected_rms_mm"]
        meant = poses_by_hand(table_of(truth, "nominal"), joints)[:, :3, 3]
        true = table_of(truth, "estimate")
        before, after = (
            up_to_base(poses_by_hand(true, q)[found.reached, :3, 3], meant[found.reached])
            for q in (joints, found.joints)
        )
        assert found.reached.mean() > 0.95
        assert np.sqrt((after**2).mean()) < 0.5 * np.sqrt((before**2).mean())
        ratios.append((after**2).mean() / expected**2)
        own = np.sqrt((found.expected_mm[found.reached] ** 2).mean())
        assert own == pytest.approx(expected, rel=0.15)
    # each ratio has few effective degrees of freedom; their mean lies near one
    assert 0.5 < np.mean(ratios) < 1.7


def test_round_trip_by_hand(cell, hsr, tmp_path):
    joints = random_targets(hsr.problem.robot, 100, 7)
    lines = [
        "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg",
        *(",".join(map(repr, row)) for row in np.degrees(joints).tolist()),
    ]
    (tmp_path / "t.csv").write_text("\n".join(lines))
    main(["compensate", str(cell(0)[0]), str(tmp_path / "t.csv"), "--out", str(tmp_path / "c.csv")])
    with (tmp_path / "c.csv").open() as stream:
        rows = list(csv.DictReader(line for line in stream if not line.startswith("#")))
    assert len(rows) == 100
    document = json.loads(cell(0)[0].read_text())
    written = np.radians([[float(row[f"q{i}_deg"]) for i in range(1, 7)] for row in rows])
    reached = poses_by_hand(table_of(document, "estimate"), written)
    meant = poses_by_hand(table_of(document, "nominal"), joints)
    apart = np.linalg.norm((reached - meant)[:, :3, 3], axis=1)
    turned = Rotation.from_matrix(reached[:, :3, :3] @ meant[:, :3, :3].transpose(0, 2, 1)).magnitude()
    hit = np.array([row["status"] == "reached" for row in rows])
    assert hit.sum() >= 95
    assert apart[hit].max() < 1e-5
    assert turned[hit].max() < 1e-8
    np.testing.assert_allclose([float(row["residual_mm"]) for row in rows], apart, atol=1e-6)
    np.testing.assert_allclose([float(row["residual_mrad"]) for row in rows], 1e3 * turned, atol=1e-6)
    removed = np.linalg.norm((poses_by_hand(table_of(document, "estimate"), joints) - meant)[:, :3, 3], axis=1)
    np.testing.assert_allclose([float(row["correction_mm"]) for row in rows], removed, atol=1e-5)
    moved = np.degrees(np.abs(written - joints).max(axis=1))
    np.testing.assert_allclose([float(row["correction_deg"]) for row in rows], moved, atol=1e-5)


def test_every_way_to_miss_is_named(result):
    at = [
        deg(10, 20, 30, 40, 50, 60),
        deg(160, 20, 30, 40, 50, 60),  # q1 would have to pass 160
        deg(10, 20, 30, 40, -90, 60),  # axes 4 and 6 in line, and the calibrated wrist is tilted
        deg(170, 20, 30, 40, 50, 60),
    ]
    found = compensate(result, targets_of(at))
    assert [o.value for o in found.outcomes] == ["reached", "at a joint limit", "singular", "outside the joint limits"]
    assert found.joints[1, 0] == pytest.approx(math.radians(160), abs=1e-9)
    assert 0 < found.residual_mm[1] < found.correction_mm[1]  # as near as the limit allows
    np.testing.assert_allclose(found.joints[2], at[2], atol=1e-8)  # a jump is not taken
    assert found.residual_mm[2] == pytest.approx(found.correction_mm[2], abs=1e-6)
    strict = compensate(result, targets_of(at), largest=1e-7)
    assert [o.value for o in strict.outcomes[::2]] == ["beyond the largest correction", "singular"]


def test_poses_out_of_reach_are_reported_with_and_without_a_branch(result):
    far = np.array([[4000.0, 0.0, 500.0], [1200.0, 100.0, 900.0]])
    turn = Rotation.from_euler("y", [[90], [90]], degrees=True).as_matrix()
    blank = replace(targets_of(np.zeros((2, 6))), joints=None, poses=(far, turn))
    found = compensate(result, blank)
    assert [o.value for o in found.outcomes] == ["unreachable", "reached"]
    assert np.isnan(found.joints[0]).all()
    assert "no posture takes the pose\n" in text_of(found, "krl", result)
    led = compensate(result, replace(blank, joints=found.joints[[1, 1]]))
    assert not led.reached[0]
    assert led.reached[1]
    np.testing.assert_allclose(led.joints[1], found.joints[1], atol=1e-7)


def test_a_model_that_gives_no_number_is_reported():
    def pose(p, q):
        return chain(rotate_z(q[0]), translate_x(p.l * ca.sin(q[1]) / q[1]))

    made = arm_result(Robot("odd", 2, pose, {"l": Parameter(100.0, unit="mm", prior_std=1.0)}), [0.01])
    found = compensate(made, targets_of([[0.1, 0.2], [0.1, 0.0]]))
    assert found.outcomes == (Outcome.REACHED, Outcome.NOT_FINITE)
    np.testing.assert_allclose(found.joints[1], [0.1, 0.0], atol=1e-8)
    assert "nan" not in text_of(found, "csv", made)


def test_a_batch_is_its_rows(result):
    joints = random_targets(result.source.problem.robot, 3000, 3)
    whole = compensate(result, targets_of(joints))
    assert whole.reached.mean() > 0.95
    for i in (0, 1, 777, 2999):
        alone = compensate(result, targets_of(joints[i : i + 1]))
        assert alone.outcomes[0] is whole.outcomes[i]
        np.testing.assert_allclose(alone.joints[0], whole.joints[i], atol=1e-8)
    assert compensate(result, targets_of(joints)).joints.tobytes() == whole.joints.tobytes()


def test_poses_as_predict_writes_them_come_back_to_the_same_joints(result, tmp_path):
    corner = [deg(-20, 10, 20, 30, 40, 50), deg(25, -15, 40, -30, -60, 90)]
    path = np.linspace(*corner, 40)
    write_prediction(tmp_path / "p.csv", predict(result, rows_of(path), nominal=True))
    by_joints = compensate(result, targets_of(path))
    assert by_joints.reached.all()
    targets = read_targets(tmp_path / "p.csv", result.source)
    assert targets.joints is None
    led = compensate(result, replace(targets, joints=path + 0.02))
    np.testing.assert_allclose(led.joints, by_joints.joints, atol=1e-6)
    found = compensate(result, targets)
    assert found.reached.all()
    steps = np.abs(np.diff(found.start, axis=0)).max(axis=1)
    assert steps.max() < 3 * np.abs(np.diff(path, axis=0)).max()  # one branch along the path
    assert not any("branch changes" in note for note in notes(found, result))


def test_a_change_of_branch_is_said(result):
    path = np.linspace(deg(0, 10, 20, 170, 40, 0), deg(0, 10, 20, 190, 40, 0), 15)  # past q4's limit of 180
    prediction = predict(result, rows_of(path), nominal=True)
    turns = Rotation.from_quat(np.roll(prediction.quaternions, -1, axis=1)).as_matrix()
    found = compensate(result, replace(targets_of(path), joints=None, poses=(prediction.positions, turns)))
    assert found.reached.all()
    assert np.abs(found.joints[:, 3]).max() <= math.pi
    swung = np.flatnonzero(np.abs(np.diff(found.joints, axis=0)).max(axis=1) > 1) + 1
    assert swung.size == 1
    (said,) = [note for note in notes(found, result) if "branch changes" in note]
    assert f"before line {found.targets.lines[swung[0]]};" in said


def test_tip_poses_count_at_the_tip(hsr):
    robot = hsr.problem.robot
    tool = Parameter((10.0, 20.0, 150.0), unit="mm", prior_std=1.0, labels=("_x", "_y", "_z"))
    problem = Problem(robot, DialOnPlane(noise_std=0.01, tool=tool))
    made = arm_result(robot, np.zeros(24))
    for name, value in (("tool_x", 1.0), ("tool_y", -0.5), ("tool_z", 0.7)):
        row = next(row for row in made.document["parameters"] if row["name"] == name)
        row["estimate"] = row["nominal"] + value
    made = replace(made, source=replace(made.source, problem=problem))
    joints = random_targets(robot, 20, 5)
    found = compensate(made, targets_of(joints), frame="tip")
    assert found.reached.sum() >= 18
    table = {"alpha": robot.parameters["alpha"].nominal, "a": robot.parameters["a"].nominal,
             "d": robot.parameters["d"].nominal, "theta": robot.parameters["theta"].nominal}  # fmt: skip
    meant = poses_by_hand(table, joints) @ np.array([10.0, 20.0, 150.0, 1.0])
    true = poses_by_hand(table, found.joints) @ np.array([11.0, 19.5, 150.7, 1.0])
    assert np.linalg.norm((true - meant)[found.reached, :3], axis=1).max() < 1e-4
    assert compensate(made, targets_of(joints)).correction_mm.max() < 1e-9  # the flange is where it was


def seven_axes():
    return Robot.from_dh(
        "seven",
        alpha=deg(-90, 90, 90, -90, -90, 90, 0),
        a=(0, 0, 25, -25, 0, 88, 0),
        d=(333, 0, 316, 0, 384, 0, 107),
        theta=(0,) * 7,
    )


def test_with_seven_joints_the_motion_is_the_smallest():
    changes = np.random.default_rng(2).normal(0, 1, 28) * np.repeat([1e-3, 0.7, 0.7, 1e-3], 7)
    made = arm_result(seven_axes(), changes)
    start = np.array([deg(10, -40, 20, 70, 30, 80, -20)])
    found = compensate(made, targets_of(start))
    assert found.reached.all()
    values = {row["name"]: row["estimate"] for row in made.document["parameters"]}
    alpha, a, d, theta = (np.array([values[f"{k}{i}"] for i in range(1, 8)]) for k in ("alpha", "a", "d", "theta"))
    nominal = seven_axes().parameters
    meant = dh_chain(*(nominal[k].nominal for k in ("alpha", "a", "d")), nominal["theta"].nominal + start[0])

    def miss(q):
        pose = dh_chain(alpha, a, d, theta + q)
        turn = Rotation.from_matrix(pose[:3, :3] @ meant[:3, :3].T).as_rotvec()
        return np.concatenate([(pose - meant)[:3, 3] / 100, turn])

    best = minimize(
        lambda q: 1e4 * ((q - start[0]) ** 2).sum(),
        start[0],
        method="SLSQP",
        constraints={"type": "eq", "fun": lambda q: 1e3 * miss(q)},
        options={"ftol": 1e-12, "maxiter": 200},
    )
    assert np.abs(miss(found.joints[0])).max() < 1e-7
    np.testing.assert_allclose(found.joints[0] - start[0], best.x - start[0], atol=2e-5)
    assert np.linalg.norm(found.joints[0] - start[0]) > 1e-3


def test_an_arm_with_four_joints_keeps_the_position():
    joints = [Joint("revolute", -2.5, 2.5)] * 2 + [Joint("prismatic", 0.0, 300.0), Joint("revolute", -3.0, 3.0)]
    scara = Robot.from_dh(
        "scara", alpha=deg(0, 180, 0, 0), a=(350, 300, 0, 0), d=(400, 0, 0, 0), theta=(0,) * 4, joints=joints
    )
    changes = np.array([1e-3, 2e-3, -1e-3, 0, 0.5, -0.4, 0.2, 0, 0.3, 0, 0, 0.2, 1e-3, -2e-3, 0, 1e-3])
    made = arm_result(scara, changes)
    q = np.array([[0.3, 0.8, 120.0, 0.4], [-0.5, 1.2, 60.0, -1.0]])
    found = compensate(made, targets_of(q))
    assert found.reached.all()
    assert found.residual_mm.max() < 1e-3
    assert found.residual_rad.min() > 1e-4  # a tilted column cannot be made upright, and it is said
    nominal, names = scara.parameters, ("alpha", "a", "d", "theta")
    slide = np.array([0, 0, 1, 0])

    def pose(values, joint_values):
        alpha, a, d, theta = values
        return dh_chain(alpha, a, d + slide * joint_values, theta + (1 - slide) * joint_values)

    true = [nominal[k].nominal + changes[4 * i : 4 * i + 4] for i, k in enumerate(names)]
    meant = pose([nominal[k].nominal for k in names], q[0])

    def tilt(joint_values):
        turn = pose(true, joint_values)[:3, :3] @ meant[:3, :3].T
        return 1e6 * (Rotation.from_matrix(turn).as_rotvec() ** 2).sum()

    best = minimize(
        lambda s: tilt(s * [1, 1, 300, 1]),
        found.start[0] / [1, 1, 300, 1],
        method="SLSQP",
        constraints={"type": "eq", "fun": lambda s: (pose(true, s * [1, 1, 300, 1]) - meant)[:3, 3]},
        options={"ftol": 1e-14, "maxiter": 200},
    )
    assert 1e3 * found.residual_rad[0] == pytest.approx(math.sqrt(best.fun), rel=1e-3)


def test_unseen_directions_stay_at_nominal(hsr, corner_bound):
    """At the minimum the whitened deviation has no part in the null space of the whitened Jacobian."""
    x = lm(corner_bound).x
    whitened = x / corner_bound.prior_std
    arm = np.isfinite(corner_bound.prior_std)
    jacobian = corner_bound.jacobian(x) * np.where(arm, corner_bound.prior_std, 1.0)
    _, sizes, right = np.linalg.svd(jacobian)
    null = right[(sizes < 1e-9 * sizes[0]).nonzero()[0][0] :]
    held = null[:, arm]
    flat = null[:, ~arm]
    # directions of the arm alone: those combinations of null vectors that do not move the planes
    _, s, combos = np.linalg.svd(flat.T)
    alone = combos[(s > 1e-6).sum() :] @ held
    assert len(alone) >= 1
    assert np.abs(alone @ whitened[arm]).max() < 1e-6 * np.linalg.norm(whitened[arm])


@pytest.mark.long
def test_results_that_nothing_holds_are_refused(hsr, tmp_path, cell):
    flat = hsr.problem.with_prior({"d1": math.inf, "theta1": math.inf})
    samples = simulate(hsr.problem, hsr.cell, seed=1).samples
    fitted = calibrate(flat, samples, method="lm", reference=False)
    document = calibration_document(fitted, hsr)
    write_json(tmp_path / "flat.json", document)
    with pytest.raises(CasacalError, match=r"neither samples nor prior hold d1, theta1.*--prior d1=0.7"):
        compensate(read_result(tmp_path / "flat.json"), targets_of([deg(1, 2, 3, 4, 5, 6)]))
    write_json(tmp_path / "stuck.json", resealed({**json.loads(cell(0)[0].read_text()), "converged": False}))
    with pytest.raises(CasacalError, match="did not converge"):
        compensate(read_result(tmp_path / "stuck.json"), targets_of([deg(1, 2, 3, 4, 5, 6)]))


MOVES = {
    "rapid": (r"MoveAbsJ \[\[([^\]]*)\],\[9E9,9E9,9E9,9E9,9E9,9E9\]\]\\NoEOffs, v100, fine, tool0;", "!", 1.0),
    "krl": (r"PTP \{(A1 .*, A2 .*, A3 .*, A4 .*, A5 .*, A6 .*)\}", ";", 1.0),
    "urscript": (r"movej\(\[([^\]]*)\]\)", "#", 180 / math.pi),
}


@pytest.mark.parametrize("form", MOVES)
def test_programs_parse_back_and_hold_no_move_that_was_not_reached(result, form):
    move, comment, to_degrees = MOVES[form]
    joints = np.array([deg(10, 20, 30, 40, 50, 60), deg(10, 20, 30, 40, -90, 60), deg(-10, 20, 30, 40, 50, 60)])
    nasty = ("1,2\nmovej([0,0,0,0,0,0])\r;FOLD", "Größe\u2028!\\", "x" * 5000)
    rounding = {"rapid": RAPID, "krl": KRL, "urscript": URSCRIPT}[form].rounding
    found = compensate(result, replace(targets_of(joints), text=nasty, file="a\nb.csv"), rounding=rounding)
    text = text_of(found, form, result)
    assert text.isascii()
    lines = [line.strip() for line in text.splitlines()]
    moves = [match for line in lines if (match := re.fullmatch(move, line))]
    values = np.array([[float(v) for v in re.findall(r"-?\d+\.\d+", match[1])] for match in moves]) * to_degrees
    np.testing.assert_allclose(values, np.degrees(found.joints[[0, 2]]), atol=1e-7)
    assert found.residual_mm[[0, 2]].max() < 1e-3
    frame = {
        "rapid": ["MODULE casacal_targets", "PROC take_targets()", "ENDPROC", "ENDMODULE"],
        "krl": ["DEF casacal_targets()", "BAS(#INITMOV, 0)", "END"],
        "urscript": ["def casacal_targets():", "end"],
    }[form]
    rest = [line for line in lines if not line.startswith(comment) and not re.fullmatch(move, line)]
    assert rest == frame
    assert any("no move: singular" in line for line in lines)
    assert max(map(len, lines)) < 400


@pytest.mark.parametrize("form", ["rapid", "krl", "urscript"])
def test_languages_refuse_what_they_cannot_hold(form, tmp_path, capsys):
    folder = ROOT / "problems" / "motoman_ma1400"
    source = load_problem(folder)
    document = {
        "problem": {"name": source.name, "path": source.path, "sha256": source.sha256},
        "parameters": [],
    }
    (tmp_path / "r.json").write_text(json.dumps(document))
    code = main(["compensate", str(tmp_path / "r.json"), "none.csv", "--format", form, "--out", str(tmp_path / "o")])
    assert code == 2
    assert "'Motoman MA1400' has 7 joints (RRRRRRR)" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_the_command_says_what_it_did(cell, tmp_path, capsys):
    (tmp_path / "t.csv").write_text("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n10,20,30,40,50,60\n0,0,0,0,-90,0\n")
    out = tmp_path / "c.csv"
    assert main(["compensate", str(cell(0)[0]), str(tmp_path / "t.csv"), "--out", str(out)]) == 1
    said = capsys.readouterr().out
    assert "2 targets: 1 reached, 1 singular" in said
    assert "Not reached: line 3, singular" in said
    comments = [line for line in out.read_text().splitlines() if line.startswith("#")]
    assert any("round trip: at these joint values the calibrated flange misses" in line for line in comments)
    assert any("known from the prior alone" in line and "d1" in line for line in comments)
    assert main(["predict", str(cell(0)[0]), str(out), "--out", str(tmp_path / "p.csv")]) == 0
    (tmp_path / "t.csv").write_text("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n10,20,30,40,50,60\n")
    assert main(["compensate", str(cell(0)[0]), str(tmp_path / "t.csv"), "--out", str(out)]) == 0


def test_joint_values_of_another_unit_are_asked_about(cell, tmp_path, capsys):
    """Radians under degrees lie near zero, and degrees under radians past the limits."""
    result = cell(0)[0]
    small, large, right = (tmp_path / f"{name}.csv" for name in ("small", "large", "right"))
    header = ",".join(f"q{k}_deg" for k in range(1, 7))
    small.write_text(f"{header}\n0.2,0.1,-0.3,0.4,1.5,0.6\n0.1,0.2,-0.1,0.2,6.2,0.1\n")
    right.write_text(f"{header}\n0.2,0.1,-0.3,0.4,6.4,0.6\n")
    large.write_text(header.replace("deg", "rad") + "\n0.1,0.1,-0.3,0.4,0.5,0.6\n20,10,-30,40,50,60\n")
    for command in ("predict", "compensate"):
        for file, words in ((small, "are they radians?"), (large, "line 3"), (right, "")):
            main([command, str(result), str(file), "--out", str(tmp_path / "o.csv")])
            said = capsys.readouterr().out
            assert words in said, (command, file, said)
            assert ("are they radians?" in said) == (file == small)
            assert ("outside the joint limits" in said) == (file == large), said
            held = (tmp_path / "o.csv").read_text()
            assert ("are they radians?" in held) == (file == small)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("x_mm,y_mm,z_mm,qw,qx,qy,qz\n1,2,3,1,1,0,0\n", "line 2: the quaternion has the length 1.41421"),
        ("x_mm,y_mm,qw,qx,qy,qz\n1,2,1,0,0,0\n", "there is no column for z"),
        ("x_mm,y_mm,z_mm\n1,2,3\n", "there is no column for q1"),
        ("x,y_mm,z_mm,qw,qx,qy,qz\n1,2,3,1,0,0,0\n", "the column has no unit"),
        ("q1_deg,q2_deg,q3_deg\n1,2,3\n", "there is no column for q4"),
    ],
)
def test_bad_targets_are_refused_in_one_line(cell, tmp_path, capsys, text, says):
    (tmp_path / "t.csv").write_text(text)
    code = main(["compensate", str(cell(0)[0]), str(tmp_path / "t.csv"), "--out", str(tmp_path / "c.csv")])
    captured = capsys.readouterr()
    assert code == 2
    assert says in captured.err
    assert captured.err.count("\n") == 1
    assert not (tmp_path / "c.csv").exists()


def test_written_joints_stay_inside_the_limits(result):
    found = compensate(result, targets_of([deg(160, 20, 30, 40, 50, 60)]), rounding=Rounding(degrees=False, decimals=3))
    assert found.joints.max() <= deg(160)


def test_a_start_beyond_the_limits_is_brought_inside():
    problem = load_problem(ROOT / "problems" / "hsr_jr680").problem
    arm = PosedArm.of(problem, np.zeros(problem.model.pose.numel_in(0)))
    lower, upper = problem.robot.limits
    positions, rotations, _ = arm((lower + upper)[None] / 2)
    np.testing.assert_array_equal(arm.reach(positions, rotations, (upper + 1.0)[None], steps=0)[0], upper)
    np.testing.assert_array_equal(arm.reach(positions, rotations, (lower - 1.0)[None], steps=0)[0], lower)
