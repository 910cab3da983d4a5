"""`casacal bench`: a set that the test makes, methods of its own, and what is wrong with a set said in a sentence."""

import gzip
import hashlib
import json
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT
from instruments_on_ur5 import PROBLEMS

from casacal import Samples, load_problem, simulate
from casacal.cli.main import main
from casacal.data.samples import write_samples
from casacal.errors import CasacalError, StudyError, UnknownNameError
from casacal.study.benchmark import (
    bench_lines,
    benchmark,
    folds,
    read_set,
    read_sets,
    read_ways,
    root_mean_square,
    squares_of,
)
from casacal.study.description import Run, read_records
from casacal.study.runs import errands, tasks_of
from studies.bench import methods

PROBLEM = """
from instruments_on_ur5 import PROBLEMS

problem = PROBLEMS["TrackedPoint"]
"""
SET = """
title = "A simulated UR5"
source = "this test"
licence = "none"
file = "there/rows.csv"
sha256 = "{sha256}"
metric = "{metric}"
blocks = "{blocks}"

[stated]
part = 0.25
seed = 3

[[published]]
method = "flat"
figure = 1.7
by = "nobody"
"""
METHODS = str(ROOT / "studies" / "bench" / "methods.py")
OWN = """
import numpy as np

def flat(problem, fitted, unseen):
    return np.ones((len(unseen), 3))

def lost(problem, fitted, unseen):
    raise ValueError("no idea")

methods = {"flat": flat, "lost": lost}
"""


@pytest.fixture
def place(tmp_path):
    """A folder of sets, and one of data."""
    folder, data = tmp_path / "sets" / "mine", tmp_path / "data" / "there"
    folder.mkdir(parents=True)
    data.mkdir(parents=True)
    (folder / "problem.py").write_text(PROBLEM, encoding="utf-8")
    problem = load_problem(folder).problem
    write_samples(data / "rows.csv", problem.layout(), simulate(problem, samples=60, seed=1).samples, ["simulated"])
    digest = hashlib.sha256((data / "rows.csv").read_bytes()).hexdigest()
    (folder / "set.toml").write_text(SET.format(sha256=digest, metric="distance", blocks="regions"), encoding="utf-8")
    (tmp_path / "own.py").write_text(OWN, encoding="utf-8")
    return tmp_path


def ran(place, *words):
    words = ["--data", str(place / "data"), "--out", str(place / "out"), "--methods", METHODS, *words]
    return main(["bench", str(place / "sets"), *words])


def test_figures_are_those_of_the_residuals_that_a_method_returns(place, capsys):
    """A method that leaves 1 mm along each axis of every row: sqrt(3) in every split, whatever is bootstrapped."""
    words = ["--methods", str(place / "own.py"), "--method", "flat", "--method", "lost", "--method", "geometry (SciPy)"]
    assert ran(place, *words) == 0
    report = (place / "out" / "report.md").read_text(encoding="utf-8")
    flat = next(line for line in report.splitlines() if line.startswith("| flat"))
    assert re.findall(r"\d\.\d{3}", flat) == ["1.732"] * 7, "stated, random and blocked with their intervals"
    assert flat.endswith("| 1.00 | 1.7 (nobody) | yes |")
    assert "`lost`: ValueError: no idea" in report
    fitted = next(line for line in report.splitlines() if line.startswith("| geometry (SciPy)"))
    assert 0.07 < float(fitted.split("|")[2]) < 0.12, "three axes of 0.05 mm, and what 45 rows do not know"
    lines = (place / "out" / "records.jsonl").read_text(encoding="utf-8").splitlines()
    made = {record["setting"] for record in map(json.loads, lines)}
    assert len(made) == 1 + 5 + 4
    assert "bench: 30 of 30 records" in capsys.readouterr().err
    assert ran(place, *words) == 2, "records stand there"
    assert ran(place, *words, "--resume") == 0
    capsys.readouterr()
    assert ran(place, "--method", "flat") == 2
    assert "flat" in capsys.readouterr().err


def test_the_quick_form_has_one_block_of_every_set(place):
    assert ran(place, "--quick", "--method", "as drawn", "--method", "casacal, geometry") == 0
    report = (place / "out" / "report.md").read_text(encoding="utf-8")
    assert "yes" not in report.split("## A simulated")[1], "few rows reproduce nothing"
    records = [json.loads(line) for line in (place / "out" / "records.jsonl").read_text(encoding="utf-8").splitlines()]
    assert [record["setting"] for record in records] == ["mine / blocked / 1"] * 2


