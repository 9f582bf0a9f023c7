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

from softfin.core.clock import Condition, Event, Lock, Thread
from softfin.core.errors import RunError

BEGIN_S = 1000.0
"""Of every simulated time; not 0, which stands for "never" in places."""

LOOK_S = 0.5
"""Between two looks of a waiting thread at whether anybody is left that could wake it; real time."""


class StandstillError(RunError):
    """Every thread of a simulated clock waits for another one, and none of them for a time."""


class _Turn:
    """One wait of one thread."""

    __slots__ = ("asks_for_baton", "name", "over", "signal", "standstill", "woken")

    def __init__(self, asks_for_baton: bool) -> None:
        self.asks_for_baton = asks_for_baton
        """Of a member, which goes on only when nobody else runs."""
        self.name = threading.current_thread().name
        self.over = self.woken = self.standstill = False
        """Over: no wait any more. Woken: by somebody, not by its time."""
        self.signal = threading.Lock()
        self.signal.acquire()


class SimulatedClock:
    """Meets the Clock contract. Use it in the thread that makes it, and in those that it spawns."""

    def __init__(self) -> None:
        self._now, self._wall = BEGIN_S, time.time()
        self._guard = threading.RLock()
        """Of all below; held for moments, as other threads than members come in as well."""
        self._ready: deque[_Turn] = deque()
        self._timers: list[tuple[float, int, _Turn]] = []
        self._number = itertools.count()
        self._waiting: dict[_Turn, None] = {}
        """Members."""
        self._running: _Turn | None = _Turn(asks_for_baton=True)
        """Who has the baton: the wait that has ended last."""
        self._member = threading.local()
        """Of a member alone: its newest `turn`."""
        self._member.turn = self._running
        self._members = {threading.current_thread()}
        self._elders = set(threading.enumerate())
        """Threads that were there before know nothing of this clock, until they use it."""

    def __call__(self) -> float:
        """Now [s]."""
        return self._now

    def wall(self) -> float:
        """The time of day at which it was made, and what has passed since [s]."""
        return self._wall + self._now - BEGIN_S

    def sleep(self, seconds: float) -> None:
        """Let the others run until so much time has passed."""
        self._wait(self._turn(None, max(0.0, seconds)))

    def event(self) -> Event:
        """Not set yet."""
        return _Event(self)

    def lock(self) -> Lock:
        """Not re-entrant."""
        return _Lock(self, reentrant=False)

    def rlock(self) -> Lock:
        """Re-entrant."""
        return _Lock(self, reentrant=True)

    def condition(self) -> Condition:
        """With a re-entrant lock of its own."""
        return _Condition(self)

    def spawn(self, target: Callable[[], None], name: str) -> Thread:
        """A member; its first turn comes when its maker waits."""
        return _Thread(self, target, name)

    def _turn(self, queue: deque[_Turn] | None, timeout: float | None) -> _Turn:
        """Begin a wait: in a queue of whoever may be woken, until a timeout [s]."""
        with self._guard:
            turn = _Turn(asks_for_baton=hasattr(self._member, "turn"))
            if not turn.asks_for_baton:
                self._elders.discard(threading.current_thread())
            if queue is not None:
                queue.append(turn)
            if timeout is not None:
                heapq.heappush(self._timers, (self._now + timeout, next(self._number), turn))
            return turn

    def _wait(self, turn: _Turn) -> bool:
        """Let others run until it is this one's turn again; whether somebody woke it, and not its time."""
        before = getattr(self._member, "turn", None)
        try:
            self._give_up(before, turn)
            self._until(turn)
        except BaseException:
            # Ctrl-C: this wait is over, but two members must not run at once; a second Ctrl-C does not wait for that.
            self._wake([turn])
            self._give_up(before, turn)
            self._until(turn)
            raise
        if turn.standstill:
            raise StandstillError(
                f"simulated time stands still: every thread waits for another one, none for a time "
                f"({turn.name} was the first)"
            )
        return turn.woken

    def _give_up(self, before: _Turn | None, turn: _Turn) -> None:
        """From here on a member waits for its turn; `before` is the one that it had."""
        with self._guard:
            if before is not None and turn is not self._running:
                self._member.turn = turn
                # Of a wait that a second Ctrl-C has broken off.
                self._waiting.pop(before, None)
                self._waiting[turn] = None
                if turn.over:
                    self._ready.append(turn)
                if self._running is before:
                    self._running = None
            self._pass_on()

    def _until(self, turn: _Turn) -> None:
        while not (self._running is turn if turn.asks_for_baton else turn.over):
            if not turn.signal.acquire(timeout=LOOK_S):
                with self._guard:
                    self._pass_on()

    def _wake(self, turns: list[_Turn]) -> int:
        """End waits; how many of them were still waiting."""
        with self._guard:
            waiting = [turn for turn in turns if not turn.over]
            for turn in waiting:
                turn.woken = True
                self._end(turn)
            if self._running is None:
                self._pass_on()
            return len(waiting)

    def _end(self, turn: _Turn) -> None:
        # In this order, so that a Ctrl-C in between loses nobody: who is in twice has one turn all the same.
        if turn in self._waiting:
            self._ready.append(turn)
        turn.over = True
        if not turn.asks_for_baton:
            turn.signal.release()

    def _pass_on(self) -> None:
        """Have the next one run; where all wait, move on to the earliest moment that one waits for."""
        while self._running is None:
            if self._ready:
                turn = self._ready[0]
                if turn in self._waiting:
                    self._running = turn
                    del self._waiting[turn]
                del self._ready[0]
                if self._running is turn:
                    turn.signal.release()
            elif self._timers:
                at, _, turn = self._timers[0]
                if not turn.over:
                    self._now = max(self._now, at)
                    self._end(turn)
                heapq.heappop(self._timers)
            elif self._waiting and not self._others():
                turn = next(iter(self._waiting))
                turn.standstill = True
                self._end(turn)
            else:
                return

    def _forget(self, queue: deque[_Turn], turn: _Turn) -> None:
        """A wait that its time has ended is still in its queue."""
        with self._guard:
            if turn in queue:
                queue.remove(turn)

    def _others(self) -> bool:
        """Whether a thread that is no member may still wake one."""
        known = self._elders | self._members
        return any(thread not in known for thread in threading.enumerate())


