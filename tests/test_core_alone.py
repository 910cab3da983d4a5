"""The core stands alone: without any leaf it binds, fits with every estimator, agrees with IPOPT and runs a study."""

import os
import re
import shutil
import subprocess
import sys

import pytest
from conftest import ROOT
from test_architecture import CORE, GROUND, ORDER, PACKAGE

LEAVES = [name for name in ORDER if name not in CORE and name not in GROUND]

RUN = """
import math
import sys
from pathlib import Path

import numpy as np
from tiny_study import Linear

from casacal import Problem, Robot, Samples, TrackedPoint, bind, ekf, ipopt, lm, sckf, sckf_lm
from casacal.fit import nlpsol
from casacal.study import Method, Study
from casacal.fit.controls import scipy_least_squares
from casacal.fit.population import annealing, evolution, swarm
from casacal.study import run
from casacal.uncertainty.identifiability import identifiability
from casacal.uncertainty.tip_error import tip_rms, workspace_joints

A, ALPHA, D = (0.0, 400.0, 350.0, 0.0), (math.pi / 2, 0.0, 0.0, -math.pi / 2), (300.0, 0.0, 20.0, 80.0)


def flange(q):
    T = np.eye(4)
    for t, a, alpha, d in zip(q, A, ALPHA, D):
        c, s, ca, sa = math.cos(t), math.sin(t), math.cos(alpha), math.sin(alpha)
        T = T @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
    return T[:3, 3]


problem = Problem(Robot.from_dh("own", a=A, alpha=ALPHA, d=D, theta=(0.0,) * 4), TrackedPoint(noise_std=0.05))
rng = np.random.default_rng(5)
joints = rng.uniform(-1.2, 1.2, size=(60, 4))
seen = np.array([flange(q + [1e-3, 4e-3, -3e-3, 5e-3]) for q in joints]) + 0.05 * rng.normal(size=(60, 3))
columns = {f"q{j + 1}_rad": joints[:, j] for j in range(4)} | {f"{name}_mm": seen[:, k] for k, name in enumerate("xyz")}
bound = bind(problem, Samples.from_arrays(columns, problem.layout()))

best = lm(bound)
assert best.converged, best
for other in (ipopt(bound), nlpsol(bound, solver="sqpmethod"), scipy_least_squares(bound), sckf_lm(bound)):
    assert abs(other.cost - best.cost) < 1e-6 * best.cost, (other, best)
for filtered in (sckf(bound), ekf(bound)):
    assert filtered.cost < 2 * best.cost, (filtered, best)
for search in (annealing, evolution, swarm):
    assert math.isfinite(search(bound, seed=1, budget=20_000).cost)
rms = float(np.sqrt(np.mean(bound.plain_residual(best.x) ** 2)))
assert 0.03 < rms < 0.06, rms  # of 180 residuals with 0.05 mm, fitted by some 25 unknowns
drawn = float(np.sqrt(np.mean(bound.plain_residual(bound.x0) ** 2)))
assert drawn > 3 * rms, (drawn, rms)
known = identifiability(bound, bound.tip_jacobian(best.x, joints), bound.tips(best.x, joints))
assert 0 < known.rank <= bound.unknowns

found = run(Study("tiny", {"linear": Linear()}, {"lm": lm, "sckf": Method(sckf)}, trials=3), Path("records"))
assert len(found.values("linear", "lm", "cost")) == 3
leaves = {name.split(".")[1] for name in sys.modules if name.startswith("casacal.")} & set(LEAVES)
assert not leaves, leaves
print("alone")
"""


def without(leaves, place):
    """Folder with a copy of casacal/ that lacks some rooms and modules."""
    shutil.copytree(PACKAGE, place / "casacal", ignore=shutil.ignore_patterns("__pycache__"))
    for name in leaves:
        room = place / "casacal" / name
        shutil.rmtree(room) if room.is_dir() else room.with_suffix(".py").unlink()
    return place


def python(place, *arguments):
    path = os.pathsep.join([str(place), str(ROOT / "tests")])
    found = subprocess.run([sys.executable, *arguments], env={**os.environ, "PYTHONPATH": path}, cwd=place,
                           capture_output=True, text=True, timeout=300)  # fmt: skip
    assert found.returncode == 0, found.stderr[-2000:]
    return found.stdout


def test_the_core_runs_without_any_leaf(tmp_path):
    place = without(LEAVES, tmp_path)
    assert not (place / "casacal" / "calibration").exists()
    assert python(place, "-c", f"LEAVES = {LEAVES!r}\n{RUN}").strip() == "alone"


LAST = {
    "tablet": ("serve",),
    "verification": ("verify", "iso9283"),
    "shopfloor": ("measure",),
    "doctor": ("doctor",),
    "changes": ("changed",),
}
"""Leaves on which no other leaf stands but the page, which goes with each of them, and their commands."""

REST = """
import pathlib, pkgutil, importlib
import casacal
from casacal.cli.main import COMMANDS, main

for module in pkgutil.walk_packages(casacal.__path__, "casacal."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
assert main(["--help"]) == 0
assert main(["calibrate", PROBLEM]) == 0
"""


@pytest.mark.long_unless("doctor")
@pytest.mark.parametrize("leaf", LAST)
def test_a_leaf_can_be_deleted_with_its_command(leaf, tmp_path):
    """Of all that is left every module imports, `--help` lists the other commands, and `calibrate` works."""
    commands = dict.fromkeys((*LAST[leaf], *LAST["tablet"]))
    place = without(dict.fromkeys([leaf, "tablet", *(f"cli/{command}" for command in commands)]), tmp_path)
    main = place / "casacal" / "cli" / "main.py"
    text = main.read_text(encoding="utf-8")
    for command in commands:
        assert text.count(f'"{command}"') == 1
        text = re.sub(f'"{command}",? ?', "", text)
    main.write_text(text, encoding="utf-8")
    said = python(place, "-c", f"PROBLEM = {str(ROOT / 'problems' / 'hsr_jr680')!r}\n{REST}")
    assert "calibrate the arm from samples" in said
    assert not re.search(rf"^ +({'|'.join(commands)}) ", said, re.M)