def test_workers_are_given_methods_that_they_can_import(place, monkeypatch):
    def given(file):
        study = benchmark(read_sets(place / "sets"), place / "data", read_ways([file]), quick=True)
        return study, errands(study, tasks_of(study), None, False)[0]

    (study, one), (_, other) = given(METHODS), given(place / "own.py")
    (setting,), method = study.settings, "geometry (SciPy)"
    assert one.study().fingerprint(setting, method) == study.fingerprint(setting, method)
    monkeypatch.delitem(sys.modules, "casacal_study_own")
    with pytest.raises(StudyError, match=r"cannot unpack the study: .*casacal_study_own.* into a package"):
        other.study()


def test_methods_rank_as_they_must(place):
    """On a simulated arm without anything beside its geometry, geometry wins over the drawing and over offsets."""
    bench = read_set(place / "sets" / "mine")
    problem = bench.problem
    rows = bench.read(place / "data", problem)
    fitted, unseen = folds(rows, "stated", bench.blocks, bench.stated)[0]
    parts = rows.take(fitted), rows.take(unseen)
    left = {
        name: float(np.sqrt(squares_of(np.asarray(methods.methods[name](problem, *parts)), "distance").mean()))
        for name in ("as drawn", "joint offsets", "geometry (SciPy)", "geometry + Gaussian process")
    }
    assert left["as drawn"] > left["joint offsets"] > 3 * left["geometry (SciPy)"]
    assert left["geometry + Gaussian process"] < 1.2 * left["geometry (SciPy)"]


def test_a_process_over_the_joints_finds_what_geometry_cannot():
    """A bump that no length or angle makes, between its own neighbours."""
    problem = PROBLEMS["TrackedPoint"]
    samples = simulate(problem, samples=240, seed=2).samples
    middle, spread = samples.joints.mean(axis=0), samples.joints.std(axis=0)
    bump = 0.8 * np.exp(-(((samples.joints - middle) / spread) ** 2).sum(axis=1) / 4)
    bent = Samples(
        samples.joints, {**samples.columns, "z": samples.columns["z"] + bump}, {}, samples.lines, {}, "bent", "bent"
    )
    rows = np.random.default_rng(0).permutation(240)
    some, rest = bent.take(rows[:190]), bent.take(rows[190:])
    with_it, without = (
        np.sqrt((np.asarray(way(problem, some, rest)) ** 2).sum(axis=1).mean())
        for way in (methods.geometry_and_process, methods.methods["geometry (SciPy)"])
    )
    assert with_it < 0.95 * without


def test_splits_leave_out_every_row_once():
    joints = np.random.default_rng(0).normal(size=(53, 6))
    samples = Samples(joints, {}, {}, tuple(range(2, 55)), {"day": tuple("abc"[k % 3] for k in range(53))}, "x", "x")
    for kind, blocks in (("random", "order"), ("blocked", "order"), ("blocked", "regions"), ("blocked", "day")):
        made = folds(samples, kind, blocks, {})
        assert sorted(np.concatenate([unseen for _, unseen in made]).tolist()) == list(range(53))
        assert all(sorted([*fitted, *unseen]) == list(range(53)) for fitted, unseen in made)
    assert [len(unseen) for _, unseen in folds(samples, "blocked", "day", {})] == [18, 18, 17]
    assert all(np.ptp(unseen) == len(unseen) - 1 for _, unseen in folds(samples, "blocked", "order", {}))
    order = np.random.default_rng(0).permutation(53)
    ((_, part),) = folds(samples, "stated", "order", {"part": 0.3, "seed": 0})
    np.testing.assert_array_equal(part, np.sort(order[37:]))
    ((some, rest),) = folds(samples, "stated", "order", {"part": 0.3, "seed": 0, "rows": 20})
    np.testing.assert_array_equal(some, np.sort(order[:14]))
    np.testing.assert_array_equal(rest, np.sort(order[14:20]))
    ((_, third),) = folds(samples, "stated", "order", {"column": "day", "value": "b"})
    np.testing.assert_array_equal(third, np.arange(1, 53, 3))
    assert folds(samples, "stated", "order", {}) == []
    with pytest.raises(UnknownNameError, match="night"):
        folds(samples, "blocked", "night", {})
    with pytest.raises(UnknownNameError, match=r"no value of 'day' in x named 'd'.*Known: a, b, c"):
        folds(samples, "stated", "order", {"column": "day", "value": "d"})
    with pytest.raises(CasacalError, match=r"The column 'day' of x has one value\. Name one with several"):
        folds(samples.take(np.arange(0, 53, 3)), "blocked", "day", {})


def test_a_description_that_is_no_text_is_refused(place):
    path = place / "sets" / "mine" / "set.toml"
    path.write_bytes(b'title = "\xff"')
    with pytest.raises(CasacalError, match=r"is no TOML"):
        read_set(path.parent)


