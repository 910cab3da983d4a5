"""Documents tell the truth: what README and docs show is run, links lead somewhere, pages list what there is."""

import ast
import json
import re
import shlex
import subprocess
from importlib import import_module

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from commands_page import page as commands_page
from conftest import ROOT
from planned_arms import ARMS
from shown_outputs import SHOWN, given_files, missing, outputs, same_line
from test_architecture import EARLIER, ORDER

import casacal
from casacal.cli.main import COMMANDS, main
from casacal.fit.methods import METHODS

INTERVAL = r"\d[\d.]* ?%? \(\d[\d.]* to \d[\d.]*\)"
DOCUMENTS = [
    *sorted(ROOT.glob("*.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "problems").glob("*/*.md")),
    *sorted((ROOT / "studies").glob("*/*.md")),
]
SIMULATED = sorted(path.parent for path in (ROOT / "problems").glob("*/samples.csv"))
README = (ROOT / "README.md").read_text(encoding="utf-8")


PAGES = {
    path.stem: path.read_text(encoding="utf-8") for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
}


def blocks(text, language):
    return re.findall(rf"```{language}\n(.*?)```", text, re.S)


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    for name in ("problems", "studies"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "out").mkdir()
    for text in PAGES.values():
        for name, rows in given_files(text):
            (tmp_path / name).write_text(rows)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.long
@pytest.mark.parametrize("page", [name for name, text in PAGES.items() if blocks(text, "sh") and name != "README"])
def test_the_commands_of_a_page_run_in_order_and_say_what_stands_under_them(page, workplace, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    said = outputs(PAGES[page])
    for block, output in zip(SHOWN.finditer(PAGES[page]), said, strict=True):
        assert block["text"], f"python tests/shown_outputs.py writes what {block['commands']} says"
        assert missing(block["text"], output) is None
    if page == "first_calibration":
        assert (workplace / "out" / "first" / "residuals.png").is_file()
    if page == "your_robot":
        assert (workplace / "out" / "ur5.script").read_text().count("movej(") == 2
    if page == "ten_minutes":  # plates 40 mm and 3 degrees off: nothing below the table, planned or touched; verified
        arm = next(arm for arm in ARMS if arm.name == "UR10e")
        assert any("Promise kept" in each for each in said)
        assert not any("cannot be made by the true arm" in each for each in said)
        for name in ("plan", "touched", "touched_check"):
            rows = pd.read_csv(workplace / "out" / f"ur10e_{name}.csv", comment="#")
            joints = rows[[f"q{k}_deg" for k in range(1, 7)]].to_numpy(float)
            assert min(arm.origins(q)[:, 2].min() for q in joints) > -1e-3
            off = [arm.origins(q)[-1, 2] - 20 for q in joints[(rows["plane"] == "floor").to_numpy()]]
            assert (np.median(off) > 30) == (name != "plan"), "the floor that was touched is 40 mm higher"


def test_an_output_on_a_page_differs_in_last_digits_alone():
    assert same_line("expected tip error 0.76 -> 0.35 mm", "expected tip error 0.79 -> 0.34 mm")
    assert not same_line("expected tip error 0.76 -> 0.35 mm", "expected tip error 0.76 -> 0.45 mm")
    assert not same_line("Calibrated: expect 0.76 mm", "Use with care: expect 0.76 mm")
    assert missing("one\n...\nthree", "one\ntwo\nthree\n") is None
    assert missing("three\none", "one\ntwo\nthree\n") == "one"


def test_the_front_page_is_one_that_is_read():
    assert len(README.splitlines()) <= 200
    assert [line for block in blocks(README, "sh") for line in block.splitlines()] == [
        "pip install -e . && casacal calibrate problems/hsr_jr680",
        'pip install -e ".[test]" && pytest',
    ]
    assert all(f"| `casacal {name}` |" in README for name in COMMANDS)


def test_the_front_page_shows_what_comes_out(workplace, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    assert main(["calibrate", "problems/hsr_jr680"]) == 0
    assert capsys.readouterr().out.rstrip() == blocks(README, "text")[0].rstrip()


@pytest.mark.long
def test_the_demonstration_goes_the_whole_way(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["demo", "--seed", "3"]) == 0
    said = capsys.readouterr().out
    shown = re.findall(r"^\$ casacal (\w+)", said, re.M)
    assert shown == ["new", "plan", "simulate", "check", "calibrate", "verify", "compensate"]
    for name in ("plan.csv", "ur5/samples.csv", "fit/report.html", "ur5/samples_check.csv", "ur5.script"):
        assert (tmp_path / "casacal_demo" / name).stat().st_size > 0
    assert "Calibrated: expect a tip error of" in said
    assert main(["demo"]) == 2
    assert "exists already" in capsys.readouterr().err


def test_the_demonstration_ends_where_a_step_fails(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("casacal.cli.plan.run", lambda options: 1)
    assert main(["demo", "--out=-a b"]) == 1
    assert re.findall(r"^\$ casacal (\w+)", capsys.readouterr().out, re.M) == ["new", "plan"]
    assert (tmp_path / "-a b" / "ur5" / "problem.py").is_file()


def test_every_command_and_option_is_on_a_page():
    assert PAGES["commands"] == commands_page(), "python tests/commands_page.py > docs/commands.md writes it again"


@pytest.mark.long
@pytest.mark.parametrize("page", [name for name, text in PAGES.items() if blocks(text, "python")])
def test_the_python_of_a_page_runs(page, workplace, capsys):
    plt.switch_backend("agg")
    for block in blocks(PAGES[page], "python"):
        exec(compile(block, page, "exec"), {})
    plt.close("all")
    if page == "python":
        assert float(capsys.readouterr().out.split()[0]) < 0.02


def test_the_methods_are_those_there_are():
    table = PAGES["first_calibration"].split("| `--method` |")[1].split("\n\n")[0]
    assert set(re.findall(r"`([a-z-]+)`", table)) - {"--method"} == set(METHODS)


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_between_documents_lead_somewhere(path):
    for target in re.findall(r"\]\(([^)\s#]+)[^)]*\)", path.read_text(encoding="utf-8")):
        if not re.match(r"[a-z]+:", target):
            assert (path.parent / target).exists(), target


@pytest.mark.parametrize("path", sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_outputs_and_its_links_lead_somewhere(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    assert sum(cell["cell_type"] == "code" for cell in cells) > 3
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells)
    for target in re.findall(r"\]\(([^)\s#]+)\)", "".join("".join(cell["source"]) for cell in cells)):
        assert target.startswith("https:") or (path.parent / target).exists(), target


def test_the_site_holds_whatever_documents_link_to():
    """The hook of the site names by patterns what it holds; a link to anything else breaks its strict build."""
    tree = ast.parse((ROOT / "docs" / "mirror.py").read_text(encoding="utf-8"))
    lists = [node.value for node in tree.body if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple)]
    assert len(lists) == 2
    held = {path for each in lists for pattern in ast.literal_eval(each) for path in ROOT.glob(pattern)}
    for document in held:
        if document.suffix == ".md":
            for link in re.findall(r"\]\((\.?[\w./-]+\.\w+)(?:#[\w-]*)?\)", document.read_text(encoding="utf-8")):
                assert (document.parent / link).resolve() in held, f"{document.name}: {link}"


def test_the_page_of_public_names_is_what_is_exported():
    text = (ROOT / "docs" / "public.md").read_text(encoding="utf-8")
    front, chapters, modules = re.split("## In the chapters|## Modules", text)
    assert sorted(re.findall(r"^\| `(\w+)` \| \S", front, re.M)) == casacal.__all__
    assert len(casacal.__all__) <= 60
    listed = {}
    for section in chapters.split("\n### ")[1:]:
        listed[section.split("`")[1]] = re.findall(r"^\| `(\w+)` \| \S", section, re.M)
    for chapter, names in listed.items():
        assert sorted(names) == sorted(import_module(chapter).__all__), chapter
        assert not set(names) & set(casacal.__all__), f"{chapter}: a name has one public place"
    assert {f"casacal.{path.parent.name}" for path in (ROOT / "casacal").glob("*/__init__.pyi")} < set(listed)
    for module, row in re.findall(r"^\| `(casacal\.[\w.]+)` \| (.*) \|$", modules, re.M):
        for name in re.findall(r"`(\w+)`", row.split(":")[0]):
            assert hasattr(import_module(module), name), f"{module}.{name}"


def test_the_top_of_the_project_holds_what_belongs_there():
    """A run that wrote into the folder of the project was once kept with it."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("no checkout of git")
    folders = {name.partition("/")[0] for name in listed.stdout.splitlines() if "/" in name}
    assert folders == {".ci", ".github", "casacal", "docs", "problems", "studies", "tests"}


def test_the_architecture_page_lists_the_packages_in_their_order():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    table = text.split("| `casacal/` | what |")[1].split("\n\n")[0]
    listed = [name for row in table.splitlines()[2:] for name in re.findall(r"`(\w+)/?`", row.split("|")[1])]
    assert listed == sorted(listed, key=ORDER.index)
    assert set(listed) == set(ORDER) - {"__main__"} - EARLIER
    lines = text.split("## Where the method's lines are")[1]
    for name in re.findall(r"`([\w/]+\.py)`", text.replace(lines, "").split("## The way")[1] + lines):
        assert list((ROOT / "casacal").rglob(name)), name


def method_page():
    """Rows of the table (equation, what, where, errata), and every dotted place that the page names."""
    text = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| (")]
    return rows, sorted(set(re.findall(r"`((?:\w+\.)+\w+)[^`]*`", text)) - {"module.name"})


def exists(place):
    """Whether a dotted name is a module of casacal, or an attribute in one; `bound` and `problem` are values."""
    for value, home in (("bound.symbolic", "fit.symbolic.SymbolicProblem"),
                        ("bound", "fit.bound_problem.BoundProblem"),
                        ("model.symbols", "model.trace.Symbols")):  # fmt: skip
        if re.match(rf"{value}(\.[a-z]|$)", place):
            place = place.replace(value, home, 1)
            break
    parts = place.split(".")
    for k in range(len(parts), 0, -1):
        try:
            found = import_module(".".join(["casacal", *parts[:k]]))
        except ModuleNotFoundError:
            continue
        for name in parts[k:]:
            if not hasattr(found, name):
                return False
            found = getattr(found, name)
        return True
    return False


def test_every_equation_has_a_place_that_exists():
    rows, places = method_page()
    assert [row[0] for row in rows] == [f"({i})" for i in range(1, 32)]
    assert len(places) > 30
    for place in places:
        assert exists(place), place
    for equation, _, where, _ in rows:
        assert re.search(r"`(\w+\.)+\w+`", where) or "the same step" in where or "no step" in where, equation


def test_every_erratum_stands_at_its_equation():
    rows, _ = method_page()
    text = (ROOT / "docs" / "errata.md").read_text(encoding="utf-8")
    for erratum, where in re.findall(r"^\| (E\d+) \| (.*?) \|", text, re.M):
        told = [int(row[0][1:-1]) for row in rows if erratum in re.findall(r"E\d+", row[3])]
        spans = re.findall(r"\((\d+)\)(?:-\((\d+)\))?", where)
        expected = {k for first, last in spans for k in range(int(first), int(last or first) + 1)}
        assert set(told) == expected or (erratum in ("E1", "E3") and told == [1]), erratum


def test_the_page_of_the_method_can_fail():
    assert exists("model.kinematics.dh")
    assert not exists("model.kinematics.no_such_link")
    assert not exists("no_such_module.dh")


def test_every_erratum_that_is_cited_stands_in_the_errata():
    text = (ROOT / "docs" / "errata.md").read_text(encoding="utf-8")
    explained = set(re.findall(r"^\| (E\d+) \|", text, re.M))
    assert explained == {f"E{i}" for i in range(1, 23)}
    for folder in ("casacal", "studies", "tests", "problems"):
        for path in (ROOT / folder).rglob("*.py"):
            cited = set(re.findall(r"\bE\d{1,2}\b", path.read_text(encoding="utf-8")))
            assert cited <= explained, path
    for name in re.findall(r"`((?:casacal|tests|problems)/[\w/.]+)`", text):
        assert (ROOT / name).exists(), name


def test_the_citation_names_the_version():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"^version: (.*)$", citation, re.M)[1] == casacal.__version__
    assert "arXiv:2208.02652" in citation


@pytest.mark.parametrize(("page", "count"), [("README", 6), ("studies", 10)])
def test_the_headline_is_that_of_the_committed_report(page, count):
    report = (ROOT / "studies" / "paper" / "report.md").read_text(encoding="utf-8")
    rows = [line for line in PAGES[page].splitlines() if re.match(r"\| (before|M\d|IPOPT)", line)]
    assert len(rows) == count
    for row in rows:
        assert row in report
    for figure in re.findall(r"\d[\d.]* %? ?\(\d[\d.]* to \d[\d.]*\)", PAGES[page]):
        value, low, high = map(float, re.findall(r"\d+\.?\d*", figure))
        found = [tuple(map(float, re.findall(r"\d+\.?\d*", f))) for f in re.findall(INTERVAL, report)]
        digits = max(len(text.partition(".")[2]) for text in re.findall(r"\d+\.?\d*", figure))
        assert (value, low, high) in {tuple(round(part, digits) for part in triple) for triple in found}, figure


@pytest.mark.parametrize("folder", SIMULATED, ids=lambda folder: folder.name)
def test_the_generating_command_makes_the_committed_samples(folder, workplace, capsys):
    command = re.search(r"casacal (simulate problems/\w+ .*)", (folder / "README.md").read_text(encoding="utf-8"))[1]
    assert f"problems/{folder.name} " in command
    assert main(shlex.split(command)) == 0
    made = (workplace / "out" / "samples.csv").read_text().splitlines()
    kept = (folder / "samples.csv").read_text().splitlines()
    assert len(made) == len(kept)
    assert made[1] == kept[1]
    same = 0
    for one, two in zip(made[2:], kept[2:], strict=True):
        *numbers, label = one.split(",")
        *others, expected = two.split(",")
        assert label == expected
        same += [float(x) for x in numbers] == pytest.approx([float(x) for x in others], abs=5e-6)
    # Another processor's linear algebra rounds otherwise. Where nothing holds a joint that turns the tool about its
    # plunger, the way to a touch may then end elsewhere: in up to 8 of 120 rows of the UR5. Another seed leaves none.
    assert same >= 0.85 * len(made[2:])
