"""Simulated time, shared by threads that take turns: as fast as the computer allows, and the same in every run.

The thread that makes the clock and those that it spawns are its members. Exactly one of them runs, until it waits; then
the next one that need not wait any more goes on, in the order in which they were woken. Only when all of them wait does
time move on, to the earliest moment that one of them waits for. So computing takes no time, nothing is ever late, and
nothing depends on how the operating system shares the processor out. Any other thread, such as a test's own or one that
reads a keyboard, may use the clock too: it is woken when its time has come, but nobody waits for it.

A member must not wait for another one in any other way, as by `threading.Event`: everybody would stand still.
"""

import heapq
import itertools
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from softfin.core.clock import Clock

BEGIN_S = 1000.0
"""Start of every simulated time [s]; not 0, which stands for "never" in places."""

RECHECK_S = 0.5
"""Real time between two looks of a waiting thread at whether it is its turn, should a Ctrl-C have lost its signal."""


class _Wait:
    """One wait of one thread."""

    __slots__ = ("is_member", "over", "parked", "signal", "woken")

    def __init__(self, is_member: bool) -> None:
        self.is_member = is_member
        """A member goes on only when no other member runs."""
        self.parked = False
        """The member has let the others run."""
        self.over = self.woken = False
        """Over: no wait any more. Woken: by somebody, not by its time."""
        self.signal = threading.Lock()
        self.signal.acquire()


class SimulatedClock(Clock):
    """Use it in the thread that makes it, and in those that it spawns."""

    def __init__(self) -> None:
        self._now, self._wall = BEGIN_S, time.time()
        self._guard = threading.RLock()
        """Protects everything below; held for moments, since other threads than members come in as well."""
        self._ready: deque[_Wait] = deque()
        self._timers: list[tuple[float, int, _Wait]] = []
        self._number = itertools.count()
        self._running: _Wait | None = _Wait(is_member=True)
        """The wait after which the running member went on."""
        self._member = threading.local()
        """A member's newest `wait`; other threads have none."""
        self._member.wait = self._running

    def __call__(self) -> float:
        """Return the simulated time [s]."""
        return self._now

    def wall(self) -> float:
        """Return the time of day at which the clock was made, plus what has passed since [s]."""
        return self._wall + self._now - BEGIN_S

    def sleep(self, seconds: float) -> None:
        """Let the others run until so much time has passed."""
        self._finish(self._begin([], max(0.0, seconds)))

    def event(self) -> threading.Event:
        """Make an event that is not set."""
        return _Event(self)

    def condition(self) -> threading.Condition:
        """Make a condition with a re-entrant lock of its own."""
        return _Condition(self)

    lock = condition

    def spawn(self, target: Callable[[], object], name: str) -> threading.Thread:
        """Start a member; its first turn comes when its maker waits."""
        thread = _Thread(self, target, name)
        thread.start()
        self._wake([thread.first])
        return thread

    def _begin(self, queue: list[_Wait], timeout: float | None) -> _Wait:
        """Begin a wait: in a queue of those who may be woken, and until a timeout [s]; `_finish` ends it."""
        with self._guard:
            wait = _Wait(is_member=hasattr(self._member, "wait"))
            queue[:] = [*(each for each in queue if not each.over), wait]
            if timeout is not None:
                heapq.heappush(self._timers, (self._now + timeout, next(self._number), wait))
            return wait

    def _finish(self, wait: _Wait) -> bool:
        """Let others run until the wait is over; whether somebody woke it, and not its time."""
        before = getattr(self._member, "wait", None)
        try:
            self._park(before, wait)
            self._until(wait)
        except BaseException:
            # Ctrl-C: this wait is over, but two members must not run at once; a second Ctrl-C does not wait for that.
            self._wake([wait])
            self._park(before, wait)
            self._until(wait)
            raise
        return wait.woken

    def _park(self, before: _Wait | None, wait: _Wait) -> None:
        """Let the next member run in place of this one; `before` is the wait after which this one went on."""
        with self._guard:
            if before is not None and wait is not self._running:
                self._member.wait = wait
                # A second Ctrl-C may have broken that wait off.
                before.parked = False
                wait.parked = True
                if wait.over:
                    self._ready.append(wait)
                if self._running is before:
                    self._running = None
            self._run_next()

    def _until(self, wait: _Wait) -> None:
        while not (self._running is wait if wait.is_member else wait.over):
            wait.signal.acquire(timeout=RECHECK_S)

    def _wake(self, waits: list[_Wait]) -> bool:
        """End waits; whether any of them was still waiting."""
        with self._guard:
            waiting = [wait for wait in waits if not wait.over]
            for wait in waiting:
                wait.woken = True
                self._end(wait)
            self._run_next()
            return bool(waiting)

    def _end(self, wait: _Wait) -> None:
        # In this order, so that a Ctrl-C in between loses nobody: who is in twice has one turn all the same.
        if wait.parked:
            self._ready.append(wait)
        wait.over = True
        if not wait.is_member:
            wait.signal.release()

    def _run_next(self) -> None:
        """Have the next member run; where all wait, move time on to the earliest moment that one waits for."""
        while self._running is None and (self._ready or self._timers):
            if self._ready:
                wait = self._ready[0]
                if wait.parked:
                    self._running, wait.parked = wait, False
                self._ready.popleft()
                if self._running is wait:
                    wait.signal.release()
            else:
                at, _, wait = self._timers[0]
                if not wait.over:
                    self._now = max(self._now, at)
                    self._end(wait)
                heapq.heappop(self._timers)


