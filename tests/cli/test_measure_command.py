"""`casacal measure`: what is typed and sent, over pipes and pseudo-terminals; a file that outlives what kills it."""

import os
import re
import select
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT
from measured_world import World

from casacal import CasacalError, Instrument, Parameter, Problem, load_problem, plan
from casacal.cli.main import main
from casacal.model.kinematics import position
from casacal.planning import read_route
from casacal.planning.clearance import Clearance
from casacal.planning.plan import plan_text, write_plan
from casacal.shopfloor.conversation import answered, command_of, help_words, posture, touch_of
from casacal.shopfloor.gauges import HOLD, LONGEST, QUIET, Entry, Inbox, SerialLine, gauge
from casacal.shopfloor.recording import begun
from casacal.shopfloor.session import Session
from casacal.shopfloor.touch import Touch, TouchFile

pty = pytest.importorskip("pty")
HSR = ROOT / "problems" / "hsr_jr680"
PLAIN = gauge("plain")


@pytest.fixture(scope="module")
def planned(hsr, tmp_path_factory):
    """A plan of 36 touches on disk, and the arm that answers."""
    folder = tmp_path_factory.mktemp("plan")
    made = plan(hsr.problem, hsr.cell, touches=36, pool=300, starts=1, seed=8)
    write_plan(folder / "plan.csv", made, hsr.problem, hsr.name)
    route = read_route(folder / "plan.csv", hsr.problem.layout())
    return folder / "plan.csv", route, World(hsr.problem, route, seed=6)


def test_a_plan_is_read_as_it_was_written(hsr, planned, tmp_path):
    path, route, _ = planned
    made = plan(hsr.problem, hsr.cell, touches=36, pool=300, starts=1, seed=8)
    assert route.purposes == made.purposes
    assert route.samples.joints == pytest.approx(made.samples.joints, abs=1e-6)
    assert route.samples.columns["reading"] == pytest.approx(made.samples.columns["reading"], abs=1e-4)
    assert route.samples.labels["plane"] == made.samples.labels["plane"]
    text = path.read_text()
    for old, new, words in (
        ("expected_reading_mm", "reading_mm", "'reading_mm' is a measurement, which a plan does not have"),
        (",fit,", ",fitt,", "'fitt' is no purpose"),
        ("q3_deg", "q3", "has no unit"),
    ):
        (tmp_path / "other.csv").write_text(text.replace(old, new, 1))
        with pytest.raises(CasacalError, match=words):
            read_route(tmp_path / "other.csv", hsr.problem.layout())


@pytest.mark.parametrize(
    ("line", "reading", "first", "face"),
    [
        ("3.21", 3.21, None, None),
        ("3,21", 3.21, None, None),
        ("+3.21 mm", 3.21, None, None),
        ("0.1264in", 0.1264 * 25.4, None, None),
        ("3.21 wall", 3.21, None, "wall"),
        ("3,21;wall", 3.21, None, "wall"),
        ("10 20 30 -40 50 60.5 3.21", 3.21, 10, None),
        ("10, 20, 30, -40, 50, 60.5, 3.21, wall", 3.21, 10, "wall"),
        ("10,20,30,-40,50,60.5,3.21,wall", 3.21, 10, "wall"),
        ("10,5; 20; 30; -40; 50; 60; 3,21", 3.21, 10.5, None),
    ],
)
def test_lines_are_understood(hsr, planned, line, reading, first, face):
    session = Session(hsr.problem, planned[1])
    touch = session.next()
    typed = touch_of(line, hsr.problem.layout(), touch, PLAIN)
    assert tuple(typed.readings.values()) == pytest.approx((reading,))
    assert typed.labels == {"plane": face or touch.labels["plane"]}
    expected = touch.joints[0] if first is None else np.radians(first)
    assert typed.joints[0] == pytest.approx(expected)


@pytest.mark.parametrize("line", ["1 2", "abc", "1 2 3 4 5 6 7 8", "3.2 wall side", "3.2 4.1 wall", "nan", "1e999"])
def test_lines_that_say_nothing_are_refused(hsr, planned, line):
    session = Session(hsr.problem, planned[1])
    answer = answered(session, session.next(), line, PLAIN)
    assert answer.session is session
    assert answer.change == "none"
    assert answer.said


