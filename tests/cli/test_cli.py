"""The command line as a user meets it: exit codes, files, and one line for every refusal."""

import contextlib
import csv
import io
import json
import math
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT
from oracles import dh_chain

import casacal
from casacal.cli.main import main

HSR = (ROOT / "problems" / "hsr_jr680").as_posix()
KNOWN_FROM = {"samples", "samples and prior", "prior alone", "held"}


@pytest.fixture
def run(capsys):
    def call(*arguments):
        code = main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """The folder of a calibration, and what the command says to the output and to the errors."""
    folder, out, err = tmp_path_factory.mktemp("calibrated") / "out", io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        assert main(["calibrate", HSR, "--holdout", "0.25", "--seed", "1", "--out", str(folder)]) == 0
    return folder, out.getvalue(), err.getvalue()


@pytest.fixture(scope="module")
def calibrated(told):
    return told[0]


def test_calibrate_writes_all_it_promises(calibrated):
    document = json.loads((calibrated / "result.json").read_text(encoding="utf-8"))
    assert document["problem"]["name"] == "hsr_jr680"
    assert document["method"] == "sckf-lm"
    assert document["converged"] is True
    assert document["data"]["samples"] == 120
    assert document["data"]["heldout"] == 30
    names = [row["name"] for row in document["parameters"]]
    assert names[:6] == [f"alpha{i}" for i in range(1, 7)]
    assert {"a3", "theta2", "tool_x"} <= set(names)
    assert {row["known_from"] for row in document["parameters"]} <= KNOWN_FROM
    for plane in document["planes"].values():
        assert np.linalg.norm(plane["normal"]) == pytest.approx(1)
    assert set(document["planes"]) == {"floor", "wall", "side"}
    for when in ("before", "after"):
        for part in ("fit", "heldout"):
            assert set(document["metrics"][when][part]) == {"rmse_mm", "mae_mm", "std_mm", "max_mm"}
    assert (
        document["metrics"]["after"]["heldout"]["rmse_mm"] < 0.2 * document["metrics"]["before"]["heldout"]["rmse_mm"]
    )
    found = document["identifiability"]
    assert len(found["null"]) == found["unknowns"] - found["rank"]
    reference = document["reference"]
    assert reference["solver"] == "ipopt"
    assert abs(reference["relative_gap"]) < 1e-8
    assert set(document["seconds"]) == {"build", "solve", "total"}
    assert set(document["versions"]) == {"casacal", "casadi", "numpy", "python"}
    assert set(document["evaluations"]) == {"residual_rows", "jacobian_rows"}
    with (calibrated / "parameters.csv").open(encoding="utf-8") as stream:
        assert stream.readline().startswith("# written by casacal")
        table = list(csv.DictReader(stream))
    assert [row["name"] for row in table] == names
    assert {row["known_from"] for row in table} <= KNOWN_FROM
    for picture in ("residuals.png", "convergence.png"):
        assert (calibrated / picture).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_normals_point_towards_the_tool(calibrated):
    document = json.loads((calibrated / "result.json").read_text(encoding="utf-8"))
    assert document["planes"]["floor"]["normal"][2] > 0.99
    assert document["planes"]["wall"]["normal"][0] < -0.99


@pytest.mark.long
def test_the_same_input_gives_the_same_bytes(calibrated, tmp_path, run):
    code, *_ = run("calibrate", HSR, "--holdout", 0.25, "--seed", 1, "--out", tmp_path)
    assert code == 0
    for name in ("parameters.csv", "residuals.png", "convergence.png"):
        assert (tmp_path / name).read_bytes() == (calibrated / name).read_bytes()
    one, two = (json.loads((folder / "result.json").read_text()) for folder in (tmp_path, calibrated))
    assert one.pop("seconds").keys() == two.pop("seconds").keys()
    assert one.pop("seal")["of"] == two.pop("seal")["of"]  # its hash is of the paths, too
    for document in (one, two):  # paths are relative to the folders, which differ
        for part in (document["problem"], *document["problem"]["files"]):
            assert part.pop("path").endswith("problems/hsr_jr680/problem.py")
        assert document["data"].pop("file").endswith("problems/hsr_jr680/samples.csv")
    assert json.dumps(one) == json.dumps(two)


