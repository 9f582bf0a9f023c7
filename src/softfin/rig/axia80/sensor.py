"""The ATI Axia80 force/torque sensor: its stream over UDP becomes one filtered wrench a tick, in softfin's axes.

Scale and units come from the sensor's own pages, the stream is RDT (ATI manual 9610-05-Ethernet Axia). Tried against
the emulator, which another program's client reads too; not against a real sensor.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from softfin.core.clock import REAL, Clock
from softfin.core.errors import DeviceError, RigError
from softfin.rig.axia80.config import SensorConfig
from softfin.rig.axia80.rdt import Order
from softfin.rig.axia80.socket import BUFFER_BYTES, RdtSocket
from softfin.rig.axia80.status import decode_status
from softfin.rig.axia80.stream import ForceReading, ForceStream
from softfin.rig.axia80.xml import SensorSettings, read_settings
from softfin.rig.machine import Wrench
from softfin.rig.simulated_clock import SimulatedClock
from softfin.rig.simulated_network import KEPT_BYTES, fetch_page

FIRST_RECORD_S = 2.0
"""Longest wait for the stream to begin; the request is sent four times meanwhile, as UDP may lose it."""

ASKED_AGAIN_S = 1.0
"""Without a new record, the stream is asked for anew."""

SILENT_S = 1.5
"""Without a new record for so long, its stream has ended; the loop judges the age of the force long before."""

MEASURED_S = 0.5
"""Of the stream, to know its rate and fill the filter."""

SECOND_LOOK_S = 3.0
"""At a rate that does not fit; its mean since the stream began fits in the end where the computer was only busy."""

RATE_TOLERANCE = 0.1
"""Of the rate that the rig's file says; the filter is built for that, and its delay is counted in records."""

BIAS_S = 0.1
"""Records on their way when the sensor's zero is set still have the old one."""

NAP_S = 0.002

KEPT_S = 0.25
"""Of the stream, that the kernel should keep: enabling a drive and a busy computer take that long."""


class Measured(NamedTuple):
    """The unfiltered stream over a while, in softfin's axes."""

    mean: Wrench
    std: Wrench
    records: int


