"""Every study runs in its quick form, and is committed with a report that its own records make again."""

import json
import os
import re
import shutil
import subprocess
import sys

import pytest
from conftest import ROOT
from matplotlib.figure import Figure

from casacal.cli.main import main
from casacal.study.runs import RECORDS
from casacal.study.study_file import load_study

FILES = sorted(path for path in (ROOT / "studies").glob("*.py") if "\ndef report(" in path.read_text(encoding="utf-8"))
NAMES = [path.stem for path in FILES]
REAL = {"real_arm", "real_arm_effects"}
EXTRA = {"population": ("pymoo", "pyswarms")}  # packages that a study runs, and its report does without


@pytest.fixture(params=FILES, ids=NAMES)
def file(request, monkeypatch):
    if request.param.stem in REAL:
        folder = request.getfixturevalue("motoman_data")
        monkeypatch.setenv("CASACAL_MOTOMAN", str(folder))
        for name in REAL:  # where the measurements are is asked for as they are imported
            sys.modules.pop(f"studies.{name}", None)
    return request.param


@pytest.mark.long_unless("what_sizes_mean")
def test_a_study_runs_and_reports(file, tmp_path, capsys):
    for package in EXTRA.get(file.stem, ()):
        pytest.importorskip(package)
    trials = ["--trials", "1"] if load_study(file).study is not None else []
    assert main(["study", str(file), "--quick", "--out", str(tmp_path), *trials]) == 0
    assert "Written" in capsys.readouterr().out
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert report.startswith("# ")
    assert "|---|" in report
    assert f"python -m studies.{file.stem}" in report
    assert "numpy" in report
    assert not _methods_that_never_answer(tmp_path)
    pictures = re.findall(r"!\[[^]]*\]\(([^)]+)\)", report)
    assert pictures or file.stem == "efficiency"
    for picture in pictures:
        assert (tmp_path / picture).read_bytes()[:4] == b"\x89PNG"


@pytest.mark.long_unless("what_sizes_mean")
def test_a_study_is_committed_with_the_report_that_its_records_make(file, tmp_path, monkeypatch):
    monkeypatch.setattr(Figure, "savefig", lambda *given, **options: None)  # the words alone are compared
    folder = ROOT / "studies" / file.stem
    committed = (folder / "report.md").read_text(encoding="utf-8")
    if load_study(file).study is None:
        return
    for name in (f"{RECORDS}.gz", "machines.json"):
        shutil.copy(folder / name, tmp_path / name)
    assert main(["study", str(file), "--report", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "report.md").read_text(encoding="utf-8") == committed


def _methods_that_never_answer(folder):
    """Methods all of whose records say that they failed: their report would be a table of dashes."""
    file = folder / "records.jsonl"
    records = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()] if file.is_file() else []
    answered = {record["method"] for record in records if record["error"] is None}
    return {record["method"] for record in records} - answered


@pytest.mark.long
def test_a_study_runs_as_a_module(tmp_path):
    command = [sys.executable, "-m", "studies.as_printed", "--quick", "--out", str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "report.md").is_file()


def test_real_measurements_that_are_absent_are_said(monkeypatch, capsys):
    monkeypatch.delenv("CASACAL_MOTOMAN", raising=False)
    monkeypatch.delitem(sys.modules, "studies.real_arm", raising=False)
    assert main(["study", str(ROOT / "studies" / "real_arm.py")]) == 0
    assert "CASACAL_MOTOMAN" in capsys.readouterr().out
    sys.modules.pop("studies.real_arm", None)
