"""report.md of a study: what its own function says, and under it how, where and with what it was made."""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from casacal.errors import StudyError
from casacal.files import write_json, write_text
from casacal.study.runs import Run
from casacal.study.study_file import StudyFile, lines_of

MACHINES = "machines.json"
REPORT = "report.md"
PACKAGES = ("casacal", "casadi", "numpy", "scipy")


def machine(workers: int = 1, *, cluster: bool = False) -> dict[str, Any]:
    """What a run was made on: processors, system, Python, packages, processes at once, or that a cluster was asked."""
    return {
        "processor": _processor(),
        "cpus": os.cpu_count(),
        "system": platform.system(),
        "python": platform.python_version(),
        "packages": {name: metadata.version(name) for name in PACKAGES},
        "processes": workers,
        "cluster": cluster,
    }


def note_machines(out: Path, machines: Sequence[dict[str, Any]]) -> None:
    """Add machines to those that made the records of a folder, each once."""
    known = read_machines(out)
    known += [each for each in machines if each not in known]
    write_json(out / MACHINES, {"machines": known})


def read_machines(out: Path) -> list[dict[str, Any]]:
    """Machines that made the records of a folder; raises StudyError when the file is damaged."""
    try:
        return list(json.loads((out / MACHINES).read_text(encoding="utf-8"))["machines"])
    except FileNotFoundError:
        return []
    except (ValueError, KeyError, TypeError):
        fix = "Remove it; the report will then not name a machine"
        raise StudyError(f"'{out / MACHINES}' is damaged", fix) from None


def write_report(source: StudyFile, run: Run, options: str) -> Path:
    """Write report.md, and what else the study draws, into the run's folder; returns its path.

    Args:
        source: whose `report` says what was found.
        run: records and folder.
        options: of the command, those that decide what is in the report.

    """
    run.out.mkdir(parents=True, exist_ok=True)
    lines = [*lines_of(source, run), "", "## How this was made", "", *_made(source, run, options)]
    path = run.out / REPORT
    write_text(path, "\n".join(lines) + "\n")
    return path


def _made(source: StudyFile, run: Run, options: str) -> list[str]:
    commands = source.commands(options)
    lines = [f"{' or '.join(f'`{command}`' for command in commands)}.", ""]
    if run.study is not None:
        failed = sum(record["error"] is not None for record in run.records)
        lines += [
            f"{len(run.study.settings)} settings, {len(run.study.methods)} methods, {run.study.trials} trials, seed "
            f"{run.study.seed}: {len(run.records)} records, {failed} of them failures; SHA-256 without timings "
            f"`{run.digest[:16]}`. `{commands[0]} --report --out DIR`, DIR the folder of `records.jsonl`, writes "
            "this page again from the records alone.",
            "",
        ]
    for made in read_machines(run.out):
        packages = ", ".join(f"{name} {version}" for name, version in made["packages"].items())
        place = f"{made['processor']}, {made['cpus']} CPUs, {made['system']}"
        at_once = f", {made['processes']} processes" if made["processes"] > 1 else ""
        at_once = ", which asked a Dask cluster" if made.get("cluster") else at_once
        lines.append(f"- {place}{at_once}; Python {made['python']}, {packages}")
    return lines


def _processor() -> str:
    """Name of the processor's model where the system tells, else of its kind."""
    if sys.platform == "linux":
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return " ".join(line.partition(":")[2].split())
    return platform.processor() or platform.machine()
