"""Logs at 100 Hz in; statistics of each of them, and all that is wrong with them, out."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from softfin.core.progress import Progress
from softfin.data.checks.alignment import Lag
from softfin.data.checks.channels import channels_in_degrees, columns_of, without_spikes
from softfin.data.checks.checks import CHANNEL_CHECKS, DATASET_CHECKS, STATISTICS_CHECKS, CheckedLog, check_lags
from softfin.data.checks.statistics import LogStatistics, measure, measure_together
from softfin.data.importing.importing import FORCE_FRAMES, ImportConfig
from softfin.data.importing.recording import NamedLog
from softfin.data.issues import SEVERITIES, Issue, merge_issues


@dataclasses.dataclass(frozen=True)
class Inspection:
    """Issues, gravest first, and the statistics that they rest on."""

    issues: list[Issue]
    logs: list[LogStatistics]

    def summary(self) -> dict[str, Any]:
        """Amount of data, columns as read, lags [ms] and correlations of frames over all logs, and counts of issues."""
        frames = [one.frames for one in self.logs if one.frames is not None]
        return {
            "logs": sum(one.part == "train" for one in self.logs),
            "test_logs": sum(one.part == "test" for one in self.logs),
            "rows": sum(one.rows for one in self.logs),
            "columns": {one.log: one.message for one in self.issues if one.name == "columns"},
            "command_lag_ms": _spread([one.command_lag for one in self.logs]),
            "force_lag_ms": _spread([one.force_lag for one in self.logs]),
            "frames": {frame: float(np.mean([one[frame] for one in frames])) for frame in FORCE_FRAMES}
            if frames
            else None,
            "counts": {kind: sum(one.severity == kind for one in self.issues) for kind in SEVERITIES},
        }

    def to_dict(self) -> dict[str, Any]:
        """The inspection for JSON."""
        return {
            "summary": self.summary(),
            "issues": [issue.to_dict() for issue in self.issues],
            "logs": [statistics.to_dict() for statistics in self.logs],
        }


def inspect(
    logs: Sequence[NamedLog],
    issues: Iterable[Issue] = (),
    config: ImportConfig | None = None,
    progress: Progress | None = None,
) -> Inspection:
    """Check logs; `issues` are those that were met when they were read with `config`."""
    config = config or ImportConfig()
    found = list(issues)
    statistics, short = [], []
    for index, named in enumerate(logs):
        log = _prepared(named, config)
        found += [issue for check in (*CHANNEL_CHECKS, *STATISTICS_CHECKS) for issue in check(log)]
        statistics.append(log.statistics)
        if log.statistics.command_lag is None or log.statistics.force_lag is None:
            short.append(log)
        if progress is not None:
            progress("inspect", (index + 1) / len(logs), f"{index + 1:,} of {len(logs):,} logs")
    if len(short) == len(logs) > 1:
        together = measure_together([log.calm for log in short], statistics[0].part)
        pooled = short[0]._replace(statistics=together)
        found += [issue for check in STATISTICS_CHECKS for issue in check(pooled)]
        found += check_lags([together], config)
    found += [*check_lags(statistics, config), *(issue for check in DATASET_CHECKS for issue in check(logs))]
    return Inspection(merge_issues(found), statistics)


def _prepared(named: NamedLog, config: ImportConfig) -> CheckedLog:
    """Repair the channels where one fault would hide the next."""
    raw = columns_of(named.log)
    wrong = channels_in_degrees(raw, config.velocity_rad_s is not None)
    columns = raw._replace(**{channel: np.radians(getattr(raw, channel)) for channel in wrong})
    calm = without_spikes(columns)
    statistics = measure(calm, named.name, named.part, float(named.log.reading.time[0]))
    return CheckedLog(raw, columns, calm, statistics, config)


def _spread(lags: Sequence[Lag | None]) -> dict[str, float] | None:
    values = np.array([lag.milliseconds for lag in lags if lag is not None])
    if not values.size:
        return None
    spread = {"median": np.median(values), "least": values.min(), "most": values.max(), "std": values.std()}
    return {name: round(float(value), 1) for name, value in spread.items()}
