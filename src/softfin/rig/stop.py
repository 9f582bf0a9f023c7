"""Who may say stop while the fin moves: signals, a key on the terminal, a topic, a device's own alarm."""

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from softfin.rig.safety import Trip

SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP")
"""The last is Ctrl-Z: a program that sleeps watches over nothing."""

PATIENCE_S = 2.0
"""A second signal within this must not disturb the stop that the first one began: people press Ctrl-C twice [s]."""


class StopRequest:
    """A flag that anybody may raise, from any thread or signal handler; the first reason counts."""

    def __init__(self) -> None:
        self.trip: Trip | None = None

    def ask(self, cause: str, reason: str) -> None:
        """Say stop."""
        if self.trip is None:
            self.trip = Trip(cause, reason)


@contextmanager
def stopped_by_signals(request: StopRequest) -> Iterator[None]:
    """Ctrl-C and its kin raise the flag, instead of an exception somewhere in the loop; only in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    asked: list[float] = []

    def handle(number: int, _: FrameType | None) -> None:
        name = signal.Signals(number).name
        asked.append(time.monotonic())
        if asked[-1] - asked[0] > PATIENCE_S:
            # Once said and not obeyed, as while figures are drawn: now it ends as programs do.
            raise KeyboardInterrupt
        request.ask("emergency_stop", f"stopped by {'Ctrl-C' if name == 'SIGINT' else name}")

    before: dict[int, Any] = {}
    for name in SIGNALS:
        if hasattr(signal, name):
            number = getattr(signal, name)
            before[number] = signal.signal(number, handle)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Keyboard:
    """Lines from a terminal: Enter alone says stop, other lines are handed on; ends with the process."""

    def __init__(self, request: StopRequest, line: Callable[[str], None], stream: Iterable[str] | None = None) -> None:
        self._request, self._line, self._stream = request, line, stream or sys.stdin
        self._thread = threading.Thread(target=self._listen, name="keyboard", daemon=True)

    def start(self) -> None:
        """From now on."""
        self._thread.start()

    def _listen(self) -> None:
        try:
            for line in self._stream:
                if not line.strip():
                    self._request.ask("emergency_stop", "stopped by a key")
                else:
                    with contextlib.suppress(Exception):
                        self._line(line.strip())
        except (OSError, ValueError):
            return
