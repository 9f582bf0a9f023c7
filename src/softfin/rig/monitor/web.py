"""View of a recording as a web page on localhost. Read-only: no request changes or opens anything.

The only two addresses, `/` and `/data?since=N`, are generated in memory. Request paths are never
looked up on disk.
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
from softfin.rig.monitor.summary import STATES, WINDOW_S, TraceRow, counts, finite

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src "
        "'self'; img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
"""Security headers: the page must not load anything from elsewhere or be embedded in another
page."""


class Server(socketserver.ThreadingTCPServer):
    """Server for a recording, which is read only while a page requests data; raises
    ConfigurationError if it cannot listen."""

    allow_reuse_address = daemon_threads = True
    request_queue_size = 128
    """Maximum number of pending connections; if it is too small, a burst of clients is delayed by
    one second."""

    def __init__(self, follower: Follower, host: str, port: int) -> None:
        self.host = host
        self._follower = follower
        self._reading = threading.Lock()
        """Held by the request that is reading the recording."""
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
        """Ignore errors, because they mean that a client disconnected."""

    @property
    def address(self) -> str:
        """Address of the page for a browser."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.server_address[1]}/"

    def data(self, since: int) -> bytes:
        """Return the rows with serial numbers above `since`, the summary, and the value of `since`
        for the next request, as JSON."""
        with self._reading:
            self._follower.poll()
            summary = self._follower.summary()
            new_rows = {}
            for role, trace in self._follower.traces.items():
                if role != "event":
                    new_rows[role] = [
                        trace.less_zero(row) for row in trace.rows if row.serial > since
                    ]
        latest = since
        plain_rows = {}
        for role, rows in new_rows.items():
            latest = max([latest, *(row.serial for row in rows)])
            plain_rows[role] = [_plain_row(row) for row in rows]
        texts = {"says": STATES[summary["state"]], "counts": counts(summary), "window_s": WINDOW_S}
        answer = {"next": latest, "rows": plain_rows, "summary": summary | texts}
        # Browsers cannot parse NaN in JSON.
        return json.dumps(answer, separators=(",", ":"), allow_nan=False).encode()


def _plain_row(row: TraceRow) -> list[float | None]:
    return [finite(value) for value in (row.time, *row.values)]


class _Handler(BaseHTTPRequestHandler):
    """Handler for one request; accepts only the page and its data."""

    server: Server
    server_version = "softfin"
    sys_version = ""
    timeout = 3.0
    """Longest pause of a client during its request or the response [s]."""

    def do_GET(self) -> None:
        """Return the page or the data."""
        path, _, query = self.path.partition("?")
        if not _is_known(self.headers.get("Host", ""), self.server.host):
            # DNS rebinding: otherwise any web page could read ours through a host name that
            # resolves to this computer.
            self.send_error(HTTPStatus.FORBIDDEN, "unknown host name")
        elif self.path == "/":
            self._answer(self.server.page, "text/html; charset=utf-8")
        elif path != "/data":
            self.send_error(HTTPStatus.NOT_FOUND, "page not found")
        elif match := re.fullmatch(r"(?:since=([0-9]{1,15}))?", query):
            self._answer(self.server.data(int(match[1] or 0)), "application/json")
        else:
            self.send_error(HTTPStatus.BAD_REQUEST, "since must be an integer")

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
    """Return whether a Host header is an IP address or one of our names; its port may be that of a
    tunnel."""
    with contextlib.suppress(ValueError):
        name = urlsplit(f"//{host.strip()}").hostname or ""
        return name in ("localhost", own.lower()) or bool(ipaddress.ip_address(name))
    return False
