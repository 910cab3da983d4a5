"""Mirror images of an arm, which no touch can tell from it, and readings that fit either way round.

Faces, spikes and wires tell distances, which a mirror keeps. Many arms are their own image: if the axes lie in one
plane in some posture, joints 1, 4 and 6 counted the other way reflect every tip; others need half turns besides.
Touches then fit to the last digit, yet every Cartesian position is that of the image. Only poses off the pendant tell.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np

from casacal.data.samples import Measurements
from casacal.deployment.result import MirrorImage
from casacal.fit.bound_problem import BoundProblem
from casacal.fit.lm import lm
from casacal.model.instrument import readings_within
from casacal.model.robot import Robot, inside_limits
from casacal.uncertainty.tip_error import workspace_joints
from casacal.values import Array

POSTURES = 8  # where tips are compared; five points in space already tell an image from a turn
MOST_PATTERNS = 1 << 15  # beyond which half turns are left out: two arms that face each other have 12 joints
AKIN = 0.01  # misfit of the image over the spread of the tips, below which parameters may make up for the rest
APART = 1.0  # mm by which a rigid motion must miss the image; an arm in a plane is its own
EQUAL = 12.0  # difference of the costs below which rows and priors do not tell one from the other: odds of e^12
IMAGE_ROWS = 1000  # of the samples that are fitted: an image fits as well, or is off by thousands
MORE_STEPS = 20  # than the arm itself takes, after which a pattern is no image: an image is as near to its drawing
OF_A_ROW = 4.0  # cost that a further row may add
SCATTER = 5.0  # noises by which readings must differ for their direction to matter
MOST_FITS = 12  # patterns that are fitted, the simplest first
DIAL_WAY = (  # what is open where readings fit either way; what it would mean, and settles it
    "the touches do not tell in which direction the dial counts",
    "Were its sign wrong in the problem, the arm would err by twice what it does as drawn. Touch three places again "
    "with the arm 1 mm nearer, and calibrate with these touches as well",
)


def mirror_image(fit: BoundProblem) -> MirrorImage | None:
    """The simplest other conventions whose cost is the same to within EQUAL, or lower, and whose arm is a mirror image.

    None where there is none: an instrument that sees poses, say, or joint limits, tell them apart.
    """
    fit, robot, own = fit.thinned(IMAGE_ROWS), fit.problem.robot, None
    signs, offsets = mirrors(robot)
    joints = workspace_joints(robot, poses=POSTURES)
    drawn = fit.tips(fit.x0, joints)
    tips = fit.tips(fit.x0, (signs[:, None] * joints + offsets[:, None]).reshape(-1, len(robot.axes)))
    tips = tips.reshape(len(signs), POSTURES, 3)
    closed = np.isfinite(tips).all(axis=(1, 2))  # the loops of a closed chain may have no such image
    signs, offsets = signs[closed], offsets[closed]
    off, moved_off = misfits(tips[closed], drawn)
    spread = math.sqrt(float(((drawn - drawn.mean(axis=0)) ** 2).sum(axis=1).mean()))
    found = np.flatnonzero((off <= AKIN * spread) & (moved_off >= max(APART, 2 * AKIN * spread)))
    changes = (signs[found] < 0).sum(axis=1) + (offsets[found] > 0).sum(axis=1)
    numbers = np.arange(1, len(robot.axes) + 1)
    for k in found[np.argsort(changes, kind="stable")][:MOST_FITS]:
        turned = [replace(some, joints=some.joints * signs[k] + offsets[k]) for some in fit.measured.sets]
        if not all(inside_limits(robot, some.joints).all() for some in turned):
            continue
        own = lm(fit) if own is None else own
        image = lm(fit.on(*turned), max_steps=own.steps + MORE_STEPS)
        if image.converged and image.cost - own.cost <= EQUAL:
            other_way, halves = (tuple(numbers[each].tolist()) for each in (signs[k] < 0, offsets[k] > 0))
            return MirrorImage(other_way, halves, float(moved_off[k]))
    return None


def either_way(fit: BoundProblem, every: Measurements | None = None) -> bool:
    """Whether readings of a plunger fit as well where they are counted the other way, from their mean or mid-travel.

    So where every posture was driven to as the drawn arm would read the same there: what readings then tell are the
    errors of the arm, and the other way round their opposite, which makes the arm err by twice what it does as drawn.
    every: rows that the other way would have to fit, far better than this one, where some of them were set aside.
    """
    fit, own = fit.thinned(IMAGE_ROWS) if every is None else fit, None
    rows = fit.measured if every is None else every
    for i, instrument in enumerate(fit.problem.instruments):
        sets, probe = list(rows.sets), instrument.probe
        if probe is None or probe.column is None:
            continue
        read = sets[i].columns[probe.column]
        if read.std() <= SCATTER * np.median(fit.blocks[i].noise):
            continue  # then it hardly matters, or nothing fits
        own = lm(fit) if own is None else own
        most = own.cost + EQUAL + OF_A_ROW * (len(rows) - len(fit.measured))
        if every is not None:
            most = min(most, lm(fit.on(*every.sets)).cost - EQUAL)
        for ends in (2 * np.median(read), sum(readings_within(probe.travel))):
            sets[i] = replace(sets[i], columns={**sets[i].columns, probe.column: ends - read})
            other = lm(fit.on(*sets), max_steps=own.steps + MORE_STEPS)
            if other.converged and other.cost <= most:
                return True
    return False


def mirrors(robot: Robot) -> tuple[Array, Array]:
    """Signs (k, n) and offsets (k, n; rad) to try.

    Half a turn of the first joint only turns the base, half a turn of the last only the flange: neither is tried.
    """
    count = len(robot.axes)
    free = [j for j in range(1, count - 1) if robot.axes[j].turns]
    if 1 << (count + len(free)) > MOST_PATTERNS:
        free = []
    if 1 << count > MOST_PATTERNS:
        return np.ones((0, count)), np.zeros((0, count))
    signs = np.array(list(itertools.product((1.0, -1.0), repeat=count)))
    halves = np.zeros((1 << len(free), count))
    halves[:, free] = list(itertools.product((0.0, math.pi), repeat=len(free)))
    return np.repeat(signs, len(halves), axis=0), np.tile(halves, (len(signs), 1))


def misfits(tips: Array, drawn: Array) -> tuple[Array, Array]:
    """RMS distance (k,) of sets of tips (k, N, 3) from the drawn ones (N, 3): with any isometry, and with a motion."""
    those, these = tips - tips.mean(axis=1, keepdims=True), drawn - drawn.mean(axis=0)
    left, sizes, right = np.linalg.svd(those.transpose(0, 2, 1) @ these)
    squares = (those**2).sum(axis=(1, 2)) + (these**2).sum()
    proper = np.where(np.linalg.det(left @ right) < 0, -1.0, 1.0)
    alike = squares - 2 * sizes.sum(axis=1)
    moved = alike + 2 * (1 - proper) * sizes[:, 2]
    return tuple(np.sqrt(np.maximum(each, 0.0) / len(drawn)) for each in (alike, moved))