class _Thread(threading.Thread):
    def __init__(self, clock: SimulatedClock, target: Callable[[], object], name: str) -> None:
        super().__init__(target=target, name=name, daemon=True)
        self._clock, self._finished = clock, _Event(clock)
        self.first = _Wait(is_member=True)
        self.first.parked = True

    def run(self) -> None:
        clock = self._clock
        clock._member.wait = self.first
        clock._until(self.first)
        try:
            super().run()
        finally:
            self._finished.set()
            with clock._guard:
                clock._running = None
                clock._run_next()

    def join(self, timeout: float | None = None) -> None:
        self._finished.wait(timeout)

    def is_alive(self) -> bool:
        return not self._finished.is_set()


class _Condition(threading.Condition):
    def __init__(self, clock: SimulatedClock) -> None:
        self._clock, self._owner, self._count = clock, 0, 0
        self._lock: list[_Wait] = []
        """Those who wait for the lock."""
        self._waiters: list[_Wait] = []
        """Those who wait to be notified."""

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        clock, me = self._clock, threading.get_ident()
        end = clock() + timeout
        while True:
            with clock._guard:
                if self._owner in (0, me):
                    self._owner, self._count = me, self._count + 1
                    return True
                left = end - clock()
                if not blocking or (timeout >= 0 and left <= 0):
                    return False
                wait = clock._begin(self._lock, left if timeout >= 0 else None)
            clock._finish(wait)

    def release(self) -> None:
        with self._clock._guard:
            self._count -= 1
            if self._count == 0:
                self._let_go()

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *_: Any) -> None:
        self.release()

    def wait(self, timeout: float | None = None) -> bool:
        clock = self._clock
        with clock._guard:
            wait = clock._begin(self._waiters, timeout)
            held, self._count = self._count, 0
            self._let_go()
        try:
            return clock._finish(wait)
        finally:
            self.acquire()
            self._count = held

    def wait_for(self, predicate: Callable[[], Any], timeout: float | None = None) -> Any:
        end = None if timeout is None else self._clock() + timeout
        while not (result := predicate()):
            left = None if end is None else end - self._clock()
            if left is not None and left <= 0:
                break
            self.wait(left)
        return result

    def notify_all(self) -> None:
        with self._clock._guard:
            self._clock._wake(self._waiters)

    def _let_go(self) -> None:
        """Let the one that has waited for longest in."""
        self._owner = 0
        while self._lock and not self._clock._wake([self._lock.pop(0)]):
            pass


class _Event(threading.Event):
    def __init__(self, clock: SimulatedClock) -> None:
        super().__init__()
        # The one that threading's own event waits on.
        self._cond = _Condition(clock)

    def wait(self, timeout: float | None = None) -> bool:
        # Whoever sets it at the very moment of the timeout is in time.
        return super().wait(timeout) or self.is_set()
