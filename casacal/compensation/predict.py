"""Where a calibrated (or true, or nominal) robot is at given joint values."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import CasacalError
from casacal.files import write_text
from casacal.problem.problem_file import ProblemFile, load_problem
from casacal.samples.layout import Layout
from casacal.samples.samples import Samples
from casacal.tables.text import read_table
from casacal.uncertainty.workspace import tip_stds, up_to_base, workspace_joints
from casacal.unknowns import Parameter


@dataclass(frozen=True)
class Prediction:
    """Positions (N, 3; mm) and unit quaternions (N, 4; w, x, y, z, w >= 0) in the base frame.

    `std` (N,) is the standard deviation of the position, mm, its three axes together, up to the base frame; or None.
    """

    positions: Array
    quaternions: Array
    std: Array | None = None


@dataclass(frozen=True)
class ResultFile:
    """A result.json (or a truth), with the problem it answers."""

    file: str
    source: ProblemFile
    document: Mapping[str, Any]


def read_result(path: str | Path) -> ResultFile:
    """Read a result.json or a truth, and load its problem: from the path it names, or beside the result.

    Raises CasacalError when it is not one, or when its problem is gone or has changed since.
    """
    file = str(path)
    try:
        document = json.loads(Path(path).read_text(encoding="utf-8"))
        place, digest = document["problem"]["path"], document["problem"]["sha256"]
        _ = [(row["name"], float(row["estimate"])) for row in document["parameters"]]
    except FileNotFoundError:
        raise CasacalError(
            f"{file}: there is no such file", "Give the result.json that calibrate --out wrote"
        ) from None
    except (OSError, ValueError, KeyError, TypeError):
        raise CasacalError(f"{file}: this is not a result of casacal", "Give a result.json or a truth.json") from None
    beside = Path(path).parent / place
    source = load_problem(beside if not Path(place).exists() and beside.exists() else place)
    if source.sha256 != digest:
        raise CasacalError(
            f"{file}: its problem {source.path} has changed since the calibration",
            "Calibrate again, or restore the problem file",
        )
    _check_nominal(file, source, document)
    return ResultFile(file, source, document)


def _check_nominal(file: str, source: ProblemFile, document: Mapping[str, Any]) -> None:
    """Refuse a result whose arm has changed since, as where problem.py reads a URDF that was edited."""
    began = {row["name"]: row.get("nominal") for row in document["parameters"]}
    for key, unknown in source.problem.robot.parameters.items():
        if not isinstance(unknown, Parameter) or unknown.nominal is None:
            continue
        for name, value in zip(unknown.component_names(key), np.ravel(unknown.nominal), strict=True):
            was = began.get(name)
            if isinstance(was, (int, float)) and abs(was - value) > 1e-9 * (1 + abs(value)):
                raise CasacalError(
                    f"{file}: its arm has changed since the calibration ('{name}' was {was:g} and is {value:g})",
                    "Calibrate again, or restore the file that the problem reads",
                )


def arm_values(result: ResultFile, *, nominal: bool = False) -> SimpleNamespace:
    """What `robot.pose` takes as `p`: the arm's parameters as calibrated (or as drawn), as numbers (CasADi DM)."""
    values = {}
    for key, unknown in result.source.problem.robot.parameters.items():
        if unknown.nominal is None:
            raise CasacalError(f"'{key}' of the arm has no nominal value", "Give it one in the problem file")
        values[key] = unknown.at(ca.DM(unknown.nominal), ca.DM(_local(key, unknown, result, nominal)))
    return SimpleNamespace(**values)


def read_joints(path: str | Path, source: ProblemFile) -> Samples:
    """Read joint values, and the instrument's columns where the file has them; raises SamplesError."""
    asked, table = source.problem.layout(), read_table(path)
    present = {
        name: dimension
        for name, dimension in asked.columns.items()
        if any(column == name or column.startswith(f"{name}_") for column in table.header)
    }
    return Samples.from_table(table, Layout(asked.joints, present))


def predict(
    result: ResultFile,
    joints: Samples,
    *,
    frame: Literal["flange", "tip"] = "flange",
    nominal: bool = False,
    std: bool = False,
) -> Prediction:
    """Pose of the flange, or position of the tip with the flange's orientation, at each row.

    Args:
        result: a calibration or a truth.
        joints: rows of joint values; columns that are absent (a reading) count as zero.
        frame: "flange" is `robot.pose`; "tip" is where the instrument touches.
        nominal: use nominal values instead of the estimate.
        std: whether to add standard deviations.

    Raises CasacalError for standard deviations of the nominal arm, or of a result that holds no covariance.

    """
    from scipy.spatial.transform import Rotation

    problem = result.source.problem
    model, instrument = problem.model, problem.instrument
    z = local_coordinates(result, nominal=nominal)
    data = np.zeros((len(joints), model.pose.numel_in(2)))
    data[:, : joints.joints.shape[1]] = joints.joints
    for i, name in enumerate(instrument.columns):
        data[:, joints.joints.shape[1] + i] = joints.columns.get(name, 0.0)
    constants = np.zeros(model.pose.numel_in(1))  # planes and the like move neither flange nor tip
    poses = model.batch.pose(z, constants, data)[0].reshape(-1, 4, 4).transpose(0, 2, 1)
    positions = model.batch.tip(z, constants, data)[0] if frame == "tip" else poses[:, :3, 3]
    xyzw = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    spread = None
    if std:
        if nominal:
            raise CasacalError("The nominal arm has no standard deviation", "Leave out --nominal or --std")
        spread = _spread(result, z, data, frame)
    return Prediction(positions, np.roll(xyzw, 1, axis=1), spread)


