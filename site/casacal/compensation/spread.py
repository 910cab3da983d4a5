"""How well it is known where a calibrated arm is: all that moves it, with its covariance, carried to positions."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.compensation.arm import (
    CalibratedArm,
    all_motion,
    covariance_of,
    local_coordinates,
    row_constants,
    with_effects,
)
from casacal.compensation.told import NOTHING_TOLD
from casacal.discrepancy.effect import Site
from casacal.errors import CasacalError
from casacal.instruments import Instrument
from casacal.problem.compile import RowModel
from casacal.samples.samples import Samples
from casacal.uncertainty.workspace import tip_stds, up_to_base, workspace_joints


@dataclass(frozen=True, eq=False)
class Moved:
    """A model of the arm with all that moves it, z (nz,) at the result, and which of z (k,) are known how well (k, k).

    names: of these (k,). off: by how much these (k,) are elsewhere than the arm is said to be. elsewhere: columns of a
    row at any posture. constants: c (nc,) of the model.
    """

    model: RowModel
    z: Array
    columns: list[int]
    names: list[str]
    covariance: Array
    off: Array | None
    elsewhere: Array
    constants: Array

    @property
    def joints(self) -> int:
        """How many joint values a row begins with."""
        return self.model.pose.numel_in(2) - self.elsewhere.size

    def rows(self, given: Array, told: Mapping[str, Array] = NOTHING_TOLD) -> Array:
        """Whole rows (N, n + k) of given joint values and first columns, and of columns that are told, by name."""
        rows = np.tile(np.concatenate([np.zeros(self.joints), self.elsewhere]), (len(given), 1))
        rows[:, : given.shape[1]] = given
        for name, values in told.items():
            rows[:, self.joints + self.model.names.index(name)] = values
        return rows


def moved_arm(result: CalibratedArm) -> Moved:
    """All that moves the arm of a result; raises CasacalError where it holds no covariance, or of another kit."""
    problem, found = result.source.problem, with_effects(result)
    covariance, columns = covariance_of(result)
    if found is None:
        index, local = [j for _, j in columns], [n for k, u in problem.model.unknowns.items() for n in u.names(k)]
        known, names = covariance[np.ix_(index, index)], [local[i] for i, _ in columns]
        model, z = problem.model, local_coordinates(result, of=problem)
        elsewhere, constants = np.zeros(len(model.names)), row_constants(result, problem)
        return Moved(model, z, [i for i, _ in columns], names, known, None, elsewhere, constants)
    model, site = problem.with_kit.model, Site(problem.robot, problem.instrument)
    names = [name for key, unknown in model.unknowns.items() for name in unknown.names(key)]
    lost = sorted({each["name"] for each in result.discrepancy["unknowns"]} - set(names))
    if lost:
        what = f"{result.file}: it holds an effect beside the geometry ('{lost[0]}') that the problem does not have"
        raise CasacalError(what, "Give the problem that it was calibrated with, or calibrate again")
    whole, off = found
    places = {name: j for j, name in enumerate(off)}
    at = [i for i, name in enumerate(names) if name in places]
    index = [places[names[i]] for i in at]
    away = dict.fromkeys(model.names, 0.0)
    for effect in model.effects:
        away |= effect.away(site)
    away |= {name: float(value) for name, value in result.discrepancy.get("usual", {}).items() if name in away}
    return Moved(
        model,
        local_coordinates(result, of=problem.with_kit),
        at,
        [names[i] for i in at],
        whole[np.ix_(index, index)],
        np.array([off[names[i]] for i in at]),
        np.array(list(away.values())),
        row_constants(result, problem.with_kit),
    )


@dataclass(frozen=True)
class RowZeros:
    """Where the dial of each row was set to zero: unknown by name, the dial's sign, the prior of any zero, mm."""

    names: list[str]
    sign: int
    prior_std: float

    @staticmethod
    def of(instrument: Instrument, joints: Samples, known: Collection[str]) -> RowZeros | None:
        """Of rows that name their sessions; None where they name none, or the zero was set once.

        known: unknowns that a result has. One of rows that named no session knows one zero, which is that of all rows.
        Raises CasacalError for readings of which nothing says when the dial was set.
        """
        probe = instrument.probe
        if probe is None or probe.zero is None or probe.zero_label is None:
            return None
        labels: Sequence[str] | None = joints.labels.get(probe.zero_label)
        if labels is None and f"{probe.zero}.{probe.zero_label}" in known:  # as rows without the column are read
            labels = [probe.zero_label] * len(joints)
        if labels is not None:
            prior = float(instrument.unknowns[probe.zero].prior_stds[0])
            return RowZeros([f"{probe.zero}.{label}" for label in labels], probe.sign, prior)
        if probe.column in joints.columns:
            what = f"The dial was set to zero anew for each {probe.zero_label}, and the rows do not say for which"
            fix = f"Add the column '{probe.zero_label}', or leave out the reading, or ask for the flange"
            raise CasacalError(what, fix)
        return None


def position_stds(
    result: CalibratedArm,
    data: Array,
    frame: str,
    zeros: RowZeros | None,
    told: Mapping[str, Array] = NOTHING_TOLD,
) -> Array:
    """Standard deviation (N,) of the position, mm, all axes together, apart from the position of the base.

    Where it stands is what a rigid motion fitted over the workspace takes out. Effects beside the geometry that are not
    corrected count as errors, by what they do and by how well that is known. told: columns (N,) that rows tell of
    effects, by name; what is not told is as large as it was in the fitted rows.
    """
    arm, joints = moved_arm(result), workspace_joints(result.source.problem.robot)
    data = arm.rows(data, told)
    if zeros is None:
        return _stds(arm.covariance, _field(arm, data, frame), _field(arm, joints, frame), arm.off)
    names, found = np.array(zeros.names), np.zeros(len(data))
    off = None if arm.off is None else np.append(arm.off, 0.0)
    for name in dict.fromkeys(zeros.names):
        covariance = _with_zero(result, [*arm.names, name], zeros.prior_std)
        rows = names == name
        there, workspace = (_field(arm, each, frame, zeros.sign) for each in (data[rows], joints))
        found[rows] = _stds(covariance, there, workspace, off)
    return found


def _stds(covariance: Array, there: tuple[Array, Array], workspace: tuple[Array, Array], off: Array | None) -> Array:
    return np.asarray(np.linalg.norm(tip_stds(covariance, up_to_base(*there, *workspace), off), axis=1))


def _field(arm: Moved, given: Array, frame: str, sign: int = 0) -> tuple[Array, Array]:
    """Moves of positions (3 N, k) by what moves the arm, with a sign also by the dial's zero, and the positions."""
    rows, batch = arm.rows(given), arm.model.batch
    points, slopes = (batch.tip_jacobian if frame == "tip" else batch.flange_jacobian)(arm.z, arm.constants, rows)
    field = slopes.reshape(3 * len(rows), arm.z.size)[:, arm.columns]
    if sign:
        field = np.column_stack([field, sign * batch.plunger(arm.z, arm.constants, rows)[0].ravel()])
    return field, points


def _with_zero(result: CalibratedArm, names: Sequence[str], prior_std: float) -> Array:
    """Covariance of some unknowns (k, k), the last a zero of the dial: by its prior where the result knows none."""
    whole, known = all_motion(result)
    at = [known.index(name) for name in names if name in known]
    found = np.zeros((len(names), len(names)))
    found[: len(at), : len(at)] = whole[np.ix_(at, at)]
    if len(at) < len(names):
        found[-1, -1] = prior_std**2
    return found
