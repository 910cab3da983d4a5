"""The harness: the same records whoever makes them, in whatever order, however often it is killed."""

import dataclasses
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tiny_study
from conftest import ROOT

from casacal import lm, sckf, swarm
from casacal.cli.main import main
from casacal.errors import StudyError
from casacal.simulation import Simulated
from casacal.study import Method, Study
from casacal.study.description import appending, merged, read_records, records_digest, to_line
from casacal.study.runs import RECORDS, merge, open_run, run
from casacal.study.trial import Task, perform

TINY = ROOT / "tests" / "tiny_study.py"


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    return run(tiny_study.study, tmp_path_factory.mktemp("serial"), file=TINY)


def without_timings(path):
    return [
        {k: v for k, v in json.loads(line).items() if k not in ("seconds", "check")}
        for line in path.read_text().splitlines()
    ]


def test_every_trial_of_every_method_is_a_record(serial):
    expected = 2 * (5 * 12 + 4)
    assert len(serial.records) == expected
    keys = {(r["setting"], r["method"], r["trial"]) for r in serial.records}
    assert len(keys) == expected
    assert serial.values("one", "lm", "cost").shape == (12,)
    assert serial.values("one", "evolution", "cost").shape == (4,)


def test_a_users_own_estimator_is_one_function_in_a_dict(serial):
    mine, best = serial.values("two", "mine", "cost"), serial.values("two", "lm", "cost")
    assert (mine >= best - 1e-9).all()
    assert np.isfinite(mine).all()
    record = serial.of("two", "mine")[0]
    assert record["status"] == "UNSAID"
    assert record["counts"]["residual_rows"] == 5 * tiny_study.LinearTrial(1).problem.rows
    detail = serial.of("two", "lm")[0]["detail"]["x"]
    seed = tiny_study.study.trial_seed(0)
    np.testing.assert_allclose(detail, lm(tiny_study.LinearTrial(seed).problem).x, rtol=1e-9)


def test_failures_are_rows_with_their_message(serial):
    assert serial.failures("one", "broken") == ["ZeroDivisionError: on purpose"] * 12
    assert np.isnan(serial.values("one", "broken", "cost")).all()
    gone = Study("gone", {"s": tiny_study.Linear(tiny_study.study.trial_seed(1))}, {"lm": lm}, trials=3)
    records = [perform(gone, Task("s", k, ("lm",), ("key",)))[0] for k in range(3)]
    assert [r["error"] for r in records] == [None, "RuntimeError: out of reach", None]


@pytest.mark.parametrize(
    ("estimate", "said"),
    [
        (lambda problem: problem.x0[:-1], "shape"),
        (lambda problem: problem.x0 * np.nan, "not finite"),
        (lambda problem: 1 / 0, "ZeroDivisionError"),
    ],
)
def test_an_estimate_that_is_none_is_a_failure(estimate, said):
    study = Study("s", {"s": tiny_study.Linear()}, {"m": estimate}, trials=1)
    (record,) = perform(study, Task("s", 0, ("m",), ("key",)))
    assert said in record["error"]


@pytest.mark.long
def test_two_workers_make_the_same_records(serial, tmp_path):
    found = run(tiny_study.study, tmp_path, file=TINY, workers=2)
    assert found.digest == serial.digest
    assert without_timings(tmp_path / RECORDS) == without_timings(serial.out / RECORDS)


def test_three_shards_merged_make_the_same_records(serial, tmp_path):
    parts = [tmp_path / f"part{i}" for i in (1, 2, 3)]
    counts = [len(run(tiny_study.study, part, file=TINY, shard=(i + 1, 3)).records) for i, part in enumerate(parts)]
    assert sum(counts) == len(serial.records)
    assert min(counts) > 0
    whole = merge(tiny_study.study, parts[::-1], tmp_path / "whole")
    assert whole.digest == serial.digest
    assert without_timings(tmp_path / "whole" / RECORDS) == without_timings(serial.out / RECORDS)


