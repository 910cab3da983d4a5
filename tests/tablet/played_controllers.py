"""Controllers that play their protocols on loopback: RTDE of Universal Robots, Robot Web Services of ABB."""

import base64
import hashlib
import json
import math
import re
import socketserver
import ssl
import struct
import threading
import time
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class PlayedArm:
    """Joint values (rad) that are shown, and what else the controller does: `drift` a look, `says` in place of all."""

    def __init__(self, joints, *, drift=0.0, says=None):
        self.joints, self.drift, self.says, self.looks = list(joints), drift, says, 0

    def now(self):
        self.looks += 1
        return [q + self.drift * self.looks for q in self.joints]


@contextmanager
def _running(server):
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield f"127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()


@contextmanager
def rtde_controller(arm):
    """HOST:PORT of a controller that answers version, recipe and start, and sends a message before each package."""

    class Handler(socketserver.StreamRequestHandler):
        disable_nagle_algorithm = True  # which would put the parts together again

        def send(self, kind, payload):
            package = struct.pack(">HB", 3 + len(payload), ord(kind)) + payload
            for part in (package[:2], package[2:5], package[5:]):  # a network parts packages where it likes
                self.wfile.write(part)
                time.sleep(0.002)

        def handle(self):
            if arm.says is not None:
                self.wfile.write(arm.says)
                return
            while head := self.rfile.read(3):
                size, kind = struct.unpack(">HB", head)
                payload = self.rfile.read(size - 3)
                if chr(kind) == "V":
                    self.send("V", bytes([struct.unpack(">H", payload)[0] == 2]))
                elif chr(kind) == "O":
                    assert struct.unpack(">d", payload[:8])[0] > 0
                    known = payload[8:] == b"actual_q"
                    self.send("O", bytes([7]) + (b"VECTOR6D" if known else b"NOT_FOUND"))
                elif chr(kind) == "S":
                    self.send("S", b"\x01")
                    self.send("M", b"\x05hello\x04robo\x01")
                    self.send("U", bytes([7]) + struct.pack(">6d", *arm.now()))

    class Server(socketserver.ThreadingTCPServer):
        daemon_threads = True

        def handle_error(self, request, client_address):
            """A client that has gone away is no error here."""

    with _running(Server(("127.0.0.1", 0), Handler)) as address:
        yield address


@contextmanager
def rws_controller(arm, *, user="Default User", password="robotics", unit="ROB_1", most_sessions=3, tls=None):
    """HOST:PORT of a controller that wants digest authentication (RFC 2617) and has few sessions.

    tls: the file of a key and certificate; then it is one of RobotWare 7, which wants the basic scheme.
    """
    sessions = set()

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_):
            pass

        def refuse(self, status, *headers):
            self.send_response(status)
            for name, value in headers:
                self.send_header(name, value)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def newer(self):
            basic = base64.b64encode(f"{user}:{password}".encode()).decode()
            if self.headers.get("Authorization") != f"Basic {basic}":
                self.refuse(401, ("WWW-Authenticate", 'Basic realm="validusers@robapi.abb"'))
                return
            assert self.path == f"/rw/motionsystem/mechunits/{unit}/jointtarget"
            assert self.headers["Accept"] == "application/hal+json;v=2.0"
            values = {f"rax_{k}": f"{math.degrees(q):.6f}" for k, q in enumerate(arm.now(), 1)}
            body = json.dumps({"state": [{"_type": "ms-jointtarget", **values}]}).encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def do_GET(self):
            if tls is not None:
                self.newer()
                return
            given = dict(re.findall(r'(\w+)="?([^",]+)"?', self.headers.get("Authorization", "")))
            ha = [
                hashlib.md5(text.encode()).hexdigest()
                for text in (f"{user}:validusers@robapi.abb:{password}", f"GET:{self.path}")
            ]
            text = ":".join([ha[0], "n0nce", given.get("nc", ""), given.get("cnonce", ""), "auth", ha[1]])
            if given.get("response") != hashlib.md5(text.encode()).hexdigest():
                challenge = 'Digest realm="validusers@robapi.abb", qop="auth", nonce="n0nce", algorithm=MD5'
                self.refuse(401, ("WWW-Authenticate", challenge))
                return
            if self.path != f"/rw/motionsystem/mechunits/{unit}/jointtarget?json=1":
                self.refuse(404)
                return
            cookie = self.headers.get("Cookie")
            if cookie is None:
                if len(sessions) == most_sessions:
                    self.refuse(503)
                    return
                sessions.add(cookie := f"ABBCX={len(sessions)}")
            values = {f"rax_{k}": f"{math.degrees(q):.6f}" for k, q in enumerate(arm.now(), 1)}
            state = {"_type": "ms-jointtarget", "_title": unit, **values, "eax_a": "8.999999873E+09"}
            body = json.dumps({"_links": {}, "_embedded": {"_state": [state]}}).encode()
            self.send_response(200)
            self.send_header("Set-Cookie", cookie)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    if tls is not None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(tls)
        server.socket = context.wrap_socket(server.socket, server_side=True)
    with _running(server) as address:
        yield address
