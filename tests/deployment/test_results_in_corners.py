"""Results in corners: effects at their largest, forms that hold the flange alone, readings in a file of their own."""

import csv
import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

from casacal import calibrate, changed, load_problem, simulate, verify
from casacal.calibration.fresh import opened, with_memory
from casacal.changes.changed import CauseFound, _next
from casacal.cli.main import main
from casacal.data.samples import write_samples
from casacal.data.text import typed_rows
from casacal.deployment.export import _remarked
from casacal.deployment.remark import remark
from casacal.deployment.result_file import read_result

HSR, UR5, THREE = (str(ROOT / "problems" / name) for name in ("hsr_jr680", "ur5", "ur5_three_instruments"))
FACES = ("floor", "wall", "side")


@pytest.fixture(scope="module")
def kept(hsr, tmp_path_factory):
    """A result of 90 touches on disk, its folder, and 30 touches more."""
    made, folder = simulate(hsr.problem, hsr.cell, samples=120, seed=3).samples, tmp_path_factory.mktemp("kept")
    calibrate(hsr, made.take(np.arange(90)), reference=False).save(folder / "fit")
    return folder / "fit", made.take(np.arange(90, 120)), folder


def test_what_is_known_of_effects_is_the_estimate_and_no_more():
    """An effect that is corrected and at its largest size is counted once: arms that did not change are not changed."""
    source = load_problem(UR5)
    cell = replace(source.cell, compliance=2.22)
    rows, k = simulate(source.problem, cell, samples=200, seed=3).samples, np.arange(200)
    made, fresh = calibrate(source, rows.take(k[k % 5 != 0]), reference=False), rows.take(k[k % 5 == 0])
    assert made.corrected == ("give",)
    case = opened(made, fresh, problem=None, instrument=None, standing=("plane",))
    memory = with_memory(case.fresh(("plane",)), case.arm)
    estimate = dict(zip(made.fit.names, made.result.x, strict=True))
    moving = set(made.unjudged.motion.arm.names)
    for j in np.flatnonzero(memory.known):
        name = memory.bound.names[j]
        if name in moving and memory.bound.beside[j] != "growth":
            assert memory.at[j] == pytest.approx(estimate[name], rel=1e-9, abs=1e-15)
    assert changed(made, fresh, standing=("plane",)).ended == "nothing"
    assert calibrate(source, fresh, prior=made, standing=("plane",), reference=False).earlier_chance > 0.01


def test_a_slipped_joint_breaks_the_promise_where_faces_stand(kept):
    """What is known of geometry and effects together is less wide than both as if one knew nothing of the other."""
    folder, fresh, _ = kept
    assert verify(folder, fresh, standing=FACES).kept
    for joint, slip in ((1, 0.15e-3), (0, 0.2e-3)):
        joints = fresh.joints.copy()
        joints[:, joint] += slip
        assert not verify(folder, replace(fresh, joints=joints), standing=FACES).kept


def test_a_form_that_holds_the_flange_promises_the_flange(kept):
    arm = read_result(kept[0])
    flange = arm.found.tip.flange_expected_mm
    for form in ("dh", "urdf", "ur", "c", "casadi"):
        said = "\n".join(remark(arm, form=form))
        assert f"expected error of the flange, which this form holds: {flange:.3f} mm" in said
        assert "with the tool as calibrated, which is no part of it" in said
    assert "expected" not in "\n".join(remark(arm, form="zeros"))
    assert "flange" not in "\n".join(remark(arm, form="frame"))


def split(rows, problem, folder):
    """Poses and readings of rows in two files, joined by a number."""
    write_samples(folder / "whole.csv", problem.layout(), rows, [])
    lines = [line for line in (folder / "whole.csv").read_text().splitlines() if not line.startswith("#")]
    table = list(csv.reader(lines))
    at = next(k for k, name in enumerate(table[0]) if name.startswith("reading"))
    poses = [["pose", *table[0][:at], *table[0][at + 1 :]]]
    poses += [[str(k), *row[:at], *row[at + 1 :]] for k, row in enumerate(table[1:])]
    readings = [["pose", table[0][at]], *([str(k), row[at]] for k, row in enumerate(table[1:]))]
    for name, some in (("the poses.csv", poses), ("readings.csv", readings)):
        (folder / name).write_text("\n".join(map(",".join, some)) + "\n")
    return str(folder / "the poses.csv"), str(folder / "readings.csv")


