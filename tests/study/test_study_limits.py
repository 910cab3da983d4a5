"""Methods that hang, crash, end their process or change what others see: records of their own, and the rest goes on."""

import json
import os
import random
import re
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import hostile_study
import numpy as np
import pytest
import tiny_study
from conftest import ROOT
from hears_signals import hears_signals
from test_study import alive, count_lines, within

from casacal.cli.main import main
from casacal.errors import StudyError
from casacal.study import Study
from casacal.study.description import LIMIT, merged, read_records, to_line
from casacal.study.runs import RECORDS, open_run, run
from casacal.study.study_file import load_study
from casacal.study.trial import Task, perform

HOSTILE = ROOT / "tests" / "hostile_study.py"
ENDED = "Ended: the process of the trial "
SAYS = {
    "leaves": ENDED + "came to an end with exit code 3",
    "crashes": ENDED + "was killed by SIGSEGV",
    "interrupts": "KeyboardInterrupt: no message",
    "hangs": "TimeLimit: no answer within 1.5 s",
    "exits": "SystemExit: enough",
    "wanders": None,
    "spoils": "Changed: the method changed the problem that all share",
    "appends": None,
    "lm": None,
    "draws": None,
}


@pytest.fixture(scope="module")
def calm(tmp_path_factory):
    """What the methods that behave find when no other is about."""
    study = Study("hostile", hostile_study.study.settings, hostile_study.CALM, trials=2)
    return run(study, tmp_path_factory.mktemp("calm"))


def found_by(made, names):
    return {(r["method"], r["trial"]): (r["error"], r["figures"]) for r in made.records if r["method"] in names}


def lone(method, **options):
    return Study("lone", {"one": tiny_study.Linear()}, {"m": method}, trials=1, **options)


@pytest.mark.long
def test_every_way_to_fail_is_a_record_and_the_others_go_on(calm, tmp_path):
    made = run(hostile_study.study, tmp_path / "two", file=HOSTILE, timeout=1.5, workers=2)
    assert {(r["method"], r["trial"]): r["error"] for r in made.records} == {
        (method, trial): said for method, said in SAYS.items() for trial in range(2)
    }
    assert found_by(made, hostile_study.CALM) == found_by(calm, hostile_study.CALM)
    assert [r[LIMIT] for r in made.of("one", "hangs")] == [1.5, 1.5]
    assert not any(LIMIT in r for r in made.records if r["method"] != "hangs")
    assert made.values("one", "wanders", "cost").tolist() == made.values("one", "lm", "cost").tolist()
    assert made.values("one", "leaves", "solve", group="seconds").size == 2
    # all is recorded, so that nothing runs again, here or in processes
    assert run(hostile_study.study, tmp_path / "two", file=HOSTILE, resume=True).digest == made.digest
    assert run(hostile_study.study, tmp_path / "two", file=HOSTILE, timeout=1.5, resume=True).digest == made.digest


