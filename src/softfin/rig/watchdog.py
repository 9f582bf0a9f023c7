"""A watchdog above the loop: a loop that does not tick any more must not keep the fin moving.

It is a thread of the same Python interpreter. A loop that is stuck in C code which holds the interpreter's lock stops
this thread, too, as a stopped process or a computer that hangs does. Then the rig's drive stops the motor itself: the
loop's own thread sends the host's heartbeat, and without it for `drive.heartbeat_s` the drive faults (0x8130). Behind
ROS 2's topics there is no such heartbeat: the fin's driver has to notice that commands are missing.
"""

from collections.abc import Callable

from softfin.core.clock import REAL, Clock
from softfin.rig.safety import SafetyConfig


class Watchdog:
    """A thread that stops the machine when the loop is silent, as where a controller waits for ever."""

    def __init__(self, config: SafetyConfig, bite: Callable[[float], None], clock: Clock = REAL) -> None:
        self._silence, self._bite, self._clock = config.watchdog_s, bite, clock
        self._fed = clock()
        self._ended = clock.event()
        clock.spawn(self._watch, "watchdog")

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
