"""Refits a streaming surrogate to a few minutes of new logs of its fin, after the fin has changed:
the silicone has aged, the water is colder, or the servo is new.

The network architecture, scales and limits stay the same, and training starts from the weights of
the members. The result is the surrogate before or after the refit, whichever predicts the held-out
logs better.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np

from softfin.core.errors import ConfigurationError, LogError
from softfin.core.json_object import JsonObject
from softfin.core.plant_identity import identity
from softfin.core.progress import Progress
from softfin.core.quantities import LIMIT_KEYS, RATE_HZ, Log, command_limits
from softfin.storage.run_directory import RunDirectory
from softfin.surrogate.protocol import SurrogateConfig
from softfin.surrogate.streaming.ensemble import calibrated, predict_force, predict_motion
from softfin.surrogate.streaming.fit import StreamingConfig, fit_streaming, split_streaming
from softfin.surrogate.streaming.streaming import StreamingSurrogate
from softfin.surrogate.table_one import table_one

REFIT = {"drive_updates": 100, "force_updates": 300, "held_out": 0.3}
"""Defaults that differ from those of a fit, chosen on held-out logs of four perturbed tanks."""

LIMIT_TOLERANCE = 0.03
"""Distance by which new commands may exceed the limits of a surrogate [rad, rad/s]. Random commands
do not quite reach the ends of their range, so the limits differ slightly between recordings."""

MAX_FORCE_RATIO = 4
"""Ratio of forces at the same speed above which the fins must differ in size [-]. The force is
proportional to the fourth power of the length."""


class Refit(NamedTuple):
    """Refit of a streaming surrogate; replaces an `Architecture` in `fit`."""

    name: str
    """Path of the surrogate."""
    start: StreamingSurrogate
    entries: JsonObject
    """Entries of ``surrogate.json`` that the refitted surrogate inherits."""

    def config(self) -> StreamingConfig:
        """Return the default configuration."""
        drive = self.start.members.drive.config
        force = self.start.members.force.config
        return StreamingConfig(drive=drive, force=force, members=self.start.size, **REFIT)

    def fit(
        self,
        logs: Sequence[Log],
        config: SurrogateConfig,
        seed: int,
        run_directory: RunDirectory,
        progress: Progress | None = None,
    ) -> StreamingSurrogate:
        """Return the surrogate before or after the refit, whichever predicts the held-out logs
        better, with an interval calibrated on these logs.

        Raises:
            ConfigurationError: If the configuration changes the network architecture.
            LogError: If commands in the logs are outside the limits of the surrogate, or if the
                forces are those of a fin of a different size.
        """
        assert isinstance(config, StreamingConfig)
        start = self.start
        own = self.config()
        if (config.drive, config.force, config.members) != (own.drive, own.force, own.members):
            raise ConfigurationError(
                f"--start {self.name}: a refit cannot change the network architecture; remove the "
                "options --drive, --force and --members, or fit without --start"
            )
        limits = command_limits(logs)
        # The first and third limits are minima, which are exceeded by smaller values.
        excess = np.subtract(limits, start.limits) * (-1, 1, -1, 1)
        worst = int(excess.argmax())
        if excess[worst] > LIMIT_TOLERANCE:
            raise LogError(
                f"--start {self.name}: the commands in the new logs exceed the limits of the "
                f"surrogate ({LIMIT_KEYS[worst]} is {limits[worst]:.3g}, limit "
                f"{start.limits[worst]:.3g}); record commands within the limits, or fit without "
                "--start"
            )
        before = start.members.force.scales
        _, holding, now, _ = split_streaming(logs, config)
        rate = now.velocity_rad_s / before.velocity_rad_s
        ratio = now.force_n / before.force_n / rate**2
        if not 1 / MAX_FORCE_RATIO < ratio < MAX_FORCE_RATIO:
            raise LogError(
                f"--start {self.name}: the forces in the new logs are {ratio:.2g} times those of "
                "the surrogate at the same speed, so the fin has a different size; check the force "
                "unit, or fit without --start"
            )
        refitted = fit_streaming(logs, config, seed, run_directory, progress, start.members)
        # The offset is the mean drift of the logs; keep that of the start, which has more logs.
        refitted = eqx.tree_at(
            lambda each: each.members.force.offset, refitted, start.members.force.offset
        )
        errors = []
        for surrogate in (start, refitted):
            scores = table_one(surrogate, holding)["force_free_running"]
            errors.append(scores["physical"]["rmse"])
        better = refitted if errors[1] < errors[0] else start
        force = predict_force(better.members.force, predict_motion(better.members.drive, holding))
        interval = calibrated(force, holding, config.burn_in)
        return StreamingSurrogate(better.members, start.limits, interval, better.familiarity)

    def provenance(self, logs: Sequence[Log], scored: Sequence[Log]) -> JsonObject:
        """Return the name, hash and scores of the original surrogate, and the length of the new
        logs in minutes."""
        return {
            "start": self.name,
            "identity": identity(self.start),
            "scores": table_one(self.start, scored),
            "minutes": sum(log.rows for log in logs) / RATE_HZ / 60,
        }
