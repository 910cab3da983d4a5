"""What one output says, another says as well: of several instruments, of programs, of pages, of JSON."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT

from casacal import Problem, TrackedPoint, calibrate, load_problem, simulate, verify
from casacal.cli.main import main
from casacal.data.samples import write_samples
from casacal.deployment.arm import FLANGE_UNKNOWN, CalibratedArm, cautions, for_instrument
from casacal.deployment.compensate import compensate
from casacal.deployment.predict import predict
from casacal.deployment.programs import notes
from casacal.deployment.remark import remark
from casacal.deployment.result_file import read_result
from casacal.deployment.work_frame import work_frame
from casacal.effects import GravitySag
from casacal.model.dial import dial_zero
from casacal.programs.correct import compensate_program
from casacal.values import FrozenMapping

JOINTS = np.radians([[10, 20, 10, 40, 70, 60], [-30, 10, 20, -60, -60, 10], [45, -15, 30, 100, 50, -90]])


@pytest.fixture(scope="module")
def done(corner_simulation, hsr, tmp_path_factory):
    """Two results of one arm type, saved: the second from fewer touches."""
    made = []
    for count in (120, 60):
        folder = tmp_path_factory.mktemp("done")
        rows = corner_simulation.samples
        some = rows.take(np.arange(0, len(rows), max(len(rows) // count, 1)))
        calibrate(hsr, some, method="lm", reference=False, discrepancy="none").save(folder)
        made.append(read_result(folder))
    return made


def changed_in(arm, **parts):
    """A result with other parts in its document."""
    return CalibratedArm(arm.file, arm.source, FrozenMapping({**arm.document, **parts}))


def targets_of(folder, joints):
    header = ",".join(f"q{i}_deg" for i in range(1, 7))
    text = "\n".join(",".join(f"{v:.6f}" for v in row) for row in np.degrees(joints))
    (folder / "t.csv").write_text(f"{header}\n{text}\n")
    return str(folder / "t.csv")


def program_of(folder, joints, name="p.mod"):
    """A RAPID program that goes to joint targets t0, t1, ..."""
    external = ",".join(["9E9"] * 6)
    lines = [
        f"CONST jointtarget t{k}:=[[{','.join(f'{v:.4f}' for v in row)}],[{external}]];"
        for k, row in enumerate(np.degrees(joints))
    ]
    moves = [f"MoveAbsJ t{k},v100,fine,tool0;" for k in range(len(joints))]
    (folder / name).write_text("\n".join(["MODULE m", *lines, "PROC main()", *moves, "ENDPROC", "ENDMODULE", ""]))
    return str(folder / name)


@pytest.fixture(scope="module")
def three():
    source = load_problem(ROOT / "problems" / "ur5_three_instruments")
    return calibrate(source, method="lm", reference=False)


def test_a_work_frame_of_one_of_several_instruments_stands_where_its_faces_meet(three):
    arm = for_instrument(three.arm, "dial")
    found = work_frame(arm, faces=["floor", "wall", "side"])
    planes = {name.removeprefix("dial "): each for name, each in three.arm.document["planes"].items()}
    normals = np.array([planes[name]["normal"] for name in ("floor", "wall", "side")])
    points = np.array([planes[name]["point_mm"] for name in ("floor", "wall", "side")])
    meet = np.linalg.solve(normals, (normals * points).sum(axis=1))
    assert found.matrix[:3, 3] == pytest.approx(meet, abs=1e-3)
    assert found.matrix[:3, 2] == pytest.approx(normals[0], abs=1e-6)
    assert 0.001 < found.origin_std < 1.0


def test_a_tip_error_of_the_first_instrument_is_not_told_of_another(three):
    said = {**three.arm.document["discrepancy"], "corrected": ["sag"], "expected_rms_mm_without_corrections": 0.123}
    told = changed_in(three.arm, discrepancy=said)
    assert "0.123" in " ".join(remark(for_instrument(told, "dial"), form="dh"))
    assert "0.123" not in " ".join(remark(for_instrument(told, "tracker"), form="dh"))


def test_a_tip_of_no_session_is_the_tools_point_to_predict_and_compensate_alike(hsr, tmp_path):
    """Without a reading, where the dial stood at zero is no matter: every target is reached."""
    zeroed = Problem(hsr.problem.robot, replace(hsr.problem.instrument, zero_shift=dial_zero()))
    calibrate(zeroed, zeroed.read(hsr.samples), method="lm", reference=False, discrepancy="none").save(tmp_path)
    found = compensate(read_result(tmp_path), JOINTS, frame="tip")
    assert found.reached.all()
    assert found.residual_mm.max() < 1e-4


def test_both_arms_err_where_a_program_goes_from_one_to_another(done, tmp_path):
    one, two = done
    path = program_of(tmp_path, JOINTS)
    found = compensate_program(one, path, onto=two)
    alone = [predict(arm, JOINTS, std=True).std for arm in (one, two)]
    assert found.expected_mm == pytest.approx(np.hypot(*alone), rel=0.01)


def test_an_error_of_the_flange_that_is_not_known_is_no_number_anywhere(done, tmp_path):
    tip = {**done[0].document["tip"], "flange_expected_rms_mm": None}
    arm = changed_in(done[0], tip=tip)
    assert np.isnan(predict(arm, JOINTS, std=True).std).all()
    assert np.isfinite(predict(arm, JOINTS, std=True, frame="tip").std).all()
    assert np.isfinite(predict(done[0], JOINTS, std=True).std).all()
    found = compensate(arm, JOINTS)
    assert np.isnan(found.expected_mm).all()
    assert FLANGE_UNKNOWN in notes(found, arm)
    assert np.isnan(compensate_program(arm, program_of(tmp_path, JOINTS)).expected_mm).all()


def test_a_program_says_that_an_arm_is_the_truth_and_its_moves_largest_first(hsr, tmp_path, capsys):
    where = str(ROOT / "problems" / "hsr_jr680")
    assert main(["simulate", where, "--samples", "40", "--seed", "2", "--out", str(tmp_path / "s.csv")]) == 0
    capsys.readouterr()
    truth = str(tmp_path / "s.truth.json")
    path = program_of(tmp_path, np.vstack([JOINTS, np.radians([[170, 20, 10, 40, 70, 60]])]))  # one beyond its limit
    out = str(tmp_path / "o.mod")
    assert main(["compensate", truth, path, "--out", out, "--skip-unknown", "--json"]) == 1
    said = json.loads(capsys.readouterr().out)
    sizes = [move["correction_mm"] for move in said["moves"]]
    assert len(sizes) == 3
    assert sizes == sorted(sizes, reverse=True)
    assert any("the true arm of a simulation" in words for words in said["notes"])
    assert said["left"][0]["file"] == path
    assert main(["predict", truth, path, "--out", str(tmp_path / "o.csv")]) == 1
    assert "the true arm of a simulation" in " ".join(capsys.readouterr().out.split())
    assert "the true arm of a simulation" in (tmp_path / "o.csv").read_text().split("line,target")[0]


def test_a_mirror_image_is_told_of_whatever_is_cartesian(done):
    image = {"reversed": [1, 4, 6], "half_turned": [], "off_mm": 700.0}
    arm = changed_in(done[0], mirror_image=image)
    assert arm.mirror_words is not None
    assert arm.mirror_words in cautions(arm)
    assert arm.mirror_words not in cautions(arm, posed=False)


def test_what_verify_says_on_a_terminal_stands_in_page_and_json(hsr, done, tmp_path, capsys):
    where = str(ROOT / "problems" / "hsr_jr680")
    assert main(["simulate", where, "--samples", "30", "--seed", "4", "--out", str(tmp_path / "s.csv")]) == 0
    capsys.readouterr()
    truth, rows, page = str(tmp_path / "s.truth.json"), str(tmp_path / "s.csv"), tmp_path / "v.html"
    asked = ["verify", truth, rows, "--tolerance", "0.001", "--risk", "0.45", "--report", str(page), "--json"]
    main(asked)
    assert "true arm of a simulation" in " ".join(json.loads(capsys.readouterr().out)["remarks"])
    assert "true arm of a simulation" in page.read_text()
    arm = changed_in(done[0], mirror_image={"reversed": [1, 4, 6], "half_turned": [], "off_mm": 700.0})
    found = verify(arm, hsr.problem.read(rows))
    assert arm.mirror_words in found.summary()
    assert arm.mirror_words[:40] in found.page()


def test_fresh_rows_of_a_program_are_those_of_a_table(hsr, done, tmp_path, capsys):
    rows = simulate(hsr.problem, hsr.cell, samples=30, seed=4).samples
    joints = np.radians(np.round(np.degrees(rows.joints), 4))
    rows = replace(rows, joints=joints)
    write_samples(tmp_path / "s.csv", hsr.problem.layout(), rows, [])
    path = program_of(tmp_path, joints)
    with (tmp_path / "r.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["pose", "reading_mm", "plane"])
        pairs = zip(rows.columns["reading"], rows.labels["plane"], strict=True)
        writer.writerows([f"t{k}", *each] for k, each in enumerate(pairs))
    said = []
    for asked in ([str(tmp_path / "s.csv")], [path, "--readings", str(tmp_path / "r.csv")]):
        main(["verify", done[0].file, *asked, "--json"])
        said.append(json.loads(capsys.readouterr().out))
    assert said[0]["chi_square"] == pytest.approx(said[1]["chi_square"], rel=1e-3)


def test_doctor_joins_poses_to_what_the_pendant_shows(hsr, tmp_path, capsys):
    poses = predict(calibrate(hsr, method="plane-only"), JOINTS, nominal=True)
    targets_of(tmp_path, JOINTS)
    table = (tmp_path / "t.csv").read_text().splitlines()
    named = [f"pose,{table[0]}", *(f"t{k},{line}" for k, line in enumerate(table[1:]))]
    (tmp_path / "poses.csv").write_text("\n".join(named) + "\n")
    cells = np.column_stack([poses.positions, poses.quaternions])
    shown = ["pose,x,y,z,qw,qx,qy,qz", *(f"t{k}," + ",".join(f"{v:.8f}" for v in row) for k, row in enumerate(cells))]
    (tmp_path / "pendant.csv").write_text("\n".join(shown) + "\n")
    where = str(ROOT / "problems" / "hsr_jr680")
    main(["doctor", where, str(tmp_path / "poses.csv"), "--readings", str(tmp_path / "pendant.csv"), "--json"])
    assert json.loads(capsys.readouterr().out)["meanings"]


def test_a_declared_effect_is_not_lost_where_another_instrument_verifies(hsr):
    """It belongs to the arm, whoever looks at it."""
    declared = hsr.problem.with_terms(GravitySag(size=0.5))
    made = calibrate(declared, simulate(declared, hsr.cell, samples=80, seed=1).samples, method="lm", reference=False)
    tracker = Problem(hsr.problem.robot, TrackedPoint(noise_std=0.02))
    from casacal.calibration.fresh import opened

    rows = simulate(tracker, samples=30, seed=2).samples
    case = opened(made, rows, problem=tracker, instrument=None, standing=())
    assert [term.key for term in case.source.problem.terms] == [term.key for term in made.source.problem.terms]
    assert case.source.problem.terms
