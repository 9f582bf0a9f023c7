"""Refits a streaming surrogate to a few minutes of new logs of its fin, which has changed since: the
silicone ages, the water is colder, or the servo is new.

Architecture, scales and limits stay the same, and each member continues from its weights. The
surrogate before or after the refit is returned, whichever predicts the held-out logs better.
"""

from collections.abc import Sequence

import jax
import numpy as np

from softfin.core.errors import ConfigurationError, LogError
from softfin.core.json_object import JsonObject
from softfin.core.plant_identity import identity
from softfin.core.progress import Progress
from softfin.core.quantities import LIMIT_KEYS, RATE_HZ, Log, command_limits
from softfin.storage.run_directory import RunDirectory
from softfin.surrogate.protocol import SurrogatePlant
from softfin.surrogate.streaming.ensemble import calibrated, predict_force, predict_motion
from softfin.surrogate.streaming.fit import (
    StreamingConfig,
    StreamingSplit,
    split_streaming,
    train_members,
)
from softfin.surrogate.streaming.segments import measure_scales
from softfin.surrogate.streaming.streaming import StreamingSurrogate
from softfin.surrogate.table_one import rmse

REFIT = {
    "drive_updates": 100,
    "force_updates": 300,
    "learning_rate": 0.003,
    "free_running": (0.0, 0.0),
    "held_out": 0.3,
}
"""Defaults of a refit that differ from a fit; docs/surrogates.md describes the measurements."""

ARCHITECTURE_FIELDS = ("drive", "force", "members")
"""Fields of `StreamingConfig` that a refit cannot change."""

LIMIT_TOLERANCE = 0.03
"""Distance by which new commands may exceed the limits of a surrogate [rad, rad/s]. Random commands
never quite reach the end of a range."""

MAX_LENGTH_RATIO = 1.4
"""Ratio of fin lengths above which the fin is a different one. The force is proportional to the
fourth power of the length, so the force differs by a factor of 3.8."""


def check_start(start: SurrogatePlant, name: str) -> StreamingSurrogate:
    """Raise ConfigurationError unless a surrogate can be refitted."""
    if not isinstance(start, StreamingSurrogate):
        raise ConfigurationError(
            f"--start {name}: a surrogate of the model {start.model}; only streaming surrogates "
            "can be refitted; fit the logs without --start"
        )
    return start


def refit_config(start: StreamingSurrogate) -> StreamingConfig:
    """Return the default configuration for refitting a surrogate."""
    return StreamingConfig(
        drive=start.members.drive.config,
        force=start.members.force.config,
        members=start.size,
        **REFIT,
    )


def check_architecture(start: StreamingSurrogate, name: str, config: StreamingConfig) -> None:
    """Raise ConfigurationError if a configuration changes the architecture of a surrogate."""
    kept = refit_config(start)
    for field in ARCHITECTURE_FIELDS:
        if getattr(config, field) != getattr(kept, field):
            raise ConfigurationError(
                f"{field}: a refit keeps the architecture of {name} ({getattr(kept, field)!r}); "
                f"remove --{field}, or fit without --start"
            )


def check_same_fin(start: StreamingSurrogate, name: str, logs: Sequence[Log]) -> None:
    """Raise LogError if commands in logs are outside the limits of a surrogate, or if the logs are
    those of a fin of a different size."""
    limits = command_limits(logs)
    excess = (
        start.limits.angle_min - limits.angle_min,
        limits.angle_max - start.limits.angle_max,
        start.limits.velocity_min - limits.velocity_min,
        limits.velocity_max - start.limits.velocity_max,
    )
    for key, value, limit, beyond in zip(LIMIT_KEYS, limits, start.limits, excess, strict=True):
        if beyond > LIMIT_TOLERANCE:
            raise LogError(
                f"new logs: {key} of the commands is {value:.3g}, outside the limits of {name} "
                f"({limit:.3g}); record commands within them, or fit without --start"
            )
    scales = measure_scales(logs)
    # force ~ density length^4 rate^2
    before = start.members.force.scales
    squared = (before.velocity_rad_s / scales.velocity_rad_s) ** 2
    ratio = (scales.force_n / before.force_n * squared) ** 0.25
    if max(ratio, 1 / ratio) > MAX_LENGTH_RATIO:
        raise LogError(
            f"new logs: the force is that of a fin {ratio:.2g} times as long as the fin of {name}; "
            "check the force unit, or fit without --start"
        )


def split_single_log(logs: Sequence[Log], share: float) -> Sequence[Log]:
    """Split a single log into two, of which the second is held out; return several logs
    unchanged."""
    if len(logs) != 1:
        return logs
    (log,) = logs
    cut = round((1 - share) * log.rows)
    return [jax.tree.map(lambda x, part=part: x[part], log) for part in (slice(cut), slice(cut, None))]


def refit_streaming(
    start: StreamingSurrogate,
    logs: Sequence[Log],
    config: StreamingConfig,
    seed: int,
    run_directory: RunDirectory,
    progress: Progress | None = None,
) -> tuple[StreamingSurrogate, JsonObject]:
    """Train the members of `start` on new logs.

    Returns:
        The surrogate that predicts the held-out logs better, with an interval calibrated on these
        logs; and the errors of both, for the provenance.
    """
    split = split_streaming(logs, config)._replace(scales=start.members.force.scales)
    refitted = train_members(
        start.members, start.limits, split, config, seed, run_directory, progress
    )
    errors = {
        "start": _force_error(start, split.holding),
        "refit": _force_error(refitted, split.holding),
    }
    kept = min(errors, key=errors.__getitem__)
    if kept == "start":
        motion = predict_motion(start.members.drive, split.holding)
        force = predict_force(start.members.force, motion)
        interval = calibrated(force, split.holding, config.burn_in)
        refitted = StreamingSurrogate(start.members, start.limits, interval, start.familiarity)
    rows = sum(log.rows for log in logs)
    return refitted, {
        "start_identity": identity(start),
        "new_minutes": rows / RATE_HZ / 60,
        "kept": kept,
        "held_out_force_rmse_n": errors,
    }


def _force_error(surrogate: StreamingSurrogate, logs: Sequence[Log]) -> float:
    """Return the root mean square error of the force predicted from commands alone [N]."""
    series = surrogate.predictions(logs)["force_free_running"].series
    measured = [log.reading.force[-len(force) :] for force, log in zip(series, logs, strict=True)]
    return rmse(np.concatenate(series), np.concatenate(measured))
