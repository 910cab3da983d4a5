"""A study file, and its report.md: what its own function says, and under it how, where and with what it was made."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import platform
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any

from casacal.errors import CasacalError, StudyError, came, said
from casacal.files import write_json, write_text
from casacal.study.description import Run, Study
from casacal.user_code import line_of
from casacal.wording import counted


@dataclass(frozen=True)
class StudyFile:
    """A study to run: its full and quick forms (None where it only computes), its report, and where it comes from.

    commands: any of them runs it. path: of the file that workers read; None where the study itself is given to them.
    """

    name: str
    commands: tuple[str, ...]
    path: str | None
    study: Study | None
    quick: Study | None
    report: Callable[[Any], Sequence[str] | str]
    skipped: str | None

    def form(self, *, quick: bool = False, trials: int | None = None) -> Study | None:
        """The study to run, with another number of trials where one is given."""
        chosen = self.quick if quick else self.study
        return chosen if chosen is None or trials is None else replace(chosen, trials=trials)


def load_study(path: str | Path) -> StudyFile:
    """Read a study file; raises StudyError when there is none, when it raises, or when it defines no report."""
    file = Path(path)
    if not file.is_file():
        near = ", ".join(sorted(p.as_posix() for p in Path("studies").glob("[!_]*.py")))
        raise StudyError(f"There is no study at '{path}'", f"Give a Python file{f'; here: {near}' if near else ''}")
    values = names_of(file)
    study, report = values.get("study"), values.get("report")
    quick = values.get("quick", study)
    if not callable(report) or not all(form is None or isinstance(form, Study) for form in (study, quick)):
        raise StudyError(f"'{path}' defines no report(run), or its study is no Study", "See casacal.study.study_file")
    parts, _ = _dotted(file.resolve())  # as they are named from the folder of its package, or from here
    named = file.as_posix() if len(parts) == 1 and not file.is_absolute() else f"{'/'.join(parts)}.py"
    commands = (f"casacal study {named}", f"python -m {'.'.join(parts)}")[: len(parts)]
    return StudyFile(file.stem, commands, file.as_posix(), study, quick, report, values.get("skipped"))


def names_of(file: Path) -> dict[str, Any]:
    """Names defined by a user's file, with their values; raises CasacalError when the file raises.

    It is imported by its dotted name where it is part of a package, else on its own beside its neighbours.
    """
    parts, folder = _dotted(file.resolve())
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    try:
        if len(parts) > 1:
            return vars(importlib.import_module(".".join(parts)))
        spec = importlib.util.spec_from_file_location(f"casacal_study_{file.stem}", file.resolve())
        if spec is None or spec.loader is None:
            raise StudyError(f"'{file.name}' is not a Python file", "Name it NAME.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
        return vars(module)
    except (Exception, SystemExit) as error:  # a user's file may raise anything
        raise _failure(file, error) from error


def _dotted(file: Path) -> tuple[list[str], Path]:
    """Parts of a file's dotted name, and the folder from which it is imported."""
    parts, folder = [file.stem], file.parent
    while (folder / "__init__.py").is_file():
        parts, folder = [folder.name, *parts], folder.parent
    return parts, folder


def _failure(file: Path, error: BaseException) -> CasacalError:
    """A refusal that names the last line of the file itself that was running."""
    if isinstance(error, CasacalError):
        return error
    return StudyError(f"{line_of(file, error)}: {said(error)}", "Mend the study file")


MACHINES = "machines.json"
REPORT = "report.md"
PACKAGES = ("casacal", "casadi", "numpy", "scipy")


def machine(workers: int = 1, *, cluster: bool = False) -> dict[str, Any]:
    """Machine of a run: processors, system, Python, packages, processes, or cluster."""
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

    options: of the command, those that decide what it says. Raises StudyError when the study's report fails or is none.
    """
    run.out.mkdir(parents=True, exist_ok=True)
    commands = [f"{command}{options}" for command in source.commands]
    try:
        report = source.report(run)
    except (Exception, SystemExit) as error:  # a user's function may raise anything
        raise _failure(Path(source.path or source.name), error) from error
    if not isinstance(report, Iterable):
        raise StudyError(f"Got {came(report)} from report(run) of '{source.path}'", "Return the lines of report.md")
    said_by_study = report.splitlines() if isinstance(report, str) else map(str, report)
    lines = [*said_by_study, "", "## How this was made", ""]
    lines += [f"{' or '.join(f'`{command}`' for command in commands)}.", ""]
    if run.study is not None:
        failed = sum(record["error"] is not None for record in run.records)
        lines += [
            f"{counted(len(run.study.settings), 'setting')}, {counted(len(run.study.methods), 'method')}, "
            f"{counted(run.study.trials, 'trial')}, seed {run.study.seed}: {counted(len(run.records), 'record')}, "
            f"{counted(failed, 'failure')}; SHA-256 without timings "
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
    path = run.out / REPORT
    write_text(path, "\n".join([*lines, "", "<!-- written by casacal study -->"]) + "\n")
    return path


def _processor() -> str:
    """Name of the processor's model where the system tells, else of its kind."""
    if sys.platform == "linux":
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return " ".join(line.partition(":")[2].split())
    return platform.processor() or platform.machine()
