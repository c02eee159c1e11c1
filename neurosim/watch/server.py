"""The page's server, only for this computer's own browser.

It listens on the loopback address alone. Other programs on this computer, and other pages in its
browser, have no access: every address contains a random secret of this run; a request must name
this server as its host, so that a foreign name that resolves to this computer has no access (DNS
rebinding); and requests of other sites' pages are rejected. The page may not load anything from
elsewhere, and no other page may frame it.
"""

from __future__ import annotations

import errno
import hmac
import json
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any

from neurosim.base.errors import UserError
from neurosim.watch.sketch import PARTS
from neurosim.watch.viewer import CORNERS, Viewer

HOST = "127.0.0.1"
#: Longest body of a request: a click, or positions of levers.
LONGEST_BODY = 4096
#: Largest number of connections; a browser has six. A further one replaces the oldest that has not
#: sent the secret yet.
CONNECTIONS = 32
#: Seconds within which a request must be complete, or the connection is closed.
ASK_WITHIN = 10.0
#: Longest wait of a request for the next picture, s.
PATIENCE = 1.0

_PAGES = {
    "": ("page.html", "text/html; charset=utf-8"),
    "page.css": ("page.css", "text/css; charset=utf-8"),
    "page.js": ("page.js", "text/javascript; charset=utf-8"),
    "hand.js": ("hand.js", "text/javascript; charset=utf-8"),
}
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


class PageServer:
    """Serves a viewer's page on the loopback address while used as a context.

    Attributes:
        url: the page's address, with its secret.
    """

    def __init__(self, viewer: Viewer, port: int = 0):
        """Open the port; 0 for any free one.

        Raises:
            UserError: if the port is taken.
        """
        token = secrets.token_urlsafe(24)

        self._over = threading.Event()
        parts = {"viewer": viewer, "token": token, "over": self._over}
        handler = type("Handler", (_Handler,), parts)
        try:
            self._server = _Server((HOST, port), handler)
        except PermissionError:
            raise UserError(f"port {port} may not be used; name one above 1023") from None
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            raise UserError(
                f"port {port} is taken by another program; name another with --port, or leave it "
                "out for any that is free"
            ) from None
        self.address: tuple[str, int] = self._server.server_address[:2]
        handler.port = self.address[1]
        self.url = f"http://{HOST}:{self.address[1]}/{token}/"
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), name="page server", daemon=True
        )

    def __enter__(self) -> PageServer:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    # On Windows it would let two servers share the port.
    allow_reuse_address = os.name != "nt"
    # A browser must not wait for others until it is accepted.
    request_queue_size = 128

    def __init__(self, *args: Any):
        super().__init__(*args)
        # For every connection: time since which its request is waited for; None while it is
        # answered.
        self.asking: dict[socket.socket, float | None] = {}
        # Connections that sent the secret.
        self.known: set[socket.socket] = set()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a new thread, unless there are too many."""
        if len(self.asking) >= CONNECTIONS and not self._make_room():
            super().shutdown_request(request)
            return
        self.asking[request] = time.monotonic()
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        self.asking.pop(request, None)
        self.known.discard(request)
        super().shutdown_request(request)

    def waits(self, request: Any, since: float | None) -> None:
        """Note the time since which an accepted connection is waited for; None: it is not."""
        if request in self.asking:
            self.asking[request] = since

    def _make_room(self) -> bool:
        """Close the oldest connection that has not sent the secret; False: all have sent it."""
        strangers = (each for each in list(self.asking) if each not in self.known)
        oldest = next(strangers, None)
        if oldest is None:
            return False
        self.asking.pop(oldest, None)
        with suppress(OSError):
            oldest.shutdown(socket.SHUT_RDWR)
        return True

    def service_actions(self) -> None:
        """Close connections without a request, some times a second."""
        latest = time.monotonic() - ASK_WITHIN
        for request, since in list(self.asking.items()):
            if since is not None and since < latest:
                with suppress(OSError):
                    request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing: a browser may leave in the middle of a picture."""


class _Refused(Exception):
    """A request that gets only a status."""

    def __init__(self, status: HTTPStatus, why: str):
        super().__init__(why)
        self.status = status


