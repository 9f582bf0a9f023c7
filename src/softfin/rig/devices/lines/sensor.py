"""A force sensor that sends lines of text: one filtered wrench per tick, in softfin's axes.

softfin keeps the sensor's zero and subtracts it, so that a restart of the sensor does not lose it.
"""

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float

from softfin.core.clock import REAL, Clock
from softfin.core.errors import DeviceError, RigError
from softfin.core.printable import printable
from softfin.core.quantities import RATE_HZ
from softfin.rig.device import CheckResult, ForceReading
from softfin.rig.devices.lines.config import COUNTERS, LinesConfig
from softfin.rig.devices.lines.parser import (
    CLOCK_ERRORS,
    LagWatch,
    LineCounter,
    LineParser,
    Record,
)
from softfin.rig.devices.lines.transport import LineReader, TimedLine, open_transport
from softfin.rig.filter import AntiAlias
from softfin.rig.lock import DeviceLock
from softfin.rig.machine import Wrench, rotated, rotation
from softfin.rig.stream_clock import StreamClock

FIRST_LINE_S = 5.0
"""Longest wait for the first line [s]; many Arduinos restart when their port is opened."""

SILENT_S = 1.5
"""Time without a usable line after which the sensor counts as silent [s]; the loop's limit on the
force's age is much shorter."""

MEASURED_S = 0.5
"""Shortest time over which the rate is measured [s]."""

MALFORMED_LINES = 5
"""Number of consecutive unusable lines that is a fault; a single one is only counted."""

STUCK_S = 1.0
FROZEN_LINES = 20
"""Time [s] and number of lines for which all values may stay the same."""


