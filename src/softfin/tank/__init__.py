"""The virtual tank: a simulated soft fin in still water, as a `Plant`."""

from softfin.tank.randomization import (
    DomainRandomization,
    RandomizedTank,
    sample_tank,
    with_parameters,
)
from softfin.tank.sensor import IDEAL, SensorConfig
from softfin.tank.tank import Tank, TankConfig, TankState

__all__ = [
    "IDEAL",
    "DomainRandomization",
    "RandomizedTank",
    "SensorConfig",
    "Tank",
    "TankConfig",
    "TankState",
    "sample_tank",
    "with_parameters",
]
