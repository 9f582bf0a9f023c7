"""Estimates of the records missing from an evenly sampled stream, from the times of the received
records, and a warning about the share lost in a session."""

import math
from collections.abc import Mapping

MIN_CREDIT = 0.5
"""Credit that is due to jitter or to the error of the rate, not to a record that came early."""

CREDIT_RECORDS = 32
"""Number of records after which credit that none of them needed expires; no driver sends more at
once."""

WARNED_SHARE = 0.01
"""Minimum share of lost and unusable records for a warning."""


def explain_losses(counters: Mapping[str, int]) -> str | None:
    """Return a warning with the share of lost and unusable records; None below `WARNED_SHARE`."""
    unusable = counters.get("sensor_malformed", 0)
    # If records have numbers or timestamps, the lost ones already include the unusable ones.
    lost = max(counters.get("sensor_lost", 0), unusable)
    sent = counters.get("sensor_records", 0) - unusable + lost
    if lost < max(WARNED_SHARE * sent, 1):
        return None
    return (
        f"force sensor: {lost / sent:.0%} of its records were lost or unusable ({lost} of {sent}); "
        "check its cable, supply and network, then run: softfin rig check"
    )


def wrapped_step(before: int, after: int) -> int:
    """Return the difference of two 32-bit sequence numbers, allowing for wrap-around; negative if
    the number went backwards."""
    # Maps the difference to -2^31 .. 2^31 - 1.
    return (after - before + 2**31) % 2**32 - 2**31


class LossEstimate:
    """Estimates losses from times that may be late: records that wait for each other are stamped in
    a burst, and nothing is lost in the gap before the next burst.

    A record that arrives early increases the time allowed for the next gap. The credit is zero
    again once the records are on time, so that an error of the rate does not add up.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._credit = 0.0
        """Number of records by which the stream is ahead of its rate."""
        self._lowest = math.inf
        """Lowest credit since it was last checked for expiry."""
        self._num_records = 0
        """Number of records since then."""

    def missing(self, elapsed_s: float) -> int:
        """Return how many records are missing before the one that is `elapsed_s` later than its
        predecessor."""
        self._credit += 1 - elapsed_s * self._rate_hz
        missing = max(0, round(-self._credit))
        if self._credit < MIN_CREDIT:
            self._credit = 0.0
        self._lowest = min(self._lowest, self._credit)
        self._num_records += 1
        if self._num_records == CREDIT_RECORDS:
            self._credit -= self._lowest
            self._lowest = math.inf
            self._num_records = 0
        return missing
