"""What casacal writes bears its mark, what others wrote stays, and sets of files are old or new after any kill."""

import io
import json
import os
import shutil
import subprocess
import sys

import casadi as ca
import pandas as pd
import pytest
from conftest import ROOT

import casacal
from casacal import CasacalError
from casacal.cli.main import main
from casacal.files import recover, refuse_others, side_by_side, together, write_text

HSR = ROOT / "problems" / "hsr_jr680"
JOINTS = "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n0,10,20,30,-40,50\n"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a calibration, joint values, and simulated rows."""
    folder = tmp_path_factory.mktemp("written")
    assert main(["calibrate", str(HSR), "--method", "lm", "--no-reference", "--out", str(folder / "fit")]) == 0
    assert main(["simulate", str(HSR), "--samples", "40", "--out", str(folder / "sim.csv")]) == 0
    (folder / "j.csv").write_text(JOINTS)
    return folder


RESULT = "fit/result.json"
WRITERS = {
    "predict": ["predict", RESULT, "j.csv", "--out", "x.csv"],
    "compensate": ["compensate", RESULT, "j.csv", "--out", "x.csv"],
    "rapid": ["compensate", RESULT, "j.csv", "--format", "rapid", "--out", "x.csv"],
    "plan": ["plan", str(HSR), "--touches", "12", "--pool", "40", "--out", "x.csv"],
    "sheet": ["plan", str(HSR), "--touches", "12", "--pool", "40", "--out", "y.csv", "--sheet", "x.csv"],
    "program": ["plan", str(HSR), "--touches", "12", "--pool", "40", "--out", "x.csv", "--program", "krl"],
    "dh": ["export", RESULT, "--to", "dh", "--out", "x.csv"],
    "zeros": ["export", RESULT, "--to", "zeros", "--out", "x.csv"],
    "c": ["export", RESULT, "--to", "c", "--out", "x.csv"],
    "casadi": ["export", RESULT, "--to", "casadi", "--out", "x.csv"],
    "simulate": ["simulate", str(HSR), "--samples", "40", "--out", "x.csv"],
    "report": ["verify", RESULT, "sim.csv", "--report", "x.csv"],
    "frame": ["export", RESULT, "--to", "frame", "--faces", "floor,wall,side", "--out", "x.csv"],
}
OTHERS = {
    "tracker": b"q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm\n1,2,3,4,5,6,7,8,9\n",
    "utf-16": "q1_deg,reading_mm\n1,2\n".encode("utf-16"),
    "measured": b"# measured by casacal: hsr, plan 0\nq1_deg,reading_mm\n1,2\n",
    "workbook": b"PK\x03\x04 a workbook",
    "prose": b"To be calibrated by casacal on Monday.\n",
    "json": b'{"mine": 1}',
    "program": b"print('mine')\n",
    "no": b"# not written by casacal but by Ann\na,b\n1,2\n",
    "a cell": b"who,what\nAnn,this was written by casacal 0.1.0\n",
    "inside": b'{"mine": {"written_by": "casacal 0.1.0"}}',
    "page": b"<html><p>the report written by casacal 0.1.0 is elsewhere</p></html>",
    "measured and marked": b"# measured by casacal: hsr, plan 0\n# written by casacal 0.1.0\nq1_deg,reading_mm\n1,2\n",
    "measured by another name": b"# planned by casacal for x\nq1_deg,x_mm,order,touch,purpose,kept\n1,2,1,1,fit,-\n",
    "a plan that was filled in": b"# planned by casacal for x: not a measurement\nq1_deg,reading_mm,plane\n1,2,floor\n",
    "picture": b"\x89PNG\r\n\x1a\n mine",
}


MEASURED = ("measured", "measured and marked", "measured by another name", "a plan that was filled in")


@pytest.mark.parametrize("kind", OTHERS)
@pytest.mark.parametrize("name", ["x.csv", "x_check.csv"])
def test_a_session_begins_in_no_file_of_others(place, tmp_path, monkeypatch, capsys, kind, name):
    """Neither cut where it has no last line end, nor written anew in another encoding, nor removed."""
    monkeypatch.chdir(tmp_path)
    plan = str(place / "plan.csv")
    if not (place / "plan.csv").exists():
        assert main(["plan", str(HSR), "--touches", "12", "--pool", "40", "--out", plan]) == 0
    for content in (OTHERS[kind], OTHERS[kind].rstrip(b"\n"), OTHERS[kind] + b"\x00\xff\xfe cut"):
        (tmp_path / name).write_bytes(content)
        monkeypatch.setattr(sys, "stdin", io.StringIO("3.2\nq\n"))
        assert main(["measure", str(HSR), "--plan", plan, "--out", "x.csv"]) == 2
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {name: content}
    capsys.readouterr()


@pytest.mark.long_unless("predict", "compensate", "plan", "dh", "casadi", "simulate")
@pytest.mark.parametrize("writer", WRITERS)
def test_a_command_writes_over_its_own_files_and_over_nobody_elses(place, tmp_path, monkeypatch, capsys, writer):
    """First every kind of file that is somebody else's is kept, to the byte; then its own is written, twice."""
    shutil.copytree(place, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    typed = WRITERS[writer]
    for kind, content in OTHERS.items():
        (tmp_path / "x.csv").write_bytes(content)
        there = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
        assert main(typed) == 2, kind
        said = capsys.readouterr().err
        assert "'x.csv' exists and " + ("holds measured rows" if kind in MEASURED else "was not written by") in said
        assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == there
    (tmp_path / "x.csv").write_bytes(b"")  # an empty file holds nothing
    for _ in range(2):
        assert main(typed) in (0, 1)
        refuse_others("x.csv")
        capsys.readouterr()
    if writer == "casadi":  # the mark stands behind what CasADi reads
        shutil.copy("x.csv", "x.casadi")
        assert isinstance(ca.Function.load("x.casadi"), ca.Function)
    if writer == "simulate":
        (tmp_path / "x.truth.json").write_text('{"mine": 1}')
        assert main(typed) == 2
        assert "x.truth.json' exists and was not written by casacal" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["report.html", "result.json", "parameters.csv", "residuals.png", "convergence.png"])
