"""A follower in, a page on localhost out that draws its traces; read-only: no request changes or opens anything.

Two addresses, `/` and `/data?since=N`, both made in memory. No path of a request is ever looked up on a disk.
"""

import base64
import hashlib
import importlib.resources
import ipaddress
import json
import re
import socket
import sys
import threading
from collections.abc import Callable
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, urlsplit

from softfin.core.canvas import with_canvas
from softfin.core.choices import LOOPBACK
from softfin.core.errors import ConfigurationError
from softfin.rig.monitor.follow import Follower
from softfin.rig.monitor.messages import NAMES
from softfin.rig.monitor.summary import STATES, WINDOW_S, finite
from softfin.rig.web_server import REQUEST_S, BoundedServer, OneRequest

REFRESH_S = 0.2

DIGITS = 4


class Feed:
    """The follower, shared by the thread that reads and those that answer."""

    def __init__(self, follower: Follower) -> None:
        self._follower = follower
        self._lock = threading.Lock()

    def poll(self) -> None:
        """Take in what is new."""
        with self._lock:
            self._follower.poll()

    def data(self, since: int) -> bytes:
        """Rows whose serial number is above `since`, the summary, and the number to ask with next, as JSON."""
        with self._lock:
            summary, traces = self._follower.summary(), self._follower.traces
            rows = {role: trace.after(since) for role, trace in traces.items() if role != "event"}
        newest = max((row.serial for found in rows.values() for row in found), default=since)
        told: dict[str, Any] = summary.to_dict() | {"says": STATES[summary.state], "window_s": WINDOW_S}
        return json.dumps(
            {
                "next": newest,
                "columns": {role: ("time_s", *NAMES[role]) for role in rows},
                "rows": {role: [_plain(row.time, *row.values) for row in found] for role, found in rows.items()},
                "summary": told,
            },
            separators=(",", ":"),
            allow_nan=False,
        ).encode()


def _plain(*values: float | str) -> list[float | None]:
    return [None if (number := finite(value)) is None else round(number, DIGITS) for value in values]


class Server(BoundedServer):
    """Answers until it is closed; raises ConfigurationError where it cannot listen."""

    # A port that another program listens to is not shared with it.
    allow_reuse_address = sys.platform != "win32"

    def __init__(self, feed: Feed, host: str, port: int) -> None:
        self.feed, self.host = feed, host
        page = importlib.resources.files("softfin.rig.monitor").joinpath("page.html").read_text("utf-8")
        self.page = with_canvas(page).encode()
        self.policy = _policy(self.page.decode())
        if not 0 <= port <= 65535:
            raise ConfigurationError(f"--port {port}: a port is a whole number from 0 to 65535; 0 takes a free one")
        try:
            self.address_family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
            super().__init__((host, port), _Handler)
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise ConfigurationError(
                f"cannot listen on {host} port {port} ({reason}); --port 0 takes a free port, --host {LOOPBACK} is here"
            ) from None

    @property
    def address(self) -> str:
        """What to type into a browser."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.server_address[1]}/"

    def server_bind(self) -> None:
        """Without asking a name server who we are, as the standard library does."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, int(self.allow_reuse_address))
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_port = int(self.server_address[1])


class _Handler(OneRequest):
    """Answers for the page and its data, and refuses everything else."""

    server: Server
    server_version, sys_version = "softfin", ""

    def parse_request(self) -> bool:
        """Whether it is one that is answered."""
        if not super().parse_request():
            return False
        if self.command not in ("GET", "HEAD"):
            self.send_error(HTTPStatus.METHOD_NOT_ALLOWED, "this page is read-only")
        elif not _known(self.headers.get_all("Host") or [], self.server.host):
            # Else any web page could read ours through a name of its own that it points at this computer.
            self.send_error(HTTPStatus.FORBIDDEN, "not a name of this page")
        else:
            return True
        return False

    def do_GET(self) -> None:
        """The page, or the data."""
        parts = urlsplit(self.path) if self.path.startswith("/") and not self.path.startswith("//") else None
        if parts is not None and parts.path == "/" and not parts.query:
            self._answer(self.server.page, "text/html; charset=utf-8")
        elif parts is not None and parts.path == "/data":
            since = _since(parts.query)
            if since is None:
                self.send_error(HTTPStatus.BAD_REQUEST, "since is a whole number")
            else:
                self._answer(self.server.feed.data(since), "application/json")
        else:
            self.send_error(HTTPStatus.NOT_FOUND, "there is only the page")

    do_HEAD = do_GET

    def end_headers(self) -> None:
        """With what keeps other pages out."""
        for name, value in {
            "Content-Security-Policy": self.server.policy,
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Cache-Control": "no-store",
            **({"Allow": "GET, HEAD"} if self.command not in ("GET", "HEAD") else {}),
        }.items():
            self.send_header(name, value)
        super().end_headers()

    def _answer(self, body: bytes, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(body)


def _known(hosts: list[str], own: str) -> bool:
    """Whether the address was typed as a number, or as a name that is ours; the port may be that of a tunnel."""
    if len(hosts) != 1:
        return False
    match = re.fullmatch(r"(?:\[([0-9A-Fa-f:.]+)\]|([^:\[\]]+))(?::\d{1,5})?", hosts[0].strip())
    if match is None:
        return False
    name = (match[1] or match[2]).lower()
    if name in ("localhost", own.lower()):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _since(query: str) -> int | None:
    """0 where nothing is said, None where it is no number."""
    if not query:
        return 0
    try:
        given = parse_qs(query, keep_blank_values=True, strict_parsing=True, max_num_fields=1)
    except ValueError:
        return None
    values = given.get("since", [])
    return int(values[0]) if len(values) == 1 and re.fullmatch(r"[0-9]{1,15}", values[0]) else None


def _policy(page: str) -> str:
    """Only the page's own script and style run, and only this address is asked."""
    hashes = {
        tag: " ".join(
            f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
            for text in re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        )
        for tag in ("script", "style")
    }
    return (
        f"default-src 'none'; script-src {hashes['script']}; style-src {hashes['style']}; connect-src 'self'; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


def serve(server: Server, *, sleep: Callable[[float], None]) -> None:
    """Follow and answer until interrupted; the server is closed at the end."""
    thread = threading.Thread(target=server.serve_forever, name="monitor page", daemon=True)
    thread.start()
    try:
        while True:
            server.feed.poll()
            sleep(REFRESH_S)
    finally:
        server.shutdown()
        server.server_close()
        thread.join(REQUEST_S)
