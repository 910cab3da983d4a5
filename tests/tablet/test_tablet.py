"""The page's server and state without a browser: who is let in, steps of several windows, a file that stays right."""

import base64
import csv
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT
from measured_world import World
from played_controllers import PlayedArm, rtde_controller
from scipy.spatial.transform import Rotation

from casacal import CasacalError, calibrate, load_problem, plan, simulate
from casacal.cli.main import main
from casacal.deployment.predict import predict
from casacal.deployment.programs import no_gain
from casacal.planning import read_route
from casacal.planning.clearance import Clearance
from casacal.planning.plan import write_plan
from casacal.planning.scene import scene
from casacal.shopfloor.controllers import controller
from casacal.shopfloor.gauges import gauge
from casacal.tablet.asked import number_of, pendant_table, uploaded
from casacal.tablet.gates import document
from casacal.tablet.server import address_of, is_this_machine, listening, server, token_of
from casacal.tablet.work import OutdatedError, Work, Workplace, for_page
from casacal.values import FrozenMapping
from casacal.wording import mm

pytestmark = pytest.mark.usefixtures("set_ups_of_few", "few_candidates")
PLAIN = gauge("plain")
TOKEN = "a-token-of-this-test"


@pytest.fixture(scope="module")
def planned(hsr, tmp_path_factory):
    """A plan of 36 touches on disk, and the arm that answers."""
    folder = tmp_path_factory.mktemp("plan")
    made = plan(hsr.problem, hsr.cell, touches=36, pool=300, starts=1, seed=8)
    write_plan(folder / "plan.csv", made, hsr.problem, hsr.name)
    route = read_route(folder / "plan.csv", hsr.problem.layout())
    return folder / "plan.csv", World(hsr.problem, route, seed=6)


@pytest.fixture
def few_candidates(monkeypatch):
    """The page plans among a tenth of the touches: what a plan is like is asked elsewhere."""
    monkeypatch.setattr("casacal.tablet.work.POOL", 300)


@pytest.fixture
def workplace(hsr, planned, tmp_path):
    return Workplace(hsr, tmp_path / "work", PLAIN, 0.0, Clearance(), plan=planned[0])


def enter(work, line):
    work.do("enter", {"version": work.version, "line": line})


def well_made(world, number, off=0.0):
    """A line with all joint values and the reading of a touch of the plan."""
    joints, reading, _ = world.touch(number)
    return " ".join([*(f"{value:.4f}" for value in np.degrees(joints)), f"{reading + off:.3f}"])


def wait(work):
    for _ in range(1200):
        if work.job is None:
            return
        time.sleep(0.05)
    raise AssertionError(f"still at work: {work.job}")


@contextmanager
def served(work):
    """The address of a page, with its token's cookie."""
    place = listening("127.0.0.1", 0)
    port = place.getsockname()[1]
    running = server(work, TOKEN, port)
    thread = threading.Thread(target=running.run, kwargs={"sockets": [place]}, daemon=True)
    thread.start()
    while not running.started:
        time.sleep(0.01)
    yield f"127.0.0.1:{port}", f"casacal_{port}={TOKEN}"
    running.should_exit = True
    thread.join(10)
    place.close()


class NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_):
        return None


OPENER = urllib.request.build_opener(urllib.request.ProxyHandler({}), NoRedirect)


def ask(host, path, *, body=None, **headers):
    """Status, headers and text of an answer."""
    headers = {name.replace("_", "-"): value for name, value in headers.items()}
    request = urllib.request.Request(f"http://{host}{path}", body, headers)
    try:
        with OPENER.open(request, timeout=20) as reply:
            return reply.status, reply.headers, reply.read().decode()
    except urllib.error.HTTPError as refused:
        with refused:
            return refused.code, refused.headers, refused.read().decode()


def test_only_who_has_the_token_is_let_in(workplace):
    with served(Work(workplace)) as (host, cookie):
        for path in ("/", "/state", "/static/page.js", "/file/plan.csv", "/events", "/nothing"):
            assert ask(host, path)[0] == 403
        assert ask(host, "/?token=wrong")[0] == 403
        assert ask(host, "/state", Cookie=f"{cookie}x")[0] == 403
        status, headers, _ = ask(host, f"/?token={TOKEN}")
        assert (status, headers["Location"]) == (303, "/")
        assert headers["Set-Cookie"].startswith(cookie)
        assert "HttpOnly" in headers["Set-Cookie"]
        assert "samesite=strict" in headers["Set-Cookie"].lower()
        status, headers, text = ask(host, "/", Cookie=cookie)
        assert status == 200
        assert "<script" in text
        assert "unsafe" not in headers["Content-Security-Policy"]  # no script and no style that stands in the page
        assert "access-control-allow-origin" not in {name.lower() for name in headers}
        assert TOKEN not in text
        _, headers, _ = ask(host, "/file/plan.csv", Cookie=cookie)
        assert headers["Content-Security-Policy"].startswith("sandbox")  # files have a policy of their own
        assert headers["X-Content-Type-Options"] == "nosniff"


def test_other_names_and_other_origins_are_refused(workplace):
    with served(Work(workplace)) as (host, cookie):
        assert ask(host, "/state", Cookie=cookie, Host="evil.example")[0] == 421
        assert ask(host, "/state", Cookie=cookie, Host=f"localhost:{host.partition(':')[2]}")[0] == 200
        body = json.dumps({"step": "enter", "version": 0, "line": "s"}).encode()
        for origin in ({}, {"Origin": "http://evil.example"}, {"Origin": "null"}):
            assert ask(host, "/step", body=body, Cookie=cookie, **origin)[0] == 403
        assert ask(host, "/step", body=body, Cookie=cookie, Origin=f"http://{host}")[0] == 200


