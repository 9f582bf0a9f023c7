"""The virtual tank: a soft fin in still water behind the Plant contract."""

from softfin.tank.conditions import Conditions, Spread, draw, randomised, under
from softfin.tank.drawn import DrawnTanks
from softfin.tank.sensor import IDEAL, SensorConfig
from softfin.tank.tank import Tank, TankConfig, TankState

__all__ = [
    "IDEAL",
    "Conditions",
    "DrawnTanks",
    "SensorConfig",
    "Spread",
    "Tank",
    "TankConfig",
    "TankState",
    "draw",
    "randomised",
    "under",
]
