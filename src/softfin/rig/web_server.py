"""A web server that slow clients cannot take up: few connections, one short request each, the oldest gives way.

What is answered is the handler's; this is only how requests come in.
"""

import contextlib
import socket
import socketserver
import threading
import time
from http.server import BaseHTTPRequestHandler
from io import BytesIO
from typing import Any

MOST_CLIENTS = 16
"""At the same time; for the next one, the connection that has been open for longest is closed."""

MOST_REQUEST_BYTES = 8192

REQUEST_S = 3.0
"""For a request to arrive, and for its answer to be taken [s]."""

DROPPED_S = 1.0
"""For the thread of a connection that was closed to notice [s]."""


class BoundedServer(socketserver.ThreadingTCPServer):
    """Answers each request in a thread of its own, `MOST_CLIENTS` at a time."""

    daemon_threads = True
    request_queue_size = 128
    """Connections that wait to be taken; too few cost a burst of clients a second."""

    def __init__(self, address: tuple[str, int], handler: type["OneRequest"]) -> None:
        self._places = threading.BoundedSemaphore(MOST_CLIENTS)
        self._lock = threading.Lock()
        self._open: dict[socket.socket, None] = {}
        """In the order in which they came."""
        super().__init__(address, handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """In a thread, in place of the oldest connection where there are too many."""
        if not self._places.acquire(blocking=False):
            self._drop_oldest()
            if not self._places.acquire(timeout=DROPPED_S):
                self.shutdown_request(request)
                return
        with self._lock:
            self._open[request] = None
        try:
            super().process_request(request, client_address)
        except BaseException:
            self._release(request)
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Give the place back at the end."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._release(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that went away is nobody's concern."""

    def _drop_oldest(self) -> None:
        with self._lock:
            oldest = next(iter(self._open), None)
            self._open.pop(oldest, None)  # type: ignore[arg-type]
        if oldest is not None:
            with contextlib.suppress(OSError):
                oldest.shutdown(socket.SHUT_RDWR)

    def _release(self, request: socket.socket) -> None:
        with self._lock:
            self._open.pop(request, None)
        self._places.release()


class OneRequest(BaseHTTPRequestHandler):
    """Reads one request, as a whole and in time, then the connection ends."""

    timeout = REQUEST_S

    def setup(self) -> None:
        """Read it at once: what waits for its end must not wait for long."""
        super().setup()
        self.rfile = BytesIO(_head(self.connection))

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: who asks is of no interest."""


def _head(connection: socket.socket) -> bytes:
    """A request up to its empty line; nothing where it is too long or too slow."""
    until, head = time.monotonic() + REQUEST_S, b""
    while b"\r\n\r\n" not in head and b"\n\n" not in head:
        left = until - time.monotonic()
        if left <= 0 or len(head) > MOST_REQUEST_BYTES:
            return b""
        connection.settimeout(left)
        try:
            some = connection.recv(MOST_REQUEST_BYTES)
        except OSError:
            return b""
        if not some:
            return b""
        head += some
    connection.settimeout(REQUEST_S)
    return head if len(head) <= MOST_REQUEST_BYTES else b""
