"""`casacal new`: a DH sheet or a URDF becomes a folder that runs and reads like those of problems/."""

import json
import math
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT
from robots_of_others import ODD_URDF, PUMA_TOML, UR5_CSV, UR5_URDF
from test_arms import nominal, pose_of

from casacal import Robot, load_problem
from casacal.cli.main import main

ROW = "{0},{1},{2},{3},0.7,R,-170.5,170.5,,\n"
LONG_TABLE = """# name: a "very" long \\ name
# convention: modified
# signs: 1 1 1 1 1 1 1 -1
# offsets_deg: 0.123456789 0.123456789 0.123456789 0.123456789 0.123456789 0.123456789 0.123456789 0
# offsets_mm: 0 0 0 0 0 0 0 12.5
# coupling: 2 1 0.25; 3 2 -1
joint,alpha_rad,a_mm,d_mm,theta_rad,kind,lower_deg,upper_deg,lower_mm,upper_mm
"""
LONG_TABLE += "".join(ROW.format(i, 0.1234567891 * i, 100.123456789 * i, 50.123456789 * i) for i in range(1, 8))
LONG_TABLE += "8,0,12,0,0,P,,,-10,300\n"


@pytest.fixture
def place(tmp_path, monkeypatch):
    for name, text in (
        ("ur5.csv", UR5_CSV),
        ("puma.toml", PUMA_TOML),
        ("ur5.urdf", UR5_URDF),
        ("odd.urdf", ODD_URDF),
        ("long.csv", LONG_TABLE),
    ):
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CASACAL_BACKEND", "blocks")  # each arm is calibrated once: not worth a compiler's seconds
    return tmp_path


SOURCES = {
    "ur5.csv": ("--dh", "ur5.csv"),
    "puma.toml": ("--dh", "puma.toml"),
    "long.csv": ("--dh", "long.csv"),
    "ur5.urdf": ("--urdf", "ur5.urdf", "--tip", "tool0"),
    "odd.urdf": ("--urdf", "odd.urdf"),
}


