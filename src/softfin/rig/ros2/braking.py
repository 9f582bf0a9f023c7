"""Stops a fin behind ROS 2 topics by sending braking messages until the fin is at rest.

A separate thread sends each kind of message, and one thread reads the fin. If a thread hangs in the
transport, the stop still returns in time, and the other messages are sent.
"""

import contextlib
import functools
from collections.abc import Callable, Sequence

from softfin.core.clock import Clock

STOP_S = 0.5
"""Maximum wait for the fin to come to rest [s]; a fin that keeps moving is reported."""

REPEAT_S = 0.02
"""Time between messages of the same kind [s]; a driver that misses a message receives the next one
within two ticks."""

LOOK_S = 0.005
"""Time between readings of the fin [s]."""

REST_S = 0.1
"""Time without rotation after which a fin is treated as at rest [s]: ten readings at 100 Hz."""

REST_RAD = 0.01
"""Angle by which a fin at rest may move during this time [rad]; it corresponds to 0.1 rad/s and
exceeds encoder noise."""


def brake(
    clock: Clock, sends: Sequence[Callable[[], None]], look: Callable[[], tuple[float, float]]
) -> bool:
    """Send messages until the fin is at rest, for at most `STOP_S`; return whether it is at rest.

    Each function in `sends` sends one message. `look` returns the time [s] and angle [rad] of the
    latest reading. All these functions may raise errors or hang.
    """
    is_over = clock.event()
    at_rest = clock.event()

    def repeat(send: Callable[[], None]) -> None:
        while not is_over.is_set():
            # If sending fails, it may succeed the next time.
            with contextlib.suppress(Exception):
                send()
            is_over.wait(REPEAT_S)

    def watch() -> None:
        # The reading since which the fin has not turned; a repeated reading changes nothing.
        since: tuple[float, float] | None = None
        while not is_over.is_set():
            with contextlib.suppress(Exception):
                time, angle = look()
                if since is None or abs(angle - since[1]) > REST_RAD:
                    since = (time, angle)
                if time - since[0] >= REST_S:
                    at_rest.set()
                    return
            is_over.wait(LOOK_S)

    try:
        for send in sends:
            clock.spawn(functools.partial(repeat, send), "stop")
        clock.spawn(watch, "rest")
        return at_rest.wait(STOP_S)
    except RuntimeError:
        # Stop the fin even if the computer cannot start a thread.
        for send in sends:
            with contextlib.suppress(Exception):
                send()
        return False
    finally:
        is_over.set()