class _Handler(BaseHTTPRequestHandler):
    viewer: Viewer
    token: str
    port: int
    over: threading.Event

    server: _Server

    protocol_version = "HTTP/1.1"
    server_version, sys_version = "neurosim", ""
    timeout = 30

    def handle_one_request(self) -> None:
        """Wait for a request, and answer it."""
        self.server.waits(self.connection, time.monotonic())
        super().handle_one_request()

    def do_GET(self) -> None:
        """Give the page, its parts, or the next picture."""
        self._answer(self._get)

    def do_POST(self) -> None:
        """Take the settings of the page."""
        self._answer(self._post)

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing: the terminal is for people."""

    def _answer(self, how: Callable[[str], tuple[bytes, str, dict[str, str]]]) -> None:
        try:
            body, kind, headers = how(self._checked())
            status = HTTPStatus.OK
        except _Refused as refused:
            status, headers = refused.status, {}
            body, kind = f"{refused}\n".encode(), "text/plain; charset=utf-8"
            # The following bytes may be the unread body.
            self.close_connection = True
        except UserError as error:
            # Errors of a person are shown to the person.
            status, headers = HTTPStatus.OK, {}
            body, kind = _json({"error": str(error)})
        self.server.waits(self.connection, None)
        self.send_response(status)
        for name, value in {**_HEADERS, **headers}.items():
            self.send_header(name, value)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _checked(self) -> str:
        """Return the path of an allowed request, below the secret."""
        if self.over.is_set():
            raise _Refused(HTTPStatus.SERVICE_UNAVAILABLE, "neurosim has ended")
        own = {f"{name}:{self.port}" for name in (HOST, "localhost")}
        hosts = self.headers.get_all("Host", [])
        if len(hosts) != 1 or hosts[0] not in own:
            raise _Refused(HTTPStatus.FORBIDDEN, "this server answers to its own name only")
        origins = self.headers.get_all("Origin", [])
        if not {f"http://{name}" for name in own}.issuperset(origins):
            raise _Refused(HTTPStatus.FORBIDDEN, "this server answers its own page only")
        if self.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
            raise _Refused(HTTPStatus.FORBIDDEN, "this server answers its own page only")
        parts = self.path.partition("?")[0].split("/", 2)
        given = parts[1] if len(parts) == 3 else ""
        if not hmac.compare_digest(given.encode(), self.token.encode()):
            raise _Refused(HTTPStatus.FORBIDDEN, "open the address that neurosim printed")
        self.server.known.add(self.connection)
        return parts[2]

    def _get(self, what: str) -> tuple[bytes, str, dict[str, str]]:
        if what in _PAGES:
            name, kind = _PAGES[what]
            return (files("neurosim.watch") / name).read_bytes(), kind, {}
        if what == "picture":
            query = self.path.partition("?")[2]
            name, _, number = query.partition("=")
            counts = name == "after" and number.isdecimal() and len(number) < 16
            after = int(number) if counts else 0
            picture, state = self.viewer.picture(after, PATIENCE)
            described = json.dumps(state, separators=(",", ":"), ensure_ascii=True)
            return picture, "image/jpeg", {"Neurosim-State": described}
        if what == "drawing":
            return *_json(self.viewer.drawing()), {}
        raise _Refused(HTTPStatus.NOT_FOUND, "there is nothing here")

    def _post(self, what: str) -> tuple[bytes, str, dict[str, str]]:
        asked = self._body()
        if what in ("drive", "end") and (hand := self.viewer.hand) is not None:
            if what == "end":
                hand.end()
            else:
                hand.take(*_levers(asked))
            return *_json(hand.state()), {}
        if not self.viewer.settable:
            raise UserError("settings cannot be changed during a recording")
        viewer = self.viewer
        if what == "colour":
            message = viewer.set_colour(_one_of(asked, "which", ("front", "rear")), *_place(asked))
        elif what == "corner":
            message = viewer.set_corner(_one_of(asked, "corner", tuple(CORNERS)), *_place(asked))
        elif what == "clear":
            message = viewer.clear_corners()
        elif what == "board":
            height = None if asked.get("height") is None else _number(asked, "height")
            message = viewer.set_board(_number(asked, "length"), _number(asked, "width"), height)
        elif what == "draw":
            part = _one_of(asked, "part", tuple(PARTS))
            message = viewer.draw(part, *_place(asked), _number(asked, "width"))
        elif what == "finish":
            message = viewer.finish(_number(asked, "width"))
        elif what == "undo":
            message = viewer.undo()
        elif what == "save":
            name = _one_of(asked, "what", ("calibration", "markers", "place"))
            message = viewer.save(name, replace=asked.get("replace") is True)
        else:
            raise _Refused(HTTPStatus.NOT_FOUND, "there is nothing here")
        return *_json({"message": message, "corners": viewer.corners}), {}

    def _body(self) -> dict[str, Any]:
        if self.headers.get_content_type() != "application/json":
            raise _Refused(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "expected JSON")
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal():
            raise _Refused(HTTPStatus.LENGTH_REQUIRED, "expected a length")
        if int(length) > LONGEST_BODY:
            raise _Refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "that is too long")
        try:
            asked = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            asked = None
        if not isinstance(asked, dict):
            raise _Refused(HTTPStatus.BAD_REQUEST, "expected a JSON object")
        return asked


def _json(content: dict[str, Any]) -> tuple[bytes, str]:
    return json.dumps(content).encode(), "application/json"


def _one_of(asked: dict[str, Any], name: str, possible: tuple[str, ...]) -> str:
    if asked.get(name) not in possible:
        raise _Refused(HTTPStatus.BAD_REQUEST, f"{name}: expected one of {', '.join(possible)}")
    return asked[name]


def _number(asked: dict[str, Any], name: str) -> float:
    value = asked.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e6:
        raise _Refused(HTTPStatus.BAD_REQUEST, f"{name}: expected a number")
    return float(value)


def _levers(asked: dict[str, Any]) -> tuple[str, list[float] | None, float]:
    """Return the page's name, the levers' positions and the speed; None: the page is closed."""
    page, levers = asked.get("page"), asked.get("levers")
    if not isinstance(page, str):
        raise _Refused(HTTPStatus.BAD_REQUEST, "page: expected a name")
    if levers is None:
        return page, None, 0.0
    if not isinstance(levers, list):
        raise _Refused(HTTPStatus.BAD_REQUEST, "levers: expected a list")
    named = {f"lever {place}": value for place, value in enumerate(levers)}
    return page, [_number(named, name) for name in named], _number(asked, "speed")


def _place(asked: dict[str, Any]) -> tuple[float, float]:
    return _number(asked, "u"), _number(asked, "v")
