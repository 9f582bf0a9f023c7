"""Ways to stop a moving fin besides the safety limits: signals, a key on the terminal, a watchdog
on the loop."""

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType

from softfin.core.clock import REAL, Clock
from softfin.rig.safety import Trip

STOP_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP")
"""Signals that stop the fin; the last is Ctrl-Z, because a suspended program cannot watch it."""

PATIENCE_S = 2.0
"""Time within which a second signal must not interrupt the stop that the first one started [s]:
people press Ctrl-C twice.
"""


class StopRequest:
    """A flag that any thread or signal handler may raise; the first reason counts."""

    def __init__(self) -> None:
        self.trip: Trip | None = None
        self.is_obeyed = False
        """Whether the machine is being stopped. That takes a bounded time, and no signal may
        interrupt it."""

    def ask(self, cause: str, reason: str) -> None:
        """Ask for a stop."""
        if self.trip is None:
            self.trip = Trip(cause, reason)


@contextmanager
def stopped_by_signals(request: StopRequest) -> Iterator[None]:
    """Make stop signals raise the flag, instead of an exception somewhere in the loop; only in the
    main thread."""
    asked: list[float] = []

    def handle(number: int, _: FrameType | None) -> None:
        name = signal.Signals(number).name
        asked.append(time.monotonic())
        if asked[-1] - asked[0] > PATIENCE_S and not request.is_obeyed:
            # The first one was not obeyed, for example because figures are being drawn. Now the
            # program ends like any other.
            raise KeyboardInterrupt
        request.ask("emergency_stop", f"stopped by {'Ctrl-C' if name == 'SIGINT' else name}")

    with _handling_signals(handle):
        yield


@contextmanager
def interrupted_by_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt at the first stop signal, so that code that powers a motor can stop
    it.

    Later signals are ignored: they would interrupt the stop, which takes a bounded time.
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
def _handling_signals(handle: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Install a handler for the stop signals; only in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [getattr(signal, name) for name in STOP_SIGNALS if hasattr(signal, name)]
    # nohup ignores SIGHUP on purpose: an overnight collection must survive a dropped ssh
    # connection.
    numbers = [number for number in numbers if not _is_ignored_hangup(number)]
    before = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _is_ignored_hangup(number: signal.Signals) -> bool:
    return number.name == "SIGHUP" and signal.getsignal(number) is signal.SIG_IGN


def listen_to_keyboard(
    request: StopRequest, on_line: Callable[[str], None], stream: Iterable[str] | None = None
) -> threading.Thread:
    """Start a thread that reads a terminal: Enter alone asks for a stop, other lines go to
    `on_line`."""
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
    """Discard what was typed before a question, if the input is a terminal."""
    with contextlib.suppress(ImportError, OSError):
        # Imported here: there is none on Windows.
        import termios

        with contextlib.suppress(termios.error, TypeError, ValueError):
            termios.tcflush(sys.stdin, termios.TCIFLUSH)


SIGNAL_CHECK_S = 0.2
"""Longest time for which the main thread waits for a lock [s]. The kernel may deliver a
signal to another thread. That does not wake the main thread, in which Python handles signals."""


class Watchdog:
    """A thread that stops the machine when the loop is silent, for example because a controller
    hangs.

    C code that holds the interpreter's lock blocks this thread as well. Then the rig's drive stops
    the motor by itself: it faults (0x8130) after `drive.heartbeat_s` without the host's heartbeat.
    ROS 2 topics have no such protection: the fin's driver has to notice missing commands.
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
        """Note that the loop is alive."""
        self._fed = now

    def end(self) -> None:
        """Stop watching."""
        self._ended.set()

    def _watch(self) -> None:
        while not self._ended.wait(self._longest / 4):
            silence = self._clock() - self._fed
            if silence > self._longest:
                self._on_silence(silence)
                return
