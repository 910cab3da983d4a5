"""A verification in the calibration's own report: where it stands, what it replaces, and reports of others."""

import json
import shutil

import html5lib
import pytest
from conftest import ROOT
from test_html_report import Page

from casacal.cli.main import main

HSR = str(ROOT / "problems" / "hsr_jr680")


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrated")
    assert main(["calibrate", HSR, "--method", "lm", "--no-reference", "--out", str(folder / "out")]) == 0
    assert main(["simulate", HSR, "--out", str(folder / "fresh.csv"), "--samples", "60", "--tilt", "20"]) == 0
    return folder


def sections(text):
    return [attributes["id"] for attributes, _ in Page(text.partition("\n")[2]).all("section")]


def test_a_section_follows_the_verdict_and_the_next_one_replaces_it(calibrated, capsys):
    result, report = calibrated / "out" / "result.json", calibrated / "out" / "report.html"
    before = report.read_text()
    common = ["verify", str(result), str(calibrated / "fresh.csv"), "--into-report", "--json"]
    assert main(common) == 0
    found = json.loads(capsys.readouterr().out)
    once = report.read_text()
    was, now = sections(before), sections(once)
    assert now == [*was[: was.index("verdict") + 1], "verified", *was[was.index("verdict") + 1 :]]
    html5lib.HTMLParser(strict=True).parse(once)
    read = Page(once.partition("\n")[2])
    assert read.faults == []
    said = read.text_of("verified")
    assert "fresh.csv" in said
    assert found["sha256"] in said
    whole = next(part for part in found["errors"] if part["kind"] == "all")
    assert f"{whole['after']['mm']:.4f}" in said
    assert f"{whole['before']['mm']:.4f}" in said
    assert main([*common, "--tolerance", "0.0001"]) == 1
    capsys.readouterr()
    twice = report.read_text()
    assert sections(twice) == now
    assert "verdict care" in twice[twice.index('id="verified"') :]
    assert "0.0001 mm" in Page(twice.partition("\n")[2]).text_of("verified")
    start, end = (twice.index(mark) for mark in ('<section id="verified"', '<section id="measured"'))
    assert twice[:start] + twice[end:] == before, "nothing else is touched"


@pytest.mark.long
def test_reports_of_others_are_left_alone(calibrated, tmp_path, capsys):
    other = tmp_path / "out"
    other.mkdir()
    shutil.copy(calibrated / "out" / "result.json", other / "result.json")
    common = ["verify", str(other / "result.json"), str(calibrated / "fresh.csv"), "--into-report"]
    assert main(common) == 2
    assert "There is no report" in capsys.readouterr().err
    document = json.loads((other / "result.json").read_text())
    text = (calibrated / "out" / "report.html").read_text()
    for wrong in (text.replace(document["data"]["sha256"], "0" * 64), "<p>mine</p>", text.replace("measured", "m")):
        (other / "report.html").write_text(wrong)
        assert main(common) == 2
        assert "is not the report of this result" in capsys.readouterr().err
        assert (other / "report.html").read_text() == wrong
