"""What is written is whole, of one run, where it was asked for, and never over what was read."""

import json
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest
from conftest import ROOT
from hears_signals import hears_signals

from casacal import CasacalError
from casacal.calibration.calibrated import FILES
from casacal.cli.main import heard, main
from casacal.files import PREFIX, check_writable, mark_of_this_run, side_by_side, together, write_text

HSR = ROOT / "problems" / "hsr_jr680"
KILLS = int(os.environ.get("CASACAL_KILLS", "2"))
"""Kills of each kind; a hundred were run once."""
WRITER = """
import sys
from pathlib import Path
from casacal import calibrate
made = {seed: calibrate(sys.argv[1], method="lm", reference=False, holdout=0.3, seed=seed) for seed in (1, 2)}
print("ready", flush=True)
while True:
    for calibration in made.values():
        calibration.save(sys.argv[2])
"""


def marks_of(folder):
    """Which run each file of a folder is of, as far as it tells: seeds, by the held-out rows' figures."""
    found = {}
    if (folder / "result.json").exists():
        found["result.json"] = json.loads((folder / "result.json").read_text())["seed"]
    if (folder / "report.html").exists():
        page = re.sub(r"<[^>]*>", " ", (folder / "report.html").read_text())
        found["report.html"] = int(re.search(r"\bSeed\s+(\d)", page)[1])
    return found


def stop(process, number):
    """Send a signal until it ends a process: Python may swallow one that comes while it tidies up."""
    for _ in range(60):
        process.send_signal(number)
        try:
            process.communicate(timeout=1)
        except subprocess.TimeoutExpired:
            continue
        return
    raise AssertionError("it does not end")


