"""Threads share rows and candidates; what they find does not depend on how many there are."""

import functools
import json
import os
import signal
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module

import numpy as np
import pytest
from test_kernels import BACKENDS

import casacal
from casacal import annealing, bind, calibrate, check, ekf, ipopt, lm, load_problem, public, sckf, simulate
from casacal.errors import ProblemError
from casacal.kernels.losses import huber
from casacal.threads import shared_out, thread_count


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_thread_and_two_find_the_same_numbers(hsr, backend, monkeypatch):
    rows = hsr.problem.read(hsr.samples)
    many = rows.take(np.random.default_rng(0).integers(len(rows), size=20_000))
    one, two = (bind(hsr.problem, many, backend=backend, threads=count) for count in (1, 2))
    x = 0.3 * one.start_std
    np.testing.assert_array_equal(one.residual(x), two.residual(x))
    for loss in (None, huber()):
        first, second = one.normal(x, loss), two.normal(x, loss)
        assert first.cost == second.cost
        np.testing.assert_array_equal(first.gradient, second.gradient)
        np.testing.assert_array_equal(first.information, second.information)
    np.testing.assert_array_equal(lm(one).x, lm(two).x)
    v = one.graph.start + 1e-3
    for block, other in zip(one.graph.blocks, two.graph.blocks, strict=True):
        assert (block.threads, other.threads) == (1, 2)
        for first, second in zip(block(v), other(v), strict=True):
            np.testing.assert_array_equal(first, second)
    monkeypatch.setattr("casacal.fit.bound_problem.COMPACT", 10_000)
    triangle = one.compact_jacobian(x)
    assert triangle.shape == (one.unknowns, one.unknowns)
    np.testing.assert_array_equal(triangle, two.compact_jacobian(x))
    states = one.start_std * np.random.default_rng(1).normal(size=(70, one.unknowns))
    np.testing.assert_array_equal(one.costs(states), two.costs(states))
    # and as a whole they are the sum of their parts
    r, j = one.residual(x), one.jacobian(x)
    assert two.normal(x).cost == pytest.approx(r @ r / 2, rel=1e-12)
    np.testing.assert_allclose(two.normal(x).information, j.T @ j, rtol=1e-9, atol=1e-9 * np.abs(j).max() ** 2)
    np.testing.assert_allclose(triangle.T @ triangle, j.T @ j, rtol=1e-9, atol=1e-9 * np.abs(j).max() ** 2)


def test_work_is_shared_in_order_and_errors_come_through():
    assert shared_out(lambda k: k * k, range(7), 3) == [k * k for k in range(7)]
    assert shared_out(lambda k: k, [], 3) == []

    def fails(k):
        raise ZeroDivisionError(k)

    with pytest.raises(ZeroDivisionError):
        shared_out(fails, range(4), 2)


def test_nobody_works_on_after_an_error():
    begun, ended = [], []

    def task(k):
        if k == 0:
            raise ZeroDivisionError
        begun.append(k)
        time.sleep(0.05)
        ended.append(k)

    with pytest.raises(ZeroDivisionError):
        shared_out(task, range(100), 2)
    assert begun == ended
    assert len(begun) < 99


def test_threads_are_counted(monkeypatch):
    assert thread_count(3) == 3
    monkeypatch.setenv("CASACAL_THREADS", "2")
    assert thread_count() == 2
    monkeypatch.delenv("CASACAL_THREADS")
    assert thread_count() >= 1
    for asked in (0, -1):
        with pytest.raises(ProblemError, match="Give one or more"):
            thread_count(asked)
    monkeypatch.setenv("CASACAL_THREADS", "many")
    with pytest.raises(ProblemError, match="'many' threads"):
        thread_count()


def test_public_names_are_imported_by_one_thread_at_a_time(monkeypatch):
    """Two threads that enter a package by different doors would make Python give up (_DeadlockError)."""
    inside, most = [], []

    def slow(name):
        inside.append(name)
        time.sleep(0.01)
        most.append(len(inside))
        inside.remove(name)
        return import_module(name)

    monkeypatch.setattr(public, "import_module", slow)
    with ThreadPoolExecutor(16) as pool:
        found = list(pool.map(lambda name: getattr(casacal, name), casacal.__all__))
    assert set(most) == {1}
    assert all(each is not None for each in found)


