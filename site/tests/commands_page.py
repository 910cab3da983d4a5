"""docs/commands.md as the parsers say it: `python tests/commands_page.py > docs/commands.md` writes it again."""

import argparse
import sys

from casacal.cli.main import COMMANDS, EPILOG, build_parser


def page() -> str:
    """The page: a section for each command, a row for each argument and option."""
    commands = build_parser().commands
    lines = ["# Commands and options", "", EPILOG, "", "`casacal COMMAND --help` says the same in a terminal."]
    for name in COMMANDS:
        parser = commands[name]
        lines += ["", f"## `casacal {name}`", "", " ".join((parser.description or "").split())]
        lines += ["", "| argument | what |", "|---|---|"]
        lines += [_row(action) for action in parser._actions if action.dest != "help"]
    return "\n".join(lines) + "\n"


def _row(action: argparse.Action) -> str:
    meta = action.metavar or ("" if action.nargs == 0 else (action.dest or "").upper())
    meta = " ".join(meta) if isinstance(meta, tuple) else str(meta)
    if action.choices and not action.metavar:
        meta = ", ".join(map(str, action.choices))
    names = [f"`{option}{' ' + meta if meta else ''}`" for option in action.option_strings] or [f"`{meta}`"]
    told = " ".join(((action.help or "") % {"default": action.default, "prog": "casacal"}).split())
    cells = (", ".join(names), told)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


if __name__ == "__main__":
    sys.stdout.write(page())