@pytest.mark.parametrize(
    ("name", "line", "reading"),
    [
        ("digimatic", "01A+00003.210\r", 3.21),
        ("digimatic", "02A-0000.0125", -0.0125),
        ("sylvac", "+003.2100\r\n", 3.21),
        ("sylvac", " 003.210", 3.21),
        ("sylvac", "-0.5 <", -0.5),
        ("plain", "+0000.125 ,IN", 3.175),
        ("plain", '0.125"', 3.175),
        ("plain", "3210 um", 3.21),
        ("digimatic", "911", "which is an error"),
        ("sylvac", "ERR3", "which is an error"),
        ("plain", "3.2.1", "not a reading of a gauge called plain"),
        ("digimatic", "3.2", "not a reading of a gauge called digimatic"),
    ],
)
def test_gauges_are_read(name, line, reading):
    if isinstance(reading, str):
        with pytest.raises(CasacalError, match=reading):
            gauge(name).reading(line)
    else:
        assert gauge(name).reading(line) == pytest.approx(reading)


def test_ones_own_gauge():
    own = gauge("plain", pattern=r"CH1\s+(?P<value>[-+.\d]+)\s*(?P<unit>mm|in)?", unit="in", asks="R\\r")
    assert own.reading("CH1  +0.100") == pytest.approx(2.54)
    assert own.reading("CH1  +0.100 mm") == pytest.approx(0.1)
    assert own.asks == "R\r"
    for wrong in ({"pattern": "("}, {"pattern": "[0-9]+"}, {"unit": "cm"}):
        with pytest.raises(CasacalError):
            gauge("plain", **wrong)
    with pytest.raises(CasacalError, match="Did you mean 'sylvac'"):
        gauge("silvac")


def test_words_are_commands():
    assert command_of("u") == command_of("UNDO") == ("undo", None)
    assert command_of("u 7") == ("undo", 7)
    assert command_of("c 2") == ("correct", 2)
    assert command_of("?") == ("help", None)
    assert command_of("3.2") is None
    with pytest.raises(CasacalError, match="is no number"):
        command_of("u it")


def test_what_was_touched_is_in_the_file_at_once(hsr, planned, tmp_path):
    _, route, world = planned
    file = TouchFile(tmp_path / "deep" / "s.csv", hsr.problem.layout(), "measured by casacal: x, plan 1")
    session = Session(hsr.problem, route)
    last = route.purposes.index("check") + 2
    for number in range(1, last + 1):
        session = session.take(*world.touch(number), number=number)
        file.append(session.touches[-1], number)
        touches, left_out, cut = TouchFile(file.path, file.layout, file.mark).read()
        assert not cut
        assert not left_out
        assert [touch.number for touch in touches] == list(range(1, number + 1))
    assert all(alike(one, two) for one, two in zip(touches, session.touches, strict=True))
    checks = [touch for touch in touches if touch.purpose == "check"]
    assert checks
    assert len(hsr.problem.read(file.check_path)) == len(checks)
    samples = hsr.problem.read(file.path)
    assert len(samples) == last - len(checks)
    whole = file.path.read_bytes()
    for length in range(len(whole) - 40, len(whole), 7):
        file.path.write_bytes(whole[:length])
        left, _, cut = file.read()
        assert cut
        assert len(left) == last - 1
        assert hsr.problem.read(file.path).joints.shape[0] == len(samples) - 1
        file.path.write_bytes(whole)
    answered = [replace(session.touches[0], kept=True), replace(session.touches[1], corrected=True)]
    file.rewrite([*answered, *session.touches[2:5]])
    again = [(touch.number, touch.kept, touch.corrected) for touch in file.read()[0]]
    assert again == [(1, True, False), (2, False, True), *((number, False, False) for number in (3, 4, 5))]
    with pytest.raises(CasacalError, match="belongs to another problem or plan"):
        TouchFile(file.path, file.layout, "measured by casacal: x, plan 2").read()
    file.path.write_text(file.path.read_text().replace(",fit,", ",fix,"))
    with pytest.raises(CasacalError, match="were changed"):
        file.read()


