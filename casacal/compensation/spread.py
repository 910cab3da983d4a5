"""How well it is known where a calibrated arm is: all that moves it, with its covariance, carried to positions."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from casacal.array_types import Array
from casacal.compensation.arm import CalibratedArm, all_motion, local_coordinates, row_constants, with_effects
from casacal.compensation.told import NOTHING, NOTHING_TOLD, TellingColumns, whole_rows
from casacal.errors import CasacalError
from casacal.instruments import Instrument
from casacal.problem.compile import RowModel
from casacal.problem.term import Site
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


def moved_arm(result: CalibratedArm) -> Moved:
    """All that moves the arm of a result; raises CasacalError without a covariance, and for effects of another kit."""
    problem, effects = result.source.problem, with_effects(result)
    problem = problem if effects is None else result.with_its_kit(problem)
    model, away = problem.model, dict.fromkeys(problem.model.names, 0.0)
    names = [name for key, unknown in problem.symbols.unknowns.items() for name in unknown.names(key)]
    if effects is not None:
        if lost := sorted(set(result.found.effects.values) - set(names)):
            what = f"{result.file}: it holds an effect beside the geometry ('{lost[0]}') that the problem does not have"
            raise CasacalError(what, "Give the problem that it was calibrated with, or calibrate again")
        for effect in model.terms:
            away |= effect.away(Site(problem.robot, problem.instrument))
        away |= {name: value for name, value in result.found.effects.usual.items() if name in away}
    covariance, known = all_motion(result)
    at = [i for i, name in enumerate(names) if name in known]
    found = [names[i] for i in at]
    index = [known.index(name) for name in found]
    off = None if effects is None else np.array([effects[1][name] for name in found])
    z, constants = local_coordinates(result, of=problem), row_constants(result, problem)
    elsewhere = np.array(list(away.values()))
    return Moved(model, z, at, found, covariance[np.ix_(index, index)], off, elsewhere, constants)


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
        if probe.column not in joints.columns:
            return None
        what = f"The dial was set to zero anew for each {probe.zero_label}, and the rows do not say for which"
        fix = f"Add the column '{probe.zero_label}', or leave out the reading, or ask for the flange"
        raise CasacalError(what, fix)


def position_stds(
    result: CalibratedArm, data: Array, frame: str, zeros: RowZeros | None, told: TellingColumns = NOTHING
) -> Array:
    """Standard deviation (N,) of the position, mm, all axes together, apart from the position of the base.

    Where it stands is what a rigid motion fitted over the workspace takes out. Effects beside the geometry that are not
    corrected count as errors, by what they do and by how well that is known. told: what rows tell of effects; a column
    that stands at its mean is off by its standard deviation in the fitted rows.
    """
    arm, joints = moved_arm(result), workspace_joints(result.source.problem.robot)
    names, n = arm.model.names, joints.shape[1]
    data = whole_rows(data, n, names, told.columns, arm.elsewhere)
    joints = whole_rows(joints, n, names, NOTHING_TOLD, arm.elsewhere)
    squares, sign = np.zeros(len(data)), 0 if zeros is None else zeros.sign
    whole, known = all_motion(result)
    workspace = _field(arm, joints, frame, sign)
    for zero in [None] if zeros is None else dict.fromkeys(zeros.names):
        covariance, off, rows = arm.covariance, arm.off, np.ones(len(data), dtype=bool)
        if zeros is not None:  # a dial's zero as well as the result knows it, or else as its prior does
            at = [known.index(each) for each in (*arm.names, zero) if each in known]
            covariance = np.diag([*np.zeros(len(arm.names)), zeros.prior_std**2])
            covariance[: len(at), : len(at)] = whole[np.ix_(at, at)]
            off, rows = None if arm.off is None else np.append(arm.off, 0.0), np.array(zeros.names) == zero
        moves = up_to_base(*_field(arm, data[rows], frame, sign), *workspace)
        squares[rows] = (tip_stds(covariance, moves, off) ** 2).sum(axis=1)
    for name, deviation in told.deviations.items():
        moved = data.copy()
        moved[:, n + list(names).index(name)] += deviation
        squares += ((_field(arm, moved, frame)[1] - _field(arm, data, frame)[1]) ** 2).sum(axis=1)
    return np.sqrt(squares)


def _field(arm: Moved, rows: Array, frame: str, sign: int = 0) -> tuple[Array, Array]:
    """Moves of positions (3 N, k) by what moves the arm, with a sign also by the dial's zero, and the positions."""
    batch = arm.model.batch
    points, slopes = (batch.tip_jacobian if frame == "tip" else batch.flange_jacobian)(arm.z, arm.constants, rows)
    field = slopes.reshape(3 * len(rows), arm.z.size)[:, arm.columns]
    if sign:
        field = np.column_stack([field, sign * batch.plunger(arm.z, arm.constants, rows)[0].ravel()])
    return field, points
