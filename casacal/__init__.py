"""casacal: calibrate a robot arm with a dial indicator and a flat face.

Public names are imported when first used, so that `casacal --help` does not wait for CasADi.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from casacal.version import __version__ as __version__

if TYPE_CHECKING:
    from casacal.binding.bound_problem import BoundProblem, bind
    from casacal.calibration.calibrate import calibrate
    from casacal.calibration.calibration import Calibration
    from casacal.checks import Finding, check
    from casacal.compensation.compensate import compensate
    from casacal.compensation.predict import read_result
    from casacal.compensation.targets import Targets, read_targets
    from casacal.doctor import PendantRows, diagnose, read_pendant_rows
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
    from casacal.instruments import DialOnBody, DialOnPlane, Instrument, Step, TrackedPoint, tool_point
    from casacal.kinematics import chain, deg, dh, modified_dh
    from casacal.least_squares.result import Result, Status
    from casacal.problem.cell import Cell, Face, corner, gauge_block, plate
    from casacal.problem.problem import Problem
    from casacal.problem.problem_file import ProblemFile, load_problem
    from casacal.robots.conventions import Conventions
    from casacal.robots.joints import Joint
    from casacal.robots.robot import Robot
    from casacal.samples.samples import Samples
    from casacal.simulation.simulate import Simulation, simulate
    from casacal.study import Method, Run, Simulated, Study
    from casacal.unknowns import Direction, Frame, Parameter, Plane

_HOMES = {
    "casacal.binding.bound_problem": ("BoundProblem", "bind"),
    "casacal.calibration.calibrate": ("calibrate",),
    "casacal.calibration.calibration": ("Calibration",),
    "casacal.problem.cell": ("Cell", "Face", "corner", "gauge_block", "plate"),
    "casacal.compensation.compensate": ("compensate",),
    "casacal.doctor": ("PendantRows", "diagnose", "read_pendant_rows"),
    "casacal.robots.conventions": ("Conventions",),
    "casacal.checks": ("Finding", "check"),
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
    "casacal.problem.problem_file": ("ProblemFile", "load_problem"),
    "casacal.instruments": ("DialOnBody", "DialOnPlane", "Instrument", "Step", "TrackedPoint", "tool_point"),
    "casacal.kinematics": ("chain", "deg", "dh", "modified_dh"),
    "casacal.compensation.predict": ("read_result",),
    "casacal.problem.problem": ("Problem",),
    "casacal.least_squares.result": ("Result", "Status"),
    "casacal.robots.joints": ("Joint",),
    "casacal.robots.robot": ("Robot",),
    "casacal.samples.samples": ("Samples",),
    "casacal.simulation.simulate": ("Simulation", "simulate"),
    "casacal.study": ("Method", "Run", "Simulated", "Study"),
    "casacal.compensation.targets": ("Targets", "read_targets"),
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
