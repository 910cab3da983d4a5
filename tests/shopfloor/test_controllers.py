"""Joint values off a controller: protocols played on loopback, and every way in which they go wrong."""

import math
import shutil
import subprocess
import sys
import threading
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import repeat

import pytest
from conftest import ROOT
from played_controllers import PlayedArm, rtde_controller, rws_controller

from casacal import CasacalError, load_problem
from casacal.shopfloor.controllers import controller

Q = [0.1, -1.2, 1.3, -0.4, 1.5, -3.1]


@pytest.fixture(scope="module")
def robot():
    return load_problem(ROOT / "problems" / "ur5").problem.robot


@pytest.mark.parametrize(("kind", "played"), [("rtde", rtde_controller), ("rws", rws_controller)])
def test_joint_values_are_those_that_the_controller_shows(robot, kind, played):
    with played(PlayedArm(Q)) as address:
        asked = controller(f"{kind}:{address}", robot)
        assert asked.joints() == pytest.approx(Q, abs=1e-8)
        for _ in range(5):  # more looks than the controller has sessions
            assert asked.standing() == pytest.approx(Q, abs=1e-8)


@pytest.mark.parametrize(("kind", "played"), [("rtde", rtde_controller), ("rws", rws_controller)])
def test_a_moving_arm_and_a_lost_link_are_said(robot, kind, played):
    arm = PlayedArm(Q, drift=math.radians(0.05))
    with played(arm) as address:
        asked = controller(f"{kind}:{address}", robot)
        with pytest.raises(CasacalError, match="The arm is moving"):
            asked.standing()
        arm.drift = math.radians(0.001)
        asked.standing()
    with pytest.raises(CasacalError, match="gives no joint values"):
        asked.standing()


@pytest.mark.parametrize(
    "says",
    [b"", b"HTTP/1.1 400 Bad Request\r\n\r\n", b"\x00\x04V\x00", b"\x00\x04V\x01\x00\x0dO\x07NOT_FOUND", b"\x00\x01"],
)
def test_what_is_no_rtde_is_no_joint_value(robot, says):
    with (
        rtde_controller(PlayedArm(Q, says=says)) as address,
        pytest.raises(CasacalError, match="gives no joint values"),
    ):
        controller(f"rtde:{address}", robot).joints()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_joint_values_that_are_none_are_refused(robot, value):
    with rtde_controller(PlayedArm([*Q[:5], value])) as address, pytest.raises(CasacalError, match="not finite"):
        controller(f"rtde:{address}", robot).joints()


def test_user_unit_and_password_of_rws(robot):
    with rws_controller(PlayedArm(Q), user="cell", password="s3cret", unit="ROB_2") as address:
        asked = controller(f"rws:cell:s3cret@{address}/ROB_2", robot)
        assert asked.joints() == pytest.approx(Q, abs=1e-8)
        assert "s3cret" not in asked.name  # no sentence shows it
        with pytest.raises(CasacalError, match="gives no joint values") as caught:
            controller(f"rws:cell:wrong@{address}/ROB_2", robot).joints()
        assert "wrong" not in str(caught.value)


def test_robotware_7_by_tls_and_the_basic_scheme(robot, tmp_path):
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("no openssl here to make a certificate with")
    both = tmp_path / "both.pem"
    made = ["req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj", "/CN=controller"]
    subprocess.run([openssl, *made, "-keyout", both, "-out", tmp_path / "cert.pem"], check=True, capture_output=True)
    both.write_text(both.read_text() + (tmp_path / "cert.pem").read_text())
    with rws_controller(PlayedArm(Q), tls=both) as address:
        assert controller(f"rws:https://{address}", robot).standing() == pytest.approx(Q, abs=1e-8)
        with pytest.raises(CasacalError, match="401"):
            controller(f"rws:https://me:wrong@{address}", robot).joints()


@pytest.mark.parametrize(
    ("spelled", "words"),
    [
        ("fanuc:10.0.0.1", "names no controller"),
        ("rtde:", "names no controller"),
        ("10.0.0.1", "names no controller"),
        ("rtde:10.0.0.1:x", "no address"),
        ("rtde:10.0.0.1:99999", "no address"),
        ("rws:ftp://10.0.0.1", "not how a controller is asked"),
        ("rws:a b", "no address"),
        ("rws:a\x00b", "no address"),
    ],
)
def test_addresses_that_are_none(robot, spelled, words):
    with pytest.raises(CasacalError, match=words):
        controller(spelled, robot)


def test_an_arm_of_other_joints_is_refused():
    robot = load_problem(ROOT / "problems" / "adept_cobra600").problem.robot
    with pytest.raises(CasacalError, match="six turning joints"):
        controller("rtde:127.0.0.1", robot)


@pytest.mark.parametrize("page", [b"{", b"[]", b'{"state": [{}]}', b'{"state": "' + 5000 * b"x", None])
def test_what_is_no_page_of_rws_is_no_joint_value(robot, page):
    """None: a page without an end, of which no more is read than a page of RWS holds."""
    sent = 0

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            nonlocal sent
            self.send_response(200)
            self.end_headers()
            with suppress(OSError):
                for part in [page] if page is not None else repeat(10_000 * b" "):
                    self.wfile.write(part)
                    sent += len(part)

        def log_message(self, *_):
            """Nothing is printed."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
    try:
        with pytest.raises(CasacalError, match="gives no joint values"):
            controller(f"rws:127.0.0.1:{server.server_address[1]}", robot).joints()
    finally:
        server.shutdown()
        server.server_close()
    assert sent < 100_000_000


@pytest.mark.parametrize("host", ["ä" * 70, "a[b", "[::1", "%", "xn--a", "a..b", "1.2.3.4.5"])
def test_a_host_that_cannot_be_is_said_when_it_is_asked(robot, host):
    with pytest.raises(CasacalError, match=r"gives no joint values|no address"):
        controller(f"rws:{host}", robot).joints()


def test_a_missing_library_is_said(robot, monkeypatch):
    monkeypatch.setitem(sys.modules, "httpx", None)
    with pytest.raises(CasacalError, match=r"httpx is not installed.*casacal\[page\]"):
        controller("rws:127.0.0.1", robot)


def test_the_name_is_the_address_alone(robot):
    assert controller("rtde:192.168.0.10", robot).name == "192.168.0.10"
