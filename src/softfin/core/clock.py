"""The clock shared by the 100 Hz loop, its threads and the emulated devices: real, or simulated as
fast as the computer allows.

Everything that waits, waits on a clock: the clock creates the threads, events, locks and
conditions, and they may only be used with the clock that created them. The simulated one is
`softfin.rig.simulated_clock`.
"""

import threading
import time
from collections.abc import Callable

PAIR_S = 0.005
"""Longest time between two clock readings that still count as simultaneous [s]: a tenth of what
counts as a suspend."""


class Clock:
    """The computer's own time, and everything that waits for it, by `threading`."""

    def __call__(self) -> float:
        """Return the monotonic time [s]."""
        return time.monotonic()

    def wall(self) -> float:
        """Return the wall-clock time [s since 1970]."""
        return time.time()

    def suspended(self) -> float:
        """Return how long the computer has been suspended since boot [s]; 0 if the platform does
        not track it."""
        if not hasattr(time, "CLOCK_BOOTTIME"):
            return 0.0
        # This thread may be preempted between two readings, which would look like a short sleep.
        while True:
            before = time.clock_gettime(time.CLOCK_MONOTONIC)
            boot = time.clock_gettime(time.CLOCK_BOOTTIME)
            if time.clock_gettime(time.CLOCK_MONOTONIC) - before < PAIR_S:
                return boot - before

    def sleep(self, seconds: float) -> None:
        """Wait for so long."""
        time.sleep(seconds)

    def event(self) -> threading.Event:
        """Make an event that is not set."""
        return threading.Event()

    def condition(self) -> threading.Condition:
        """Make a condition with a re-entrant lock of its own; like `lock`, it may be held while its
        owner waits."""
        return threading.Condition()

    lock = condition

    def spawn(self, target: Callable[[], object], name: str) -> threading.Thread:
        """Start a daemon thread."""
        thread = threading.Thread(target=target, name=name, daemon=True)
        thread.start()
        return thread


REAL = Clock()
"""The clock of every real rig."""
