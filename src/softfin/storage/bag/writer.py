"""Live recording as a ROS 2 bag in MCAP format. The control loop queues rows without waiting, and a
thread writes them.

Every `flush_s` seconds, new rows are closed as a chunk, written and synchronised to disk, so a
crash or a power cut loses only later rows. At any time, the file is the start of a valid bag, which
`softfin bag recover` can complete.
"""

import contextlib
import io
import os
import queue
import shutil
from collections.abc import Sequence
from pathlib import Path

from softfin.core.clock import REAL, Clock
from softfin.core.errors import LogError, RunError, one_line
from softfin.storage import artifact as artifacts
from softfin.storage.bag.messages import (
    COMMAND,
    CURRENT,
    ESTIMATE,
    EVENTS,
    HALF_WIDTH,
    JOINT,
    LEVEL,
    REFERENCE,
    SECOND_NS,
    VOLTAGE,
    WRENCH,
    BagWriter,
)

POLL_S = 0.05
"""Period at which the queue is emptied [s]. There are few rows at a time, so the loop is delayed by
at most a few tenths of a millisecond."""

STALL_S = 5.0
"""Time without a flush, while rows arrive, after which the recording is treated as failed [s]."""

BACKLOG = 50_000
"""Maximum number of rows that wait for a slow disk: two minutes at 400 rows per second, about 20
MB."""

CLOSE_S = 10.0
"""Maximum time that `close` waits for the thread [s]."""


