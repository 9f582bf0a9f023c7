"""Ticks on a clock that may have begun anywhere: a log's own, a computer's, that of somebody else's recorder."""

from softfin.core.quantities import RATE_HZ

DAY = 24 * 3600 * RATE_HZ
"""Ticks. A plant counts them in 32 bits and tells its time in single precision: Unix time fits into neither."""


def tick_at(time_s: float) -> int:
    """The tick at a time, counted within the day."""
    return round(time_s * RATE_HZ) % DAY
