"""What the README shows is run: its casacal commands and its Python."""

import re
import shlex

import matplotlib.pyplot as plt
import pytest
from conftest import ROOT

from casacal.cli.calibrate import METHOD_NAMES
from casacal.cli.main import main

INTERVAL = r"\d[\d.]* ?%? \(\d[\d.]* to \d[\d.]*\)"
SIMULATED = sorted(path.parent for path in (ROOT / "problems").glob("*/samples.csv"))
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, re.S)


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    for name in ("problems", "studies"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "out").mkdir()
    for name, text in re.findall(r"`(out/[\w./]+)`:\n\n```csv\n(.*?)```", README, re.S):
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_commands_run_in_order(workplace, capsys):
    commands = [line for block in blocks("sh") for line in block.splitlines() if line.startswith("casacal ")]
    assert len(commands) >= 6
    for command in commands:
        assert main(shlex.split(command)[1:]) == 0, f"{command}\n{capsys.readouterr().err}"
    assert (workplace / "out" / "first" / "residuals.png").is_file()
    assert (workplace / "out" / "ur5.script").read_text().count("movej(") == 2


def test_the_two_commands_stand_alone():
    commands = [line for block in blocks("sh") for line in block.splitlines() if line.startswith("pip install")]
    assert commands == [
        "pip install -e . && casacal calibrate problems/hsr_jr680",
        'pip install -e ".[test]" && pytest',
    ]


def test_the_python_runs(workplace, capsys):
    plt.switch_backend("agg")
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), {})
    plt.close("all")
    assert float(capsys.readouterr().out.split()[0]) < 0.02


def test_links_and_names_exist():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / target).exists(), target
    table = README.split("| `--method` |")[1].split("\n\n")[0]
    assert set(re.findall(r"`([a-z-]+)`", table)) - {"--method"} == set(METHOD_NAMES)


def test_the_headline_is_that_of_the_committed_report():
    report = (ROOT / "studies" / "paper" / "report.md").read_text(encoding="utf-8")
    rows = [line for line in README.splitlines() if re.match(r"\| (before|M\d|IPOPT)", line)]
    assert len(rows) == 10
    for row in rows:
        assert row in report
    for figure in re.findall(r"\d[\d.]* %? ?\(\d[\d.]* to \d[\d.]*\)", README):
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
    for one, two in zip(made[2:], kept[2:], strict=True):
        *numbers, label = one.split(",")
        *others, same = two.split(",")
        assert label == same
        # another machine's linear algebra may round the last digit of a joint otherwise
        assert [float(x) for x in numbers] == pytest.approx([float(x) for x in others], abs=2e-7)
