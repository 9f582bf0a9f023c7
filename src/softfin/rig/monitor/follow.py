"""Follow a growing bag: each byte is read once, only a time window is kept in memory, and damage is
reported in one line.

The file is opened read-only and closed after each poll, so the recorder is not disturbed and the
disk can be unmounted.
"""

import contextlib
import io
import itertools
import os
import time
from collections.abc import Callable
from pathlib import Path

from mcap.records import Channel, Footer, Message, Schema

from softfin.core.errors import ArtifactError, LogError
from softfin.core.printable import printable
from softfin.rig.monitor.summary import MAX_CHARACTERS, ROLES, Summary, Trace, summarize
from softfin.storage.bag.recovery import MAGIC, RawRecord, decode_bag_record, read_records
from softfin.storage.formats import check_file_format
from softfin.storage.paths import check_monitored

READ_BYTES = 4 * 2**20
"""Maximum number of bytes read per poll, so that reading an old recording shows progress."""

SILENT_RECORDING_S = 3.0
"""Time without a new row after which a recording counts as silent [s]; a recorder writes twice per
second."""

PATTERNS = ("*.mcap", "*/*.mcap", "*/*/*.mcap")
"""Patterns for a folder of bags, of bag folders, or of runs containing them; no deeper, so that the
monitor does not search entire disks."""


