"""Follows a growing bag. Each byte is read once, only the latest messages of each topic are kept,
and damage is reported in one line.

The file is opened read-only and closed after each poll, so the recorder is not disturbed.
"""

import contextlib
import io
import itertools
import math
import os
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from mcap.records import Channel, Footer, Message

from softfin.core.errors import ArtifactError, InputError, LogError
from softfin.core.json_object import JsonObject
from softfin.core.printable import printable
from softfin.core.quantities import TICK_S
from softfin.storage.bag import messages
from softfin.storage.bag.messages import JOINT_STATE, TYPES, WRENCH_STAMPED, type_store
from softfin.storage.bag.recovery import MAGIC, BagRecord, decode_bag_record, read_records
from softfin.storage.bag.zero import parse_zero, zeros_at
from softfin.storage.formats import check_file_format
from softfin.storage.paths import check_monitored

READ_BYTES = 4 * 2**20
"""Maximum number of bytes read per poll, so that progress is visible while an old recording is
read."""

KEPT_ROWS = 2500
"""Number of messages kept per topic: 25 s at 100 Hz."""

SHOWN_EVENTS = 8
MAX_CHARACTERS = 300
"""Maximum number of displayed characters of an event or a path."""

SILENT_RECORDING_S = 3.0
"""Time without a new row after which a recording is treated as silent [s]; a recorder writes twice
per second."""

PATTERNS = ("*.mcap", "*/*.mcap", "*/*/*.mcap")
"""Patterns for a folder of bags, of bag folders, or of runs that contain bag folders; not deeper,
so that the monitor does not search entire disks."""

ROLES = {
    "joint": messages.JOINT,
    "wrench": messages.WRENCH,
    "command": messages.COMMAND,
    "reference": messages.REFERENCE,
    "estimate": messages.ESTIMATE,
    "half_width": messages.HALF_WIDTH,
    "level": messages.LEVEL,
    "current": messages.CURRENT,
    "event": messages.EVENTS,
}
"""Topic of each role on the page."""

Row: TypeAlias = tuple[Any, ...]
"""Time since the first message of the recording [s], and the values of a message."""


class Trace:
    """The latest messages of one topic, which are decoded only when displayed."""

    def __init__(self, topic: str) -> None:
        self._type = TYPES[topic]
        self.count = 0
        self.missing = 0
        """Number of rows missing at 100 Hz."""
        self.time_s = 0.0
        """Time from the first message of the recording to the latest message [s]."""
        self._kept: deque[tuple[int, float, bytes]] = deque(maxlen=KEPT_ROWS)

    def add(self, serial: int, time_s: float, data: bytes) -> None:
        """Keep a message; serial numbers count the messages of all topics."""
        if self.count:
            self.missing += max(round((time_s - self.time_s) / TICK_S) - 1, 0)
        self.count += 1
        self.time_s = time_s
        self._kept.append((serial, time_s, data))

    def rows(self, since: int) -> list[Row]:
        """Return the readable messages after a serial number. Each row contains the time, followed
        by angle and velocity, force (x, y) and torque about the shaft, a single number, or a
        text."""
        rows = []
        for serial, time_s, data in self._kept:
            # The generated decoder may raise any exception for damaged bytes.
            with contextlib.suppress(Exception):
                if serial > since:
                    rows.append((time_s, *self._values(data)))
        return rows

    def _values(self, data: bytes) -> Row:
        message: Any = type_store().deserialize_cdr(data, self._type)
        if self._type == JOINT_STATE:
            return float(message.position[0]), float(message.velocity[0])
        if self._type == WRENCH_STAMPED:
            wrench = message.wrench
            return wrench.force.x, wrench.force.y, wrench.torque.z
        value = message.data
        return (printable(value, most=MAX_CHARACTERS) if isinstance(value, str) else value,)


