"""Stroke time of a fin: the time that its shaft takes to reach a new commanded angle, estimated
from logs."""

from collections.abc import Sequence

import numpy as np

from softfin.core.quantities import TICK_S, Log

ARRIVED = 0.9
"""Fraction of the way to a commanded angle at which a stroke is treated as finished."""
MIN_STROKE_RAD = 0.3
"""Minimum change of angle that is treated as a stroke [rad]; smaller moves end before the drive has
accelerated."""
MIN_STROKES = 10
"""Minimum number of strokes for a median."""
SHORT_PERCENT = 1
"""Percentile of the time between two commands that is used as the minimum, because a few commands
may follow each other by accident."""


def stroke_time(logs: Sequence[Log]) -> float | None:
    """Return the median time from a new commanded angle until the shaft has covered 90% of the way
    [s]; None if the logs have fewer than 10 strokes, or if most of them were cut short.

    Strokes that are cut short by the next command are treated as longer than all others. The
    returned time is at least the minimum hold time of commands in the logs, because a surrogate
    cannot predict the force of faster strokes than those in its training data.
    """
    times = []
    holds: list[int] = []
    for log in logs:
        command = np.asarray(log.command.angle)
        angle = np.asarray(log.reading.angle)
        starts = np.flatnonzero(np.diff(command)) + 1
        holds += np.diff(starts).tolist()
        for start, end in zip(starts, [*starts[1:], len(command)], strict=True):
            way = command[start] - angle[start]
            if abs(way) < MIN_STROKE_RAD:
                continue
            arrived = np.flatnonzero((angle[start:end] - angle[start]) / way >= ARRIVED)
            times.append(arrived[0] * TICK_S if len(arrived) else np.inf)
    if len(times) < MIN_STROKES:
        return None
    median = float(np.median(times))
    shortest_s = TICK_S * float(np.percentile(holds, SHORT_PERCENT))
    return round(max(median, shortest_s), 3) if np.isfinite(median) else None