class BagRecorder:
    """A bag that grows while the fin moves. A thread adds rows with times from `clock`.

    Time stamps are times from `clock` plus the initial offset of the wall clock, so that jumps of
    the wall clock have no effect.
    """

    def __init__(
        self,
        path: Path,
        *,
        flush_s: float = 0.5,
        reserve_bytes: int = 50_000_000,
        clock: Clock = REAL,
    ) -> None:
        """Create the file and its folder; raises LogError if the file exists, and RunError if it
        cannot be written."""
        self.path = path
        self._flush_s = flush_s
        self._reserve = reserve_bytes
        self._clock = clock
        self._offset_ns = round((clock.wall() - clock()) * SECOND_NS)
        self._queue: queue.SimpleQueue[tuple[str, float, Sequence[float] | str]] = (
            queue.SimpleQueue()
        )
        self.failure: str | None = None
        """Reason why the recording is incomplete, with a fix, in one line; None if there is no
        failure."""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # The buffer of 50 MB can hold the rows of 25 minutes while the disk is full.
            self._file = io.BufferedWriter(io.FileIO(path, "xb"), 50_000_000)
        except FileExistsError:
            raise LogError(
                f"{path}: already exists, and recordings are never overwritten; choose a different "
                "name"
            ) from None
        except OSError as error:
            raise RunError(
                f"{path}: cannot be written ({error.strerror or error}); record elsewhere"
            ) from None
        artifacts.sync(path.parent)
        self._bag = BagWriter(self._file, [VOLTAGE])
        self._flushed = clock()
        self._commanded = -float("inf")
        self._closing = clock.event()
        # Flush now so that the file is a valid bag before the first row arrives, and a full disk is
        # detected before anything moves.
        self._flush()
        if self.failure is not None:
            with contextlib.suppress(OSError):
                self._file.close()
            path.unlink()
            raise RunError(self.failure)
        self._thread = clock.spawn(self._work, "bag recorder")

    def command(self, time: float, angle: float, velocity: float) -> None:
        """Record a command [rad, rad/s]."""
        # In simulated time, two commands may have the same time, but their order must be kept.
        self._commanded = max(time, self._commanded + 1e-6)
        self._hand_in(COMMAND, self._commanded, (angle, velocity))

    def joint(
        self,
        time: float,
        angle: float,
        velocity: float,
        current: float | None,
        voltage: float | None = None,
    ) -> None:
        """Record the angle and velocity of the shaft [rad, rad/s], and the motor current [A] and
        supply voltage [V] if measured."""
        self._hand_in(JOINT, time, (angle, velocity))
        if current is not None:
            self._hand_in(CURRENT, time, (current,))
        if voltage is not None:
            self._hand_in(VOLTAGE, time, (voltage,))

    def wrench(self, time: float, wrench: Sequence[float]) -> None:
        """Record the force [N] and torque [N m] of the fin on its mount, (x, y, z) each."""
        self._hand_in(WRENCH, time, tuple(wrench))

    def reference(self, time: float, force: Sequence[float]) -> None:
        """Record the reference force (x, y) [N]."""
        self._hand_in(REFERENCE, time, (*force, 0.0, 0.0, 0.0, 0.0))

    def estimate(
        self, time: float, force: Sequence[float], half_width: Sequence[float], level: float
    ) -> None:
        """Record the true mean force that feedback estimates and the half-width of its 90% interval
        (x, y) [N], and how badly the family explains the measurements [-]."""
        self._hand_in(ESTIMATE, time, (*force, 0.0, 0.0, 0.0, 0.0))
        self._hand_in(HALF_WIDTH, time, (*half_width, 0.0, 0.0, 0.0, 0.0))
        self._hand_in(LEVEL, time, (level,))

    def event(self, time: float, text: str) -> None:
        """Record an event as text."""
        self._hand_in(EVENTS, time, text)

    def close(self) -> None:
        """Write the remaining rows, the index and the footer. May be called repeatedly and never
        raises; `failure` describes any error."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            self._fail(
                f"the file was not completed within {CLOSE_S:g} s",
                f"run softfin bag recover {self.path}",
            )

    def _hand_in(self, topic: str, time: float, values: Sequence[float] | str) -> None:
        if self._closing.is_set():
            return
        waiting = self._queue.qsize()
        # The loop must not wait: rows beyond the backlog are dropped, and the recording is treated
        # as failed.
        if waiting >= BACKLOG or self._clock() - self._flushed > STALL_S:
            self._fail(f"{waiting:,} rows are waiting to be written", "record on a faster disk")
        if waiting < BACKLOG:
            self._queue.put((topic, time, values))

    def _work(self) -> None:
        try:
            while not self._closing.wait(POLL_S):
                self._take()
                if self._clock() - self._flushed >= self._flush_s:
                    self._flush()
            self._take()
            self._flush(end=True)
        except Exception as error:
            # Whatever the error is, the loop must detect it and stop the fin.
            self._fail(
                f"{type(error).__name__}: {one_line(error)}",
                f"run softfin bag recover {self.path}",
            )
        finally:
            with contextlib.suppress(OSError):
                self._file.close()

    def _take(self) -> None:
        for _ in range(self._queue.qsize()):
            topic, seconds, values = self._queue.get()
            try:
                self._bag.write(topic, self._offset_ns + round(seconds * SECOND_NS), values)
            except Exception as error:
                self._fail(
                    f"{topic}: invalid values {values!r:.100} ({error})",
                    "report this bug in softfin",
                )

    def _flush(self, end: bool = False) -> None:
        try:
            (self._bag.finish if end else self._bag.flush)()
            if shutil.disk_usage(self.path.parent).free < self._reserve:
                # Report the error while there is still space for the stop, the events and the
                # footer.
                self._fail(
                    f"less than {self._reserve / 1e6:g} MB of disk space left", "free disk space"
                )
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            # Unwritten bytes stay in the buffer; the next flush writes them if there is free space
            # again.
            self._fail(
                error.strerror or str(error),
                f"free disk space, then run softfin bag recover {self.path}",
            )
        self._flushed = self._clock()

    def _fail(self, reason: str, fix: str) -> None:
        if self.failure is None:
            self.failure = (
                f"{self.path}: recording failed: {reason}; the rows so far are kept; {fix}"
            )
