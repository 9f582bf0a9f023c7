"""How long the tests wait for whatever runs beside them in real time: processes, threads, sockets,
browsers.

A limit on waiting only ends a test that hangs. It must not fail a correct program because the
computer is slow or busy, so there is one limit for all, far above what the slowest of them takes.
"""

import time
from collections.abc import Callable

HANG_S = 600.0
"""Time after which something that a test waits for counts as hung [s]."""


def wait_until(is_true: Callable[[], object]) -> None:
    """Wait until it is true; fail when it hangs."""
    end = time.monotonic() + HANG_S
    while not is_true():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.002)
