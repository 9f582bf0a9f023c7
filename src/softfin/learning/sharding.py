"""A run's lanes over the devices of a machine: each keeps some, and one program runs on all of them.

Lanes need nothing of each other, so devices that keep lanes do not talk. Where lanes cannot be dealt out evenly, their
environments are; then the devices talk in each mean over environments.
"""

from collections.abc import Sequence
from typing import Any, TypeVar, cast

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

Tree = TypeVar("Tree")

AXIS = "devices"


def over_devices(lanes: Tree, count: int, environments: int, devices: Sequence[Any] | None = None) -> Tree:
    """The lanes, over as many devices as have equal parts of them, or else of their environments.

    Args:
        lanes: leaves ``(lanes, ...)``; environments are dealt out where a ``batch`` is part of it, with leaves
            ``(lanes, environments, ...)``, as the lanes of all algorithms have it.
        count: of lanes.
        environments: of each lane.
        devices: to choose from, in their order; by default all that JAX finds.
    """
    found = jax.devices() if devices is None else list(devices)
    if (used := shared_by(count, len(found))) > 1:
        return cast(Tree, jax.device_put(lanes, _sharding(found[:used], AXIS)))
    if (used := shared_by(environments, len(found))) > 1 and hasattr(lanes, "batch"):
        everywhere: Any = jax.device_put(lanes, _sharding(found[:used]))
        batch = jax.device_put(lanes.batch, _sharding(found[:used], None, AXIS))
        return cast(Tree, everywhere._replace(batch=batch))
    return lanes


def shared_by(count: int, devices: int) -> int:
    """The greatest number of devices, of those there are, that have equal parts of `count` things."""
    return max(used for used in range(1, devices + 1) if count % used == 0)


def _sharding(devices: Sequence[Any], *axes: str | None) -> NamedSharding:
    return NamedSharding(Mesh(np.array(devices), (AXIS,)), PartitionSpec(*axes))  # type: ignore[no-untyped-call]
