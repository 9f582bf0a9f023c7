"""An emulated Axia80: speaks RDT over UDP and serves its web pages; an emulated fin loads it.

Its counts are those of the fin's force rotated back into the sensor's axes and units; what is out of range is flagged.
"""

import contextlib
import socket
import threading
from typing import Any

import numpy as np

from softfin.core.clock import REAL, Clock
from softfin.rig.axia80.pages import FORCE_UNITS, TORQUE_UNITS
from softfin.rig.axia80.rdt import OVER_RANGE, Counts, RdtCommand, RdtRecord, decode_request, encode_record
from softfin.rig.emulation.fin import EmulatedFin
from softfin.rig.emulation.sensor_faults import FaultyNetwork
from softfin.rig.emulation.sensor_pages import sensor_pages, serve_pages
from softfin.rig.frame import rotated, rotation
from softfin.rig.simulated_clock import SimulatedClock
from softfin.rig.simulated_network import SimulatedSocket, network_of

RANGE = (500.0, 500.0, 900.0, 20.0, 20.0, 20.0)
"""Measuring range of the M20 [N, N m], from memory; loads beyond it are flagged and clipped."""

FLAGGED_RECORDS = 32
"""Number of records for which an over-range stays in the status (ATI manual 9610-05-Ethernet Axia)."""

ADC_RATE_HZ = 7812.0

WAKE_S = 0.002
"""Longest time that a record waits to be sent; the sensor sends what is due since then."""

MAX_BEHIND_S = 1.0
"""A process that was stopped for longer does not send the missed records; their numbers are skipped."""

TOP_COUNT = 2**31 - 1


