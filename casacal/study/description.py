"""A study (settings, methods, trials, a seed), its records, and the fingerprint by which each record is keyed."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import gzip
import hashlib
import json
import math
import os
import platform
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from importlib import metadata
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any, Protocol, TypeAlias

import casadi as ca
import numpy as np

from casacal.errors import StudyError
from casacal.files import place_whole, write_text
from casacal.fit.least_squares import LeastSquares, Result
from casacal.values import Array

PACKAGES = ("casadi", "numpy", "scipy")  # packages whose version can change a number


def fingerprint(value: Any) -> str:
    """Sixteen hexadecimal digits that change when a value does, or a function, or anything these refer to.

    Knows numbers, texts, arrays, collections, dataclasses, enumerations, partial functions, and Python functions by
    their byte code, defaults, closure and the globals they use. casacal's own count by name: see `code_fingerprint`.
    """
    return _digest(json.dumps(_described(value, ()), sort_keys=True).encode())[:16]


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
    if isinstance(value, (ca.Function, ca.SX, ca.MX, ca.DM)):  # the same graph in another object is the same
        kind = type(value).__name__
        graph = ca.Function("graph", ca.symvar(value), [value]) if isinstance(value, ca.MX) else value
        return ["graph", kind, _digest(graph.serialize().encode())]
    return ["object", _class(type(value), within), _described(_state(value), within)]


def _state(value: Any) -> Any:
    """Fields of a dataclass, or attributes of another object; the text of one that has neither.

    Raises StudyError where that text is no more than an address, which differs from run to run.
    """
    if dataclasses.is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if hasattr(value, "__dict__"):
        return vars(value)
    if " at 0x" in (text := str(value)):
        what = f"The study uses an object of the kind {type(value).__name__}, which nothing tells from another one"
        raise StudyError(what, "Make it inside the function that uses it")
    return text


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
    own = dict[str, Any]()
    for key, item in sorted(vars(cls).items()):
        if isinstance(item, (property, staticmethod, classmethod, functools.cached_property)):
            (inner,) = (getattr(item, name) for name in ("fget", "__func__", "func") if hasattr(item, name))
            own[key] = _described(inner, within)
        elif isinstance(item, FunctionType) or (isinstance(item, VALUES) and not key.startswith("__")):
            own[key] = _described(item, within)
    return [cls.__qualname__, own, [_class(base, within) for base in cls.__bases__]]


VALUES = (bool, int, float, str, tuple, list, dict, set, frozenset, np.ndarray)


def _ours(module: str | None) -> bool:
    return module is not None and module.split(".")[0] in ("casacal", *PACKAGES)


def _code(code: CodeType) -> Any:
    # neither file nor line numbers: moving a function does not change what it computes
    docstring = {first for first in code.co_consts[:1] if isinstance(first, str)}  # none where there is none
    constants = [_code(c) if isinstance(c, CodeType) else repr(c) for c in code.co_consts if c not in docstring]
    return [_digest(code.co_code), list(code.co_names), constants]


def _names(code: CodeType) -> list[str]:
    inner = [name for c in code.co_consts if isinstance(c, CodeType) for name in _names(c)]
    return [*code.co_names, *inner]


try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

Record: TypeAlias = dict[str, Any]
Key: TypeAlias = tuple[str, int]

DIGITS = 10  # significant digits that a record keeps of a number
TIMING_DIGITS = 4
TIMINGS = "seconds"  # the one entry of a record that may differ when the trial is run again
LIMIT = "limit"  # key of the time limit, in seconds, in a record whose method it ended
_CHECKED = re.compile(rb',"check":"([0-9a-f]{16})"}$')  # first half of the SHA-256 of the line without this end


def key_of(record: Mapping[str, Any]) -> Key:
    """Key of a record: fingerprint of setting, method, seed and code, and the trial's number."""
    return str(record["fingerprint"]), int(record["trial"])


def to_line(record: Mapping[str, Any]) -> str:
    """A record as one line of JSON with sorted keys, and a checksum of it at the end.

    Numbers have ten digits, timings four, and are null where not finite.
    """
    text = _text(record)
    return f'{text[:-1]},"check":"{_digest(text.encode())[:16]}"}}\n'


def _text(record: Mapping[str, Any]) -> str:
    plain = {key: _rounded(value, TIMING_DIGITS if key == TIMINGS else DIGITS) for key, value in record.items()}
    return json.dumps(plain, sort_keys=True, separators=(",", ":"), allow_nan=False)


def read_records(path: Path) -> list[Record]:
    """Records of a file, or of the same file gzipped, without the last line where a kill cut it short.

    None when there is no file. Raises StudyError for a line that is no record or is not as it was written, and for two
    records of one trial and method that differ. Where no line has a checksum, as in early files, none is asked for.
    """
    content = _content_of(path)
    lines = content[: content.rfind(b"\n") + 1].splitlines()
    checked = any(_CHECKED.search(line) for line in lines)
    return merged([[_record(line, path, number, checked) for number, line in enumerate(lines, start=1)]])


