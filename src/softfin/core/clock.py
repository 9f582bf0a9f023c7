"""The clock that the 100 Hz loop, its threads and the emulated devices share: real, or simulated as fast as it goes.

Whatever waits, waits on a clock: it makes the threads, events, locks and conditions. The other one is
`softfin.rig.simulated_clock`.
"""

import threading
import time
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class Event(Protocol):
    """As `threading.Event`."""

    def set(self) -> None:
        """Wake whoever waits."""
        ...

    def clear(self) -> None:
        """Reset the event, so that it is waited for again."""
        ...

    def is_set(self) -> bool:
        """Whether nobody has to wait."""
        ...

    def wait(self, timeout: float | None = None) -> bool:
        """Until it is set, or the time [s] is over; which of both."""
        ...


@runtime_checkable
class Lock(Protocol):
    """As `threading.Lock` or `threading.RLock`."""

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        """Whether it could be had."""
        ...

    def release(self) -> None:
        """Raises RuntimeError where it is not held."""
        ...

    def __enter__(self) -> bool: ...
    def __exit__(self, *_: Any) -> None: ...


@runtime_checkable
class Condition(Lock, Protocol):
    """As `threading.Condition`, whose lock is re-entrant."""

    def wait(self, timeout: float | None = None) -> bool:
        """Let go of the lock until somebody notifies, or the time [s] is over; which of both."""
        ...

    def wait_for(self, predicate: Callable[[], bool], timeout: float | None = None) -> bool:
        """Wait until the predicate is true; return whether it is."""
        ...

    def notify_all(self) -> None:
        """Wake whoever waits."""
        ...


@runtime_checkable
class Thread(Protocol):
    """As `threading.Thread`, once it is started."""

    def join(self, timeout: float | None = None) -> None:
        """Wait for its end, for so long [s] at most."""
        ...

    def is_alive(self) -> bool:
        """Whether it has not ended."""
        ...


@runtime_checkable
class Clock(Protocol):
    """Time, and all that waits for it; what it makes is used with this clock alone."""

    def __call__(self) -> float:
        """The monotonic time [s]."""
        ...

    def wall(self) -> float:
        """The time of day that belongs to it [s since 1970]."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait so long."""
        ...

    def event(self) -> Event:
        """Not set yet."""
        ...

    def lock(self) -> Lock:
        """As `threading.Lock`; may be held while its holder waits."""
        ...

    def rlock(self) -> Lock:
        """As `threading.RLock`; likewise."""
        ...

    def condition(self) -> Condition:
        """With a re-entrant lock of its own."""
        ...

    def spawn(self, target: Callable[[], None], name: str) -> Thread:
        """A daemon thread, started."""
        ...


class RealClock:
    """The computer's own; its threads, locks and events are those of `threading`."""

    def __call__(self) -> float:
        """`time.monotonic` [s]."""
        return time.monotonic()

    def wall(self) -> float:
        """`time.time` [s]."""
        return time.time()

    def sleep(self, seconds: float) -> None:
        """`time.sleep`."""
        time.sleep(seconds)

    def event(self) -> Event:
        """Not set yet."""
        return threading.Event()

    def lock(self) -> Lock:
        """Not re-entrant."""
        return threading.Lock()

    def rlock(self) -> Lock:
        """Re-entrant."""
        return threading.RLock()

    def condition(self) -> Condition:
        """With a re-entrant lock of its own."""
        return threading.Condition()

    def spawn(self, target: Callable[[], None], name: str) -> Thread:
        """A daemon thread, started."""
        thread = threading.Thread(target=target, name=name, daemon=True)
        thread.start()
        return thread


REAL = RealClock()
"""That of every real rig."""
