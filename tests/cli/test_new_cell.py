"""`casacal new` takes the plates that a person has, and a gauge block; what cannot be is refused, and nothing made."""

import csv
import io
import json
import shutil

import numpy as np
import pytest
from conftest import ROOT

from casacal import Cell, calibrate, load, load_problem, simulate, verify
from casacal.cli.main import main
from casacal.model.problem_file import keep_conventions
from casacal.planning.candidates import pool_of
from casacal.planning.clearance import Clearance

TABLE = """# name: six
# convention: standard
joint,alpha_deg,a_mm,d_mm,theta_deg,lower_deg,upper_deg
1,-90,150,450,0,-170,170
2,0,600,0,-90,-90,120
3,-90,120,0,0,-120,150
4,90,0,640,0,-180,180
5,-90,0,0,0,-115,115
6,0,0,100,0,-180,180
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cells")
    (folder / "six.csv").write_text(TABLE, encoding="utf-8")

    def new(name, *words):
        arm = ["--dh", str(folder / "six.csv"), "--tool", "0,0,120", "--sign", "-1", "--travel", "10"]
        return main(["new", name, *arm, "--accuracy", "0.5", "--out", str(folder), *words]), folder / name

    return new


def test_plates_and_a_block_stand_where_they_were_said_to(made, capsys):
    code, place = made("two", "--plate", "floor:700,0,140:300", "--plate", "wall:900,200,300:-2,0,0", "--block", "50",
                       "--table", "100")  # fmt: skip
    assert code == 0
    said = capsys.readouterr().out
    assert "Face 'floor': middle at 700, 0, 140 mm, 300 mm wide" in said
    source = load_problem(place)
    faces = {face.label: face for face in source.cell.faces}
    assert list(faces) == ["floor", "wall", "block"]
    assert faces["floor"].centre == (700, 0, 140)
    assert faces["floor"].size == (300, 300)
    np.testing.assert_allclose(faces["wall"].axes[0], (-1, 0, 0))
    assert faces["block"].centre == (700, 0, 190)
    assert faces["block"].size == (35, 35)
    assert source.cell.table == 100
    step = source.problem.instrument.steps["block"]
    assert (step.on, step.height) == ("floor", 50)
    text = (place / "problem.py").read_text(encoding="utf-8")
    assert max(map(len, text.splitlines())) <= 120
    assert "proposed" not in text
    assert "on a table at z = 100 mm" in (place / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("plates", "away"),
    [
        (["wall:900,200,300:2,0,0"], "--plate wall:900,200,300:-2,0,0:300"),
        (["wall:900,200,300:-2,0,0"], ""),
        (["wall:-600,-600,300:-1,-1,0:200"], "--plate wall:-600,-600,300:1,1,0:200"),
        (["shelf:900,200,300", "low:900,200,200", "beside:900,551,200:300", "lid:800,0,500:0,0,-1"], ""),
    ],
)
def test_a_plate_that_turns_its_back_on_the_arm_is_said_with_the_cure(made, capsys, plates, away):
    code, place = made(f"facing{len(plates)}{len(away)}", *(word for each in plates for word in ("--plate", each)))
    assert code == 0
    said = " ".join(capsys.readouterr().out.split())
    assert ("faces away from the arm's base" in said) == bool(away)
    assert away in said
    assert len(load_problem(place).cell.faces) == len(plates)


def test_an_arm_may_stand_on_no_table(made):
    code, place = made("hanging", "--table=-inf", "--plate", "floor:700,0,-640:300")
    assert code == 0
    assert load_problem(place).cell.table == -np.inf
    assert "problem.py, without a table;" in (place / "README.md").read_text(encoding="utf-8")


def test_a_block_stands_on_its_plate_along_the_normal(made):
    code, place = made("leaning", "--plate", "ramp:700,0,400:3,0,4:200", "--block", "100")
    assert code == 0
    ramp, block = load_problem(place).cell.faces
    np.testing.assert_allclose(np.subtract(block.centre, ramp.centre), (60, 0, 80))
    np.testing.assert_allclose(block.axes[0], ramp.axes[0])


def test_without_plates_some_are_proposed_above_the_table_and_marked(made, capsys):
    code, place = made("proposed", "--block", "100", "--table", "-200")
    assert code == 0
    assert "Proposed face 'floor'" in capsys.readouterr().out
    source = load_problem(place)
    assert [face.label for face in source.cell.faces][-1] == "block"
    assert len(source.cell.faces) == 4
    assert all(face.lowest >= -200 for face in source.cell.faces)
    assert source.cell.faces[0].centre[0] > 0
    assert "TO FILL IN: these" in (place / "problem.py").read_text(encoding="utf-8")
    low, there = made("low", "--table", "-100")
    assert low == 0
    assert len(load_problem(there).cell.faces) == 3
    bare, plain = made("bare")
    assert bare == 0
    assert load_problem(plain).cell is None


def test_boxes_to_keep_out_of_are_kept_and_obeyed(made, tmp_path, capsys):
    """A column beside the plate: in problem.py, in the plan by default, and by both of `plan` and `measure` said."""
    words = ["--plate", "floor:700,0,40:300", "--keep-out", "500:600,-400:-150,0:900", "--keep-out=-900:-800,-9:9,0:50"]
    code, place = made("beside", *words)
    assert code == 0
    source = load_problem(place)
    assert source.cell.keep_out == (((500, 600), (-400, -150), (0, 900)), ((-900, -800), (-9, 9), (0, 50)))
    assert "boxes that the arm keeps out of" in (place / "README.md").read_text(encoding="utf-8")
    capsys.readouterr()
    asked = ["plan", str(place), "--touches", "20", "--pool", "200", "--out", str(tmp_path / "plan.csv"), "--json"]
    assert main(asked) == 0
    assert "keep off the table, box 1, box 2, face 'floor'" in json.loads(capsys.readouterr().out)["collisions"]
    free = pool_of(source.problem, Cell(faces=source.cell.faces), 300, 0).joints
    tips = np.full((len(free), 3), 5e3)
    box = Clearance(source.cell.keep_out[:1]).around(source.problem.robot, None)
    kept = pool_of(source.problem, source.cell, 300, 0).joints
    assert not box.clear(free, tips).all()
    assert box.clear(kept, tips).all()
    code, there = made("high", "--keep-out", "-2000:2000,-2000:2000,-900:250")
    assert code == 2, "a tip cannot be above the box on three faces that stand on the table"
    code, there = made("above", "--keep-out", "100:2000,-2000:2000,-900:250")
    assert code == 0
    source = load_problem(there)
    assert len(source.cell.faces) == 3
    assert len(pool_of(source.problem, source.cell, 60, 0)) == 60, "where it is proposed, it can be planned"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--keep-out", "0.4:0.6,0:1,0:1"], "Give mm in the base frame: 0.5 m are 500"),
        (["--keep-out", "600:400,0:100,0:100"], "600:400,0:100,0:100 is empty. Give each range as LOW:HIGH in mm"),
        (["--keep-out", "-50:900,-100:100,-1:500"], "and the arm stands in it"),
        (["--keep-out", "50:inf,0:100,0:100"], "Give numbers of mm"),
        (["--keep-out", "50:nan,0:100,0:100"], "--keep-out is 50:nan,0:100,0:100. Give numbers of mm"),
        (["--keep-out", "0:100,0:100,-inf:0"], "100000 is far enough"),
        (["--plate", "a:25,-6,1:300"], "covers the origin of the base"),
        (["--plate", "a:700,0,40:0.3"], "0.3 m are 300"),
        (
            ["--plate", "a:700,0,40:300", "--keep-out", "400:900,-400:400,0:500"],
            "is in a box that the arm keeps out of",
        ),
        (["--travel", "1e308"], "The dial's travel is 1e+308"),
        (["--tool", "0,0,1e308"], "Give three numbers of mm"),
        (["--table", "1e308"], "The table is at 1e+308 mm"),
        (["--table", "inf"], "or -inf for none"),
        (["--plate", "a:700,0,40:200", "--plate", "b:840,0,40:100"], "Plates 'a' and 'b' are in one place"),
        (["--plate", "a:700,0,40:1,0,9", "--plate", "b:700,0,40:1,0,9.1"], "Plates 'a' and 'b' are in one place"),
        (["--plate", "a:700,0,90:0,0,-1:300"], "faces the table, 90 mm before it, where no tool has room"),
        (["--plate", "a:700,0,90:0,0,-1:300"], "where the tool comes from: --plate a:700,0,90:0,0,1:300"),
        (["--keep-out", "50:60,0:100"], "is not X0:X1,Y0:Y1,Z0:Z1"),
        (["--plate", "floor:0.7,0,0.04"], "Give mm in the base frame: 0.6 m are 600"),
        (["--plate", "floor:700,0,-40"], "reaches down to z = -40 mm, and the table is at 0 mm"),
        (["--plate", "wall:700,0,100:1,0,0:300"], "reaches down to z = -50 mm"),
        (["--plate", "floor:1e308,0,40"], "is (1e+308, 0.0, 40.0"),
        (["--plate", "a\nb:700,0,40"], "A plate is named 'a\\nb'"),
        (["--plate", "floor:700,0"], "is no plate. Write NAME:X,Y,Z"),
        (["--plate", "floor:700,0,40:1,2"], "is no plate"),
        (["--plate", "floor:700,0,x"], "is no plate"),
        (["--plate", ":700,0,40"], "is no plate"),
        (["--plate", "floor:700,0,40:0,0,0"], "a normal that is not zero"),
        (["--plate", "floor:700,0,nan"], "is (700.0, 0.0, nan"),
        (["--plate", "floor:700,0,40:-3"], "a normal that is not zero, a side"),
        (["--plate", "a:700,0,40", "--plate", "a:700,300,40"], "Two faces share a name (a, a)"),
        (["--plate", "block:700,0,40", "--block", "50"], "Two faces share a name (block, block)"),
        (["--block", "0.1"], "The gauge block is 0.1 mm high. Give 1 to 1000 mm"),
        (["--block", "100", "--table", "nan"], "The table is at nan mm"),
        (["--block", "100", "--table", "9000"], "No place was found"),
    ],
)
def test_what_cannot_be_is_refused_and_nothing_is_made(made, words, says, capsys):
    code, place = made("refused", *words)
    assert code == 2
    assert says in capsys.readouterr().err
    assert not place.exists()


def purposes(path):
    rows = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    return [(row["purpose"], row["plane"]) for row in csv.DictReader(io.StringIO("\n".join(rows)))]


def test_the_block_is_carried_from_the_plan_to_the_verification(made, tmp_path, capsys):
    """Plates stand 40 mm and 3 degrees off where the problem has them: `calibrate` and `verify` need no change."""
    _, place = made("whole", "--block", "100")
    out = tmp_path / "plan.csv"
    assert main(["plan", str(place), "--touches", "90", "--pool", "600", "--out", str(out)]) == 0
    planned = purposes(out)
    assert {face for purpose, face in planned if purpose == "check"} == {"floor", "wall", "side", "block"}
    assert {face for purpose, face in planned if purpose == "fit"} >= {"floor", "block"}
    capsys.readouterr()
    source = load_problem(place)
    text = (place / "problem.py").read_text(encoding="utf-8")
    assert text.count("Face(") == 4
    turn = np.radians(3)
    moved = []
    for face in source.cell.faces:
        about = (0, 0, 1) if face.normal[2] < 0.5 else (0, 1, 0)
        normal = np.array(face.normal) + turn * np.cross(about, face.normal)
        centre = np.add(face.centre, (40, -40, 30))
        moved.append(type(face)(face.label, tuple(centre.tolist()), tuple(normal.tolist()), face.size))
    floor = moved[0]
    top = np.add(floor.centre, 100 * floor.axes[0])
    moved[-1] = type(floor)("block", tuple(top.tolist()), floor.normal, (35.0, 35.0))
    cell = type(source.cell)(faces=tuple(moved))
    there = simulate(source.problem, cell, samples=110, seed=5)
    fitted = calibrate(source, there.samples.take(np.arange(80)), reference=False)
    assert fitted.verdict.level != "do not use"
    assert fitted.tip_std[1] < 0.25
    fitted.save(tmp_path / "fit")
    fresh = verify(load(tmp_path / "fit"), there.samples.take(np.arange(80, 110)))
    assert fresh.kept


def test_a_plan_with_a_block_may_be_made_again_and_takes_no_second_block(tmp_path, capsys):
    """What casacal wrote it may write again; an edited file of somebody else stays. The arm's conventions go along."""
    where = tmp_path / "hsr_jr680"
    shutil.copytree(ROOT / "problems" / "hsr_jr680", where)
    keep_conventions(load_problem(where), file="poses.csv", poses=4)
    plan = ["plan", str(where), "--pool", "150", "--touches", "40", "--out", str(tmp_path / "p.csv")]
    for height in ("100", "80"):
        assert main([*plan, "--block", height]) == 0
    made = tmp_path / "hsr_jr680_block"
    assert "--block 80" in (made / "problem.py").read_text()
    assert load_problem(made).confirmed
    assert main(["plan", str(made), *plan[2:], "--block", "50"]) == 2
    assert "'block' is a gauge block of this problem already" in capsys.readouterr().err
    (made / "problem.py").write_text("# mine\n")
    assert main([*plan, "--block", "100"]) == 2
    assert "was not written by casacal" in capsys.readouterr().err