@pytest.mark.long
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("kind", ["SIGINT", "SIGKILL", "SIGTERM"])
def test_a_run_that_is_stopped_leaves_files_of_one_run(kind, tmp_path):
    """Two results take turns in one folder, and the writer is stopped at any moment."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    seen = set()
    for k in range(KILLS):
        out = tmp_path / "out"
        writer = subprocess.Popen([sys.executable, "-c", WRITER, str(HSR), str(out)], stdout=subprocess.PIPE,
                                  stderr=subprocess.DEVNULL, env=environment, preexec_fn=hears_signals)  # fmt: skip
        assert writer.stdout.readline() == b"ready\n"
        time.sleep(0.05 + (k * 0.37) % 1.9)
        stop(writer, getattr(signal, kind))
        names = {path.name for path in out.iterdir()} if out.exists() else set()
        visible = {name for name in names if not name.startswith(".")}
        assert visible <= set(FILES)
        if "result.json" in visible:
            assert visible == set(FILES)
        if kind == "SIGINT":  # the others leave Python no time to tidy up
            assert names == visible
        tables = {path.read_bytes() for path in (out / "parameters.csv",) if path.exists()}
        seen |= tables
        found = marks_of(out)
        assert len(set(found.values())) <= 1, found
        if tables and "result.json" in found:
            rows = json.loads((out / "result.json").read_text())["parameters"]
            line = next(iter(tables)).decode().splitlines()[2].split(",")
            assert float(line[3]) == pytest.approx(rows[0]["estimate"], rel=1e-11)
    assert main(["calibrate", str(HSR), "--method", "lm", "--no-reference", "--out", str(tmp_path / "out")]) == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == set(FILES)  # leftovers are swept


def test_all_files_take_their_places_or_none(tmp_path):
    old = "# written by casacal 0.1.0, old"
    (tmp_path / "a").write_text(old)
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(CasacalError, match="No space left"):
        fill_the_disk(tmp_path)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a": old, "mine": "mine"}
    with together(tmp_path, ["c", "a", "b"]) as place:
        (place / "b").write_text("new")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"b": "new", "mine": "mine"}
    with pytest.raises(ZeroDivisionError), together(tmp_path / "deep" / "er", ["a"]):
        raise ZeroDivisionError
    assert not (tmp_path / "deep" / "er").exists()


@pytest.mark.skipif(os.name == "nt", reason="devices of POSIX")
def test_a_file_may_be_a_pipe():
    code = "from casacal.files import write_text; write_text('/dev/stdout', 'all of it')"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, env=environment, check=True)
    assert ran.stdout == b"all of it"


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="a folder where even root may not write")
@pytest.mark.parametrize(("command", "name"), [("calibrate", "/proc/x"), ("simulate", "/proc/x.csv")])
def test_a_place_that_cannot_be_written_is_named_and_before_a_fit(command, name, capsys):
    assert main([command, str(HSR), "--out", name]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith(f"casacal: '{name}' cannot be written (")


def test_trying_whether_a_folder_can_be_written_leaves_nothing(tmp_path):
    check_writable(tmp_path / "deep" / "er")
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("mine")
    with pytest.raises(CasacalError, match=r"'.*file.er' cannot be written"):
        check_writable(tmp_path / "file" / "er")


def test_a_signal_waits_until_all_files_are_placed(tmp_path, monkeypatch):
    moves, move = [], shutil.move

    def slowly(source, target):
        moves.append(target.name)
        if len(moves) == 1:
            signal.raise_signal(signal.SIGINT)
        move(source, target)

    monkeypatch.setattr(shutil, "move", slowly)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # whatever started these tests may ignore it
    with pytest.raises(KeyboardInterrupt):
        write_pair(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x.csv", "x.json"]
    assert signal.signal(signal.SIGINT, before) is signal.default_int_handler
    place_in_thread = []
    thread = threading.Thread(target=lambda: place_in_thread.append(write_set(tmp_path / "t")))
    thread.start()
    thread.join()
    assert (tmp_path / "t" / "a").exists()


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("goes_on", [5.0, 0.0])
def test_an_interrupt_that_something_swallows_still_ends_the_run(goes_on):
    """It comes again while the run goes on, not while it tidies up, and at the end of a run that was quicker."""
    seen = []

    def run():
        with suppress(KeyboardInterrupt):
            try:
                signal.raise_signal(signal.SIGINT)
            finally:
                time.sleep(0.15 if goes_on else 0.0)  # so that it would come again while this tidies up
        with suppress(KeyboardInterrupt):
            time.sleep(goes_on)
        try:
            time.sleep(goes_on)
            seen.append("went on")
        finally:
            time.sleep(0.3 if goes_on else 0.0)
            seen.append("tidied up")
        return 0

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # whatever started these tests may ignore it
    alarm = signal.getsignal(signal.SIGALRM)
    with pytest.raises(KeyboardInterrupt):
        heard(run)
    assert seen == (["tidied up"] if goes_on else ["went on", "tidied up"])
    assert signal.signal(signal.SIGINT, before) is signal.default_int_handler
    assert signal.getsignal(signal.SIGALRM) is alarm
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("ends", [True, False])
def test_an_alarm_that_is_due_as_the_run_ends_leaves_none_behind(monkeypatch, ends):
    """Left armed, it would end the process without a word: SIGALRM kills where nobody handles it."""
    arm, late = signal.setitimer, []

    def disarm_late(timer, seconds, interval=0.0):
        arm(timer, seconds, interval)
        if seconds == 0:
            late.append(signal.raise_signal(signal.SIGALRM))

    def run():
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        if ends:
            raise KeyboardInterrupt
        return 0

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(signal, "setitimer", disarm_late)
    with pytest.raises(KeyboardInterrupt):
        heard(run)
    assert late == [None]
    assert signal.signal(signal.SIGINT, before) is signal.default_int_handler
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def fill_the_disk(folder):
    with together(folder, ["a", "b"]) as place:
        (place / "a").write_text("new")
        raise OSError(28, "No space left on device")


def test_a_full_disk_is_said_of_the_file_that_was_asked_for(tmp_path, monkeypatch):
    """Not of the place aside where it is written first."""

    def full(*_):
        raise OSError(28, "No space left on device")

    with together(tmp_path, ["report.html"]) as place:
        monkeypatch.setattr(os, "replace", full)
        with pytest.raises(CasacalError) as said:
            write_text(place / "report.html", "new")
    assert said.value.what == f"'{tmp_path / 'report.html'}' cannot be written (No space left on device)"


def write_pair(folder):
    with side_by_side([folder / "x.csv", folder / "x.json"]) as places:
        for place in places:
            place.write_text("new")


def write_set(folder):
    with together(folder, ["a"]) as place:
        (place / "a").write_text("a")


@pytest.mark.skipif(os.name == "nt", reason="locks of POSIX")
def test_a_run_that_is_turned_away_leaves_the_others_folder_alone(tmp_path, monkeypatch):
    """The folder comes into being, with another run's file in it, between the look for it and the lock."""
    made, mkdir = tmp_path / "out", Path.mkdir

    def beaten(path, *given, **options):
        mkdir(path, *given, **options)
        (path / "theirs").write_text("theirs")
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(Path, "mkdir", beaten)
    with pytest.raises(CasacalError, match="cannot be written"):
        write_set(made)
    assert (made / "theirs").read_text() == "theirs"