def test_the_summary_says_what_a_person_needs(run, told):
    _, out, err = told
    assert err == ""
    for words in ("Calibrated", "as drawn", "held out", "not accuracy", "Next: ", "ipopt agrees"):
        assert words in out
    assert "Known from" not in out
    code, out, err = run("calibrate", HSR, "--holdout", 0.25, "--verbose")
    assert (code, err) == (0, "")
    for words in (
        "Calibrated",
        "Before",
        "After",
        "held-out rows",
        "Std. dev.",
        "Known from",
        "directions",
        "ipopt agrees",
    ):
        assert words in out


@pytest.mark.long_unless("ekf", "plane-only")
@pytest.mark.parametrize("method", ["ekf", "plane-only", "ipopt"])  # test_own_instrument.py runs every one by command
def test_a_method_runs_and_its_exit_code_is_that_of_the_verdict(run, method):
    code, out, _ = run("calibrate", HSR, "--method", method)
    assert f": {method} from 120 samples" in out.splitlines()[0]
    far = method == "plane-only"  # it ends far above the minimum
    assert code == (1 if far else 0)
    assert ("Do not use" in out) == far
    assert ("expect a tip error" in out) != far


@pytest.mark.long
def test_fixing_and_priors(run, tmp_path):
    options = ("--fix", "alpha,a3", "--prior", "d=0.1", "--no-reference", "--verbose")
    code, out, _ = run("calibrate", HSR, *options, "--out", tmp_path)
    assert code == 0
    assert "Reference: not run" in out
    rows = {row["name"]: row for row in json.loads((tmp_path / "result.json").read_text())["parameters"]}
    assert rows["alpha2"]["estimate"] == rows["alpha2"]["nominal"]
    assert rows["a3"]["known_from"] == "held"
    assert rows["d1"]["std"] <= 0.1 + 1e-12


def test_a_method_that_does_not_converge_exits_with_one(run, tmp_path, monkeypatch):
    from casacal import lm

    own = sys.modules["casacal.fit.lm"]
    monkeypatch.setattr(own, "lm", lambda fit, progress=None: lm(fit, max_steps=1))
    code, out, _ = run("calibrate", HSR, "--method", "lm")
    assert code == 1
    assert "Ran out of steps" in out


def test_simulate_then_calibrate_then_predict(run, tmp_path):
    samples, truth, out = tmp_path / "s.csv", tmp_path / "s.truth.json", tmp_path / "out"
    assert run("simulate", HSR, "--out", samples, "--samples", 90, "--seed", 4, "--repeatability", 0.005)[0] == 0
    assert run("calibrate", HSR, samples, "--out", out)[0] == 0
    document = json.loads(truth.read_text())
    assert document["method"] == "truth"
    positions = {}
    for name, source, options in (
        ("true", truth, ()),
        ("estimated", out / "result.json", ()),
        ("nominal", truth, ("--nominal",)),
    ):
        poses = tmp_path / f"{name}.csv"
        assert run("predict", source, samples, "--out", poses, "--frame", "tip", *options)[0] == 0
        with poses.open() as stream:
            assert "written by casacal" in stream.readline()
            assert stream.readline().strip() == "x_mm,y_mm,z_mm,qw,qx,qy,qz"
            positions[name] = np.loadtxt(stream, delimiter=",")
    np.testing.assert_allclose(np.linalg.norm(positions["true"][:, 3:], axis=1), 1, atol=1e-9)
    error = {n: np.sqrt(((p[:, :3] - positions["true"][:, :3]) ** 2).sum(1).mean()) for n, p in positions.items()}
    assert error["estimated"] < 0.6 * error["nominal"]


