"""A million rows and an empty cache: memory, reading, and starting, each measured in processes of their own."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from casacal.model.problem_file import load_problem
from studies.reporting import PROBLEMS, table
from studies.speed_case import arm_at_a_plane, touches

ROWS = 1_000_000
TURNS = 5

FIT = """
import re, resource, sys
from pathlib import Path
import numpy as np
from casacal.threads import one_thread_each
one_thread_each()
from casacal import bind, lm
from studies.speed_case import arm_at_a_plane
if sys.argv[2].endswith("csv"):
    import pandas
    pandas.read_csv(sys.argv[1])
problem = arm_at_a_plane()
def peak():
    try:  # of this program; what getrusage says may be left from the process that started it
        return int(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1]) / 1024
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
def fit(file):
    samples = problem.read(file)
    bound = bind(problem, samples, backend=sys.argv[3])
    lm(bound).covariance
    lanes = sum(p.lanes.d.nbytes + p.lanes.w.nbytes for p in bound._rows.pieces)
    return (samples.joints.nbytes + lanes) / 2**20
fit(sys.argv[1])
before = peak()
data = fit(sys.argv[2])
print(data, peak() - before - data)
"""

READ = """
import sys, time
import pandas as pd
from studies.speed_case import arm_at_a_plane
problem, times = arm_at_a_plane(), ([], [])
for _ in range(6):
    for k, read in enumerate((pd.read_csv, problem.read)):
        began = time.perf_counter()
        read(sys.argv[1])
        times[k].append(time.perf_counter() - began)
print(*(sorted(each[1:])[2] for each in times))
"""


def sections() -> list[str]:
    """Lines of two sections."""
    with tempfile.TemporaryDirectory() as place:
        return [*a_million_rows(Path(place)), "", *start_up(Path(place))]


def a_million_rows(place: Path) -> list[str]:
    """Peak memory above the data, and the time to read a CSV file over that of pandas."""
    problem = arm_at_a_plane()
    header = ",".join(f"q{i}_rad" for i in range(1, 7))
    joints = touches(problem, ROWS)
    for name, rows in (("few", joints[:500]), ("million", joints)):
        fields = np.zeros(len(rows), dtype=[(f"q{i}_rad", "f8") for i in range(1, 7)])
        for i in range(6):
            fields[f"q{i + 1}_rad"] = rows[:, i]
        np.save(place / f"{name}.npy", fields)
        np.savetxt(place / f"{name}.csv", rows, fmt="%.10f", delimiter=",", header=header, comments="")
    body = []
    for kind in ("npy", "csv"):
        for backend in ("c", "blocks"):
            arguments = (FIT, place / f"few.{kind}", place / f"million.{kind}", backend)
            data, above = map(float, fresh(*arguments).split())
            body.append((f".{kind}, {backend}", f"{data:.0f}", f"{above:.0f}"))
    theirs, ours = map(float, fresh(READ, place / "million.csv").split())
    return [
        "## A million rows",
        "",
        "Peak memory of reading and LM with its covariance, MB above what the same process needs for 500 rows; the",
        "data are the joint values as read and, as kernels read them, their sines and cosines and the weights. At most",
        "50 with c and 300 with blocks were aimed at.",
        "",
        *table(("samples, kernels", "data, MB", "above the data, MB"), body),
        "",
        f"Reading the CSV file (six columns, {(place / 'million.csv').stat().st_size / 1e6:.0f} MB) takes "
        f"{ours / theirs:.2f} times pandas' own `read_csv`, medians of five. It includes the file's SHA-256, and each "
        "line is looked at for what could be wrong with it; `.npy` and `.npz` are for who has millions.",
    ]


def start_up(place: Path) -> list[str]:
    """Seconds of the whole command, with the kernels' cache warm and empty, and of importing casacal."""
    command = [sys.executable, "-m", "casacal", "calibrate", str(PROBLEMS / "hsr_jr680"), "--method", "lm"]
    command.append("--no-reference")
    load_problem(PROBLEMS / "hsr_jr680")
    # bytecode is kept, as it is where casacal is installed, whatever this process was told
    kept = {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": str(place / "bytecode")}
    run(command, **kept)
    warm, cold = [], []
    for turn in range(TURNS):
        empty = place / f"cache{turn}"
        for times in (cold, warm):  # the second finds what the first compiled
            times.append(timed(command, CASACAL_CACHE=str(empty), **kept))
    bare, whole = (
        min(timed([sys.executable, "-c", f"import casadi, numpy{more}"], **kept) for _ in range(TURNS))
        for more in ("", ", casacal")
    )
    return [
        "## Starting",
        "",
        f"`casacal calibrate problems/hsr_jr680 --method lm --no-reference`, best of {TURNS}: {min(warm):.2f} s with",
        f"the kernels in the cache, {min(cold):.2f} s with an empty one (about 1.0 and 2.5 were aimed at).",
        f"`import casacal` beyond CasADi and NumPy: {max(whole - bare, 0):.3f} s.",
    ]


def timed(command: list[str], **environment: str) -> float:
    """Seconds of a process."""
    began = time.perf_counter()
    run(command, **environment)
    return time.perf_counter() - began


def fresh(program: str, *arguments: object) -> str:
    """What a program prints in a process of its own."""
    return run([sys.executable, "-c", program, *map(str, arguments)])


def run(command: list[str], **environment: str) -> str:
    """What a command prints; it finds this checkout first."""
    paths = os.pathsep.join([str(PROBLEMS.parent), os.environ.get("PYTHONPATH", "")])
    changed = {**os.environ, "PYTHONPATH": paths, **environment}
    done = subprocess.run(command, env=changed, capture_output=True, text=True, check=True)
    return done.stdout