@pytest.mark.parametrize(
    ("host", "own"),
    [
        ("127.0.0.1:8765", True),
        ("192.168.1.7", True),
        ("[::1]:80", True),
        ("localhost", True),
        ("evil.example:8765", False),
        ("127.0.0.1.evil.example", False),
        ("", False),
        ("[evil]:1", False),
        ("robot-pc.lan:8765", False),
    ],
)
def test_names_of_this_machine(host, own):
    assert is_this_machine(host) is own
    assert is_this_machine("robot-pc.lan:8765", "Robot-PC.lan"), "as --host says"


def test_nothing_but_files_by_their_names_is_given_out(workplace):
    with served(Work(workplace)) as (host, cookie):
        assert ask(host, "/file/plan.csv", Cookie=cookie)[0] == 200
        for path in (
            "/file/result.json",  # not there yet
            "/file/problem.py",
            "/file/..%2F..%2Fproblem.py",
            "/file/../../etc/passwd",
            "/file/%2Fetc%2Fpasswd",
            "/static/..%2Fwork.py",
            "/static/page.html.bak",
        ):
            assert ask(host, path, Cookie=cookie)[0] == 404


@pytest.mark.parametrize(
    ("body", "status", "words"),
    [
        (b"", 400, "no step"),
        (b"[1]", 400, "no step"),
        (b"{", 400, "no step"),
        (b"[" * 100_000, 400, "no step"),
        (b'{"step": 3}', 400, "step"),
        (b'{"step": "rm"}', 400, "enter"),
        (b'{"step": "enter"}', 409, "changed meanwhile"),
        (b'{"step": "enter", "version": 0}', 400, "no text"),
        (b'{"step": "enter", "version": 0, "line": ["1"]}', 400, "no text"),
        (b'{"step": "correct", "version": 0, "files": "x"}', 400, "no calibration"),
        (b"x" * (5 << 20), 413, "smaller"),
    ],
)
def test_what_is_no_step_is_refused_in_a_sentence(workplace, body, status, words):
    work = Work(workplace)
    with served(work) as (host, cookie):
        found = ask(host, "/step", body=body, Cookie=cookie, Origin=f"http://{host}")
    assert found[0] == status
    assert words in json.loads(found[2])["error"]
    assert len(work.recording.session) == 0


def test_a_hundred_requests_at_once_leave_the_file_right(workplace, planned):
    """Of those that show one state, one is taken; the others are told so."""
    work = Work(workplace)
    with served(work) as (host, cookie):
        body = {"step": "enter", "version": work.version, "line": well_made(planned[1], 1)}
        sent = {"body": json.dumps(body).encode(), "Cookie": cookie, "Origin": f"http://{host}"}
        with ThreadPoolExecutor(25) as pool:
            found = list(pool.map(lambda _: ask(host, "/step", **sent)[0], range(100)))
    assert sorted(found) == [200] + [409] * 99
    assert len(work.recording.session) == 1
    assert len(workplace.samples.read_text().splitlines() if workplace.samples.exists() else checks(workplace)) == 3


def checks(workplace):
    return workplace.samples.with_name("samples_check.csv").read_text().splitlines()


def test_a_window_that_was_overtaken_changes_nothing(workplace, planned):
    work = Work(workplace)
    version = work.version
    enter(work, well_made(planned[1], 1))
    with pytest.raises(OutdatedError):
        work.do("enter", {"version": version, "line": "u"})
    assert len(work.recording.session) == 1


def test_page_and_terminal_take_turns_on_one_file(workplace, planned, hsr, tmp_path, monkeypatch, capsys):
    """Five touches on the page, five at the terminal, and on again; the file is what one session would have written."""
    path, world = planned
    work = Work(workplace)
    for number in range(1, 6):
        enter(work, well_made(world, number))
    typed = tmp_path / "typed.txt"
    typed.write_text("\n".join(well_made(world, number) for number in range(6, 11)) + "\nq\n")
    command = ["measure", str(ROOT / "problems" / "hsr_jr680"), "--plan", str(path), "--out", str(workplace.samples)]
    with typed.open() as lines:
        monkeypatch.setattr("sys.stdin", lines)
        main(command)
    assert "Going on after 5 touches" in capsys.readouterr().out
    with pytest.raises(OutdatedError):  # the page has not shown yet what the terminal wrote
        enter(work, well_made(world, 6))
    assert document(work)["gates"]["measure"]["made"] == 10
    again = work
    enter(again, well_made(world, 11))
    in_one = Work(replace(workplace, folder=tmp_path / "one"))
    for number in range(1, 12):
        enter(in_one, well_made(world, number))
    assert workplace.samples.read_bytes() == in_one.place.samples.read_bytes()
    assert again.recording.session.tip_error == pytest.approx(in_one.recording.session.tip_error, rel=1e-6)


def test_the_state_after_a_restart_is_that_before(workplace, planned):
    work = Work(workplace)
    for number in range(1, 22):
        enter(work, well_made(planned[1], number, off=3.0 if number == 21 else 0.0))
    before, after = document(work)["gates"]["measure"], document(Work(workplace))["gates"]["measure"]
    assert before["doubt"] is not None
    assert [count for count, _ in after["curve"]] == [count for count, _ in before["curve"]]
    assert np.array(after["curve"])[:-1] == pytest.approx(np.array(before["curve"])[:-1], rel=1e-3)
    for name in ("made", "doubt", "touches", "next", "error", "below"):
        assert after[name] == before[name], name


def test_a_doubt_names_touches_and_answers(workplace, planned):
    work = Work(workplace)
    for number in range(1, 21):
        enter(work, well_made(planned[1], number))
    enter(work, well_made(planned[1], 21, off=4.23))  # what it may be, or nothing that is known
    doubt = document(work)["gates"]["measure"]["doubt"]
    assert 21 in doubt["touches"]
    assert any(each["can"] for each in doubt["suspects"])
    assert any("no known cause" in each["words"] for each in doubt["suspects"])
    assert all(each["can"] == ("no known cause" not in each["words"]) for each in doubt["suspects"])
    enter(work, "1.234")  # no reading is taken before an answer
    assert len(work.recording.session) == 21
    enter(work, "u 21")
    assert document(work)["gates"]["measure"]["doubt"] is None
    assert document(work)["gates"]["measure"]["next"]["number"] == 21


