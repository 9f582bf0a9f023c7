"""Simulated time, shared by threads that take turns. It advances as fast as the computer allows and
is identical in every run.

The thread that creates the clock and the threads that it spawns are its members. Exactly one member
runs until it waits; then, of the members that are ready, the one that has waited longest continues.
Time advances only when all members wait, to the earliest time that one of them waits for. Computing
therefore takes no time, nothing is ever late, and nothing depends on the operating system's
scheduler. Other threads, such as a test's threads or one that reads the keyboard, may also use the
clock, but the members do not wait for them.

A member must not wait for another in any other way, e.g. with `threading.Event`: all members would
then wait forever.
"""

import math
import threading
import time
from collections.abc import Callable
from typing import Any

from softfin.core.clock import Clock

BEGIN_S = 1000.0
"""Start of simulated time [s]; not 0, which means "never" in some places."""

RECHECK_S = 0.5
"""Real-time interval at which a waiting thread checks whether it is its turn [s], in case Ctrl-C
lost its signal."""

Condition = Callable[[], object]
"""Function that returns whether a wait is over."""


class _Member:
    """A thread and the condition that it waits for."""

    def __init__(self) -> None:
        self.ready: Condition = lambda: True
        self.end = math.inf
        self.signal = threading.Lock()
        # Locked until it is this member's turn.
        self.signal.acquire()


class SimulatedTime(Clock):
    """Clock to use in the thread that creates it, and in the threads that it spawns."""

    is_simulated = True

    def __init__(self) -> None:
        self._now = BEGIN_S
        # Whole seconds, so that times derived from the wall clock are rounded alike in every run.
        self._wall = int(time.time())
        self.wall_set_s = 0.0
        """Time by which the wall clock has been set forward [s]; tests may change it."""
        self.shared: dict[Any, Any] = {}
        """Buses, sockets and web pages on this clock, by address."""
        self._guard = threading.RLock()
        """Protects the attributes below; held only briefly, because threads that are not members
        also use it."""
        self._waiting: list[_Member] = []
        self._local = threading.local()
        self._running: _Member | None = _Member()
        self._local.member = self._running

    def __call__(self) -> float:
        """Return the simulated time [s]."""
        return self._now

    def wall(self) -> float:
        """Return the wall-clock time [s]: the wall-clock time at which the clock was created, plus
        the simulated time since, plus `wall_set_s`."""
        return self._wall + (self._now - BEGIN_S) + self.wall_set_s

    def suspended(self) -> float:
        """Return 0: this computer is never suspended."""
        return 0.0

    def sleep(self, seconds: float) -> None:
        """Let the other members run until `seconds` have passed."""
        self.wait_for(lambda: False, max(0.0, seconds))

    def event(self) -> threading.Event:
        """Return a new event, which is not set."""
        return _Event(self)

    def condition(self) -> threading.Condition:
        """Return a new condition with its own re-entrant lock."""
        return _Condition(self)

    lock = condition

    def spawn(self, target: Callable[[], object], name: str) -> threading.Thread:
        """Start a member; its first turn comes when the current member waits."""
        thread = _Thread(self, target, name)
        thread.start()
        with self._guard:
            self._waiting.append(thread.member)
            self.go_on()
        return thread

    def wait_for(self, ready: Condition, timeout: float | None = None) -> bool:
        """Let the other members run until `ready()` or a timeout [s]; return whether it is
        ready."""
        if ready():
            return True
        member: _Member | None = getattr(self._local, "member", None)
        me = member or _Member()
        me.ready = ready
        me.end = math.inf if timeout is None else self._now + timeout
        try:
            self._wait(me)
        except BaseException:
            # Ctrl-C ends this wait, but two members must not run at once, so wait for this member's
            # turn; a second Ctrl-C skips that.
            me.ready = lambda: True
            self._wait(me)
            raise
        is_ready = bool(ready())
        if member is None:
            self._end_turn()
        return is_ready

    def go_on(self) -> None:
        """If all members wait, let the next one run; if no member is ready, first advance to the
        earliest time for which a member waits."""
        with self._guard:
            if self._running is not None or not self._waiting:
                return
            # Members are in order of arrival, so the first that is ready has waited longest.
            chosen = next((each for each in self._waiting if each.ready()), None)
            if chosen is None:
                chosen = min(self._waiting, key=lambda each: each.end)
                if chosen.end == math.inf:
                    return
                # Time never goes back, even if the end of the wait has already passed.
                self._now = max(self._now, chosen.end)
            # In this order, so that a Ctrl-C in between does not lose the member.
            self._running = chosen
            self._waiting.remove(chosen)
            if chosen.signal.locked():
                chosen.signal.release()

    def _wait(self, me: _Member) -> None:
        with self._guard:
            if me not in self._waiting:
                self._waiting.append(me)
            if self._running is me:
                self._running = None
            self.go_on()
        self._await_turn(me)

    def _await_turn(self, me: _Member) -> None:
        while self._running is not me:
            me.signal.acquire(timeout=RECHECK_S)

    def _end_turn(self) -> None:
        with self._guard:
            self._running = None
            self.go_on()


class _Thread(threading.Thread):
    def __init__(self, clock: SimulatedTime, target: Callable[[], object], name: str) -> None:
        super().__init__(target=target, name=name, daemon=True)
        self.member = _Member()
        self._clock = clock
        self._has_ended = False

    def run(self) -> None:
        self._clock._local.member = self.member
        self._clock._await_turn(self.member)
        try:
            super().run()
        finally:
            self._has_ended = True
            self._clock._end_turn()

    def join(self, timeout: float | None = None) -> None:
        self._clock.wait_for(lambda: self._has_ended, timeout)

    def is_alive(self) -> bool:
        return not self._has_ended


class _Condition(threading.Condition):
    def __init__(self, clock: SimulatedTime) -> None:
        self._clock = clock
        self._owner = 0
        self._count = 0
        self._news = 0

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        me = threading.get_ident()
        while True:
            with self._clock._guard:
                # 0 means that the lock is free; identifiers of threads are never 0.
                if self._owner in (0, me):
                    self._owner = me
                    self._count += 1
                    return True
            if not blocking or not self._clock.wait_for(
                lambda: self._owner == 0, None if timeout < 0 else timeout
            ):
                return False

    def release(self) -> None:
        self._count -= 1
        if self._count == 0:
            self._owner = 0
            self._clock.go_on()

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *_: object) -> None:
        self.release()

    def wait(self, timeout: float | None = None) -> bool:
        before = self._news
        return bool(self.wait_for(lambda: self._news != before, timeout))

    def wait_for(self, predicate: Condition, timeout: float | None = None) -> Any:
        # Release a re-entrant lock completely while waiting, as threading.Condition does.
        held = self._count
        self._count = 0
        self._owner = 0
        try:
            return self._clock.wait_for(predicate, timeout)
        finally:
            self.acquire()
            self._count = held

    def notify_all(self) -> None:
        self._news += 1
        self._clock.go_on()


class _Event(threading.Event):
    def __init__(self, clock: SimulatedTime) -> None:
        super().__init__()
        self._clock = clock

    def set(self) -> None:
        super().set()
        self._clock.go_on()

    def wait(self, timeout: float | None = None) -> bool:
        return self._clock.wait_for(self.is_set, timeout)