def test_no_file_of_a_calibration_is_written_over_others(place, tmp_path, name, capsys):
    for path in (place / "fit").iterdir():
        refuse_others(path)  # each bears the mark
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_bytes(b"mine")
    assert main(["calibrate", str(HSR), "--method", "lm", "--no-reference", "--out", str(tmp_path / "out")]) == 2
    assert f"{name}' exists and was not written by casacal" in capsys.readouterr().err
    assert [path.read_bytes() for path in (tmp_path / "out").iterdir()] == [b"mine"]


def test_python_asks_as_the_command_line_does(place, tmp_path):
    found = casacal.load(place / "fit")
    (tmp_path / "mine.csv").write_text("mine")
    for write in (
        lambda: found.export("dh", tmp_path / "mine.csv"),
        lambda: found.program([[0.0] * 6], "rapid", tmp_path / "mine.csv"),
        lambda: write_text(tmp_path / "mine.csv", "other"),
    ):
        with pytest.raises(CasacalError, match="was not written by casacal"):
            write()
    assert (tmp_path / "mine.csv").read_text() == "mine"


KILLED = """
import os, shutil, sys
from pathlib import Path
from casacal import files
asked, left = sys.argv[1], int(sys.argv[2])
def watched(function):
    def watching(*given, **more):
        global left
        for after in (False, True):
            left -= 1
            if left == 0:
                os._exit(9)
            if not after:
                made = function(*given, **more)
        return made
    return watching
for name in ("rename", "replace", "unlink", "rmdir"):
    setattr(os, name, watched(getattr(os, name)))
shutil.move = watched(shutil.move)
folder, own = Path(asked), sys.argv[3] == "own"
with files.together(folder, ["a", "b", "gone", "last"], own=own) as place:
    for name in ("a", "b", "last"):
        (place / name).write_text((folder / "a").read_text().replace("old", "new"))
"""


@pytest.mark.long
@pytest.mark.skipif(os.name == "nt", reason="folders that are locked")
@pytest.mark.parametrize("own", ["own", "marked"])
def test_a_set_is_old_or_new_after_a_kill_at_any_moment(tmp_path, own):
    """The writer is ended before and after each change of a name, until none is left at which it could be."""
    names, seen = ("a", "b", "gone", "last"), set()
    head = "# measured by casacal: p" if own == "own" else "# written by casacal 0.1.0"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    for step in range(1, 60):
        folder = tmp_path / str(step)
        folder.mkdir()
        for name in names:
            (folder / name).write_text(f"{head}, old\n")
        typed = [sys.executable, "-c", KILLED, str(folder), str(step), own]
        ended = subprocess.run(typed, env=environment, check=False)
        if own == "own":
            assert all((folder / name).exists() for name in ("a", "b", "last")), "at no moment is any of them lost"
        if step % 3 == 0:  # also where the folder was moved meanwhile
            folder = folder.rename(tmp_path / f"moved {step}")
        recover(folder)
        after = {name: (folder / name).read_text() for name in names if (folder / name).exists()}
        new = dict.fromkeys(("a", "b", "last"), f"{head}, new\n")
        assert after in (dict.fromkeys(names, f"{head}, old\n"), new), step
        seen.add(after == new)
        with together(folder, ["a"], own=own == "own"):  # sweeps what the killed one left, and takes the old file away
            pass
        assert not [path for path in folder.iterdir() if path.name.startswith(".")]
        if ended.returncode == 0:
            break
    assert ended.returncode == 0
    assert step > 8, "it was killed many times"
    assert seen == {True, False}