def test_a_row_takes_what_the_arm_really_had(workplace, planned):
    """The joint values of the controller stand in the file, not those of the plan, which only the posture shows."""
    joints, reading, _ = planned[1].touch(1)
    with rtde_controller(PlayedArm(joints + 0.01)) as address:
        asked = controller(f"rtde:{address}", workplace.source.problem.robot)
        work = Work(replace(workplace, stands=asked.standing))
        off = work.stands()["off"]
        enter(work, f"{reading:.3f}")
        (touch,) = work.recording.session.touches
        assert touch.joints == pytest.approx(joints + 0.01, abs=1e-12)
        assert touch.number == 1
        wanted = np.degrees(joints + 0.01 - work.recording.session.plan.samples.joints[0])
        assert [float(each) for each in off] == pytest.approx(wanted, abs=1e-4)
        enter(work, "u")
    enter(work, f"{reading:.3f}")  # the link is lost: nothing is taken for true that nobody saw
    assert len(work.recording.session) == 0
    assert "gives no joint values" in work.said["measure"][0]
    enter(work, well_made(planned[1], 1))
    assert work.recording.session.touches[0].joints == pytest.approx(joints, abs=1e-6)  # which were typed


def test_the_whole_way_without_a_browser(hsr, planned, tmp_path):
    """Plan, touches, calibration, verification and targets, each as its command makes it."""
    work = Work(Workplace(hsr, tmp_path / "work", PLAIN, 0.0, Clearance()))
    assert document(work)["gates"]["measure"]["state"] == "ahead"
    with pytest.raises(CasacalError, match="no plan yet"):
        enter(work, "1.0")
    with pytest.raises(CasacalError, match="no number of touches"):
        work.do("plan", {"version": work.version, "touches": "many", "tolerance": ""})
    work.do("plan", {"version": work.version, "touches": "40", "tolerance": ""})
    with pytest.raises(CasacalError, match="Still at work"):
        work.do("calibrate", {"version": work.version})
    wait(work)
    assert {"plan.csv", "sheet.html"} <= set(document(work)["files"])
    route = work.recording.session.plan
    world = World(hsr.problem, route, seed=2)
    for number in range(1, 41):
        enter(work, well_made(world, number))
        while work.recording.session.alarm is not None:
            enter(work, "k")
    assert document(work)["gates"]["measure"]["state"] == "passed"
    work.do("calibrate", {"version": work.version})
    wait(work)
    gate = document(work)["gates"]["decide"]
    command = calibrate(hsr, hsr.problem.read(work.place.samples))
    assert (gate["level"], gate["words"]) == (command.verdict.level, command.verdict.words)
    assert not work.outdated
    work.do("verify", {"version": work.version, "tolerance": ""})
    wait(work)
    assert document(work)["gates"]["verify"]["state"] == "passed"
    targets = "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n10,20,30,-50,-55,-50\n0,10,20,0,30,0\n"
    sent = [{"name": "C:\\cell\\targets.csv", "data": base64.b64encode(targets.encode()).decode()}]
    found = work.do("correct", {"version": work.version, "files": sent, "frame": "tip"})
    data = base64.b64decode(found["files"][0]["data"]).decode()
    (tmp_path / "targets.csv").write_text(targets)
    out = tmp_path / "corrected.csv"
    command = ["compensate", str(work.place.fit), str(tmp_path / "targets.csv"), "--frame", "tip"]
    assert main([*command, "--out", str(out)]) == 0
    assert rows_of(data) == rows_of(out.read_text())
    assert "compensate targets.csv" in data  # not the name under which it was kept here
    with pytest.raises(CasacalError, match="were made"):
        work.do("plan", {"version": work.version, "touches": "40", "tolerance": ""})
    enter(work, "u")
    assert work.outdated
    with pytest.raises(CasacalError, match="after the calibration"):
        work.do("correct", {"version": work.version, "files": sent, "frame": "tip"})


def test_too_few_touches_are_said_before_anybody_makes_them(hsr, planned, tmp_path):
    """At the plan, and of a plan from elsewhere until enough are made; `go_on` finds more beyond the plan."""
    work = Work(Workplace(hsr, tmp_path / "work", PLAIN, 0.0, Clearance()))
    work.do("plan", {"version": work.version, "touches": "20", "tolerance": ""})
    wait(work)
    assert work.failed["plan"]
    assert re.search(r"17 are fitted, and a calibration takes (\d+)", work.said["plan"][0])
    asked = re.search(r"Ask for (\d+) or more", work.said["plan"][0])[1]
    assert not (tmp_path / "work" / "plan.csv").exists()
    work.do("plan", {"version": work.version, "touches": asked, "tolerance": ""})
    wait(work)
    assert not work.failed["plan"]
    other = Work(Workplace(hsr, tmp_path / "other", PLAIN, 0.0, Clearance(), plan=planned[0]))
    for number in range(1, 11):
        enter(other, well_made(planned[1], number))
    gate = document(other)["gates"]["decide"]
    assert gate["state"] == "ahead"
    assert re.search(r"\d+ that are fitted, \d+ so far", gate["missing"])
    for number in range(11, 37):
        enter(other, well_made(planned[1], number))
        while other.recording.session.alarm is not None:
            enter(other, "k")
    assert document(other)["gates"]["measure"]["next"] is None
    other.do("go_on", {"version": other.version, "tolerance": "0.01"})
    assert document(other)["gates"]["measure"]["next"]["number"] is None
    assert document(other)["gates"]["measure"]["next"]["arm"] is not None


