"""Logs at 100 Hz go in; out come the statistics of each log and everything wrong with it."""

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
)
from softfin.data.checks.statistics import (
    LogColumns,
    LogStatistics,
    channels_in_degrees,
    known_lags,
    measure,
    to_columns,
    without_spikes,
)
from softfin.data.importing.clocks import NamedLog
from softfin.data.importing.importing import FORCE_FRAMES, ImportConfig
from softfin.data.issues import SEVERITIES, Issue, merge_issues

POOLED = 100
"""Largest number of logs that are checked together if each alone is too short to find its signs,
axes and lags."""


@dataclasses.dataclass(frozen=True)
class Inspection:
    """Issues, most severe first, and the statistics behind them."""

    issues: list[Issue]
    logs: list[LogStatistics]

    def summary(self) -> JsonObject:
        """Amount of data, columns as read, lags [ms] and correlations of frames over all logs, and
        counts of issues."""
        found = [one.frames for one in self.logs if one.frames is not None]
        frames = {}
        for name in FORCE_FRAMES if found else ():
            frames[name] = float(np.mean([one[name] for one in found]))
        parts = [one.part for one in self.logs]
        severities = [one.severity for one in self.issues]
        return {
            "logs": parts.count("train"),
            "test_logs": parts.count("test"),
            "rows": sum(one.rows for one in self.logs),
            "columns": {one.log: one.message for one in self.issues if one.name == "columns"},
            "command_lag_ms": _spread(known_lags(self.logs, "command")),
            "force_lag_ms": _spread(known_lags(self.logs, "force")),
            "frames": frames or None,
            "counts": {kind: severities.count(kind) for kind in SEVERITIES},
        }

    def to_dict(self) -> JsonObject:
        """The inspection for JSON."""
        return {"summary": self.summary(), **dataclasses.asdict(self)}


def inspect(
    logs: Sequence[NamedLog],
    issues: Iterable[Issue] = (),
    config: ImportConfig | None = None,
    progress: Progress | None = None,
) -> Inspection:
    """Check logs; `issues` are those found while reading them with `config`."""
    config = config or ImportConfig()
    found = list(issues)
    statistics = []
    series = []
    comparable: list[LogStatistics] = []
    for index, named in enumerate(logs):
        # Channels are repaired so that one fault does not hide the next.
        raw = to_columns(named.log)
        columns = raw
        for channel in channels_in_degrees(raw, config.velocity_rad_s is not None):
            columns = columns._replace(**{channel: np.radians(getattr(raw, channel))})
        # Not the velocity, which is usually a difference of angles and therefore noisy.
        calm = columns._replace(
            angle=without_spikes(columns.angle),
            force_x=without_spikes(columns.force_x),
            force_y=without_spikes(columns.force_y),
        )
        statistics.append(measure(calm, named))
        log = CheckedLog(raw, columns, calm, statistics[-1], config)
        in_counts = list(check_counts(log))
        if in_counts:
            # While an angle's scale and zero are unknown, no other check is meaningful.
            found += in_counts
        else:
            series.append(calm)
            comparable.append(statistics[-1])
            for check in LOG_CHECKS:
                found += check(log)
        if progress is not None:
            progress("inspect", (index + 1) / len(logs), f"{index + 1:,} of {len(logs):,} logs")
    if len(comparable) > 1 and all(one.rows < MIN_ALIGNED_S * RATE_HZ for one in comparable):
        # Short logs are joined end to end; there are few joints compared with steps.
        joined = LogColumns(*map(np.concatenate, zip(*series[:POOLED], strict=True)))
        together = measure(
            joined, logs[0]._replace(name=f"the first {len(series[:POOLED])} logs together")
        )
        pooled = CheckedLog(joined, joined, joined, together, config)
        found += check_following(pooled)
        found += check_force_axes(pooled)
        found += check_lags([together], config)
    issues = [*found, *check_lags(comparable, config), *check_dataset(logs)]
    return Inspection(merge_issues(issues), statistics)


def _spread(measured: Sequence[tuple[float, str]]) -> dict[str, float] | None:
    if not measured:
        return None
    lags, _ = zip(*measured, strict=True)
    return {
        "median": round(float(np.median(lags)), 1),
        "least": round(min(lags), 1),
        "most": round(max(lags), 1),
    }