@pytest.mark.long
@pytest.mark.skipif(os.name == "nt", reason="locks of POSIX")
def test_two_runs_on_one_folder_meet_a_sentence(tmp_path, capsys):
    with together(tmp_path, ["a"]):
        assert main(["calibrate", str(HSR), "--method", "lm", "--no-reference", "--out", str(tmp_path)]) == 2
        assert "Another run is writing into" in capsys.readouterr().err
    assert main(["calibrate", str(HSR), "--method", "lm", "--no-reference", "--out", str(tmp_path)]) == 0


def test_leftovers_of_runs_that_ended_are_swept_and_others_are_not(tmp_path):
    mark = mark_of_this_run()
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    gone, kept = mark.rpartition("-")[0] + f"-{dead.pid}", mark
    for name in (f"{PREFIX}{gone}-x", f"{PREFIX}{kept}-y", f"{PREFIX}someone-1-z"):
        (tmp_path / name).mkdir()
    (tmp_path / f".a.csv.{gone}-x.csv").write_text("left")
    (tmp_path / f".b.csv.{gone}-x.csv").write_text("of another file")
    write_set(tmp_path)
    write_text(tmp_path / "a.csv", "new")
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"a", "a.csv", f"{PREFIX}{kept}-y", f"{PREFIX}someone-1-z", f".b.csv.{gone}-x.csv"}