def test_the_first_gate_says_what_the_problem_takes_for_granted(workplace, tmp_path):
    facts = dict(document(Work(workplace))["gates"]["cell"]["facts"])
    assert facts["Joint limits"].startswith("-160 to 160, -85 to 85, -80 to 80, ")
    assert facts["Tip in the flange's frame"] == "(0, 0, 0) mm"
    assert facts["It reads more as the plunger"].startswith("comes out; otherwise its sign")
    pushed = load_problem(ROOT / "problems" / "ur5")
    workplace = Workplace(pushed, tmp_path, PLAIN, 0.0, Clearance())
    assert dict(document(Work(workplace))["gates"]["cell"]["facts"])["It reads more as the plunger"].startswith(
        "is pushed in"
    )


def test_the_posture_of_another_touch_is_not_taken_for_this_one(workplace, planned):
    work = Work(workplace)
    joints = work.recording.session.plan.samples.joints
    enter(work, " ".join([*(f"{value:.6f}" for value in np.degrees(joints[4])), "1.0"]))
    assert len(work.recording.session) == 0
    assert "joint values of touch 5" in work.said["measure"][0]


def test_the_token_stays_with_the_folder_and_its_owner(tmp_path):
    token = token_of(tmp_path / "work")
    assert len(token) == 22
    assert token_of(tmp_path / "work") == token
    assert (tmp_path / "work" / "page.token").stat().st_mode & 0o77 == 0
    (tmp_path / "work" / "page.token").write_text("short")
    assert token_of(tmp_path / "work") not in (token, "short")
    assert token_of(tmp_path / "other") != token


def rows_of(text):
    return list(csv.reader(line for line in text.splitlines() if not line.startswith("#")))


@pytest.mark.parametrize(
    ("text", "value"), [("", None), ("  ", None), ("0,25", 0.25), ("0.25", 0.25), ("3", 3.0), ("500", 500.0)]
)
def test_numbers_in_fields(text, value):
    assert number_of({"x": text}, "x", 0, 500) == value


@pytest.mark.parametrize("text", ["nan", "inf", "-1", "0", "501", "1e9", "0x10", "a", "1 2"])
def test_what_is_no_number_of_a_field(text):
    with pytest.raises(CasacalError, match="is no x"):
        number_of({"x": text}, "x", 0, 500)


def test_pendant_rows_become_columns_with_units():
    rows = "1;2;3;4;5;6;100;200;300;0.1;0.2;0.3\n\n" + 3 * " 1 2 3 4 5 6  100 200 300 0.1 0.2 0.3 \n"
    table = pendant_table({"form": "rxyz", "rows": rows}, [True] * 5 + [False])
    assert table.header == (
        *(f"q{k}_deg" for k in range(1, 6)),
        "q6_mm",
        "x_mm",
        "y_mm",
        "z_mm",
        "rx_rad",
        "ry_rad",
        "rz_rad",
    )
    assert len(table.rows) == 4
    assert table.lines == (1, 3, 4, 5)
    for form, text, words in (
        ("rxyz", "1 2 3", "Line 1 has 3 numbers, not 12"),
        ("rxyz", "1,5 2.5 3", "are mixed"),
        ("rxyz", "", "Got 0 poses"),
        ("rxyz", rows.partition("\n")[0], "Got 1 pose"),
        ("euler", "1", "euler"),
    ):
        with pytest.raises(CasacalError, match=words):
            pendant_table({"form": form, "rows": text}, [True] * 6)


def test_four_poses_confirm_the_conventions_once(hsr, planned, tmp_path):
    """Poses of the drawn arm pass; with joint 1 counted the other way the page says so and keeps nothing."""
    folder = tmp_path / "hsr_jr680"
    shutil.copytree(ROOT / "problems" / "hsr_jr680", folder)
    source = load_problem(folder)
    work = Work(Workplace(source, tmp_path / "work", PLAIN, 0.0, Clearance(), plan=planned[0]))
    rng = np.random.default_rng(3)
    lines = {1: [], -1: []}
    for _ in range(5):
        q = rng.uniform(-0.8, 0.8, 6)
        pose = np.array(source.problem.robot.traced.at_drawn(q)).astype(float)
        turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
        for sign, made in lines.items():
            joints = np.degrees(q) * [sign, 1, 1, 1, 1, 1]
            made.append(" ".join(f"{value:.6f}" for value in [*joints, *pose[:3, 3], *turn]))
    work.do("conventions", {"version": work.version, "form": "rxyz", "rows": "\n".join(lines[-1])})
    assert work.failed["conventions"]
    assert document(work)["gates"]["conventions"]["state"] == "open"
    assert not (folder / "conventions.json").exists()
    metres = [
        " ".join([*row.split()[:6], *(f"{float(v) / 1000:.9f}" for v in row.split()[6:9]), *row.split()[9:]])
        for row in lines[1]
    ]
    with pytest.raises(CasacalError, match=r"lengths in m\b"):
        work.do("conventions", {"version": work.version, "form": "rxyz", "rows": "\n".join(metres)})
    work.do("conventions", {"version": work.version, "form": "rxyz", "rows": "\n".join(lines[1])})
    assert document(work)["gates"]["conventions"]["state"] == "passed"
    assert load_problem(folder).confirmed


@pytest.mark.parametrize(
    ("files", "words"),
    [
        (None, "No file"),
        ([], "No file"),
        ([{"name": "x.exe", "data": ""}], "ends in"),
        ([{"name": "../../x.csv", "data": "not base64!"}], "damaged"),
        ([{"name": "a.csv", "data": ""}, {"name": "/x/A.CSV", "data": ""}], "Two files called 'A.CSV'"),
        ([{"name": "x.dat", "data": ""}, {"name": "y.src", "data": ""}], "'x.dat' came without"),
        ([{"name": "x.csv", "data": ""}] * 21, "21 files"),
        ([{"data": ""}], "no text"),
        (["x"], "no text"),
        ([{"name": "x.csv", "data": "A" * 5_000_000}], "at most"),
    ],
)
def test_files_that_are_refused(tmp_path, files, words):
    with pytest.raises(CasacalError, match=words):
        uploaded({"files": files}, tmp_path)


