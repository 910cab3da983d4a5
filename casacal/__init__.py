"""casacal: calibrate a robot arm with a dial indicator and a flat face.

Public names are imported when first used, so that `casacal --help` does not wait for CasADi.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from casacal.bound_problem import BoundProblem, bind
    from casacal.calibrating import calibrate
    from casacal.calibration import Calibration
    from casacal.cells import Cell, Face, corner, gauge_block, plate
    from casacal.compensation import compensate
    from casacal.convention_doctor import PendantRows, diagnose, read_pendant_rows
    from casacal.conventions import Conventions
    from casacal.doctor import Finding, check
    from casacal.errors import CasacalError
    from casacal.estimators import (
        annealing,
        ekf,
        evolution,
        ipopt,
        lm,
        nominal,
        null_step,
        plane_only,
        scipy_least_squares,
        sckf,
        sckf_lm,
        swarm,
    )
    from casacal.files import ProblemFile, load_problem
    from casacal.instruments import DialOnBody, DialOnPlane, Instrument, Step, TrackedPoint, tool_point
    from casacal.joints import Joint
    from casacal.kinematics import chain, deg, dh, modified_dh
    from casacal.prediction import read_result
    from casacal.problem import Problem
    from casacal.result import Result, Status
    from casacal.robot import Robot
    from casacal.samples import Samples
    from casacal.simulated_trials import Simulated
    from casacal.simulation import Simulation, simulate
    from casacal.study import Method, Run, Study
    from casacal.targets import Targets, read_targets
    from casacal.unknowns import Direction, Frame, Parameter, Plane

__version__ = "0.1.0"

_HOMES = {
    "casacal.bound_problem": ("BoundProblem", "bind"),
    "casacal.calibrating": ("calibrate",),
    "casacal.calibration": ("Calibration",),
    "casacal.cells": ("Cell", "Face", "corner", "gauge_block", "plate"),
    "casacal.compensation": ("compensate",),
    "casacal.convention_doctor": ("PendantRows", "diagnose", "read_pendant_rows"),
    "casacal.conventions": ("Conventions",),
    "casacal.doctor": ("Finding", "check"),
    "casacal.errors": ("CasacalError",),
    "casacal.estimators": (
        "annealing",
        "ekf",
        "evolution",
        "ipopt",
        "lm",
        "nominal",
        "null_step",
        "plane_only",
        "sckf",
        "sckf_lm",
        "scipy_least_squares",
        "swarm",
    ),
    "casacal.files": ("ProblemFile", "load_problem"),
    "casacal.instruments": ("DialOnBody", "DialOnPlane", "Instrument", "Step", "TrackedPoint", "tool_point"),
    "casacal.kinematics": ("chain", "deg", "dh", "modified_dh"),
    "casacal.prediction": ("read_result",),
    "casacal.problem": ("Problem",),
    "casacal.result": ("Result", "Status"),
    "casacal.joints": ("Joint",),
    "casacal.robot": ("Robot",),
    "casacal.samples": ("Samples",),
    "casacal.simulated_trials": ("Simulated",),
    "casacal.simulation": ("Simulation", "simulate"),
    "casacal.study": ("Method", "Run", "Study"),
    "casacal.targets": ("Targets", "read_targets"),
    "casacal.unknowns": ("Direction", "Frame", "Parameter", "Plane"),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'casacal' has no attribute '{name}'")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
