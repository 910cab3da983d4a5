"""Every study runs in its quick form and leaves a report whose pictures exist."""

import importlib
import re
import sys

import pytest
from conftest import ROOT

HELPERS = {"__init__", "reporting"}
NAMES = sorted(path.stem for path in (ROOT / "studies").glob("*.py") if path.stem not in HELPERS)
QUICK = {"efficiency": ["--trials", "2"], "identifiability": ["--quick"]}


@pytest.mark.parametrize("name", NAMES)
def test_a_study_runs_and_reports(name, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [name, "--out", str(tmp_path), *QUICK.get(name, [])])
    importlib.import_module(f"studies.{name}").main()
    assert capsys.readouterr().out
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert report.startswith("# ")
    assert "|---|" in report
    assert f"python -m studies.{name}" in report
    for picture in re.findall(r"!\[[^]]*\]\(([^)]+)\)", report):
        assert (tmp_path / picture).read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize("name", NAMES)
def test_a_study_is_committed_with_its_report(name):
    assert (ROOT / "studies" / name / "report.md").is_file()
