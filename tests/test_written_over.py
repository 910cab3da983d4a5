"""What casacal writes bears its mark, what others wrote stays, and sets of files are old or new after any kill."""

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
    "picture": b"\x89PNG\r\n\x1a\n mine",
}


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
        assert "'x.csv' exists and " + ("holds measured rows" if kind == "measured" else "was not written by") in said
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
folder = Path(asked)
with files.together(folder, ["a", "b", "gone", "last"], elsewhere={"b": folder / "other" / "b"}, own=True) as place:
    for name in ("a", "b", "last"):
        (place / name).write_text("new")
"""


@pytest.mark.skipif(os.name == "nt", reason="folders that are locked")
def test_a_set_is_old_or_new_after_a_kill_at_any_moment(tmp_path):
    """The writer is ended before and after each change of a name, until none is left at which it could be."""
    names, seen = ("a", "other/b", "gone", "last"), set()
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    for step in range(1, 60):
        folder = tmp_path / str(step)
        (folder / "other").mkdir(parents=True)
        for name in names:
            (folder / name).write_text("old")
        ended = subprocess.run([sys.executable, "-c", KILLED, str(folder), str(step)], env=environment, check=False)
        before = {name: (folder / name).read_text() for name in names if (folder / name).exists()}
        assert set(before) >= {"a", "other/b", "last"}, "at no moment is any of them lost"
        recover(folder)
        after = {name: (folder / name).read_text() for name in names if (folder / name).exists()}
        assert after in (dict.fromkeys(names, "old"), dict.fromkeys(("a", "other/b", "last"), "new")), step
        seen.add(tuple(sorted(set(after.values()))))
        with together(folder, ["a"], own=True):  # sweeps what the killed one left, and takes the old file away
            pass
        assert not [path for path in folder.iterdir() if path.name.startswith(".")]
        if ended.returncode == 0:
            break
    assert ended.returncode == 0
    assert step > 8, "it was killed many times"
    assert seen == {("old",), ("new",)}


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
        (tmp_path / name).write_text("old, written by casacal")
    with side_by_side([tmp_path / "x.truth.json", tmp_path / "x.csv"]) as (truth, rows):
        truth.write_text("new")
        rows.write_text("a,b\n1,2\n")
    assert (tmp_path / "x.truth.json").read_text() == "new"
    assert pd.read_csv(tmp_path / "x.csv").shape == (1, 2)