def test_what_is_left_out_stays_left_out_after_a_restart(hsr, planned, tmp_path):
    """Touches of the plan that were skipped, and asked for again, whichever file they would stand in."""
    path, route, world = planned
    checked = route.purposes.index("check") + 1

    def recording():
        return begun(hsr, path, tmp_path / "s.csv", PLAIN, table=0.0, clearance=Clearance())[0]

    first = recording()
    first.enter("s 1")
    first.enter(f"s {checked}")
    first.enter(f"s {len(route)}")
    first.enter(str(world.touch(2)[1]))
    assert recording().session.skipped == {1, checked, len(route)}, "left out before anything was made"
    first.enter(str(world.touch(3)[1]))
    first.enter("s 1")
    again = recording()
    assert (again.session.skipped, again.proposed.number) == ({checked, len(route)}, 1)
    assert [touch.number for touch in again.session.touches] == [2, 3]
    again.enter("u")
    assert recording().session.skipped == {checked, len(route)}
    assert len(hsr.problem.read(tmp_path / "s.csv")) == 1
    with pytest.raises(CasacalError, match="another program changed"):
        first.enter("s 5")


def alike(one: Touch, two: Touch) -> bool:
    return (
        np.allclose(one.joints, two.joints, atol=1e-9)
        and dict(one.columns) == pytest.approx(dict(two.columns))
        and one.labels == two.labels
        and all(getattr(one, name) == getattr(two, name) for name in ("number", "purpose", "kept", "corrected"))
    )


def test_a_session_by_pipe(planned, tmp_path, monkeypatch, capsys):
    """A sign slips, which the dial cannot show, then a turn; it is named and put right, also after a pause."""
    path, route, world = planned
    late = [number for number in range(26, 34) if route.purposes[number - 1] == "fit"]
    wrong, lines = max(late, key=lambda number: world.readings[number - 1]), []
    for number in range(1, 37):
        _, reading, _ = world.touch(number)
        joints = " ".join(f"{value:.4f}" for value in np.degrees(world.joints[number - 1]))
        if number == wrong:
            turned = reading + (1.0 if reading < 5 else -1.0)
            lines += [f"{joints} {-reading}", f"{joints} {turned}", "c"]
        else:
            lines.append(f"{joints} {reading}")
    command = ["measure", str(HSR), "--plan", str(path), "--out", str(tmp_path / "s.csv")]
    feed(monkeypatch, lines[: wrong + 1])
    assert main(command) == 1
    said = capsys.readouterr().out
    assert "outside the dial's range of 0 to 10 mm" in said
    assert f"touch {wrong} is still in doubt" in said
    feed(monkeypatch, ["12", *lines[wrong + 1 :]])
    assert main(command) == 0
    said = capsys.readouterr().out
    assert said.count(f"warning: touch {wrong} is off by") == 2, "asked anew, and where a number came as the answer"
    assert re.search(rf"1\. touch {wrong}: a turn of the pointer", said)
    assert "put right" in said
    assert re.search(r"36 touches: tip error [\d.]+ mm expected, below", said)
    read = read_both(tmp_path / "s.csv")
    assert len(read) == 36
    assert all(value > 0 for value in read)
    assert route.purposes.count("check") == len(readings(tmp_path / "s_check.csv"))
    feed(monkeypatch, [])
    assert main(["measure", str(HSR), "--plan", str(path), "--out", str(tmp_path / "s.csv"), "--tolerance", "50"]) == 0
    said = capsys.readouterr().out
    assert "Going on after 36 touches" in said
    assert "within the tolerance of 50 mm" in said


def feed(monkeypatch, lines):
    import io

    monkeypatch.setattr("sys.stdin", io.StringIO("".join(f"{line}\n" for line in lines)))


