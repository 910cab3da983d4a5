"""Plans of five arms from their makers' tables, looked at by kinematics of our own: nothing goes below the table."""

import argparse
import dataclasses
import io
import json
import math
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import ROOT
from planned_arms import ARMS

from casacal import CasacalError, Cell, Face, Parameter, Robot, chain, corner, load_problem, plan
from casacal.cli.main import main
from casacal.cli.plan import _following
from casacal.errors import SimulationError
from casacal.model.capsules import above_table
from casacal.model.kinematics import translate_x
from casacal.planning.candidates import pool_of
from casacal.planning.clearance import Clearance
from casacal.planning.set_ups import POOL, set_ups
from casacal.simulation.cell import Disturbances
from casacal.simulation.places import default_cell

pytestmark = pytest.mark.usefixtures("set_ups_of_few")
BY_NAME = {arm.name: arm for arm in ARMS}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A problem folder for each arm, made by `casacal new` from its table."""
    place, found = tmp_path_factory.mktemp("arms"), {}
    for arm in ARMS:
        table = place / "dh.csv"
        table.write_text(arm.csv())
        name = arm.name.replace(" ", "_")
        tool = ",".join(map(str, arm.tool))
        common = ["--tool", tool, "--sign", "-1", "--travel", "10", "--accuracy", "0.5", "--out", str(place)]
        assert main(["new", name, "--dh", str(table), *common]) == 0
        found[arm.name] = place / name
    return found


def heights(arm, joints):
    """Lowest of all joints' origins and the tip (mm) in each posture, in degrees and mm."""
    return np.array([arm.origins(row)[:, 2].min() for row in joints])


def joints_of(path, arm):
    rows = pd.read_csv(path, comment="#")
    names = [f"q{k}_{'mm' if k in arm.slides else 'deg'}" for k in range(1, len(arm.rows) + 1)]
    return rows, rows[names].to_numpy(float)


