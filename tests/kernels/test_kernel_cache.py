"""The cache of compiled kernels and compilers of every kind: what was compiled is loaded, and nothing else ever is."""

import ctypes
import dataclasses
import logging
import os
import shutil
import stat
import subprocess
import sys

import pytest
from conftest import ROOT
from test_kernels import HAS_COMPILER, fresh, kernels  # noqa: F401  a fixture
from test_study import alive, within

from casacal.kernels import libraries
from casacal.kernels.libraries import KEY, CompilerError, load_library

pytestmark = pytest.mark.skipif(not HAS_COMPILER or os.name != "posix", reason="no C compiler, or not Unix")
GCC = next((path for name in ("gcc", "clang", "cc") if (path := shutil.which(name))), "")


def source(value):
    return f"int answer(void) {{ return {value}; }}\n"


def answer(value=7):
    return load_library(source(value), ("answer",)).answer()


def libraries_in(folder):
    return sorted(folder.glob(f"*{libraries.SUFFIX}"))


def written(path, text):
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return str(path)


def built(tmp_path, text, name="planted"):
    """A library that is not from the cache."""
    (tmp_path / f"{name}.c").write_text(text)
    made = tmp_path / f"{name}.so"
    subprocess.run([GCC, "-shared", "-fPIC", str(tmp_path / f"{name}.c"), "-o", str(made)], check=True)
    return made


@pytest.fixture
def counted(fresh, monkeypatch):  # noqa: F811
    """The cache, and a compiler that writes down each time it compiles."""
    note = fresh.parent / "compiled"
    note.touch()
    counting = f'case "$*" in *--version*) ;; *) echo . >> "{note}" ;; esac\nexec {GCC} "$@"'
    monkeypatch.setenv("CC", written(fresh.parent / "counting", counting))
    return fresh, lambda: len(note.read_text().split())


def test_what_was_compiled_once_is_loaded_again(counted):
    cache, compiled = counted
    assert [answer(), answer(), answer(8), answer()] == [7, 7, 8, 7]
    assert compiled() == 2
    assert len(libraries_in(cache)) == 2
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700


def replaced(path, content):
    path.unlink()  # a loaded file must not change under the process
    path.write_bytes(content)
    path.chmod(0o700)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path, other: replaced(path, b""),
        lambda path, other: replaced(path, path.read_bytes()[:1000]),
        lambda path, other: replaced(path, path.read_bytes()[:-1] + b"x"),
        lambda path, other: replaced(path, b"not a library"),
        lambda path, other: replaced(path, other.read_bytes()),
        lambda path, other: (path.unlink(), os.mkfifo(path)),
        lambda path, other: (path.unlink(), (path / "sub").mkdir(parents=True)),
        lambda path, other: (path.unlink(), path.symlink_to(other)),
        lambda path, other: (path.unlink(), path.symlink_to(path)),
        lambda path, other: path.chmod(0o722),
    ],
    ids=["empty", "cut", "changed", "text", "planted", "fifo", "folder", "link", "circle", "writable"],
)
def test_a_broken_or_planted_entry_is_compiled_anew(counted, tmp_path, spoil):
    cache, compiled = counted
    other = built(tmp_path, source(666))
    assert answer() == 7
    (path,) = libraries_in(cache)
    good = path.read_bytes()
    spoil(path, other)
    assert answer() == 7
    assert compiled() == 2
    (again,) = libraries_in(cache)
    assert stat.S_ISREG(again.lstat().st_mode)
    assert again.read_bytes() == good
    assert answer() == 7
    assert compiled() == 2


def test_a_library_under_the_name_of_another_is_not_loaded(counted):
    """Content that is the cache's own, for another source."""
    cache, compiled = counted
    answer(7)
    (seven,) = libraries_in(cache)
    answer(8)
    (eight,) = set(libraries_in(cache)) - {seven}
    shutil.copy(eight, cache / f"{seven.name[:32]}-{eight.name[33:]}")
    seven.unlink()
    assert answer(7) == 7
    assert compiled() == 3


def test_a_name_that_somebody_without_the_key_computes_is_not_loaded(counted, tmp_path, monkeypatch):
    """A whole cache made by another user, or on another machine, is not believed."""
    cache, compiled = counted
    answer()
    user = tmp_path / "user" / "casacal"
    assert (user / KEY).is_file()
    assert not (cache / KEY).exists()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "another"))
    assert answer() == 7
    assert compiled() == 2
    assert (user / KEY).read_bytes() != (tmp_path / "another" / "casacal" / KEY).read_bytes()