@pytest.mark.long
@pytest.mark.filterwarnings("default")  # the cluster's own, such as ports in use
def test_a_cluster_of_two_workers_makes_the_same_records(serial, tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), str(ROOT / "tests")]))
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=2, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        found = run(tiny_study.study, tmp_path, file=TINY, scheduler=cluster.scheduler_address)
    assert found.digest == serial.digest
    assert without_timings(tmp_path / RECORDS) == without_timings(serial.out / RECORDS)


def test_no_scheduler_is_said(tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    monkeypatch.setattr("casacal.study.runs.CONNECT_SECONDS", 1)
    with pytest.raises(StudyError, match="No Dask scheduler answers"):
        run(tiny_study.study, tmp_path, file=TINY, scheduler="tcp://127.0.0.1:9")


@pytest.mark.long
def test_a_run_killed_again_and_again_ends_with_the_same_records(serial, tmp_path):
    # slower trials, so that kills fall into the middle
    slow = tmp_path / "tiny_study.py"
    slow.write_text(TINY.read_text().replace("PAUSE = 0.0", "PAUSE = 0.02"))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    command = [sys.executable, "-m", "casacal", "study", str(slow), "--out", str(tmp_path / "out"), "--resume"]
    rng, seen = random.Random(5), []
    for _ in range(5):
        process = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        before = count_lines(tmp_path / "out" / RECORDS)
        goal = before + rng.randint(1, 20)
        deadline = time.monotonic() + 60
        while count_lines(tmp_path / "out" / RECORDS) < goal and time.monotonic() < deadline:
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        process.wait()
        seen.append(count_lines(tmp_path / "out" / RECORDS))
    assert seen == sorted(seen)
    assert 0 < seen[0] < seen[-1] < len(serial.records)
    assert subprocess.run(command, env=environment, capture_output=True, check=False).returncode == 0
    assert open_run(tiny_study.study, tmp_path / "out").digest == serial.digest


@pytest.mark.long
def test_workers_end_with_the_process_that_is_killed(tmp_path):
    (tmp_path / "naps.py").write_text(
        "import os, sys, time\nfrom pathlib import Path\nfrom casacal.study.runs import in_processes\n"
        "def nap(path):\n    Path(path).write_text(str(os.getpid()))\n    time.sleep(60)\n"
        "if __name__ == '__main__':\n    list(in_processes(nap, sys.argv[1:], 2))\n"
    )
    notes = [tmp_path / "one", tmp_path / "two"]
    process = subprocess.Popen([sys.executable, "naps.py", *map(str, notes)], cwd=tmp_path, stderr=subprocess.DEVNULL,
                               env={**os.environ, "PYTHONPATH": str(ROOT)})  # fmt: skip
    assert within(30, lambda: all(note.is_file() and note.read_text() for note in notes))
    pids = [int(note.read_text()) for note in notes]
    process.kill()
    process.wait()
    assert within(10, lambda: not any(map(alive, pids)))


def within(seconds, condition):
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
    return True


def alive(pid):
    try:
        os.kill(pid, 0)
        return Path(f"/proc/{pid}/stat").read_text().split(")")[-1].split()[0] != "Z"
    except FileNotFoundError:
        return Path("/proc").is_dir() is False
    except ProcessLookupError:
        return False


def count_lines(path):
    return path.read_bytes().count(b"\n") if path.is_file() else 0


def test_a_line_cut_short_is_made_again(serial, tmp_path):
    shutil.copytree(serial.out, tmp_path / "out")
    path = tmp_path / "out" / RECORDS
    path.write_bytes(path.read_bytes()[:-40])
    assert len(read_records(path)) == len(serial.records) - 1
    assert run(tiny_study.study, tmp_path / "out", file=TINY, resume=True).digest == serial.digest
    assert count_lines(path) == len(serial.records)


def test_a_damaged_line_is_named(serial, tmp_path):
    lines = (serial.out / RECORDS).read_text().splitlines(keepends=True)
    (tmp_path / RECORDS).write_text("".join([*lines[:3], "{nonsense}\n", *lines[3:]]))
    with pytest.raises(StudyError, match="Line 4 "):
        read_records(tmp_path / RECORDS)


def test_records_are_not_overwritten_without_resume(serial, tmp_path):
    shutil.copytree(serial.out, tmp_path / "out")
    with pytest.raises(StudyError, match="--resume"):
        run(tiny_study.study, tmp_path / "out", file=TINY)
    assert read_records(tmp_path / "out" / RECORDS) == list(serial.records)


def test_records_of_another_version_are_refused(serial, tmp_path):
    shutil.copytree(serial.out, tmp_path / "out")
    methods = {**tiny_study.METHODS, "mine": Method(tiny_study.steepest, {"steps": 6})}
    other = Study("tiny", tiny_study.study.settings, methods, trials=12, details=2)
    with pytest.raises(StudyError, match=r"24 of \d+ records"):
        run(other, tmp_path / "out", resume=True)


def test_more_trials_go_on_from_fewer(serial, tmp_path):
    few = Study("tiny", tiny_study.study.settings, tiny_study.METHODS, trials=5, details=2)
    assert len(run(few, tmp_path, resume=True).records) == 2 * (5 * 5 + 4)
    assert run(tiny_study.study, tmp_path, resume=True).digest == serial.digest
    again = run(few, tmp_path, resume=True)  # and fewer again see only their own
    assert {record["trial"] for record in again.records} == set(range(5))
    assert count_lines(tmp_path / RECORDS) == len(serial.records)


def test_one_writer_a_folder(tmp_path):
    with appending(tmp_path / RECORDS), pytest.raises(StudyError, match="Another run"), appending(tmp_path / RECORDS):
        pass


def test_parts_that_disagree_are_not_merged(serial):
    (first, *rest) = serial.records
    changed = {**first, "figures": {**first["figures"], "cost": 1.0}}
    assert len(merged([serial.records, [{**first, "seconds": {"solve": 9.0}}]])) == len(serial.records)
    with pytest.raises(StudyError, match="differ"):
        merged([[first, *rest], [changed]])
    assert records_digest([changed, *rest]) != serial.digest


def test_gzipped_records_are_read_and_resumed(serial, tmp_path):
    import gzip

    (tmp_path / f"{RECORDS}.gz").write_bytes(gzip.compress((serial.out / RECORDS).read_bytes()))
    assert open_run(tiny_study.study, tmp_path).digest == serial.digest
    assert run(tiny_study.study, tmp_path, resume=True).digest == serial.digest
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / f"{RECORDS}.gz").write_bytes((tmp_path / f"{RECORDS}.gz").read_bytes()[:-30])
    with pytest.raises(StudyError, match="cannot be read"):
        open_run(tiny_study.study, tmp_path / "cut")