@pytest.mark.long_unless("UR10e")
@pytest.mark.parametrize("name", ["UR10e", "SCARA"])
def test_nothing_goes_below_the_base_plane_and_each_face_is_told(folders, tmp_path, capsys, name):
    arm, out, sheet = BY_NAME[name], tmp_path / "plan.csv", tmp_path / "sheet.html"
    capsys.readouterr()
    asked = ["plan", str(folders[name]), "--out", str(out), "--touches", "40", "--pool", "300", "--sheet", str(sheet)]
    assert main(asked) == 0
    said = capsys.readouterr().out
    assert said.startswith("Collisions looked at: links, as rods of ")
    assert main([*asked, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    rows, joints = joints_of(out, arm)
    assert heights(arm, joints).min() > -1e-3
    assert found["table_mm"] == 0
    assert found["collisions_checked"] is True
    assert found["collisions"].startswith(f"Collisions looked at: links, as rods of {found['link_radius_mm']} mm")
    assert {face["label"] for face in found["faces"]} == set(rows["plane"])
    for face in found["faces"]:
        centre, normal, size = (np.array(face[key]) for key in ("centre_mm", "normal", "size_mm"))
        across = np.linalg.svd(normal[None])[2][1:]  # the face is square, so half its diagonal reaches lowest
        assert centre[2] - np.hypot(*across[:, 2]) * size[0] / 2 > -1e-9
        assert centre[0] > 0, "in front of the base"
        here = (rows["plane"] == face["label"]).to_numpy()
        readings, needed = rows["expected_reading_mm"].to_numpy()[here], []
        for q, reading in zip(joints[here], readings, strict=True):
            (*_, tip), pushed = arm.origins(q), arm.moved_tool(q, reading)
            assert abs(normal @ (pushed - centre)) < 0.02, "on the face"
            assert np.linalg.norm(pushed - centre) < np.linalg.norm(size) / 2 + 0.1
            assert pushed[2] > -1e-3
            slope = normal @ (pushed - tip) / reading
            needed.append([reading + off / slope for off in face["off_mm"]])
        low, high = face["off_mm"]
        assert low < 0 < high
        needed = np.array(needed)
        assert needed.min() == pytest.approx(0, abs=2e-3), "one touch is at the end of the dial, none is beyond"
        assert needed.max() == pytest.approx(10, abs=2e-3)
        x, y, z = centre
        words = f"centre ({x:.0f}, {y:.0f}, {z:.0f}) mm"
        told = f"may stand off by {low:+.1f} to {high:+.1f} mm"
        for text in (said, out.read_text(), sheet.read_text()):
            assert words in " ".join(text.split())
            assert told in " ".join(text.split())
            assert "Collisions looked at: links, as rods of" in " ".join(text.split())
            assert "what else stands around were not looked at" in " ".join(text.split())


@pytest.mark.long
def test_ten_plans_stay_above_the_table(folders):
    for name, arm in BY_NAME.items():
        source = load_problem(folders[name])
        for seed in range(2):
            joints = plan(source.problem, touches=30, pool=300, starts=1, seed=seed).samples.joints
            shown = np.where(source.problem.robot.revolute, np.degrees(joints), joints)
            assert heights(arm, shown).min() > -1e-3, (name, seed)


@pytest.mark.long
def test_a_table_may_be_lower_or_higher(folders, tmp_path, capsys):
    arm, out = BY_NAME["UR10e"], tmp_path / "plan.csv"
    asked = ["plan", str(folders["UR10e"]), "--out", str(out), "--touches", "30", "--pool", "200", "--json"]
    for table in (-400.0, 150.0):
        assert main([*asked, "--table", str(table)]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["table_mm"] == table
        lowest = heights(arm, joints_of(out, arm)[1]).min()
        assert table - 1e-3 < lowest < table + 250
        floor = next(face for face in found["faces"] if face["label"] == "floor")
        assert floor["centre_mm"][2] == pytest.approx(table + 20), "a plate lies on the table"
    assert main([*asked, "--table", "nan"]) == 2
    assert "Give its height in mm" in capsys.readouterr().err


def test_a_face_below_the_table_is_refused(folders):
    source = load_problem(folders["UR5"])
    low = Cell(faces=corner((500.0, 0.0, 50.0), size=300.0))
    with pytest.raises(SimulationError, match=r"Face 'floor' reaches down to z = -100 mm, and the table is at 0 mm"):
        plan(source.problem, low, touches=20, pool=60)
    made = plan(source.problem, Cell(faces=low.faces, table=-150.0), touches=20, pool=60, starts=1)
    assert made.cell.table == -150
    with pytest.raises(CasacalError, match="above the table at z = 700 mm"):
        plan(source.problem, Cell(faces=(Face("p", (500.0, 0.0, 710.0), (0, 0, 1)),), table=700.0), touches=20, pool=60)


def test_other_instruments_keep_above_the_table_too():
    several = load_problem(ROOT / "problems" / "ur5_three_instruments").problem.measured_by("tracker")
    for table in (0.0, -math.inf):
        made = plan(several, Disturbances(table=table), touches=20, pool=60, starts=1)
        lowest = min(BY_NAME["UR5"].origins(q)[:-1, 2].min() for q in np.degrees(made.samples.joints))
        assert (lowest > -1e-3) == (table == 0)


@pytest.mark.long
def test_links_that_were_looked_at_are_not_said_to_be_unchecked(folders, tmp_path, capsys):
    arm, out = BY_NAME["IRB 120"], tmp_path / "plan.csv"
    asked = ["plan", str(folders["IRB 120"]), "--out", str(out), "--touches", "30", "--pool", "100"]
    assert main([*asked, "--link-radius", "40"]) == 0
    assert "not checked" not in capsys.readouterr().out
    moving = np.array([arm.origins(q)[1:-1, 2].min() for q in joints_of(out, arm)[1]])
    assert moving.min() > 40 - 1e-3, "links stay their radius above the table"
    source = load_problem(folders["IRB 120"])
    made = plan(source.problem, clearance=Clearance(link_radius=40.0), touches=20, pool=60, starts=1)
    assert made.cell.faces == default_cell(source.problem).faces


@pytest.mark.long
def test_links_that_were_not_looked_at_are_said_to_be_unchecked(folders, tmp_path, capsys):
    out, robot = tmp_path / "plan.csv", load_problem(folders["UR5"]).problem.robot
    asked = ["plan", str(folders["UR5"]), "--out", str(out), "--touches", "12", "--pool", "60", "--link-radius", "0"]
    assert main([*asked, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["collisions_checked"] is False
    assert found["collisions"].startswith(
        "Collisions not checked: of the arm only joints, flange and tip are kept off the"
    )
    assert "Collisions not checked" in out.read_text()
    odd = Robot(
        "odd", joints=2, pose=lambda p, q: chain(translate_x(p.l * q[0] * q[1])), parameters={"l": Parameter(9.0)}
    )
    around = Clearance((((0.0, 10.0),) * 3,)).around(odd, Disturbances())
    assert "only the tip is kept off the table, box 1; links (joints do not carry one another in order)" in around.words
    tips = np.array([[5.0, 5.0, 5.0], [5.0, 5.0, 15.0], [5.0, 5.0, -1.0]])
    assert around.clear(np.zeros((3, 2)), tips).tolist() == [False, True, False]
    assert Clearance((), 0).around(robot, None).words.startswith("Collisions not checked: of the arm nothing")


@pytest.mark.parametrize(("name", "low", "high"), [("UR5", 50, 65), ("UR10e", 65, 95), ("LBR iiwa 14", 58, 75)])
def test_links_are_as_thick_as_their_makers_draw_them(folders, name, low, high):
    around = Clearance().around(load_problem(folders[name]).problem.robot, None)
    assert low <= around.radius <= high


def test_what_is_in_the_way_is_named(folders):
    """A wall across the arm's middle, behind which the plate lies: its forearm is in the way, and nothing else."""
    source = load_problem(folders["UR5"])
    wall = ((250.0, 260.0), (-2000.0, 2000.0), (-2000.0, 2000.0))
    plate = Cell(faces=(Face("p", (600.0, 0.0, 50.0), (0, 0, 1), (100.0, 100.0)),))
    with pytest.raises(CasacalError, match=r"Only 0 of \d+ .* In the way: link \d against box 1 \(\d+%\)"):
        plan(source.problem, plate, touches=20, pool=60, clearance=Clearance((wall,)))


def test_a_face_that_hardly_any_touch_reaches_is_named(folders):
    """A plate under a beam that only the fewest postures pass, beside one that stands free."""
    source = load_problem(folders["UR5"])
    beam = ((300.0, 900.0), (100.0, 700.0), (190.0, 220.0))
    plates = (Face("free", (400.0, -300.0, 50.0), (0, 0, 1), (200.0, 200.0)),
              Face("under", (550.0, 400.0, 50.0), (0, 0, 1), (200.0, 200.0)))  # fmt: skip
    with pytest.raises(CasacalError, match=r"Only \d of \d+ reachable touches of face 'under' keep clear"):
        plan(source.problem, Cell(faces=plates), touches=20, pool=60, clearance=Clearance((beam,)))


def test_the_tip_is_asked_as_well_as_the_joints_also_of_an_arm_that_is_no_chain(folders):
    robot = load_problem(folders["UR5"]).problem.robot
    up, down = np.radians([[0, -90, 0, -90, 0, 0], [0, 60, 0, -90, 0, 0]])
    tips = np.array([[0.0, 0.0, 5.0], [0.0, 0.0, -5.0]])
    stands = above_table(robot, 0.0)
    assert [bool(stands(q[None], tip[None])[0]) for q in (up, down) for tip in tips] == [True, False, False, False]
    assert above_table(robot, -1e4)(np.array([up, down]), tips).all()
    odd = Robot(
        "odd", joints=2, pose=lambda p, q: chain(translate_x(p.l * q[0] * q[1])), parameters={"l": Parameter(9.0)}
    )
    assert above_table(odd, 0.0)(np.zeros((2, 2)), tips).tolist() == [True, False]


@pytest.mark.long
def test_touches_that_were_made_elsewhere_are_refused_not_planned_on(folders, tmp_path, capsys):
    """With the table forgotten, new touches would hang 400 mm above the plate, and the promise would be absurd."""
    problem, plan_file, rows = str(folders["UR5"]), str(tmp_path / "p.csv"), str(tmp_path / "s.csv")
    common = ["--touches", "60", "--pool", "200"]
    assert main(["plan", problem, "--table=-400", "--out", plan_file, *common]) == 0
    assert "casacal measure" in (said := capsys.readouterr().out)
    assert "--table=-400" in said
    assert main(["measure", problem, "--plan", plan_file, "--out", str(tmp_path / "m.csv")]) == 2
    assert "planned with the table at z = -400 mm, and here it is at 0 mm" in capsys.readouterr().err
    assert main(["simulate", problem, "--plan", plan_file, "--out", rows]) == 2
    assert "Give --table=-400" in capsys.readouterr().err
    assert main(["simulate", problem, "--table=-400", "--plan", plan_file, "--out", rows]) == 0
    again = ["plan", problem, "--after", rows, "--out", str(tmp_path / "q.csv"), "--touches", "12", "--pool", "60"]
    assert main(again) == 2
    assert "lie 400 mm from where the cell has that face" in capsys.readouterr().err.replace("401", "400").replace(
        "399", "400"
    )
    assert main([*again, "--table=-400"]) == 0


@pytest.mark.long_unless("-inf")
@pytest.mark.parametrize(
    "typed", [["--table", "-inf"], ["--table", "-1e2"], ["--table=-1e9"]], ids=lambda each: each[-1]
)
def test_heights_below_zero_may_be_typed(folders, tmp_path, typed):
    common = ["--out", str(tmp_path / "p.csv"), "--touches", "12", "--pool", "60"]
    assert main(["plan", str(folders["UR5"]), *common, *typed]) == 0


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        (["--link-radius", "0.05", "--out", "p.csv"], "0.05 m are 50"),
        (["--out", "p.xlsx"], "would not be a .xlsx file"),
    ],
)
def test_slips_of_a_hurried_user_are_said(folders, tmp_path, monkeypatch, capsys, typed, said):
    monkeypatch.chdir(tmp_path)
    assert main(["plan", str(folders["UR5"]), "--touches", "12", "--pool", "60", *typed]) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def _new(folders, place, name, *plates):
    """A folder for a UR10e with plates of its own; the dial's sign is not said."""
    table = folders["UR10e"].parent / "ur10e.csv"
    table.write_text(BY_NAME["UR10e"].csv())
    words = [word for plate in plates for word in ("--plate", plate)]
    common = ["--tool", "0,0,120", "--travel", "10", "--accuracy", "1", "--out", str(place)]
    assert main(["new", name, "--dh", str(table), *common, *words]) == 0
    return place / name


def test_a_plate_that_few_postures_reach_is_not_called_out_of_reach(folders, tmp_path):
    """Of touches from below, three in ten keep clear: of the first three that are drawn none may."""
    source = load_problem(_new(folders, tmp_path, "under", "under:600,0,400:0,0,-1:300"))
    for seed in range(6):
        assert len(pool_of(source.problem, source.cell, 3, seed)) == 3
    with pytest.raises(SimulationError):
        pool_of(source.problem, Cell(faces=(Face("far", (3000, 0, 400), (0, 0, 1)),)), 3, 0)


@pytest.mark.long
def test_a_plate_that_the_plan_leaves_out_is_said_with_why(folders, tmp_path, capsys):
    plates = ["a:650,-150,20", "b:650,250,20", "w:900,-200,300:-1,0,0", "s:600,-500,300:0,1,0", "h:500,-300,400:100"]
    place, out = _new(folders, tmp_path, "many", *plates), tmp_path / "p.csv"
    capsys.readouterr()
    assert main(["plan", str(place), "--pool", "300", "--touches", "30", "--out", str(out)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    touched = set(pd.read_csv(out, comment="#")["plane"])
    for name in "abwsh":
        words = said.split(f"Face {name}: ")[1].split("Face ")[0]
        assert ("left out, no touch is planned on it" in words) == (name not in touched)
    assert len(touched) < 5
    assert "could only say where it stands" in said
    kept = (pd.read_csv(out, comment="#")["purpose"] == "check").sum()
    assert f"{kept} kept to verify ({kept / 30:.0%})" in said, "as many as the rows"


@pytest.mark.long
def test_each_set_up_is_advised_with_what_to_type(folders, tmp_path, monkeypatch, capsys):
    """A larger tilt as an option of plan; plates as options of new, which make the cell that was compared."""
    monkeypatch.chdir(tmp_path)
    place = _new(folders, tmp_path, "one", "floor:650,-150,20:300")
    source = load_problem(place)
    monkeypatch.setattr("casacal.planning.set_ups.POOL", 60)
    compared = set_ups(source.problem, source.cell, touches=20)
    found = {each.option.partition("=")[0]: each for each in compared}
    assert set(found) == {"", "--plate", "--block", "--tilt"}
    assert main(["plan", str(place), "--touches", "12", "--pool", "60", "--tilt", "45", "--out", "p.csv"]) == 0
    assert main(["plan", str(place), "--touches", "12", "--pool", "60", "--tilt", "95", "--out", "q.csv"]) == 2
    assert "Give 0 to less than 90" in capsys.readouterr().err
    tracker = str(ROOT / "problems" / "instruments" / "tracker")
    assert main(["plan", tracker, "--touches", "12", "--tilt", "45", "--out", "q.csv"]) == 2
    assert "--tilt is about faces" in capsys.readouterr().err
    options = argparse.Namespace(typed="casacal plan one --out p.csv", instrument=None, table=None, link_radius=None,
                                 keep_out=[], out="p.csv")  # fmt: skip
    now = dataclasses.replace(found[""], error=1.0)
    first, *_ = _following(options, [now, dataclasses.replace(found["--tilt"], error=0.1)], place, of_one=False)
    assert first == f"To do so: casacal plan one --out p.csv {found['--tilt'].option}"
    three = next(each for each in compared if "three" in each.words)
    first, *_ = _following(options, [now, dataclasses.replace(three, error=0.1)], place, of_one=False)
    made = _new(folders, tmp_path, "three", *(word.removeprefix("--plate=") for word in shlex.split(three.option)))
    for one, other in zip(load_problem(made).cell.faces, three.cell.faces, strict=True):
        np.testing.assert_allclose(one.centre, other.centre, atol=1e-3)
        np.testing.assert_allclose(one.axes[0], other.axes[0], atol=1e-3)
    assert first == f"To do so: casacal new with {three.option}"


@pytest.mark.long
def test_postures_that_somebody_wrote_into_a_plan_are_looked_at(folders, tmp_path, monkeypatch, capsys):
    """An arm that lies down, its tip below the table by our own kinematics, in the third line; and one in a box."""
    monkeypatch.chdir(tmp_path)
    problem = str(folders["UR10e"])
    assert main(["plan", problem, "--touches", "12", "--pool", "60", "--out", "p.csv"]) == 0
    rows = pd.read_csv("p.csv", comment="#")
    low = [0.0, -2.0, 20.0, 90.0, 90.0, 0.0]
    assert BY_NAME["UR10e"].origins(low)[-1][2] < -50
    text = Path("p.csv").read_text().splitlines()
    rows.loc[2, [f"q{k}_deg" for k in range(1, 7)]] = low
    head = "\n".join(line for line in text if line.startswith("#"))
    Path("low.csv").write_text(f"{head}\n{rows.to_csv(index=False)}")
    capsys.readouterr()
    for plan_file, words in (("p.csv", []), ("low.csv", ["the tool against the table"])):
        monkeypatch.setattr("sys.stdin", io.StringIO("s\ns\nq\n"))
        assert main(["measure", problem, "--plan", plan_file, "--out", "m.csv"]) == 0
        said = capsys.readouterr().out
        assert said.count("warning: do not go to the next posture") == len(words)
        assert all(each in said.split("touch 2 is left out")[1].split("touch 3")[0] for each in words)
        assert main(["simulate", problem, "--plan", plan_file, "--out", "s.csv"]) == 0
        said = capsys.readouterr().out
        assert ("an arm cannot be in these postures of the plan: touch 3 (" in said) == bool(words)
    monkeypatch.setattr("sys.stdin", io.StringIO("q\n"))
    box = ["--keep-out", "100:2000,-900:900,0:900"]
    assert main(["measure", problem, "--plan", "p.csv", *box, "--out", "m.csv"]) == 0
    assert "link 4 against box 1" in capsys.readouterr().out.split("touch 1")[0]


@pytest.mark.long
def test_a_block_beside_an_unfinished_problem_says_what_is_to_fill_in(folders, tmp_path, capsys):
    place = _new(folders, tmp_path, "bare", "floor:650,-150,20:300")
    asked = ["plan", str(place), "--block", "50", "--touches", "50", "--pool", "120", "--out", str(tmp_path / "p.csv")]
    assert main(asked) == 0
    marked = [k for k, line in enumerate((place / "problem.py").read_text().splitlines(), 1) if "TO FILL IN" in line]
    blocked = tmp_path / "bare_block"
    assert f"To fill in there, which counts here as well: line {marked[0]}." in (blocked / "problem.py").read_text()
    assert [Path(file.path).parent.name for file in load_problem(blocked).files] == ["bare_block", "bare"]
    rows = str(tmp_path / "s.csv")
    assert main(["simulate", str(blocked), "--plan", str(tmp_path / "p.csv"), "--out", rows]) == 0
    capsys.readouterr()
    main(["calibrate", str(blocked), rows, "--no-reference"])
    assert "1 line of the problem file is marked TO FILL IN" in capsys.readouterr().out


@pytest.mark.long
@pytest.mark.skipif(os.name == "nt", reason="devices of POSIX")
def test_a_plan_goes_into_a_pipe(folders, tmp_path):
    typed = [sys.executable, "-m", "casacal", "plan", str(folders["UR5"]), "--touches", "12", "--pool", "60"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ran = subprocess.run([*typed, "--out", "/dev/stdout"], capture_output=True, text=True, env=environment, check=True)
    assert ran.stdout.startswith("# planned by casacal for UR5: not a measurement\n# table at z = 0 mm\n")


def test_links_stay_their_radius_above_the_table():
    """As above a table that is higher by it, the slimmer wrist by half of it, while the tip may touch the table."""
    robot = load_problem(ROOT / "problems" / "ur5").problem.robot
    low, high = robot.limits
    joints = np.random.default_rng(0).uniform(low, high, size=(400, len(low)))
    tips, arm = np.tile([500.0, 0.0, 1000.0], (400, 1)), BY_NAME["UR5"]
    thick = Clearance(link_radius=60.0).around(robot, Disturbances())
    origins = np.array([arm.origins(q)[:-1, 2] for q in np.degrees(joints)])  # the last is the flange
    needed = np.array([-np.inf, 60.0, 60.0, 60.0, 30.0, 30.0])
    for height in (1000.0, 10.0, -10.0):
        tips[:, 2] = height
        hit = np.any([each.rows for each in thick.collisions(joints, tips) if each.other == "the table"], axis=0)
        np.testing.assert_array_equal(hit, (origins < needed).any(axis=1) | (height < 0))
    assert above_table(robot, 0)(joints, np.add(tips, (0, 0, 100))).sum() > (origins >= needed).all(axis=1).sum()


@pytest.mark.long_unless("hsr_jr680")
@pytest.mark.parametrize("name", ["hsr_jr680", "UR10e"])
def test_the_advice_of_a_gauge_block_holds_when_it_is_followed_to_the_letter(
    folders, tmp_path, monkeypatch, capsys, name
):
    """The printed lines, typed as they stand: the plan, the touches of a simulated arm, the fit, and fresh rows."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("casacal.planning.set_ups.POOL", POOL)  # which set-up is worth most is what is advised
    problem = folders[name] if name in folders else ROOT / "problems" / name
    assert main(["plan", str(problem), "--pool", "1000", "--out", "p.csv"]) == 0
    said = capsys.readouterr().out
    before = float(re.search(r"Expect a tip error of ([0-9.]+) mm", said)[1])
    assert "a gauge block of 100 mm" in said
    advice = re.search(r"^To do so: casacal (.*)$", said, re.M)[1]
    assert main(shlex.split(advice)) == 0
    said = capsys.readouterr().out
    promised = float(re.search(r"Expect a tip error of ([0-9.]+) mm", said)[1])
    assert promised < 0.7 * before
    block = f"{problem.name}_block"
    assert f"Next: casacal measure {block} --plan p.csv" in said
    made, drawn = load_problem(block), load_problem(problem)
    step = made.problem.instrument.steps["block"]
    assert (step.on, step.height) == (made.cell.faces[0].label, 100)
    assert made.cell.faces[-1].centre[2] == pytest.approx(made.cell.faces[0].centre[2] + 100)
    assert made.problem.robot.parameters["a"].values == drawn.problem.robot.parameters["a"].values
    assert main(["simulate", block, "--plan", "p.csv", "--seed", "3", "--out", "s.csv"]) == 0
    assert main(["calibrate", block, "s.csv", "--no-reference", "--out", "fit"]) == 0
    capsys.readouterr()
    assert main(["verify", "fit/result.json", "s_check.csv"]) == 0
    assert "Promise kept" in capsys.readouterr().out
    found = json.loads((tmp_path / "fit" / "result.json").read_text())
    assert found["tip"]["expected_rms_mm"] < before, "although a fit also doubts the noise and the dial's gain"
    read = io.StringIO("4.0\nq\n")
    monkeypatch.setattr("sys.stdin", read)
    assert main(["measure", block, "--plan", "p.csv", "--out", "m.csv"]) == 0
    assert "touch 1" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        (["--block", "0.1"], "The gauge block is 0.1 mm high. Give 1 to 1000 mm"),
        (["--block", "nan"], "The gauge block is nan mm high"),
        (["--instrument", "tracker", "--block", "100"], "no gauge block stands among what is measured here"),
    ],
)
def test_a_block_that_cannot_be_is_refused_and_nothing_written(tmp_path, capsys, typed, said):
    several = str(ROOT / "problems" / "ur5_three_instruments")
    if typed[0] == "--block":
        typed = ["--instrument", "dial", *typed]
    assert main(["plan", several, "--touches", "12", "--pool", "60", "--out", str(tmp_path / "p.csv"), *typed]) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_one_of_several_instruments_may_have_a_block(tmp_path, capsys):
    several = str(ROOT / "problems" / "ur5_three_instruments")
    asked = [
        "plan",
        several,
        "--instrument",
        "dial",
        "--touches",
        "20",
        "--pool",
        "60",
        "--out",
        str(tmp_path / "p.csv"),
    ]
    assert main([*asked, "--block", "50"]) == 0
    made = load_problem(tmp_path / "ur5_three_instruments_block").problem
    assert 50 in [step.height for step in made.instrument.steps.values()]
    said = capsys.readouterr().out
    assert "--instrument" not in said.split("Next: ")[1]
