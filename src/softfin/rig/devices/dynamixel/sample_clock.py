"""Age of servo responses, from the servo clock in them."""

from softfin.rig.devices.dynamixel.protocol import TICK_RANGE, TICK_UNIT_S

LATE_S = 0.004
"""Time by which an answer may be older than its request, as estimated [s]."""

DRIFT = 0.02
"""Largest assumed difference between the rates of the two clocks."""

FORGOTTEN_S = 5.0
"""Time after which the estimate starts again [s]; the servo clock restarts every 33 s."""


class SampleClock:
    """Detects responses to earlier requests: a packet does not identify its request, and a USB
    adapter or a busy computer may deliver it after the next request."""

    def __init__(self) -> None:
        self._sent: float | None = None
        self._tick = 0
        self._lead = 0.0
        """Age of the latest answer compared with the oldest accepted one [s]; at most 0. `DRIFT`
        makes the estimate forget the oldest one."""

    def is_late(self, sent: float, tick: int) -> bool:
        """Return whether a sample with the servo time `tick` [ms] is older than the request that
        was sent at `sent` [s]."""
        if self._sent is None or sent - self._sent > FORGOTTEN_S:
            lead = 0.0
        else:
            ticks = (tick - self._tick + TICK_RANGE // 2) % TICK_RANGE - TICK_RANGE // 2
            host_s = sent - self._sent
            lead = self._lead + host_s - ticks * TICK_UNIT_S
            # A clock that runs fast must not hide a late answer.
            lead += DRIFT * host_s
            if lead > LATE_S + 2 * DRIFT * host_s:
                return True
        self._sent = sent
        self._tick = tick
        self._lead = min(lead, 0.0)
        return False