def test_the_truth_reproduces_the_samples_by_numpy_alone(run, tmp_path):
    samples = tmp_path / "s.csv"
    assert run("simulate", HSR, "--out", samples, "--seed", 9)[0] == 0
    truth = json.loads((tmp_path / "s.truth.json").read_text())
    value = {row["name"]: row["estimate"] for row in truth["parameters"]}
    table = {k: np.array([value[f"{k}{i}"] for i in range(1, 7)]) for k in ("alpha", "a", "d", "theta")}
    with samples.open() as stream:
        rows = list(csv.DictReader(line for line in stream if not line.startswith("#")))
    misses = []
    for row in rows:
        q = [math.radians(float(row[f"q{i}_deg"])) for i in range(1, 7)]
        d = table["d"] + np.array([0, 0, 0, 0, 0, float(row["reading_mm"])])
        tip = dh_chain(table["alpha"], table["a"], d, table["theta"] + q)[:3, 3]
        plane = truth["planes"][row["plane"]]
        misses.append(np.dot(plane["normal"], tip - np.array(plane["point_mm"])))
    assert np.std(misses) == pytest.approx(0.0093, abs=0.002)  # 0.01 mm along the plunger, tilted up to 30 degrees
    assert abs(np.mean(misses)) < 0.003


@pytest.mark.skipif(os.name == "nt", reason="devices of POSIX")
def test_words_about_a_file_do_not_get_into_it_where_it_is_standard_output(run, calibrated, tmp_path):
    joints, kept = tmp_path / "q.csv", tmp_path / "p.csv"
    joints.write_text("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n10,20,30,40,50,60\n")
    code, words, _ = run("predict", calibrated / "result.json", joints, "--out", kept)
    command = [sys.executable, "-m", "casacal", "predict", calibrated / "result.json", joints, "--out", "/dev/stdout"]
    piped = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert (piped.returncode, piped.stdout) == (code, kept.read_text())
    assert piped.stderr == words.replace(str(kept), "/dev/stdout")


def test_predict_flange_is_the_pose(run, calibrated, tmp_path):
    joints = tmp_path / "q.csv"
    joints.write_text("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n10,20,30,40,50,60\n")
    assert run("predict", calibrated / "result.json", joints, "--out", tmp_path / "p.csv", "--nominal")[0] == 0
    pose = np.loadtxt(tmp_path / "p.csv", delimiter=",", skiprows=2)
    expected = dh_chain(
        np.radians([-90, 0, 90, -90, 90, 0]),
        [249.85003, 900.32123, -206.14449, 0, 0, 0],
        [653.5, 0, 0, 1030.37534, 0, 200.6],
        np.radians([10, -70, 210, 40, 140, 60]),
    )
    np.testing.assert_allclose(pose[:3], expected[:3, 3], atol=1e-5)
    w, *v = pose[3:]
    trace = 4 * w * w - 1
    assert trace == pytest.approx(np.trace(expected[:3, :3]), abs=1e-9)
    np.testing.assert_allclose(np.array(v) * 4 * w, [expected[2, 1] - expected[1, 2], expected[0, 2] - expected[2, 0],
                                                    expected[1, 0] - expected[0, 1]], atol=1e-9)  # fmt: skip


