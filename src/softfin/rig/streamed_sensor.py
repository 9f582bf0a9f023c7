"""A force sensor that streams records and whose zero softfin keeps. It provides one filtered wrench
per tick in softfin's axes.

The records come from a `RecordSource`, e.g. lines on a serial port or messages on a ROS 2 topic.
softfin subtracts the zero, so it is not lost when the sensor restarts.
"""

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from pydantic import Field

from softfin.core.clock import Clock
from softfin.core.errors import DeviceError, RigError
from softfin.core.quantities import RATE_HZ
from softfin.rig.device import CheckResult, ForceReading, ForceSensorConfig
from softfin.rig.filter import BRIDGED_S, AntiAlias, design
from softfin.rig.frozen import FrozenChannels
from softfin.rig.lock import DeviceLock
from softfin.rig.machine import Wrench, WrenchArray, rotated, rotation
from softfin.rig.stream_clock import StreamClock

FIRST_WAIT_S = 5.0
"""Maximum wait for the first record [s]; many Arduinos restart when their port is opened, and ROS 2
nodes need time to find each other."""

SILENT_S = 1.5
"""Time without a usable record after which the sensor is treated as silent [s]; the age limit for
forces in the loop is much shorter."""

MEASURED_S = 0.5
"""Minimum time over which the rate is measured [s]."""

PAUSE_S = 0.3
"""Minimum pause between records that is treated as a restart while the sensor is being opened
[s]."""

KEPT_S = 2.0
"""Time after which unread records are dropped [s]."""

CONSTANT_S = 0.9
"""Time for which a channel of a sensor with unknown noise may keep its value [s]; less than 1 s, so
that softfin reports a frozen channel within 1 s."""

MALFORMED_RECORDS = 5
"""Number of consecutive unusable records that is treated as a fault; a single unusable record is
only counted."""


class StreamedSensorConfig(ForceSensorConfig):
    """Settings of a sensor that streams records and whose zero softfin keeps."""

    rate_hz: float = Field(ge=10, le=1000)
    """Number of records per second; softfin measures the rate when it opens the sensor and rejects
    a deviation of more than 10%."""
    filter_delay_s: float = Field(ge=0, le=0.5)
    """Delay of the filter in the sensor [s], by which softfin corrects the time of the force; no
    default, because it depends on the sensor and its settings."""
    cutoff_hz: float = Field(30.0, ge=10, le=40)
    """Cut-off frequency of the anti-alias filter (gain 1/2) [Hz]; not used at 100 records per
    second or fewer."""

    @property
    def is_filtered(self) -> bool:
        """Whether softfin filters the records; a rate at or below 100 Hz needs no filter."""
        return self.rate_hz > RATE_HZ

    def check_stale(self, force_stale_s: float) -> None:
        """Raise ValueError if the usual age of the force exceeds a limit [s]."""
        filter_s = 0.0
        if self.is_filtered:
            filter_s = len(design(self.rate_hz, self.cutoff_hz)) // 2 / self.rate_hz
        # As for other sensors, the filter may have to refill, and two records may be lost.
        needed = self.filter_delay_s + 3 * filter_s + max(2 * BRIDGED_S, 3 / self.rate_hz)
        if force_stale_s < needed:
            raise ValueError(
                f"safety.force_stale_s = {force_stale_s:g}: at {self.rate_hz:g} records per second "
                f"and with a delay of {self.filter_delay_s + filter_s:.3f} s, the force may be "
                f"older; use {math.ceil(100 * needed) / 100:.2f} or more, or a faster sensor"
            )


def queue_length(rate_hz: float) -> int:
    """Return the number of unread records that a source keeps."""
    return max(100, round(KEPT_S * rate_hz))


class TimedWrench(NamedTuple):
    """A usable record."""

    wrench: WrenchArray
    """Force and torque in the sensor axes [N, N m]."""
    missing: int
    """Number of records that were lost or unusable since the previous record."""
    time: float
    """Time of the record [s]; may be late, e.g. by the transmission time."""