def readings(path):
    rows = [line.split(",") for line in Path(path).read_text().splitlines()[1:]]
    return [float(row[rows[0].index("reading_mm")]) for row in rows[1:]]


def read_both(path):
    return readings(path) + readings(path.with_name("s_check.csv"))


def test_what_is_asked_for_wrongly_is_refused(planned, tmp_path, capsys):
    path, *_ = planned
    usual = ["measure", str(HSR), "--plan", str(path), "--out", str(tmp_path / "s.csv")]
    (tmp_path / "theirs.csv").write_text("q1_deg,reading_mm\n1,2\n")
    for arguments, words in (
        (["measure", str(HSR), "--plan", str(tmp_path / "none.csv"), "--out", "s.csv"], "there is no such file"),
        (["measure", str(HSR), "--plan", str(HSR / "samples.csv"), "--out", "s.csv"], "is a measurement"),
        ([*usual[:-1], str(path)], "it is what the command reads"),
        ([*usual[:-1], str(tmp_path / "theirs.csv")], "belongs to another problem or plan"),
        ([*usual, "--serial", str(tmp_path / "no_port")], "cannot be used"),
        ([*usual, "--serial", "x", "--frame", "9X9"], "is not such as 8N1"),
        ([*usual, "--gauge", "x"], "no gauge named"),
        ([*usual, "--tolerance", "-1"], "as the tolerance"),
        ([*usual, "--box", "1,2"], "is not X0:X1"),
    ):
        assert main(arguments) == 2, arguments
        assert words in capsys.readouterr().err
    assert not (tmp_path / "s.csv").exists()
    assert (tmp_path / "theirs.csv").read_text() == "q1_deg,reading_mm\n1,2\n"


def test_files_that_others_write_are_left_alone(hsr, planned, tmp_path, monkeypatch, capsys):
    path, _, world = planned
    out = tmp_path / "s.csv"
    usual = ["measure", str(HSR), "--plan", str(path), "--out"]
    for wrong, words in ((os.devnull, "no file that can grow"), (str(tmp_path / "o.xlsx"), "would not be a .xlsx")):
        feed(monkeypatch, ["3.2"])
        assert main([*usual, wrong]) == 2
        assert words in capsys.readouterr().err
    feed(monkeypatch, [str(world.readings[0])])
    assert main([*usual, str(out)]) == 0
    before = out.read_bytes()
    for data in (b"\xef\xbb\xbf" + before, before.replace(b"# measured", b'"# measured')):
        out.write_bytes(data)
        feed(monkeypatch, ["3.2"])
        assert main([*usual, str(out)]) == 2
        assert "another program has changed this file" in capsys.readouterr().err
        assert out.read_bytes() == data
    out.write_bytes(before)

    class Elsewhere:
        """Somebody who types here after another session has written there."""

        def __iter__(self):
            yield "2.9"
            out.write_bytes(out.read_bytes() + before.splitlines(keepends=True)[-1])
            yield "3.1"

    monkeypatch.setattr("sys.stdin", Elsewhere())
    assert main([*usual, str(out)]) == 2
    assert "another program changed" in capsys.readouterr().err
    other = tmp_path / "other.csv"
    other.write_text(path.read_text().replace("planned by casacal for hsr_jr680", "planned by casacal for ur5", 1))
    assert main(["measure", str(HSR), "--plan", str(other), "--out", str(tmp_path / "x.csv")]) == 2
    assert "was planned for 'ur5', and the problem is 'hsr_jr680'" in capsys.readouterr().err


