"""The clock shared by the 100 Hz loop, its threads and the emulated devices: real time, or
simulated as fast as the computer allows.

All waiting goes through a clock: it creates the threads, events, locks and conditions, which must
only be used with the clock that created them. The simulated clock is in
`softfin.emulation.clock`.
"""

import threading
import time
from collections.abc import Callable

PAIR_S = 0.005
"""Maximum time between two clock readings that are treated as simultaneous [s]: a tenth of the
shortest pause that is treated as a suspend."""


class Clock:
    """The computer's own clock; waits using `threading`."""

    is_simulated = False
    """Whether time is simulated; devices on a simulated clock exist only in this process."""

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
        # Preemption between two readings would look like a short suspend, so read again.
        while True:
            before = time.clock_gettime(time.CLOCK_MONOTONIC)
            boot = time.clock_gettime(time.CLOCK_BOOTTIME)
            if time.clock_gettime(time.CLOCK_MONOTONIC) - before < PAIR_S:
                return boot - before

    def sleep(self, seconds: float) -> None:
        """Wait for a time [s]."""
        time.sleep(seconds)

    def event(self) -> threading.Event:
        """Create an event that is not set."""
        return threading.Event()

    def condition(self) -> threading.Condition:
        """Create a condition with its own re-entrant lock; like `lock`, it may be held while the
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