PROBLEMS = {
    "raises": ("import math\n\nx = 1 / 0\n", "line 3: ZeroDivisionError"),
    "syntax": ("def broken(:\n", "line 1: SyntaxError"),
    "nothing": ("x = 1\n", "does not define `problem`"),
    "other": ("problem = 'an arm'\n", "does not define `problem`"),
    "imports": ("import nonsense_module\n", "ModuleNotFoundError"),
    "exits": ("raise SystemExit(3)\n", "SystemExit"),
    "pasted": (
        "c = Conventions(signs=(1, -1))\n",
        "line 1: NameError: name 'Conventions' is not defined. Add from casacal",
    ),
    "number": (
        "from casacal import Robot\n\nRobot('r', 1, lambda p, q: q, {'l1': 300.0})\n",
        "line 3: Robot parameter 'l1' is a float. Make it one: l1=Parameter(...)",
    ),
    "degrees": (
        "from casacal import Joint\n\nJoint('revolute', -170, 170)\n",
        "line 3: A joint has the limits -170 to 170 rad, which are many turns. Give rad, such as deg(-170, 170)",
    ),
    "dh": (
        "from casacal import Robot\n\nRobot.from_dh('r', alpha=(0,), a=(1, 2), d=(0,), theta=(0,), length_std=1,\n"
        "              angle_std=1)\n",
        "line 3: The DH table of 'r'",
    ),
    "pose": (
        "from casacal import DialOnPlane, Problem, Robot\n"
        "problem = Problem(Robot('r', 6, lambda p, q: p.nothing, {}), DialOnPlane(noise_std=1))\n",
        "pose of 'r' failed",
    ),
    "shape": (
        "from casacal import DialOnPlane, Problem, Robot\n"
        "problem = Problem(Robot('r', 6, lambda p, q: q, {}), DialOnPlane(noise_std=1))\n",
        "shape (6, 1)",
    ),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_bad_problem_files_are_refused_in_one_line(run, tmp_path, name):
    content, says = PROBLEMS[name]
    (tmp_path / "problem.py").write_text(content)
    code, out, err = run("calibrate", tmp_path, ROOT / "problems" / "hsr_jr680" / "samples.csv")
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert says in err
    assert "Traceback" not in err


SLIP = """import math, casadi as ca
from casacal import DialOnPlane, Problem, Robot
from casacal.model.kinematics import chain, rotate_z, translate_x

def pose(p, q):
    {line}

problem = Problem(Robot("r", 2, pose, {{}}), DialOnPlane(noise_std=0.01))
"""


@pytest.mark.parametrize("command", ["simulate", "plan"])
@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("return chain(rotate_z(q[0]), translate_x(p.L))", "line 6: pose of 'r' failed with AttributeError"),
        ("if q[0] > 0: return chain()", "line 6: pose of 'r' failed with RuntimeError"),
        ("pass", "problem.py: pose of 'r' failed with TypeError: it returns nothing."),
        ("return chain(rotate_z(q[0]))[:3, :3]", "pose of 'r' has the shape (3, 3)"),
        (
            "c, s = ca.cos(q[0]), ca.sin(q[0]); return ca.diagcat(ca.blockcat([[c, s], [s, c]]), 1, 1)",
            "The pose of 'r' is no rigid motion (R^T R is off by 0.52), at the joint values [0.274, -0.46]. Look at",
        ),
        (
            "return ca.diagcat(rotate_z(q[0])[:3, :3], -1)",
            "has the last row [0.0, 0.0, 0.0, -1.0] in place of 0, 0, 0, 1",
        ),
        ("return ca.diagcat(rotate_z(q[0])[:2, :2], -1, 1)", "The pose of 'r' mirrors (det R = -1), at the joint"),
        ("return chain(rotate_z(math.sin(q[0])), translate_x(9))", "The tip of 'r' is not finite in any posture"),
    ],
)
def test_a_slip_in_pose_is_one_line_of_every_command(run, tmp_path, command, line, says):
    (tmp_path / "problem.py").write_text(SLIP.format(line=line))
    code, out, err = run(command, tmp_path, "--out", tmp_path / "out.csv")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert says in err
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--json"], "unrecognized"),
        (["nonsense"], "There is no command named 'nonsense'. Known: new, doctor"),
        (["calibrate"], "PROBLEM"),
        (["calibrate", "nowhere"], "no problem at 'nowhere'"),
        (["predict", "result.json", "at.csv", "--out", "-"], "--out - names no file. Standard output is /dev/stdout"),
        (["calibrate", HSR, "none.csv"], "no such file"),
        (["calibrate", HSR, "--method", "magic"], "magic"),
        (["calibrate", HSR, "--holdout", "1"], "fraction"),
        (["calibrate", HSR, "--holdout", "0.99"], "leaves no row of 'floor'"),
        (["calibrate", HSR, "--holdout", "0.8"], "24 rows are fitted"),
        (["calibrate", HSR, "--fix", "a7"], "no free unknown named 'a7'"),
        (["calibrate", HSR, "--prior", "a3"], "NAME=STD"),
        (["calibrate", HSR, "--prior", "a3=0"], "positive"),
        (["calibrate", HSR, "--prior", "plane=0.001"], "components in mm and rad"),
        (["calibrate", HSR, "--fix", "aplha"], "Did you mean 'alpha'"),
        (["calibrate", HSR, "--prior", "a3=nan"], "NAME=STD"),
        (["calibrate", HSR, "--fix", ""], "--fix is empty"),
        (["calibrate", HSR, "--free", " , "], "--free is empty"),
        (["calibrate", HSR, "--holdout", "0.3", "--holdout-by", ""], "--holdout-by is empty"),
        (["calibrate", HSR, "--holdout-by", " "], "--holdout-by is empty"),
        (["calibrate", HSR, "--set", "sign=1", "--set", "sign=-1"], "--set gives 'sign' twice"),
        (["calibrate", HSR, "--prior", "a3=1", "--prior", "a3=2"], "--prior gives 'a3' twice"),
        (["calibrate", HSR, "--fix", "a3", "--free", "a3"], "'a3' is both freed (--free) and held (--fix)"),
        (["calibrate", HSR, "--fix", "a", "--prior", "a3=1"], "'a3' is both given a prior (--prior) and held (--fix)"),
        (["calibrate", HSR, "--fix", "alpha", "--free", "alpha2"], "'alpha2' is both freed (--free) and held (--fix)"),
        (["check", HSR, "--fix", ""], "--fix is empty"),
        (["calibrate", HSR, "--method", "lm", "--loss", "cauchy"], "invalid choice"),
        (["calibrate", HSR, "--method", "ekf", "--loss", "huber"], "takes no loss"),
        (["calibrate", HSR, "--method", "sckf", "--loss", "huber"], "Use one of lm, sckf-lm,"),
        (["calibrate", HSR, "--accuracy", "0"], "accuracy is 0 mm. Give mm, 0.01 or more"),
        (["calibrate", HSR, "--accuracy", "0.0005"], "accuracy is 0.0005 mm. Give mm, 0.01 or more"),
        (["calibrate", HSR, "--out", HSR + "/samples.csv"], "is no folder"),
        (["check", "nowhere"], "no problem"),
        (["check", HSR, "none.csv"], "no such file"),
        (["simulate", HSR, "--out", "x.csv", "--samples", "0"], "at least one"),
        (["simulate", HSR, "--out", "x.csv", "--tilt", "95"], "tilt"),
        (["simulate", HSR, "--out", "x.csv", "--outliers", "2"], "outliers"),
        (["predict", "none.json", "x.csv", "--out", "y.csv"], "no such file"),
        (["predict", HSR + "/samples.csv", "x.csv", "--out", "y.csv"], "not a result"),
    ],
)
def test_bad_arguments_are_refused_in_one_line(run, arguments, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert says in err
    assert list(tmp_path.iterdir()) == []


def test_too_few_rows_for_the_unknowns(run, tmp_path):
    lines = (ROOT / "problems" / "hsr_jr680" / "samples.csv").read_text().splitlines()
    few = tmp_path / "few.csv"
    few.write_text("\n".join(lines[:22]) + "\n")
    code, _, err = run("calibrate", HSR, few)
    assert code == 2
    assert "20 rows are fitted for 33 unknowns" in err
    assert "Take at least 33 samples" in err


def test_rows_that_a_face_lacks_come_with_the_total(run, tmp_path):
    """Who follows the advice on the face alone is not told at once that it was not enough."""
    lines = (ROOT / "problems" / "hsr_jr680" / "samples.csv").read_text().splitlines()
    header, *rows = [line for line in lines if not line.startswith("#")]
    faces = {face: [row for row in rows if row.endswith(face)] for face in ("floor", "wall", "side")}
    few = tmp_path / "few.csv"
    few.write_text("\n".join([header, *(row for some in faces.values() for row in some[:3])]) + "\n")
    code, _, err = run("calibrate", HSR, few)
    assert code == 2
    assert "Take at least 4 rows there, and at least 33 in all for 33 unknowns" in err
    few.write_text("\n".join([header, *(row for some in faces.values() for row in some[:11])]) + "\n")
    code, _, err = run("calibrate", HSR, few, "--method", "lm", "--no-reference")
    assert code != 2, err


@pytest.mark.long
def test_a_problem_that_changed_since_is_noticed(run, tmp_path):
    folder = tmp_path / "mine"
    shutil.copytree(HSR, folder)
    assert run("calibrate", folder, "--no-reference", "--method", "lm", "--out", tmp_path / "out")[0] == 0
    joints = folder / "samples.csv"
    assert run("predict", tmp_path / "out" / "result.json", joints, "--out", tmp_path / "p.csv")[0] == 0
    with (folder / "problem.py").open("a") as stream:
        stream.write("# a comment\n")
    assert run("predict", tmp_path / "out" / "result.json", joints, "--out", tmp_path / "p2.csv")[0] == 0
    with (folder / "problem.py").open("a") as stream:
        stream.write("robot = None\n")
    code, _, err = run("predict", tmp_path / "out" / "result.json", joints, "--out", tmp_path / "p2.csv")
    assert code == 2
    assert "has changed" in err


def test_a_file_that_cannot_be_completed_leaves_the_old_one(tmp_path, monkeypatch):
    from casacal import files

    target = tmp_path / "result.json"
    target.write_text("# written by casacal 0.1.0, old")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(casacal.CasacalError, match="No space"):
        files.write_text(target, "new")
    assert target.read_text() == "# written by casacal 0.1.0, old"
    assert list(tmp_path.iterdir()) == [target]


def test_help_imports_nothing_heavy():
    code = (
        "import sys; from casacal.cli.main import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'casadi', 'numpy', 'scipy', 'pandas', 'matplotlib'} & set(sys.modules)\n"
        "sys.exit(str(heavy) if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "calibrate" in done.stdout


def test_an_interruption_is_one_line(run, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["casacal.fit.lm"], "lm", stop)
    code, out, err = run("calibrate", HSR, "--method", "lm")
    assert (code, out) == (130, "")
    assert err.count("\n") == 1


@pytest.mark.long
def test_devices_and_links_are_written_into_not_replaced(hsr, tmp_path):
    import os
    import threading

    result = tmp_path / "fit"
    assert main(["calibrate", str(hsr.path), "--method", "lm", "--out", str(result)]) == 0
    real, link = tmp_path / "real.csv", tmp_path / "link.csv"
    real.write_text("# written by casacal 0.1.0, old")
    link.symlink_to(real)
    assert main(["predict", str(result), str(hsr.samples), "--out", str(link)]) == 0
    assert link.is_symlink()
    assert real.read_text().splitlines()[1].startswith("x_mm")
    pipe, read = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()))
    reader.start()
    assert main(["predict", str(result), str(hsr.samples), "--out", str(pipe)]) == 0
    reader.join()
    assert pipe.is_fifo()
    assert read[0] == real.read_bytes()