def test_readings_in_a_file_of_their_own_say_which_instrument_took_them(tmp_path, capsys):
    problem = load_problem(THREE).problem
    source = load_problem(THREE)
    made = simulate(source.problem, source.cell, samples={"dial": 60, "tracker": 30, "spike": 24}, seed=4)
    rows = dict(zip(problem.names, made.measured.sets, strict=True))
    calibrate(source, rows, method="lm", reference=False, discrepancy="none").save(tmp_path / "fit")
    session = simulate(source.problem, source.cell, samples={"dial": 30, "tracker": 12, "spike": 12}, seed=4, session=1)
    poses, readings = split(session.measured.sets[0], problem.measured_by("dial"), tmp_path)
    assert main(["verify", str(tmp_path / "fit"), poses, "--readings", readings]) == 0
    assert "Promise kept" in capsys.readouterr().out


def test_advice_names_both_files_of_rows(kept, hsr, tmp_path, capsys):
    assert typed_rows("a.csv") == "a.csv"
    folder, fresh, _ = kept
    joints = fresh.joints.copy()
    joints[:, 1] += 5e-3 * np.sign(np.sin(np.arange(30)))
    poses, readings = split(replace(fresh, joints=joints), hsr.problem, tmp_path)
    assert main(["verify", str(folder), poses, "--readings", readings]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert f"casacal check PROBLEM '{poses}' --readings {readings}" in said


def test_a_comment_before_the_robot_may_hold_what_looks_like_a_tag(kept):
    text = "<?xml version='1.0'?>\n<!-- Jane Doe <jane@example.org> -->\n<robot name='r'><link name='a'/></robot>\n"
    written = _remarked(text, read_result(kept[0]))
    assert ET.fromstring(written).tag == "robot"
    assert written.index("jane@example.org") < written.index("casacal:") < written.index("<robot")
    assert _remarked(written, read_result(kept[0])) == written


@pytest.mark.parametrize(("held", "words"), [(True, "--free tool"), (False, "--loosen tool")])
def test_the_advice_after_a_change_of_the_tool_can_be_followed(kept, held, words):
    folder, fresh, _ = kept
    found = changed(folder, fresh, standing=FACES)
    cause = CauseFound("tool", "tool", 0, ("z",), ("mm",), np.array([0.8]), np.array([0.01]), 0.0, 1.0, 0.5, True, held)
    said = _next(replace(found, causes=(cause,), ended="changed"))
    assert words in said


def test_a_zero_of_the_dial_that_was_set_anew_is_taken_in_as_advised(kept, tmp_path, capsys, hsr):
    """The HSR's problem holds its tool, as a dial's problem does by default."""
    folder, fresh, _ = kept
    moved = replace(fresh, columns={"reading": fresh.columns["reading"] + 0.8})
    write_samples(tmp_path / "h.csv", hsr.problem.layout(), moved, [])
    assert main(["changed", str(folder), str(tmp_path / "h.csv"), "--standing", ",".join(FACES)]) == 1
    said = " ".join(capsys.readouterr().out.split())
    command = said[said.index("casacal calibrate PROBLEM") : said.index(") or calibrate again")]
    assert "--free tool" in command
    words = [HSR if word == "PROBLEM" else word for word in command.split()[1:]]
    assert main([*words, "--no-reference", "--method", "lm"]) == 0


def test_a_page_says_what_its_figures_are_compared_with(kept, hsr, tmp_path):
    folder, fresh, _ = kept
    known = {"prior": folder, "standing": FACES}
    calibrate(hsr, fresh, method="lm", reference=False, **known).save(tmp_path / "second")
    page, first = ((place / "report.html").read_text() for place in (tmp_path / "second", Path(folder)))
    for words in ("the arm by the earlier result", "Before: the earlier result", "largest change from the earlier"):
        assert words in page
        assert words not in first
    for words in ("the arm as drawn", "Before: priors alone", "The largest correction in the workspace"):
        assert words not in page
        assert words in first


def test_json_of_predictions_holds_what_the_terminal_says(kept, tmp_path, capsys):
    target = tmp_path / "t.csv"
    target.write_text("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n10,20,30,-50,-55,-50\n")
    program = tmp_path / "p.mod"
    external = ",".join(["9E9"] * 6)
    program.write_text(
        f"MODULE m\nCONST jointtarget t:=[[10,20,30,-50,-55,-50],[{external}]];\n"
        "PROC main()\nMoveAbsJ t,v100,fine,tool0;\nENDPROC\nENDMODULE\n"
    )
    for file in (target, program):
        assert main(["predict", str(kept[0]), str(file), "--out", str(tmp_path / "o.csv"), "--json"]) == 0
        notes = json.loads(capsys.readouterr().out)["notes"]
        assert any("counted the other way" in note for note in notes)


def test_corrections_of_slides_have_a_column_of_their_own(tmp_path):
    place = ROOT / "problems" / "instruments" / "rail"
    source = load_problem(place)
    made = simulate(source.problem, source.cell, samples=80, seed=2)
    calibrate(source, made.samples, method="lm", reference=False, discrepancy="none").save(tmp_path / "fit")
    joints, turns = made.samples.joints[:5], source.problem.robot.revolute
    units = np.where(turns, np.degrees(1), 1.0)
    header = ",".join(f"q{k}_{'deg' if turn else 'mm'}" for k, turn in enumerate(turns, 1))
    rows = "\n".join(",".join(f"{v:.6f}" for v in row) for row in joints * units)
    (tmp_path / "t.csv").write_text(f"{header}\n{rows}\n")
    out = tmp_path / "o.csv"
    assert main(["compensate", str(tmp_path / "fit"), str(tmp_path / "t.csv"), "--out", str(out), "--force"]) in (0, 1)
    with out.open() as stream:
        written = list(csv.DictReader(line for line in stream if not line.startswith("#")))
    names = header.split(",")
    moved = np.abs(np.array([[float(row[name]) for name in names] for row in written]) - joints * units)
    for row, each in zip(written, moved, strict=True):
        assert float(row["correction_deg"]) == pytest.approx(each[turns].max(), abs=2e-5)
        assert float(row["correction_slide_mm"]) == pytest.approx(each[~turns].max(), abs=2e-3)


def test_a_box_that_is_none_throws_no_calibration_away(tmp_path, capsys, hsr, kept):
    write_samples(tmp_path / "s.csv", hsr.problem.layout(), kept[1], [])
    plain = ["calibrate", HSR, str(tmp_path / "s.csv"), "--method", "lm", "--no-reference", "--discrepancy", "none"]
    assert main([*plain, "--box", "500:300,-100:100,0:400"]) == 2
    assert "is empty" in capsys.readouterr().err
    known = ["--prior-from", str(kept[0]), "--standing", ",".join(FACES)]
    out = tmp_path / "fit"
    assert main([*plain, *known, "--box", "9000:9100,0:100,0:100", "--out", str(out)]) == 0
    assert "put the tip inside the box" in " ".join(capsys.readouterr().out.split())
    assert (out / "result.json").is_file()


def test_a_report_that_is_not_there_is_said_before_anything_is_judged(kept, tmp_path, capsys, hsr):
    write_samples(tmp_path / "f.csv", hsr.problem.layout(), kept[1], [])
    lone = tmp_path / "lone"
    lone.mkdir()
    (lone / "result.json").write_bytes((Path(kept[0]) / "result.json").read_bytes())
    page = tmp_path / "a.html"
    options = ["--report", str(page), "--into-report"]
    assert main(["verify", str(lone / "result.json"), str(tmp_path / "f.csv"), *options]) == 2
    assert "no report" in capsys.readouterr().err
    assert not page.exists()


def test_the_option_that_would_write_over_rows_is_named(kept, tmp_path, capsys, hsr):
    write_samples(tmp_path / "f.csv", hsr.problem.layout(), kept[1], [])
    file = str(tmp_path / "f.csv")
    assert main(["changed", str(kept[0]), file, "--touches", file]) == 2
    assert "Name another --touches" in capsys.readouterr().err
