"""The ATI Axia80 force/torque sensor: its stream over UDP becomes one filtered wrench a tick, in
softfin's axes.

Scale and units come from the sensor's own pages, the stream is RDT (ATI manual 9610-05-Ethernet
Axia). Tried against the emulator, which another program's client reads too; not against a real
sensor.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from softfin.core.clock import REAL, Clock
from softfin.core.errors import DeviceError, RigError
from softfin.rig.axia80.config import Axia80Config
from softfin.rig.axia80.pages import SensorSettings, fetch_page, read_settings
from softfin.rig.axia80.rdt import RdtCommand, decode_status
from softfin.rig.axia80.stream import ForceReading, ForceStream
from softfin.rig.lock import DeviceLock
from softfin.rig.machine import Wrench, rotated
from softfin.rig.simulated_clock import SimulatedClock
from softfin.rig.simulated_network import fetch_simulated_page

FIRST_RECORD_S = 2.0
"""Longest wait for the stream to begin; the request is sent four times meanwhile, as UDP may lose
it."""

SILENT_S = 1.5
"""Time without a new record after which its stream has ended; the loop judges the age of the force
long before."""

RETRY_S = 0.1
"""Time without a new record after which the stream is requested again [s]. A sensor that restarted
does not send by itself; once it does, its count tells that its zero is lost."""

BUSY_S = 10.0
"""Longest wait for a sensor that is still busy when it is opened, as after its power-up [s]."""

MEASURED_S = 0.5
"""Stretch of the stream that shows its rate and fills the filter."""


class Axia80:
    """One sensor; one thread calls it."""

    def __init__(self, config: Axia80Config, clock: Clock = REAL) -> None:
        self.config = config
        self.settings: SensorSettings | None = None
        """Settings on the sensor's pages; None until it was open."""
        self.clock = clock
        self._name = f"force sensor {config.address}"
        self._stream: ForceStream | None = None
        self.device_lock = DeviceLock(self._name, config.address, config.rdt_port)
        """Taken by `open`: the sensor streams to whoever asked last, so a second program would
        silence the first."""

    @property
    def serial(self) -> str | None:
        """Serial number of its calibration; None if it reports none, or was never open."""
        return None if self.settings is None else self.settings.calsn

    @property
    def stream(self) -> ForceStream:
        """Stream of the sensor while it is open; raises DeviceError else."""
        if self._stream is None or self._stream.client.closed:
            raise DeviceError(f"{self._name}: not open; open it first")
        return self._stream

    def open(self) -> None:
        """Read its pages, start the stream and measure its rate, which takes half a second.

        Raises RigError where it is not as the rig's file describes it, DeviceError where it does
        not answer; it is closed then.
        """
        self.close()
        self.device_lock.acquire(self.clock)
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        config = self.config
        clock = self.clock
        fetch = (
            partial(fetch_simulated_page, clock)
            if isinstance(clock, SimulatedClock)
            else fetch_page
        )
        self.settings = settings = read_settings(config.address, config.http_port, fetch)
        wanted = {
            "product": (config.product, settings.prodname),
            "serial": (config.serial, settings.calsn),
        }
        for name, (value, found) in wanted.items():
            if value not in (None, found):
                raise RigError(
                    f"{self._name}: {name} must be {value!r}, got {found!r}; check address or "
                    f"{name}"
                )
        self._stream = ForceStream(config, settings.scale, clock)
        self._await_stream(self._stream)
        self.read()

    def read(self) -> ForceReading:
        """Take what has arrived, without waiting, and return the newest force.

        During a gap or in silence the reading is the old one and so is its time.
        """
        stream = self.stream
        stream.take()
        if self.clock() - max(stream.taken, stream.requested) >= RETRY_S:
            stream.request()
        reading = stream.reading()
        if reading is None:
            raise DeviceError(
                f"{self._name}: sent {stream.records} records, too few for a force; check the "
                "network"
            )
        return reading

    def keep_up(self) -> None:
        """Take what has arrived, so that none of it grows old in the socket while something else is
        waited for."""
        self.stream.take()

    def bias(self) -> None:
        """Set the sensor's zero to the present load; it does not answer, so use `measured` to see
        whether it did.

        Takes about 0.2 s; only with the fin at rest.
        """
        stream = self.stream
        if not stream.client.send(RdtCommand.BIAS):
            raise DeviceError(
                f"{self._name}: the request to set its zero could not be sent; check the cable"
            )
        # Records on their way still have the old zero.
        self._wait(lambda: False, 0.1)
        stream.filter.clear()
        if not self._wait(lambda: stream.filter.full, FIRST_RECORD_S):
            raise DeviceError(
                f"{self._name}: its stream stopped while its zero was set; check its power and "
                "cable"
            )
        stream.watch.accept_restart()

    def measured(self, seconds: float) -> tuple[Wrench, Wrench]:
        """Mean and standard deviation of all records over a while, unfiltered, in softfin's axes;
        waits for it."""
        stream = self.stream
        stream.take()
        collected = stream.collected = []
        try:
            self._wait(lambda: False, seconds)
        finally:
            stream.collected = None
        if not collected:
            raise DeviceError(
                f"{self._name}: sent nothing in {seconds:g} s; check its power and cable"
            )
        values = np.stack(collected)
        turn = stream.rotation
        return rotated(values.mean(0), turn), rotated(values.std(0), np.abs(turn))

    def complaints(self) -> tuple[str, ...]:
        """Errors as of the latest read, each one line that ends with a fix."""
        stream = self._stream
        if stream is None:
            return ()
        lines = [str(bit) for bit in decode_status(stream.status) if bit.is_error]
        lines += stream.watch.lines()
        silent = self.clock() - stream.taken
        if silent > SILENT_S:
            lines.append(
                f"no new record for {silent:.1f} s; check its power and cable, and that no other "
                "program reads it; if it was off, its zero is lost: run softfin rig zero --force"
            )
        return tuple(f"{self._name}: {line}" for line in lines)

    def notes(self) -> tuple[str, ...]:
        """Remarks of its status that do not stop the fin: busy, simulated."""
        if self._stream is None or self._stream.client.closed:
            return ()
        return tuple(
            f"{self._name}: {bit}" for bit in decode_status(self._stream.status) if not bit.is_error
        )

    def counters(self) -> dict[str, int]:
        """Counts since it was opened; none before."""
        stream = self._stream
        if stream is None:
            return {}
        return {
            "sensor_records": stream.records,
            "sensor_lost": stream.lost,
            "sensor_late": stream.late,
            "sensor_discarded": stream.discarded,
            "sensor_refused_datagrams": stream.client.refused,
        }

    def close(self) -> None:
        """Stop the stream and close the socket; any number of times, never raises."""
        if self._stream is not None and not self._stream.client.closed:
            self._stream.client.send(RdtCommand.STOP)
            self._stream.client.close()
        self.device_lock.release()

    def _await_stream(self, stream: ForceStream) -> None:
        """Wait until it sends, at the rate that it is set to."""
        config = self.config
        for _ in range(4):
            stream.request()
            if self._wait(lambda: stream.records > 0, FIRST_RECORD_S / 4):
                break
        else:
            raise DeviceError(
                f"{self._name}: its page at port {config.http_port} answers, but no record came "
                f"from UDP port {config.rdt_port} in {FIRST_RECORD_S:g} s ({stream.client.refused} "
                "malformed datagrams); check rdt_port, RDT on the sensor's communication page, "
                "and the firewall"
            )

        def fits() -> bool:
            # The filter is built for the configured rate, and its delay is counted in records.
            is_measured = stream.times.measured_s >= MEASURED_S and stream.filter.full
            return is_measured and abs(stream.times.rate_hz / config.rate_hz - 1) <= 0.1

        # A busy computer delivers in bursts, whose mean rate fits in the end.
        if not self._wait(fits, 5.0):
            raise RigError(
                f"{self._name}: sends {stream.times.rate_hz:.0f} records per second, but rate_hz "
                f"is {config.rate_hz:g}; set the RDT rate on the sensor's communication page, or "
                "change rate_hz to match"
            )

        if not self._wait(lambda: not stream.watch.is_busy, BUSY_S):
            raise DeviceError(
                f"{self._name}: busy for more than {BUSY_S:g} s; do not use its web pages, "
                "or switch it off and on, then run: softfin rig zero --force"
            )

    def _wait(self, done: Callable[[], bool], seconds: float) -> bool:
        stream = self.stream
        end = self.clock() + seconds
        while not done():
            if self.clock() >= end:
                return False
            self.clock.sleep(0.002)
            stream.take()
        return True
