"""A web server that slow clients cannot block: few connections, one short request each, the oldest gives way.

The answers are the handler's; this is only how requests come in.
"""

import contextlib
import socket
import socketserver
import threading
from http.server import BaseHTTPRequestHandler
from typing import Any

MAX_CLIENTS = 16
"""Most connections at the same time; for the next one, the oldest is closed."""

REQUEST_S = 3.0
"""Longest silence of a client within its request or its answer [s]."""


class BoundedServer(socketserver.ThreadingTCPServer):
    """Answers each request in a thread of its own, `MAX_CLIENTS` at a time."""

    daemon_threads = True
    request_queue_size = 128
    """Connections that wait to be accepted; too few cost a burst of clients a second."""

    def __init__(self, address: tuple[str, int], handler: type["OneRequest"]) -> None:
        self._lock = threading.Lock()
        self._open: dict[socket.socket, None] = {}
        """Connections in the order in which they came."""
        super().__init__(address, handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread, in place of the oldest connection where there are too many."""
        with self._lock:
            if len(self._open) >= MAX_CLIENTS:
                oldest = next(iter(self._open))
                del self._open[oldest]
                with contextlib.suppress(OSError):
                    oldest.shutdown(socket.SHUT_RDWR)
            self._open[request] = None
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer, and free the place at the end."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            with self._lock:
                self._open.pop(request, None)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a client that went away."""


class OneRequest(BaseHTTPRequestHandler):
    """Answers one request, then the connection ends."""

    timeout = REQUEST_S

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""
