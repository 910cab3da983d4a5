"""A fingerprint changes with whatever can change a number, and with nothing else."""

import dataclasses
import functools
import os
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT

from casacal import lm, swarm
from casacal.errors import StudyError
from casacal.kernels.losses import huber
from casacal.simulation import Simulated
from casacal.study.description import code_fingerprint, fingerprint

FACTOR = 2.0


def uses_a_global(problem):
    return FACTOR * problem


def calls_another(problem):
    return uses_a_global(problem)


def closure(value):
    return lambda problem: problem + value


def defaulted(problem, *, option=1):
    return problem * option


def test_values_tell():
    values = [
        None, True, 1, 1.0, -0.0, 0.0, float("inf"), "1", (1, 2), (2, 1), {"a": 1}, {"a": 2}, {"b": 1}, {1, 2},
        np.array([1.0, 2.0]), np.array([1, 2]), np.array([[1.0, 2.0]]), huber(), huber(2.0), lm, swarm,
        functools.partial(lm, max_steps=3), functools.partial(lm, max_steps=4), closure(1), closure(2),
    ]  # fmt: skip
    prints = [fingerprint(value) for value in values]
    assert len(set(prints)) == len(prints)
    assert prints == [fingerprint(value) for value in values]


def test_functions_tell_by_what_they_do_and_use(monkeypatch):
    before = [fingerprint(f) for f in (uses_a_global, calls_another)]
    monkeypatch.setattr(sys.modules[__name__], "FACTOR", 3.0)
    assert [fingerprint(f) for f in (uses_a_global, calls_another)] != before
    assert all(a != b for a, b in zip(before, [fingerprint(f) for f in (uses_a_global, calls_another)], strict=True))
    one, other = {}, {}
    exec('def f(x):\n    """Said one way."""\n    return x + 1', one)
    exec('\n\ndef f(x):\n    """Said another way."""\n    return x + 1', other)
    assert fingerprint(one["f"]) == fingerprint(other["f"])
    exec('def f(x):\n    """Said one way."""\n    return x + 2', other)
    assert fingerprint(one["f"]) != fingerprint(other["f"])
    assert fingerprint(defaulted) != fingerprint(functools.partial(defaulted, option=2))


def test_a_recursive_function_ends():
    def fact(n):
        return n * fact(n - 1) if n else 1

    assert len(fingerprint(fact)) == 16


def test_problems_and_cells_tell(hsr):
    base = fingerprint(Simulated(hsr.problem, hsr.cell))
    others = [
        Simulated(hsr.problem.with_prior({"a": 0.8}), hsr.cell),
        Simulated(hsr.problem, dataclasses.replace(hsr.cell, backlash=1e-6)),
        Simulated(hsr.problem, hsr.cell, samples=121),
        Simulated(hsr.problem.fix("alpha6"), hsr.cell),
        Simulated(hsr.problem, hsr.cell, fitted=hsr.problem),
    ]
    assert len({base, *map(fingerprint, others)}) == 6


def test_a_users_instrument_tells_by_its_methods(hsr):
    (dial,) = hsr.problem.instruments
    first = fingerprint(dial)
    assert first == fingerprint(dataclasses.replace(dial))

    class Other(type(dial)):
        def tip(self, pose, p, row):
            return super().tip(pose, p, row) * 1.0

    fields = {f.name: getattr(dial, f.name) for f in dataclasses.fields(dial) if f.init}
    assert fingerprint(Other(**fields)) != first


@pytest.mark.long
def test_another_process_finds_the_same():
    program = (
        "from casacal import load_problem, lm\nfrom casacal.simulation import Simulated\n"
        "from casacal.study.description import *\n"
        "s = load_problem('problems/hsr_jr680')\n"
        "print(fingerprint([Simulated(s.problem, s.cell), lm, {1, 2, 'x'}]), code_fingerprint())"
    )
    found = []
    for seed in ("1", "2"):
        done = subprocess.run(
            [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True,
            env={**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": str(ROOT)},
        )  # fmt: skip
        found.append(done.stdout)
    assert found[0] == found[1]
    assert code_fingerprint() in found[0]


def test_graphs_tell_by_what_they_compute():
    def graph(kind, factor):
        x = kind.sym("x")
        return ca.Function("f", [x], [factor * x**2])

    for kind in (ca.SX, ca.MX):
        assert fingerprint(graph(kind, 2)) == fingerprint(graph(kind, 2)) != fingerprint(graph(kind, 3))
    assert fingerprint(ca.DM([1, 2])) == fingerprint(ca.DM([1, 2])) != fingerprint(ca.DM([1, 3]))
    assert fingerprint(2 * ca.MX.sym("x")) != fingerprint(3 * ca.MX.sym("x"))


def test_what_only_its_address_tells_is_refused():
    with pytest.raises(StudyError, match=r"of the kind object, which nothing tells.*inside the function"):
        fingerprint([object()])


def test_all_that_a_users_class_holds_tells():
    def made(count, *, table=(1,)):
        class Own:
            rows, words = {"n": list(table)}, np.array(table)

            @staticmethod
            def steps():
                return count

            @classmethod
            def more(cls):
                return cls.steps() + count

            @functools.cached_property
            def kept(self):
                return count

        return Own

    assert fingerprint(made(1)) == fingerprint(made(1))
    assert len({fingerprint(made(1)), fingerprint(made(2)), fingerprint(made(1, table=(2,)))}) == 3
    for name in ("steps", "more", "kept"):
        one, other = made(1), made(2)
        for each in {"steps", "more", "kept"} - {name}:
            setattr(other, each, vars(one)[each])
        assert fingerprint(one) != fingerprint(other), name
