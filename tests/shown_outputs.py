"""Outputs under commands of the documentation: `python tests/shown_outputs.py docs/check.md ...` writes them anew."""

import contextlib
import io
import math
import os
import re
import shlex
import sys
import tempfile
from pathlib import Path
from unittest import mock

from casacal.cli.main import main

ROOT = Path(__file__).resolve().parents[1]
SHOWN = re.compile(r"^```sh\n(?P<commands>.*?)^```\n(?P<under>\n```text\n(?P<text>.*?)^```\n)?", re.S | re.M)
MOST, CUT = 14, "..."
NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e-?\d+)?")
CLOSE = 0.1
"""By how much a number on a page may differ from what another machine finds, relative."""
TINY = 1e-5  # below which a number is rounding alone


def given_files(text):
    """Files that a page gives the reader to write, by name."""
    return re.findall(r"`(out/[\w./]+)`[^\n]*:\n\n```(?:csv|text)\n(.*?)```", text, re.S)


def outputs(text):
    """Outputs of the commands of a page, in its order, by block; run in a folder where the page may be followed."""
    found = []
    for block in SHOWN.finditer(text):
        for command in block["commands"].splitlines():
            said, errors = io.StringIO(), io.StringIO()
            with (
                mock.patch("sys.stdin", io.StringIO()),  # nobody types
                contextlib.redirect_stdout(said),
                contextlib.redirect_stderr(errors),
            ):
                code = main(shlex.split(command)[1:])
            assert code == 0, f"{command}\n{errors.getvalue()}"
        found.append(said.getvalue())
    return found


def excerpt(output):
    """What a page shows of an output: its first lines, cut where an item begins; digests are those of one machine."""
    lines = [line.rstrip() for line in output.rstrip().splitlines() if "SHA-256" not in line]
    if len(lines) <= MOST:
        return "\n".join(lines)
    end = next((k for k in range(MOST, 4, -1) if lines[k - 1] and not lines[k].startswith(" ")), MOST)
    return "\n".join([*lines[:end], CUT])


def same_line(shown, said):
    """Whether a line says the same in words, and nearly the same in numbers."""
    if NUMBER.sub("#", shown) != NUMBER.sub("#", said):
        return False
    pairs = zip(NUMBER.findall(shown), NUMBER.findall(said), strict=True)
    return all(math.isclose(float(one), float(two), rel_tol=CLOSE, abs_tol=TINY) for one, two in pairs)


def missing(shown, output):
    """The first line of an excerpt that the output does not have in its place; None where it has all of them."""
    said = iter(line.rstrip() for line in output.splitlines())
    lines = (line for line in shown.splitlines() if line != CUT)
    return next((line for line in lines if not any(same_line(line, each) for each in said)), None)


def written_anew(path):
    """A page with the outputs that its commands have today."""
    text = path.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for name in ("problems", "studies"):
            Path(name).symlink_to(ROOT / name)
        Path("out").mkdir()
        for page in (ROOT / "docs").rglob("*.md"):
            for name, rows in given_files(page.read_text(encoding="utf-8")):
                Path(name).write_text(rows)
        found = iter(outputs(text))
    return SHOWN.sub(lambda block: f"```sh\n{block['commands']}```\n\n```text\n{excerpt(next(found))}\n```\n", text)


if __name__ == "__main__":
    os.environ["COLUMNS"] = "100"
    for page in map(Path, sys.argv[1:]):
        page.write_text(written_anew(page.resolve()), encoding="utf-8")
