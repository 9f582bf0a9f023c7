"""Which model: the one that is asked for, or the best of several on logs that none of them was fitted to."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from softfin.checkpoint import Workspace
from softfin.configuration import Configuration
from softfin.quantities import RATE_HZ, Log
from softfin.surrogate.fit import FitConfig, Progress, check_lengths, fit, held_out
from softfin.surrogate.horizons import free_running, places, take
from softfin.surrogate.store import AnySurrogate
from softfin.surrogate.streaming.config import StreamingConfig
from softfin.surrogate.streaming.fit import fit_streaming
from softfin.surrogate.streaming.streaming import MEMORY

HORIZON_S = 30
"""That candidates are left alone for, where the held-out logs are as long."""


class AutoConfig(Configuration):
    """Three candidates: the paper's nets, streaming nets, and streaming nets to which the fin has no symmetry."""

    paper: FitConfig = FitConfig()
    """The paper's nets."""
    streaming: StreamingConfig = StreamingConfig()
    """Streaming nets; the third candidate is the same without `mirror` and `turning`."""

    def candidates(self) -> dict[str, FitConfig | StreamingConfig]:
        """By name, in order of preference where two are equally good."""
        free = {"drive": {"mirror": False}, "force": {"mirror": False, "turning": False}}
        return {
            "streaming": self.streaming,
            "streaming, no symmetry": self.streaming.merged(free, "streaming"),
            "paper": self.paper,
        }


def fit_any(
    logs: Sequence[Log],
    config: FitConfig | StreamingConfig | AutoConfig,
    seed: int,
    workspace: Workspace,
    progress: Progress | None = None,
) -> tuple[AnySurrogate, dict[str, Any] | None]:
    """Fit what the configuration says; of several candidates the best, with the evidence for it (else None)."""
    if isinstance(config, FitConfig):
        return fit(logs, config, seed, workspace, progress), None
    if isinstance(config, StreamingConfig):
        return fit_streaming(logs, config, seed, workspace, progress), None
    candidates = config.candidates()
    # The shares may differ: what none was fitted to is what the least share holds out.
    holding = list(logs[-min(held_out(len(logs), one.held_out) for one in candidates.values()) :])
    # Before hours of fitting, not behind them.
    first = max(MEMORY, config.paper.posnet.window)
    check_lengths(holding, first, "held-out")
    fitted, scores = dict[str, AnySurrogate](), dict[str, dict[str, float]]()
    for number, (name, one) in enumerate(candidates.items()):
        report = None if progress is None else _part(progress, name, number, len(candidates))
        fitted[name], _ = fit_any(logs, one, seed, workspace.part(str(number)), report)
    for name, surrogate in fitted.items():
        scores[name] = _scores(surrogate, holding, first)
    record = workspace.log()
    for number, each in enumerate(scores.values()):
        record.write(number, **each)
    record.close()
    best = min(scores, key=lambda name: scores[name]["force_rmse_n"])
    return fitted[best], {"chosen": best, "held_out": scores}


def _scores(surrogate: AnySurrogate, logs: Sequence[Log], first: int) -> dict[str, float]:
    """Free-running from row `first` on, over all rows and both axes."""
    rows = [len(log.reading.time) for log in logs]
    ticks = min(HORIZON_S * RATE_HZ, min(rows) - first)
    where = places(rows, ticks, first)
    said, measured = free_running(surrogate, logs, where, ticks).reading, take(logs, where, ticks).reading
    force, angle = said.force - measured.force, said.angle - measured.angle
    return {
        "force_rmse_n": float(np.sqrt(np.mean(np.square(force, dtype=np.float64)))),
        "angle_rmse_rad": float(np.sqrt(np.mean(np.square(angle, dtype=np.float64)))),
        "seconds": ticks / RATE_HZ,
    }


def _part(progress: Progress, name: str, number: int, of: int) -> Progress:
    return lambda stage, done, note: progress(stage, (number + done) / of, f"{name}: {note}")
