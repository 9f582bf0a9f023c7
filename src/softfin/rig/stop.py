"""Ways to stop a moving fin in addition to the safety limits: signals, the Enter key, and a
watchdog on the loop."""

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TypeAlias

from softfin.core.clock import REAL, Clock
from softfin.core.errors import SafetyStop
from softfin.rig.priority import WATCHDOG, set_priority
from softfin.rig.safety import Trip

STOP_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP")
"""Signals that stop the fin. The last is Ctrl-Z, because a suspended program cannot monitor the
fin."""

_Handlers: TypeAlias = dict[int, Callable[[int, FrameType | None], object] | int | None]
"""Signal handlers, keyed by signal number as in the module `signal`."""

PATIENCE_S = 2.0
"""Time within which a second signal must not interrupt the stop started by the first [s], because
people press Ctrl-C twice."""


class StopRequest:
    """Stop flag that any thread or signal handler may set; the first reason counts."""

    def __init__(self) -> None:
        self.trip: Trip | None = None
        self.ends_program = False
        """Whether a signal has arrived, which also ends the program."""
        self.is_by_signal = False
        """Whether a signal is the first reason of the stop."""
        self.is_obeyed = False
        """Whether the machine is being stopped, which takes a bounded time and must not be
        interrupted by signals."""

    def ask(self, cause: str, reason: str) -> None:
        """Request a stop, unless one has already been requested."""
        if self.trip is None:
            self.trip = Trip(cause, reason)


@contextmanager
def stopped_by_signals(request: StopRequest) -> Iterator[None]:
    """Make stop signals set the flag instead of raising an exception in the loop; effective only in
    the main thread."""
    asked: list[float] = []

    def handle(number: int, _: FrameType | None) -> None:
        name = signal.Signals(number).name
        asked.append(time.monotonic())
        if asked[-1] - asked[0] > PATIENCE_S and not request.is_obeyed:
            # The first signal had no effect, e.g. because figures are being drawn; now end the
            # program as usual.
            raise KeyboardInterrupt
        request.ends_program = True
        request.is_by_signal = request.is_by_signal or request.trip is None
        request.ask("emergency_stop", f"stopped by {'Ctrl-C' if name == 'SIGINT' else name}")

    with _handling_signals(handle):
        yield


@contextmanager
def interrupted_by_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt on the first stop signal so that code that powers a motor can stop
    the motor.

    Later signals are ignored, because they would interrupt the stop, which takes a bounded time.
    """
    is_asked = False

    def handle(number: int, _: FrameType | None) -> None:
        nonlocal is_asked
        if not is_asked:
            is_asked = True
            raise KeyboardInterrupt

    with _handling_signals(handle):
        yield


@contextmanager
def undisturbed_after_stop() -> Iterator[None]:
    """Ignore stop signals while a `SafetyStop` is being handled; otherwise, use the previous
    handlers.

    People press Ctrl-C repeatedly. The fin is already stopped by then, and the error message and
    exit code must not be lost.
    """

    def handle(number: int, _: FrameType | None) -> None:
        error = sys.exception()
        while error is not None:
            if isinstance(error, SafetyStop):
                return
            error = error.__context__
        signal.signal(number, before[number])
        signal.raise_signal(number)

    with _handling_signals(handle) as before:
        yield


@contextmanager
def ignored_termination() -> Iterator[None]:
    """Ignore SIGTERM, which a second ``rig stop`` sends to the first; effective only in the main
    thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def _handling_signals(handle: Callable[[int, FrameType | None], None]) -> Iterator[_Handlers]:
    """Install a handler for the stop signals and yield the previous handlers. Effective only in the
    main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield {}
        return
    numbers = [getattr(signal, name) for name in STOP_SIGNALS if hasattr(signal, name)]
    # `nohup` ignores SIGHUP on purpose, so that an overnight data collection survives a dropped ssh
    # connection.
    numbers = [number for number in numbers if not _is_ignored_hangup(number)]
    before: _Handlers = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield before
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _is_ignored_hangup(number: signal.Signals) -> bool:
    return number.name == "SIGHUP" and signal.getsignal(number) is signal.SIG_IGN


def listen_to_keyboard(
    request: StopRequest, on_line: Callable[[str], None], stream: Iterable[str] | None = None
) -> threading.Thread:
    """Start a thread that reads the terminal: Enter alone requests a stop, and other lines are
    passed to `on_line`."""
    lines = sys.stdin if stream is None else stream

    def listen() -> None:
        with contextlib.suppress(OSError, ValueError):
            for line in lines:
                if not line.strip():
                    request.ask("emergency_stop", "stopped by a key")
                else:
                    with contextlib.suppress(Exception):
                        on_line(line.strip())

    return REAL.spawn(listen, "keyboard")


def discard_typed_ahead() -> None:
    """Discard keys typed before a question, if the input is a terminal."""
    with contextlib.suppress(ImportError, OSError):
        # Imported here because Windows does not have this module.
        import termios

        with contextlib.suppress(termios.error, TypeError, ValueError):
            termios.tcflush(sys.stdin, termios.TCIFLUSH)


SIGNAL_CHECK_S = 0.2
"""Maximum wait of the main thread for a lock [s]. The kernel may deliver a signal to a different
thread, which does not wake the main thread, where Python handles signals."""


class Watchdog:
    """A thread that stops the machine if the loop falls silent, e.g. because a controller hangs.

    C code that holds the GIL also blocks this thread. In this case, a rig drive stops the motor by
    itself: it faults (0x8130) after `drive.heartbeat_s` without a host heartbeat. ROS 2 topics have
    no such protection: the driver of the fin must detect missing commands.
    """

    def __init__(
        self, longest_s: float, on_silence: Callable[[float], None], clock: Clock = REAL
    ) -> None:
        self._longest = longest_s
        self._on_silence = on_silence
        self._clock = clock
        self._fed = clock()
        self._ended = clock.event()
        clock.spawn(self._watch, "watchdog")

    def feed(self, now: float) -> None:
        """Register a tick of the loop at time `now` [s]."""
        self._fed = now

    def end(self) -> None:
        """Stop watching."""
        self._ended.set()

    def _watch(self) -> None:
        set_priority(WATCHDOG, self._clock)
        # Check four times per timeout, so that the stop is late by at most a quarter of the
        # timeout.
        while not self._ended.wait(self._longest / 4):
            silence = self._clock() - self._fed
            if silence > self._longest:
                self._on_silence(silence)
                return
