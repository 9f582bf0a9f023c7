"""The ATI Axia80 force/torque sensor: its UDP stream is converted to one filtered wrench per tick,
in softfin's axes.

Scale and units come from the sensor's web pages; the stream uses RDT (ATI manual 9610-05-Ethernet
Axia). Tested with the emulator, which a third-party client can also read, but not with a real
sensor.
"""

from collections.abc import Callable, Iterator

import numpy as np

from softfin.core.errors import DeviceError, RigError
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.device import CheckResult, ForceReading, SampleCounter
from softfin.rig.devices.axia80.config import Axia80Config
from softfin.rig.devices.axia80.pages import SensorSettings, read_settings
from softfin.rig.devices.axia80.rdt import RdtCommand, decode_status
from softfin.rig.devices.axia80.stream import ForceStream
from softfin.rig.lock import DeviceLock
from softfin.rig.machine import Wrench, rotated

FIRST_RECORD_S = 2.0
"""Longest wait for the stream to start [s]; the request is sent four times in this period, because
UDP may lose it."""

SILENT_S = 1.5
"""Time without a new record after which the stream counts as ended [s]; the loop's limit on the
force's age is much shorter."""

RETRY_S = 0.1
"""Time without a new record after which the stream is requested again [s]. A restarted sensor does
not send until requested; its sample counter then reveals that its zero is lost."""

BUSY_S = 10.0
"""Longest wait for a sensor that is busy when opened, e.g. after its power-up [s]."""

MEASURED_S = 0.5
"""Time for which the sensor streams to measure the rate and fill the filter [s]."""


