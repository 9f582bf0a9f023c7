"""Fits the model that is asked for, or the best of several on logs that none of them was fitted to."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from softfin.core.configuration import Configuration
from softfin.core.errors import LogError
from softfin.core.quantities import RATE_HZ, Log
from softfin.storage.run_directory import RunDirectory
from softfin.surrogate.compare.free_running import free_run, segments_of, take
from softfin.surrogate.compare.metrics import rms
from softfin.surrogate.paper.fit import FitConfig, fit, split
from softfin.surrogate.store import AnySurrogate
from softfin.surrogate.streaming.fit import StreamingFit, fit_streaming
from softfin.surrogate.streaming.learner import StreamingConfig
from softfin.surrogate.streaming.streaming import MEMORY
from softfin.surrogate.training import Progress, check_lengths, held_out_count

HORIZON_S = 30
"""Time that candidates run free for, where a held-out log is as long [s]."""

SHORTEST_S = 10
"""Shortest part of a held-out log, behind what warms a candidate, that is not passed over for longer ones [s]."""


class AutoConfig(Configuration):
    """Three candidates: the paper's nets, streaming nets, and streaming nets to which the fin has no symmetry."""

    paper: FitConfig = FitConfig()
    """The paper's nets."""
    streaming: StreamingConfig = StreamingConfig()
    """Streaming nets; the third candidate is the same without `mirror` and `turning`."""

    def candidates(self) -> dict[str, FitConfig | StreamingConfig]:
        """Configurations by name, in order of preference where two are equally good; of equal ones the first."""
        free = {"drive": {"mirror": False}, "force": {"mirror": False, "turning": False}}
        without = self.streaming.merged(free, "streaming")
        return {
            "streaming": self.streaming,
            **({} if without == self.streaming else {"streaming, no symmetry": without}),
            "paper": self.paper,
        }


def fit_any(
    logs: Sequence[Log],
    config: FitConfig | StreamingConfig | AutoConfig,
    seed: int,
    run_directory: RunDirectory,
    progress: Progress | None = None,
) -> tuple[AnySurrogate, dict[str, Any] | None]:
    """Fit the model of the configuration; of several candidates the best, with the evidence for it (else None).

    The evidence: which was ``chosen``, the errors of each on ``held_out`` logs, how many of these, and why others were
    ``left_out``.
    """
    if isinstance(config, FitConfig):
        return fit(logs, config, seed, run_directory, progress), None
    if isinstance(config, StreamingConfig):
        return fit_streaming(logs, config, seed, run_directory, progress), None
    candidates, left_out = _possible(logs, config.candidates(), run_directory)
    # The shares may differ: the least share holds out what none was fitted to.
    holding = list(logs[-min(held_out_count(len(logs), one.held_out) for one in candidates.values()) :])
    first = max([MEMORY, *(one.posnet.window for one in candidates.values() if isinstance(one, FitConfig))])
    scored = _long_enough(holding, first)
    fitted = dict[str, AnySurrogate]()
    for number, (name, one) in enumerate(candidates.items()):
        report = None if progress is None else _part(progress, name, number, len(candidates))
        fitted[name], _ = fit_any(logs, one, seed, run_directory.part(str(number)), report)
    scores = {name: _scores(surrogate, scored, first) for name, surrogate in fitted.items()}
    record = run_directory.log()
    for number, each in enumerate(scores.values()):
        record.write(number, **each)
    record.close()
    best = min(scores, key=lambda name: scores[name]["force_rmse_n"])
    counts = {"logs_held_out": len(holding), "logs_scored": len(scored)}
    return fitted[best], {"chosen": best, "held_out": scores, **counts, "left_out": left_out}


def _possible(
    logs: Sequence[Log], candidates: dict[str, FitConfig | StreamingConfig], run_directory: RunDirectory
) -> tuple[dict[str, FitConfig | StreamingConfig], dict[str, str]]:
    """Candidates that can be fitted to the logs, and why others cannot: before hours of fitting, not behind them.

    Raises the first candidate's LogError where none can.
    """
    possible, reasons = dict[str, FitConfig | StreamingConfig](), dict[str, LogError]()
    for name, one in candidates.items():
        try:
            if isinstance(one, FitConfig):
                split(logs, one)
            else:
                StreamingFit(logs, one, 0, run_directory, None)
            possible[name] = one
        except LogError as error:
            reasons[name] = error
    if not possible:
        raise next(iter(reasons.values()))
    return possible, {name: str(error) for name, error in reasons.items()}


def _long_enough(logs: Sequence[Log], first: int) -> list[Log]:
    """Those that leave `SHORTEST_S` behind row `first`; where none does, those that leave a row, of which one must."""
    rows = [len(log.reading.time) for log in logs]
    long = first + SHORTEST_S * RATE_HZ
    least = long if max(rows) >= long else first + 1
    if max(rows) < least:
        check_lengths(logs, first, "held-out")
    return [log for log, count in zip(logs, rows, strict=True) if count >= least]


def _scores(surrogate: AnySurrogate, logs: Sequence[Log], first: int) -> dict[str, float]:
    """Errors free-running from row `first` on, each log in segments as long as it allows; over both axes."""
    lengths = [min(HORIZON_S * RATE_HZ, len(log.reading.time) - first) for log in logs]
    force, angle = [], []
    for ticks in sorted(set(lengths)):
        alike = [log for log, length in zip(logs, lengths, strict=True) if length == ticks]
        where = segments_of([len(log.reading.time) for log in alike], ticks, first)
        predicted, measured = free_run(surrogate, alike, where, ticks).reading, take(alike, where, ticks).reading
        force.append(np.ravel(predicted.force - measured.force))
        angle.append(np.ravel(predicted.angle - measured.angle))
    return {
        "force_rmse_n": rms(np.concatenate(force)),
        "angle_rmse_rad": rms(np.concatenate(angle)),
        "seconds": sum(map(len, angle)) / RATE_HZ,
    }


def _part(progress: Progress, name: str, number: int, of: int) -> Progress:
    return lambda stage, done, note: progress(stage, (number + done) / of, f"{name}: {note}")
