"""Earlier name of `casacal.model.kinematics`; it goes with the next version."""

import warnings
from importlib import import_module
from typing import Any


def __getattr__(name: str) -> Any:
    if name.startswith("__"):
        raise AttributeError(name)
    warnings.warn(
        f"casacal.kinematics is now casacal.model.kinematics: take '{name}' from there",
        DeprecationWarning,
        stacklevel=2,
    )
    return getattr(import_module("casacal.model.kinematics"), name)
