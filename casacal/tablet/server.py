"""The page over HTTP: one address, one token, nothing that a browser elsewhere could use.

Starlette routes and uvicorn serves: a small, well-kept pair that answers in threads and streams events. The first visit
brings the token in the address; from then on a cookie holds it, which no script and no other site can use. Requests
must name this machine as their host, so that no name of somebody else's leads here (DNS rebinding), and steps must come
from a page of this origin. The client names no path and no code: only steps, texts, numbers, and files by fixed names.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import os
import re
import secrets
import socket
from collections.abc import AsyncIterator, Mapping
from contextlib import suppress
from importlib import resources
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from casacal.errors import CasacalError, RefusedResultError
from casacal.files import writable
from casacal.pages import space
from casacal.tablet.gates import document, files
from casacal.tablet.work import OutdatedError, Work, for_page, unforeseen

try:
    import uvicorn
    from starlette.applications import Starlette
    from starlette.concurrency import run_in_threadpool
    from starlette.datastructures import MutableHeaders
    from starlette.requests import Request
    from starlette.responses import JSONResponse, PlainTextResponse, RedirectResponse, Response, StreamingResponse
    from starlette.routing import Route
    from starlette.types import ASGIApp, Message, Receive, Scope, Send
except ImportError:
    raise CasacalError("Starlette and uvicorn are not installed", "Install them: pip install 'casacal[page]'") from None

LARGEST = 4 << 20  # bytes of a request: a robot program, in base64
IN_SPACE = ("space.js", "three.module.min.js")
"""Scripts that reports have as well."""
STATIC = {"page.css": "text/css", **dict.fromkeys(("page.js", *IN_SPACE), "text/javascript")}
LOOK = 10  # ticks between two looks at the files of the work
TICK, BEAT = 0.1, 15.0  # seconds between two looks for a change, and between two signs of life to a window
FILES_POLICY = (
    "sandbox allow-scripts; default-src 'none'; style-src 'unsafe-inline'; img-src data:; "
    "script-src 'unsafe-inline' blob:; frame-ancestors 'self'"
)
"""Reports are shown in a frame of the page, with their own style and script, and as if from nowhere."""
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "frame-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    ),
}


class Door:
    """Lets in who has the token, by its cookie or once in the address, and came to this machine by its own name."""

    def __init__(self, app: ASGIApp, token: str, cookie: str, host: str = "") -> None:
        self.app, self.token, self.cookie, self.host = app, token, cookie, host

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or hand it on to the page."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        request = Request(scope)
        refused = self._refused(request)
        if refused is not None:
            await refused(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)  # a file of the work has a policy of its own
            await send(message)

        await self.app(scope, receive, with_headers)

    def _refused(self, request: Request) -> Response | None:
        """An answer to who is not let in, and the way on for who has just shown the token; None for others."""
        if not is_this_machine(request.headers.get("host", ""), self.host):
            return PlainTextResponse("This page is reached by the address that casacal serve printed.\n", 421)
        shown = request.query_params.get("token")
        if shown is not None and request.url.path == "/" and request.method == "GET":
            if not _same(shown, self.token):
                return PlainTextResponse("The token in the address is not the one that was printed.\n", 403)
            welcome = RedirectResponse("/", 303, headers=HEADERS)
            welcome.set_cookie(self.cookie, self.token, httponly=True, samesite="strict", path="/")
            return welcome
        if not _same(request.cookies.get(self.cookie, ""), self.token):
            return PlainTextResponse("Open the address that casacal serve printed, with its token.\n", 403)
        origin = request.headers.get("origin")
        if request.method != "GET" and (origin is None or origin.partition("://")[2] != request.headers.get("host")):
            return PlainTextResponse("A step must come from the page itself.\n", 403)
        return None


def is_this_machine(host: str, called: str = "") -> bool:
    """Whether a Host header names this machine: an address in numbers, localhost, its own name, or that `called`."""
    name = host.rpartition("]")[0].removeprefix("[") if host.startswith("[") else host.partition(":")[0]
    own = socket.gethostname().lower()
    if name and name.lower() in ("localhost", own, f"{own}.local", called.lower()):
        return True
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


def _same(one: str, two: str) -> bool:
    return hmac.compare_digest(one.encode(), two.encode())


class Pages:
    """What the page of some work answers to each address."""

    def __init__(self, work: Work) -> None:
        self.work = work

    async def page(self, _: Request) -> Response:
        """The page itself, which asks for all else."""
        return Response(static("page.html"), media_type="text/html")

    async def asset(self, request: Request) -> Response:
        """A style or a script."""
        name = request.path_params["name"]
        if name not in STATIC:
            return PlainTextResponse("There is no such file.\n", 404)
        return Response(static(name), media_type=STATIC[name])

    def state(self, _: Request) -> Response:
        """All that is shown."""
        self.work.look()
        return JSONResponse(document(self.work))

    def space(self, _: Request) -> Response:
        """The cell and the planned postures in space."""
        return JSONResponse(self.work.space())

    def stands(self, _: Request) -> Response:
        """Where the controller shows the arm."""
        return JSONResponse(self.work.stands())

    def file(self, request: Request) -> Response:
        """A file by its name: pages to be shown, others to be kept."""
        name = request.path_params["name"]
        path = files(self.work).get(name)
        if path is None or not path.is_file():
            return PlainTextResponse("There is no such file yet.\n", 404)
        kind = {"html": "text/html", "json": "application/json"}.get(name.rpartition(".")[2], "text/csv")
        headers = {"Content-Security-Policy": FILES_POLICY}
        if kind != "text/html":
            headers["Content-Disposition"] = f'attachment; filename="{name}"'
        return Response(path.read_bytes(), media_type=kind, headers=headers)

    async def fell(self, _: Request, error: Exception) -> Response:
        """What nobody foresaw, as a sentence; the log has it whole."""
        return answer(500, unforeseen(error))

    async def step(self, request: Request) -> Response:
        """Take a step: the new state, or a sentence on why it was not taken."""
        body = b""
        async for part in request.stream():
            body += part
            if len(body) > LARGEST:
                return answer(413, f"More than {LARGEST >> 20} MB came. Choose a smaller file.")
        try:
            asked = json.loads(body)
            name = asked["step"]
        except (ValueError, KeyError, TypeError, RecursionError):
            return answer(400, "What came is no step. Load the page again.")
        try:
            found = await run_in_threadpool(self.work.do, name if isinstance(name, str) else "", asked)
            return JSONResponse(found | {"state": await run_in_threadpool(document, self.work)})
        except CasacalError as error:
            status = {OutdatedError: 409, RefusedResultError: 403}.get(type(error), 400)
            return answer(status, str(error))

    async def events(self, request: Request) -> Response:
        """The version of the state, each time that it changes."""

        async def changes() -> AsyncIterator[str]:
            last, silent, ticks = -1, 0.0, 0
            while not await request.is_disconnected():
                silent, ticks = silent + TICK, ticks + 1
                if ticks % LOOK == 0:  # what a terminal does to the files is shown too
                    await run_in_threadpool(self.work.look)
                if self.work.version != last or silent > BEAT:
                    last, silent = self.work.version, 0.0
                    yield f"data: {last}\n\n"
                await asyncio.sleep(TICK)

        return StreamingResponse(changes(), media_type="text/event-stream")


def application(work: Work, *, token: str, cookie: str = "casacal", host: str = "") -> ASGIApp:
    """The page of some work, as an ASGI application.

    token: what opens it. cookie: the name under which it is kept. host: by which name this machine is reached, too.
    """
    pages = Pages(work)
    routes = [
        Route("/", pages.page),
        Route("/static/{name}", pages.asset),
        Route("/state", pages.state),
        Route("/space", pages.space),
        Route("/stands", pages.stands),
        Route("/file/{name}", pages.file),
        Route("/events", pages.events),
        Route("/step", pages.step, methods=["POST"]),
    ]
    return Door(Starlette(routes=routes, exception_handlers={Exception: pages.fell}), token, cookie, host)


def answer(status: int, words: str) -> Response:
    """A refusal in a sentence."""
    return JSONResponse({"error": for_page(words)}, status)


def static(name: str) -> bytes:
    """A file of the page as it is shipped."""
    return (
        space.static(name) if name in IN_SPACE else (resources.files("casacal.tablet") / "static" / name).read_bytes()
    )


def listening(host: str, port: int) -> socket.socket:
    """A socket at an address of this machine, 0 for any free port; raises CasacalError where it is taken."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    place = socket.socket(family, socket.SOCK_STREAM)
    place.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        place.bind((host, port))
        place.listen()
    except (OSError, OverflowError) as error:
        place.close()
        what = f"Nothing can be served at {host}, port {port} ({getattr(error, 'strerror', None) or error})"
        raise CasacalError(what, "Name another --port or --host") from None
    return place