@pytest.mark.parametrize("source", SOURCES)
def test_the_folder_is_the_file(place, source, capsys):
    assert main(["new", "mine", *SOURCES[source], "--out", "problems"]) == 0
    assert "casacal serve problems/mine" in capsys.readouterr().out
    folder = place / "problems" / "mine"
    files = sorted(["README.md", "problem.py", *([source] if source.endswith("urdf") else [])])
    assert sorted(path.name for path in folder.iterdir()) == files
    assert [path.name for path in folder.parent.iterdir()] == ["mine"]
    made = load_problem(folder).problem.robot
    if source.endswith("urdf"):
        tip = "tool0" if source == "ur5.urdf" else None
        read = Robot.from_urdf(place / source, tip=tip)
        assert (folder / source).read_bytes() == (place / source).read_bytes()
    else:
        read = Robot.from_dh_file(place / source)
    assert made.name == read.name
    assert set(made.parameters) >= set(read.parameters)
    for one, two in zip(made.axes, read.axes, strict=True):
        assert one.kind == two.kind
        np.testing.assert_allclose((one.lower, one.upper), (two.lower, two.upper), rtol=1e-11)
    rng = np.random.default_rng(0)
    for _ in range(5):
        q = rng.uniform([j.lower for j in read.axes], [j.upper for j in read.axes])
        np.testing.assert_allclose(pose_of(made, nominal(made), q), pose_of(read, nominal(read), q), atol=1e-8)
    config = ["--config", ROOT / "pyproject.toml", "--no-cache", folder]
    for command in (["check"], ["format", "--check", "--diff"]):
        done = subprocess.run([sys.executable, "-m", "ruff", *command, *config], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    assert max(len(line) for line in (folder / "README.md").read_text().splitlines()) <= 120


def test_a_better_gauge_is_believed_and_an_unlikely_one_is_not(place, capsys):
    assert main(["new", "mine", "--dh", "ur5.csv", "--noise", "0.002"]) == 0
    assert load_problem("mine").problem.instrument.noise_std == 0.002
    capsys.readouterr()
    for wrong in ("10", "0", "-1", "nan"):
        assert main(["new", "other", "--dh", "ur5.csv", f"--noise={wrong}"]) == 2
        assert "noise" in capsys.readouterr().err
    assert not (place / "other").exists()


def test_parallel_axes_are_found(place, capsys):
    (place / "plain.csv").write_text(UR5_CSV.replace("# parallel: 2, 3\n", ""))
    assert main(["new", "mine", "--dh", "plain.csv"]) == 0
    assert "Parallel axes: 2 and 3, 3 and 4" in capsys.readouterr().out
    assert load_problem("mine").problem.robot.arm.parallel == (2, 3)
    readme = (place / "mine" / "README.md").read_text()
    assert "2 and 3, 3 and 4" in readme
    assert "24 parameters" in readme
    assert sum(u.size for u in load_problem("mine").problem.robot.parameters.values()) == 24


@pytest.mark.long
def test_what_is_made_simulates_checks_calibrates_and_predicts(place, capsys):
    assert main(["new", "mine", "--dh", "puma.toml"]) == 0
    assert main(["simulate", "mine", "--out", "out/mine.csv", "--seed", "2"]) == 0
    assert main(["check", "mine", "out/mine.csv"]) == 0
    assert main(["calibrate", "mine", "out/mine.csv", "--method", "lm", "--out", "out/mine"]) == 0
    assert "ipopt agrees" in capsys.readouterr().out
    assert main(["predict", "out/mine/result.json", "out/mine.csv", "--out", "out/p.csv"]) == 0


def test_a_column_type_is_told_to_be_kind(place, capsys):
    rows = "1,0,350,200,0,R\n2,180,250,0,0,R\n"
    (place / "typed.csv").write_text("# convention: standard\njoint,alpha_deg,a_mm,d_mm,theta_deg,type\n" + rows)
    assert main(["new", "mine", "--dh", "typed.csv"]) == 2
    assert "there is no field 'type'. Did you mean 'kind'?" in capsys.readouterr().err


@pytest.mark.long
def test_a_scara_goes_where_new_sends_it(place, capsys):
    """It cannot tilt its tool, and yet every command that is advised works; each face is inclined against the tool."""
    rows = "1,0,350,200,0,R\n2,180,250,0,0,R\n3,0,0,0,0,P\n4,0,0,50,0,R\n"
    (place / "scara.csv").write_text("# convention: standard\njoint,alpha_deg,a_mm,d_mm,theta_deg,kind\n" + rows)
    assert main(["new", "scara", "--dh", "scara.csv"]) == 0
    advised = capsys.readouterr().out.rsplit("casacal simulate ", 1)[1].split("\n", 1)[0].split()
    assert main(["simulate", *advised]) == 0
    problem = load_problem("scara").problem
    samples = problem.read(advised[-1])
    assert len(set(samples.labels["plane"])) == 3
    lower, upper = problem.robot.limits
    assert (samples.joints >= lower - 1e-6).all()
    assert (samples.joints <= upper + 1e-6).all()
    assert main(["check", "scara", advised[-1]]) == 0
    capsys.readouterr()
    assert main(["calibrate", "scara", advised[-1], "--method", "lm", "--no-reference", "--json"]) == 0
    for face in json.loads(capsys.readouterr().out)["planes"].values():
        assert abs(face["normal"][2]) == pytest.approx(math.cos(math.radians(15)), abs=2e-3)


def test_an_arm_that_touches_no_three_faces_is_told_why(place, capsys):
    (place / "rail.csv").write_text("# convention: standard\njoint,alpha_deg,a_mm,d_mm,theta_deg,kind\n1,0,350,0,0,P\n")
    assert main(["new", "rail", "--dh", "rail.csv"]) == 0
    assert main(["simulate", "rail", "--out", "s.csv"]) == 2
    assert "No place was found where 'rail' can touch three faces" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["new", "mine"], "--dh --urdf"),
        (["new", "mine", "--dh", "ur5.csv", "--urdf", "ur5.urdf"], "not allowed"),
        (["new", "mine", "--dh", "none.csv"], "no such file"),
        (["new", "mine", "--dh", "ur5.csv", "--tip", "tool0"], "links of a URDF"),
        (["new", "mine", "--urdf", "ur5.urdf", "--tip", "tool1"], "no link named 'tool1'"),
        (["new", "problems/mine", "--dh", "ur5.csv"], "--out says where it goes"),
        (["new", "ur5.csv", "--dh", "ur5.csv"], "exists already"),
        (["new", "mine", "--dh", "ur5.csv", "--tool", "0,0,0.12"], "a tool of 0.12 mm. Give it in mm: 0.12 m are 120"),
        (["new", "mine", "--dh", "ur5.csv", "--out", "ur5.csv"], "cannot be written"),
    ],
)
def test_refusals_leave_nothing_behind(place, capsys, arguments, says):
    before = sorted(place.iterdir())
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert says in err
    assert sorted(place.iterdir()) == before


