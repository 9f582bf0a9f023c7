import ctypes
import sys
import threading
import time

from softfin.rig.safety import SafetyConfig
from softfin.rig.watchdog import Watchdog

HANG_S = 0.15


def test_a_hang_that_holds_the_interpreters_lock_is_seen_only_when_it_is_over():
    bitten, silences = threading.Event(), []

    def bite(silence: float) -> None:
        silences.append(silence)
        bitten.set()

    dog = Watchdog(SafetyConfig(watchdog_s=0.05), bite)
    interval = sys.getswitchinterval()
    # Nothing but the call could let the watchdog's thread run.
    sys.setswitchinterval(60)
    try:
        dog.feed(time.monotonic())
        ctypes.PyDLL(None).usleep(round(HANG_S * 1e6))
        during = list(silences)
    finally:
        sys.setswitchinterval(interval)
    assert during == []
    assert bitten.wait(10)
    assert silences[0] >= HANG_S
