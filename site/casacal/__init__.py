"""casacal: calibrate a robot arm with a dial indicator and a flat face.

Public names stand in `__init__.pyi`, for type checkers and for this module. Each is imported when first used, so that
`casacal --help` does not wait for CasADi.

One thread imports at a time: Python gives up where two enter one package by different doors, SciPy's included. The lock
cannot hang, as no module of casacal asks for a public name while it is imported.
"""

import re
from importlib import import_module
from pathlib import Path
from threading import RLock
from typing import Any

_STUB = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
_HOME = {name: module for module, name in re.findall(r"^from (\S+) import \w+ as (\w+)$", _STUB, re.MULTILINE)}
_IMPORTING = RLock()
__all__ = sorted(_HOME.keys() - {"__version__"})


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'casacal' has no attribute '{name}'")
    with _IMPORTING:
        return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(_HOME)