class EmulatedAxia80:
    """Serves from construction until `close`, from daemon threads; faults may be set from any thread."""

    def __init__(
        self,
        fin: EmulatedFin,
        host: str = "127.0.0.1",
        rdt_port: int = 0,
        http_port: int = 0,
        rate_hz: float = 1000.0,
        frame: str = "x,y",
        units: tuple[str, str] = ("N", "N-m"),
        counts: tuple[float, float] = (1e6, 1e6),
        noise: tuple[float, float] = (0.0, 0.0),
        seed: int = 0,
        clock: Clock = REAL,
    ) -> None:
        """`counts` for one unit of force and of torque; `noise` is their standard deviation [N, N m]."""
        self.host, self.rate_hz = host, rate_hz
        self.network = FaultyNetwork(seed)
        self.pages = sensor_pages(units, counts)
        """Its web pages, by path; may be changed at any time."""
        self._fin, self._clock = fin, clock
        # The inverse of the client's: from softfin's axes into the sensor's.
        self._rotation = rotation(frame).T
        self._scale = np.repeat([counts[0] / FORCE_UNITS[units[0]], counts[1] / TORQUE_UNITS[units[1]]], 3)
        self._noise = np.repeat(noise, 3) if any(noise) else None
        self._limits = np.minimum(np.array(RANGE) * self._scale, TOP_COUNT)
        self._random = np.random.default_rng(seed)
        self._bias = np.zeros(6)
        self._status = self._flagged = self._adc = self._first_sequence = 0
        self._silent_until = 0.0
        self._lock = threading.Lock()
        self._closing = clock.event()
        self._stream: _Stream | None = None
        wake_s = max(WAKE_S, 1 / rate_hz)
        self._socket: socket.socket | SimulatedSocket
        if isinstance(clock, SimulatedClock):
            self._socket = SimulatedSocket(clock, host, rdt_port, wake_s)
            network = network_of(clock)
            self.http_port, self._server = http_port or next(network.free_ports), None
            network.pages[host, self.http_port] = self.pages
        else:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            try:
                self._socket.settimeout(wake_s)
                self._socket.bind((host, rdt_port))
                self._server = serve_pages(host, http_port, self.pages)
            except BaseException:
                self._socket.close()
                raise
            self.http_port = self._server.server_port
        self.rdt_port = int(self._socket.getsockname()[1])
        self._thread = clock.spawn(self._serve, "emulated sensor's stream")

    def remembered(self) -> dict[str, Any]:
        """State that would be lost with its supply, for JSON: its zero in its own axes [N, N m], count of samples."""
        return {"bias": self._bias.tolist(), "samples": self._adc}

    def recall(self, remembered: dict[str, Any]) -> None:
        """Continue as if its supply had never been off."""
        bias = np.array(remembered["bias"], float)
        if bias.shape != (6,):
            raise ValueError("bias must be six numbers")
        with self._lock:
            self._bias, self._adc = bias, int(remembered["samples"])

    def disturb(self, drop: float = 0.0, duplicate: float = 0.0, reorder: float = 0.0, delay_s: float = 0.0) -> None:
        """Faults of the network from now on, as fractions of the datagrams and a delay [s]; none ends them."""
        with self._lock:
            network = self.network
            network.drop, network.duplicate, network.reorder, network.delay_s = drop, duplicate, reorder, delay_s

    def rollover(self, records: int = 100) -> None:
        """Both sequences roll over so many records into the next stream; before a client connects."""
        with self._lock:
            self._first_sequence = (1 << 32) - records
            self._adc = (1 << 32) - round(records * ADC_RATE_HZ / self.rate_hz)

    def status(self, bits: int) -> None:
        """Set the status of every record from now on; 0 for none."""
        with self._lock:
            self._status = bits

    def silence(self, seconds: float = float("inf")) -> None:
        """Neither receive nor send for so long [s]; 0 ends it."""
        with self._lock:
            self._silent_until = self._clock() + seconds

    def reboot(self, seconds: float = 0.5) -> None:
        """Switch off and on: silent for so long [s], then without client, bias and its sequence."""
        with self._lock:
            self._stream = None
            self._bias = np.zeros(6)
            self._adc = self._first_sequence = 0
            self._silent_until = self._clock() + seconds
            self.network.clear()

    def close(self) -> None:
        """Stop serving; any number of times."""
        self._closing.set()
        self._thread.join()
        self._socket.close()
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
        elif isinstance(self._clock, SimulatedClock):
            network_of(self._clock).pages.pop((self.host, self.http_port), None)

    def _serve(self) -> None:
        while not self._closing.is_set():
            # Nothing comes in time, or an answer to a client that is gone.
            with contextlib.suppress(OSError):
                data, sender = self._socket.recvfrom(2048)
                with self._lock:
                    if self._clock() >= self._silent_until:
                        self._obey(data, sender)
            now = self._clock()
            with self._lock:
                stream, silent = self._stream, now < self._silent_until
                if stream is not None:
                    self._measure(stream, now)
                datagrams = self.network.arrived(now)
            for datagram in datagrams:
                if stream is not None and not silent:
                    with contextlib.suppress(OSError):
                        self._socket.sendto(datagram, stream.client)

    def _obey(self, data: bytes, client: tuple[str, int]) -> None:
        request = decode_request(data)
        if request is None:
            return
        command, wanted = request
        if command is RdtCommand.BIAS:
            self._bias = self._felt()
        elif command is RdtCommand.STOP:
            self._stream = None
        else:
            self._stream = _Stream(client, self._clock(), wanted, self._first_sequence or 1)
            self._first_sequence = 0

    def _measure(self, stream: "_Stream", now: float) -> None:
        due = int((now - stream.began) * self.rate_hz) - stream.sent
        skipped = due - round(MAX_BEHIND_S * self.rate_hz)
        if skipped > 0:
            stream.sent, stream.sequence, due = stream.sent + skipped, stream.sequence + skipped, due - skipped
        felt = self._felt() if due > 0 else self._bias
        counts: tuple[Counts, bool] | None = None
        for _ in range(due):
            if stream.left == 0:
                return
            # Without noise all that is due has the same load.
            if counts is None or self._noise is not None:
                counts = self._counts(felt)
            if counts[1]:
                self._flagged = FLAGGED_RECORDS
            status = self._status | (OVER_RANGE if self._flagged else 0)
            self._flagged = max(0, self._flagged - 1)
            self._adc += round(ADC_RATE_HZ / self.rate_hz) or 1
            record = RdtRecord(stream.sequence % 2**32, self._adc % 2**32, status, counts[0])
            self.network.send(encode_record(record), now)
            stream.sent, stream.sequence, stream.left = stream.sent + 1, stream.sequence + 1, stream.left - 1

    def _felt(self) -> np.ndarray:
        return np.array(rotated(self._fin.now().wrench, self._rotation))

    def _counts(self, felt: np.ndarray) -> tuple[Counts, bool]:
        """Counts of one record, and whether they were out of range."""
        values = felt - self._bias
        if self._noise is not None:
            values += self._noise * self._random.standard_normal(6)
        counts = values * self._scale
        beyond = bool((np.abs(counts) > self._limits).any())
        fx, fy, fz, tx, ty, tz = np.rint(np.clip(counts, -self._limits, self._limits)).astype(int).tolist()
        return (fx, fy, fz, tx, ty, tz), beyond


class _Stream:
    """The stream of one request."""

    def __init__(self, client: tuple[str, int], began: float, wanted: int, sequence: int) -> None:
        self.client, self.began, self.sequence, self.sent = client, began, sequence, 0
        self.left = wanted or -1
        """Records still to be sent; negative for no end."""
