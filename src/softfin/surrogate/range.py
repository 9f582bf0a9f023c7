"""The range of a surrogate's training data and the fin they are of, which go into every controller trained in it.

A rig tells by the range how far its fin is from the training data, and by the name that a controller is for another.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from softfin.core.errors import LogError
from softfin.core.quantities import Limits, Log
from softfin.storage import artifact as artifacts
from softfin.surrogate.channels import ANGLE, COMMANDS, FORCES, joined_channels

Range: TypeAlias = dict[str, list[float] | None]
"""Least and greatest of each channel; None where that is not known."""

CHANNELS = (ANGLE, "velocity_rad_s", *FORCES)
"""Channels of the readings."""

UNKNOWN: Mapping[str, Any] = {"training_range": None, "fin": None}
"""Entries of a plant that is not a surrogate, or one without them."""


def training_range(logs: Sequence[Log]) -> Range:
    """Range of the readings in the logs that a surrogate learns from."""
    columns = joined_channels(logs) | {CHANNELS[1]: np.concatenate([log.reading.velocity for log in logs])}
    return {name: [float(columns[name].min()), float(columns[name].max())] for name in CHANNELS}


def check_commands_learnt(logs: Sequence[Log], source: str) -> None:
    """Raise LogError where a surrogate of these logs would have limits that no fin has: none could be loaded."""
    columns = joined_channels(logs)
    limits = Limits(*(float(end) for name in COMMANDS for end in (columns[name].min(), columns[name].max())))
    if problem := limits.problem(one_velocity=True):
        raise LogError(f"{source}: the commands to learn from: {problem}; are they in degrees? see --angles deg")


def learnt_from(plant: object) -> dict[str, Any]:
    """``training_range`` and ``fin`` of a surrogate's folder, where `plant` names one that has them; else unknown.

    Surrogates with min-max scaling, imported ones among them, have kept the range of their channels in it.
    """
    folder = Path(plant) if isinstance(plant, str | Path) else None
    if folder is None or not artifacts.is_kind(folder, "surrogate"):
        return dict(UNKNOWN)
    description = artifacts.load_description(folder, "surrogate")
    entries = {name: description.get(name) for name in UNKNOWN}
    scaling = description.get("scaling")
    if entries["training_range"] is None and isinstance(scaling, dict):
        channels = {name: scaling.get(name) for name in CHANNELS}
        entries["training_range"] = {
            name: [channel["data_min"], channel["data_max"]] if isinstance(channel, dict) else None
            for name, channel in channels.items()
        }
    return entries
