"""Which files are robot programs, and in which language: what can be told without a reader of any."""

from pathlib import Path

ENDINGS = {
    ".mod": "rapid",
    ".modx": "rapid",
    ".prg": "rapid",
    ".src": "krl",
    ".script": "urscript",
    ".ls": "fanuc",
    ".jbi": "yaskawa",
}
"""Language by the ending of a program's file."""


def is_program(path: object) -> bool:
    """Whether a path has the ending of a robot program."""
    return isinstance(path, (str, Path)) and Path(path).suffix.lower() in ENDINGS
