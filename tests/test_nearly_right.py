"""What is nearly right is asked about or works as it was meant; it is never overlooked."""

import shutil

import pandas as pd
import pytest
from conftest import ROOT
from fuzz_seeds import URDF

import casacal
from casacal import Robot
from casacal.cli.main import main
from casacal.errors import ProblemError

HSR = ROOT / "problems" / "hsr_jr680"


@pytest.fixture
def samples(tmp_path):
    return lambda old, new: (
        (tmp_path / "s.csv").write_text((HSR / "samples.csv").read_text().replace(old, new, 1)) and tmp_path / "s.csv"
    )


@pytest.mark.parametrize("name", ["Plane", "planes", "PLANE", "plnae", "face", "Faces", "wall", "surface", "plane_id"])
def test_a_label_column_by_another_name_is_asked_about(name, samples, capsys):
    assert main(["calibrate", str(HSR), str(samples(",plane\n", f",{name}\n")), "--no-reference"]) == 2
    assert f"did you mean '{name}'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new"), [("q1_deg", "Q1_deg"), ("reading_mm", "Reading_mm"), ("q3_deg", "q3-deg"),
                     ("reading_mm", "readings_mm"), ("q1_deg", "q1deg")]
)  # fmt: skip
def test_a_number_column_by_another_name_is_asked_about(old, new, samples, capsys):
    assert main(["calibrate", str(HSR), str(samples(old, new)), "--no-reference"]) == 2
    said = capsys.readouterr().err
    assert f"did you mean '{new}'?" in said
    assert f"Call it {old}" in said


def test_an_empty_name_of_samples_is_refused(capsys):
    assert main(["calibrate", str(HSR), ""]) == 2
    assert "SAMPLES is empty" in capsys.readouterr().err


@pytest.mark.long_unless("calibrate --no-reference --method=lm PROBLEM SAMPLES", "check PROBLEM --id pose SAMPLES")
@pytest.mark.parametrize(
    "typed",
    [
        ["calibrate", "PROBLEM", "--method", "lm", "SAMPLES", "--no-reference"],
        ["calibrate", "--method", "lm", "PROBLEM", "--no-reference", "SAMPLES"],
        ["calibrate", "--no-reference", "--method=lm", "PROBLEM", "SAMPLES"],
        ["check", "PROBLEM", "--id", "pose", "SAMPLES"],
    ],
    ids=" ".join,
)
def test_options_may_stand_anywhere(typed, capsys):
    given = {"PROBLEM": str(HSR), "SAMPLES": str(HSR / "samples.csv")}
    assert main([given.get(word, word) for word in typed]) == 0
    assert main([given.get(word, word) for word in typed] + ["--nonsense"]) == 2
    assert "unrecognized arguments: --nonsense" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("<axis ", "<Axis ", "Write <axis>"),
        ("<origin ", "<ORIGIN ", "Write <origin>"),
        ("<limit ", "<Limit ", "Write <limit>"),
        ("<parent ", "<Parent ", "Write <parent>"),
        ('<joint name="j1"', '<Joint name="j1"', "Write <joint>"),
        ('<axis xyz="', '<axis XYZ="', "Write xyz="),
        ('<origin xyz="0 0 0.3" rpy=', '<origin xyz="0 0 0.3" RPY=', "Write rpy="),
        ('<origin xyz="0 0 0.3" rpy="0 0 0"', '<origin xyz="0 0 0.3" quat_xyzw="0 0 1 0"', "It may have xyz, rpy"),
        ('<limit lower="-2"', '<limit Lower="-2"', "Write lower="),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 1"/><axis xyz="0 1 0"/>', "a second <axis>"),
        ('<origin xyz="0 0 0.3"', '<origin xyz="0 0 0.1"/><origin xyz="0 0 0.3"', "a second <origin>"),
        ('<parent link="base"/>', '<parent link="base"/><parent link="a"/>', "a second <parent>"),
        ('<limit lower="-2"', '<limit lower="-1" upper="1"/><limit lower="-2"', "a second <limit>"),
    ],
)
def test_a_urdf_that_is_nearly_one_is_refused(old, new, said, tmp_path):
    assert old in URDF
    (tmp_path / "arm.urdf").write_text(URDF.replace("</Joint>", "</joint>").replace(old, new, 1))
    text = (tmp_path / "arm.urdf").read_text()
    if "<Joint" in new:
        (tmp_path / "arm.urdf").write_text(text.replace("</joint>", "</Joint>", 1))
    with pytest.raises(ProblemError, match=said):
        Robot.from_urdf(tmp_path / "arm.urdf")


