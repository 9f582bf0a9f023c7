"""An emulated Axia80: speaks RDT over UDP and serves its web pages, and an emulated fin pulls at it.

Its counts are those of the fin's force turned back into the sensor's axes and units; what it cannot measure it flags.
"""

import contextlib
import select
import socket
import threading
from typing import Any

import numpy as np

from softfin.core.clock import REAL, Clock
from softfin.core.errors import RigError
from softfin.rig.axia80.config import rotation
from softfin.rig.axia80.rdt import MOST_RECORDS, Counts, Order, Record, Request, decode_request, encode_record
from softfin.rig.axia80.status import OVER_RANGE
from softfin.rig.axia80.xml import FORCE_UNITS, TORQUE_UNITS
from softfin.rig.emulation.fin import EmulatedFin
from softfin.rig.emulation.sensor_faults import Network
from softfin.rig.emulation.sensor_pages import PageServer, sensor_pages
from softfin.rig.simulated_clock import SimulatedClock
from softfin.rig.simulated_network import SimulatedPages, SimulatedSocket

RANGE = (500.0, 500.0, 900.0, 20.0, 20.0, 20.0)
"""Of the M20 [N, N m], from memory; what is beyond is flagged and cut to it."""

FLAGGED_RECORDS = 32
"""An over-range stays in the status for so many records (ATI manual 9610-05-Ethernet Axia)."""

ADC_RATE_HZ = 7812.0

WAKE_S = 0.002
"""Longest that a record waits for its sending; the sensor sends what is due since then."""

MOST_BEHIND_S = 1.0
"""A process that was stopped for longer does not send what it owes, its numbers jump."""

TOP_COUNT = 2**31 - 1


