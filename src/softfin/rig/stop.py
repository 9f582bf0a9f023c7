"""Ways to stop a moving fin besides the safety limits: signals, a key on the terminal, a watchdog
above the loop."""

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
"""The signals that stop the fin; the last is Ctrl-Z: a program that sleeps watches over nothing."""

PATIENCE_S = 2.0
"""Time within which a second signal must not disturb the stop that the first one began: people
press Ctrl-C twice [s].
"""


class StopRequest:
    """A flag that any thread or signal handler may raise; the first reason counts."""

    def __init__(self) -> None:
        self.trip: Trip | None = None
        self.is_obeyed = False
        """Whether the machine is being stopped, which is bounded in time: no signal must break that
        off."""

    def ask(self, cause: str, reason: str) -> None:
        """Ask for a stop."""
        if self.trip is None:
            self.trip = Trip(cause, reason)


@contextmanager
def stopped_by_signals(request: StopRequest) -> Iterator[None]:
    """Ctrl-C and its kin raise the flag, instead of an exception somewhere in the loop; only in the
    main thread."""
    asked: list[float] = []

    def handle(number: int, _: FrameType | None) -> None:
        name = signal.Signals(number).name
        asked.append(time.monotonic())
        if asked[-1] - asked[0] > PATIENCE_S and not request.is_obeyed:
            # The first one was not obeyed, as while figures are drawn: now the program ends as
            # others do.
            raise KeyboardInterrupt
        request.ask("emergency_stop", f"stopped by {'Ctrl-C' if name == 'SIGINT' else name}")

    with _handling_signals(handle):
        yield


@contextmanager
def interrupted_by_signals() -> Iterator[None]:
    """The first of Ctrl-C and its kin raises KeyboardInterrupt, so that what powers a motor ends by
    stopping it.

    Later ones are ignored: they would break the stop off, which is bounded in time.
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
    """Have the signals that stop the fin handled; only in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [getattr(signal, name) for name in STOP_SIGNALS if hasattr(signal, name)]
    # Under nohup the end of the terminal is ignored on purpose: a night's collection must survive a
    # dropped ssh.
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
    """Discard what was typed before a question was asked, if a terminal is there."""
    with contextlib.suppress(ImportError, OSError):
        # Imported here: there is none on Windows.
        import termios

        with contextlib.suppress(termios.error, TypeError, ValueError):
            termios.tcflush(sys.stdin, termios.TCIFLUSH)


SIGNAL_CHECK_S = 0.2
"""Longest time for which the main thread waits for a lock [s]. The kernel may give a signal to
another thread, which does not wake the main thread, where Python handles it."""


class Watchdog:
    """A thread that stops the machine when the loop is silent, as where a controller waits for
    ever.

    A loop that is stuck in C code which holds the interpreter's lock stops this thread, too. Then
    the rig's drive stops the motor itself: without the host's heartbeat for `drive.heartbeat_s` it
    faults (0x8130). Behind ROS 2's topics nothing like it exists: the fin's driver has to notice
    missing commands.
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
        """Watch no more."""
        self._ended.set()

    def _watch(self) -> None:
        while not self._ended.wait(self._longest / 4):
            silence = self._clock() - self._fed
            if silence > self._longest:
                self._on_silence(silence)
                return