def test_in_one_process_nothing_is_left_of_what_a_method_did(calm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TINY", raising=False)
    handling, drawn = np.geterr(), random.getstate()
    made = run(hostile_study.quick, Path("out"))
    assert found_by(made, hostile_study.CALM) == found_by(calm, hostile_study.CALM)
    assert {r["method"]: r["error"] for r in made.records} == {name: SAYS[name] for name in made.study.methods}
    assert (Path.cwd(), np.geterr(), random.getstate()) == (tmp_path, handling, drawn)
    assert "TINY" not in os.environ
    assert warnings.filters[0][0] == "error"
    assert count_lines(tmp_path / "out" / RECORDS) == len(made.records) == 12
    assert hostile_study.RUDE["appends"].options == {"steps": []}


@pytest.mark.long
def test_a_process_for_each_trial_makes_the_same_records(tmp_path):
    few = Study("tiny", tiny_study.study.settings, tiny_study.METHODS, trials=2, details=2)
    here = run(few, tmp_path / "here")
    assert run(few, tmp_path / "apart", timeout=60, workers=2).digest == here.digest
    assert [list(r) for r in read_records(tmp_path / "apart" / RECORDS)] == [list(r) for r in here.records]


@pytest.mark.long
def test_what_a_short_limit_ended_is_tried_again_with_a_longer_one(tmp_path, monkeypatch):
    slow = tmp_path / "slow_study.py"
    slow.write_text(
        "import time\nfrom tiny_study import Linear\nfrom casacal import lm\nfrom casacal.study import Study\n"
        "def slow(problem):\n    open('slow', 'a').write('x')\n    time.sleep(0.8)\n    return lm(problem)\n"
        "def broken(problem):\n    open('ran', 'a').write('x')\n    raise ZeroDivisionError\n"
        "study = Study('slow', {'one': Linear()}, {'slow': slow, 'broken': broken}, trials=1)\n"
        "def report(run):\n    return [str(r['error']) for r in run.records]\n"
    )
    monkeypatch.chdir(tmp_path)

    def told(*words):
        assert main(["study", str(slow), "--out", "out", "--timeout", *words]) == 0
        return [r["error"] for r in read_records(tmp_path / "out" / RECORDS)]

    assert told("0.3") == ["TimeLimit: no answer within 0.3 s", "ZeroDivisionError: no message"]
    for seconds in ("0.2", "0.3"):
        assert told(seconds, "--resume") == ["TimeLimit: no answer within 0.3 s", "ZeroDivisionError: no message"]
    assert (tmp_path / "slow").read_text() == "x", "no longer time, no other try"
    assert told("30", "--resume") == [None, "ZeroDivisionError: no message"]
    assert (tmp_path / "ran").read_text() == "x", "other failures are not tried again"
    assert count_lines(tmp_path / "out" / RECORDS) == 2
    report = (tmp_path / "out" / "report.md").read_text()
    assert "TimeLimit" not in report
    assert "ZeroDivisionError" in report


def test_what_had_more_time_stands(tmp_path):
    head = {"setting": "s", "method": "m", "trial": 0, "fingerprint": "key"}
    short, long = {**head, LIMIT: 1.0, "error": "TimeLimit"}, {**head, LIMIT: 2.0, "error": "TimeLimit"}
    done = {**head, "error": None}
    for records, stands in (((short, long), long), ((long, short), long), ((short, done), done), ((done, long), done)):
        assert merged([records]) == [stands]
    with pytest.raises(StudyError, match="Two records of setting 's', method 'm', trial 0 differ"):
        merged([[done, {**done, "error": "other"}]])


@pytest.mark.long
def test_a_trial_that_cannot_be_made_in_time_fails_every_method_at_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "stuck_study.py"
    file.write_text(
        "import os, time\nfrom casacal import lm, ekf\nfrom casacal.study import Study\n"
        "class Stuck:\n    def trial(self, seed):\n        time.sleep(60)\n"
        "class Gone:\n    def trial(self, seed):\n        open('tried', 'a').write('x')\n        os._exit(4)\n"
        "study = Study('stuck', {'stuck': Stuck(), 'gone': Gone()}, {'a': lm, 'b': ekf}, trials=1)\n"
        "def report(run):\n    return []\n"
    )
    made = run(load_study(file).study, tmp_path / "out", file=file, timeout=0.3)
    assert [r["error"] for r in made.of("stuck", "a") + made.of("stuck", "b")] == [
        "TimeLimit: no answer within 0.3 s"
    ] * 2
    assert [r["error"] for r in made.of("gone", "a") + made.of("gone", "b")] == [
        ENDED + "came to an end with exit code 4"
    ] * 2
    assert (tmp_path / "tried").read_text() == "x"


@pytest.mark.long
def test_what_a_method_started_ends_with_it(tmp_path, monkeypatch):
    monkeypatch.setenv("NOTE", str(tmp_path / "pid"))
    made = run(lone(hostile_study.starts_others), tmp_path / "out", timeout=2)
    assert made.failures("one", "m") == ["TimeLimit: no answer within 2 s"]
    assert within(5, lambda: not alive(int((tmp_path / "pid").read_text())))


@pytest.mark.long
@pytest.mark.skipif(os.name == "nt", reason="signals of Unix")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_run_leaves_no_process_and_goes_on(tmp_path, how):
    file = tmp_path / "napping_study.py"
    file.write_text(
        "import os, time\nfrom pathlib import Path\nfrom tiny_study import Linear\n"
        "from casacal import lm\nfrom casacal.study import Study\n"
        "def naps(problem):\n    Path('pid').write_text(str(os.getpid()))\n"
        "    time.sleep(0 if Path('awake').exists() else 60)\n    return lm(problem)\n"
        "study = Study('napping', {'one': Linear()}, {'lm': lm, 'naps': naps}, trials=1)\n"
        "def report(run):\n    return [str(r['error']) for r in run.records]\n"
    )
    command = [sys.executable, "-m", "casacal", "study", str(file), "--out", "out", "--timeout", "50", "--resume"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    process = subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL,
                               stderr=subprocess.PIPE, text=True, preexec_fn=hears_signals)  # fmt: skip
    note = tmp_path / "pid"
    assert within(30, lambda: note.is_file() and note.read_text())
    process.send_signal(how)
    said = process.communicate(timeout=30)[1]
    assert process.returncode == (130 if how == signal.SIGINT else -signal.SIGKILL)
    assert "Traceback" not in said
    assert within(10, lambda: not alive(int(note.read_text())))
    (tmp_path / "awake").touch()
    assert subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True).returncode == 0
    assert [r["error"] for r in read_records(tmp_path / "out" / RECORDS)] == [None, None]


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf")])
def test_a_limit_that_is_none_is_refused(tmp_path, seconds):
    with pytest.raises(StudyError, match="Give seconds above zero"):
        run(tiny_study.study, tmp_path / "out", timeout=seconds)
    assert not (tmp_path / "out").exists()