def test_remarks_that_look_like_settings_are_told_and_travel_is_to_be_filled_in(place, capsys):
    (place / "noted.csv").write_text(
        UR5_CSV.replace("# convention", "# units: m\n# units: mm\n# casacal: made\n# convention", 1)
    )
    assert main(["new", "noted", "--dh", "noted.csv"]) == 0
    said = capsys.readouterr().out
    assert "Taken for remarks, not for settings: units. Known are name, convention" in " ".join(said.split())
    assert "To fill in: the dial's travel: 0 to 10 mm is assumed" in said
    text = (place / "noted" / "problem.py").read_text()
    assert "travel=10, " in text
    assert text.count("TO FILL IN") == 4
    assert main(["simulate", "noted", "--samples", "60", "--out", "noted_rows.csv"]) == 0
    assert main(["calibrate", "noted", "noted_rows.csv", "--no-reference"]) == 0
    said = capsys.readouterr().out
    assert "4 lines of the problem file are marked TO FILL IN: what stands there is assumed" in " ".join(said.split())
    assert main(["new", "known", "--dh", "noted.csv", "--travel=-5:5"]) == 0
    assert "travel is to" not in capsys.readouterr().out
    text = (place / "known" / "problem.py").read_text()
    assert ("travel=(-5, 5), " in text, text.count("TO FILL IN")) == (True, 3)


@pytest.mark.parametrize(("travel", "says"), [("nan", "'nan' is no number"), ("1:2:3", "'1:2:3' is no number")])
def test_a_travel_that_is_none_is_called_by_its_option(place, capsys, travel, says):
    assert main(["new", "mine", "--dh", "ur5.csv", "--travel", travel]) == 2
    said = capsys.readouterr().err
    assert f"--travel: {says}" in said
    assert "number_or_range" not in said


def test_a_travel_of_nothing_names_no_file_that_is_not_there(place, capsys):
    assert main(["new", "mine", "--dh", "ur5.csv", "--travel", "1e-300"]) == 2
    assert capsys.readouterr().err.startswith("casacal: The dial's travel is 1e-300. Give its range")


@pytest.mark.parametrize(
    ("head", "limits", "named", "told"),
    [
        ("", "", "mine", True),
        ("# name: Erna\n", ",100,-90", "Erna", False),
        ("", ",180,-180", "mine", False),  # as the maker of a UR states them
    ],
)
def test_an_arm_that_its_table_does_not_name_has_the_name_that_was_given(tmp_path, capsys, head, limits, named, told):
    """And limits that no table states are to fill in: a plan goes to them."""
    columns = "alpha_deg,a_mm,d_mm,theta_deg" + (",upper_deg,lower_deg" if limits else "")
    rows = "\n".join(f"{row}{limits}" for row in ("90,0,300,0", "0,400,0,0", "90,20,0,0"))
    (tmp_path / "table.csv").write_text(f"{head}# convention: standard\n{columns}\n{rows}\n")
    assert main(["new", "mine", "--dh", str(tmp_path / "table.csv"), "--out", str(tmp_path)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert load_problem(tmp_path / "mine").problem.robot.name == named
    assert ("To fill in: joint limits" in said) == told
