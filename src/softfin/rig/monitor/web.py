"""A web page on this computer that shows a recording. It is read-only: no request changes or opens
anything.

The only two paths, `/` and `/data?since=N`, are generated in memory. Request paths are never looked
up on disk.
"""

import contextlib
import importlib.resources
import json
import re
import socketserver
import sys
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Annotated

from softfin.core.canvas import with_canvas
from softfin.core.choices import LOOPBACK
from softfin.core.errors import ConfigurationError
from softfin.core.option_types import RECORDING, PathLike
from softfin.rig.monitor.follow import Follower

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src "
        "'self'; img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
"""Security headers: the page must not load anything from elsewhere or be embedded in a different
page."""


def monitor(recording: Annotated[PathLike, RECORDING], *, port: int = 8080) -> None:
    """Watch a recording in progress on a web page. Ctrl-C ends the page, not the recording.

    Args:
        recording: Bag (.mcap) to watch, or a folder of bags (the newest is watched).
        port: Port of the page on this computer; 0 for any free port.
    """
    # Ending the page is not a failure, so the exit code is 0.
    with (
        contextlib.suppress(KeyboardInterrupt),
        Server(Follower(Path(recording)), port) as server,
    ):
        sys.stderr.write(f"{server.address} shows the recording; press Ctrl-C to end\n")
        server.serve_forever()


class Server(socketserver.ThreadingTCPServer):
    """Server for a recording, which is read only while a page requests data; raises
    ConfigurationError if the server cannot listen."""

    allow_reuse_address = daemon_threads = True
    request_queue_size = 128
    """Maximum number of pending connections; if it is too small, a burst of clients is delayed by
    one second."""

    def __init__(self, follower: Follower, port: int) -> None:
        self._follower = follower
        self._reading = threading.Lock()
        """Lock held by the request that is reading the recording."""
        page = importlib.resources.files("softfin.rig.monitor").joinpath("page.html")
        self.page = with_canvas(page.read_text("utf-8")).encode()
        try:
            super().__init__((LOOPBACK, port), _Handler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise ConfigurationError(
                f"cannot listen on port {port} ({reason}); use --port 0 for any free port"
            ) from None

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore errors, because they mean that a client disconnected."""

    @property
    def address(self) -> str:
        """Address of the page, to open in a browser."""
        return f"http://{LOOPBACK}:{self.server_address[1]}/"

    def data(self, since: int) -> bytes:
        """Return the rows with serial numbers above `since`, the summary, and the value of `since`
        for the next request, as JSON."""
        with self._reading:
            self._follower.poll()
            answer = {
                "summary": self._follower.summary(),
                "rows": self._follower.rows(since),
                "next": self._follower.serial,
            }
        # Browsers cannot parse NaN in JSON.
        return json.dumps(answer, separators=(",", ":"), allow_nan=False).encode()


class _Handler(BaseHTTPRequestHandler):
    """Handler for one request; serves only the page and its data."""

    server: Server
    server_version = "softfin"
    sys_version = ""
    timeout = 3.0
    """Maximum pause of a client during a request or response [s]."""

    def do_GET(self) -> None:
        """Return the page or the data."""
        if self.headers.get("Host", "").split(":")[0] not in (LOOPBACK, "localhost"):
            # Prevent DNS rebinding: otherwise, any web page could read this page through a host
            # name that resolves to this computer.
            self.send_error(HTTPStatus.FORBIDDEN, "unknown host name")
        elif self.path == "/":
            self._answer(self.server.page, "text/html; charset=utf-8")
        elif match := re.fullmatch(r"/data\?since=([0-9]{1,15})", self.path):
            self._answer(self.server.data(int(match[1])), "application/json")
        else:
            self.send_error(HTTPStatus.NOT_FOUND, "page not found")

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""

    def _answer(self, body: bytes, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        headers = HEADERS | {"Content-Type": kind, "Content-Length": str(len(body))}
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)
