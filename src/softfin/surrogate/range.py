"""What goes with a surrogate into every controller that is trained in it: how far its data reached, and of which fin.

A rig tells by the range how far from anything learnt its fin is, and by the name that a controller is not for it.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from softfin.core.errors import LogError
from softfin.core.quantities import Limits, Log
from softfin.storage import artifact as artifacts
from softfin.surrogate.paper.forcenet import FORCES
from softfin.surrogate.paper.surrogate import ANGLE

Range: TypeAlias = dict[str, list[float] | None]
"""Least and greatest of each channel; None where that is not known."""

CHANNELS = (ANGLE, "velocity_rad_s", *FORCES)
"""Of the readings."""

UNKNOWN: Mapping[str, Any] = {"training_range": None, "fin": None}
"""Of a plant that is no surrogate, or none that says."""


def training_range(logs: Sequence[Log]) -> Range:
    """Of the readings in the logs that a surrogate learns from."""
    readings = [log.reading for log in logs]
    columns = [
        [reading.angle for reading in readings],
        [reading.velocity for reading in readings],
        *([reading.force[:, axis] for reading in readings] for axis in range(len(FORCES))),
    ]
    return {
        name: [float(min(part.min() for part in parts)), float(max(part.max() for part in parts))]
        for name, parts in zip(CHANNELS, columns, strict=True)
    }


def check_commands_learnt(logs: Sequence[Log], source: str) -> None:
    """Raise LogError where a surrogate of these logs would have limits that no fin has: none could be loaded."""
    ranges = [(min(c.min() for c in commands), max(c.max() for c in commands))
              for commands in zip(*(log.command for log in logs), strict=True)]  # fmt: skip
    if problem := Limits(*(float(end) for ends in ranges for end in ends)).problem(one_velocity=True):
        raise LogError(f"{source}: the commands to learn from: {problem}; are they in degrees? see --angles deg")


def learnt_from(plant: object) -> dict[str, Any]:
    """``training_range`` and ``fin`` of a surrogate's folder, where `plant` names one that says; else unknown.

    Surrogates with min-max scaling, imported ones among them, have kept the range of their channels in it.
    """
    folder = Path(plant) if isinstance(plant, str | Path) else None
    if folder is None or not artifacts.is_kind(folder, "surrogate"):
        return dict(UNKNOWN)
    description = artifacts.load_description(folder, "surrogate")
    known = {name: description.get(name) for name in UNKNOWN}
    scaling = description.get("scaling")
    if known["training_range"] is None and isinstance(scaling, dict):
        known["training_range"] = {name: _scaled(scaling.get(name)) for name in CHANNELS}
    return known


def _scaled(channel: Any) -> list[float] | None:
    return [channel["data_min"], channel["data_max"]] if isinstance(channel, dict) else None