def test_files_are_kept_under_names_of_ours(tmp_path):
    sent = [{"name": name, "data": ""} for name in ("/etc/../x.DAT", "..\\..\\x.src", "x.csv", "y.csv")]
    kept = {"targets0.dat": "x.DAT", "targets0.src": "x.src", "targets0.csv": "x.csv", "targets1.csv": "y.csv"}
    assert uploaded({"files": sent}, tmp_path) == {tmp_path / name: shown for name, shown in kept.items()}


def test_the_picture_in_space_stands_where_the_arm_does(hsr, planned):
    """Tips lie on their faces within the dial's travel, faces are as large and stand where the cell has them."""
    route = read_route(planned[0], hsr.problem.layout())
    found = scene(hsr.problem, hsr.cell, Clearance(), route.samples)
    assert json.loads(json.dumps(found)) == found
    assert len(found["arms"]) == len(route)
    faces = {solid["name"]: solid for solid in found["solids"] if solid["touched"]}
    for face in hsr.cell.faces:
        solid = faces[face.label]
        top = np.array(solid["centre"]) + np.array(solid["axes"][0]) * solid["size"][0] / 2
        assert top == pytest.approx(np.array(face.centre), abs=0.02)
    for arm, label in zip(found["arms"], route.samples.labels["plane"], strict=True):
        face = next(each for each in hsr.cell.faces if each.label == label)
        off = (np.array(arm["nodes"][-1]) - face.centre) @ face.axes[0]
        assert abs(off) < 1.0  # the tip at the expected reading is on the drawn face
        assert np.array(arm["plunger"]) @ face.axes[0] < -0.8  # and comes from outside
        assert arm["nodes"][0] == [0, 0, 0]
    assert len(found["radii"]) == len(found["arms"][0]["nodes"]) - 1


def test_an_address_that_is_taken_is_a_sentence():
    with listening("127.0.0.1", 0) as place:
        place.listen()
        with pytest.raises(CasacalError, match="Nothing can be served"):
            listening("127.0.0.1", place.getsockname()[1])


def test_the_address_that_is_printed_can_be_opened():
    assert address_of("127.0.0.1", 1) == "http://127.0.0.1:1"
    assert address_of("::1", 1) == "http://[::1]:1"
    everywhere = address_of("0.0.0.0", 1)
    assert everywhere.startswith("http://")
    assert "0.0.0.0" not in everywhere
    assert is_this_machine(everywhere.removeprefix("http://"))


def test_without_its_extra_the_command_says_what_to_install(tmp_path):
    """In a Python that finds no uvicorn, and for options that are none."""
    code = "import sys; sys.modules['uvicorn'] = None; from casacal.cli.main import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "serve", str(ROOT / "problems" / "hsr_jr680")]
    for more, words in (([], "pip install 'casacal[page]'"), (["--port", "99999"], "casacal[page]")):
        done = subprocess.run([*command, *more], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 2
        assert words in done.stderr
        assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--port", "99999"], "65535"),
        (["--host", "no.such.host.invalid"], "Nothing can be served"),
        (["--plan", "nothing.csv"], "no such file"),
        (["--joints", "kuka:1.2.3.4"], "names no controller"),
        (["--since", "nothing.json"], "nothing.json"),
        (["--out", "file.txt"], "is no folder"),
        (["--tolerance", "-1"], "positive"),
    ],
)
def test_options_that_are_none_are_sentences(options, words, planned, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file.txt").write_text("x")
    with_plan = [] if "--plan" in options else ["--plan", str(planned[0])]
    assert main(["serve", str(ROOT / "problems" / "hsr_jr680"), "--port", "0", *options, *with_plan]) == 2
    assert words in capsys.readouterr().err


def test_what_nobody_foresaw_is_said_and_the_next_step_works(workplace, planned, monkeypatch):
    """A verification that falls over leaves words, and no window waits for ever."""

    def fall(*_, **__):
        raise ZeroDivisionError("planted")

    work = Work(workplace)
    for number in range(1, 37):
        enter(work, well_made(planned[1], number))
        while work.recording.session.alarm is not None:
            enter(work, "k")
    monkeypatch.setattr("casacal.calibration.calibrate.calibrate", fall)
    work.do("calibrate", {"version": work.version})
    wait(work)
    gate = document(work)["gates"]["decide"]
    assert gate["failed"]
    assert "not foreseen (ZeroDivisionError('planted'))" in gate["said"][0]
    enter(work, "u")
    assert len(work.recording.session) == 35


@pytest.fixture
def measured(workplace, planned):
    """A page after ten touches; its files stand in its own folder, the plan as well."""
    workplace.folder.mkdir()
    shutil.copy(planned[0], workplace.folder / "plan.csv")
    work = Work(replace(workplace, plan=None))
    for number in range(1, 11):
        enter(work, well_made(planned[1], number))
    return work


def test_a_window_hears_of_what_others_do_to_the_files(measured):
    plan_file = measured.place.plan_file
    as_it_was = plan_file.read_bytes()
    with served(measured) as (host, cookie):
        request = urllib.request.Request(f"http://{host}/events", headers={"Cookie": cookie})
        with OPENER.open(request, timeout=20) as events:
            first = events.readline()
            for content, trouble in ((as_it_was + b"# edited\n", "was changed after touches"), (as_it_was, "")):
                plan_file.write_bytes(content)
                events.readline()
                assert events.readline() != first  # without anybody's asking
                assert trouble in measured.trouble
                assert bool(measured.trouble) == bool(trouble)


def test_an_earlier_result_that_cannot_be_compared_leaves_the_new_arm_in_use(calibrated, monkeypatch):
    """Targets must not be those of the arm before; and touches are known by what they hold, not by when it was."""
    work = page_of(calibrated)
    before = work.arm

    def refuse(*_, **__):
        raise CasacalError("The rows have no column 'x'", "Give it")

    monkeypatch.setattr("casacal.changes.changed.changed", refuse)
    work.place = replace(work.place, since=before)
    (work.place.folder / "verified.html").write_text("of the calibration before")
    assert "verified.html" in document(work)["files"]
    work.do("calibrate", {"version": work.version})
    wait(work)
    assert work.arm is not before
    assert "verified.html" not in document(work)["files"]
    made_from = hashlib.sha256(work.place.samples.read_bytes()).hexdigest()
    assert document(work)["gates"]["decide"]["made_from"] == made_from, "by which a window knows that the report is new"
    assert not work.failed["decide"]
    assert any("no column 'x'" in words for words in work.said["decide"])
    assert not work.outdated
    text = work.place.samples.read_text()
    work.place.samples.write_text(text + text.splitlines()[-1] + "\n")
    os.utime(work.place.samples, (1, 1))
    assert work.outdated, "however old the file says it is"


def test_touches_that_were_left_out_are_named_and_asked_for_again(measured):
    for line in ("s 12", "s 13"):
        enter(measured, line)
    gates = document(measured)["gates"]
    assert gates["measure"]["skipped"] == [12, 13]
    assert gates["measure"]["next"]["number"] == 11
    enter(measured, "s 12")
    assert document(measured)["gates"]["measure"]["skipped"] == [13]


def shown(work):
    """What GET /state answers, with the gates' states and words."""
    with served(work) as (host, cookie):
        status, _, text = ask(host, "/state", Cookie=cookie)
    assert status == 200, text
    return json.loads(text)


def spoil_cell(place):
    place.samples.write_text(re.sub(r"\n(-?[\d.]+),", r"\nx7,", place.samples.read_text(), count=1))


def unknown_touch(place):
    place.samples.write_text(place.samples.read_text().replace(",1,fit,", ",99,fit,", 1))


def short_row(place):
    with place.samples.open("a") as file:
        file.write("1,2\n")


def longer_comment(place):
    place.samples.write_text(place.samples.read_text().replace("\n", " and more\n", 1))


def folder_there(place):
    place.samples.unlink()
    place.samples.mkdir()


def file_for_folder(place):
    shutil.move(place.folder, place.folder.with_name("aside"))
    place.folder.write_text("x")


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (spoil_cell, "samples.csv, line 3"),
        (unknown_touch, "touch 99 is none of the plan"),
        (short_row, "samples.csv"),
        (longer_comment, "another program has changed this file"),
        (folder_there, "samples.csv"),
        (file_for_folder, "plan.csv' is gone"),
        (lambda place: place.plan_file.unlink(), "plan.csv' is gone"),
    ],
)
def test_spoilt_files_are_said_and_mending_them_mends_the_page(measured, spoil, named, tmp_path):
    place, kept = measured.place, tmp_path / "kept"
    shutil.copytree(place.folder, kept)
    spoil(place)
    found = shown(measured)
    assert named in found["trouble"]
    assert all(found["trouble"] in found["gates"][name]["missing"] for name in ("plan", "measure"))
    with pytest.raises(CasacalError, match=re.escape(named.partition(",")[0])):
        enter(measured, "1.0")
    for path in (place.samples, place.folder):
        if path.is_dir():
            shutil.rmtree(path)
        elif path.exists():
            path.unlink()
    shutil.copytree(kept, place.folder)
    found = shown(measured)
    assert found["trouble"] == ""
    assert found["gates"]["measure"]["made"] == 10


