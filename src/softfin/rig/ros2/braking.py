"""A stop of a fin made of topics: messages that brake it, sent again and again until the fin is
seen at rest.

Whatever hangs in the transport, a send or a look at the fin, hangs in a thread of its own: the stop
returns in time, and the other messages go out.
"""

import contextlib
import functools
from collections.abc import Callable, Sequence

from softfin.core.clock import Clock

STOP_S = 0.5
"""Longest wait for the fin to come to rest [s]; one that goes on is reported."""

REPEAT_S = 0.02
"""Time between two messages of one kind [s]: a driver that misses one hears the next within two
ticks."""

LOOK_S = 0.005
"""Time between two looks at the fin [s]."""

REST_S = 0.1
"""Time for which a fin must not turn to count as at rest [s]: ten readings of a driver at 100
Hz."""

REST_RAD = 0.01
"""Angle within which a fin at rest stays meanwhile [rad]: 0.1 rad/s, and more than the noise of an
encoder."""


class RestWatch:
    """Judges by new readings whether a fin is at rest."""

    def __init__(self) -> None:
        self._since: tuple[float, float] | None = None

    def is_at_rest(self, time: float, angle: float) -> bool:
        """Take a reading, at a time [s] and an angle [rad]; the same one again proves nothing."""
        if self._since is None or abs(angle - self._since[1]) > REST_RAD:
            self._since = (time, angle)
        return time - self._since[0] >= REST_S


def brake(
    clock: Clock, sends: Sequence[Callable[[], None]], look: Callable[[], tuple[float, float]]
) -> bool:
    """Send messages until the fin is at rest, for `STOP_S` at most; return whether it is.

    Each of `sends` sends one message. `look` returns time [s] and angle [rad] of the newest
    reading. Both may raise and hang.
    """
    is_over = clock.event()
    at_rest = clock.event()

    def repeat(send: Callable[[], None]) -> None:
        while not is_over.is_set():
            # A send that failed may succeed the next time.
            with contextlib.suppress(Exception):
                send()
            is_over.wait(REPEAT_S)

    def watch() -> None:
        rest = RestWatch()
        while not is_over.is_set():
            with contextlib.suppress(Exception):
                if rest.is_at_rest(*look()):
                    at_rest.set()
                    return
            is_over.wait(LOOK_S)

    try:
        for send in sends:
            clock.spawn(functools.partial(repeat, send), "stop")
        clock.spawn(watch, "rest")
        return at_rest.wait(STOP_S)
    except RuntimeError:
        # A computer that cannot start a thread must stop its fin nevertheless.
        for send in sends:
            with contextlib.suppress(Exception):
                send()
        return False
    finally:
        is_over.set()
