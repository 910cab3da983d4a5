"""The version, and public names: read from the stub beside a package, and imported when first used.

A package's `__init__.pyi` serves type checkers and, when it runs, these functions. So `casacal --help` does not wait
for CasADi, and a chapter's public names cost nothing to whoever takes one of its modules.

One thread imports at a time: Python gives up where two enter one package by different doors, SciPy's included. The lock
cannot hang, as no module of casacal asks for a public name while it is imported.
"""

import re
import sys
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from threading import RLock
from typing import Any

__version__ = "0.1.0"
_IMPORTING = RLock()


def homes(package: str) -> dict[str, str]:
    """Public names of a package, each with the module that defines it; its chapters with an empty one."""
    stub = Path(str(sys.modules[package].__file__)).with_suffix(".pyi").read_text(encoding="utf-8")
    found = re.findall(r"^from (\S+) import \w+ as (\w+)$", stub, re.MULTILINE)
    return {name: "" if module == package else module for module, name in found}


def on_demand(package: str, home: dict[str, str]) -> Callable[[str], Any]:
    """`__getattr__` of a package: the public name or the chapter asked for, or AttributeError."""

    def found(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        with _IMPORTING:
            return getattr(import_module(home[name]), name) if home[name] else import_module(f"{package}.{name}")

    return found


def moved(earlier: str, home: str) -> Callable[[str], Any]:
    """`__getattr__` of an earlier module: the name from its new home, with a DeprecationWarning; for one version."""

    def found(name: str) -> Any:
        if name == "__all__":  # what `from earlier import *` takes
            return [each for each in vars(import_module(home)) if not each.startswith("_")]
        if name.startswith("__"):
            raise AttributeError(name)
        message = f"{earlier} is now {home}: take '{name}' from there"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return getattr(import_module(home), name)

    return found
