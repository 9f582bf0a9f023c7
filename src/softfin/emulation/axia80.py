"""An emulated Axia80, loaded by an emulated fin: implements RDT over UDP and serves its web pages.

The wrench of the fin is rotated into the sensor axes and converted to counts; out-of-range loads
are flagged.
"""

import contextlib
import itertools
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from xml.sax.saxutils import escape

import numpy as np

from softfin.core.choices import LOOPBACK
from softfin.core.json_object import JsonObject
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.fin import EmulatedFin
from softfin.emulation.stream import EmulatedSensor
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.devices.axia80.pages import CALIBRATION, SETTINGS
from softfin.rig.devices.axia80.rdt import (
    BUSY,
    OVER_RANGE,
    RdtCommand,
    RdtRecord,
    decode_request,
    encode_record,
)

COUNTS = 1e6
"""Counts per unit of force [N] and torque [N m]."""

LIMITS = np.array((500.0, 500.0, 900.0, 20.0, 20.0, 20.0))
"""Measuring range of the M20 [N, N m], not verified; loads beyond it are flagged and clipped."""

ADC_RATE_HZ = 7812.0

BUSY_AT_START_S = 0.3
"""Time for which the sensor is busy after power-up [s]; an unverified assumption."""

NOISE = np.random.default_rng(0).integers(-1, 2, (1021, 6))
"""Noise [counts], indexed by the sample counter. The noise of a real sensor is thousands of counts
(not verified); here it is just large enough to show that the sensor is alive, so that tests can
compare forces."""

WAKE_S = 0.002
"""Maximum interval between transmissions [s]; each sends all records that are due."""


class EmulatedAxia80(EmulatedSensor[bytes]):
    """Emulated sensor that sends its records, as datagrams, to the latest client."""

    def __init__(
        self,
        fin: EmulatedFin,
        rdt_port: int = 0,
        http_port: int = 0,
        rate_hz: float = 1000.0,
        frame: str = "x,y",
        clock: Computer = COMPUTER,
    ) -> None:
        self.pages = sensor_pages()
        """Web pages, by path; may be changed at any time."""
        self.status = 0
        """Status of every record; tests may set its bits."""
        self.busy_s = BUSY_AT_START_S
        """Time for which the sensor is busy after power-up [s]; tests may set it."""
        self._powered_at = clock()
        self._counts = (0, 0, 0, 0, 0, 0)
        self._lock = threading.Lock()
        self._stream: _Stream | None = None
        self._ports = contextlib.ExitStack()
        wake_s = max(WAKE_S, 1 / rate_hz)
        self._socket = clock.udp_socket()
        self._socket.settimeout(wake_s)
        self._socket.bind((LOOPBACK, rdt_port))
        self.rdt_port = int(self._socket.getsockname()[1])
        if isinstance(clock, SimulatedClock):
            self.http_port = http_port or self.rdt_port
            clock.shared["http", LOOPBACK, self.http_port] = self.pages
            self._ports.callback(clock.shared.pop, ("http", LOOPBACK, self.http_port), None)
        else:
            server = serve_pages(http_port, self.pages)
            self.http_port = server.server_port
            self._ports.callback(server.server_close)
            self._ports.callback(server.shutdown)
        self._ports.callback(self._socket.close)
        super().__init__(fin, rate_hz, clock, frame)

    def address(self) -> JsonObject:
        """Return the address and ports in the format of a rig file."""
        return {"address": LOOPBACK, "http_port": self.http_port, "rdt_port": self.rdt_port}

    def reboot(self, seconds: float = 0.5) -> None:
        """Restart: stay silent for a time [s], then continue without a client and with a new sample
        counter."""
        with self._lock:
            self._stream = None
            self._powered_at = self._clock() + seconds
            self.silence(seconds)

    def unplug(self) -> None:
        """Close the sockets; may be called repeatedly."""
        self._ports.close()

    def _run(self) -> None:
        while not self._closing.is_set():
            # A timeout, or an ICMP error for a client that is gone.
            with contextlib.suppress(OSError):
                data, sender = self._socket.recvfrom(2048)
                request = decode_request(data)
                with self._lock:
                    if request is not None and self._clock() >= self._silent_until:
                        if request is RdtCommand.STOP:
                            # Accept requests from any client; there is only one stream, to the
                            # latest client.
                            self._stream = None
                        else:
                            self._stream = _Stream(sender, self._clock())
            with self._lock:
                now = self._clock()
                stream = self._stream
                datagrams = [] if stream is None else self._measure(stream, now)
            for arriving in itertools.chain.from_iterable(map(self.transmit, datagrams)):
                if stream is not None and now >= self._silent_until:
                    with contextlib.suppress(OSError):
                        self._socket.sendto(arriving, stream.client)

    def _measure(self, stream: "_Stream", now: float) -> list[bytes]:
        """Return the records that are due, all with the current load."""
        due = int((now - stream.began) * self.rate_hz) - stream.sent
        if due <= 0:
            return []
        load = self.measure()
        clipped = np.rint(COUNTS * np.clip(load, -LIMITS, LIMITS)).astype(int)
        status = self.status
        if (np.abs(load) > LIMITS).any():
            status |= OVER_RANGE
        if now - self._powered_at < self.busy_s:
            status |= BUSY
        datagrams = []
        for _ in range(due):
            samples = self._samples(stream.began + stream.sent / self.rate_hz)
            stream.sent += 1
            if not self.are_values_frozen:
                self._counts = tuple((clipped + NOISE[samples % len(NOISE)]).tolist())
            record = RdtRecord(stream.sent % 2**32, samples % 2**32, status, self._counts)
            datagrams.append(encode_record(record))
        return datagrams

    def _samples(self, time: float) -> int:
        """Return the sample counter, which is 0 at power-up."""
        return max(0, int((time - self._powered_at) * ADC_RATE_HZ))


@dataclass
class _Stream:
    client: tuple[str, int]
    began: float
    sent: int = 0


def sensor_pages(
    force_unit: str = "N", torque_unit: str = "N-m", serial: str = "FT00000"
) -> dict[str, bytes]:
    """Return the two pages that clients read, by path, in the format of a real sensor."""
    settings = {
        "prodname": "Emulated Axia80-M20",
        "scfgfu": force_unit,
        "scfgtu": torque_unit,
        "cfgcpf": f"{COUNTS:.10g}",
        "cfgcpt": f"{COUNTS:.10g}",
    }
    return {
        SETTINGS: _xml("netft", settings),
        CALIBRATION: _xml("netftCalibration", {"calsn": serial}),
    }


def serve_pages(port: int, pages: Mapping[str, bytes]) -> ThreadingHTTPServer:
    """Serve bytes by path in a daemon thread, until the server's `shutdown` and `server_close`."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            body = pages.get(self.path)
            self.send_response(404 if body is None else 200)
            self.send_header("Content-Length", str(len(body or b"")))
            self.end_headers()
            self.wfile.write(body or b"")

        def log_message(self, format: str, *args: object) -> None:
            """Log nothing."""

    server = ThreadingHTTPServer((LOOPBACK, port), Handler)
    threading.Thread(
        target=server.serve_forever, args=(0.05,), daemon=True, name="emulated sensor's pages"
    ).start()
    return server


def _xml(root: str, fields: Mapping[str, str]) -> bytes:
    rows = "\r\n".join(f"<{name}>{escape(value)}</{name}>" for name, value in fields.items())
    return f'<?xml version="1.0" encoding="UTF-8"?>\r\n<{root}>\r\n{rows}\r\n</{root}>\r\n'.encode()
