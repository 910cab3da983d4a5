"""Joint values as a controller shows them, read and never written: Universal Robots and ABB.

Universal Robots: the Real-Time Data Exchange of the controller, port 30004, protocol version 2 ("RTDE Guide" of
Universal Robots): packages of a size (16 bits, the header included), a type (one byte) and a payload, big-endian.
ABB: Robot Web Services of RobotWare 6 (HTTP, digest) and 7 (HTTPS, basic), resource `jointtarget` of a mechanical unit.
"""

from __future__ import annotations

import json
import math
import socket
import struct
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BufferedRWPair
from typing import Any
from urllib.parse import quote

import numpy as np

from casacal.errors import CasacalError, harmless
from casacal.model.robot import Robot
from casacal.values import Array

PATIENCE = 2.0  # seconds after which a controller that does not answer is given up
BETWEEN = 0.1  # seconds between two looks at an arm, which stands where both agree
STILL = math.radians(0.01)  # rad by which they may differ: encoders flicker by less, a jogged arm moves by more
AXES = 6
RTDE_PORT = 30004
LARGEST = 4096  # bytes of a package, and of a page of RWS, that are read


@dataclass(frozen=True)
class Controller:
    """A controller by what it is called and how it is asked for its six joint values (rad)."""

    name: str
    ask: Callable[[], Array]

    def joints(self) -> Array:
        """Joint values (6,; rad) now; raises CasacalError where the controller does not give them."""
        try:
            found = self.ask()
        except (OSError, ValueError, KeyError, IndexError, TypeError, struct.error) as error:
            said = harmless(" ".join(str(error).split()))[:200] or type(error).__name__
            what = f"The controller at {self.name} gives no joint values ({said})"
            raise CasacalError(what, "Check the link, or type the joint values with the reading") from None
        if found.shape != (AXES,) or not np.isfinite(found).all():
            what = f"The controller at {self.name} gives {len(found)} joint values, or some that are not finite"
            raise CasacalError(what, "Type the joint values with the reading")
        return found

    def standing(self) -> Array:
        """Joint values (6,; rad) of an arm that stands; raises CasacalError while it moves, and as `joints`."""
        before = self.joints()
        time.sleep(BETWEEN)
        after = self.joints()
        if np.abs(after - before).max() > STILL:
            raise CasacalError("The arm is moving", "Take the reading when it stands")
        return after


def controller(spelled: str, robot: Robot) -> Controller:
    """A controller from KIND:ADDRESS, for an arm of six turning joints.

    rtde:HOST[:PORT] is Universal Robots'. rws:HOST[:PORT] is ABB's: http unless it begins with https://, as its default
    user unless USER:PASSWORD@ stands before the host, mechanical unit ROB_1 unless another one follows a slash.

    Nothing is asked yet. Raises CasacalError for another kind or arm, and for an address that is none.
    """
    kind, _, address = spelled.partition(":")
    if kind not in KINDS or not address.strip("/"):
        fix = "Give rtde:ADDRESS (Universal Robots) or rws:ADDRESS (ABB), such as rtde:192.168.0.10"
        raise CasacalError(f"--joints {spelled} names no controller", fix)
    if len(robot.axes) != AXES or not robot.revolute.all():
        what = f"--joints is for arms of six turning joints, and '{robot.name}' is another"
        raise CasacalError(what, "Leave it out, and type the joint values with the reading")
    return Controller(address.rpartition("@")[2], KINDS[kind](address))


REQUEST_VERSION, SETUP_OUTPUTS, START, DATA = b"V", b"O", b"S", b"U"
VERSION, FREQUENCY = 2, 10.0  # of the protocol; packages a second, of which one is read


def rtde(address: str) -> Callable[[], Array]:
    """What gives the actual joint values (6,; rad) of a Universal Robots controller, over a connection of its own."""
    host, port = _host_and_port(address, RTDE_PORT)

    def ask() -> Array:
        with socket.create_connection((host, port), PATIENCE) as at, at.makefile("rwb") as link:
            if _answer(link, REQUEST_VERSION, struct.pack(">H", VERSION)) != b"\x01":
                raise ValueError(f"it does not speak version {VERSION} of RTDE")
            recipe = _answer(link, SETUP_OUTPUTS, struct.pack(">d", FREQUENCY) + b"actual_q")
            if recipe[1:] != b"VECTOR6D":
                raise ValueError("it has no actual_q")
            if _answer(link, START, b"") != b"\x01":
                raise ValueError("it does not start to send")
            data = _received(link, DATA)
        if data[:1] != recipe[:1]:
            raise ValueError("it sends another recipe")
        return np.array(struct.unpack(">6d", data[1:]))

    return ask


