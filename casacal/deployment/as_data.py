"""Problems as data: what result.json holds of an arm and its instrument, so that it can be used without their code.

What is declared in casacal's own words (a DH table, a URDF's chain, parameters, a dial) is written as declared;
functions of a user's own are written as the graphs that they build.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from importlib import import_module
from typing import Any

import casadi as ca
import numpy as np

from casacal.errors import CasacalError
from casacal.kernels.program import graph_data, graph_from
from casacal.model.problem import Problem
from casacal.model.robot import Robot
from casacal.model.traced_instrument import TracedInstrument
from casacal.values import FrozenMapping

HOMES: Mapping[str, str] = {
    "model.dh_table": "DHTable",
    "model.urdf": "UrdfChain UrdfJoint",
    "model.joints": "Conventions Joint",
    "model.traced_pose": "Screws TracedPose",
    "model.unknown": "Parameter",
    "model.geometry": "Direction Plane Frame",
    "model.constraint": "Constraint Correlation",
    "model.instrument": "Probe ResidualBlock Trusted Words",
    "model.traced_instrument": "TracedInstrument",
    "model.dial": "DialOnPlane DialOnBody Step",
    "model.points": "TrackedPoint KnownPoint FixedPoint Sockets Distance SphereTouch SelfContact",
    "model.tracked_pose": "TrackedPose",
    "effects.compliance": "GravitySag LinkSag TorqueCompliance",
    "effects.gears": "Backlash GearRipple JointCoupling TransmissionError",
    "effects.trusted": "FocalLength",
    "effects.smooth": "Drift FaceForm JointField PlateForm SphereForm ThermalGrowth",
}
KINDS: Mapping[str, str] = {name: f"casacal.{home}" for home, names in HOMES.items() for name in names.split()}
"""Classes that may stand in such data, and the modules that define them: nothing else is ever made of the data.

A module is imported when a problem uses one of its classes, and not before."""


def _is_of(package: str, item: Any) -> bool:
    """Whether an item is an instance of one of these classes, defined in a package of casacal."""
    home = KINDS.get(type(item).__name__, "")
    return type(item).__module__ == home and home.startswith(package)


def problem_data(problem: Problem) -> dict[str, Any]:
    """A problem in JSON's own types, with a hash that says whether somebody changed them.

    Raises CasacalError where a user's function is no graph of elementary operations.
    """
    robot = problem.robot
    pose = None if robot.arm is not None and robot.pose == robot.arm.pose else robot.traced
    data = {
        "name": robot.name,
        "joints": _encoded(robot.axes),
        "parameters": _encoded(robot.parameters),
        "arm": _encoded(robot.arm),
        "pose": _encoded(pose),
        "instruments": [
            _encoded(each if _is_of("casacal.model", each) else TracedInstrument.of(each, robot.parameters))
            for each in problem.instruments
        ],
    }
    if len(problem.instruments) > 1:
        data |= {"names": list(problem.names), "shared": _encoded(problem.shared)}
    if problem.terms and all(_is_of("casacal.effects", term) for term in problem.terms):
        data["effects"] = _encoded(problem.terms)
    if problem.constraints:
        data["constraints"] = _encoded(problem.constraints)
    return {"sha256": _digest(data), **data}


def problem_from(data: Mapping[str, Any]) -> Problem:
    """The problem that such data describe; raises CasacalError where they describe none or were changed."""
    kept = {key: item for key, item in data.items() if key != "sha256"}
    if data.get("sha256") != _digest(kept):
        raise CasacalError("The arm in the file was changed after it was written", "Restore the file")
    try:
        arm = _decoded(kept["arm"])
        pose = arm.pose if kept["pose"] is None else _decoded(kept["pose"])
        robot = Robot(str(kept["name"]), _decoded(kept["joints"]), pose, _decoded(kept["parameters"]), arm)
        measured = [_decoded(each) for each in kept["instruments"]]
        constraints = _decoded(kept.get("constraints", []))
        if len(measured) == 1:
            problem = Problem(robot, *measured, constraints=constraints)
        else:
            named = dict(zip(map(str, kept["names"]), measured, strict=True))
            problem = Problem(robot, named, shared=_decoded(kept["shared"]), constraints=constraints)
        problem = problem.with_terms(*_decoded(kept.get("effects", [])))
        _ = problem.models, problem.free_names(), robot.limits  # what is wrong inside shows here, not later
        return problem
    except CasacalError:
        raise
    except Exception as error:  # whatever stands in the file
        said = " ".join(str(error).split())[:200]
        raise CasacalError(
            f"The arm in the file cannot be read: {said}", "Update casacal, or calibrate again"
        ) from error


def _digest(data: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def _encoded(item: Any) -> Any:
    """Values of the closed set of kinds, and what they hold, in JSON's types; floats that JSON lacks as words."""
    if item is None or isinstance(item, (bool, int, str)):
        return item
    if isinstance(item, (np.integer, np.bool_)):
        return item.item()
    if isinstance(item, (float, np.floating)):
        return float(item) if math.isfinite(item) else {"is": "number", "text": str(float(item))}
    if isinstance(item, (tuple, list, np.ndarray)):
        return [_encoded(each) for each in item]
    if isinstance(item, Mapping):
        return {"is": "items", "items": [[key, _encoded(each)] for key, each in item.items()]}
    if isinstance(item, ca.Function):
        return {"is": "graph", **graph_data(item)}
    if _is_of("casacal", item):
        fields = {
            field.name: _encoded(getattr(item, field.name)) for field in dataclasses.fields(item) if field.compare
        }
        return {"is": type(item).__name__, **fields}
    raise CasacalError(
        f"A {type(item).__name__} cannot be written into a result", "Use casacal's own kinds of unknowns"
    )


def _decoded(item: Any) -> Any:
    if isinstance(item, list):
        return tuple(_decoded(each) for each in item)
    if not isinstance(item, Mapping):
        return item
    if item["is"] == "number":
        return float(item["text"])
    if item["is"] == "items":
        return FrozenMapping({str(key): _decoded(each) for key, each in item["items"]})
    if item["is"] == "graph":
        return graph_from(item)
    fields = {key: _decoded(each) for key, each in item.items() if key != "is"}
    return getattr(import_module(KINDS[item["is"]]), item["is"])(**fields)
