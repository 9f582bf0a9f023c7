"""Fits the model that is asked for, or the better of both on logs that neither was fitted to."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from softfin.core.configuration import Configuration
from softfin.core.errors import LogError
from softfin.core.progress import Progress
from softfin.core.quantities import RATE_HZ, Log
from softfin.storage.run_directory import RunDirectory
from softfin.surrogate.compare.free_running import free_run, segments_of, take
from softfin.surrogate.compare.metrics import rms
from softfin.surrogate.paper.fit import FitConfig, fit, split
from softfin.surrogate.store import AnySurrogate
from softfin.surrogate.streaming.fit import StreamingConfig, fit_streaming, split_streaming
from softfin.surrogate.streaming.streaming import MEMORY
from softfin.surrogate.training import check_lengths, held_out_count

HORIZON_S = 30
"""Time that candidates run free for, where a held-out log is as long [s]."""

SHORTEST_S = 10
"""Shortest part of a held-out log, behind what warms a candidate, that is not passed over for longer ones [s]."""


class AutoConfig(Configuration):
    """Both models are fitted, and the better one is kept."""

    paper: FitConfig = FitConfig()
    """The paper's nets."""
    streaming: StreamingConfig = StreamingConfig()
    """Streaming nets."""


def fit_any(
    logs: Sequence[Log],
    config: FitConfig | StreamingConfig | AutoConfig,
    seed: int,
    run_directory: RunDirectory,
    progress: Progress | None = None,
) -> tuple[AnySurrogate, dict[str, Any] | None]:
    """Fit the model of the configuration; of both candidates the better, with the evidence for it (else None).

    The evidence: which was ``chosen``, the errors of each on ``held_out`` logs, how many of these, and why others were
    ``left_out``.
    """
    if isinstance(config, FitConfig):
        return fit(logs, config, seed, run_directory, progress), None
    if isinstance(config, StreamingConfig):
        return fit_streaming(logs, config, seed, run_directory, progress), None
    # In order of preference where both are equally good.
    candidates: dict[str, FitConfig | StreamingConfig] = {"streaming": config.streaming, "paper": config.paper}
    left_out = dict[str, LogError]()
    # What cannot be fitted is found out before hours of fitting.
    for name, check in (("streaming", lambda: split_streaming(logs, config.streaming)),
                        ("paper", lambda: split(logs, config.paper))):  # fmt: skip
        try:
            check()
        except LogError as error:
            left_out[name] = error
            del candidates[name]
    if not candidates:
        raise left_out["streaming"]
    # The shares may differ: the least share holds out what none was fitted to.
    holding = list(logs[-min(held_out_count(len(logs), one.held_out) for one in candidates.values()) :])
    first = max([MEMORY, *(one.posnet.window for one in candidates.values() if isinstance(one, FitConfig))])
    scored = _long_enough(holding, first)
    fitted = dict[str, AnySurrogate]()
    for number, (name, one) in enumerate(candidates.items()):

        def report(stage: str, done: float, note: str, name: str = name, number: int = number) -> None:
            if progress is not None:
                progress(stage, (number + done) / len(candidates), f"{name}: {note}")

        fitted[name], _ = fit_any(logs, one, seed, run_directory.part(str(number)), report)
    scores = {name: _scores(surrogate, scored, first) for name, surrogate in fitted.items()}
    record = run_directory.log()
    for number, each in enumerate(scores.values()):
        record.write(number, **each)
    record.close()
    best = min(scores, key=lambda name: scores[name]["force_rmse_n"])
    counts = {"logs_held_out": len(holding), "logs_scored": len(scored)}
    reasons = {name: str(error) for name, error in left_out.items()}
    return fitted[best], {"chosen": best, "held_out": scores, **counts, "left_out": reasons}


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
    force, angle = [], []
    for log in logs:
        ticks = min(HORIZON_S * RATE_HZ, len(log.reading.time) - first)
        where = segments_of([len(log.reading.time)], ticks, first)
        predicted, measured = free_run(surrogate, [log], where, ticks).reading, take([log], where, ticks).reading
        force.append(np.ravel(predicted.force - measured.force))
        angle.append(np.ravel(predicted.angle - measured.angle))
    return {
        "force_rmse_n": rms(np.concatenate(force)),
        "angle_rmse_rad": rms(np.concatenate(angle)),
        "seconds": sum(map(len, angle)) / RATE_HZ,
    }
