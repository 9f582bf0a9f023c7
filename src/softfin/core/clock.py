"""The clock shared by the 100 Hz loop, its threads and the emulated devices: real, or simulated as fast as it goes.

Whatever waits, waits on a clock: the clock makes the threads, events, locks and conditions, and what it makes is used
with this clock alone. The other implementation is `softfin.rig.simulated_clock`.
"""

import threading
import time
from collections.abc import Callable
from typing import Protocol, runtime_checkable


@runtime_checkable
class Clock(Protocol):
    """Time, and everything that waits for it."""

    def __call__(self) -> float:
        """Return the monotonic time [s]."""
        ...

    def wall(self) -> float:
        """Return the time of day that belongs to it [s since 1970]."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait for so long."""
        ...

    def event(self) -> threading.Event:
        """Make an event that is not set."""
        ...

    def condition(self) -> threading.Condition:
        """Make a condition with a re-entrant lock of its own."""
        ...

    def lock(self) -> threading.Condition:
        """Make a re-entrant lock, which may be held while its holder waits."""
        ...

    def spawn(self, target: Callable[[], object], name: str) -> threading.Thread:
        """Start a daemon thread."""
        ...


class RealClock:
    """The computer's own clock; its threads, locks and events are those of `threading`."""

    sleep = staticmethod(time.sleep)
    event = staticmethod(threading.Event)
    condition = lock = staticmethod(threading.Condition)

    def __call__(self) -> float:
        """Return `time.monotonic` [s]."""
        return time.monotonic()

    def wall(self) -> float:
        """Return `time.time` [s]."""
        return time.time()

    def spawn(self, target: Callable[[], object], name: str) -> threading.Thread:
        """Start a daemon thread."""
        thread = threading.Thread(target=target, name=name, daemon=True)
        thread.start()
        return thread


REAL = RealClock()
"""The clock of every real rig."""