def _answer(link: BufferedRWPair, kind: bytes, payload: bytes) -> bytes:
    """Payload of the answer to a package."""
    link.write(struct.pack(">H", 3 + len(payload)) + kind + payload)
    link.flush()
    return _received(link, kind)


def _received(link: BufferedRWPair, kind: bytes) -> bytes:
    """Payload of the next package of a kind; others, such as messages, are passed over."""
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until:
        head = link.read(3)
        size, of_kind = struct.unpack(">Hc", head) if len(head) == 3 else (0, b"")
        if not 3 <= size <= LARGEST:
            raise ValueError("what answers is no RTDE" if head else "it closed the link")
        payload = link.read(size - 3)
        if of_kind == kind:
            return payload
    raise ValueError("no joint values came")


DEFAULT_USER, DEFAULT_PASSWORD = "Default User", "robotics"  # as ABB delivers its controllers


def rws(address: str) -> Callable[[], Array]:
    """What gives the joint values (6,; rad) that ABB's Robot Web Services show in degrees.

    One session is kept, of which a controller has few. Certificates are not checked: a controller signs its own.
    Raises CasacalError where httpx is not installed.
    """
    try:
        import httpx
    except ImportError:
        raise CasacalError("httpx is not installed", "Install it: pip install 'casacal[page]'") from None
    scheme, _, rest = address.rpartition("://")
    who, _, place = rest.rpartition("@")
    user, _, password = who.partition(":")
    server, _, unit = place.partition("/")
    _host_and_port(server, 443 if scheme == "https" else 80)
    if scheme not in ("", "http", "https"):
        raise CasacalError(f"'{scheme}' is not how a controller is asked", "Give http://HOST or https://HOST")
    known = (user or DEFAULT_USER, password or DEFAULT_PASSWORD)
    newer = scheme == "https"
    url = f"{scheme or 'http'}://{server}/rw/motionsystem/mechunits/{quote(unit or 'ROB_1', safe='')}/jointtarget"
    link = httpx.Client(
        auth=known if newer else httpx.DigestAuth(*known),
        headers={"Accept": "application/hal+json;v=2.0" if newer else "application/json"},
        params={} if newer else {"json": "1"},
        timeout=PATIENCE,
        verify=False,
        trust_env=False,
        limits=httpx.Limits(max_keepalive_connections=0),
    )
    lock = threading.Lock()  # the client counts challenges, and pages are asked from several threads

    def ask() -> Array:
        with lock:
            try:
                with link.stream("GET", url) as page:
                    content = next(page.iter_bytes(LARGEST), b"")
            except (httpx.HTTPError, httpx.InvalidURL) as error:
                raise OSError(str(error)) from None
        if page.is_error:
            raise ValueError(f"it answers {page.status_code} {page.reason_phrase}")
        document: Mapping[str, Any] = json.loads(content)
        state = document["state"] if "state" in document else document["_embedded"]["_state"]
        return np.radians([float(state[0][f"rax_{k}"]) for k in range(1, AXES + 1)])

    return ask


def _host_and_port(address: str, usual: int) -> tuple[str, int]:
    """Host and port of HOST[:PORT]; raises CasacalError."""
    host, colon, port = address.rpartition(":") if address.count(":") == 1 else (address, "", "")
    of_port = not colon or (port.isdecimal() and 0 < int(port) < 65536)
    if not host or not of_port or not host.isprintable() or " " in host:
        raise CasacalError(f"'{address}' is no address of a controller", "Give HOST or HOST:PORT")
    return host.strip("[]"), int(port) if colon else usual


KINDS: Mapping[str, Callable[[str], Callable[[], Array]]] = {"rtde": rtde, "rws": rws}
"""How each kind of controller is asked, by the word before its address."""