def test_the_key_is_the_users_alone(counted, tmp_path):
    compiled = counted[1]
    answer()
    path = tmp_path / "user" / "casacal" / KEY
    assert (stat.S_IMODE(path.stat().st_mode), path.stat().st_size) == (0o600, 32)
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    assert [each.name for each in path.parent.iterdir()] == [KEY]
    for number, spoil in enumerate(
        (
            lambda: path.chmod(0o644),
            lambda: path.write_bytes(b"short"),
            lambda: (path.unlink(), os.mkfifo(path)),
            lambda: (path.unlink(), path.mkdir()),
            lambda: (path.unlink(), path.symlink_to(os.devnull)),
        ),
        start=2,
    ):
        old = path.read_bytes()
        spoil()
        assert answer() == 7
        assert compiled() == number, "what an unsafe key sealed is not believed"
        assert (stat.S_IMODE(path.lstat().st_mode), path.stat().st_size) == (0o600, 32)
        assert path.read_bytes() != old
    assert [each.name for each in path.parent.iterdir()] == [KEY]


def test_without_a_home_the_key_lies_beside_the_libraries(counted, tmp_path, monkeypatch):
    cache, compiled = counted
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert [answer(), answer()] == [7, 7]
    assert compiled() == 1
    assert stat.S_IMODE((cache / KEY).stat().st_mode) == 0o600


@pytest.mark.parametrize("spoil", [os.mkfifo, lambda path: path.touch(), lambda path: path.symlink_to(path)])
def test_a_cache_that_is_no_folder_is_said(fresh, spoil):  # noqa: F811
    spoil(fresh)
    with pytest.raises(CompilerError, match=r"the cache folder .* cannot be used"):
        answer()


def test_a_cache_of_somebody_else_is_not_used(fresh, monkeypatch):  # noqa: F811
    fresh.mkdir(0o700)
    uid = os.getuid()
    monkeypatch.setattr(libraries.os, "getuid", lambda: uid + 1)
    with pytest.raises(CompilerError, match="can be written by others"):
        answer()


def test_racing_processes_agree_on_a_key(fresh):  # noqa: F811
    program = (
        f"from casacal.kernels.libraries import load_library\nprint(load_library({source(7)!r}, ('answer',)).answer())"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    racing = [
        subprocess.Popen([sys.executable, "-c", program], env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(4)
    ]
    assert [process.communicate(timeout=60)[0] for process in racing] == ["7\n"] * 4
    assert len(libraries_in(fresh)) == 1


VERSION = 'case "$*" in *--version*) echo mine 1.0; exit 0 ;; esac\n'
OUT = 'while [ "$1" != -o ]; do shift; done\n'


@pytest.mark.long
@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("exit 1", "does not run (exit code 1)"),
        ("echo 'no licence' >&2; exit 1", "does not run (no licence)"),
        ("sleep 60", "does not run (no answer)"),
        ("sleep 60 & sleep 60", "does not run (no answer)"),
        (VERSION + "sleep 60", "took longer than 0.5 s"),
        (VERSION + "kill -9 $$", "failed (exit code -9)"),
        (VERSION + "printf '\\377\\376\\033[2J\\n'; exit 1", "failed (\ufffd\ufffd?[2J)"),
        (VERSION + "yes", "took longer than 0.5 s"),
        (VERSION + "exit 0", "wrote no library"),
        (VERSION + OUT + ': > "$2"', "wrote no library"),
        (VERSION + OUT + 'mkfifo "$2"', "wrote no library"),
        (VERSION + OUT + 'mkdir "$2"', "wrote no library"),
        (VERSION + OUT + 'ln -s /dev/zero "$2"', "wrote no library"),
        (VERSION + OUT + 'echo nonsense > "$2"', "cannot be loaded"),
        (VERSION + OUT + 'cp "$WITHOUT" "$2"', "has no function answer"),
    ],
    ids=[
        "fails",
        "says_why",
        "hangs",
        "leaves_a_child",
        "never_ends",
        "killed",
        "garbage",
        "babbles",
        "nothing",
        "empty",
        "fifo",
        "folder",
        "device",
        "nonsense",
        "other_functions",
    ],
)
def test_a_compiler_that_does_not_do_its_work_is_said(fresh, tmp_path, monkeypatch, text, says):  # noqa: F811
    monkeypatch.setattr(libraries, "SECONDS", 0.5)
    monkeypatch.setattr(libraries, "ANSWERS", 0.5)
    monkeypatch.setenv("WITHOUT", str(built(tmp_path, "int other(void) { return 1; }\n")))
    monkeypatch.setenv("CC", written(tmp_path / "mine", text))
    for _ in range(2):
        with pytest.raises(CompilerError) as refused:
            answer()
        assert says in str(refused.value)
        assert "\n" not in str(refused.value)
    assert str(refused.value).isprintable()
    assert not fresh.exists() or list(fresh.iterdir()) == []