class _Thread:
    def __init__(self, clock: SimulatedClock, target: Callable[[], None], name: str) -> None:
        self._clock, self._target = clock, target
        self._ended = _Event(clock)
        self._first = _Turn(asks_for_baton=True)
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._first.name = name
        with clock._guard:
            clock._members.add(self._thread)
            clock._waiting[self._first] = None
        self._thread.start()
        clock._wake([self._first])

    def _run(self) -> None:
        clock = self._clock
        clock._member.turn = self._first
        clock._until(self._first)
        try:
            self._target()
        finally:
            self._ended.set()
            with clock._guard:
                clock._members.discard(threading.current_thread())
                clock._running = None
                clock._pass_on()

    def join(self, timeout: float | None = None) -> None:
        self._ended.wait(timeout)

    def is_alive(self) -> bool:
        return not self._ended.is_set()


class _Event:
    def __init__(self, clock: SimulatedClock) -> None:
        self._clock, self._set = clock, False
        self._queue: deque[_Turn] = deque()

    def set(self) -> None:
        if self._set:
            return
        with self._clock._guard:
            self._set = True
            waiting = list(self._queue)
            self._queue.clear()
            self._clock._wake(waiting)

    def clear(self) -> None:
        self._set = False

    def is_set(self) -> bool:
        return self._set

    def wait(self, timeout: float | None = None) -> bool:
        clock = self._clock
        with clock._guard:
            if self._set:
                return True
            turn = clock._turn(self._queue, timeout)
        try:
            return clock._wait(turn) or self._set
        finally:
            clock._forget(self._queue, turn)


class _Lock:
    def __init__(self, clock: SimulatedClock, reentrant: bool) -> None:
        self._clock, self._reentrant = clock, reentrant
        self._owner: int | None = None
        self._count = 0
        self._queue: deque[_Turn] = deque()

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        clock, me = self._clock, threading.get_ident()
        end = clock() + timeout
        while True:
            with clock._guard:
                if self._owner is None or (self._reentrant and self._owner == me):
                    self._owner = me
                    self._count += 1
                    return True
                left = end - clock()
                if not blocking or (timeout >= 0 and left <= 0):
                    return False
                turn = clock._turn(self._queue, left if timeout >= 0 else None)
            try:
                clock._wait(turn)
            finally:
                clock._forget(self._queue, turn)

    def release(self) -> None:
        with self._clock._guard:
            if self._owner is None or (self._reentrant and self._owner != threading.get_ident()):
                raise RuntimeError("cannot release a lock that is not held")
            self._count -= 1
            if self._count == 0:
                self._owner = None
                self._let_one_in()

    def _let_one_in(self) -> None:
        while self._queue and not self._clock._wake([self._queue.popleft()]):
            pass

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *_: Any) -> None:
        self.release()


class _Condition:
    """As `threading.Condition`."""

    def __init__(self, clock: SimulatedClock) -> None:
        self._clock, self._lock = clock, _Lock(clock, reentrant=True)
        self.acquire, self.release = self._lock.acquire, self._lock.release
        self._queue: deque[_Turn] = deque()

    def __enter__(self) -> bool:
        return self._lock.acquire()

    def __exit__(self, *_: Any) -> None:
        self._lock.release()

    def wait(self, timeout: float | None = None) -> bool:
        clock, lock = self._clock, self._lock
        with clock._guard:
            if lock._owner != threading.get_ident():
                raise RuntimeError("cannot wait on a condition that is not held")
            turn = clock._turn(self._queue, timeout)
            held, lock._owner, lock._count = lock._count, None, 0
            lock._let_one_in()
        try:
            return clock._wait(turn)
        finally:
            clock._forget(self._queue, turn)
            lock.acquire()
            lock._count = held

    def wait_for(self, predicate: Callable[[], bool], timeout: float | None = None) -> bool:
        end = None if timeout is None else self._clock() + timeout
        while not (result := predicate()):
            left = None if end is None else end - self._clock()
            if left is not None and left <= 0:
                break
            self.wait(left)
        return result

    def notify_all(self) -> None:
        with self._clock._guard:
            waiting = list(self._queue)
            self._queue.clear()
            self._clock._wake(waiting)
