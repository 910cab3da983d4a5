"""A plane residual is not accuracy: without a prior, one plane is fitted perfectly by an arm of another size."""

import dataclasses

import numpy as np

from casacal import bind, lm, plate, simulate
from casacal.uncertainty.tip_error import tip_rms, without_rigid, workspace_joints

PLATE = plate((1350.0, 0.0, 500.0))


def arm_size(result):
    """Reach of the identified arm over its nominal reach: lengths and offsets together."""
    values = {name: nominal + (0 if j is None else result.x[j]) for name, _, nominal, j in result.problem.parameters()}
    nominal = {name: nominal for name, _, nominal, _ in result.problem.parameters()}
    keys = [name for name in values if name[0] in "ad" and name[1:].isdigit()]
    return np.linalg.norm([values[key] for key in keys]) / np.linalg.norm([nominal[key] for key in keys])


def fit_one_plane(hsr, *, prior, seed=2):
    # the paper's situation: a dial, nearly normal to one plate
    problem = hsr.problem
    cell = dataclasses.replace(hsr.cell, faces=PLATE, tilt=np.radians(15))
    simulation = simulate(problem, cell, samples=160, seed=seed)
    if not prior:
        problem = problem.with_prior(dict.fromkeys(("alpha", "a", "d", "theta"), np.inf))
    rows = simulation.samples
    fitted = bind(problem, rows.take(np.arange(120)))
    result = lm(fitted, max_steps=400)
    held = fitted.on(rows.take(np.arange(120, 160)))
    residual = float(np.sqrt(np.mean(held.plain_residual(result.x) ** 2)))
    joints = workspace_joints(problem.robot)
    true = fitted.tips(simulation.truth(fitted), joints)
    error = tip_rms(without_rigid((fitted.tips(result.x, joints) - true).ravel(), true))
    nominal = tip_rms(without_rigid((fitted.tips(fitted.x0, joints) - true).ravel(), true))
    return residual, arm_size(result), error, nominal


def test_without_a_prior_the_planes_look_perfect_and_the_arm_is_lost(hsr):
    # where along the unseen directions a fit ends is chance, that it is nowhere near is not
    fits = [fit_one_plane(hsr, prior=False, seed=seed) for seed in range(6)]
    residuals, sizes, errors, nominals = map(np.array, zip(*fits, strict=True))
    assert residuals.max() < 0.015
    assert (np.abs(sizes - 1) > 0.01).all()  # five times what the default prior lets through, below
    assert np.abs(sizes - 1).max() > 0.2
    assert (errors > 50 * nominals).all()


def test_the_default_prior_prevents_it(hsr):
    fits = [fit_one_plane(hsr, prior=True, seed=seed) for seed in range(6)]
    residuals, sizes, errors, nominals = map(np.array, zip(*fits, strict=True))
    assert residuals.max() < 0.015
    assert (np.abs(sizes - 1) < 0.002).all()
    assert (errors < nominals).all()
    assert np.sqrt(np.mean((errors / nominals) ** 2)) < 0.65
