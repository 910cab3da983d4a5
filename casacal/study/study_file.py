"""A study file, and the trials that it asks for one by one."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import pickle
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

from casacal.errors import CasacalError, StudyError, came
from casacal.study.description import Study
from casacal.study.records import Record
from casacal.study.trial import Task, trial_records


@dataclass(frozen=True)
class StudyFile:
    """A study read from a file: its full and quick forms (None where it only computes), and its report."""

    name: str
    path: str
    study: Study | None
    quick: Study | None
    report: Callable[[Any], Sequence[str] | str]
    skipped: str | None

    def commands(self, options: str) -> list[str]:
        """What runs it from the folder of its package (or its own), with the same options."""
        parts, _ = _dotted(Path(self.path).resolve())
        found = [f"casacal study {'/'.join(parts)}.py{options}"]
        return found if len(parts) == 1 else [*found, f"python -m {'.'.join(parts)}{options}"]

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
    try:
        values = vars(_imported(file.resolve()))
    except (Exception, SystemExit) as error:  # a user's file may raise anything
        raise _failure(file, error) from error
    study, report = values.get("study"), values.get("report")
    quick = values.get("quick", study)
    if not callable(report) or not all(form is None or isinstance(form, Study) for form in (study, quick)):
        raise StudyError(f"'{path}' defines no report(run), or its study is no Study", "See casacal.study.study_file")
    return StudyFile(file.stem, file.as_posix(), study, quick, report, values.get("skipped"))


def _dotted(file: Path) -> tuple[list[str], Path]:
    """Parts of a file's dotted name, and the folder from which it is imported."""
    parts, folder = [file.stem], file.parent
    while (folder / "__init__.py").is_file():
        parts, folder = [folder.name, *parts], folder.parent
    return parts, folder


def lines_of(source: StudyFile, run: Any) -> list[str]:
    """What the study's report says of a run, as lines; raises StudyError when it fails, or says nothing."""
    try:
        said = source.report(run)
    except (Exception, SystemExit) as error:  # a user's function may raise anything
        raise _failure(Path(source.path), error) from error
    if isinstance(said, str):
        return said.splitlines()
    if not isinstance(said, Iterable):
        raise StudyError(f"Got {came(said)} from report(run) of '{source.path}'", "Return the lines of report.md")
    return [str(line) for line in said]


def _failure(file: Path, error: BaseException) -> CasacalError:
    """A refusal that names the last line of the file itself that was running."""
    if isinstance(error, CasacalError):
        return error
    places = [f.lineno for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).name == file.name]
    line = error.lineno if isinstance(error, SyntaxError) else (places or [None])[-1]
    said = " ".join(str(error).split()) or "no message"
    where = f"{file}, line {line}" if line else str(file)
    return StudyError(f"{where}: {type(error).__name__}: {said}", "Mend the study file")


def _imported(file: Path) -> ModuleType:
    """Import a file by its dotted name where it is part of a package, else on its own beside its neighbours."""
    parts, folder = _dotted(file)
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    if len(parts) > 1:
        return importlib.import_module(".".join(parts))
    spec = importlib.util.spec_from_file_location(f"casacal_study_{file.stem}", file)
    if spec is None or spec.loader is None:
        raise StudyError(f"'{file.name}' is not a Python file", "Name it NAME.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


_ONE_AT_A_TIME = threading.Lock()
"""Compiled functions keep buffers, so threads of one process take turns; clocks then measure one method alone."""


@dataclass(frozen=True)
class Errand:
    """A task for a worker that reads the study's file itself."""

    path: str
    quick: bool
    trials: int
    task: Task


@dataclass(frozen=True)
class Carried:
    """A task for a worker, with the study itself, pickled: a study of values needs no file."""

    study: bytes
    task: Task


def tasks_of(study: Study) -> list[Task]:
    """All tasks of a study, trial by trial, so that what is recorded early covers every setting."""
    keys = {(setting, name): study.fingerprint(setting, name) for setting in study.settings for name in study.methods}
    found = []
    for trial in range(study.trials):
        methods = tuple(name for name in study.methods if trial < study.trials_of(name))
        for setting in study.settings:
            if methods:
                found.append(Task(setting, trial, methods, tuple(keys[setting, name] for name in methods)))
    return found


def perform(study: Study, task: Task) -> list[Record]:
    """Records of a task."""
    return [record for record in trial_records(study, task) if record is not None]


def perform_errand(errand: Errand | Carried) -> list[Record]:
    """Records of a task, in a worker; raises StudyError when its casacal or its study file is another one."""
    with _ONE_AT_A_TIME:
        return perform(opened(errand), errand.task)


def opened(errand: Errand | Carried) -> Study:
    """The study of a task, in a worker; raises StudyError when its casacal or its study file is another one."""
    if isinstance(errand, Carried):
        return _unpacked(errand.study)
    if [_fingerprint(errand, method) for method in errand.task.methods] != list(errand.task.fingerprints):
        what = "A worker has another study file, casacal, Python, casadi, numpy or scipy than the one that asks"
        raise StudyError(what, "Give all of them the same")
    return _study(errand.path, errand.quick, errand.trials)


def carried(study: Study) -> bytes:
    """A study on its way to workers; raises StudyError for one that only this process understands."""
    try:
        return pickle.dumps(study)
    except Exception as error:  # closures and whatever else a user's methods hold
        what = f"The study '{study.name}' cannot be given to workers: {' '.join(str(error).split())}"
        raise StudyError(what, "Write it to a file, or run it here") from error


@functools.lru_cache(maxsize=4)
def _unpacked(study: bytes) -> Study:
    found = pickle.loads(study)
    assert isinstance(found, Study)
    return found


@functools.cache
def _study(path: str, quick: bool, trials: int) -> Study:
    study = load_study(path).form(quick=quick, trials=trials)
    if study is None:
        raise StudyError(f"'{path}' defines no study", "Give the file that the run was started with")
    return study


@functools.cache
def _key(path: str, quick: bool, trials: int, setting: str, method: str) -> str:
    return _study(path, quick, trials).fingerprint(setting, method)


def _fingerprint(errand: Errand, method: str) -> str:
    return _key(errand.path, errand.quick, errand.trials, errand.task.setting, method)