@pytest.mark.skipif(os.name == "nt", reason="modes of POSIX")
def test_modes_are_the_users_and_links_are_followed(tmp_path):
    before = os.umask(0o027)
    try:
        write_text(tmp_path / "new.csv", "# written by casacal 0.1.0, 1")
        write_set(tmp_path / "set")
    finally:
        os.umask(before)
    for path in (tmp_path / "new.csv", tmp_path / "set" / "a"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o640
    (tmp_path / "new.csv").chmod(0o604)
    write_text(tmp_path / "new.csv", "2")
    assert stat.S_IMODE((tmp_path / "new.csv").stat().st_mode) == 0o604
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "set" / "a").unlink()
    (tmp_path / "set" / "a").symlink_to(tmp_path / "elsewhere" / "real")
    (tmp_path / "elsewhere" / "real").write_text("# written by casacal 0.1.0, old")
    write_set(tmp_path / "set")
    assert (tmp_path / "set" / "a").is_symlink()
    assert (tmp_path / "elsewhere" / "real").read_text() == "a"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A problem, a result of it that names its files by where they stand from there, and joints."""
    place = tmp_path_factory.mktemp("made")
    shutil.copytree(HSR, place / "p")
    assert main(["calibrate", str(place / "p"), "--method", "lm", "--no-reference", "--out", str(place / "o")]) == 0
    (place / "q.csv").write_text((HSR / "samples.csv").read_text())
    (place / "mine.csv").write_text((HSR / "samples.csv").read_text().partition("\n")[2])  # as if measured
    return place


@pytest.fixture
def result(made, tmp_path):
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    return tmp_path / "o" / "result.json"


@pytest.mark.parametrize(
    "typed",
    [
        ["predict", "o/result.json", "q.csv", "--out", "q.csv"],
        ["predict", "o/result.json", "q.csv", "--out", "o/../o/result.json"],
        ["compensate", "o/result.json", "q.csv", "--out", "q.csv"],
        ["export", "o/result.json", "--to", "dh", "--out", "o/result.json"],
        ["export", "o/result.json", "--to", "urdf", "--source", "q.csv", "--out", "q.csv"],
        ["calibrate", "p", "o/parameters.csv", "--out", "o"],
        ["simulate", "p", "--out", "mine.csv"],
        ["simulate", "p", "--out", "p/problem.py"],
        ["simulate", "p", "--out", "link.csv"],
        ["compensate", "o", "q.csv", "--out", "o/result.json"],
        ["predict", "o", "q.csv", "--out", "mine.csv"],
        ["export", "o", "--to", "dh", "--out", "p/problem.py"],
        ["export", "o", "--to", "dh", "--out", "tool.py"],
        ["plan", "p", "--out", "touched.csv"],
        ["plan", "p", "--out", "new.csv", "--sheet", "mine.csv"],
        ["verify", "o", "q.csv", "--report", "mine.csv"],
        ["changed", "o", "q.csv", "--touches", "touched.csv"],
    ],
    ids=" ".join,
)
def test_nothing_is_written_over_what_is_read(typed, result, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link.csv").symlink_to(tmp_path / "p" / "problem.py")
    (tmp_path / "tool.py").write_text("print('mine')")
    (tmp_path / "touched.csv").write_text("# measured by casacal: p, plan 0\nq1_deg,x_mm\n1,2\n")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert main(typed) == 2
    said = capsys.readouterr().err
    assert any(
        why in said
        for why in ("is what the command reads", "was not written by casacal", "measured rows", "does not end in .csv")
    )
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_what_casacal_planned_or_simulated_may_be_written_over(result, tmp_path):
    assert main(["simulate", str(HSR), "--out", str(tmp_path / "s.csv"), "--samples", "40"]) == 0
    plan = f"# planned by casacal for p: not a measurement\n{(tmp_path / 'mine.csv').read_text()}".replace(
        "reading_mm", "expected_reading_mm"
    )
    (tmp_path / "plan.csv").write_text(plan)
    for name in ("s.csv", "plan.csv"):
        assert main(["predict", str(result), str(tmp_path / "q.csv"), "--out", str(tmp_path / name)]) == 0


def test_simulate_writes_both_files_or_neither(tmp_path, monkeypatch, capsys):
    from casacal.calibration import truth

    def fails(*_, **__):
        raise CasacalError("no truth", "none")

    monkeypatch.setattr(truth, "truth_document", fails)
    assert main(["simulate", str(HSR), "--out", str(tmp_path / "x" / "s.csv")]) == 2
    assert list(tmp_path.iterdir()) in ([], [tmp_path / "x"])
    assert not (tmp_path / "x").exists()
    monkeypatch.undo()
    assert main(["simulate", str(HSR), "--out", str(tmp_path / "x" / "s.csv"), "--samples", "40"]) == 0
    document = json.loads((tmp_path / "x" / "s.truth.json").read_text())
    assert document["data"]["file"] == "s.csv"
    assert sorted(path.name for path in (tmp_path / "x").iterdir()) == ["s.csv", "s.truth.json"]


@pytest.mark.skipif(os.name == "nt", reason="pipes of POSIX")
def test_a_pipe_gets_the_answer_and_stays_a_pipe(result, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    read = []
    thread = threading.Thread(target=lambda: read.append((tmp_path / "pipe").read_text()))
    thread.start()
    assert main(["predict", str(result), str(tmp_path / "q.csv"), "--out", str(tmp_path / "pipe")]) == 0
    thread.join(timeout=10)
    assert read[0].splitlines()[1].startswith("x_mm,y_mm,z_mm")
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)
    assert main(["simulate", str(HSR), "--out", str(tmp_path / "pipe")]) == 2
