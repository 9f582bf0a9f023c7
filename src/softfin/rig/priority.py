"""Real-time priority of the threads that must not be late, if the system allows it."""

import os

from softfin.core.clock import Clock

NORMAL = 0
LOOP = 10
"""Priority of the 100 Hz loop while the fin is active."""
WATCHDOG = LOOP + 1
"""The watchdog must also run if the loop never waits, even on a computer with one core."""


def set_priority(priority: int, clock: Clock) -> bool:
    """Run the calling thread before all programs of lower priority; new threads and processes start
    with normal priority. Return whether it was set; False in simulated time."""
    if clock.is_simulated or not hasattr(os, "SCHED_RESET_ON_FORK"):
        return False
    if os.sched_getparam(0).sched_priority > WATCHDOG:
        # The user has set a higher one, e.g. with chrt.
        return True
    policy = os.SCHED_FIFO if priority else os.SCHED_OTHER
    try:
        os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError:
        return False
    return True


def set_loop_priority(clock: Clock) -> bool:
    """Give the calling thread the priority of the loop, but only if the system also allows that of
    the watchdog."""
    return set_priority(WATCHDOG, clock) and set_priority(LOOP, clock)
