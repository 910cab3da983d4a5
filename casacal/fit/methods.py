"""The estimators that have a name: where each stands, what it takes, and what it promises.

This is the one list of them: the command line, `calibrate` and the verdict ask it. A method of one's own needs no place
here: `calibrate(method=function)` takes any function of a least-squares problem.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any


@dataclass(frozen=True, kw_only=True)
class NamedMethod:
    """A function `name(problem, *, ...) -> Result` of casacal.fit.

    module: of casacal.fit that defines it. minimises: whether it promises the minimum; filters and controls may
    honestly miss it, and random searches often do. no_loss: why it takes no robust loss; "" where it takes `loss`.
    random: whether it takes `seed`. quiet: whether it has nothing to report on the way, and takes no `progress`.
    parameters_only: whether it is for problems without terms, as its box would be too wide or it holds the arm.
    """

    module: str
    minimises: bool = False
    no_loss: str = ""
    random: bool = False
    quiet: bool = False
    parameters_only: bool = False


_ONE_PASS = "takes every row once, at its full weight, and minimises nothing"
_CONTROL = "is the control of plain least squares, with which others are compared"

METHODS: Mapping[str, NamedMethod] = {
    "lm": NamedMethod(module="lm", minimises=True),
    "sckf": NamedMethod(module="filters", no_loss=_ONE_PASS),
    "sckf-lm": NamedMethod(module="filters", minimises=True),
    "ekf": NamedMethod(module="filters", no_loss=_ONE_PASS),
    "annealing": NamedMethod(module="population", random=True, parameters_only=True),
    "swarm": NamedMethod(module="population", random=True, parameters_only=True),
    "evolution": NamedMethod(module="population", random=True, parameters_only=True),
    "ipopt": NamedMethod(module="ipopt", minimises=True, quiet=True),
    "plane-only": NamedMethod(module="controls", no_loss=_CONTROL, quiet=True, parameters_only=True),
}
"""Methods by the name that `--method` takes; a hyphen there is an underscore in Python."""


def method_of(name: str) -> Any:
    """The function of that name, whose module is imported now; None for a name that is not in METHODS."""
    if name not in METHODS:
        return None
    return getattr(import_module(f"casacal.fit.{METHODS[name].module}"), name.replace("-", "_"))


def minimises(name: str) -> bool:
    """Whether a method promises the minimum; of one that is not in METHODS nobody knows."""
    return name in METHODS and METHODS[name].minimises