def test_numbers_that_are_not_finite_become_null():
    read = json.loads(to_line({"a": float("nan"), "b": [1.0, float("inf")]}))
    assert (read["a"], read["b"]) == (None, [1.0, None])


def test_seeds_depend_on_nothing_but_study_trial_and_method():
    one = Study("a", {"s": tiny_study.Linear()}, {"x": lm, "y": sckf}, trials=3, seed=4)
    other = Study("b", {"t": tiny_study.Linear()}, {"y": sckf}, trials=9, seed=4)
    assert [one.trial_seed(k) for k in range(3)] == [other.trial_seed(k) for k in range(3)]
    assert one.trial_seed(0) == np.random.SeedSequence(4).spawn(1)[0].generate_state(1, np.uint64)[0]
    seeds = {one.trial_seed(k) for k in range(100)} | {one.method_seed(k, m) for k in range(100) for m in ("x", "y")}
    assert len(seeds) == 300


def test_trials_are_paired_and_the_harness_counts(hsr):
    study = Study(
        "pairs",
        {"corner": Simulated(hsr.problem, hsr.cell, samples=40, heldout=10)},
        {"lm": lm, "sckf": sckf, "swarm": Method(swarm, {"budget": 20_000}, seeded=True)},
        trials=2,
        details=2,
    )
    records = [
        r for k in range(2) for r in perform(study, Task("corner", k, tuple(study.methods), tuple(study.methods)))
    ]
    for trial in range(2):
        assert len({r["figures"]["bound_mm"] for r in records if r["trial"] == trial}) == 1
    by_method = {r["method"]: r for r in records if r["trial"] == 1}
    steps = by_method["lm"]["counts"]["steps"]
    made = study.settings["corner"].trial(study.trial_seed(1)).problem
    evaluated = lm(made).residual_rows  # as the method counts itself
    assert by_method["lm"]["counts"] == {"steps": steps, "residual_rows": evaluated, "jacobian_rows": evaluated}
    assert 30 * steps <= evaluated <= 30 * (steps + 1)
    assert by_method["sckf"]["counts"] == {"steps": 30, "residual_rows": 30 * 2 * 33, "jacobian_rows": 0}
    counts = by_method["swarm"]["counts"]
    assert 20_000 - 30 * 65 < counts["residual_rows"] <= 20_000 + 30  # one more evaluation for the curvature
    for record in records:
        costs = [cost for *_, cost in record["trace"]]
        assert costs[-1] == pytest.approx(record["figures"]["cost"], rel=1e-8)
        assert record["seconds"]["solve"] > 0
    assert [cost for *_, cost in by_method["swarm"]["trace"]] == sorted(
        [cost for *_, cost in by_method["swarm"]["trace"]], reverse=True
    )


