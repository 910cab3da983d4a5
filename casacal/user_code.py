"""Python files of a user: run with the modules beside them, and classes that travel to other processes as source."""

from __future__ import annotations

import functools
import hashlib
import operator
import pickle
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from types import ModuleType
from typing import Any

from casacal.errors import CasacalError, said

IMPORTED = "__casacal_beside__"  # name in a module made by `run_file`: the files of its folder that it imported

RUNNING = frozenset({*sys.stdlib_module_names, "casacal", "casadi", "numpy", "scipy", "pandas", "matplotlib"})
"""Modules that stay whatever lies in a folder: Python's own, casacal and what it runs on."""

_IMPORTING = threading.RLock()  # the import system is one for all: one file runs at a time, and those that it loads


def run_file(path: str | Path, text: str | None = None) -> ModuleType:
    """Run a Python file as a module of its own, with the modules beside it importable; returns the module.

    Neither the file nor what it imports from its folder stays in `sys.modules`, so that files of the same name in other
    folders do not meet. What the file prints goes to the errors, so that a program may read casacal's output. Lets pass
    whatever the file raises. The file need not exist where its `text` is given.
    """
    file = Path(path)
    source = file.read_bytes() if text is None else text.encode("utf-8")
    module = ModuleType(f"casacal_user_{hashlib.sha256(str(file).encode() + source).hexdigest()[:16]}")
    module.__file__ = str(file)
    with _IMPORTING, redirect_stdout(sys.stderr), _folder_first(file.resolve().parent) as imported:
        sys.modules[module.__name__] = module  # dataclasses look there for the names in annotations
        try:
            exec(compile(source, str(file), "exec"), vars(module))
        finally:
            sys.modules.pop(module.__name__, None)
    vars(module)[IMPORTED] = tuple(imported)
    return module


def line_of(file: Path, error: BaseException) -> str:
    """A user's file, and the last line of it that was running when an error came: "problem.py, line 3"."""
    frames = traceback.extract_tb(error.__traceback__)
    places = [frame.lineno for frame in frames if Path(frame.filename).resolve() == file.resolve()]
    line = error.lineno if isinstance(error, SyntaxError) else (places or [None])[-1]
    return f"{file}, line {line}" if line else str(file)


@contextmanager
def _folder_first(folder: Path) -> Iterator[list[str]]:
    """Let imports find a folder first while the block runs; yields a list of the files imported from there."""
    local = {entry.stem for entry in folder.glob("*.py")} | {entry.parent.name for entry in folder.glob("*/*.py")}
    local -= RUNNING
    aside = {name: sys.modules.pop(name) for name in list(sys.modules) if name.split(".")[0] in local}
    sys.path.insert(0, str(folder))
    loaded: list[str] = []
    try:
        yield loaded
    finally:
        sys.path.remove(str(folder))
        for name in [name for name in sys.modules if name.split(".")[0] in local]:
            loaded.append(str(getattr(sys.modules.pop(name), "__file__", None) or ""))
        sys.modules.update(aside)


class Portable:
    """Base of classes whose instances pickle although a user's file, which nobody can import, defines the class.

    The file travels with the instance as text and is run where it arrives, unless it ran there before.
    """

    _defined_in: str | None = None

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls._defined_in = getattr(sys.modules.get(cls.__module__), "__file__", None)

    def __reduce_ex__(self, protocol: Any) -> Any:
        cls = type(self)
        found: Any = sys.modules.get(cls.__module__)
        for name in cls.__qualname__.split("."):
            found = getattr(found, name, None)
        if found is cls:  # another process finds it by its module's name
            return super().__reduce_ex__(protocol)
        if cls._defined_in is None or "<locals>" in cls.__qualname__:
            what = f"{cls.__qualname__} is defined inside a function or a session"
            raise pickle.PicklingError(f"{what}. Put the class into a file of its own, or into problem.py.")
        text = Path(cls._defined_in).read_text(encoding="utf-8")
        return _instance, (cls._defined_in, text, cls.__qualname__, dict(vars(self)))

    def __copy__(self) -> Any:
        return self  # a value

    def __deepcopy__(self, memo: object) -> Any:
        return self


@functools.lru_cache(maxsize=64)
def _class_from(path: str, text: str, name: str) -> type:
    found = operator.attrgetter(name)(run_file(path, text))
    assert isinstance(found, type)
    return found


def _instance(path: str, text: str, name: str, state: dict[str, Any]) -> Any:
    """An instance of a class that a user's file defines; raises CasacalError where the file does not run here."""
    try:
        cls = _class_from(path, text, name)
    except Exception as error:  # a user's file may raise anything
        fix = "Put what it needs beside it, or the class into a module that can be imported in both places"
        raise CasacalError(f"{path}, which defines {name}, does not run here: {said(error)}", fix) from error
    made: Any = object.__new__(cls)
    for key, item in state.items():
        object.__setattr__(made, key, item)
    return made
