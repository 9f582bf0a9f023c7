"""A watchdog above the loop: whatever keeps the loop from ticking must not keep the fin moving."""

import threading
import time
from collections.abc import Callable

from softfin.deployment.safety import SafetyConfig


class Watchdog:
    """A thread that stops the machine when the loop is silent: a controller that hangs must not leave it moving."""

    def __init__(
        self, config: SafetyConfig, bite: Callable[[float], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._silence, self._bite, self._clock = config.watchdog_s, bite, clock
        self._fed = clock()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        self._thread.start()

    def feed(self, now: float) -> None:
        """The loop is alive."""
        self._fed = now

    def end(self) -> None:
        """Watch no more."""
        self._ended.set()

    def _watch(self) -> None:
        while not self._ended.wait(self._silence / 4):
            silence = self._clock() - self._fed
            if silence > self._silence:
                self._bite(silence)
                return
