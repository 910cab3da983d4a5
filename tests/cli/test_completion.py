"""Completion scripts, asked by the shells they are for."""

import shutil
import subprocess
import sys

import pytest
from conftest import ROOT

from casacal.cli.main import COMMANDS, build_parser, main
from casacal.fit.methods import METHODS

BASH, ZSH = shutil.which("bash"), shutil.which("zsh")


def script(shell, capsys):
    assert main(["completion", shell]) == 0
    return capsys.readouterr().out


@pytest.fixture
def bash(tmp_path, capsys):
    if BASH is None:
        pytest.skip("there is no bash")
    (tmp_path / "casacal.bash").write_text(script("bash", capsys))
    (tmp_path / "arm one").mkdir()
    (tmp_path / "samples.csv").touch()

    def complete(*words):
        """What bash offers for the last word."""
        asked = (
            'source casacal.bash; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); '
            "$(complete -p casacal | sed 's/.*-F \\([^ ]*\\) casacal/\\1/'); printf '%s\\n' \"${COMPREPLY[@]}\""
        )
        done = subprocess.run(
            [BASH, "--norc", "-c", asked, "bash", *words], cwd=tmp_path, capture_output=True, text=True, check=True
        )
        assert done.stderr == ""
        return set(done.stdout.splitlines()) - {""}

    return complete


def test_bash_offers_commands(bash):
    assert bash("casacal", "") == set(COMMANDS)
    assert bash("casacal", "c") == {"calibrate", "changed", "check", "compensate", "completion"}
    assert bash("casacal", "--") == {"--help", "--version"}


@pytest.mark.parametrize("command", COMMANDS)
def test_bash_offers_every_option_of_every_command(bash, command):
    parser = build_parser()._subparsers._group_actions[0].choices[command]
    expected = {name for action in parser._actions for name in action.option_strings}
    assert bash("casacal", command, "-") == expected
    assert "--help" in expected


def test_bash_offers_choices_files_and_nothing(bash):
    assert bash("casacal", "calibrate", "x", "--method", "") == set(METHODS)
    assert bash("casacal", "calibrate", "--method", "sckf-") == {"sckf-lm"}
    assert bash("casacal", "predict", "r.json", "q.csv", "--frame", "t") == {"tip"}
    assert bash("casacal", "completion", "") == {"bash", "zsh"}
    files = {"arm one", "casacal.bash", "samples.csv"}
    assert bash("casacal", "calibrate", "") == files
    assert bash("casacal", "calibrate", "arm one", "s") == {"samples.csv"}
    assert bash("casacal", "calibrate", "arm one", "--out", "ar") == {"arm one"}
    assert bash("casacal", "calibrate", "arm one", "--seed", "") == set()
    assert bash("casacal", "calibrate", "arm one", "--no-reference", "sa") == {"samples.csv"}


ASK_ZSH = r"""
zmodload zsh/zpty
zpty asked 'PS1= RPS1= TERM=dumb zsh -f -i'
zpty -w asked 'unset zle_bracketed_paste; autoload -Uz compinit; compinit -u -D; setopt nolistbeep'
zpty -w asked "zstyle ':completion:*' list-prompt ''; zstyle ':completion:*' select-prompt ''; LISTMAX=0"
zpty -w asked 'eval "$(cat ./_casacal)"; print -r REA""DY'
zpty -r -m asked out '*READY*'
zpty -w -n asked "$1"$'\t\t'
sleep 0.7
out=
while zpty -r -t asked part; do out+=$part; done
print -r -- $out
zpty -d asked
"""


@pytest.mark.skipif(ZSH is None or sys.platform == "win32", reason="there is no zsh")
def test_zsh_offers_commands_options_choices_and_files(tmp_path, capsys):
    (tmp_path / "_casacal").write_text(script("zsh", capsys))
    (tmp_path / "samples.csv").touch()

    def complete(line):
        done = subprocess.run([ZSH, "-f", "-c", ASK_ZSH, "zsh", line], cwd=tmp_path, capture_output=True, text=True,
                              timeout=60, check=True)  # fmt: skip
        return done.stdout

    listed = complete("casacal ")
    for name in COMMANDS:
        assert name in listed
    assert "Judge a calibration by rows" in listed
    assert "calibrate" in complete("casacal cali")
    listed = complete("casacal calibrate --")
    for option in ("--method", "--holdout", "--no-reference", "--json"):
        assert option in listed
    assert "default: sckf-lm" in listed
    listed = complete("casacal calibrate --method ")
    for name in METHODS:
        assert name in listed
    assert "samples.csv" in complete("casacal calibrate arm sam")
    assert "samples.csv" in complete("casacal predict --out sam")


def test_the_scripts_are_valid_and_only_that(tmp_path, capsys):
    for shell, found in (("bash", BASH), ("zsh", ZSH)):
        text = script(shell, capsys)
        assert str(ROOT) not in text
        if found is not None:
            (tmp_path / shell).write_text(text)
            done = subprocess.run([found, "-n", str(tmp_path / shell)], capture_output=True, text=True, check=False)
            assert (done.returncode, done.stderr) == (0, "")


def test_commands_are_in_the_scripts_by_themselves(capsys):
    for shell in ("bash", "zsh"):
        text = script(shell, capsys)
        for name in COMMANDS:
            assert name in text
    assert main(["completion", "fish"]) == 2
