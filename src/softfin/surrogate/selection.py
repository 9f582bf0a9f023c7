"""Fits the model that is asked for, or the better of both on logs that neither was fitted to."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from softfin.core.configuration import Configuration
from softfin.core.progress import Progress
from softfin.core.quantities import RATE_HZ, Log
from softfin.storage.run_directory import RunDirectory
from softfin.surrogate.compare.scores import free_run, rmse, segments_of, take
from softfin.surrogate.paper.fit import FitConfig, fit, split
from softfin.surrogate.store import AnySurrogate
from softfin.surrogate.streaming.fit import StreamingConfig, fit_streaming, split_streaming
from softfin.surrogate.streaming.streaming import StreamingSurrogate
from softfin.surrogate.training import check_lengths, hold_out

HORIZON_S = 30
"""Time that candidates run free for, where a held-out log is as long [s]."""


class AutoConfig(Configuration):
    """Both models are fitted, and the better one is kept."""

    paper: FitConfig = FitConfig()
    streaming: StreamingConfig = StreamingConfig()


AnyConfig: TypeAlias = FitConfig | StreamingConfig | AutoConfig


def fit_any(
    logs: Sequence[Log], config: AnyConfig, seed: int, run_directory: RunDirectory, progress: Progress | None = None
) -> tuple[AnySurrogate, dict[str, Any] | None]:
    """Fit the model of the configuration; of both candidates the better, with the errors on held-out logs of each."""
    if isinstance(config, FitConfig):
        return fit(logs, config, seed, run_directory, progress), None
    if isinstance(config, StreamingConfig):
        return fit_streaming(logs, config, seed, run_directory, progress), None
    # What cannot be fitted or scored is found out before hours of fitting.
    split_streaming(logs, config.streaming)
    split(logs, config.paper)
    # In order of preference where both are equally good.
    candidates: dict[str, FitConfig | StreamingConfig] = {"streaming": config.streaming, "paper": config.paper}
    # The shares may differ: the least share holds out what none was fitted to.
    held_out = min((hold_out(logs, one.held_out)[1] for one in candidates.values()), key=len)
    first = max(StreamingSurrogate.memory, config.paper.posnet.window)
    check_lengths(held_out, first, "held-out")
    fitted, scores = dict[str, AnySurrogate](), dict[str, dict[str, float]]()
    for number, (name, one) in enumerate(candidates.items()):

        def report(stage: str, done: float, note: str, name: str = name, number: int = number) -> None:
            if progress is not None:
                progress(stage, (number + done) / len(candidates), f"{name}: {note}")

        fitted[name], _ = fit_any(logs, one, seed, run_directory.part(str(number)), report)
        scores[name] = _scores(fitted[name], held_out, first)
    best = min(scores, key=lambda name: scores[name]["force_rmse_n"])
    return fitted[best], {"chosen": best, "held_out": scores, "logs_held_out": len(held_out)}


def _scores(surrogate: AnySurrogate, logs: Sequence[Log], first: int) -> dict[str, float]:
    """Errors free-running from row `first` on, each log in segments as long as it allows; over both axes."""
    pairs = []
    for log in logs:
        ticks = min(HORIZON_S * RATE_HZ, len(log.reading.time) - first)
        where = segments_of([len(log.reading.time)], ticks, first)
        pairs.append((free_run(surrogate, [log], where, ticks)[0], take([log], where, ticks).reading))

    def error(name: str) -> float:
        both = zip(*pairs, strict=True)
        return rmse(*(np.concatenate([np.ravel(getattr(each, name)) for each in side]) for side in both))

    seconds = sum(measured.angle.size for _, measured in pairs) / RATE_HZ
    return {"force_rmse_n": error("force"), "angle_rmse_rad": error("angle"), "seconds": seconds}
