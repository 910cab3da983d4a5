"""The tasks of a study, and how a worker that is given one finds the study."""

from __future__ import annotations

import functools
import pickle
import threading
from dataclasses import dataclass

from casacal.errors import StudyError
from casacal.study.description import Study
from casacal.study.records import Record
from casacal.study.study_file import load_study
from casacal.study.trial import Task, trial_records

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
        raise StudyError(
            "A worker has another study file, casacal, Python, casadi, numpy or scipy than the one that asks",
            "Give all of them the same",
        )
    return _study(errand.path, errand.quick, errand.trials)


def carried(study: Study) -> bytes:
    """A study on its way to workers; raises StudyError for one that only this process understands."""
    try:
        return pickle.dumps(study)
    except Exception as error:  # closures and whatever else a user's methods hold
        raise StudyError(
            f"The study '{study.name}' cannot be given to workers: {' '.join(str(error).split())}",
            "Write it to a file, or run it here",
        ) from error


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
