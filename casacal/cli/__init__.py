"""The command line: one file a command, with its arguments and its body."""

from casacal.cli.main import main as main