def test_intervals_are_of_folds():
    squares, rows = np.array([4.0, 9.0, 1.0, 16.0]), np.array([4.0, 2.0, 4.0, 6.0])
    found = root_mean_square(squares, rows)
    value, low, high = found.value, found.low, found.high
    assert value == pytest.approx(np.sqrt(30 / 16)), "every row counts once, however many a fold has"
    assert 0.5 < low < value < high < 2.0
    assert np.isnan(root_mean_square(squares[:1], rows[:1]).low)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('title = "A simulated UR5"', "", "does not say its title"),
        ('metric = "distance"', 'metric = "feeling"', "is 'feeling'"),
        ('blocks = "regions"', 'blocks = "night"', "night"),
        ("figure = 1.7", "", "lacks a part"),
        ("[stated]", "[stated", "is no TOML"),
        ("there/rows.csv", "elsewhere.csv", "are not at"),
        ("part = 0.25", "part = 25", "is part = 25, seed = 3"),
        ("part = 0.25", "parts = 0.25", "is parts = 0.25, seed = 3"),
        ("part = 0.25", "part = 0.25\nfolds = 4", "is part = 0.25, folds = 4"),
        ("seed = 3", 'seed = "three"', "is part = 0.25, seed = 'three'"),
        ("part = 0.25", "folds = 1", "is folds = 1"),
        ("part = 0.25", "folds = 61", "has 60 rows, and its split needs 61"),
        ("seed = 3", "rows = 500", "has 60 rows, and its split needs 500"),
        ("part = 0.25\nseed = 3", 'column = "day"', "is column = 'day'. Use"),
        ("part = 0.25\nseed = 3", 'column = "night"\nvalue = "x"', "no column named 'night'"),
        ("[stated]\npart = 0.25\nseed = 3", "stated = 0.25", "is 0.25"),
        ('sha256 = "', 'sha256 = "0', "is not the file"),
    ],
)
def test_what_is_wrong_with_a_set_is_said(place, capsys, old, new, said):
    path = place / "sets" / "mine" / "set.toml"
    path.write_text(path.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")
    assert ran(place, "--method", "as drawn") == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (place / "out" / "report.md").exists()


def test_what_is_wrong_with_a_command_is_said(place, capsys, monkeypatch):
    monkeypatch.delenv("CASACAL_DATA", raising=False)
    bad = place / "bad.py"
    for words, text, said in (
        (["bench", str(place / "sets")], "", "Name theirs with --data, or in CASACAL_DATA"),
        (["bench", str(place), "--data", str(place)], "", "There is no set of the benchmark"),
        (["bench", str(place / "sets"), "--data", str(place / "data"), "--only", "yours"], "", "Known: mine"),
        (["bench", str(place / "sets"), "--data", str(place / "data")], "", "--methods FILE"),
        (["bench", str(place / "sets"), "--data", str(place / "data"), "--methods", str(bad)], "x = 1", "no `methods`"),
        (["bench", str(place / "sets"), "--data", str(place / "data"), "--methods", str(bad)], "1/0", "ZeroDivision"),
        (
            ["bench", str(place / "sets"), "--data", str(place / "data"), "--methods", METHODS, "--method", "magic"],
            "",
            "named 'magic'",
        ),
    ):
        bad.write_text(text, encoding="utf-8")
        assert main([*words, "--out", str(place / "nothing")]) == 2
        assert said in capsys.readouterr().err
    assert not (place / "nothing").exists()


def test_sets_of_the_project_are_described_whole():
    """Each can be read, its problem traced; its measurements are not part of the project."""
    sets = read_sets(ROOT / "studies" / "bench")
    assert len(sets) >= 7
    for each in sets:
        assert each.problem.models[0].components >= 1
        assert len(each.sha256) == 64
        assert not list((ROOT / "studies" / "bench" / each.name).glob("*.csv"))
    with pytest.raises(CasacalError, match="are not at"):
        benchmark(sets, ROOT, read_ways([METHODS]))


def test_the_committed_report_is_what_its_records_make(tmp_path):
    folder = ROOT / "studies" / "bench"
    (tmp_path / "records.jsonl").write_bytes(gzip.decompress((folder / "records.jsonl.gz").read_bytes()))
    records = read_records(tmp_path / "records.jsonl")
    names = {key: dict.fromkeys(record[key] for record in records) for key in ("setting", "method")}
    study = SimpleNamespace(settings=names["setting"], methods=names["method"])
    lines = bench_lines(Run(study, tuple(records), tmp_path), read_sets(folder))
    page, made, _ = (folder / "report.md").read_text(encoding="utf-8").partition("\n## How this was made\n")
    assert made
    assert "\n".join(lines) + "\n" == page
    for page, count in (("README.md", 27), ("docs/studies.md", 41)):
        table = (ROOT / page).read_text(encoding="utf-8").split("| set | as drawn |")[1].split("\n\n")[0]
        figures = re.findall(r"\d+\.\d{3}", table)
        assert len(figures) >= count
        assert set(figures) <= set(re.findall(r"\d+\.\d{3}", "\n".join(lines))), f"{page} shows the report's figures"
