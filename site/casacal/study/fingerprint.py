"""A key for what determines a computation: values, functions and the code and packages beneath them."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import platform
from collections.abc import Mapping
from enum import Enum
from importlib import metadata
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

PACKAGES = ("casadi", "numpy", "scipy")  # packages whose version can change a number


def fingerprint(value: Any) -> str:
    """Sixteen hexadecimal digits that change when a value does, or a function, or anything these refer to.

    Knows numbers, texts, arrays, collections, dataclasses, enumerations, partial functions, and Python functions by
    their byte code, defaults, closure and the globals they use. casacal's own functions and classes count by name:
    `code_fingerprint` covers them.
    """
    text = json.dumps(_described(value, ()), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@functools.cache
def code_fingerprint() -> str:
    """Sixteen hexadecimal digits for casacal's source, Python and the packages that numbers depend on."""
    package = Path(__file__).parent.parent
    sources = {
        p.relative_to(package).as_posix(): _digest(p.read_bytes())
        for p in sorted(package.rglob("*.[pch]*"))
        if p.suffix in (".py", ".c", ".h")
    }
    versions = {name: metadata.version(name) for name in PACKAGES}
    return fingerprint({"sources": sources, "versions": versions, "python": platform.python_version()})


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _described(value: Any, within: tuple[int, ...]) -> Any:
    """A JSON form of a value; `within` holds what encloses it, so that a recursive function ends."""
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, (float, np.generic)):
        return ["number", repr(value.item() if isinstance(value, np.generic) else value)]
    if isinstance(value, np.ndarray):
        return ["array", str(value.dtype), list(value.shape), _digest(np.ascontiguousarray(value).tobytes())]
    if isinstance(value, Enum):
        return ["enum", type(value).__qualname__, value.name]
    if id(value) in within:
        return "itself"
    within = (*within, id(value))
    if isinstance(value, Mapping):
        return ["map", [[_described(k, within), _described(v, within)] for k, v in value.items()]]
    if isinstance(value, (set, frozenset)):
        return ["set", sorted(json.dumps(_described(item, within), sort_keys=True) for item in value)]
    if isinstance(value, (list, tuple)):
        return ["list", [_described(item, within) for item in value]]
    if isinstance(value, functools.partial):
        return ["partial", *(_described(part, within) for part in (value.func, value.args, value.keywords))]
    if isinstance(value, MethodType):
        return ["method", value.__func__.__qualname__, _described(value.__self__, within)]
    if isinstance(value, FunctionType):
        return _function(value, within)
    if isinstance(value, type):
        return _class(value, within)
    if isinstance(value, (ModuleType, BuiltinFunctionType)):
        return ["named", value.__name__]
    return ["object", _class(type(value), within), _described(_state(value), within)]


def _state(value: Any) -> Any:
    """Fields of a dataclass, attributes of any other object; what has none counts by its text."""
    if dataclasses.is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return vars(value) if hasattr(value, "__dict__") else str(value)


def _function(function: FunctionType, within: tuple[int, ...]) -> Any:
    cells = [_described(cell.cell_contents, within) for cell in function.__closure__ or ()]
    defaults = _described([function.__defaults__, function.__kwdefaults__], within)
    if _ours(function.__module__):
        return ["function", f"{function.__module__}.{function.__qualname__}", defaults, cells]
    names = sorted(set(_names(function.__code__)) & function.__globals__.keys())
    used = [[name, _described(function.__globals__[name], within)] for name in names]
    return ["function", function.__qualname__, _code(function.__code__), defaults, cells, used]


def _class(cls: type, within: tuple[int, ...]) -> Any:
    """Name of a class; where it is a user's, also its functions and values and those of its bases."""
    if _ours(cls.__module__) or cls.__module__ in ("builtins", "numpy") or cls is object:
        return f"{cls.__module__}.{cls.__qualname__}"
    own = {
        key: _described(item.fget if isinstance(item, property) else item, within)
        for key, item in sorted(vars(cls).items())
        if isinstance(item, (FunctionType, property))
        or (isinstance(item, (bool, int, float, str, tuple)) and not key.startswith("__"))
    }
    return [cls.__qualname__, own, [_class(base, within) for base in cls.__bases__]]


def _ours(module: str | None) -> bool:
    return module is not None and module.split(".")[0] in ("casacal", *PACKAGES)


def _code(code: CodeType) -> Any:
    # neither file nor line numbers: moving a function does not change what it computes
    constants = [_code(c) if isinstance(c, CodeType) else repr(c) for c in code.co_consts if c != _docstring(code)]
    return [_digest(code.co_code), list(code.co_names), constants]


def _docstring(code: CodeType) -> Any:
    first = code.co_consts[0] if code.co_consts else None
    return first if isinstance(first, str) else object()


def _names(code: CodeType) -> list[str]:
    inner = [name for c in code.co_consts if isinstance(c, CodeType) for name in _names(c)]
    return [*code.co_names, *inner]