def bits_of(calibration):
    document = calibration.to_dict()
    document.pop("seconds")
    return json.dumps(document, sort_keys=True)


def in_turn_and_at_once(jobs, threads):
    """What each job makes: alone after the others, and many at a time on what nobody has used before."""
    with ThreadPoolExecutor(threads) as pool:
        at_once = list(pool.map(lambda job: job(), jobs))
    return [job() for job in jobs], at_once


def nominal_jacobian(bound):
    return bound.compact_jacobian(bound.x0)


@pytest.mark.long
@pytest.mark.parametrize("backend", BACKENDS)
def test_threads_share_a_problem(hsr, backend):
    """One problem that nothing was traced or compiled of yet, used by four threads in all ways at once."""
    problem = load_problem(hsr.path).problem
    samples = [problem.read(hsr.samples).take(np.arange(k, 120)) for k in range(2)]
    ways = [
        lambda s: lm(bind(problem, s, backend=backend)).x.tobytes(),
        lambda s: sckf(bind(problem, s, backend=backend)).x.tobytes(),
        lambda s: ekf(bind(problem, s, backend=backend)).x.tobytes(),
        lambda s: ipopt(bind(problem, s, backend=backend)).x.tobytes(),
        lambda s: annealing(bind(problem, s, backend=backend), seed=1, budget=2000).x.tobytes(),
        lambda s: repr(check(problem, s)),
        lambda s: bits_of(calibrate(problem, s, backend=backend, reference=False)),
        lambda s: repr(calibrate(problem, s, method="lm", backend=backend, reference=False).tip_std),
        lambda s: calibrate(problem, s, method="lm", reference=False).predict(s.joints, std=True).std.tobytes(),
        lambda s: nominal_jacobian(bind(problem, s, backend=backend)).tobytes(),
        lambda s: simulate(problem, hsr.cell, seed=len(s)).samples.columns["reading"].tobytes(),
    ]
    jobs = [functools.partial(way, some) for some in samples for way in ways]
    alone, at_once = in_turn_and_at_once(jobs, 4)
    assert [k for k, (one, other) in enumerate(zip(alone, at_once, strict=True)) if one != other] == []


@pytest.mark.long
@pytest.mark.parametrize("backend", BACKENDS)
def test_many_calibrations_on_eight_threads(hsr, backend):
    problem = load_problem(hsr.path).problem
    rows, rng = problem.read(hsr.samples), np.random.default_rng(4)
    chosen = [rows.take(np.sort(rng.choice(len(rows), 100, replace=False))) for _ in range(20)]
    methods = ("lm", "sckf-lm", "lm", "ekf", "lm")

    def job(k):
        way = "kit" if k % 5 == 1 else "none"
        made = calibrate(
            problem, chosen[k % 20], method=methods[k % 5], backend=backend, reference=False, discrepancy=way
        )
        return made.result.x.tobytes(), made.result.covariance.tobytes()

    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(job, range(200)))
    alone = [job(k) for k in range(20)]
    assert [k for k in range(200) if found[k] != alone[k % 20]] == []


def test_threads_that_are_asked_for_count_more_than_the_environment(monkeypatch):
    monkeypatch.setenv("CASACAL_THREADS", "2")
    assert thread_count(3) == 3


def test_a_process_that_is_forked_shares_out_as_well():
    """Its pools have no threads: these stay with the process that began them."""
    assert shared_out(str, range(6), 2) == [*"012345"]
    if not hasattr(os, "fork"):
        pytest.skip("nothing forks here")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of threads that are left behind, which is what is tried
        child = os.fork()
    if child == 0:
        signal.alarm(20)  # ends a child that waits for ever
        os._exit(0 if shared_out(str, range(6), 2) == [*"012345"] else 1)
    assert os.waitpid(child, 0)[1] == 0


def test_a_task_may_share_out_its_own():
    def task(k):
        return sum(shared_out(lambda j: 10 * k + j, range(3), 2))

    with ThreadPoolExecutor(1) as alone:
        assert alone.submit(shared_out, task, range(4), 2).result(timeout=60) == [3, 33, 63, 93]