class Axia80:
    """One sensor; not thread-safe."""

    def __init__(self, config: Axia80Config, clock: Computer = COMPUTER) -> None:
        self.config = config
        self.settings: SensorSettings | None = None
        """Settings from the sensor's pages; None before the first `open`."""
        self.clock = clock
        self.name = f"force sensor {config.address}"
        self._stream: ForceStream | None = None
        self.device_lock = DeviceLock(self.name, config.address, config.rdt_port)
        """Acquired by `open`: the sensor streams only to the latest client, so a second program
        would cut off the first."""

    @property
    def serial(self) -> str | None:
        """Serial number of the calibration; None if the sensor does not report it or has not been
        opened."""
        return None if self.settings is None else self.settings.calsn

    @property
    def stream(self) -> ForceStream:
        """Stream of the open sensor; raises DeviceError if the sensor is not open."""
        if self._stream is None or self._stream.client.closed:
            raise DeviceError(f"{self.name}: not open; open it first")
        return self._stream

    @property
    def delay_s(self) -> float:
        """Delay of the filter [s]."""
        return self.stream.delay_s

    @property
    def sample_counter(self) -> SampleCounter:
        """The sensor's counter of samples since it was switched on."""
        watch = self.stream.watch
        return SampleCounter(watch.ft_sequence, watch.ft_rate_hz)

    @property
    def zero_wrench(self) -> None:
        """None, because the sensor subtracts its zero itself."""
        return None

    def open(self) -> None:
        """Read the sensor's pages, start the stream and measure its rate, which takes half a
        second.

        Raises RigError if the sensor does not match the rig's file and DeviceError if it does not
        respond; the sensor is then closed.
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
        self.settings = settings = read_settings(config.address, config.http_port, clock.fetch_page)
        wanted = {
            "product": (config.product, settings.prodname),
            "serial": (config.serial, settings.calsn),
        }
        for name, (value, found) in wanted.items():
            if value not in (None, found):
                raise RigError(
                    f"{self.name}: {name} must be {value!r}, got {found!r}; check address or {name}"
                )
        self._stream = ForceStream(config, settings.scale, clock)
        self._await_stream(self._stream)
        self.read()

    def read(self) -> ForceReading:
        """Process the records that have arrived and return the latest force, without waiting.

        If nothing new has arrived, the reading and its time do not change.
        """
        stream = self.stream
        stream.take()
        if self.clock() - max(stream.taken, stream.requested) >= RETRY_S:
            stream.request()
        reading = stream.reading()
        if reading is None:
            raise DeviceError(
                f"{self.name}: received {stream.records} records, too few to compute a force; "
                "check the network"
            )
        return reading

    def keep_up(self) -> None:
        """Process the records that have arrived, so that none becomes outdated in the socket during
        other waits."""
        self.stream.take()

    def zero(self) -> None:
        """Set the sensor's zero to the current load. The sensor does not acknowledge this, so use
        `measured` to check the result.

        Takes about 0.2 s. Call only while the fin is at rest.
        """
        stream = self.stream
        if not stream.client.send(RdtCommand.BIAS):
            raise DeviceError(
                f"{self.name}: could not send the request to set its zero; check the cable"
            )
        # Records in transit still have the old zero.
        self._wait(lambda: False, 0.1)
        stream.filter.clear()
        if not self._wait(lambda: stream.filter.full, FIRST_RECORD_S):
            raise DeviceError(
                f"{self.name}: stream stopped while its zero was being set; check its power and "
                "cable"
            )
        stream.watch.accept_restart()

    def restore_zero(self, wrench: Wrench) -> None:
        """Never called, because `zero_wrench` is None."""
        raise AssertionError("the sensor keeps its zero itself")

    def checks(self) -> Iterator[CheckResult]:
        """Describe the open sensor."""
        product = self.settings.prodname if self.settings else "sensor"
        yield CheckResult(
            "force sensor",
            "well",
            f"{product}, {self.stream.times.rate_hz:.0f} records/s, filter delay "
            f"{self.stream.delay_s * 1e3:.1f} ms",
        )

    def measured(self, seconds: float) -> tuple[Wrench, Wrench]:
        """Wait for `seconds`, then return the mean and standard deviation of the unfiltered records
        received in that time, in softfin's axes [N, N m]."""
        stream = self.stream
        stream.take()
        collected = stream.collected = []
        try:
            self._wait(lambda: False, seconds)
        finally:
            stream.collected = None
        if not collected:
            raise DeviceError(
                f"{self.name}: sent nothing for {seconds:g} s; check its power and cable"
            )
        values = np.stack(collected)
        turn = stream.rotation
        return rotated(values.mean(0), turn), rotated(values.std(0), np.abs(turn))

    def complaints(self) -> tuple[str, ...]:
        """Return the errors as of the latest read, one line each, ending with the fix."""
        stream = self._stream
        if stream is None:
            return ()
        lines = [str(bit) for bit in decode_status(stream.status) if bit.is_error]
        lines += stream.watch.lines()
        silent = self.clock() - stream.taken
        if silent > SILENT_S:
            lines.append(
                f"no new record for {silent:.1f} s; check its power and cable, and make sure that "
                "no other program reads it; if it was off, its zero is lost: run softfin rig "
                "zero --force"
            )
        return tuple(f"{self.name}: {line}" for line in lines)

    def notes(self) -> tuple[str, ...]:
        """Return notes on the sensor's status that do not stop the fin, e.g. that it is busy or
        simulated."""
        if self._stream is None or self._stream.client.closed:
            return ()
        return tuple(
            f"{self.name}: {bit}" for bit in decode_status(self._stream.status) if not bit.is_error
        )

    def counters(self) -> dict[str, int]:
        """Return the counters since `open`, by name; empty before."""
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
        """Stop the stream and close the socket; may be called repeatedly and never raises."""
        if self._stream is not None and not self._stream.client.closed:
            self._stream.client.send(RdtCommand.STOP)
            self._stream.client.close()
        self.device_lock.release()

    def _await_stream(self, stream: ForceStream) -> None:
        """Wait until the sensor sends at the configured rate and is no longer busy."""
        config = self.config
        for _ in range(4):
            stream.request()
            if self._wait(lambda: stream.records > 0, FIRST_RECORD_S / 4):
                break
        else:
            raise DeviceError(
                f"{self.name}: its web page on port {config.http_port} works, but no record "
                f"arrived from UDP port {config.rdt_port} within {FIRST_RECORD_S:g} s "
                f"({stream.client.refused} malformed datagrams); check rdt_port, the RDT setting "
                "on the sensor's communication page, and the firewall"
            )

        def fits() -> bool:
            # The filter is built for the configured rate, and its delay is counted in records.
            is_measured = stream.times.measured_s >= MEASURED_S and stream.filter.full
            return is_measured and abs(stream.times.rate_hz / config.rate_hz - 1) <= 0.1

        # A busy computer delivers records in bursts; their mean rate converges to the true one.
        if not self._wait(fits, 5.0):
            raise RigError(
                f"{self.name}: sends {stream.times.rate_hz:.0f} records per second, but rate_hz "
                f"is {config.rate_hz:g}; set the RDT rate on the sensor's communication page, or "
                "change rate_hz to match"
            )

        if not self._wait(lambda: not stream.watch.is_busy, BUSY_S):
            raise DeviceError(
                f"{self.name}: busy for more than {BUSY_S:g} s; do not use its web pages; if it "
                "stays busy, switch it off and on, then run: softfin rig zero --force"
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