def test_a_compiler_that_does_not_answer_is_asked_once(fresh, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.setattr(libraries, "ANSWERS", 0.2)
    monkeypatch.setenv("CC", written(tmp_path / "mine", f"echo . >> {tmp_path}/asked\nsleep 60"))
    for _ in range(3):
        with pytest.raises(CompilerError):
            answer()
    assert (tmp_path / "asked").read_text() == ".\n"


def test_what_a_compiler_started_ends_with_it(fresh, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.setattr(libraries, "ANSWERS", 0.5)
    monkeypatch.setenv("CC", written(tmp_path / "mine", f"sleep 60 & echo $! > {tmp_path}/pid\nwait"))
    with pytest.raises(CompilerError, match="no answer"):
        answer()
    assert within(5, lambda: not alive(int((tmp_path / "pid").read_text())))


@pytest.mark.parametrize("given", ["fifo", "folder", "nowhere", "'open", "  "])
def test_what_is_no_compiler_is_said(fresh, tmp_path, monkeypatch, given):  # noqa: F811
    os.mkfifo(tmp_path / "fifo", 0o777)
    (tmp_path / "folder").mkdir()
    monkeypatch.setenv("CC", str(tmp_path / given) if given in ("fifo", "folder") else given)
    if given == "  ":
        assert answer() == 7
        return
    with pytest.raises(CompilerError, match=r"no C compiler found|does not run \(PermissionError\)"):
        answer()


def test_a_compiler_behind_another_program_or_in_a_folder_with_a_space(fresh, tmp_path, monkeypatch):  # noqa: F811
    before = written(tmp_path / "before", 'exec "$@"')
    for given in (f"{before} {GCC}", f"{before} {GCC} -g", f"env {GCC}"):
        monkeypatch.setenv("CC", given)
        assert answer() == 7
    (tmp_path / "a b").mkdir()
    monkeypatch.setenv("CC", written(tmp_path / "a b" / "cc", f'exec {GCC} "$@"'))
    assert answer() == 7
    assert len(libraries_in(fresh)) == 4, "each is another compiler"


def test_a_compiler_with_an_odd_version_is_used(fresh, tmp_path, monkeypatch):  # noqa: F811
    odd = f'case "$*" in *--version*) printf \'\\377\\n\\033\'; exit 0 ;; esac\nexec {GCC} "$@"'
    monkeypatch.setenv("CC", written(tmp_path / "odd", odd))
    assert answer() == 7
    silent = f'case "$*" in *--version*) exit 0 ;; esac\nexec {GCC} "$@"'
    monkeypatch.setenv("CC", written(tmp_path / "silent", silent))
    assert answer() == 7


@pytest.mark.parametrize(
    "text", [VERSION + OUT + 'cp "$WITHOUT" "$2"', VERSION + OUT + 'echo nonsense > "$2"', "exit 1"]
)
def test_then_blocks_serve_and_one_sentence_says_why(hsr, fresh, tmp_path, monkeypatch, caplog, text):  # noqa: F811
    monkeypatch.setenv("WITHOUT", str(built(tmp_path, "int residual(void) { return 1; }\n")))
    monkeypatch.setenv("CC", written(tmp_path / "mine", text))
    with caplog.at_level(logging.WARNING, "casacal"):
        assert kernels(hsr).name == "blocks"
        assert kernels(hsr).name == "blocks"
    (said,) = {record.getMessage() for record in caplog.records}
    assert said.startswith("casacal: no C kernels (")
    assert said.endswith("); using blocks, which are slower")


def test_a_library_that_loads_no_more_is_compiled_anew(counted, monkeypatch):
    """As after an update of what it was linked with."""
    compiled = counted[1]
    answer()
    real, failing = ctypes.CDLL, ["once"]

    def load(path):
        if failing.pop() if failing else None:
            raise OSError("libgomp.so.1: cannot open shared object file")
        return real(path)

    monkeypatch.setattr(libraries.ctypes, "CDLL", load)
    assert answer() == 7
    assert compiled() == 2


def test_a_library_of_another_compiler_is_built_anew(monkeypatch, tmp_path):
    monkeypatch.setenv("CASACAL_CACHE", str(tmp_path / "cache"))
    chosen, built = libraries.compiler(), []
    for version in ("1.0", "1.0", "2.0"):
        monkeypatch.setattr(libraries, "compiler", lambda v=version: dataclasses.replace(chosen, version=v))
        libraries.load_library("int answer(void) { return 7; }\n", ("answer",))
        built.append(len(list((tmp_path / "cache").glob(f"*{libraries.SUFFIX}"))))
    assert built == [1, 1, 2]