def test_simulated_trials_are_judged_by_the_truth(hsr):
    trial = Simulated(hsr.problem, hsr.cell, samples=60, heldout=20).trial(3)
    from dataclasses import replace

    result = lm(trial.problem)
    perfect = trial.judge(replace(result, x=trial.truth))
    assert perfect["tip_rms_mm"] < 1e-9
    assert perfect["nees"] < 1e-12
    assert perfect["coverage"] == 1.0
    assert perfect["heldout_rmse_mm"] == pytest.approx(0.01, rel=0.5)
    fitted = trial.judge(result)
    assert fitted["cost"] < perfect["cost"]
    assert 0.05 < fitted["tip_rms_mm"] < 5
    assert fitted["tip_rms_mm"] <= fitted["tip_p95_mm"] <= fitted["tip_max_mm"]


def test_a_study_must_have_parts():
    with pytest.raises(StudyError, match="no setting"):
        Study("s", {}, {"lm": lm})
    with pytest.raises(StudyError, match="is a str"):
        Study("s", {"s": tiny_study.Linear()}, {"lm": "lm"})
    with pytest.raises(StudyError, match="0 trials"):
        Study("s", {"s": tiny_study.Linear()}, {"lm": lm}, trials=0)


def refusal(capsys, *words):
    code = main(["study", *map(str, words)])
    captured = capsys.readouterr()
    assert code == 2
    assert captured.err.count("\n") == 1
    return captured.err


def test_the_command_runs_resumes_and_reports_again(tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["study", str(TINY), "--quick", "--out", str(out)]) == 0
    said = capsys.readouterr()
    digest = re.search(r"SHA-256 without timings ([0-9a-f]{64})", said.out)[1]
    assert "12 of 12 records" in said.err
    report = (out / "report.md").read_bytes()
    assert digest[:16].encode() in report
    assert "--resume" in refusal(capsys, TINY, "--quick", "--out", out)
    assert main(["study", str(TINY), "--quick", "--out", str(out), "--resume"]) == 0
    assert main(["study", str(TINY), "--quick", "--out", str(out), "--report"]) == 0
    assert (out / "report.md").read_bytes() == report
    assert str(tmp_path) not in report.decode()
    assert len(json.loads((out / "machines.json").read_text())["machines"]) == 1


