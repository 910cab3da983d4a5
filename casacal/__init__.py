"""casacal: calibrate a robot arm with a dial indicator and a flat face.

Public names are imported when first used, so that `casacal --help` does not wait for CasADi.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from casacal.version import __version__ as __version__

if TYPE_CHECKING:
    from casacal.binding.bound_problem import BoundProblem as BoundProblem
    from casacal.binding.bound_problem import bind as bind
    from casacal.binding.symbolic import SymbolicProblem as SymbolicProblem
    from casacal.calibration.calibrate import calibrate as calibrate
    from casacal.calibration.calibrated import Calibrated as Calibrated
    from casacal.calibration.calibration import Calibration as Calibration
    from casacal.calibration.saved import SavedCalibration as SavedCalibration
    from casacal.calibration.saved import load as load
    from casacal.changes.change import Change as Change
    from casacal.changes.changed import changed as changed
    from casacal.changes.update import updated as updated
    from casacal.checks import Finding as Finding
    from casacal.checks import check as check
    from casacal.compensation.arm import CalibratedArm as CalibratedArm
    from casacal.compensation.compensate import compensate as compensate
    from casacal.compensation.predict import Prediction as Prediction
    from casacal.compensation.result_file import read_result as read_result
    from casacal.compensation.targets import Compensation as Compensation
    from casacal.compensation.targets import Outcome as Outcome
    from casacal.compensation.targets import Targets as Targets
    from casacal.compensation.targets import read_targets as read_targets
    from casacal.doctor import PendantRows as PendantRows
    from casacal.doctor import diagnose as diagnose
    from casacal.doctor import read_pendant_rows as read_pendant_rows
    from casacal.errors import CasacalError as CasacalError
    from casacal.errors import ProblemError as ProblemError
    from casacal.errors import SamplesError as SamplesError
    from casacal.errors import SimulationError as SimulationError
    from casacal.errors import StudyError as StudyError
    from casacal.estimators import annealing as annealing
    from casacal.estimators import ekf as ekf
    from casacal.estimators import evolution as evolution
    from casacal.estimators import ipopt as ipopt
    from casacal.estimators import lm as lm
    from casacal.estimators import nominal as nominal
    from casacal.estimators import null_step as null_step
    from casacal.estimators import plane_only as plane_only
    from casacal.estimators import scipy_least_squares as scipy_least_squares
    from casacal.estimators import sckf as sckf
    from casacal.estimators import sckf_lm as sckf_lm
    from casacal.estimators import swarm as swarm
    from casacal.instruments import DialOnBody as DialOnBody
    from casacal.instruments import DialOnPlane as DialOnPlane
    from casacal.instruments import Distance as Distance
    from casacal.instruments import FixedPoint as FixedPoint
    from casacal.instruments import Instrument as Instrument
    from casacal.instruments import KnownPoint as KnownPoint
    from casacal.instruments import Probe as Probe
    from casacal.instruments import ResidualBlock as ResidualBlock
    from casacal.instruments import SelfContact as SelfContact
    from casacal.instruments import Sight as Sight
    from casacal.instruments import Sockets as Sockets
    from casacal.instruments import SphereTouch as SphereTouch
    from casacal.instruments import Step as Step
    from casacal.instruments import Suspect as Suspect
    from casacal.instruments import TrackedPoint as TrackedPoint
    from casacal.instruments import TrackedPose as TrackedPose
    from casacal.instruments import Words as Words
    from casacal.instruments import dial_cycle as dial_cycle
    from casacal.instruments import dial_gain as dial_gain
    from casacal.instruments import dial_zero as dial_zero
    from casacal.instruments import tool_point as tool_point
    from casacal.kinematics import chain as chain
    from casacal.kinematics import deg as deg
    from casacal.kinematics import dh as dh
    from casacal.kinematics import modified_dh as modified_dh
    from casacal.least_squares.losses import Loss as Loss
    from casacal.least_squares.losses import huber as huber
    from casacal.least_squares.losses import tukey as tukey
    from casacal.least_squares.objective import LeastSquares as LeastSquares
    from casacal.least_squares.result import Result as Result
    from casacal.least_squares.result import Status as Status
    from casacal.measuring.session import Session as Session
    from casacal.planning.plan import Plan as Plan
    from casacal.planning.plan import plan as plan
    from casacal.planning.route import Route as Route
    from casacal.planning.route import read_route as read_route
    from casacal.problem.cell import Cell as Cell
    from casacal.problem.cell import Disturbances as Disturbances
    from casacal.problem.cell import Face as Face
    from casacal.problem.cell import corner as corner
    from casacal.problem.cell import gauge_block as gauge_block
    from casacal.problem.cell import plate as plate
    from casacal.problem.problem import Problem as Problem
    from casacal.problem.problem_file import ProblemFile as ProblemFile
    from casacal.problem.problem_file import load_problem as load_problem
    from casacal.problem.symbols import Symbols as Symbols
    from casacal.robots.carriers import carried as carried
    from casacal.robots.carriers import facing as facing
    from casacal.robots.carriers import rail as rail
    from casacal.robots.carriers import turntable as turntable
    from casacal.robots.joints import Conventions as Conventions
    from casacal.robots.joints import Joint as Joint
    from casacal.robots.robot import Robot as Robot
    from casacal.samples.measurements import Measurements as Measurements
    from casacal.samples.samples import Samples as Samples
    from casacal.simulation.simulate import Simulation as Simulation
    from casacal.simulation.simulate import simulate as simulate
    from casacal.study import Method as Method
    from casacal.study import Run as Run
    from casacal.study import Simulated as Simulated
    from casacal.study import Study as Study
    from casacal.uncertainty.learned_priors import LearnedPriors as LearnedPriors
    from casacal.uncertainty.learned_priors import learned_priors as learned_priors
    from casacal.uncertainty.learned_priors import scaled_to_accuracy as scaled_to_accuracy
    from casacal.unknowns import Direction as Direction
    from casacal.unknowns import Frame as Frame
    from casacal.unknowns import Parameter as Parameter
    from casacal.unknowns import Plane as Plane
    from casacal.verification.verify import Verification as Verification
    from casacal.verification.verify import verify as verify

_HOMES = {
    "casacal.binding.bound_problem": ("BoundProblem", "bind"),
    "casacal.binding.symbolic": ("SymbolicProblem",),
    "casacal.calibration.calibrate": ("calibrate",),
    "casacal.calibration.calibration": ("Calibration",),
    "casacal.measuring.session": ("Session",),
    "casacal.changes.change": ("Change",),
    "casacal.changes.changed": ("changed",),
    "casacal.changes.update": ("updated",),
    "casacal.planning.plan": ("Plan", "plan"),
    "casacal.planning.route": ("Route", "read_route"),
    "casacal.problem.cell": ("Cell", "Disturbances", "Face", "corner", "gauge_block", "plate"),
    "casacal.compensation.compensate": ("compensate",),
    "casacal.doctor": ("PendantRows", "diagnose", "read_pendant_rows"),
    "casacal.robots.joints": ("Conventions", "Joint"),
    "casacal.checks": ("Finding", "check"),
    "casacal.errors": ("CasacalError", "ProblemError", "SamplesError", "SimulationError", "StudyError"),
    "casacal.estimators": (
        "annealing",
        "ekf",
        "evolution",
        "ipopt",
        "lm",
        "nominal",
        "null_step",
        "plane_only",
        "scipy_least_squares",
        "sckf",
        "sckf_lm",
        "swarm",
    ),
    "casacal.problem.problem_file": ("ProblemFile", "load_problem"),
    "casacal.instruments": (
        "DialOnBody",
        "DialOnPlane",
        "Distance",
        "FixedPoint",
        "Instrument",
        "KnownPoint",
        "Probe",
        "ResidualBlock",
        "SelfContact",
        "Sight",
        "Sockets",
        "SphereTouch",
        "Step",
        "Suspect",
        "TrackedPoint",
        "TrackedPose",
        "Words",
        "dial_cycle",
        "dial_gain",
        "dial_zero",
        "tool_point",
    ),
    "casacal.kinematics": ("chain", "deg", "dh", "modified_dh"),
    "casacal.calibration.saved": ("SavedCalibration", "load"),
    "casacal.compensation.arm": ("CalibratedArm",),
    "casacal.compensation.predict": ("Prediction",),
    "casacal.compensation.targets": ("Compensation", "Outcome", "Targets", "read_targets"),
    "casacal.compensation.result_file": ("read_result",),
    "casacal.calibration.calibrated": ("Calibrated",),
    "casacal.least_squares.losses": ("Loss", "huber", "tukey"),
    "casacal.least_squares.objective": ("LeastSquares",),
    "casacal.problem.problem": ("Problem",),
    "casacal.problem.symbols": ("Symbols",),
    "casacal.least_squares.result": ("Result", "Status"),
    "casacal.robots.robot": ("Robot",),
    "casacal.robots.carriers": ("carried", "facing", "rail", "turntable"),
    "casacal.uncertainty.learned_priors": ("LearnedPriors", "learned_priors", "scaled_to_accuracy"),
    "casacal.samples.measurements": ("Measurements",),
    "casacal.samples.samples": ("Samples",),
    "casacal.simulation.simulate": ("Simulation", "simulate"),
    "casacal.study": ("Method", "Run", "Simulated", "Study"),
    "casacal.unknowns": ("Direction", "Frame", "Parameter", "Plane"),
    "casacal.verification.verify": ("Verification", "verify"),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'casacal' has no attribute '{name}'")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
