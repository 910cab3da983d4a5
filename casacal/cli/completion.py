"""`casacal completion`: a script that completes commands, options and file names in a shell."""

from __future__ import annotations

import argparse

from casacal.cli.common import DONE, add
from casacal.cli.terminal import say
from casacal.errors import CasacalError

HELP = "print a shell completion script"
PLACES = ("FILE", "DIR", "PROBLEM", "SAMPLES", "RESULT", "JOINTS", "TARGETS", "POSES", "STUDY")
"""Arguments that name files or folders."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal completion`."""
    parser.description = "Print a completion script, made from the commands of this version."
    add(parser, "SHELL", "the shell that the script is for", choices=("bash", "zsh"))
    parser.epilog = (
        'bash: put eval "$(casacal completion bash)" into ~/.bashrc. zsh: put eval "$(casacal completion zsh)" after '
        "compinit into ~/.zshrc, or save the output as _casacal in a folder of $fpath."
    )


def run(options: argparse.Namespace) -> int:
    """Print the script for a shell; returns 0. Raises CasacalError where shtab, which writes it, is absent."""
    try:
        import shtab
    except ImportError:
        fix = "Install it with pip install shtab"
        raise CasacalError("Completion scripts are written by shtab, which is not installed", fix) from None
    parser = options.whole()
    for action in (action for command in parser.commands.values() for action in command._actions):
        if action.metavar in PLACES:
            action.complete = shtab.FILE
    say(shtab.complete(parser, options.shell).rstrip())
    return DONE