def test_shards_and_merge_from_the_command_line(serial, tmp_path, capsys):
    parts = [str(tmp_path / f"part{i}") for i in (1, 2)]
    for i, part in enumerate(parts):
        assert main(["study", str(TINY), "--shard", f"{i + 1}/2", "--out", part]) == 0
    assert main(["study", str(TINY), "--merge", *parts, "--out", str(tmp_path / "whole")]) == 0
    assert serial.digest in capsys.readouterr().out
    assert main(["study", str(TINY), "--merge", parts[0], "--out", str(tmp_path / "half")]) == 0
    assert "records are missing" in capsys.readouterr().err
    assert "Add --resume" in refusal(capsys, TINY, "--merge", parts[1], "--out", tmp_path / "half")
    assert main(["study", str(TINY), "--merge", parts[1], "--out", str(tmp_path / "half"), "--resume"]) == 0
    assert serial.digest in capsys.readouterr().out
    for both in (["--report", "--shard", "1/2"], ["--merge", parts[0], "--shard", "1/2"]):
        assert "Give one of them" in refusal(capsys, TINY, *both, "--out", tmp_path / "whole")


def test_advice_names_the_study_as_it_can_be_found_from_here(tmp_path, monkeypatch, capsys):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "small.py").write_text(TINY.read_text())
    monkeypatch.chdir(tmp_path)
    assert main(["study", "mine/small.py", "--shard", "1/2", "--out", "part"]) == 0
    assert "casacal study mine/small.py --merge DIR DIR" in capsys.readouterr().out.replace("\n", " ")


def test_what_cannot_be_run_is_refused_in_one_line(tmp_path, capsys):
    assert "no study at" in refusal(capsys, tmp_path / "none.py")
    assert "not I/N" in refusal(capsys, TINY, "--shard", "4/3", "--out", tmp_path / "a")
    assert "no record" in refusal(capsys, TINY, "--report", "--out", tmp_path / "b")
    assert "holds no records" in refusal(capsys, TINY, "--merge", tmp_path / "b", "--out", tmp_path / "c")
    assert "0 trials" in refusal(capsys, TINY, "--trials", "0", "--out", tmp_path / "d")
    assert "0 workers" in refusal(capsys, TINY, "--workers", "0", "--out", tmp_path / "e")
    bad = tmp_path / "bad_study.py"
    bad.write_text("study = 3\n")
    assert "defines no report" in refusal(capsys, bad)
    bad.write_text("x = 1\nraise ValueError('on line two')\n")
    assert "line 2: ValueError: on line two" in refusal(capsys, bad)
    bad.write_text("def report(run):\n    return run.nothing\n")
    assert "line 2: AttributeError" in refusal(capsys, bad, "--out", tmp_path / "f")
    assert not (tmp_path / "f" / "report.md").exists()


