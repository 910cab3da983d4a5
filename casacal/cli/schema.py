"""`casacal schema`: the JSON schema of result.json, for programs that read it."""

from __future__ import annotations

import argparse

from casacal.cli.common import DONE
from casacal.cli.terminal import say

HELP = "print the JSON schema of result.json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe `casacal schema`, which takes no arguments."""
    parser.description = (
        "Print the JSON schema (draft 2020-12) of result.json, by which casacal itself checks the file. Keys that it "
        "does not name may be added by anybody."
    )


def run(_options: argparse.Namespace) -> int:
    """Print the schema; returns 0."""
    from casacal.deployment.result_file import schema_text

    say(schema_text().rstrip())
    return DONE