@pytest.fixture
def left_ready(tmp_path):
    """A folder in which a run was killed when its files were ready, before any of them took its place."""
    folder = tmp_path / "d"
    folder.mkdir()
    for name in ("a", "last"):
        (folder / name).write_text("# written by casacal 0.1.0, old\n")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    for step in range(1, 20):
        subprocess.run([sys.executable, "-c", KILLED, str(folder), str(step), "marked"], env=environment, check=False)
        if list(folder.glob(".casacal.ready-*")):
            return folder
    raise AssertionError("it is never ready")


def test_what_was_put_there_meanwhile_stays(left_ready):
    (left_ready / "a").write_text("mine")
    recover(left_ready)
    assert (left_ready / "a").read_text() == "mine"
    with pytest.raises(CasacalError, match="was not written by casacal"), together(left_ready, ["last"]):
        pass
    (left_ready / "a").unlink()
    recover(left_ready)
    assert "new" in (left_ready / "a").read_text()


def test_a_copy_of_a_folder_leaves_the_first_one_alone(left_ready, tmp_path):
    there = {path.name: path.read_bytes() for path in left_ready.iterdir() if path.is_file()}
    shutil.copytree(left_ready, tmp_path / "copy")
    recover(tmp_path / "copy")
    assert "new" in (tmp_path / "copy" / "last").read_text()
    assert {path.name: path.read_bytes() for path in left_ready.iterdir() if path.is_file()} == there


@pytest.mark.parametrize(
    "listed",
    [
        '{"files": [["../victim", true]], "own": false}', '{"files": [["VICTIM", true]], "own": false}',
        "[]", "null", '{"files": 5}', "[" * 5000, '{"files": [], "own": true}', "\x00",
    ],
)  # fmt: skip
def test_a_forged_list_moves_nothing(tmp_path, listed):
    (tmp_path / "victim").write_text("# written by casacal 0.1.0\n")
    ready = tmp_path / "d" / ".casacal.ready-1"
    ready.mkdir(parents=True)
    (ready / "a").write_text("evil")
    (ready / ".list").write_text(listed.replace("VICTIM", str(tmp_path / "victim")))
    (tmp_path / "d" / "s.csv").write_text("a,b\n1,2\n")
    recover(tmp_path / "d")
    with together(tmp_path / "d", ["other"]):
        pass
    assert (tmp_path / "victim").read_text() == "# written by casacal 0.1.0\n"
    assert (ready / "a").read_text() == "evil"


def test_a_result_whose_files_were_not_all_placed_is_read_as_the_new_one(place, tmp_path, monkeypatch):
    shutil.copytree(place / "fit", tmp_path / "fit")
    moves = iter(range(2))
    move = shutil.move
    with monkeypatch.context() as patched:
        patched.setattr(shutil, "move", lambda *given: move(*given) if next(moves, None) is not None else 1 / 0)
        with pytest.raises(ZeroDivisionError):
            casacal.calibrate(HSR, method="lm", reference=False, seed=7, holdout=0.2).save(tmp_path / "fit")
    assert casacal.load(tmp_path / "fit").to_dict()["seed"] == 7
    assert json.loads((tmp_path / "fit" / "result.json").read_text())["seed"] == 7
    assert not [path for path in (tmp_path / "fit").iterdir() if path.name.startswith(".")]


def test_samples_whose_truth_was_not_placed_are_read_with_it(tmp_path):
    for name in ("x.csv", "x.truth.json"):
        (tmp_path / name).write_text("# written by casacal 0.1.0, old")
    with side_by_side([tmp_path / "x.truth.json", tmp_path / "x.csv"]) as (truth, rows):
        truth.write_text("new")
        rows.write_text("a,b\n1,2\n")
    assert (tmp_path / "x.truth.json").read_text() == "new"
    assert pd.read_csv(tmp_path / "x.csv").shape == (1, 2)
