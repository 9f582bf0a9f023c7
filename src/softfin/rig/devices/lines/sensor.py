"""A force sensor that sends lines of text, which become records for a `StreamedSensor`."""

import os
from collections.abc import Iterator

from softfin.core.printable import printable
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.device import CheckResult
from softfin.rig.device_type import ForceSensorType
from softfin.rig.devices.lines.config import COUNTERS, LinesConfig
from softfin.rig.devices.lines.parser import CLOCK_ERRORS, LagWatch, LineCounter, parse_line
from softfin.rig.devices.lines.transport import LineReader, TimedLine, open_transport
from softfin.rig.streamed_sensor import (
    FIRST_WAIT_S,
    MALFORMED_RECORDS,
    RecordSource,
    StreamedSensor,
    TimedWrench,
)


def lines_sensor(config: LinesConfig, clock: Computer = COMPUTER) -> StreamedSensor:
    """Create a force sensor that sends lines."""
    return StreamedSensor(config, LineSource(config, clock), clock)


class LineSource(RecordSource):
    """The lines of one sensor."""

    unit = "line"
    remedy = "check its cable and supply"

    def __init__(self, config: LinesConfig, clock: Computer) -> None:
        port = config.port
        name = port or f"{config.address} on UDP port {config.udp_port}"
        # A port may have several names.
        super().__init__(name, "lines", os.path.realpath(port) if port else config.udp_port)
        self.config = config
        self.clock = clock
        self._reader: LineReader | None = None
        self.restart()

    def restart(self) -> None:
        """Forget the lines so far."""
        super().restart()
        self._counter = LineCounter(self.config)
        self._lag = LagWatch(CLOCK_ERRORS.get(self.config.counter or "", 0.0))
        self._count_s: float | None = None
        """Duration of one count, once known [s]; None if the lines have no counter."""
        self._senders: list[str] = []
        """The first two addresses from which records came."""
        self._missing = 0
        self._malformed_in_a_row = 0
        self._example = b""
        """The latest malformed line."""

    @property
    def trouble(self) -> str | None:
        """Error that ended the reader; None while it runs."""
        return None if self._reader is None else self._reader.trouble

    def open(self) -> None:
        """Open the port; raises DeviceError on failure."""
        self.restart()
        transport = open_transport(self.config, self.clock)
        is_serial = self.config.port is not None
        self._reader = LineReader(transport, self.config.rate_hz, self.clock, is_serial)

    def take(self) -> list[TimedWrench]:
        """Return the usable lines that have arrived."""
        records: list[TimedWrench] = []
        if self._reader is None:
            return records
        # Not `while reader.lines`, because lines may arrive as fast as they are processed.
        for _ in range(len(self._reader.lines)):
            record = self._take(self._reader.lines.popleft())
            if record is not None:
                records.append(record)
        return records

    def watch(self, rate_hz: float) -> None:
        """Watch the delay of lines with a counter or time from now on."""
        counter = self.config.counter
        if counter is not None:
            # The line rate may differ from the configured rate by 10%.
            is_line = counter == "count"
            self._count_s = 1 / rate_hz if is_line else COUNTERS[counter]

    def describe(self) -> str:
        """Describe the records."""
        return "lines"

    def checks(self) -> Iterator[CheckResult]:
        """Yield a warning that lines without a number can be lost unnoticed."""
        if self.config.counter is None:
            text = "lines have no counter or time, so lost and duplicate lines are not detected"
            yield CheckResult("force sensor", "note", text)

    def explain_silence(self) -> str:
        """Return the expected columns and an example of a received line."""
        if self._senders:
            others = " and ".join(self._senders)
            return f"records come only from {others}; check address and udp_port"
        problem = f"no line within {FIRST_WAIT_S:g} s"
        if self.counted["malformed"]:
            problem = f"no line with columns {', '.join(self.config.columns)}, e.g. "
            problem += self._shown_example()
        return f"{problem}; {self.remedy}, and columns, separator and baud in the rig file"

    def complaints(self) -> list[str]:
        """Return the faults of the port and of the lines."""
        lines = []
        if self.trouble is not None:
            lines.append(f"disconnected ({self.trouble}); {self.remedy}, then start again")
        if len(self._senders) > 1:
            lines.append(
                f"records come from {' and '.join(self._senders)}, so two sensors send to this "
                "port, or one restarted; give each sensor its own udp_port, then start again"
            )
        elif self._counter.has_restarted:
            lines.append(
                "its counter went back, so the sensor restarted, or two sensors send to the same "
                "address; check its supply and cable"
            )
        if self._lag.is_lagging:
            lines.append(
                f"its lines arrive {self._lag.lag_s:.2f} s later than at the start, because they "
                "wait in a buffer; send fewer or shorter lines, or increase baud, then start again"
            )
        if self._malformed_in_a_row >= MALFORMED_RECORDS:
            lines.append(
                f"sends lines that do not match columns, e.g. {self._shown_example()}; check "
                "columns, separator and baud"
            )
        return lines

    def close(self) -> None:
        """Close the port; may be called repeatedly and never raises."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def _take(self, line: TimedLine) -> TimedWrench | None:
        """Count a line; return it if it is a new record."""
        record = parse_line(line.text, self.config)
        if record is not None and line.source not in self._senders:
            self._senders = [*self._senders, line.source][:2]
        if not line.is_expected:
            return None
        self.counted["records"] += 1
        if record is None:
            self.counted["malformed"] += 1
            self._malformed_in_a_row += 1
            self._example = line.text
            if self.config.counter is None:
                self._missing += 1
            return None
        self._malformed_in_a_row = 0
        steps = self._counter.steps(record.number)
        if steps <= 0:
            self.counted["late"] += 1
            return None
        if self.config.counter is not None:
            self.counted["lost"] += steps - 1
            self._missing += steps - 1
        if self._count_s is not None:
            self._lag.take(self._counter.total * self._count_s, line.time)
        missing = self._missing
        self._missing = 0
        return TimedWrench(record.wrench, missing, line.time)

    def _shown_example(self) -> str:
        return repr(printable(self._example.decode("ascii", "replace"))[:60])


LINES = ForceSensorType(LinesConfig, lines_sensor)
"""The type `lines`."""