def _record(line: bytes, path: Path, number: int, checked: bool) -> Record:
    """The record of a line; raises StudyError when it is none, or `checked` and not as it was written."""
    end = _CHECKED.search(line)
    whole = end is not None and end[1] == _digest(line[: end.start()] + b"}")[:16].encode()
    try:
        record = json.loads(line)
        key_of(record)
    except (ValueError, KeyError, TypeError, RecursionError):
        record = None
    if not isinstance(record, dict) or (checked and not whole):
        of = ""
        if isinstance(record, dict):
            of = ", ".join(f" {k} {record[k]!r}" for k in ("setting", "method", "trial") if k in record)
        what = f"is damaged: its checksum is not that of what it says ({of.strip()})" if of else "is not a record"
        raise StudyError(f"Line {number} of '{path}' {what}", "Restore the file, or remove that line and resume")
    record.pop("check", None)
    return record


@contextlib.contextmanager
def appending(path: Path) -> Iterator[Appender]:
    """Open a record file for appending, repairing a last line cut short; raises StudyError when another run has it.

    A gzipped file is unpacked beside itself.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.is_file() and _packed(path).is_file():
            place_whole(path, lambda place: place.write_bytes(_content_of(path)), own=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0), 0o644)
    except OSError as error:
        raise StudyError(f"'{path}' cannot be written ({error.strerror})", "Choose another folder") from error
    try:
        try:
            _lock(handle)
        except OSError:
            raise StudyError(f"Another run is writing '{path}'", "Wait for it, or choose another folder") from None
        os.ftruncate(handle, path.read_bytes().rfind(b"\n") + 1)
        yield Appender(handle, path)
    finally:
        os.close(handle)


def _lock(handle: int) -> None:
    """Let one process write a file; raises OSError where another one does. The lock ends with the process."""
    if fcntl is not None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    else:  # Windows: a byte far beyond the end, so that all others can be read
        import msvcrt

        os.lseek(handle, 1 << 40, os.SEEK_SET)
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)


class Appender:
    """Appends records to an open file, some at a time in one write."""

    def __init__(self, handle: int, path: Path) -> None:
        self._handle, self._path = handle, path

    def rewrite(self, records: Iterable[Record]) -> None:
        """Put other records in place of all, at once; where an open file cannot be replaced, over them."""
        data = "".join(to_line(record) for record in records)
        if os.name != "nt":
            write_text(self._path, data, own=True)
            return
        os.ftruncate(self._handle, 0)
        os.write(self._handle, data.encode())
        os.fsync(self._handle)

    def append(self, records: Iterable[Record]) -> None:
        """Write whole lines and wait until they are on the disk."""
        data = "".join(to_line(record) for record in records).encode()
        while data:
            data = data[os.write(self._handle, data) :]
        os.fsync(self._handle)


def merged(parts: Sequence[Iterable[Record]]) -> list[Record]:
    """All records of several runs, each key once; of two, the one whose method had more time.

    Raises StudyError when two records of one key differ in more than their timings.
    """
    found: dict[Key, Record] = {}
    for record in (record for part in parts for record in part):
        other = found.setdefault(key_of(record), record)
        if other is record:
            continue
        if had_less_time(other, record):
            found[key_of(record)] = record
        elif not had_less_time(record, other) and _content(other) != _content(record):
            raise StudyError(
                f"Two records of setting '{record['setting']}', method '{record['method']}', trial {record['trial']} "
                "differ",
                "They come from machines or packages that compute differently, or one was edited; run these parts on "
                "one kind of machine",
            )
    return list(found.values())


def had_less_time(one: Record, other: Record) -> bool:
    """Whether a time limit ended one record's method that the other's did not have, or had longer."""
    return LIMIT in one and float(one[LIMIT]) < float(other.get(LIMIT, math.inf))


def records_digest(records: Iterable[Record]) -> str:
    """SHA-256 of records in their order, timings and fingerprints aside.

    Equal numbers have equal digests, also from a later version that computes the same.
    """
    return _digest("".join(f"{_content(record)}\n" for record in records).encode())


def _packed(path: Path) -> Path:
    return path.with_name(path.name + ".gz")


def _content_of(path: Path) -> bytes:
    try:
        if path.is_file():
            return path.read_bytes()
        return gzip.decompress(_packed(path).read_bytes()) if _packed(path).is_file() else b""
    except (OSError, EOFError, zlib.error) as error:
        said = getattr(error, "strerror", None) or str(error)
        raise StudyError(f"'{path}' cannot be read ({said})", "Check the folder, or restore the file") from error


def _content(record: Mapping[str, Any]) -> str:
    return _text({name: value for name, value in record.items() if name not in (TIMINGS, "fingerprint")})


def _rounded(value: Any, digits: int) -> Any:
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _rounded(item, digits) for key, item in value.items()}
    if isinstance(value, (np.generic, np.ndarray)):
        return _rounded(value.tolist(), digits)
    if isinstance(value, (list, tuple)):
        return [_rounded(item, digits) for item in value]
    return value


Estimator: TypeAlias = Callable[..., Result | Array]  # of a `LeastSquares`, to a `Result` or the estimate x (n,)


class Trial(Protocol):
    """One problem that all methods of a trial solve, and how an answer is judged."""

    @property
    def problem(self) -> LeastSquares:
        """Problem given to every method."""

    def judge(self, result: Result) -> Mapping[str, float]:
        """Figures of merit by name; called by the harness, untimed."""

    def detail(self, result: Result) -> Mapping[str, Any]:
        """Further data that the first trial keeps: numbers, texts and lists of them."""


class Setting(Protocol):
    """Source of trials: a problem in a cell, a file of measurements split at random, ..."""

    def trial(self, seed: int) -> Trial:
        """The trial of a seed; the same for the same seed, whoever asks."""


@dataclass(frozen=True)
class Method:
    """An estimator with its options.

    estimate: the function. options: keyword arguments of every call. seeded: whether it takes `seed`, which then
    differs from trial to trial. trials: in how many trials it takes part, the first ones; None for all.
    """

    estimate: Estimator
    options: Mapping[str, Any] = field(default_factory=dict)
    seeded: bool = False
    trials: int | None = None

    def __call__(self, problem: LeastSquares, seed: int) -> Result | Array:
        """Estimate, with options of its own, and the seed where the function takes one."""
        return self.estimate(problem, **copy.deepcopy(dict(self.options)), **({"seed": seed} if self.seeded else {}))


@dataclass(frozen=True)
class Study:
    """Every method on every trial of every setting, on the same truth, poses and noise.

    name: a word. settings: by name, such as `Simulated(problem, cell)`. methods: by name, a `Method` or a plain
    function of a `LeastSquares`. trials: how many per setting. seed: of all of them; trial k of every setting gets the
    same child of it. details: how many trials, the first ones, also keep the objective on the way; the very first its
    estimates too. Raises StudyError when a part is missing.
    """

    name: str
    settings: Mapping[str, Setting]
    methods: Mapping[str, Method | Estimator]
    trials: int = 200
    seed: int = 0
    details: int = 1

    def __post_init__(self) -> None:
        if not self.settings or not self.methods:
            raise StudyError(f"The study '{self.name}' has no setting or no method", "Give at least one of each")
        for name, what in self.methods.items():
            if not callable(what):
                fix = "Give a function"
                raise StudyError(f"Method '{name}' of the study '{self.name}' is a {type(what).__name__}", fix)
        if self.trials < 1:
            raise StudyError(f"The study '{self.name}' has {self.trials} trials", "Give at least one")
        if self.seed < 0:
            raise StudyError(f"The study '{self.name}' has the seed {self.seed}", "Give zero or more")

    def method(self, name: str) -> Method:
        """A method by name."""
        found = self.methods[name]
        return found if isinstance(found, Method) else Method(found)

    def trials_of(self, method: str) -> int:
        """Number of trials of a setting in which a method takes part."""
        most = self.method(method).trials
        return self.trials if most is None else min(most, self.trials)

    def trial_seed(self, trial: int) -> int:
        """Seed of a trial: a child of the study's, whatever else runs."""
        return _spawned(self.seed, trial)

    def method_seed(self, trial: int, method: str) -> int:
        """Seed of a method in a trial."""
        return _spawned(self.seed, trial, *method.encode())

    def fingerprint(self, setting: str, method: str) -> str:
        """Key of what determines the records of a setting and a method, all but the trial's number."""
        how = self.method(method)
        what = [setting, self.settings[setting], method, how.estimate, how.options, how.seeded]
        return fingerprint([self.name, what, self.seed, self.details, code_fingerprint()])


