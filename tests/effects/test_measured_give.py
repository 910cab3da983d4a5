"""What columns of the samples say of joints, torques and ways of approach: found, weighed, missed in a sentence."""

import dataclasses

import numpy as np
import pytest
from instruments_on_ur5 import ROBOT, TOOL, flanges

from casacal import Problem, TrackedPoint, bind, calibrate, lm, simulate, tool_point
from casacal.effects import Backlash, TorqueCompliance
from casacal.errors import ProblemError, SamplesError
from casacal.simulation import Disturbances

GIVE = np.array([60.0, 120.0, 90.0, 200.0, 250.0, 300.0]) * 1e-6
NAMES = tuple(f"torque{j}_Nm" for j in range(1, 7))
effect = TorqueCompliance(columns_of=NAMES)
problem = Problem(ROBOT, TrackedPoint(noise_std=0.02, tool=tool_point(*TOOL, prior_std=1.0)), terms=(effect,))


@pytest.fixture(scope="module")
def loaded():
    """A drawn arm whose joints stand off by give times torque; points of the tip multiplied out in NumPy."""
    rng = np.random.default_rng(6)
    still = Disturbances(resolution=0.0, repeatability=0.0, error_scale=0.0)
    samples = simulate(problem.without_terms, still, samples=80, seed=1).samples
    torques = rng.normal(size=(80, 6)) * [2.0, 40.0, 20.0, 4.0, 3.0, 1.0]
    stands = (flanges(samples.joints + GIVE * torques)[:, :3] @ np.array([*TOOL, 1.0])) + rng.normal(
        size=(80, 3)
    ) * 0.02
    text = {name: tuple(f"{value:.9f}" for value in column) for name, column in zip(NAMES, torques.T, strict=True)}
    columns = dict(zip("xyz", stands.T, strict=True))
    return dataclasses.replace(samples, columns=columns, extra=text)


def test_the_give_of_each_joint_is_found(loaded):
    bound = bind(problem, loaded)
    result = lm(bound)
    own = [j for j, key in enumerate(bound.beside) if key == effect.key]
    assert np.abs((result.x[own] - GIVE) / result.std[own]).max() < 4
    assert (result.std[own][:5] < 0.1 * GIVE[:5]).all(), "five of six are known well; the last turns the tip alone"
    without = lm(bind(problem.without_terms, loaded))
    assert without.cost > 30 * result.cost


def test_calibrate_corrects_it_row_by_row(loaded):
    found = calibrate(problem, loaded, reference=False)
    assert found.corrected == (effect.key,)
    assert found.metrics["after"]["fit"]["rmse_mm"] < 0.05
    assert effect.key in {each.key for each in found.effect_sizes}


def test_torques_that_are_absent_are_asked_for(loaded):
    for extra, said in (
        ({}, "has no column 'torque1_Nm' of torques"),
        (
            {**loaded.extra, "torque3_Nm": ("1",) * 79 + ("much",)},
            "line 80, column 'torque3_Nm': 'much' is not a finite",
        ),
        ({**loaded.extra, "torque3_Nm": ("nan",) * 80}, "line 1, column 'torque3_Nm': 'nan' is not a finite number"),
        ({**loaded.extra, "torque3_Nm": ("1e6",) * 80}, "'torque3_Nm': 1e\\+06 is absurd .beyond 100,000 Nm."),
    ):
        with pytest.raises((ProblemError, SamplesError), match=said):
            bind(problem, dataclasses.replace(loaded, extra=extra))
    with pytest.raises(ProblemError, match="Got 2 columns of torques for 6 joints"):
        bind(problem.with_terms(TorqueCompliance(columns_of=NAMES[:2])), loaded)


CAME = tuple(f"came{j}" for j in range(1, 7))


@pytest.fixture(scope="module")
def approached(loaded):
    """A drawn arm with play whose joints came from either side by chance, as columns say; points by NumPy."""
    rng = np.random.default_rng(7)
    ways, play = rng.choice([-1, 1], size=(80, 6)), np.array([50.0, 80.0, 60.0, 100.0, 150.0, 90.0]) * 1e-6
    stands = flanges(loaded.joints - play * ways)[:, :3] @ np.array([*TOOL, 1.0]) + rng.normal(size=(80, 3)) * 0.005
    text = {name: tuple(str(way) for way in column) for name, column in zip(CAME, ways.T, strict=True)}
    return dataclasses.replace(loaded, columns=dict(zip("xyz", stands.T, strict=True)), extra=text), play


def test_play_is_found_where_columns_say_how_joints_came(approached):
    samples, play = approached
    fine = dataclasses.replace(problem.instrument, noise_std=0.005)
    told = bind(Problem(ROBOT, fine, terms=(Backlash(columns_of=CAME),)), samples)
    result = lm(told)
    own = [j for j, key in enumerate(told.beside) if key == "play"]
    found, std = result.x[own][:6], result.std[own][:6]
    assert np.abs((found - play) / std)[:5].max() < 4
    assert (std[:4] < 0.2 * play[:4]).all()
    guessed = lm(bind(Problem(ROBOT, fine, terms=(Backlash(),)), samples))
    assert guessed.cost > 3 * result.cost, "the row before says nothing of how these joints came"


def test_ways_of_approach_that_are_none_are_named(approached):
    samples, _ = approached
    told = Problem(ROBOT, problem.instrument, terms=(Backlash(columns_of=CAME),))
    for column, said in (
        (("up",) * 80, "line 1, column 'came2': 'up' is not a finite number"),
        (("1",) * 79 + ("2",), f"line {samples.lines[79]}, column 'came2': 2 is no way of approach"),
    ):
        with pytest.raises(SamplesError, match=said):
            bind(told, dataclasses.replace(samples, extra={**samples.extra, "came2": column}))
    with pytest.raises(ProblemError, match="no column 'came1' of ways of approach"):
        bind(told, dataclasses.replace(samples, extra={}))
    with pytest.raises(ProblemError, match="Got 1 columns of ways of approach for 6 joints"):
        bind(Problem(ROBOT, problem.instrument, terms=(Backlash(columns_of=CAME[:1]),)), samples)
