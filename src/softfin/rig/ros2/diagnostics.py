"""State of a fin node as diagnostic_msgs/DiagnosticArray: the fin, the loop, the sensor and the
estimator, over the last second."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from softfin.control.feedback import UNFAMILIAR, Estimate
from softfin.rig.machine import Sample
from softfin.rig.session import SessionState
from softfin.storage.bag.messages import SECOND_NS, serialized

DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

OK = 0
WARNING = 1
ERROR = 2
"""Levels of diagnostic_msgs/DiagnosticStatus."""

PERIOD_S = 1.0
"""Time between two messages [s]."""

GAP_WARNING_S = 0.03
"""Time between two ticks above which the loop is reported as late [s]: two ticks are missing."""

AGE_WARNING_S = 0.1
"""Age above which a reading is reported as old [s]; by default, the fin stops at 0.15 s for a
force."""


class Status(NamedTuple):
    """One entry of the message."""

    name: str
    level: int
    message: str
    values: Mapping[str, object]
    """Values by name, with the unit at the end of the name."""


class FinDiagnostics:
    """Collects the samples of one second."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.state: SessionState = "inactive"
        """State of the fin; it is stopped until somebody resets it."""
        self.reason = ""
        """Reason of the stop; empty if the fin is not stopped."""
        self.estimate: Estimate | None = None
        """Latest estimate of the feedback; None without feedback."""
        self._since = clock()
        self._ticked = self._since
        self._ticks = 0
        self._gap_s = 0.0
        self._joint_age_s = 0.0
        self._force_age_s = 0.0
        self._sample: Sample | None = None

    def add(self, sample: Sample) -> None:
        """Add the sample of one tick."""
        now = self._clock()
        if self._sample is not None:
            self._gap_s = max(self._gap_s, now - self._ticked)
        self._ticked = now
        self._ticks += 1
        self._sample = sample
        self._joint_age_s = max(self._joint_age_s, now - sample.time)
        self._force_age_s = max(self._force_age_s, now - sample.force_time)

    def is_due(self) -> bool:
        """Return whether the last message is one second old."""
        return self._clock() - self._since >= PERIOD_S

    def take(self) -> list[Status]:
        """Return the statuses of the time since the last call, and start a new second."""
        now = self._clock()
        statuses = [self._fin()]
        if self._sample is not None:
            statuses += [self._loop(now - self._since), self._sensor(), self._estimator()]
        self._since = now
        self._ticks = 0
        self._gap_s = 0.0
        self._joint_age_s = 0.0
        self._force_age_s = 0.0
        self._sample = None
        return statuses

    def _fin(self) -> Status:
        values: dict[str, object] = {"state": self.state}
        if self._sample is not None:
            for name, value in (
                ("angle_rad", self._sample.angle),
                ("velocity_rad_s", self._sample.velocity),
                ("current_a", self._sample.current),
                ("voltage_v", self._sample.voltage),
            ):
                if value is not None:
                    values[name] = round(value, 4)
        return Status("fin", ERROR if self.reason else OK, self.reason or self.state, values)

    def _loop(self, seconds: float) -> Status:
        is_late = self._gap_s > GAP_WARNING_S
        values = {
            "rate_hz": round(self._ticks / seconds, 1) if seconds > 0 else math.nan,
            "longest_tick_ms": round(self._gap_s * 1e3, 1),
        }
        message = "late: the computer is too busy" if is_late else "on time"
        return Status("loop", WARNING if is_late else OK, message, values)

    def _sensor(self) -> Status:
        assert self._sample is not None
        values = {
            "force_age_ms": round(self._force_age_s * 1e3, 1),
            "joint_age_ms": round(self._joint_age_s * 1e3, 1),
        }
        if complaints := self._sample.complaints:
            return Status("sensor", ERROR, complaints[0], values)
        is_old = max(self._force_age_s, self._joint_age_s) > AGE_WARNING_S
        message = "old readings" if is_old else "new readings"
        return Status("sensor", WARNING if is_old else OK, message, values)

    def _estimator(self) -> Status:
        if self.estimate is None:
            return Status("estimator", OK, "off", {})
        level = float(self.estimate.level)
        values = {"level": round(level, 2)}
        for name, pair in (
            ("force", self.estimate.force),
            ("half_width", self.estimate.half_width),
            ("drift", self.estimate.drift),
        ):
            for axis, value in zip("xy", pair, strict=True):
                values[f"{name}_{axis}_n"] = round(float(value), 4)
        is_outside = level > UNFAMILIAR
        message = "the fin is outside the family" if is_outside else "estimating"
        return Status("estimator", WARNING if is_outside else OK, message, values)


def encode_diagnostics(stamp_ns: int, source: str, statuses: Sequence[Status]) -> bytes:
    """Return the message; `source` is the name of the fin, which precedes each name."""
    seconds, nanoseconds = divmod(stamp_ns, SECOND_NS)
    fields: dict[str, object] = {
        "header.stamp.sec": seconds,
        "header.stamp.nanosec": nanoseconds,
    }
    for index, status in enumerate(statuses):
        path = f"status.{index}"
        fields |= {
            f"{path}.level": status.level,
            f"{path}.name": f"{source}: {status.name}",
            f"{path}.message": status.message,
            f"{path}.hardware_id": source,
        }
        for number, (key, value) in enumerate(status.values.items()):
            fields[f"{path}.values.{number}.key"] = key
            fields[f"{path}.values.{number}.value"] = str(value)
    return serialized(DIAGNOSTICS, fields)