def local_coordinates(result: ResultFile, *, nominal: bool = False) -> Array:
    """Local coordinates (nz,) of the first instrument's row model at the result, or at the nominal values.

    Zero for unknowns that differ by label. Raises CasacalError when the result lacks one.
    """
    unknowns = result.source.problem.model.unknowns
    return np.concatenate([_local(key, unknown, result, nominal) for key, unknown in unknowns.items()])


def _spread(result: ResultFile, z: Array, data: Array, frame: str) -> Array:
    """Standard deviation (N,) of the position, mm, all axes together, up to the base frame that the workspace fits."""
    problem = result.source.problem
    model = problem.model
    evaluate = model.batch.tip_jacobian if frame == "tip" else model.batch.flange_jacobian
    constants, workspace = np.zeros(model.pose.numel_in(1)), workspace_joints(problem.robot)
    frame_data = np.zeros((len(workspace), data.shape[1]))
    frame_data[:, : workspace.shape[1]] = workspace
    covariance, columns = _covariance(result)
    fields = []
    for rows in (data, frame_data):
        points, slopes = evaluate(z, constants, rows)
        fields.append((slopes.reshape(3 * len(rows), z.size)[:, [i for i, _ in columns]], points))
    field = up_to_base(*fields[0], *fields[1])
    index = [j for _, j in columns]
    stds = tip_stds(covariance[np.ix_(index, index)], field)
    return np.asarray(np.linalg.norm(stds, axis=1))


def _covariance(result: ResultFile) -> tuple[Array, list[tuple[int, int]]]:
    """Covariance of the result's unknowns (n, n), and which position of the model's z is which of them."""
    try:
        rows = [[math.inf if value is None else float(value) for value in row] for row in result.document["covariance"]]
        names = [row["name"] for row in result.document["unknowns"]]
    except (KeyError, TypeError):
        raise CasacalError(f"{result.file}: it holds no covariance", "Calibrate again with this version") from None
    places = {name: j for j, name in enumerate(names)}
    local = [n for key, u in result.source.problem.model.unknowns.items() for n in u.names(key)]
    return np.array(rows), [(i, places[name]) for i, name in enumerate(local) if name in places]


def infinite_variances(result: ResultFile, keys: Iterable[str]) -> list[str]:
    """Names of those components, of the unknowns with the given keys, that neither samples nor prior hold.

    Raises CasacalError for a result that holds no covariance.
    """
    covariance, columns = _covariance(result)
    unknowns = result.source.problem.model.unknowns
    names = [(key, name) for key, unknown in unknowns.items() for name in unknown.names(key)]
    wanted = set(keys)
    return [names[i][1] for i, j in columns if names[i][0] in wanted and not math.isfinite(covariance[j, j])]


def _local(key: str, unknown: Any, result: ResultFile, nominal: bool) -> Array:
    """Local coordinates of an unknown at the result; zero for those that differ by label."""
    if nominal or unknown.per is not None or not unknown.size:
        return np.zeros(unknown.size)
    if isinstance(unknown, Parameter):
        known = {row["name"]: float(row["estimate"]) - float(row["nominal"]) for row in result.document["parameters"]}
    else:
        known = {row["name"]: float(row["value"]) for row in result.document["unknowns"]}
        if not known.keys() & set(unknown.names(key)):  # held by the calibration
            return np.zeros(unknown.size)
    missing = [name for name in unknown.names(key) if name not in known]
    if missing:
        raise CasacalError(f"{result.file}: '{missing[0]}' is missing", "Give a result of this problem")
    return np.array([known[name] for name in unknown.names(key)])


def write_prediction(path: str | Path, prediction: Prediction) -> None:
    """Write x_mm,y_mm,z_mm,qw,qx,qy,qz, and std_mm where there is one, a row a pose."""
    lines = ["x_mm,y_mm,z_mm,qw,qx,qy,qz" + (",std_mm" if prediction.std is not None else "")]
    for i, (place, turn) in enumerate(zip(prediction.positions, prediction.quaternions, strict=True)):
        cells = [f"{v:.6f}" for v in place] + [f"{v:.12f}" for v in turn]
        lines.append(",".join(cells if prediction.std is None else [*cells, f"{prediction.std[i]:.6f}"]))
    write_text(path, "\n".join(lines) + "\n")
