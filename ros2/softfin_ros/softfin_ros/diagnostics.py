"""State of a fin node as diagnostic_msgs/DiagnosticArray: the fin, the loop, the sensor and the
estimator, over the last second."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

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
"""Time between two ticks above which the loop is late [s]: two ticks are missing."""

AGE_WARNING_S = 0.1
"""Age above which a reading is old [s]; by default, the fin stops at 0.15 s for a force."""


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
        self.state: SessionState = "unconfigured"
        """State of the fin; it is stopped until somebody resets it."""
        self.reason = ""
        """Reason of the stop; empty if the fin is not stopped."""
        self.estimate: Estimate | None = None
        """Latest estimate of the feedback; None without feedback."""
        self._since = clock()
        self._times: list[tuple[float, float, float]] = []
        """Times of the ticks, of their angles and of their forces [s]."""
        self._sample: Sample | None = None

    def add(self, sample: Sample) -> None:
        """Add the sample of one tick."""
        self._times.append((self._clock(), sample.time, sample.force_time))
        self._sample = sample

    def is_due(self) -> bool:
        """Return whether the last message is one second old."""
        return self._clock() - self._since >= PERIOD_S

    def take(self) -> list[Status]:
        """Return the statuses of the time since the last call."""
        level = ERROR if self.reason else OK
        statuses = [Status("fin", level, self.reason or self.state, {"state": self.state})]
        if self._sample is not None:
            now, joint, force = np.array(self._times).T
            statuses += [
                _loop(now),
                _sensor(float((now - joint).max()), float((now - force).max()), self._sample),
                _estimator(self.estimate),
            ]
        self._since = self._clock()
        # The next second starts at the last tick, so that no gap is missed.
        del self._times[: None if self._sample is None else -1]
        self._sample = None
        return statuses


def _loop(times: np.ndarray) -> Status:
    gaps_s = np.diff(times)
    gap_s = float(gaps_s.max(initial=0.0))
    values = {"ticks": len(gaps_s), "longest_tick_ms": round(gap_s * 1e3, 1)}
    if gap_s > GAP_WARNING_S:
        return Status("loop", WARNING, "late: the computer is too busy", values)
    return Status("loop", OK, "on time", values)


def _sensor(joint_s: float, force_s: float, sample: Sample) -> Status:
    values = {"joint_age_ms": round(joint_s * 1e3, 1), "force_age_ms": round(force_s * 1e3, 1)}
    if sample.complaints:
        return Status("sensor", ERROR, sample.complaints[0], values)
    if max(joint_s, force_s) > AGE_WARNING_S:
        return Status("sensor", WARNING, "old readings", values)
    return Status("sensor", OK, "new readings", values)


def _estimator(estimate: Estimate | None) -> Status:
    if estimate is None:
        return Status("estimator", OK, "off", {})
    # The fields of the estimate with units are forces in newtons.
    values = {
        f"{name}_n": np.round(value, 4).tolist()
        for name, value in estimate._asdict().items()
        if name != "level"
    }
    values["level"] = round(float(estimate.level), 2)
    if estimate.level > UNFAMILIAR:
        return Status("estimator", WARNING, "the fin is outside the family", values)
    return Status("estimator", OK, "estimating", values)


def encode_diagnostics(stamp_ns: int, source: str, statuses: Sequence[Status]) -> bytes:
    """Return the message; `source` is the name of the fin, which precedes each name."""
    seconds, rest = divmod(stamp_ns, SECOND_NS)
    fields: dict[str, object] = {"header.stamp.sec": seconds, "header.stamp.nanosec": rest}
    for index, status in enumerate(statuses):
        path = f"status.{index}"
        fields[f"{path}.level"] = status.level
        fields[f"{path}.name"] = f"{source}: {status.name}"
        fields[f"{path}.message"] = status.message
        fields[f"{path}.hardware_id"] = source
        for number, (key, value) in enumerate(status.values.items()):
            fields[f"{path}.values.{number}.key"] = key
            fields[f"{path}.values.{number}.value"] = str(value)
    return serialized(DIAGNOSTICS, fields)
