"""Methods that do what no method should, among some that behave; matrix problems that need no robot."""

import ctypes
import os
import random
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from tiny_study import Linear

from casacal import lm
from casacal.study import Method, Study

CALLS = []


def hangs(problem):
    while True:
        time.sleep(0.05)


def leaves(problem):
    os._exit(3)


def exits(problem):
    sys.exit("enough")


def interrupts(problem):
    raise KeyboardInterrupt


def crashes(problem):
    ctypes.string_at(1)


def wanders(problem):
    os.chdir("/")
    os.environ["TINY"] = "changed"
    np.seterr(all="raise")
    np.random.seed(0)  # noqa: NPY002
    random.seed(0)
    warnings.simplefilter("ignore")
    return lm(problem)


def spoils(problem):
    problem.problem.x0 += 1.0
    return problem.x0


def appends(problem, *, steps):
    steps.append(len(steps))
    return problem.x0 + len(steps)


def draws(problem):
    return problem.x0 + np.random.normal(size=problem.unknowns) + random.random()  # noqa: NPY002


def starts_others(problem):
    note = Path(os.environ["NOTE"])
    code = "import os, sys, time; open(sys.argv[1], 'w').write(str(os.getpid())); time.sleep(60)"
    subprocess.Popen([sys.executable, "-c", code, str(note)])
    while not note.exists() or not note.read_text():
        time.sleep(0.02)
    return hangs(problem)


CALM = {"lm": lm, "draws": draws}
LETHAL = {"leaves": leaves, "crashes": crashes, "interrupts": interrupts, "hangs": hangs}
RUDE = {"exits": exits, "wanders": wanders, "spoils": spoils, "appends": Method(appends, {"steps": []})}
study = Study("hostile", {"one": Linear()}, {**LETHAL, **RUDE, **CALM}, trials=2)
quick = Study("hostile", {"one": Linear()}, {**RUDE, **CALM}, trials=2)


def report(run):
    return [f"{r['method']} {r['trial']} {r['error']}" for r in run.records]