def test_a_study_that_cannot_run_here_says_so(tmp_path, capsys):
    (tmp_path / "absent_study.py").write_text("skipped = 'no data'\n\n\ndef report(run):\n    return []\n")
    assert main(["study", str(tmp_path / "absent_study.py"), "--out", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out == "Skipped: no data\n"
    assert not (tmp_path / "out").exists()


def test_without_flock_a_lock_of_windows_is_taken(tmp_path, monkeypatch):
    """On Windows: the file is opened without translation of line ends, and a byte far beyond its end is locked."""
    from types import SimpleNamespace

    from casacal.study import description as records

    locked = []
    fake = SimpleNamespace(LK_NBLCK=2, locking=lambda handle, mode, size: locked.append((mode, size)))
    monkeypatch.setitem(sys.modules, "msvcrt", fake)
    monkeypatch.setattr(records, "fcntl", None)
    with records.appending(tmp_path / "records.jsonl") as appender:
        appender.append([{"fingerprint": "a", "trial": 0}])
        appender.append([{"fingerprint": "a", "trial": 1}])
    assert locked == [(2, 1)]
    assert len(records.read_records(tmp_path / "records.jsonl")) == 2

    def busy(*_):
        raise OSError("locked")

    fake.locking = busy
    with pytest.raises(StudyError, match="Another run"), records.appending(tmp_path / "records.jsonl"):
        pass


@pytest.mark.parametrize(
    ("returned", "found"), [("'# Title\\n\\ntext'", "# Title\n\ntext\n"), ("['# Title', 3]", "# Title\n3\n")]
)
def test_a_report_may_be_lines_or_one_text(tmp_path, returned, found):
    file = tmp_path / "told.py"
    file.write_text(f"def report(run):\n    return {returned}\n")
    assert main(["study", str(file), "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "report.md").read_text().startswith(found)


@pytest.mark.parametrize(("returned", "came"), [("None", "nothing"), ("3", "an int")])
def test_a_report_that_is_none_is_refused(tmp_path, capsys, returned, came):
    file = tmp_path / "told.py"
    file.write_text(f"def report(run):\n    return {returned}\n")
    assert main(["study", str(file), "--out", str(tmp_path / "out")]) == 2
    assert f"Got {came} from report(run)" in capsys.readouterr().err


LOST = """
import subprocess, sys
sys.path[:0] = [sys.argv[1], sys.argv[1] + "/tests"]
from pathlib import Path
from casacal.errors import StudyError
from casacal.study.runs import run
import tiny_study
scheduler = subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port",
                              "0", "--no-dashboard", "--scheduler-file", sys.argv[2] + "/s.json"],
                             stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
import json, os, time
while not (os.path.exists(sys.argv[2] + "/s.json") and os.path.getsize(sys.argv[2] + "/s.json")):
    time.sleep(0.05)
time.sleep(0.2)  # it is written in one piece, and not at one time
address = json.load(open(sys.argv[2] + "/s.json"))["address"]
import threading
threading.Timer(3.0, scheduler.kill).start()  # no worker came: its tasks wait
try:
    run(tiny_study.study, Path(sys.argv[2]), file=sys.argv[1] + "/tests/tiny_study.py", scheduler=address)
except StudyError as error:
    print("said:", error)
"""


@pytest.mark.long
def test_a_scheduler_that_is_lost_ends_in_a_sentence_and_the_run_goes_on(serial, tmp_path):
    """The process ends, no traceback of another package stands in its output, and --resume makes the same records."""
    pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    ended = subprocess.run(
        [sys.executable, "-c", LOST, str(ROOT), str(tmp_path)], capture_output=True, text=True, timeout=100, check=False
    )
    assert ended.returncode == 0, ended.stderr
    assert "was lost. Start it and its workers again, and run again with --resume" in ended.stdout
    assert "Traceback" not in ended.stderr
    found = run(tiny_study.study, tmp_path, file=TINY, resume=True)
    assert found.digest == serial.digest


def test_records_of_a_killed_run_are_reported_trial_by_trial(serial, tmp_path):
    lines = (serial.out / RECORDS).read_text().splitlines(keepends=True)
    random.Random(1).shuffle(lines)
    (tmp_path / RECORDS).write_text("".join(lines))
    assert open_run(tiny_study.study, tmp_path).records == serial.records


def test_numbers_of_numpy_in_a_record_are_numbers():
    line = json.loads(to_line({"detail": {"x": np.array([1.5, np.nan]), "n": np.int64(3), "ok": np.bool_(True)}}))
    assert line["detail"] == {"x": [1.5, None], "n": 3, "ok": True}


def test_a_negative_seed_is_refused():
    with pytest.raises(StudyError, match="has the seed -1"):
        dataclasses.replace(tiny_study.study, seed=-1)