def test_a_gate_that_falls_over_leaves_the_others_and_is_in_the_log(measured, monkeypatch, caplog):
    def fall(*_):
        raise ZeroDivisionError("planted")

    monkeypatch.setattr("casacal.tablet.gates.in_units", fall)
    found = shown(measured)
    assert "not foreseen (ZeroDivisionError('planted'))" in found["gates"]["cell"]["missing"]
    assert found["gates"]["measure"]["made"] == 10
    assert "ZeroDivisionError: planted" in caplog.text
    monkeypatch.setattr("casacal.tablet.server.files", fall)
    caplog.clear()
    with served(measured) as (host, cookie):
        assert ask(host, "/file/plan.csv", Cookie=cookie)[0] == 500
    assert "ZeroDivisionError: planted" in caplog.text


def test_touches_that_vanished_and_a_plan_that_changed_are_said(measured, planned):
    place = measured.place
    lines = place.samples.read_text().splitlines(keepends=True)
    made = len(measured.recording.session)
    place.samples.write_text("".join(lines[:-3]))
    found = shown(measured)
    assert f"{made} touches had been made" in found["trouble"]
    assert f"hold {made - 3}" in found["trouble"]
    place.samples.write_text("".join(lines))
    assert shown(measured)["trouble"] == ""
    place.samples.write_text("")
    assert "others took the rest out" in shown(measured)["trouble"]
    place.samples.write_text("".join(lines))
    with place.plan_file.open("a") as file:
        file.write("# a note\n")
    found = shown(measured)
    assert "plan.csv' was changed after touches of it were made" in found["trouble"]
    shutil.copy(planned[0], place.plan_file)
    assert shown(measured)["gates"]["measure"]["made"] == made


def test_a_plan_is_made_again_and_never_over_touches(measured, tmp_path):
    place = measured.place
    place.plan_file.unlink()
    with pytest.raises(CasacalError, match="touches of it were made"):
        measured.do("plan", {"version": version_of(measured), "touches": "40", "tolerance": ""})
    fresh = Work(replace(place, folder=tmp_path / "fresh"))
    for touches in ("40", "41"):
        fresh.do("plan", {"version": fresh.version, "touches": touches, "tolerance": ""})
        wait(fresh)
        assert not fresh.failed["plan"], fresh.said["plan"]
        assert len(fresh.recording.session.plan) == int(touches)
    assert not [path for path in fresh.place.folder.iterdir() if path.name.startswith(".")]


def version_of(work):
    work.look()
    return work.version