@dataclass(frozen=True)
class Run:
    """Records of a study, in order, with the folder for its report's pictures."""

    study: Study | None
    records: tuple[Record, ...]
    out: Path
    quick: bool = False

    def of(self, setting: str, method: str) -> list[Record]:
        """Records of a method in a setting, by trial."""
        return list(self._sorted.get((setting, method), []))

    @cached_property
    def _sorted(self) -> dict[tuple[str, str], list[Record]]:
        found: dict[tuple[str, str], list[Record]] = {}
        for record in self.records:
            found.setdefault((record["setting"], record["method"]), []).append(record)
        return found

    def values(self, setting: str, method: str, name: str, *, group: str = "figures") -> Array:
        """One figure (trials,) by trial; not a number where the method failed or has no such figure.

        group: "figures", "counts" or "seconds".
        """
        found = (record[group].get(name) for record in self.of(setting, method))
        return np.array([np.nan if value is None else value for value in found], dtype=np.float64)

    def failures(self, setting: str, method: str) -> list[str]:
        """Error messages of a method in a setting."""
        return [record["error"] for record in self.of(setting, method) if record["error"] is not None]

    @property
    def digest(self) -> str:
        """SHA-256 of the records, timings aside: the same wherever and in whatever order they were made."""
        return records_digest(self.records)


def _spawned(seed: int, *key: int) -> int:
    return int(np.random.SeedSequence(seed, spawn_key=key).generate_state(1, np.uint64)[0])
