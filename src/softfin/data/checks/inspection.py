"""Logs at 100 Hz in; statistics of each of them, and all that is wrong with them, out."""

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
    measure,
    to_columns,
    without_spikes,
)
from softfin.data.importing.clocks import NamedLog
from softfin.data.importing.importing import FORCE_FRAMES, ImportConfig
from softfin.data.issues import SEVERITIES, Issue, merge_issues

POOLED = 100
"""Most logs that are checked together where each alone is too short for its sign, axes and lags."""


@dataclasses.dataclass(frozen=True)
class Inspection:
    """Issues, gravest first, and the statistics that they rest on."""

    issues: list[Issue]
    logs: list[LogStatistics]

    def summary(self) -> JsonObject:
        """Amount of data, columns as read, lags [ms] and correlations of frames over all logs, and
        counts of issues."""
        frames = [one.frames for one in self.logs if one.frames is not None]
        parts = [one.part for one in self.logs]
        return {
            "logs": parts.count("train"),
            "test_logs": parts.count("test"),
            "rows": sum(one.rows for one in self.logs),
            "columns": {one.log: one.message for one in self.issues if one.name == "columns"},
            "command_lag_ms": _spread([one.command_lag_ms for one in self.logs]),
            "force_lag_ms": _spread([one.force_lag_ms for one in self.logs]),
            "frames": {
                name: float(np.mean([one[name] for one in frames]))
                for name in FORCE_FRAMES
                if frames
            }
            or None,
            "counts": {
                kind: sum(one.severity == kind for one in self.issues) for kind in SEVERITIES
            },
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
    """Check logs; `issues` are those that were met when they were read with `config`."""
    config = config or ImportConfig()
    found = list(issues)
    statistics = []
    series = []
    comparable: list[LogStatistics] = []
    for index, named in enumerate(logs):
        # Channels are repaired where one fault would hide the next.
        raw = to_columns(named.log)
        in_degrees = channels_in_degrees(raw, config.velocity_rad_s is not None)
        columns = raw._replace(
            **{channel: np.radians(getattr(raw, channel)) for channel in in_degrees}
        )
        # Not the velocity, which is mostly a difference of angles, and rough by nature.
        rough = {
            channel: without_spikes(getattr(columns, channel))
            for channel in ("angle", "force_x", "force_y")
        }
        calm = columns._replace(**rough)
        statistics.append(measure(calm, named))
        log = CheckedLog(raw, columns, calm, statistics[-1], config)
        in_counts = list(check_counts(log))
        if in_counts:
            # As long as an angle's scale and zero are unknown, no other check means anything.
            found += in_counts
        else:
            series.append(calm)
            comparable.append(statistics[-1])
            found += [issue for check in LOG_CHECKS for issue in check(log)]
        if progress is not None:
            progress("inspect", (index + 1) / len(logs), f"{index + 1:,} of {len(logs):,} logs")
    if len(comparable) > 1 and all(one.rows < MIN_ALIGNED_S * RATE_HZ for one in comparable):
        # Short logs end to end: the seams are few beside the steps within.
        joined = LogColumns(*map(np.concatenate, zip(*series[:POOLED], strict=True)))
        together = measure(
            joined, logs[0]._replace(name=f"the first {len(series[:POOLED])} logs together")
        )
        pooled = CheckedLog(joined, joined, joined, together, config)
        found += [
            *check_following(pooled),
            *check_force_axes(pooled),
            *check_lags([together], config),
        ]
    issues = [*found, *check_lags(comparable, config), *check_dataset(logs)]
    return Inspection(merge_issues(issues), statistics)


def _spread(lags: Sequence[float | None]) -> dict[str, float] | None:
    values = [lag for lag in lags if lag is not None]
    if not values:
        return None
    spread = {"median": float(np.median(values)), "least": min(values), "most": max(values)}
    return {name: round(value, 1) for name, value in spread.items()}