def address_of(host: str, port: int) -> str:
    """The address that a browser opens: of a host that stands for all of this machine, the one in its network."""
    if host in ("0.0.0.0", "::"):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.connect(("192.0.2.1", 9))  # of nobody (RFC 5737); nothing is sent, a way there is chosen
                host = probe.getsockname()[0]
            except OSError:
                host = socket.gethostname()
    return f"http://{f'[{host}]' if ':' in host else host}:{port}"


def token_of(folder: Path) -> str:
    """The token that a folder keeps for its owner alone, or a new one: 128 random bits that nobody guesses.

    Kept, so that the page of a tablet goes on after this program was ended and begun again.
    """
    file = folder / "page.token"
    with suppress(OSError):
        kept = file.read_text(encoding="ascii", errors="replace")
        if re.fullmatch(r"[\w-]{22}", kept):
            return kept
    token = secrets.token_urlsafe(16)
    with writable(file):
        folder.mkdir(parents=True, exist_ok=True)
        file.unlink(missing_ok=True)
        with open(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="ascii") as out:
            out.write(token)
    return token


def server(work: Work, token: str, port: int, host: str = "") -> uvicorn.Server:
    """A server of the page, to be run on a socket of `listening`; `host` as for `application`."""
    app = application(work, token=token, cookie=f"casacal_{port}", host=host)
    settings: Mapping[str, Any] = {"log_level": "critical", "timeout_graceful_shutdown": 1, "server_header": False}
    return uvicorn.Server(uvicorn.Config(app, **settings))