class RecordSource(ABC):
    """Source of the records of one sensor, for `StreamedSensor`."""

    unit: str
    """Noun for a record in messages to the user, e.g. line."""
    remedy: str
    """Fix for messages if no records arrive, e.g. check its cable."""
    constant_s = CONSTANT_S
    """Time for which a channel may keep its value [s]."""

    def __init__(self, name: str, *key: object) -> None:
        """Start closed; `name` identifies the sensor in messages and contains its address, and
        `key` identifies its lock."""
        self.name = name
        self.key = key
        self.identity: dict[str, str | None] = {}
        """Properties that the open sensor reports and that affect its zero, by name, e.g.
        `serial`."""
        self.counted: Counter[str] = Counter()
        """Counters since `open`: ``records``, ``lost``, ``late``, ``malformed``, and others."""

    @property
    def trouble(self) -> str | None:
        """Reason why no more records will arrive; None while records may still arrive."""
        return None

    @abstractmethod
    def open(self) -> None:
        """Start receiving, with all counters at 0; raises RigError or DeviceError on failure."""

    def restart(self) -> None:
        """Forget the records so far, because the sensor restarted while it was opened."""
        self.counted.clear()

    @abstractmethod
    def take(self) -> Sequence[TimedWrench]:
        """Return the usable records that have arrived since the last call, oldest first, without
        waiting."""

    def watch(self, rate_hz: float) -> None:  # noqa: B027
        """Watch the delay of the records from now on if `take` cannot correct it; called once their
        rate has been measured."""

    @abstractmethod
    def describe(self) -> str:
        """Describe the records in a few words, for `softfin rig check`."""

    def checks(self) -> Iterator[CheckResult]:
        """Yield additional lines for `softfin rig check`."""
        yield from ()

    @abstractmethod
    def explain_silence(self) -> str:
        """Explain why no usable record has arrived, ending with the fix."""

    @abstractmethod
    def complaints(self) -> Sequence[str]:
        """Return one line per fault, ending with the fix."""

    def notes(self) -> Sequence[str]:
        """Return notes for the operator, one line each."""
        return ()

    @abstractmethod
    def close(self) -> None:
        """Stop receiving; may be called repeatedly and never raises."""