def test_touches_are_called_by_the_numbers_that_are_shown(planned, tmp_path, monkeypatch, capsys):
    path, _, world = planned
    out = tmp_path / "s.csv"
    feed(monkeypatch, ["s", *(str(world.readings[k]) for k in (1, 2, 3)), "u 99", "u 3"])
    assert main(["measure", str(HSR), "--plan", str(path), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "touch 4 made, 3 in all" in said
    assert "No touch 99 has been made" in said
    assert "touch 3 " in said.rpartition("taken back")[2]
    numbers = [row.split(",")[-3] for row in out.read_text().splitlines()[2:]]
    assert "3" not in numbers


def test_a_session_that_ends_in_doubt_says_so(planned, tmp_path, monkeypatch, capsys):
    path, route, _ = planned
    elsewhere = np.degrees(route.samples.joints[0]) + np.array([0, 0, 60, 0, 0, 0])
    feed(monkeypatch, [" ".join(f"{value:.4f}" for value in elsewhere) + " 3.2"])
    assert main(["measure", str(HSR), "--plan", str(path), "--out", str(tmp_path / "s.csv")]) == 1
    assert "is still in doubt" in capsys.readouterr().out


class Terminal:
    """`casacal measure` at the other end of a pseudo-terminal."""

    def __init__(self, *arguments):
        ours, theirs = pty.openpty()
        environment = {**os.environ, "TERM": "dumb", "COLUMNS": "400", "PYTHONPATH": str(ROOT)}
        command = [sys.executable, "-m", "casacal", "measure", *map(str, arguments)]
        self.process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment)
        os.close(theirs)
        self.end, self.heard = ours, ""

    def until(self, words, seconds=60.0):
        """What was heard up to some words."""
        limit = time.monotonic() + seconds
        while words not in self.heard:
            assert select.select([self.end], [], [], limit - time.monotonic())[0], self.heard
            try:
                self.heard += os.read(self.end, 4096).decode()
            except OSError:
                break
        assert words in self.heard, self.heard
        before, _, self.heard = self.heard.partition(words)
        return before + words

    def type(self, line):
        os.write(self.end, f"{line}\n".encode())

    def over(self):
        code = self.process.wait(60)
        os.close(self.end)
        return code


@pytest.mark.long
def test_a_session_outlives_what_kills_it(planned, tmp_path):
    """kill -9 after the seventh touch, at a terminal; what was made is there, and it goes on with the eighth."""
    path, _, world = planned
    out = tmp_path / "s.csv"
    terminal = Terminal(HSR, "--plan", path, "--out", out)
    for number in range(1, 8):
        assert f"touch {number} " in terminal.until("\n> ")
        terminal.type(
            f"{' '.join(f'{v:.4f}' for v in np.degrees(world.joints[number - 1]))} {world.readings[number - 1]}"
        )
        terminal.until(f"{number} made")
    terminal.process.send_signal(signal.SIGKILL)
    assert terminal.over() == -signal.SIGKILL
    made = len(readings(out)) + (len(readings(tmp_path / "s_check.csv")) if (tmp_path / "s_check.csv").exists() else 0)
    assert made == 7
    terminal = Terminal(HSR, "--plan", path, "--out", out)
    assert "Going on after 7 touches" in (said := terminal.until("\n> "))
    assert "touch 8 " in said
    terminal.type("q")
    assert "7 touches: tip error" in terminal.until("casacal calibrate judges that")
    assert terminal.over() == 0


def test_a_gauge_at_a_serial_line(planned, tmp_path):
    """A gauge that answers a question, and one whose button is pressed; an error of it is said and changes nothing."""
    pytest.importorskip("serial")
    path, _, world = planned
    ours, theirs = pty.openpty()
    asked = []

    def answer():
        while True:
            try:
                asked.append(os.read(ours, 16))
            except OSError:
                return
            os.write(ours, f"{world.readings[0]:+09.4f}\r".encode())

    threading.Thread(target=answer, daemon=True).start()
    usual = ("--plan", path, "--out", tmp_path / "s.csv", "--serial", os.ttyname(theirs), "--gauge", "sylvac")
    terminal = Terminal(HSR, *usual)
    terminal.until("\n> ")
    terminal.type("")
    assert f"{world.readings[0]:+09.4f}" in terminal.until("1 made")
    terminal.until("\n> ")
    time.sleep(QUIET + 0.1)
    os.write(ours, b"ERR0\r\n")
    terminal.until("is an error")
    terminal.until("\n> ")
    time.sleep(QUIET + 1.5)  # a hand is not as even as a clock
    os.write(ours, b"+004.5000\r\n")
    terminal.until("2 made")
    terminal.until("\n> ")
    terminal.type("q")
    terminal.until("casacal calibrate judges that")
    assert terminal.over() == 0
    assert asked
    assert asked[0].startswith(b"?")
    both = readings(tmp_path / "s.csv")
    both += readings(tmp_path / "s_check.csv") if (tmp_path / "s_check.csv").exists() else []
    assert sorted(both) == sorted([world.readings[0], 4.5])
    os.close(ours)


def heard(inbox):
    """What comes next; a test fails rather than waits where nothing does."""
    found = []
    waiting = threading.Thread(target=lambda: found.append(inbox.next()), daemon=True)
    waiting.start()
    waiting.join(5)
    assert not waiting.is_alive(), "nothing came"
    return found[0]


class Clock:
    """A time that stands still until it is moved on."""

    now = 0.0

    def __call__(self):
        return self.now


def test_a_line_of_the_gauge_counts_once_it_is_asked_for_and_after_silence():
    clock = Clock()
    inbox = Inbox(now=clock)
    inbox.send("1.0")  # before anybody asked
    inbox.prompted()
    note = heard(inbox)
    assert note.source == "note"
    assert note.text.startswith("Not taken: 1.0, which the gauge sent before it was asked for")
    clock.now += QUIET
    inbox.send("2.0")
    clock.now += HOLD / 2
    inbox.send("2.0")  # the button pressed twice
    clock.now += HOLD
    assert heard(inbox) == Entry("2.0", "sent"), "the first one counts"
    assert heard(inbox).text.startswith("Not taken: 2.0"), "the second does not"
    inbox.prompted()
    clock.now += QUIET - 0.01 - HOLD
    inbox.send("3.0")
    note = heard(inbox)
    assert note.source == "note"
    assert "3.0, which the gauge sent 2.0 s after another line" in note.text
    inbox.send("3.1")  # said once for each prompt
    inbox.type("5.5\n")
    assert heard(inbox) == Entry("5.5\n")
    inbox.take_next()
    inbox.send("3.2")
    assert heard(inbox) == Entry("3.2", "sent"), "what Enter asked for, at once"


@pytest.mark.parametrize("period", [0.01, HOLD / 3, QUIET / 2])
def test_a_stream_fills_no_touch_and_the_keyboard_comes_first(period):
    clock = Clock()
    inbox = Inbox(now=clock)
    inbox.send("7.0")
    for touch in range(5):
        inbox.prompted()
        for _ in range(1000):
            clock.now += period
            inbox.send("7.1")
        inbox.take_next()
        inbox.send("7.15")
        inbox.type("u\n")
        assert heard(inbox) == Entry("u\n"), "the keyboard comes first"
        assert heard(inbox) == Entry("7.15", "sent")
        assert heard(inbox).source == "note", touch
        inbox.take_next()
        inbox.send("7.2")
        inbox.send("7.3")
        assert heard(inbox) == Entry("7.2", "sent"), "what Enter asked for"


def test_a_slow_stream_is_noticed_at_its_third_line():
    """Sent by the clock, every few seconds, whatever it shows; a hand is never so even."""
    clock, taken = Clock(), []
    inbox = Inbox(now=clock)
    inbox.prompted()
    for k in range(20):
        clock.now += 5.0 + 0.01 * (k % 3)
        inbox.send(f"{k}")
        clock.now += 2 * HOLD
        inbox.type("wake\n")
        if heard(inbox) == Entry("wake\n") and inbox._sent is not None:
            taken.append(heard(inbox).text)
            inbox.prompted()
    assert taken == ["0", "1"]
    for pause in (3.0, 4.1, 2.2, 6.0):  # a hand
        clock.now += pause
        inbox.prompted()
        inbox.send("8.8")
        clock.now += 2 * HOLD
        while (entry := heard(inbox)).source == "note":
            pass
        assert entry == Entry("8.8", "sent"), pause


@pytest.mark.parametrize("period", [0.001, HOLD / 3])
def test_the_first_lines_of_a_stream_are_no_reading(period):
    clock = Clock()
    inbox = Inbox(now=clock)
    inbox.prompted()
    for _ in range(1000):
        inbox.send("7.1")
        clock.now += period
    note = heard(inbox)
    assert note.source == "note"
    assert "s after another line" in note.text
    inbox.type(None)
    assert heard(inbox) is None


@pytest.mark.parametrize("line", ["u", "q", "k", "undo", "c 1", "h", "?", "1 2 3 4 5 6 3.2", "3.2 wall", "", "x"])
def test_a_line_of_the_gauge_is_only_ever_a_reading(hsr, planned, line):
    session = Session(hsr.problem, planned[1])
    session = answered(session, session.next(), "3.2", PLAIN).session
    answer = answered(session, session.next(), line, PLAIN, sent=True)
    assert answer.session is session
    assert not answer.ended
    assert answer.said
    assert len(answered(session, session.next(), "3.3 mm", PLAIN, sent=True).session) == 2


def test_a_gauge_whose_button_is_pressed_twice_and_that_is_unplugged(planned, tmp_path):
    """The last reading again is asked about; commands from the gauge are none; loss and return are said."""
    pytest.importorskip("serial")
    path, _, world = planned
    ours, theirs = pty.openpty()
    port = tmp_path / "port"
    port.symlink_to(os.ttyname(theirs))
    usual = ("--plan", path, "--out", tmp_path / "s.csv", "--serial", port)
    terminal = Terminal(HSR, *usual)
    assert "Waiting for touch 1: reading in mm, from the gauge or typed" in terminal.until("\n> ")
    sent = f"{world.readings[0]:.3f}\r".encode()
    os.write(ours, sent + sent)
    assert "Not taken" not in terminal.until("1 made")
    assert "s after another line" in terminal.until("\n> Not taken") + terminal.until("Enter")
    terminal.until("\n> ")
    time.sleep(QUIET + 0.1)
    os.write(ours, sent)
    terminal.until("the reading of the last touch again. Was it read here?")
    terminal.until("\n> ")
    time.sleep(QUIET + 1.2)
    os.write(ours, b"q\r")
    terminal.until("'q' is not a reading")
    terminal.until("\n> ")
    os.close(ours)
    os.close(theirs)
    terminal.until("is gone. Plug it in again")
    ours, theirs = pty.openpty()
    port.unlink()
    port.symlink_to(os.ttyname(theirs))
    terminal.until("The gauge is back")
    terminal.until("> ")
    time.sleep(QUIET + 2.3)
    os.write(ours, sent)
    terminal.until("Was it read here?")
    terminal.until("\n> ")
    terminal.type("y")
    terminal.until("2 made")
    terminal.type("q")
    terminal.until("casacal calibrate judges that")
    assert terminal.over() == 0
    both = readings(tmp_path / "s.csv")
    both += readings(tmp_path / "s_check.csv") if (tmp_path / "s_check.csv").exists() else []
    assert both == pytest.approx([round(world.readings[0], 3)] * 2)
    os.close(ours)


def test_a_line_without_end_is_not_kept():
    pytest.importorskip("serial")
    ours, theirs = pty.openpty()
    line = SerialLine(os.ttyname(theirs))
    found = []
    reader = threading.Thread(target=lambda: found.extend(line.lines()), daemon=True)
    reader.start()
    for _ in range(64):
        os.write(ours, b"A" * 1024)
    os.write(ours, b"\r3.5\r")
    limit = time.monotonic() + 20
    while len(found) < 2 and time.monotonic() < limit:
        time.sleep(0.02)
    line.close()
    os.close(ours)
    assert found[-1] == "3.5"
    assert all(len(each) <= LONGEST for each in found)


def test_one_of_several_instruments_is_planned_for_and_read(tmp_path, monkeypatch, capsys):
    several = str(ROOT / "problems" / "ur5_three_instruments")
    route, out = tmp_path / "plan.csv", tmp_path / "spiked.csv"
    common = ["plan", several, "--out", str(route), "--touches", "12", "--pool", "60"]
    assert main(common) == 2
    assert "there are dial, tracker, spike. Name it: --instrument dial" in capsys.readouterr().err
    assert main([*common, "--instrument", "wire"]) == 2
    assert "Known: dial, tracker, spike" in capsys.readouterr().err
    assert not route.exists()
    assert main([*common, "--instrument", "spike"]) == 0
    assert main(["measure", several, "--plan", str(route), "--out", str(out)]) == 2
    assert "--instrument dial" in capsys.readouterr().err
    touches = read_route(route, load_problem(several).problem.measured_by("spike").layout())
    joints = [" ".join(f"{value:.4f}" for value in np.degrees(row)) for row in touches.samples.joints[:2]]
    feed(monkeypatch, [*joints, "e"])
    assert main(["measure", several, "--instrument", "spike", "--plan", str(route), "--out", str(out)]) == 0
    problem = load_problem(several).problem.measured_by("spike")
    there = [path for path in (out, out.with_name("spiked_check.csv")) if path.exists()]
    rows = np.concatenate([problem.read(path).joints for path in there])
    assert sorted(map(tuple, rows.round(6))) == sorted(map(tuple, touches.samples.joints[:2].round(6)))


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="there is no /proc")
def test_a_file_that_cannot_be_made_is_refused_before_any_touch(planned, tmp_path, monkeypatch, capsys):
    feed(monkeypatch, ["5.0", "e"])
    assert main(["measure", str(HSR), "--plan", str(planned[0]), "--out", "/proc/touched.csv"]) == 2
    said = capsys.readouterr()
    assert "'/proc/touched.csv' cannot be written" in said.err
    assert "touch 1" not in said.out
    feed(monkeypatch, [])
    assert main(["measure", str(HSR), "--plan", str(planned[0]), "--out", str(tmp_path / "fine.csv")]) == 0
    assert list(tmp_path.glob("fine*")) == []


