"""Earlier name of `casacal.effects`; it goes with the next version."""

import warnings
from importlib import import_module
from typing import Any


def __getattr__(name: str) -> Any:
    if name.startswith("__"):
        raise AttributeError(name)
    warnings.warn(
        f"casacal.discrepancy is now casacal.effects: take '{name}' from there", DeprecationWarning, stacklevel=2
    )
    return getattr(import_module("casacal.effects"), name)