class Follower:
    """The latest messages of a recording; call `poll` a few times per second."""

    def __init__(self, path: Path) -> None:
        """Follow a bag, or the latest one in a folder; raises LogError if `path` is neither."""
        check_monitored(path)
        self._path = path
        self._bag = path
        self._number = 0
        self._looked_at = -float("inf")
        self.serial = 0
        """Serial number of the latest message."""
        self._restart()

    def _restart(self) -> None:
        """Reset to the state before the first read."""
        self._number += 1
        self.traces = {role: Trace(topic) for role, topic in ROLES.items()}
        self._channels: dict[int, Trace] = {}
        self._offset = self._damaged = self._start_ns = 0
        self._problem: str | None = None
        self._ended = self._broken = False
        self._grown_at = -float("inf")
        """Time of the latest new messages [s]."""

    def poll(self) -> None:
        """Read the data written since the last call."""
        try:
            self._choose()
            if not (self._ended or self._broken or self._bag.is_dir()):
                self._problem = None
                with self._bag.open("rb") as file:
                    self._read(file)
        except OSError as error:
            self._problem = f"cannot be read ({error.strerror or error}); trying again"
        except InputError as error:
            self._problem = str(error)
            self._broken = True

    def summary(self) -> JsonObject:
        """Describe the recording as of the last poll."""
        joint = self.traces["joint"]
        wrench = self.traces["wrench"]
        time_s = max(joint.time_s, wrench.time_s)
        return {
            "path": printable(str(self._bag), most=MAX_CHARACTERS),
            "number": self._number,
            "state": self._state(),
            "problem": self._problem,
            "time_s": time_s if self._start_ns else None,
            "wall_s": self._start_ns * 1e-9 + time_s,
            "rows": joint.count,
            "missing": joint.missing,
            "force_missing": wrench.missing,
            "damaged": self._damaged,
            "events": self.traces["event"].rows(0)[-SHOWN_EVENTS:],
        }

    def rows(self, since: int) -> dict[str, list[list[float | None]]]:
        """Return the time and values of the messages after a serial number by role. Forces are
        relative to the recorded zero; invalid numbers become None."""
        parsed = [(time_s, parse_zero(text)) for time_s, text in self.traces["event"].rows(0)]
        zeros = [(time_s, zero) for time_s, zero in parsed if zero is not None]
        result = {}
        for role in set(ROLES) - {"event"}:
            values: np.ndarray = np.array(self.traces[role].rows(since))
            if role == "wrench" and len(values):
                values[:, 1:3] -= zeros_at(zeros, values[:, 0])
            result[role] = [_finite(row) for row in values.tolist()]
        return result

    def _choose(self) -> None:
        """In a folder, switch to the most recently written bag unless the current bag is
        growing."""
        now = time.monotonic()
        if not self._path.is_dir() or now - self._looked_at < 1.0 or self._state() == "recording":
            return
        self._looked_at = now
        bags = itertools.chain.from_iterable(map(self._path.glob, PATTERNS))
        newest = max(bags, key=lambda path: path.stat().st_mtime, default=self._bag)
        if newest != self._bag:
            self._bag = newest
            self._restart()

    def _read(self, file: io.BufferedIOBase) -> None:
        size = os.fstat(file.fileno()).st_size
        if size < self._offset:
            # The file was replaced by one with the same name, e.g. after a repair.
            self._restart()
        if self._offset == 0:
            magic = file.read(len(MAGIC))
            # A file that has just been created may still be shorter than the magic bytes.
            if not MAGIC.startswith(magic):
                raise LogError(
                    "not an MCAP file; use a bag that softfin or ros2 bag recorded as MCAP"
                )
            if magic != MAGIC:
                return
            self._offset = len(MAGIC)
        end = self._offset + READ_BYTES
        for raw in read_records(file, self._offset, size):
            self._offset = raw.end
            try:
                for record in decode_bag_record(raw):
                    self._take(record)
            except LogError:
                self._damaged += 1
            if self._offset >= end:
                return

    def _take(self, record: BagRecord) -> None:
        if isinstance(record, Message):
            trace = self._channels.get(record.channel_id)
            if trace is not None:
                self._start_ns = self._start_ns or record.log_time
                self.serial += 1
                trace.add(self.serial, (record.log_time - self._start_ns) / 1e9, record.data)
                self._grown_at = time.monotonic()
        elif isinstance(record, Channel):
            check_file_format("recording", record.metadata, "recording", ArtifactError)
            for role, topic in ROLES.items():
                if record.topic == topic:
                    self._channels[record.id] = self.traces[role]
        elif isinstance(record, Footer):
            self._ended = True

    def _state(self) -> str:
        if self._broken:
            return "damaged"
        if self._ended:
            return "ended"
        if self._start_ns == 0:
            return "waiting"
        is_growing = time.monotonic() - self._grown_at < SILENT_RECORDING_S
        return "recording" if is_growing else "silent"


def _finite(row: Sequence[float]) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in row]