def test_what_stands_in_the_place_of_touches_leaves_no_dead_end(measured):
    """An undo that cannot be written leaves nothing behind that refuses all later ones."""
    place, kept = measured.place, measured.place.samples.read_bytes()
    place.samples.write_text("of somebody else\n")
    with pytest.raises(CasacalError, match="in the place of measured rows"):
        measured.recording.file.rewrite(measured.recording.session.touches[:-1])
    assert not list(place.folder.glob(".casacal*"))
    place.samples.write_bytes(kept)
    measured.look()
    enter(measured, "u")
    assert len(measured.recording.session) == 9


def problem_of_its_own(tmp_path):
    folder = tmp_path / "hsr_jr680"
    shutil.copytree(ROOT / "problems" / "hsr_jr680", folder)
    return folder


@pytest.fixture(scope="module")
def way(hsr, tmp_path_factory):
    """A folder with a problem of its own, and beside it that of a page after a calibration."""
    base = tmp_path_factory.mktemp("way")
    (base / "work").mkdir()
    problem_of_its_own(base)
    made = plan(hsr.problem, hsr.cell, touches=44, pool=300, starts=1, seed=8)
    write_plan(base / "work" / "plan.csv", made, hsr.problem, hsr.name)
    work = page_of(base)
    world = World(hsr.problem, work.recording.session.plan, seed=6)
    for number in range(1, 45):
        enter(work, well_made(world, number))
        while work.recording.session.alarm is not None:
            enter(work, "k")
    work.do("calibrate", {"version": work.version})
    wait(work)
    assert not work.failed["decide"], work.said["decide"]
    return base


def page_of(base):
    return Work(Workplace(load_problem(base / "hsr_jr680"), base / "work", PLAIN, 0.0, Clearance()))


@pytest.fixture
def calibrated(way, tmp_path):
    return shutil.copytree(way, tmp_path / "way")


def test_a_verification_is_of_the_touches_kept_as_they_are(calibrated):
    """A touch kept to verify that is taken back changes nothing of the calibration, and all of its verification."""
    work = page_of(calibrated)
    work.do("verify", {"version": work.version, "tolerance": ""})
    wait(work)
    assert work.verified is not None
    kept = next(touch.number for touch in work.recording.session.touches if touch.purpose == "check")
    fitted = next(touch.number for touch in work.recording.session.touches if touch.purpose == "fit")
    for line in (f"u {kept}", f"s {kept}", f"s {kept}"):
        enter(work, line)
        gates = document(work)["gates"]
        assert work.verified is None
        assert gates["verify"]["state"] == "open"
        assert not gates["verify"]["said"]
        assert not work.outdated, "the touches that were fitted are as they were"
        assert "nobody has checked" in gates["hand_over"]["missing"]
    enter(work, f"u {fitted}")
    assert work.outdated
    assert "as they are" in document(work)["gates"]["hand_over"]["missing"]


def test_a_problem_that_was_edited_asks_for_a_restart_and_a_restart_begins(calibrated):
    work, file = page_of(calibrated), calibrated / "hsr_jr680" / "problem.py"
    text = file.read_text()
    file.write_text(f"{text}\n# a remark changes nothing\n")
    assert not work.edited
    file.write_text(f"{text}\nREMARK = 1\n")
    with pytest.raises(CasacalError, match="start it again"):
        work.do("calibrate", {"version": work.version})
    assert "start it again" in document(work)["gates"]["cell"]["missing"]
    again = page_of(calibrated)
    gate = document(again)["gates"]["decide"]
    assert gate["failed"]
    assert "has changed since the calibration" in gate["said"][0]
    assert document(again)["gates"]["hand_over"]["state"] == "ahead"
    assert document(again)["gates"]["measure"]["made"] == 44
    again.do("calibrate", {"version": again.version})
    wait(again)
    assert not again.failed["decide"]


TARGETS = 'name,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n"left, low",10,20,30,-50,-55,-50\nhigh,0,10,20,0,30,0\n'
JOINTS = np.radians([[10, 20, 30, -50, -55, -50], [0, 10, 20, 0, 30, 0]])
SCRIPT = f"movej([{', '.join(f'{q:.9f}' for q in JOINTS[1])}])\n"


@pytest.fixture(scope="module")
def ur5_arm():
    source = load_problem(ROOT / "problems" / "ur5")
    return calibrate(source, simulate(source.problem, source.cell, samples=80, seed=3).samples).arm


def hand_over(work, frame, leave=False, **files):
    data = {name.replace("_", "."): base64.b64encode(text.encode()).decode() for name, text in files.items()}
    sent = [{"name": name, "data": each} for name, each in data.items()]
    found = work.do("correct", {"version": work.version, "files": sent, "frame": frame, "leave": leave})
    return {each["name"]: base64.b64decode(each["data"]).decode() for each in found["files"]}, found["said"]


@pytest.mark.parametrize(("frame", "expected"), [("tip", "expected_mm"), ("flange", "flange_expected_mm")])
def test_what_was_chosen_goes_where_it_was_meant_to_go(calibrated, ur5_arm, frame, expected):
    """Tip or flange of the calibrated arm stand where those of the nominal one would; the error to expect is said."""
    work = page_of(calibrated)
    held = hashlib.sha256(work.place.samples.read_bytes()).hexdigest()
    parts = {**ur5_arm.document, "data": {**ur5_arm.document["data"], "sha256": held}}  # as if from these touches
    work.arm = replace(ur5_arm, document=FrozenMapping(parts))  # whose tool is no better known than its flange
    gate = document(work)["gates"]["hand_over"]
    assert [value for value, _ in gate["frames"]] == ["tip", "flange"]  # the first is what Decide speaks of
    value = getattr(work.arm.found.tip, expected)
    assert mm(value) in dict(gate["frames"])[frame]
    out, said = hand_over(work, frame, a_csv=TARGETS, a_script=SCRIPT)
    assert any(f"a.csv: position error of the {frame} to expect" in each for each in said)
    assert any(f"a.script: position error of the {frame} to expect" in each for each in said)
    rows = rows_of(out["corrected_a.csv"])
    assert [row[rows[0].index("name")] for row in rows[1:]] == ["left, low", "high"]
    first = rows[0].index("q1_deg")
    moved = np.radians([[float(cell) for cell in row[first : first + 6]] for row in rows[1:]])
    program = [float(each) for each in re.findall(r"-?\d+\.\d+", out["corrected_a.script"])]
    assert program == pytest.approx(moved[1].tolist(), abs=1e-8)
    for each in ("tip", "flange"):
        meant = predict(work.arm, JOINTS, frame=each, nominal=True).positions
        miss = np.linalg.norm(predict(work.arm, moved, frame=each).positions - meant, axis=1).max()
        assert (miss < 1e-3) == (each == frame), (each, miss)