@pytest.mark.parametrize("seed", ["-1", "1.5", "x"])
def test_seeds_are_whole_numbers(hsr, tmp_path, capsys, seed):
    for command in (["calibrate", str(hsr.path)], ["simulate", str(hsr.path), "--out", str(tmp_path / "s.csv")]):
        assert main([*command, "--seed", seed]) == 2
        assert "whole number" in capsys.readouterr().err


@pytest.mark.long_unless("None")
@pytest.mark.parametrize("estimate", [float("nan"), 1e308, True, "0.1", None])
def test_a_result_that_somebody_edited_is_refused(calibrated, tmp_path, capsys, estimate):
    document = json.loads((calibrated / "result.json").read_text())
    document["parameters"][0]["estimate"] = estimate
    (tmp_path / "result.json").write_text(json.dumps(document))
    capsys.readouterr()
    assert main(["export", str(tmp_path), "--to", "dh", "--out", str(tmp_path / "o.csv")]) == 2
    assert "the estimate of 'alpha1' is" in capsys.readouterr().err
    assert not (tmp_path / "o.csv").exists()


@pytest.mark.parametrize("written", ["Plane", "PLANE", "plain"])
def test_a_misspelt_label_column_is_named(hsr, tmp_path, capsys, written):
    text = hsr.samples.read_text().replace("reading_mm,plane", f"reading_mm,{written}")
    (tmp_path / "s.csv").write_text(text)
    assert main(["calibrate", str(hsr.path), str(tmp_path / "s.csv")]) == 2
    assert f"did you mean '{written}'?" in capsys.readouterr().err
