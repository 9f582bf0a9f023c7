"""A bag that grows in, its last seconds out: each byte is read once, memory holds a window, damage is one line.

It opens the file to read and for no longer than one look, so it disturbs no recorder and holds up no unmounting.
"""

import io
import itertools
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from mcap.records import Channel, Footer, Message, Schema

from softfin.core.errors import LogError
from softfin.core.printable import printable
from softfin.rig.monitor import choice
from softfin.rig.monitor.messages import MOST_CHARACTERS, TOPICS, TYPES, decoded
from softfin.rig.monitor.summary import State, Summary, readings
from softfin.rig.monitor.trace import Trace
from softfin.storage.bag.records import MAGIC, RawRecord, Record, decode, read_records
from softfin.storage.paths import check_monitored

READ_BYTES = 16 * 2**20
"""At one look, packed or unpacked: whoever waits for an old recording sees it come in."""

RECORD_COST = 100
"""Bytes that take as long to read as a record takes besides its own."""

SILENT_S = 3.0
"""Without a new row [s]: a recorder writes twice a second."""

CHOOSE_S = 1.0
"""Between two looks for a newer bag [s]."""


class Follower:
    """The newest of a recording; call `poll` a few times a second."""

    def __init__(
        self,
        path: Path,
        *,
        window_s: float = 22.0,
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], float] = time.time,
    ) -> None:
        """A bag, or a folder that bags are written to; raises LogError where there is neither.

        `window_s` is what is held of each topic.
        """
        check_monitored(path)
        self.path = path
        self.window_s = window_s
        self._clock, self._wall = clock, wall
        self._serials = itertools.count(1)
        self._number = 0
        self._chosen_at = -float("inf")
        self._bag: Path | None = None
        self._choose()
        self._begin()

    def _begin(self) -> None:
        """With nothing read yet."""
        self._number += 1
        self.traces = {role: Trace(role) for role in TYPES}
        self._kinds: dict[int, str] = {}
        self._channels: dict[int, tuple[Trace, str]] = {}
        self._offset = self._size = self._damaged = self._taken = 0
        self._waiting: Iterator[Record] = iter(())
        """Decoded records of a chunk that are still to be taken in."""
        self._start_ns = 0
        self._identity: tuple[int, int] | None = None
        self._problem: str | None = None
        self._ended = self._broken = self._caught_up = False
        self._grown_at: float | None = None
        """When rows came that were not there at the first look."""

    @property
    def follows_folder(self) -> bool:
        """A newer bag may come when this one has ended."""
        return self.path.is_dir()

    def poll(self) -> None:
        """Take in what was written since."""
        if self._choose():
            self._begin()
        if self._bag is None or self._ended or self._broken:
            return
        try:
            if not self._bag.is_file():
                raise FileNotFoundError(0, "not there any more")
            self._problem = None
            self._read(self._bag)
        except OSError as error:
            self._problem = f"{self._shown()}: cannot be read ({error.strerror or error}); looking again"

    def summary(self) -> Summary:
        """The recording as of the last look."""
        told = readings(self.traces)
        logged = None if told["time_s"] is None else self._start_ns * 1e-9 + told["time_s"]
        # What is recorded in simulated time runs ahead of the day.
        age = None if logged is None else max(0.0, self._wall() - logged)
        return Summary(
            path=self._shown(),
            number=self._number,
            state=self._state(age),
            problem=self._problem,
            size_bytes=self._size,
            damaged=self._damaged,
            age_s=age,
            **told,
        )

    def _choose(self) -> bool:
        """Whether there is another bag to follow."""
        before, now = self._bag, self._clock()
        if not self.path.is_dir():
            self._bag = self._bag or self.path
        elif now - self._chosen_at >= CHOOSE_S:
            self._chosen_at = now
            self._bag = choice.newest(self.path, self._bag)
        return before != self._bag

    def _read(self, bag: Path) -> None:
        with bag.open("rb") as file:
            status = os.fstat(file.fileno())
            identity = (status.st_dev, status.st_ino)
            if self._identity is not None and (identity != self._identity or status.st_size < self._offset):
                # Another file by the same name, as a copy or a repair leaves it.
                self._begin()
            self._identity, self._size = identity, status.st_size
            try:
                self._take_in(file)
            except LogError as error:
                self._broken = True
                self._problem = f"{self._shown()}: {error}"

    def _take_in(self, file: io.BufferedIOBase) -> None:
        if self._offset == 0:
            magic = file.read(len(MAGIC))
            if not MAGIC.startswith(magic):
                raise LogError("no MCAP file; give a bag that softfin or ros2 bag has recorded as MCAP")
            if len(magic) < len(MAGIC):
                self._caught_up = True
                return
            self._offset = len(magic)
        known, before, self._taken = self._caught_up, self._counted(), 0
        try:
            if not self._take_waiting():
                return
            for record in read_records(file, self._offset, self._size):
                self._offset = record.end
                self._decode(record)
                if not self._take_waiting() or self._ended or self._taken >= READ_BYTES:
                    return
            self._caught_up = True
        except LogError as error:
            raise LogError(f"damaged ({error}); softfin bag recover saves what is whole") from None
        finally:
            # Of the joint where there is one: no other topic's wrong stamps empty all traces.
            lasts = [trace.last for trace in self.traces.values() if trace.last is not None]
            newest = max(lasts, default=0.0) if self.traces["joint"].last is None else self.traces["joint"].last
            for trace in self.traces.values():
                since = -float("inf") if trace.role == "event" else newest - self.window_s
                trace.settle(since, decoded, self._serials)
            if known and self._counted() > before:
                self._grown_at = self._clock()

    def _counted(self) -> int:
        return sum(trace.count for trace in self.traces.values())

    def _take_waiting(self) -> bool:
        """Whether all of the chunk was taken in at this look."""
        for record in self._waiting:
            self._take(record)
            self._taken += RECORD_COST
            if self._taken >= READ_BYTES:
                return False
        return True

    def _decode(self, record: RawRecord) -> None:
        """Decode a record; one that is damaged is counted and passed over."""
        self._taken += RECORD_COST + len(record.content)
        try:
            self._waiting = iter(decode(record))
        except LogError:
            self._damaged += 1

    def _take(self, record: Record) -> None:
        if isinstance(record, Message):
            if record.channel_id in self._channels:
                trace, kind = self._channels[record.channel_id]
                self._start_ns = self._start_ns or record.log_time
                trace.offer((record.log_time - self._start_ns) * 1e-9, kind, record.data)
        elif isinstance(record, Schema):
            if any(record.name in kinds for kinds in TYPES.values()):
                self._kinds[record.id] = record.name
        elif isinstance(record, Channel):
            if record.topic in TOPICS:
                kind = self._kinds.get(record.schema_id, "") if record.message_encoding == "cdr" else ""
                self._channels[record.id] = (self.traces[TOPICS[record.topic]], kind)
        elif isinstance(record, Footer):
            self._ended = True

    def _state(self, age: float | None) -> State:
        if self._broken:
            return "damaged"
        if self._ended:
            return "ended"
        if not self._caught_up and self._size:
            return "reading"
        if age is None:
            return "waiting"
        # Another computer's clock may differ from that of the recorder: what grows counts, once it was seen to.
        quiet = age if self._grown_at is None else self._clock() - self._grown_at
        return "recording" if abs(quiet) < SILENT_S else "silent"

    def _shown(self) -> str:
        return printable(str(self._bag or self.path), most=MOST_CHARACTERS)