def test_the_tip_is_not_corrected_for_another_tool(calibrated):
    work = page_of(calibrated)
    nominal = predict(work.arm, JOINTS[1:], nominal=True).poses[0]
    place = nominal @ np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 40.0], [0, 0, 0, 1]])
    turn = Rotation.from_matrix(place[:3, :3]).as_rotvec()
    pose = ", ".join(f"{value:.6f}" for value in [*place[:3, 3] / 1000, *turn])
    text = f"set_tcp(p[0,0,0.04,0,0,0])\n{SCRIPT}movel(p[{pose}])\n"
    with pytest.raises(CasacalError, match=r"welding\.script, line 2.*its tool ends 40.*Correct the flange"):
        hand_over(work, "tip", welding_script=text)
    assert "corrected.script" in hand_over(work, "flange", welding_script=text)[0]


def test_several_files_are_all_corrected_or_none(calibrated):
    work = page_of(calibrated)
    out, said = hand_over(work, "tip", a_csv=TARGETS, b_csv=TARGETS.replace("high", "low"))
    assert list(out) == ["corrected_a.csv", "corrected_b.csv"]
    assert all(each.startswith(("a.csv: ", "b.csv: ")) for each in said)
    with pytest.raises(CasacalError, match=r"^b\.csv, line 3") as refused:
        hand_over(work, "tip", a_csv=TARGETS, b_csv=TARGETS.replace("high,0", "high,x"))
    assert str(calibrated) not in str(refused.value)
    assert "/" not in str(refused.value)
    with pytest.raises(CasacalError) as refused:
        hand_over(work, "tip", a_script="nothing()\n")
    assert "a.script holds no move" in str(refused.value)


def test_moves_that_cannot_be_corrected_stay_where_that_is_wanted(calibrated):
    """One singular posture keeps back a program, and the page says how to have the others corrected."""
    work, straight = page_of(calibrated), "movej([0,0,0,0,-1.5707963,0])\n"
    with pytest.raises(CasacalError, match=r"line 2.*singular") as refused:
        hand_over(work, "flange", a_script=SCRIPT + straight)
    assert "with the box under Hand over" in for_page(str(refused.value))
    out, said = hand_over(work, "flange", leave=True, a_script=SCRIPT + straight)
    first, second = out["corrected.script"].splitlines(keepends=True)
    assert first != SCRIPT
    assert second == straight
    assert any(each.startswith("Left as it is: ") and "singular" in each for each in said)


def test_targets_that_are_not_reached_are_said_first(calibrated):
    said = hand_over(page_of(calibrated), "tip", a_csv=TARGETS.replace("high,0", "high,999"))[1]
    assert "1 of 2 targets not reached" in said[0]
    assert "Not reached: line 3, the target's own joint values are outside the limits" in said[1]


def test_a_correction_that_gains_nothing_is_warned_of():
    assert no_gain(np.array([0.5, 0.4]), np.array([0.3, 0.3])) == []
    assert no_gain(np.array([0.5, 0.4]), np.full(2, np.nan)) == []
    (words,) = no_gain(np.array([0.5, 0.5]), np.array([0.84, 0.84]))
    assert "(0.84 mm RMS) is not smaller than what it removes (0.5 mm RMS)" in words


def test_words_of_the_terminal_are_named_as_such():
    for words in ("Name another --out", "run casacal check X", "leave them by --skip-unknown"):
        assert "in a terminal" in for_page(words)
    assert "serve the problem that it writes" in for_page("a gauge block of 100 mm on 'floor' (--block=100)")
    for words in ("End casacal serve", "1 to 3 -- or more", "written by casacal 1.0: compensate x"):
        assert for_page(words) == words


def test_conventions_are_confirmed_twice_and_taken_back_where_poses_contradict(planned, tmp_path):
    folder = problem_of_its_own(tmp_path)
    source = load_problem(folder)
    rows = {"right": [], "turned": [], "nothing": []}
    rng = np.random.default_rng(3)
    for k in range(5):
        q = rng.uniform(-0.8, 0.8, 6)
        pose = np.array(source.problem.robot.traced.at_drawn(q)).astype(float)
        turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
        for name, joints in (("right", q), ("turned", q * [-1, 1, 1, 1, 1, 1]), ("nothing", q + 0.3 * k)):
            numbers = [*np.degrees(joints), *pose[:3, 3], *turn]
            rows[name].append(" ".join(f"{value:.6f}" for value in numbers).replace(".", "," if k else "."))
    work = Work(Workplace(source, tmp_path / "work", PLAIN, 0.0, Clearance(), plan=planned[0]))

    def compare(name):
        work.do("conventions", {"version": work.version, "form": "rxyz", "rows": "\n".join(rows[name])})
        return document(work)["gates"]["conventions"]["state"]

    for contradicts in ("turned", "nothing"):
        assert [compare("right"), compare("right")] == ["passed", "passed"]
        assert compare(contradicts) == "open"
        assert "counts no more" in work.said["conventions"][-1]
        assert not load_problem(folder).confirmed
    (folder / "conventions.json").write_text('{"written_by": "written by casacal 0.9", "poses": 4}')  # as it once was
    work.source = load_problem(folder)
    assert "conventions.json" in document(work)["gates"]["conventions"]["missing"]
    assert compare("right") == "passed"