class StreamedSensor:
    """The force sensor of a rig; not thread-safe."""

    def __init__(self, config: StreamedSensorConfig, source: RecordSource, clock: Clock) -> None:
        self.config = config
        self.clock = clock
        self.name = f"force sensor {source.name}"
        self.device_lock = DeviceLock(self.name, *source.key)
        self._source = source
        self._rotation = rotation(config.frame)
        self._offset = np.zeros(6)
        self._is_open = False
        self._reset()

    def _reset(self) -> None:
        self.times = StreamClock(self.config.rate_hz)
        self._filter: AntiAlias | None = None
        if self.config.is_filtered:
            self._filter = AntiAlias(self.config.rate_hz, self.config.cutoff_hz)
        self._place = 0
        """Position of the latest record in the stream, counting lost ones."""
        self._newest: WrenchArray | None = None
        self._received = 0
        self._first_arrival = self._arrival = self.clock()
        """Times at which the first and the latest usable record were processed [s]."""
        self._frozen = FrozenChannels(self._source.constant_s * self.config.rate_hz)
        self._force: tuple[float, Wrench] | None = None
        self._peak = np.zeros(6)
        self._collected: list[WrenchArray] | None = None

    @property
    def identity(self) -> dict[str, str | None]:
        """Properties that the source reports."""
        return self._source.identity

    @property
    def zero_wrench(self) -> Wrench:
        """Wrench that is subtracted from every record, in the sensor axes [N, N m]."""
        fx, fy, fz, tx, ty, tz = self._offset.tolist()
        return fx, fy, fz, tx, ty, tz

    @property
    def delay_s(self) -> float:
        """Total delay of the filter in the sensor and of softfin's filter [s]."""
        own = 0.0 if self._filter is None else self._filter.delay / self.times.rate_hz
        return self.config.filter_delay_s + own

    def open(self) -> None:
        """Open the source, wait for records and measure their rate; raises RigError if the records
        do not match the configuration, and DeviceError if no records arrive."""
        self.close()
        self.device_lock.acquire(self.clock)
        try:
            self._reset()
            self._offset = np.zeros(6)
            self._source.open()
            self._is_open = True
            self._await_records()
            self._source.watch(self.times.rate_hz)
            self.read()
        except BaseException:
            self.close()
            raise

    def read(self) -> ForceReading:
        """Process the records that have arrived and return the latest force, without waiting."""
        self.keep_up()
        self._update_force()
        if self._force is None:
            raise DeviceError(
                f"{self.name}: too few {self._source.unit}s to compute a force; "
                f"{self._source.remedy}"
            )
        # The rotation only permutes axes and flips signs.
        peak = rotated(self._peak, np.abs(self._rotation))
        self._peak = np.zeros(6)
        return ForceReading(*self._force, peak)

    def keep_up(self) -> None:
        """Process the records that have arrived."""
        if not self._is_open:
            raise DeviceError(f"{self.name}: not open; open it first")
        records = self._source.take()
        for record in records:
            self._put(record)
        if records:
            self._arrival = self.clock()
            if not self._received:
                self._first_arrival = self._arrival
            self._received += len(records)
            self.times.stamp(self._place, records[-1].time)

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
        """Subtract a recorded zero, in the sensor axes [N, N m]."""
        self._offset = np.array(wrench)
        self._peak = np.zeros(6)

    def measured(self, seconds: float) -> tuple[Wrench, Wrench]:
        """Wait for `seconds`, then return the mean and standard deviation of the records received
        during this time, in softfin's axes [N, N m]."""
        mean, deviation = self._mean(seconds)
        return rotated(mean, self._rotation), rotated(deviation, np.abs(self._rotation))

    def checks(self) -> Iterator[CheckResult]:
        """Describe the open sensor."""
        text = f"{self._source.describe()}, {self.times.rate_hz:.0f}/s, "
        text += f"delay {self.delay_s * 1e3:.1f} ms"
        yield CheckResult("force sensor", "well", text)
        yield from (CheckResult("force sensor", "note", note) for note in self.notes())
        yield from self._source.checks()

    def complaints(self) -> tuple[str, ...]:
        """Return the faults as of the latest read, one line each, ending with the fix."""
        if not self._is_open:
            return ()
        lines = list(self._source.complaints())
        if names := self._frozen.names():
            lines.append(
                f"values are frozen ({', '.join(names)}); check the sensor and its wiring, and "
                "send enough digits to show its noise"
            )
        silent_s = self.clock() - self._arrival
        if silent_s > SILENT_S:
            unit = self._source.unit
            lines.append(f"no usable {unit} for {silent_s:.1f} s; {self._source.remedy}")
        return tuple(f"{self.name}: {line}" for line in lines)

    def notes(self) -> tuple[str, ...]:
        """Return the notes of the source, and a note if the sensor is slower than the log."""
        notes = list(self._source.notes())
        if self.config.rate_hz < RATE_HZ:
            notes.append(
                f"{self.config.rate_hz:g} {self._source.unit}s per second are fewer than the "
                f"{RATE_HZ} rows; the force in between is interpolated"
            )
        return tuple(f"{self.name}: {note}" for note in notes)

    def counters(self) -> dict[str, int]:
        """Return the counters since `open`."""
        counted = dict.fromkeys(("records", "lost", "late", "malformed"), 0) | self._source.counted
        return {f"sensor_{name}": count for name, count in counted.items()}

    def close(self) -> None:
        """Close the source; may be called repeatedly and never raises."""
        self._is_open = False
        self._source.close()
        self.device_lock.release()

    def _put(self, record: TimedWrench) -> None:
        values = record.wrench
        self._place += 1 + record.missing
        if self._filter is not None:
            if not self._filter.bridges(record.missing):
                # The numbers may have jumped by more than the elapsed time.
                self.times.restart()
            self._filter.put(values, record.missing)
        self._frozen.put(values)
        self._newest = values
        np.maximum(self._peak, np.abs(values - self._offset), out=self._peak)
        if self._collected is not None:
            self._collected.append(values - self._offset)

    def _update_force(self) -> None:
        output = self._newest if self._filter is None else self._filter.output()
        if output is None:
            return
        moment = self.times.estimate_time(self._place) - self.delay_s
        # The measured rate has not settled yet, but reported times must not go backwards.
        latest = moment if self._force is None else max(moment, self._force[0])
        self._force = (latest, rotated(output - self._offset, self._rotation))

    def _mean(self, seconds: float) -> tuple[WrenchArray, WrenchArray]:
        """Return mean and standard deviation of the next records, in the sensor axes."""
        self.keep_up()
        collected = self._collected = []
        try:
            self._wait(lambda: False, max(seconds, 3 / self.config.rate_hz))
        finally:
            self._collected = None
        if not collected:
            raise DeviceError(f"{self.name}: sent nothing for {seconds:g} s; {self._source.remedy}")
        values = np.stack(collected)
        return values.mean(0), values.std(0)

    def _await_records(self) -> None:
        """Wait until the records arrive at the configured rate, without faults."""
        rate_hz = self.config.rate_hz
        shortest_s = max(MEASURED_S, 5 / rate_hz)
        pause_s = max(PAUSE_S, 5 / rate_hz)

        def is_right(measured_hz: float) -> bool:
            return abs(measured_hz / rate_hz - 1) <= 0.1

        def fits() -> bool:
            is_full = self._filter is None or self._filter.full
            is_measured = self.times.measured_s >= shortest_s and is_full
            # The records of a sensor that is too slow cannot be distinguished from those of a
            # sensor that loses many.
            has_rate = is_right(self.times.rate_hz) and is_right(self._arrival_rate_hz())
            return is_measured and has_rate

        def pauses() -> bool:
            return self.clock() - self._arrival > pause_s

        self._await_first()
        self._wait(lambda: fits() or pauses(), 5.0 + shortest_s)
        if pauses():
            # An Arduino restarts, so the records so far were sent before its port was opened.
            self._reset()
            self._source.restart()
            self._await_first()
        is_fit = self._wait(fits, 5.0 + shortest_s)
        if complaints := self.complaints():
            raise DeviceError(complaints[0])
        unit = self._source.unit
        arrival_rate_hz = self._arrival_rate_hz()
        if not is_fit and not is_right(arrival_rate_hz):
            raise RigError(
                f"{self.name}: sends {arrival_rate_hz:.0f} {unit}s per second, but rate_hz is "
                f"{rate_hz:g}; change one of them"
            )
        if not is_fit:
            raise RigError(
                f"{self.name}: {arrival_rate_hz:.0f} {unit}s arrive per second, but according to "
                f"their timestamps or counters, the rate is {self.times.rate_hz:.0f}; check the "
                "speed of its clock, and the connection"
            )

    def _await_first(self) -> None:
        if not self._wait(lambda: self._newest is not None, FIRST_WAIT_S):
            raise DeviceError(f"{self.name}: {self._source.explain_silence()}")

    def _arrival_rate_hz(self) -> float:
        """Return the rate at which usable records have arrived [Hz]."""
        elapsed_s = self._arrival - self._first_arrival
        return (self._received - 1) / elapsed_s if elapsed_s else 0.0

    def _wait(self, done: Callable[[], bool], seconds: float) -> bool:
        end = self.clock() + seconds
        while not done():
            if self.clock() >= end or self._source.trouble is not None:
                return False
            self.clock.sleep(0.002)
            self.keep_up()
        return True
