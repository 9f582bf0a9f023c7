"""What a session read, as a Log at 100 Hz: both devices on one grid of time, whatever the jitter of the loop was."""

from collections.abc import Sequence

import numpy as np

from softfin.core.errors import DeviceError
from softfin.core.quantities import TICK_S, Command, Log, Reading
from softfin.data.importing.resample import held, interpolated
from softfin.rig.machine import Sample, Target

GAP_S = 0.05
"""Longest gap between two readings of a device that is bridged [s]; a fin at 3 Hz moves smoothly for as long."""

Issued = Sequence[tuple[float, Target]]
"""Commands with the times at which they were issued [s]."""


def log_of(samples: Sequence[Sample], issued: Issued, rows: int, gap_s: float = GAP_S) -> Log:
    """The rows from the first sample on; raises DeviceError where the samples end early or have a longer gap.

    The force of a moment is known only after its filter, so a few samples more than rows are needed.
    """
    grid = samples[0].time + TICK_S * np.arange(rows)
    joint = _track([(s.time, s.angle, s.velocity) for s in samples], grid, "angle", gap_s)
    force = _track([(s.force_time, s.wrench[0], s.wrench[1]) for s in samples], grid, "force", gap_s)
    times = np.array([time for time, _ in issued])
    angle, velocity = (np.array([getattr(target, name) for _, target in issued]) for name in Target._fields)
    command = Command(*(held(times, channel, grid).astype(np.float32) for channel in (angle, velocity)))
    seconds = TICK_S * np.arange(1, rows + 1)
    return Log(command, Reading(seconds, joint[0], joint[1], np.stack(force, axis=1)))


def _track(points: list[tuple[float, float, float]], grid: np.ndarray, name: str, gap_s: float) -> list[np.ndarray]:
    rows = np.array(points)
    rows = rows[np.concatenate([[True], np.diff(rows[:, 0]) > 0])]
    time = rows[:, 0]
    within = time[(time > grid[0]) & (time < grid[-1])]
    gaps = np.diff(np.concatenate([[min(time[0], grid[0])], within, [grid[-1]]]))
    if time[0] > grid[0] + gap_s or time[-1] < grid[-1] or gaps.max() > gap_s:
        place = grid[0] if time[0] > grid[0] + gap_s else grid[0] + gaps[: gaps.argmax()].sum()
        raise DeviceError(
            f"no {name} for {gaps.max() * 1e3:.0f} ms at {place - grid[0]:.2f} s of the log: at most "
            f"{gap_s * 1e3:.0f} ms; see softfin rig check, and record this log again with --resume"
        )
    return [interpolated(time, rows[:, i], grid).astype(np.float32) for i in (1, 2)]
