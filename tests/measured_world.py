"""A session whose touches are made well, and planned touches that the drawn arm reads alike."""

from dataclasses import replace

import numpy as np

from casacal import bind
from studies.true_cell import World as World


def taken(session, world, numbers):
    """The session after touches of the plan that were made well."""
    for number in numbers:
        session = session.take(*world.touch(number), number=number)
        assert session.alarm is None, f"touch {number}"
    return session


def at_one_reading(problem, samples, reading):
    """The planned rows moved, by least joint motion, to where the drawn arm would read the same everywhere."""
    joints, columns, bound = samples.joints.copy(), {"reading": np.full(len(samples), reading)}, bind(problem, samples)

    def off(at):
        return bound.on(replace(samples, joints=at, columns=columns)).plain_residual(bound.x0)

    for _ in range(8):
        here = off(joints)
        slopes = np.stack([(off(joints + step) - here) / 1e-6 for step in np.eye(joints.shape[1]) * 1e-6], axis=1)
        joints -= here[:, None] * slopes / (slopes**2).sum(axis=1)[:, None]
    return replace(samples, joints=joints, columns=columns)