class Axia80:
    """One sensor; one thread calls it."""

    def __init__(
        self,
        config: SensorConfig,
        clock: Clock = REAL,
        wall: Callable[[], float] | None = None,
        buffer_bytes: int = BUFFER_BYTES,
    ) -> None:
        self.config = config
        self.settings: SensorSettings | None = None
        """What the sensor's pages say; None until it was open."""
        self._clock, self._wall, self._buffer_bytes = clock, wall or clock.wall, buffer_bytes
        self._name = f"force sensor {config.address}"
        self._socket: RdtSocket | None = None
        self._stream: ForceStream | None = None
        self._asked = 0.0
        self._asked_again = self._restarts_seen = 0

    @property
    def delay_s(self) -> float:
        """Of the filter [s]."""
        return self._opened()[1].delay_s

    @property
    def rate_hz(self) -> float:
        """Records a second, as measured [Hz]."""
        return self._opened()[1].times.rate_hz

    @property
    def buffer_bytes(self) -> int:
        """What the kernel keeps of the stream while nobody reads; it counts several hundred bytes a record."""
        return self._opened()[0].buffer_bytes

    def open(self) -> None:
        """Read its pages, start the stream, measure its rate: half a second where all is well.

        Raises RigError where it is not as the rig's file says, DeviceError where it does not answer; closed then.
        """
        self.close()
        config = self.config
        self.settings = self._read_settings()
        self._check_identity(self.settings)
        self._socket = RdtSocket(config.address, config.rdt_port, self._clock, self._wall, self._buffer_bytes)
        self._stream = ForceStream(config, self.settings, self._clock())
        self._asked_again = self._restarts_seen = 0
        try:
            self._await_stream()
            self._check_rate()
            if config.bias_on_open:
                self.bias()
            self.read()
        except BaseException:
            self.close()
            raise

    def read(self, at: float | None = None) -> ForceReading:
        """Take what has arrived, without waiting; the newest force, or that of records up to a moment [s] near it.

        Where nothing new can be told, after a gap or in silence, the reading is the old one and so is its time.
        """
        receiver, stream = self._opened()
        records = stream.take(receiver)
        if self._clock() - max(stream.heard, self._asked) >= ASKED_AGAIN_S:
            self._asked_again += 1
            self._ask()
        reading = stream.reading(at, records)
        if reading is None:
            raise DeviceError(f"{self._name}: sent {stream.records} records, too few for a force; check the network")
        return reading

    def bias(self) -> None:
        """Set the sensor's own zero to what it feels now; it does not answer, so `measured` tells whether it did.

        Takes about 0.2 s; only with the fin at rest.
        """
        receiver, stream = self._opened()
        if not receiver.send(Order.BIAS):
            raise DeviceError(f"{self._name}: the network does not take the request to set its zero; check the cable")
        self._wait(lambda: False, BIAS_S)
        stream.filter.clear()
        if not self._wait(lambda: stream.full, FIRST_RECORD_S):
            raise DeviceError(f"{self._name}: its stream stopped while its zero was set; check its power and cable")
        self._restarts_seen = stream.sequence.restarts

    def measured(self, seconds: float) -> Measured:
        """Mean and standard deviation of all records over a while; waits for it."""
        receiver, stream = self._opened()
        stream.take(receiver)
        collected = stream.collected = []
        try:
            self._wait(lambda: False, seconds)
        finally:
            stream.collected = None
        if not collected:
            raise DeviceError(f"{self._name}: sent nothing in {seconds:g} s; check its power and cable")
        values = np.stack(collected)
        x, y, z, torque_x, torque_y, torque_z = map(abs, stream.turned(values.std(0)))
        return Measured(stream.turned(values.mean(0)), (x, y, z, torque_x, torque_y, torque_z), len(values))

    def complaints(self) -> tuple[str, ...]:
        """What is wrong as of the latest read, each one line that ends in the way out."""
        stream = self._stream
        if stream is None:
            return ()
        lines = [f"{self._name}: {bit}" for bit in decode_status(stream.status).errors]
        if stream.sequence.restarts > self._restarts_seen:
            lines.append(f"{self._name}: it was switched off and on, its zero is lost; set it with the fin at rest")
        silent = self._clock() - stream.heard
        if silent > SILENT_S:
            lines.append(
                f"{self._name}: nothing new for {silent:.1f} s, requests repeated so far: {self._asked_again}; "
                "check its power and cable, and that no other program reads it"
            )
        return tuple(lines)

    def notes(self) -> tuple[str, ...]:
        """What is worth knowing and no error: busy, simulated, little room for its stream."""
        receiver, stream = self._socket, self._stream
        if receiver is None or stream is None or receiver.closed:
            return ()
        notes = [str(bit) for bit in decode_status(stream.status).notes]
        kept = receiver.buffer_bytes / KEPT_BYTES / stream.times.rate_hz
        if kept < KEPT_S:
            notes.append(f"only {kept:.2f} s of its stream are kept while nobody reads; raise net.core.rmem_max")
        return tuple(f"{self._name}: {note}" for note in notes)

    def counters(self) -> dict[str, int]:
        """What was counted since it was opened; nothing before, and no more once it is closed."""
        receiver, stream = self._socket, self._stream
        if receiver is None or stream is None:
            return {}
        return {
            "sensor_records": stream.records,
            "sensor_lost": stream.sequence.lost,
            "sensor_late": stream.sequence.late,
            "sensor_duplicates": stream.sequence.duplicates,
            "sensor_streams": stream.sequence.streams,
            "sensor_restarts": stream.sequence.restarts,
            "sensor_bridged": stream.filter.bridged,
            "sensor_gaps": stream.filter.interrupted,
            "sensor_error_records": stream.error_records,
            "sensor_busy_records": stream.busy_records,
            "sensor_asked_again": self._asked_again,
            "sensor_foreign_datagrams": receiver.foreign,
            "sensor_refused_datagrams": receiver.refused,
            "sensor_unsent_requests": receiver.unsent,
            "sensor_crowded_reads": receiver.crowded,
        }

    def close(self) -> None:
        """Ask it to be silent, let go of the socket; any number of times, never raises."""
        if self._socket is not None and not self._socket.closed:
            self._socket.send(Order.STOP)
            self._socket.close()

    def _read_settings(self) -> SensorSettings:
        host, port, clock = self.config.address, self.config.http_port, self._clock
        if isinstance(clock, SimulatedClock):
            return read_settings(host, port, page_of=lambda path: fetch_page(clock, host, port, path))
        return read_settings(host, port)

    def _check_identity(self, settings: SensorSettings) -> None:
        for name, wanted, found in (
            ("product", self.config.product, settings.product),
            ("serial", self.config.serial, settings.serial),
        ):
            if wanted is not None and wanted != found:
                says = f"it says {found!r}" if found else "it says nothing of it"
                raise RigError(f"{self._name}: {name} must be {wanted!r}, {says}; check address or {name}")

    def _await_stream(self) -> None:
        receiver, stream = self._opened()
        for _ in range(4):
            self._ask()
            if self._wait(lambda: stream.records > 0, FIRST_RECORD_S / 4):
                return
        config = self.config
        raise DeviceError(
            f"{self._name}: its page at port {config.http_port} answers, but no record came from UDP port "
            f"{config.rdt_port} in {FIRST_RECORD_S:g} s ({receiver.foreign} datagrams of others, {receiver.refused} "
            "malformed); check rdt_port, RDT on the sensor's communication page, and the firewall"
        )

    def _check_rate(self) -> None:
        _, stream = self._opened()
        config, times = self.config, stream.times

        def fits() -> bool:
            return abs(times.rate_hz / config.rate_hz - 1) <= RATE_TOLERANCE

        self._wait(lambda: times.measured_s >= MEASURED_S and stream.full, 4 * MEASURED_S)
        if not fits():
            # A busy computer delivers in bursts; a longer look tells those from another rate.
            self._wait(fits, SECOND_LOOK_S)
        if not fits():
            raise RigError(
                f"{self._name}: sends {times.rate_hz:.0f} records a second, rate_hz is {config.rate_hz:g}; "
                "set the RDT rate on the sensor's communication page, or rate_hz to what it sends"
            )

    def _opened(self) -> tuple[RdtSocket, ForceStream]:
        if self._socket is None or self._stream is None or self._socket.closed:
            raise DeviceError(f"{self._name}: not open; open it first")
        return self._socket, self._stream

    def _ask(self) -> None:
        receiver, stream = self._opened()
        receiver.send(Order.START)
        stream.sequence.begin()
        self._asked = self._clock()

    def _wait(self, done: Callable[[], bool], seconds: float) -> bool:
        receiver, stream = self._opened()
        end = self._clock() + seconds
        while not done():
            if self._clock() >= end:
                return False
            self._clock.sleep(NAP_S)
            stream.take(receiver)
        return True