class EmulatedAxia80:
    """Serves from construction until `close`, from two daemon threads; faults may be set from any thread."""

    def __init__(
        self,
        fin: EmulatedFin,
        host: str = "127.0.0.1",
        rdt_port: int = 0,
        http_port: int = 0,
        rate_hz: float = 1000.0,
        frame: str = "x,y",
        force_unit: str = "N",
        torque_unit: str = "N-m",
        counts: tuple[float, float] = (1e6, 1e6),
        noise: tuple[float, float] = (0.0, 0.0),
        block: int = 1,
        product: str = "Emulated Axia80-M20",
        serial: str = "FT00000",
        seed: int = 0,
        clock: Clock = REAL,
    ) -> None:
        """Noise is the standard deviation [N, N m]; block the records a datagram where blocks are asked for."""
        if not 1 <= block <= MOST_RECORDS:
            raise RigError(f"emulated force sensor: block of {block} records; a datagram holds 1 to {MOST_RECORDS}")
        self.host, self.rate_hz = host, rate_hz
        self.network = Network(seed)
        """Where datagrams are lost, held up, doubled and swapped."""
        self.sent = 0
        """Records that went into the network."""
        self._fin, self._clock, self._block = fin, clock, block
        for unit, units in ((force_unit, FORCE_UNITS), (torque_unit, TORQUE_UNITS)):
            if unit not in units:
                raise RigError(f"emulated force sensor: no unit {unit!r}; take one of {', '.join(units)}")
        # The other way round than the client: from softfin's axes into the sensor's.
        self._rotation = rotation(frame).T
        scale = np.array([counts[0] / FORCE_UNITS[force_unit], counts[1] / TORQUE_UNITS[torque_unit]])
        self._scale, self._noise = np.repeat(scale, 3), np.repeat(noise, 3)
        self._noisy = any(noise)
        self._limits = np.minimum(np.array(RANGE) * self._scale, TOP_COUNT)
        self._random = np.random.default_rng(seed)
        self._bias = np.zeros(6)
        self._status = self._flagged = self._adc = self._first_sequence = 0
        self._silent_until = 0.0
        self._lock = threading.Lock()
        self._closing = clock.event()
        self._stream: _Stream | None = None
        self._client: tuple[str, int] | None = None
        self._socket = _bound(host, rdt_port, clock)
        try:
            self.rdt_port = int(self._socket.getsockname()[1])
            pages = sensor_pages(product, serial, (force_unit, torque_unit), counts, ADC_RATE_HZ, rate_hz)
            self.pages: PageServer | SimulatedPages
            if isinstance(clock, SimulatedClock):
                self.pages = SimulatedPages(clock, host, http_port, pages)
            else:
                self.pages = PageServer(host, http_port, pages)
        except BaseException:
            self._socket.close()
            raise
        self.http_port = self.pages.port
        self._thread = clock.spawn(self._serve, "emulated sensor's stream")

    def remembered(self) -> dict[str, Any]:
        """What it would lose with its supply, for JSON: its zero in its own axes [N, N m], its count of samples."""
        return {"bias": self._bias.tolist(), "samples": self._adc}

    def recall(self, remembered: dict[str, Any]) -> None:
        """As if its supply had never been off."""
        bias = np.array(remembered["bias"], float)
        if bias.shape != (6,):
            raise ValueError("bias must be six numbers")
        with self._lock:
            self._bias, self._adc = bias, int(remembered["samples"])

    def drop(self, fraction: float) -> None:
        """Lose datagrams at random."""
        self.network.drop(fraction)

    def delay(self, seconds: float) -> None:
        """Every datagram arrives so much later [s]."""
        self.network.delay(seconds)

    def duplicate(self, fraction: float) -> None:
        """Send datagrams twice at random."""
        self.network.duplicate(fraction)

    def reorder(self, fraction: float) -> None:
        """Swap datagrams with the next one at random."""
        self.network.reorder(fraction)

    def rollover(self, records: int = 100) -> None:
        """Both sequences roll over so many records into the next stream; for before a client comes."""
        with self._lock:
            self._first_sequence = (1 << 32) - records
            self._adc = (1 << 32) - round(records * ADC_RATE_HZ / self.rate_hz)

    def status(self, bits: int) -> None:
        """Of every record from now on; 0 is well."""
        with self._lock:
            self._status = bits

    def silence(self, seconds: float = float("inf")) -> None:
        """Neither hear nor send for so long [s]; 0 ends it."""
        with self._lock:
            self._silent_until = self._clock() + seconds

    def reboot(self, seconds: float = 0.5) -> None:
        """Off and on: silent for so long [s], then without client, bias and the sequence that it had."""
        with self._lock:
            self._stream = self._client = None
            self._bias = np.zeros(6)
            self._adc = self._first_sequence = 0
            self._silent_until = self._clock() + seconds
        self.network.clear()

    def close(self) -> None:
        """Any number of times."""
        self._closing.set()
        self._thread.join()
        self._socket.close()
        self.pages.close()

    def _serve(self) -> None:
        while not self._closing.is_set():
            if _heard(self._socket, max(WAKE_S, 1 / self.rate_hz)):
                self._hear()
            self._send_due()

    def _hear(self) -> None:
        with contextlib.suppress(OSError):
            data, sender = self._socket.recvfrom(2048)
            request = decode_request(data)
            with self._lock:
                if self._clock() >= self._silent_until and isinstance(request, Request):
                    self._obey(request, sender)

    def _obey(self, request: Request, client: tuple[str, int]) -> None:
        if request.order is Order.BIAS:
            self._bias = self._felt()
            return
        self._stream = self._client = None
        if request.order is not Order.STOP:
            self._client = client
            block = self._block if request.order is Order.START_BLOCKS else 1
            self._stream = _Stream(self._clock(), block, request.wanted, self._first_sequence or 1)
            self._first_sequence = 0

    def _send_due(self) -> None:
        now = self._clock()
        with self._lock:
            if self._stream is not None:
                self._measure(self._stream, now)
            client = self._client
            silent = now < self._silent_until
        for datagram in self.network.arrived(now):
            if client is not None and not silent:
                with contextlib.suppress(OSError):
                    self._socket.sendto(datagram, client)

    def _measure(self, stream: "_Stream", now: float) -> None:
        due = int((now - stream.began) * self.rate_hz) - stream.made
        if due > MOST_BEHIND_S * self.rate_hz:
            skipped = due - round(MOST_BEHIND_S * self.rate_hz)
            stream.made, stream.sequence = stream.made + skipped, stream.sequence + skipped
            due -= skipped
        felt = self._felt() if due > 0 else self._bias
        counts: tuple[Counts, bool] | None = None
        for _ in range(due):
            if stream.left == 0:
                return
            # Without noise all that is due has felt the same.
            if counts is None or self._noisy:
                counts = self._counts(felt)
            status = self._status_of(beyond=counts[1])
            self._adc += round(ADC_RATE_HZ / self.rate_hz) or 1
            record = Record(stream.sequence % 2**32, self._adc % 2**32, status, counts[0])
            stream.made, stream.sequence = stream.made + 1, stream.sequence + 1
            stream.pending += encode_record(record)
            stream.in_block += 1
            if stream.left is not None:
                stream.left -= 1
            if stream.in_block == stream.block or stream.left == 0:
                self.network.send(bytes(stream.pending), now)
                self.sent += stream.in_block
                stream.pending.clear()
                stream.in_block = 0

    def _felt(self) -> np.ndarray:
        wrench = np.array(self._fin.now().wrench)
        return np.concatenate([self._rotation @ wrench[:3], self._rotation @ wrench[3:]])

    def _counts(self, felt: np.ndarray) -> tuple[Counts, bool]:
        """And whether they were beyond its range."""
        values = felt - self._bias
        if self._noisy:
            values += self._noise * self._random.standard_normal(6)
        counts = values * self._scale
        beyond = bool((np.abs(counts) > self._limits).any())
        fx, fy, fz, tx, ty, tz = np.rint(np.clip(counts, -self._limits, self._limits)).astype(int).tolist()
        return (fx, fy, fz, tx, ty, tz), beyond

    def _status_of(self, beyond: bool) -> int:
        """Of one record more."""
        if beyond:
            self._flagged = FLAGGED_RECORDS
        if not self._flagged:
            return self._status
        self._flagged -= 1
        return self._status | OVER_RANGE


def _bound(host: str, port: int, clock: Clock) -> socket.socket | SimulatedSocket:
    if isinstance(clock, SimulatedClock):
        return SimulatedSocket(clock, host, port)
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        bound.bind((host, port))
        bound.setblocking(False)
    except BaseException:
        bound.close()
        raise
    return bound


def _heard(listening: socket.socket | SimulatedSocket, seconds: float) -> bool:
    """Whether something came meanwhile."""
    if isinstance(listening, SimulatedSocket):
        return listening.wait(seconds)
    return bool(select.select([listening], [], [], seconds)[0])


class _Stream:
    """From one request on."""

    def __init__(self, began: float, block: int, wanted: int, sequence: int) -> None:
        self.began, self.block, self.sequence = began, block, sequence
        self.left: int | None = wanted or None
        self.made = self.in_block = 0
        self.pending = bytearray()
