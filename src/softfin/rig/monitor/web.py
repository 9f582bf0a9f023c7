"""A recording as a page on localhost that draws its traces; read-only: no request changes or opens
anything.

Two addresses, `/` and `/data?since=N`, both made in memory. No path of a request is ever looked up
on a disk.
"""

import contextlib
import importlib.resources
import ipaddress
import json
import re
import socket
import socketserver
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from urllib.parse import urlsplit

from softfin.core.canvas import with_canvas
from softfin.core.choices import LOOPBACK
from softfin.core.errors import ConfigurationError
from softfin.rig.monitor.follow import Follower
from softfin.rig.monitor.summary import STATES, WINDOW_S, counts, finite

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src "
        "'self'; img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
"""Let the page fetch nothing from elsewhere, and no other page show it."""


class Server(socketserver.ThreadingTCPServer):
    """Serves a recording, which it follows while a page asks; raises ConfigurationError where it
    cannot listen."""

    allow_reuse_address = daemon_threads = True
    request_queue_size = 128
    """Connections that wait to be accepted; too few cost a burst of clients a second."""

    def __init__(self, follower: Follower, host: str, port: int) -> None:
        self.host = host
        self._follower = follower
        self._reading = threading.Lock()
        """Lock of the thread whose request reads."""
        page = (
            importlib.resources.files("softfin.rig.monitor")
            .joinpath("page.html")
            .read_text("utf-8")
        )
        self.page = with_canvas(page).encode()
        try:
            self.address_family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
            super().__init__((host, port), _Handler)
        except (OSError, OverflowError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise ConfigurationError(
                f"cannot listen on {host} port {port} ({reason}); use --port 0 for any free port, "
                f"or --host {LOOPBACK} for this computer"
            ) from None

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore a client that went away."""

    @property
    def address(self) -> str:
        """The page's address, for a browser."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.server_address[1]}/"

    def data(self, since: int) -> bytes:
        """Return rows whose serial number is above `since`, the summary, and the number to ask with
        next, as JSON."""
        with self._reading:
            self._follower.poll()
            summary = self._follower.summary()
            traces = self._follower.traces
            rows = {
                role: [trace.less_zero(row) for row in trace.rows if row.serial > since]
                for role, trace in traces.items()
                if role != "event"
            }
        told = {"says": STATES[summary["state"]], "counts": counts(summary), "window_s": WINDOW_S}
        answer = {
            "next": max((row.serial for found in rows.values() for row in found), default=since),
            "rows": {
                role: [[finite(value) for value in (row.time, *row.values)] for row in found]
                for role, found in rows.items()
            },
            "summary": summary | told,
        }
        return json.dumps(answer, separators=(",", ":"), allow_nan=False).encode()


class _Handler(BaseHTTPRequestHandler):
    """Answers one request for the page or its data, and refuses everything else."""

    server: Server
    server_version = "softfin"
    sys_version = ""
    timeout = 3.0
    """Longest silence of a client within its request or its answer [s]."""

    def do_GET(self) -> None:
        """Answer with the page, or the data."""
        path, _, query = self.path.partition("?")
        if not _is_known(self.headers.get("Host", ""), self.server.host):
            # Else any web page could read ours through a name of its own that it points at this
            # computer.
            self.send_error(HTTPStatus.FORBIDDEN, "not a name of this page")
        elif self.path == "/":
            self._answer(self.server.page, "text/html; charset=utf-8")
        elif path != "/data":
            self.send_error(HTTPStatus.NOT_FOUND, "there is only the page")
        elif match := re.fullmatch(r"(?:since=([0-9]{1,15}))?", query):
            self._answer(self.server.data(int(match[1] or 0)), "application/json")
        else:
            self.send_error(HTTPStatus.BAD_REQUEST, "since must be a whole number")

    do_HEAD = do_GET

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""

    def _answer(self, body: bytes, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        for name, value in {
            **HEADERS,
            "Content-Type": kind,
            "Content-Length": str(len(body)),
        }.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(body)


def _is_known(host: str, own: str) -> bool:
    """Whether the address was typed as a number, or as a name that is ours; the port may be that of
    a tunnel."""
    with contextlib.suppress(ValueError):
        name = urlsplit(f"//{host.strip()}").hostname or ""
        return name in ("localhost", own.lower()) or bool(ipaddress.ip_address(name))
    return False
