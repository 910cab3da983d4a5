"""`casacal completion`: a script that completes commands, options and file names in bash or zsh."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator

from casacal.cli.common import DONE
from casacal.cli.terminal import say

HELP = "print a shell completion script"
PLACES = ("FILE", "DIR", "PROBLEM", "SAMPLES", "RESULT", "JOINTS", "TARGETS", "POSES", "STUDY")
"""What the arguments are called that name files or folders."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Say what `casacal completion` takes."""
    parser.description = "Print a completion script, made from the commands of this version."
    parser.add_argument("shell", choices=("bash", "zsh"), help="the shell that the script is for")
    parser.epilog = (
        'bash: put eval "$(casacal completion bash)" into ~/.bashrc. zsh: save the output as _casacal in a folder of '
        "$fpath, or put source <(casacal completion zsh) after compinit into ~/.zshrc."
    )


def run(options: argparse.Namespace) -> int:
    """Print the script for a shell; returns 0."""
    commands = _commands(options.parser)
    say({"bash": _bash, "zsh": _zsh}[options.shell](options.parser, commands))
    return DONE


def _commands(parser: argparse.ArgumentParser) -> dict[str, tuple[str, argparse.ArgumentParser]]:
    """Help and parser of each command."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            words = {choice.dest: choice.help or "" for choice in action._choices_actions}
            return {name: (words[name], below) for name, below in action.choices.items()}
    return {}


def _options(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    return [action for action in parser._actions if action.option_strings]


def _positionals(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    found = [action for action in parser._actions if not action.option_strings]
    return [action for action in found if not isinstance(action, argparse._SubParsersAction)]


def _names(parser: argparse.ArgumentParser) -> str:
    return " ".join(name for action in _options(parser) for name in action.option_strings)


def _takes_value(action: argparse.Action) -> bool:
    return action.nargs != 0


def _bash(parser: argparse.ArgumentParser, commands: dict[str, tuple[str, argparse.ArgumentParser]]) -> str:
    """Script for bash 3.2 and newer."""
    values = "\n".join(line for name, (_, below) in commands.items() for line in _bash_values(name, below))
    options = "\n".join(
        f"        {name}) options={shlex.quote(_names(below))} words={shlex.quote(_words(below))} ;;"
        for name, (_, below) in commands.items()
    )
    return f"""\
# bash completion of casacal; made by: casacal completion bash
_casacal() {{
    local word=${{COMP_WORDS[COMP_CWORD]}} before=${{COMP_WORDS[COMP_CWORD-1]}} command= options= words= files=yes i
    if [[ $word == "=" ]]; then
        word=
    elif [[ $before == "=" ]]; then
        before=${{COMP_WORDS[COMP_CWORD-2]}}
    fi
    for ((i = 1; i < COMP_CWORD; i++)); do
        if [[ ${{COMP_WORDS[i]}} != -* ]]; then
            command=${{COMP_WORDS[i]}}
            break
        fi
    done
    COMPREPLY=()
    case $command in
        "") options={shlex.quote(_names(parser))} words={shlex.quote(" ".join(commands))} files= ;;
{options}
    esac
    case "$command $before" in
{values}
    esac
    if [[ $word == -* ]]; then
        COMPREPLY=($(compgen -W "$options" -- "$word"))
    elif [[ -n $words ]]; then
        COMPREPLY=($(compgen -W "$words" -- "$word"))
    elif [[ -n $files ]]; then
        local IFS=$'\\n'
        COMPREPLY=($(compgen -f -- "$word"))
        compopt -o filenames 2>/dev/null
    fi
}}
complete -F _casacal casacal"""


def _bash_values(name: str, parser: argparse.ArgumentParser) -> Iterator[str]:
    """Cases of an option that takes a value: its choices, file names, or nothing to offer."""
    for action in _options(parser):
        if not _takes_value(action):
            continue
        pattern = " | ".join(f'"{name} {option}"' for option in action.option_strings)
        if action.choices is not None:
            yield f"        {pattern}) options= words={shlex.quote(' '.join(map(str, action.choices)))} ;;"
        elif action.metavar in PLACES:
            yield f"        {pattern}) options= words= ;;"
        else:
            yield f"        {pattern}) return ;;"


def _words(parser: argparse.ArgumentParser) -> str:
    """Choices of the positional arguments, where they have any."""
    return " ".join(str(choice) for action in _positionals(parser) for choice in action.choices or ())


def _zsh(parser: argparse.ArgumentParser, commands: dict[str, tuple[str, argparse.ArgumentParser]]) -> str:
    """Script for zsh with its completion system."""
    listed = "\n".join(f"        {shlex.quote(f'{name}:{words}')}" for name, (words, _) in commands.items())
    cases = "\n".join(
        f"        {name}) _arguments {' '.join(_zsh_specs(below))} ;;" for name, (_, below) in commands.items()
    )
    top = " ".join(_zsh_specs(parser))
    return f"""\
#compdef casacal
# zsh completion of casacal; made by: casacal completion zsh
_casacal() {{
    local -a commands
    commands=(
{listed}
    )
    if (( CURRENT == 2 )); then
        if [[ $words[2] == -* ]]; then
            _arguments {top}
        else
            _describe -t commands command commands
        fi
        return
    fi
    local command=$words[2]
    shift words
    (( CURRENT-- ))
    case $command in
{cases}
    esac
}}
if [[ $funcstack[1] == _casacal ]]; then
    _casacal "$@"
else
    compdef _casacal casacal
fi"""


def _zsh_specs(parser: argparse.ArgumentParser) -> Iterator[str]:
    """Arguments of zsh's _arguments, quoted."""
    for action in _options(parser):
        said = "".join(f"\\{letter}" if letter in "[]:\\" else letter for letter in action.help or "")
        for name in action.option_strings:
            often = "*" if isinstance(action, argparse._AppendAction) else ""
            value = f":{action.metavar or action.dest}:{_zsh_offer(action)}" if _takes_value(action) else ""
            yield shlex.quote(f"{often}{name}[{said}]{value}")
    for action in _positionals(parser):
        optional = ":" if action.nargs == "?" else ""
        yield shlex.quote(f":{optional}{action.metavar or action.dest}:{_zsh_offer(action)}")


def _zsh_offer(action: argparse.Action) -> str:
    if action.choices is not None:
        return f"({' '.join(map(str, action.choices))})"
    return "_files" if action.metavar in PLACES else " "
