"""A CAN bus over TCP for programs on one computer: python-can's virtual bus served with the
socketcand protocol.

Protocol: raw mode as in the documentation of linux-can's socketcand. The client is python-can's
`socketcand` interface; no kernel module is needed. The server listens only on the loopback address,
whereas python-can's `udp_multicast` would use every network interface.
"""

import contextlib
import re
import socketserver
import threading
import time
from collections.abc import Iterator

import can

from softfin.core.choices import LOOPBACK

STOP_CHECK_S = 0.2
_SEND = re.compile(r"< send ([0-7][0-9A-Fa-f]{2}) ([0-8]) ((?:[0-9A-Fa-f]{1,2} ?){0,8}) ?>")


class SocketcandServer(socketserver.ThreadingTCPServer):
    """Server for one channel and any number of clients, on a free port, until `server_close`."""

    daemon_threads = allow_reuse_address = True

    def __init__(self, channel: str) -> None:
        super().__init__((LOOPBACK, 0), _Client)
        self.channel = channel
        self.port: int = self.server_address[1]
        self.ending = threading.Event()
        threading.Thread(
            target=self.serve_forever, args=(STOP_CHECK_S,), name="socketcand", daemon=True
        ).start()

    def server_close(self) -> None:
        """Disconnect all clients and stop; may be called repeatedly."""
        self.ending.set()
        self.shutdown()
        super().server_close()


class _Client(socketserver.BaseRequestHandler):
    server: SocketcandServer

    def handle(self) -> None:
        self.request.settimeout(STOP_CHECK_S)
        channel = self.server.channel
        lines = self._lines()
        # Disconnect clients that violate the protocol, because raw mode does not have an error
        # response.
        with contextlib.suppress(OSError):
            self.request.sendall(b"< hi >")
            for expected in (f"< open {channel} >", "< rawmode >"):
                if next(lines, None) != expected:
                    return
                self.request.sendall(b"< ok >")
            with can.Bus(interface="virtual", channel=channel) as bus:
                # python-can's client rejects the answer to rawmode if a frame arrives in the same
                # packet.
                time.sleep(0.05)
                notifier = can.Notifier(bus, [self._forward], STOP_CHECK_S)
                try:
                    for message in map(parse_frame, lines):
                        if message is None:
                            return
                        bus.send(message)
                finally:
                    notifier.stop()

    def _forward(self, message: can.Message) -> None:
        with contextlib.suppress(OSError):
            if not (message.is_remote_frame or message.is_extended_id):
                self.request.sendall(format_frame(message).encode())

    def _lines(self) -> Iterator[str]:
        """Yield the messages of the client, split at each '>', until the client disconnects or
        sends a line that is too long."""
        rest = ""
        while not self.server.ending.is_set() and len(rest) <= 256:
            with contextlib.suppress(TimeoutError):
                received = self.request.recv(4096)
                if not received:
                    return
                *lines, rest = (rest + received.decode("ascii", "replace")).split(">")
                yield from (f"{line.strip()} >" for line in lines)


def parse_frame(line: str) -> can.Message | None:
    """Return the frame in a line from a client; None if the line is not a frame with an 11-bit
    identifier."""
    match = _SEND.fullmatch(line)
    data = bytes(int(part, 16) for part in match[3].split()) if match else b""
    if not match or len(data) != int(match[2]):
        return None
    return can.Message(arbitration_id=int(match[1], 16), data=data, is_extended_id=False)


def format_frame(message: can.Message) -> str:
    """Return a frame as a line for a client."""
    return (
        f"< frame {message.arbitration_id:03X} {message.timestamp:.6f} "
        f"{bytes(message.data).hex().upper()} >"
    )