def test_limits_need_processes_of_this_machine_that_know_the_study(tmp_path):
    with pytest.raises(StudyError, match="let local processes do the work"):
        run(tiny_study.study, tmp_path, timeout=1.0, scheduler="tcp://127.0.0.1:9")
    with pytest.raises(StudyError, match="cannot be given to workers"):
        run(lone(lambda problem: problem.x0), tmp_path, timeout=1.0)
    file = tmp_path / "other_study.py"
    file.write_text("from tiny_study import Linear\nfrom casacal import ekf\nfrom casacal.study import Study\n"
                    "study = Study('lone', {'one': Linear()}, {'m': ekf}, trials=1)\n"
                    "def report(run):\n    return []\n")  # fmt: skip
    with pytest.raises(Exception, match="A worker has another study file"):
        run(lone(hostile_study.lm), tmp_path / "out", file=file, timeout=5.0)


@pytest.fixture
def recorded(tmp_path):
    run(tiny_study.quick, tmp_path / "out", file=ROOT / "tests" / "tiny_study.py")
    return tmp_path / "out"


def changed(path, number, old, new):
    lines = path.read_text().splitlines(keepends=True)
    assert re.search(old, lines[number - 1])
    lines[number - 1] = re.sub(old, new, lines[number - 1], count=1)
    path.write_text("".join(lines))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (r'"cost":\d', '"cost":9'),
        (r'"trial":1', '"trial":0'),
        (r'"solve":0\.', '"solve":1.'),
        (r',"check":"[0-9a-f]+"', ""),
        (r'"check":"..', '"check":"zz'),
    ],
)
def test_a_damaged_record_is_named_and_never_used(recorded, capsys, old, new):
    changed(recorded / RECORDS, 7, old, new)
    for attempt in (
        lambda: run(tiny_study.quick, recorded, resume=True),
        lambda: open_run(tiny_study.quick, recorded),
    ):
        with pytest.raises(StudyError, match=r"Line 7 of '.*' is damaged: .*method 'lm'"):
            attempt()
    assert main(["study", str(ROOT / "tests" / "tiny_study.py"), "--quick", "--out", str(recorded), "--report"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_record_removed_is_made_again(recorded):
    whole = open_run(tiny_study.quick, recorded).digest
    changed(recorded / RECORDS, 7, "(?s).*", "")
    assert run(tiny_study.quick, recorded, resume=True).digest == whole


def test_two_records_of_one_key_that_differ_are_refused(recorded):
    record = read_records(recorded / RECORDS)[0]
    with (recorded / RECORDS).open("a") as file:
        file.write(to_line({**record, "figures": {**record["figures"], "cost": 1.0}}))
    for attempt in (
        lambda: run(tiny_study.quick, recorded, resume=True),
        lambda: open_run(tiny_study.quick, recorded),
    ):
        with pytest.raises(StudyError, match="Two records of setting 'one', method 'lm', trial 0 differ"):
            attempt()


def test_records_from_before_there_were_checksums_are_read(recorded):
    path = recorded / RECORDS
    whole = read_records(path)
    path.write_text(re.sub(r',"check":"[0-9a-f]{16}"', "", path.read_text()))
    assert "check" not in json.loads(path.read_text().splitlines()[0])
    assert read_records(path) == whole
    path.write_text(path.read_text() + "[1]\n")
    with pytest.raises(StudyError, match="is not a record"):
        read_records(path)


def test_without_a_process_of_its_own_only_an_interruption_ends_a_study():
    (record,) = perform(lone(hostile_study.exits), Task("one", 0, ("m",), ("key",)))
    assert record["error"] == "SystemExit: enough"
    with pytest.raises(KeyboardInterrupt):  # which may be the user's, where a keyboard reaches the process
        perform(lone(hostile_study.interrupts), Task("one", 0, ("m",), ("key",)))