def test_what_other_programs_add_to_a_urdf_is_no_matter(tmp_path):
    added = '<dynamics damping="1"/><safety_controller k_velocity="1"/><Note axis="x"/>'
    extra = '<gazebo><Joint/><axis XYZ="1"/></gazebo><transmission name="t"><joint name="j1"/></transmission>'
    text = URDF.replace('<axis xyz="0 0 1"/>', f'<axis xyz="0 0 1"/>{added}', 1).replace("</robot>", f"{extra}</robot>")
    text = text.replace('<limit lower="-2" upper="2"/>', '<limit lower="-2" upper="2" effort="9" acceleration="3"/>', 1)
    for name, given in (("one", URDF), ("two", text)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "arm.urdf").write_text(given)
    one, two = (Robot.from_urdf(tmp_path / name / "arm.urdf") for name in ("one", "two"))
    assert [(j.name, j.xyz, j.rpy, j.axis, j.limits) for j in one.arm.chain] == [
        (j.name, j.xyz, j.rpy, j.axis, j.limits) for j in two.arm.chain
    ]


def test_a_label_that_begins_with_a_hash_does_not_vanish(tmp_path):
    shutil.copytree(HSR, tmp_path / "p")
    text = (HSR / "samples.csv").read_text()
    (tmp_path / "s.csv").write_text(text.replace(",floor\n", ",#1\n"))
    problem = casacal.load_problem(tmp_path / "p").problem
    found = problem.read(tmp_path / "s.csv")
    assert len(found) == len(problem.read(HSR / "samples.csv"))
    assert "#1" in found.labels["plane"].names


@pytest.mark.parametrize("given", ["samples.csv", "README.md"])
def test_only_python_is_run_as_a_problem(given, capsys):
    """Problem and samples exchanged: nothing of the samples is run."""
    assert main(["calibrate", str(HSR / given), str(HSR)]) == 2
    assert "is no problem file" in capsys.readouterr().err


def test_simulate_says_that_it_writes_csv(tmp_path, capsys):
    assert main(["simulate", str(HSR), "--out", str(tmp_path / "s.xlsx")]) == 2
    assert "Name it s.csv" in capsys.readouterr().err


def test_a_frame_where_a_file_is_read_meets_a_sentence():
    with pytest.raises(casacal.CasacalError, match=r"Samples\.from_frame takes a frame"):
        casacal.load_problem(HSR).problem.read(pd.DataFrame())


def test_what_a_readers_own_function_does_is_told(tmp_path, capsys):
    """An instrument that leaves the program must not end it with success."""
    text = (
        (HSR / "problem.py")
        .read_text()
        .replace("        joint_axis =", "        raise SystemExit(0)\n        joint_axis =")
    )
    (tmp_path / "problem.py").write_text(text)
    assert main(["simulate", str(tmp_path), "--out", str(tmp_path / "s.csv")]) == 2
    assert "line 14: tip of 'DialOnLastOffset' failed with SystemExit" in capsys.readouterr().err


@pytest.mark.parametrize("out", ["", " ", "n" * 300])
def test_an_out_that_is_no_name_is_refused(out, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["calibrate", str(HSR), "--method", "lm", "--no-reference", "--out", out]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_deep_urdf_is_read_at_once(tmp_path):
    (tmp_path / "deep.urdf").write_text('<robot name="r">' + "<a>" * 100_000 + "</a>" * 100_000 + "</robot>")
    with pytest.raises(ProblemError, match="0 links that could be the tip"):
        Robot.from_urdf(tmp_path / "deep.urdf")


def test_deep_toml_and_long_lists_of_names_meet_a_short_sentence(tmp_path):
    (tmp_path / "arm.toml").write_text("a = " + "[" * 50_000)
    with pytest.raises(ProblemError) as refused:
        Robot.from_dh_file(tmp_path / "arm.toml")
    assert len(str(refused.value)) < 2500
    links = "".join(f'<link name="{"x" * 20}{k}"/>' for k in range(2000))
    (tmp_path / "arm.urdf").write_text(URDF.replace("</robot>", f"{links}</robot>"))
    with pytest.raises(ProblemError) as refused:
        Robot.from_urdf(tmp_path / "arm.urdf", base="nowhere", tip="flange")
    assert len(str(refused.value)) < 2500