class CableEncoder(Instrument):
    """A cable that winds on a pulley whose angle is read."""

    columns: ClassVar = {"encoder": "angle"}
    column_stds: ClassVar = {"encoder": 0.002}
    unknowns: ClassVar = {"post": Parameter((900.0, 0.0, 200.0), prior_std=5.0)}

    def residual(self, pose, p, row):
        return ca.norm_2(position(pose) - p.post) - 25.0 * row.encoder


def test_an_angle_is_typed_in_the_unit_in_which_it_is_asked_for(hsr):
    problem = Problem(hsr.problem.robot, CableEncoder())
    layout, joints = problem.layout(), np.radians([10.0, 20.0, 30.0, -40.0, 50.0, 60.0])
    touch = Touch(joints, {"encoder": np.radians(1085.44)}, {}, 1)
    assert "encoder about 1085.44 deg" in posture(Session(problem), touch)
    for line in ("1085", "1085 deg", "18.936822 rad", "10 20 30 -40 50 60 1085"):
        typed = touch_of(line, layout, touch, PLAIN)
        assert tuple(typed.readings.values()) == pytest.approx((np.radians(1085),))
        assert typed.joints == pytest.approx(joints)
    with pytest.raises(CasacalError, match=r"in mm, which is no unit of this reading\. Give it in deg, ° or rad"):
        touch_of("1085 mm", layout, touch, PLAIN)
    told = help_words(problem)
    assert "(encoder in degrees)" in told
    assert "dial" not in told
    assert "plunger" not in told
    assert "move along the plunger" in help_words(hsr.problem)
    assert "(reading in mm)" in help_words(hsr.problem)
    notes = plan_text(plan(problem, touches=12, pool=60, starts=1), problem, "cable").splitlines()
    assert not any("dial" in note or "plunger" in note for note in notes if note.startswith("#"))


def test_a_pattern_of_ones_own_keeps_how_its_gauge_is_asked_and_errs():
    own = gauge("sylvac", pattern=r"X(?P<value>[-+.\d]+)")
    assert own.asks == "?\r"
    assert own.reading("X1.5") == 1.5
    with pytest.raises(CasacalError, match="which is an error"):
        own.reading("ERR 4")
