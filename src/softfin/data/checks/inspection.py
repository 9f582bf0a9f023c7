"""Logs at 100 Hz in; what each of them says of itself, and all that is wrong with them, in words, out.

`faults` judges single channels, `measurement` measures how they belong together, `judgement` judges that.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from softfin.data.checks import faults
from softfin.data.checks.faults import Columns, columns_of
from softfin.data.checks.findings import SEVERITIES, Finding, merged
from softfin.data.checks.judgement import covered, judge_all, judge_lags, judge_one
from softfin.data.checks.measurement import Facts, measured, pooled
from softfin.data.importing.alignment import Lag
from softfin.data.importing.importing import FORCE_FRAMES, ImportConfig
from softfin.data.importing.recording import NamedLog


@dataclasses.dataclass(frozen=True)
class Inspection:
    """Findings, gravest first, and the measurements that they rest on."""

    findings: list[Finding]
    logs: list[Facts]

    def summary(self) -> dict[str, Any]:
        """Over all logs: how much there is, how columns were read, how the clocks lie [ms], which frame fits best."""
        frames = [one.frames for one in self.logs if one.frames is not None]
        return {
            "logs": sum(one.part == "train" for one in self.logs),
            "test_logs": sum(one.part == "test" for one in self.logs),
            "rows": sum(one.rows for one in self.logs),
            "columns": {one.place.log: one.sentence for one in self.findings if one.name == "columns"},
            "command_lag_ms": _spread([one.command_lag for one in self.logs]),
            "force_lag_ms": _spread([one.force_lag for one in self.logs]),
            "frames": {frame: float(np.mean([one[frame] for one in frames])) for frame in FORCE_FRAMES}
            if frames
            else None,
            "counts": {kind: sum(one.severity == kind for one in self.findings) for kind in SEVERITIES},
        }

    def described(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "summary": self.summary(),
            "findings": [finding.described() for finding in self.findings],
            "logs": [facts.described() for facts in self.logs],
        }


def _spread(lags: Sequence[Lag | None]) -> dict[str, float] | None:
    known = np.array([lag.milliseconds for lag in lags if lag is not None])
    if not known.size:
        return None
    values = {"median": np.median(known), "least": known.min(), "most": known.max(), "std": known.std()}
    return {name: round(float(value), 1) for name, value in values.items()}


Progress = Callable[[int, int], None]


def inspect(
    logs: Sequence[NamedLog],
    findings: Iterable[Finding] = (),
    config: ImportConfig | None = None,
    progress: Progress | None = None,
) -> Inspection:
    """Judge logs; `findings` are those of their reading, with `config`."""
    config = config or ImportConfig()
    found = list(findings)
    facts, short = [], []
    for index, log in enumerate(logs):
        columns, wrong = _channels(log, config)
        one = measured(log, columns)
        found += [*wrong, *judge_one(one, config)]
        facts.append(one)
        if one.command_lag is None or one.force_lag is None:
            short.append(columns)
        if progress is not None:
            progress(index + 1, len(logs))
    if len(short) == len(logs) > 1:
        together = pooled(facts, short)
        found += [*judge_one(together, config), *judge_lags([together], config)]
    return Inspection(merged([*found, *judge_all(facts, config), *covered(logs)]), facts)


def _channels(log: NamedLog, config: ImportConfig) -> tuple[Columns, list[Finding]]:
    """The log's channels, repaired where a fault would hide the next, and the faults."""
    columns, in_degrees = faults.in_degrees(columns_of(log.log), log.name, config.velocity_rad_s is not None)
    checks = (faults.stuck, faults.saturated, faults.coarse, faults.velocity, faults.commanded_velocity)
    found = [finding for check in checks for finding in check(columns, log.name)]
    columns, spikes = faults.without_spikes(columns, log.name)
    return columns, [*in_degrees, *spikes, *faults.jumps(columns, log.name), *found]
