"""A CAN bus over TCP for programs on one machine: python-can's virtual bus served by the protocol of socketcand.

Protocol: the documentation of linux-can's socketcand, raw mode. python-can's own `socketcand` interface is the client;
no kernel module is needed. Listens on the loopback address alone, and announces itself to nobody.
"""

import contextlib
import re
import socket
import threading
from collections import Counter

import can

HOST = "127.0.0.1"
CYCLE_S = 0.2
FIRST_FRAME_S = 0.05
LONGEST_LINE = 256
_SEND = re.compile(r"^< send ([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8}) ([0-8]) ((?:[0-9A-Fa-f]{1,2} ?){0,8}) ?>$")


class SocketcandServer:
    """Serves one channel to any number of clients; port 0 takes a free one."""

    def __init__(self, channel: str, port: int = 0) -> None:
        self.channel = channel
        self._listener = socket.create_server((HOST, port))
        self._listener.settimeout(CYCLE_S)
        self.port: int = self._listener.getsockname()[1]
        self._ending = threading.Event()
        self._threads: list[threading.Thread] = []
        self.counters: Counter[str] = Counter()

    def start(self) -> None:
        """Take clients from now on."""
        self._spawn(self._accept)

    def close(self) -> None:
        """Any number of times."""
        self._ending.set()
        self._listener.close()
        for thread in self._threads:
            thread.join(5 * CYCLE_S)
        self._threads.clear()

    def __enter__(self) -> "SocketcandServer":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _spawn(self, target: object, *args: object) -> None:
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        thread = threading.Thread(target=target, args=args, name="socketcand", daemon=True)  # type: ignore[arg-type]
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        while not self._ending.is_set():
            try:
                client, _ = self._listener.accept()
            except TimeoutError:
                continue
            except OSError:
                return
            self.counters["clients"] += 1
            client.settimeout(CYCLE_S)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._spawn(self._serve, client)

    def _serve(self, client: socket.socket) -> None:
        lines = _Lines(client, self._ending)
        with client, contextlib.suppress(OSError):
            client.sendall(b"< hi >")
            for expected in (f"< open {self.channel} >", "< rawmode >"):
                line = lines.next()
                if line != expected:
                    self._refuse(client, line)
                    return
                if expected != "< rawmode >":
                    client.sendall(b"< ok >")
            with can.Bus(interface="virtual", channel=self.channel) as bus:
                # Only now: the answer to rawmode must come before the first frame.
                client.sendall(b"< ok >")
                gone = threading.Event()
                self._spawn(self._forward, client, bus, gone)
                try:
                    self._take(client, lines, bus)
                finally:
                    gone.set()

    def _refuse(self, client: socket.socket, line: str | None) -> None:
        if line is not None:
            self.counters["refused lines"] += 1
            client.sendall(b"< error not what is expected here >")

    def _take(self, client: socket.socket, lines: "_Lines", bus: can.BusABC) -> None:
        while (line := lines.next()) is not None:
            message = parse(line)
            if message is None:
                # A client that does not speak the protocol is let go: in raw mode there is no answer that says so.
                self.counters["refused lines"] += 1
                return
            bus.send(message)

    def _forward(self, client: socket.socket, bus: can.BusABC, gone: threading.Event) -> None:
        # python-can's client takes the answer to rawmode for wrong when a frame comes in the same packet.
        gone.wait(FIRST_FRAME_S)
        with contextlib.suppress(OSError, can.CanError):
            while not (gone.is_set() or self._ending.is_set()):
                message = bus.recv(CYCLE_S)
                if message is not None and not message.is_remote_frame:
                    client.sendall(line_of(message).encode())


def parse(line: str) -> can.Message | None:
    """A line of a client as a frame; None where it is none."""
    match = _SEND.match(line)
    if not match:
        return None
    number, length, body = match.groups()
    data = bytes(int(part, 16) for part in body.split())
    if len(data) != int(length):
        return None
    cob_id, extended = int(number, 16), len(number) == 8
    if cob_id > (0x1FFFFFFF if extended else 0x7FF):
        return None
    return can.Message(arbitration_id=cob_id, data=data, is_extended_id=extended)


def line_of(message: can.Message) -> str:
    """A frame as a line for a client."""
    number = f"{message.arbitration_id:0{8 if message.is_extended_id else 3}X}"
    return f"< frame {number} {message.timestamp:.6f} {bytes(message.data).hex().upper()} >"


class _Lines:
    """What a client sends, cut at each '>'."""

    def __init__(self, client: socket.socket, ending: threading.Event) -> None:
        self._client, self._ending, self._rest = client, ending, ""

    def next(self) -> str | None:
        """None at the end, and where a line is longer than any of the protocol's."""
        while not self._ending.is_set():
            line, end, rest = self._rest.partition(">")
            if end:
                self._rest = rest
                return f"{line.strip()} >"
            if len(self._rest) > LONGEST_LINE:
                return None
            try:
                received = self._client.recv(4096)
            except TimeoutError:
                continue
            if not received:
                return None
            self._rest += received.decode("ascii", "replace")
        return None
