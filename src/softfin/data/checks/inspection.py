"""Inspects logs at 100 Hz: computes the statistics of each log and lists its issues."""

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from softfin.core.json_object import JsonObject
from softfin.core.progress import Progress
from softfin.core.quantities import RATE_HZ
from softfin.data.checks.alignment import MIN_ALIGNED_S
from softfin.data.checks.checks import (
    LOG_CHECKS,
    CheckedLog,
    check_counts,
    check_dataset,
    check_following,
    check_force_axes,
    check_lags,
    check_speed,
)
from softfin.data.checks.signals import without_spikes
from softfin.data.checks.statistics import (
    LogColumns,
    LogStatistics,
    channels_in_degrees,
    known_lags,
    measure,
    to_columns,
)
from softfin.data.importing.clocks import NamedLog
from softfin.data.importing.importing import ANGLES, FORCE_FRAMES, ImportConfig
from softfin.data.issues import SEVERITIES, Issue, merge_issues

POOLED = 100
"""Maximum number of logs that are checked together if each log is too short to estimate signs, axes
and lags."""


@dataclasses.dataclass(frozen=True)
class Inspection:
    """Issues, most severe first, and the statistics behind them."""

    issues: list[Issue]
    logs: list[LogStatistics]

    def summary(self) -> JsonObject:
        """Return a summary of all logs: amount of data, columns, lags [ms], frame correlations,
        ranges of additional channels, and number of issues."""
        frames = _mean_frames(self.logs)
        columns = {}
        for issue in self.issues:
            if issue.name == "columns":
                columns[issue.log] = issue.message
        parts = []
        rows = 0
        channels: dict[str, tuple[float, float]] = {}
        for log in self.logs:
            parts.append(log.part)
            rows += log.rows
            for channel, (low, high) in log.channels.items():
                lowest, highest = channels.get(channel, (low, high))
                channels[channel] = (min(low, lowest), max(high, highest))
        severities = [one.severity for one in self.issues]
        return {
            "logs": parts.count("train"),
            "test_logs": parts.count("test"),
            "rows": rows,
            "columns": columns,
            "command_lag_ms": _spread(known_lags(self.logs, "command")),
            "force_lag_ms": _spread(known_lags(self.logs, "force")),
            "frames": frames,
            "channels": channels,
            "counts": {kind: severities.count(kind) for kind in SEVERITIES},
        }

    def to_dict(self) -> JsonObject:
        """Return the inspection as values for JSON."""
        return {"summary": self.summary(), **dataclasses.asdict(self)}


def inspect(
    logs: Sequence[NamedLog],
    issues: Iterable[Issue] = (),
    config: ImportConfig | None = None,
    progress: Progress | None = None,
) -> Inspection:
    """Check logs; `issues` were found while reading the logs with `config`."""
    config = config or ImportConfig()
    found = list(issues)
    statistics = []
    series = []
    comparable: list[LogStatistics] = []
    for index, named in enumerate(logs):
        # Later checks use repaired channels, so that one fault does not hide a different one.
        raw = to_columns(named.log)
        columns = raw
        for channel in channels_in_degrees(raw, config.velocity_rad_s is not None):
            columns = columns._replace(**{channel: np.radians(getattr(raw, channel))})
        # Spikes in the velocity are kept: it is usually a difference of angles and therefore noisy.
        calm = columns._replace(
            angle=without_spikes(columns.angle),
            force_x=without_spikes(columns.force_x),
            force_y=without_spikes(columns.force_y),
        )
        statistics.append(measure(calm, named))
        # Suggested options are added to the options from the file.
        of_file = {channel: named.units[channel] for channel in ANGLES if channel in named.units}
        angles = of_file | config.angles
        own = config.model_copy(update={"angles": angles})
        log = CheckedLog(raw, columns, calm, statistics[-1], own, named.log.channels)
        in_counts = list(check_counts(log))
        is_short = len(raw.angle) < RATE_HZ
        if in_counts or is_short:
            # No other check is meaningful while an angle's scale and zero are unknown, or within a
            # second.
            found += in_counts
        else:
            series.append(calm)
            comparable.append(statistics[-1])
            for check in LOG_CHECKS:
                found += check(log)
        if progress is not None:
            progress("inspect", (index + 1) / len(logs), f"{index + 1:,} of {len(logs):,} logs")
    if len(comparable) > 1 and all(one.rows < MIN_ALIGNED_S * RATE_HZ for one in comparable):
        # Short logs are joined end to end; there are few joins compared with command steps.
        pool = series[:POOLED]
        joined = LogColumns(*map(np.concatenate, zip(*pool, strict=True)))
        name = f"the first {len(pool)} logs together"
        together = measure(joined, logs[0]._replace(name=name))
        pooled = CheckedLog(joined, joined, joined, together, config)
        found += check_following(pooled)
        found += check_force_axes(pooled)
        found += check_speed(pooled)
        found += check_lags([together], config)
    issues = [*found, *check_lags(comparable, config), *check_dataset(logs)]
    return Inspection(merge_issues(issues), statistics)


def _mean_frames(logs: Sequence[LogStatistics]) -> dict[str, float] | None:
    """Return the mean correlation of each frame over all logs that are long enough."""
    found = [one.frames for one in logs if one.frames is not None]
    if not found:
        return None
    return {name: float(np.mean([one[name] for one in found])) for name in FORCE_FRAMES}


def _spread(measured: Sequence[tuple[float, str]]) -> dict[str, float] | None:
    if not measured:
        return None
    lags, _ = zip(*measured, strict=True)
    return {
        "median": round(float(np.median(lags)), 1),
        "least": round(min(lags), 1),
        "most": round(max(lags), 1),
    }