class LinesSensor:
    """One sensor; not thread-safe."""

    def __init__(self, config: LinesConfig, clock: Clock = REAL) -> None:
        self.config = config
        self.clock = clock
        place = config.port or f"{config.address} on UDP port {config.udp_port}"
        self.name = f"force sensor {place}"
        self.device_lock = DeviceLock(self.name, "lines", config.port or config.udp_port)
        self._parser = LineParser(config)
        self._rotation = rotation(config.frame)
        self._offset = np.zeros(6)
        self._reader: LineReader | None = None
        self._reset()

    def _reset(self) -> None:
        self.records = self.lost = self.late = self.malformed = 0
        self._counter = LineCounter(self.config)
        self._lag = LagWatch(CLOCK_ERRORS.get(self.config.counter or "", 0.0))
        self._count_s: float | None = None
        """Time that one count lasts, once it is known [s]; None if the lines have no counter."""
        self._sources: list[str] = []
        """The first two addresses from which records came."""
        self.times = StreamClock(self.config.rate_hz)
        self._filter: AntiAlias | None = None
        if self.config.is_filtered:
            self._filter = AntiAlias(self.config.rate_hz, self.config.cutoff_hz)
        self._place = 0
        """Position of the latest line in the stream, counting lost ones."""
        self._missing = 0
        self._newest: Record | None = None
        self._taken = self.clock()
        """Time of the latest usable line [s]."""
        self._malformed_in_a_row = 0
        self._example = b""
        """The latest malformed line."""
        self._equal_lines = 0
        self._force: tuple[float, Wrench] | None = None
        self._peak = np.zeros(6)
        self._collected: list[Float[np.ndarray, " 6"]] | None = None

    @property
    def serial(self) -> None:
        """None, because lines contain no serial number."""
        return None

    @property
    def sample_counter(self) -> None:
        """None, because softfin keeps the zero."""
        return None

    @property
    def zero_wrench(self) -> Wrench:
        """The wrench that is subtracted from every line, in the sensor's axes [N, N m]."""
        fx, fy, fz, tx, ty, tz = self._offset.tolist()
        return fx, fy, fz, tx, ty, tz

    @property
    def delay_s(self) -> float:
        """Delay of the sensor's own filter and of softfin's [s]."""
        own = 0.0 if self._filter is None else self._filter.delay / self.times.rate_hz
        return self.config.filter_delay_s + own

    def open(self) -> None:
        """Open the port, wait for lines and measure their rate; raises RigError if the lines do not
        match the configuration and DeviceError if none arrive."""
        self.close()
        self.device_lock.acquire(self.clock)
        try:
            self._reset()
            self._offset = np.zeros(6)
            transport = open_transport(self.config, self.clock)
            is_serial = self.config.port is not None
            self._reader = LineReader(transport, self.config.rate_hz, self.clock, is_serial)
            self._await_lines()
            self._start_lag_watch()
            self.read()
        except BaseException:
            self.close()
            raise

    def read(self) -> ForceReading:
        """Process the lines that have arrived and return the latest force, without waiting."""
        self.keep_up()
        self._update_force()
        if self._force is None:
            raise DeviceError(f"{self.name}: too few lines to compute a force; check its cable")
        # The rotation only permutes axes and flips signs.
        peak = rotated(self._peak, np.abs(self._rotation))
        self._peak = np.zeros(6)
        return ForceReading(*self._force, peak)

    def keep_up(self) -> None:
        """Process the lines that have arrived."""
        reader = self._open_reader()
        newest = None
        # Not `while reader.lines`: more may arrive as fast as they are processed.
        for _ in range(len(reader.lines)):
            line = reader.lines.popleft()
            if self._take(line):
                newest = line.time
        if newest is not None:
            self._taken = newest
            self.times.stamp(self._place, newest)

    def zero(self) -> None:
        """Set the zero to the mean of the next half second; call only while the fin is at rest."""
        offset = self._offset
        self._offset = np.zeros(6)
        try:
            offset = self._mean(MEASURED_S)[0]
        finally:
            self._offset = offset
            self._peak = np.zeros(6)

    def restore_zero(self, wrench: Wrench) -> None:
        """Subtract a recorded zero, in the sensor's axes [N, N m]."""
        self._offset = np.array(wrench)
        self._peak = np.zeros(6)

    def measured(self, seconds: float) -> tuple[Wrench, Wrench]:
        """Wait for `seconds`, then return the mean and standard deviation of the lines received in
        that time, in softfin's axes [N, N m]."""
        mean, deviation = self._mean(seconds)
        return rotated(mean, self._rotation), rotated(deviation, np.abs(self._rotation))

    def checks(self) -> Iterator[CheckResult]:
        """Describe the open sensor."""
        text = f"lines, {self.times.rate_hz:.0f}/s, delay {self.delay_s * 1e3:.1f} ms"
        yield CheckResult("force sensor", "well", text)
        yield from (CheckResult("force sensor", "note", note) for note in self.notes())
        if self.config.counter is None:
            text = "lines have no counter or time, so lost and doubled lines are not noticed"
            yield CheckResult("force sensor", "note", text)

    def complaints(self) -> tuple[str, ...]:
        """Return the faults as of the latest read, one line each, ending with the fix."""
        if self._reader is None or self._reader.closed:
            return ()
        lines = []
        if self._reader.trouble is not None:
            lines.append(
                f"disconnected ({self._reader.trouble}); check its cable and supply, then start "
                "again"
            )
        if len(self._sources) > 1:
            lines.append(self._two_sources())
        elif self._counter.has_restarted:
            lines.append(
                "its counter went back, so it restarted, or two sensors send to the same address; "
                "check its supply and cable"
            )
        if self._lag.is_lagging:
            lines.append(
                f"its lines arrive {self._lag.lag_s:.2f} s later than before, so they fill a "
                "buffer; send fewer or shorter lines, or increase baud, then start again"
            )
        if self._malformed_in_a_row >= MALFORMED_LINES:
            lines.append(
                f"sends lines that do not match columns, e.g. {self._shown_example()}; check "
                "columns, separator and baud"
            )
        if self._equal_lines >= max(FROZEN_LINES, STUCK_S * self.config.rate_hz):
            lines.append(
                "values are frozen; check the load cells, and send enough digits to show noise"
            )
        silent_s = self.clock() - self._taken
        if silent_s > SILENT_S:
            lines.append(f"no usable line for {silent_s:.1f} s; check its cable and supply")
        return tuple(f"{self.name}: {line}" for line in lines)

    def notes(self) -> tuple[str, ...]:
        """Return a note if the sensor is slower than the loop."""
        if self.config.rate_hz >= RATE_HZ:
            return ()
        return (
            f"{self.name}: {self.config.rate_hz:g} lines per second are fewer than the log's "
            f"{RATE_HZ} rows; the force in between is interpolated",
        )

    def counters(self) -> dict[str, int]:
        """Return the counters since `open`."""
        return {
            "sensor_records": self.records,
            "sensor_lost": self.lost,
            "sensor_late": self.late,
            "sensor_malformed": self.malformed,
        }

    def close(self) -> None:
        """Close the port; may be called repeatedly and never raises."""
        if self._reader is not None:
            self._reader.close()
        self.device_lock.release()

    def _open_reader(self) -> LineReader:
        if self._reader is None or self._reader.closed:
            raise DeviceError(f"{self.name}: not open; open it first")
        return self._reader

    def _two_sources(self) -> str:
        return (
            f"records come from {' and '.join(self._sources)}, so two sensors send to this port, "
            "or it restarted; give each its own udp_port, then start again"
        )

    def _start_lag_watch(self) -> None:
        counter = self.config.counter
        if counter is not None:
            # The rate of the lines may differ from the file by 10%.
            is_line = counter == "count"
            self._count_s = 1 / self.times.rate_hz if is_line else COUNTERS[counter]

    def _take(self, line: TimedLine) -> bool:
        """Process a line; return whether it is a new record."""
        text = line.text
        record = self._parser.parse(text)
        if record is not None and line.source not in self._sources[:2]:
            self._sources = [*self._sources, line.source][:2]
        if not line.is_expected:
            return False
        self.records += 1
        if record is None:
            self.malformed += 1
            self._malformed_in_a_row += 1
            self._example = text
            if self.config.counter is None:
                self._missing += 1
            return False
        self._malformed_in_a_row = 0
        steps = self._counter.steps(record.number)
        if steps <= 0:
            self.late += 1
            return False
        if self.config.counter is not None:
            self.lost += steps - 1
            self._missing += steps - 1
        if self._count_s is not None:
            self._lag.take(self._counter.total * self._count_s, line.time)
        self._put(record)
        return True

    def _put(self, record: Record) -> None:
        values = record.wrench
        self._place += 1 + self._missing
        if self._filter is not None:
            if not self._filter.bridges(self._missing):
                # The numbers may have jumped by more than the elapsed time.
                self.times.restart()
            self._filter.put(values, self._missing)
        self._missing = 0
        before = self._newest
        is_equal = before is not None and bool((before.wrench == values).all())
        self._equal_lines = self._equal_lines + 1 if is_equal else 0
        self._newest = record
        np.maximum(self._peak, np.abs(values - self._offset), out=self._peak)
        if self._collected is not None:
            self._collected.append(values - self._offset)

    def _update_force(self) -> None:
        output = self._filter.output() if self._filter is not None else None
        if self._filter is None and self._newest is not None:
            output = self._newest.wrench
        if output is None:
            return
        moment = self.times.estimate_time(self._place) - self.delay_s
        # The measured rate is still settling, but reported times must not go backwards.
        latest = moment if self._force is None else max(moment, self._force[0])
        self._force = (latest, rotated(output - self._offset, self._rotation))

    def _mean(self, seconds: float) -> tuple[Float[np.ndarray, " 6"], Float[np.ndarray, " 6"]]:
        """Return mean and standard deviation of the next lines, in the sensor's axes."""
        self.keep_up()
        collected = self._collected = []
        try:
            self._wait(lambda: False, max(seconds, 3 / self.config.rate_hz))
        finally:
            self._collected = None
        if not collected:
            raise DeviceError(f"{self.name}: sent nothing for {seconds:g} s; check its cable")
        values = np.stack(collected)
        return values.mean(0), values.std(0)

    def _await_lines(self) -> None:
        config = self.config
        if not self._wait(lambda: self._newest is not None, FIRST_LINE_S):
            if self._sources:
                others = " and ".join(self._sources)
                raise DeviceError(
                    f"{self.name}: records come only from {others}; check address and udp_port"
                )
            problem = f"no line within {FIRST_LINE_S:g} s"
            if self.malformed:
                problem = f"no line with columns {', '.join(config.columns)}, e.g. "
                problem += self._shown_example()
            raise DeviceError(
                f"{self.name}: {problem}; check its cable and supply, and columns, separator and "
                "baud in the rig's file"
            )
        shortest_s = max(MEASURED_S, 5 / config.rate_hz)

        def fits() -> bool:
            is_full = self._filter is None or self._filter.full
            is_measured = self.times.measured_s >= shortest_s and is_full
            return is_measured and abs(self.times.rate_hz / config.rate_hz - 1) <= 0.1

        if not self._wait(fits, 5.0 + shortest_s):
            if len(self._sources) > 1:
                raise RigError(f"{self.name}: {self._two_sources()}")
            raise RigError(
                f"{self.name}: sends {self.times.rate_hz:.0f} lines per second, but rate_hz is "
                f"{config.rate_hz:g}; change one of them"
            )

    def _shown_example(self) -> str:
        return repr(printable(self._example.decode("ascii", "replace"))[:60])

    def _wait(self, done: Callable[[], bool], seconds: float) -> bool:
        end = self.clock() + seconds
        while not done():
            if self.clock() >= end or self._open_reader().trouble is not None:
                return False
            self.clock.sleep(0.002)
            self.keep_up()
        return True