class Follower:
    """The latest rows of a recording; call `poll` a few times per second."""

    def __init__(
        self,
        path: Path,
        *,
        window_s: float = 22.0,
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], float] = time.time,
    ) -> None:
        """Follow a bag, or the latest one in a folder; raises LogError if `path` is neither.

        The last `window_s` seconds of each topic are kept.
        """
        check_monitored(path)
        self.path = path
        self.follows_folder = path.is_dir()
        """Whether to look for newer bags."""
        self._window = window_s
        self._clock = clock
        self._wall = wall
        self._serials = itertools.count(1)
        self._number = 0
        self._chosen_at = -float("inf")
        self._bag: Path | None = None if self.follows_folder else path
        self._restart()

    def _restart(self) -> None:
        """Reset to the state before the first read."""
        self._number += 1
        self.traces = {role: Trace(role) for role in ROLES}
        self._types: dict[int, str] = {}
        self._channels: dict[int, tuple[Trace, str]] = {}
        self._offset = self._size = self._damaged = self._start_ns = 0
        self._identity: tuple[int, int] | None = None
        self._problem: str | None = None
        self._ended = self._broken = self._caught_up = False
        self._grown_at: float | None = None
        """Time of the latest rows that were not present at the first read [s]."""

    def poll(self) -> None:
        """Read what has been written since the last call."""
        if self.follows_folder and self._clock() - self._chosen_at >= 1.0:
            self._chosen_at = self._clock()
            self._choose()
        if self._bag is None or self._ended or self._broken:
            return
        self._problem = None
        try:
            with self._bag.open("rb") as file:
                self._read(file)
        except OSError as error:
            self._problem = (
                f"{self._shown()}: cannot be read ({error.strerror or error}); trying again"
            )
        except (LogError, ArtifactError) as error:
            self._problem = f"{self._shown()}: {error}"
            self._broken = True

    def summary(self) -> Summary:
        """Summarize the recording as of the last poll."""
        times = [rows[-1].time for role in ("joint", "wrench") if (rows := self.traces[role].rows)]
        time_s = max(times, default=None)
        # Recordings in simulated time may be ahead of the wall clock.
        age = None if time_s is None else max(0.0, self._wall() - (self._start_ns * 1e-9 + time_s))
        return summarize(
            self.traces,
            path=self._shown(),
            number=self._number,
            state=self._state(age),
            problem=self._problem,
            size_bytes=self._size,
            damaged=self._damaged,
            age_s=age,
            time_s=time_s,
        )

    def _choose(self) -> None:
        """Switch to the most recently written bag in the folder, if it is clearly newer than the
        current one."""
        times: dict[Path, float] = {}
        for path in itertools.chain.from_iterable(map(self.path.glob, PATTERNS)):
            # A file may be renamed or removed in the meantime.
            with contextlib.suppress(OSError):
                if path.is_file() and not path.name.startswith("."):
                    times[path] = path.stat().st_mtime
        if not times:
            return
        newest = max(times, key=lambda path: (times[path], path.name))
        # To avoid alternating between simultaneous recordings, the other one must have been written
        # 1 s later.
        if newest != self._bag and (
            self._bag is None or times[newest] > times.get(self._bag, -float("inf")) + 1.0
        ):
            self._bag = newest
            self._restart()

    def _read(self, file: io.BufferedIOBase) -> None:
        self._check_identity(os.fstat(file.fileno()))
        if self._offset == 0 and not self._read_magic(file):
            return
        was_caught_up = self._caught_up
        before = self._count()
        end = self._offset + READ_BYTES
        try:
            for record in read_records(file, self._offset, self._size):
                self._offset = record.end
                self._take(record)
                if self._ended or self._offset >= end:
                    break
            else:
                self._caught_up = True
        except LogError as error:
            raise LogError(
                f"damaged ({error}); to save the intact part, use softfin bag recover"
            ) from None
        finally:
            self._settle()
            if was_caught_up and self._count() > before:
                self._grown_at = self._clock()

    def _check_identity(self, status: os.stat_result) -> None:
        """Start again if this is another file than at the last poll, or a shorter one."""
        identity = (status.st_dev, status.st_ino)
        is_other = self._identity is not None and identity != self._identity
        is_shorter = self._identity is not None and status.st_size < self._offset
        if is_other or is_shorter:
            # Another file with the same name, e.g. after a copy or repair.
            self._restart()
        self._identity = identity
        self._size = status.st_size

    def _read_magic(self, file: io.BufferedIOBase) -> bool:
        """Read the magic bytes; return False if the file does not contain all of them yet."""
        magic = file.read(len(MAGIC))
        # A file that has just been created may still be shorter than the magic bytes.
        if not MAGIC.startswith(magic):
            raise LogError("not an MCAP file; use a bag that softfin or ros2 bag recorded as MCAP")
        if magic != MAGIC:
            self._caught_up = True
            return False
        self._offset = len(MAGIC)
        return True

    def _settle(self) -> None:
        """Decode the rows within the window."""
        # Use the joint's time if there is one, so that wrong timestamps in another topic do not
        # empty all traces.
        lasts = (trace.last for trace in (self.traces["joint"], *self.traces.values()))
        newest = next((last for last in lasts if last is not None), 0.0)
        for role, trace in self.traces.items():
            since = -float("inf") if role == "event" else newest - self._window
            trace.settle(since, self._serials)
        self.traces["wrench"].zeros = self.traces["event"].recorded_zeros()

    def _count(self) -> int:
        return sum(trace.count for trace in self.traces.values())

    def _take(self, raw: RawRecord) -> None:
        """Process a record; damaged ones are counted and skipped."""
        try:
            records = decode_bag_record(raw)
        except LogError:
            self._damaged += 1
            return
        roles = {topic: role for role, topic in ROLES.items()}
        for record in records:
            if isinstance(record, Message):
                if record.channel_id in self._channels:
                    trace, type_name = self._channels[record.channel_id]
                    self._start_ns = self._start_ns or record.log_time
                    trace.offer((record.log_time - self._start_ns) / 1e9, type_name, record.data)
            elif isinstance(record, Schema):
                self._types[record.id] = record.name
            elif isinstance(record, Channel):
                check_file_format("recording", record.metadata, "recording", ArtifactError)
                if record.topic in roles:
                    type_name = (
                        self._types.get(record.schema_id, "")
                        if record.message_encoding == "cdr"
                        else ""
                    )
                    self._channels[record.id] = (self.traces[roles[record.topic]], type_name)
            elif isinstance(record, Footer):
                self._ended = True

    def _state(self, age: float | None) -> str:
        if self._broken:
            return "damaged"
        if self._ended:
            return "ended"
        if not self._caught_up and self._size:
            return "reading"
        if age is None:
            return "waiting"
        # The clocks of this computer and the recorder may differ, so once growth has been observed,
        # use its time.
        quiet = age if self._grown_at is None else self._clock() - self._grown_at
        return "recording" if abs(quiet) < SILENT_RECORDING_S else "silent"

    def _shown(self) -> str:
        return printable(str(self._bag or self.path), most=MAX_CHARACTERS)
